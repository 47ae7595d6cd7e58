"""The suite: what an attempt has reached and when, how rows stand, and that results outlive their run folders."""

import csv
from dataclasses import replace
from itertools import permutations
from math import inf
from pathlib import Path

import numpy as np
import pytest
from omegaconf import OmegaConf

from bench import merge
from bench.records.read import read_records
from bench.report.suite import attempts
from bench.report.suite.attempts import Attempt, attempts_of, joined, place, read_attempts, suite, write_attempts
from bench.report.suite.standing import SECONDS, Standing
from bench.studies.suite import _doubts, _panel
from bench.suite import _sweeps, main, parsed, show
from bench.tables import choice, read_yaml
from tests.composing import composed
from tests.looped import each
from tests.report.test_report_paper import write_lines, write_run

DIST = choice("renderer", "dist")["_label_"]
SHIPPED = Path(__file__).resolve().parents[2] / "results"
SCENES = tuple(f"{family} test {index}" for family in ("vase", "lamp") for index in range(4))  # not among references


def attempt(row: str, scene: str, errors: dict[float, float], **changed) -> Attempt:
    """One whose curve has these errors by cost, the first the start and the last the end; a second is 1000 values."""
    curve = [[cost, cost / 1000, error] for cost, error in errors.items()]
    known = {
        **{"set": "complete", "problem": f"{scene}, 20 points", "scene": scene, "seed": 0, "row": row},
        **{"preset": row.lower(), "status": "ok", "reason": "", "start": curve[0][2], "final": curve[-1][2]},
        **{"cost": curve[-1][0], "operations": None, "seconds": 1.0, "waited": None, "cpu": "one", "device": "cpu"},
        **{"threads": 1, "kernels": "torch", "started": "2026-01-01T00:00:00+00:00", "commit": "", "code": "a"},
        **{"settings": "", "curve": curve, "overrides": ["+experiment=core_complete", "task.points=20"]},
    }
    return Attempt(**(known | changed))


def field(of: list[tuple[str, float, float]]) -> Standing:
    """Rows with their final error and what they pay for each step, on all scenes."""
    return Standing(
        [
            attempt(row, scene, {0: 1.0, pay: max(final, 0.1), 2 * pay: final})
            for row, final, pay in of
            for scene in SCENES
        ]
    )


def write_completion(results: Path, errors: list[float], **changed) -> Path:
    """A run of the suite whose line n has these errors and n + 1 thousand values; the last error is that of its end."""
    settings = {
        "split": "test",
        "task": {"points": "20"},
        "renderer": {"_label_": "Mine"},
        **changed.pop("settings", {}),
    }
    changed = {"metrics": {"chamfer_l1": errors[-1]}, "metrics_start": {"chamfer_l1": errors[0]}} | changed
    changed = {"overrides": ["task.points=20", "results_dir=x"]} | changed
    folder = write_run(results, "core_complete", None, settings=settings, **changed)
    lines = [
        {"iteration": n, "seconds": n + 1.0, "cost": 1000.0 * (n + 1), "total": 1.0, "chamfer_l1": error}
        for n, error in enumerate(errors[:-1])
    ]
    write_lines(folder, lines)
    return folder


def test_a_checkpoint_has_the_costs_of_the_line_before_it(tmp_path):
    write_completion(tmp_path, [0.8, 0.4, 0.2])
    (found,) = attempts_of(read_records(tmp_path)[0], tmp_path)
    assert found.curve == [[0, 0, 0.8], [1000, 1, 0.4], [2000, 2, 0.2]]
    assert (found.set, found.problem, found.row, found.start, found.final) == (
        "complete", "car test 0, 20 points", "Mine", 0.8, 0.2,
    )  # fmt: skip
    assert found.overrides == ["task.points=20"]


def test_a_rendering_has_its_cost_and_its_pixel_errors(tmp_path):
    settings = {"split": "train", "task": {"size": 64}, "renderer": {"_label_": "Mine"}}
    metrics = {"pixel_errors": 3, "cost": 512.0, "forward_seconds": 0.25}
    known = {"settings": settings, "metrics": metrics, "metrics_start": {"pixel_errors": 900}}
    write_run(tmp_path, "core_render", None, seconds={"forward": 0.25, "backward": 1.0}, **known)
    (found,) = attempts_of(read_records(tmp_path)[0], tmp_path)
    assert (found.problem, found.start, found.curve) == ("car train 0, 64 pixels", 900, [[512, 0.25, 3]])
    failed = replace(found, problem="another", status="timeout", final=inf)
    assert Standing([found]).wrong("Mine") == 3 / 900 and Standing([found]).judged == []
    assert Standing([found, failed]).wrong("Mine") == pytest.approx((3 / 900 + 1) / 2)


def test_rows_are_compared_where_all_that_have_the_least_size_have_an_attempt(monkeypatch):
    least = [("complete", f"{scene}, 20 points", 0) for scene in SCENES[:6]]
    monkeypatch.setattr("bench.report.suite.standing.least_problems", lambda: {*least})
    whole = field([("Dist", 0.011, 100.0), ("B", 0.01, 100.0), ("Mine", 0.01, 100.0), ("Part", 0.01, 1.0)]).everything
    mine = [one for one in whole if one.row not in ("Mine", "Part") or one.key[:3] in least]
    standing = Standing([one for one in mine if one.row != "Part" or one.scene == SCENES[0]])
    assert standing.compared == {*least} and {*standing.ranked} == {"B", "Dist", "Mine"}
    assert standing.lacking("Part") == 5 and standing.rows[-1] == "Part"
    assert len(Standing([one for one in standing.everything if one.row in ("B", "Dist")]).compared) == len(SCENES)


def test_each_set_weighs_the_same_and_a_run_under_other_settings_is_not_judged():
    many = [attempt("Dist", scene, {0: 1.0, 10: 0.01}) for scene in SCENES]
    few = [replace(attempt("Dist", "s", {0: 90.0, 10: 90.0}), set="pose", problem="s, 20 degrees")]
    assert Standing(many + few).share("Dist").value == 0.5
    assert Standing(many + few).profile("Dist") == ([1, 1, 1], [0, 0.5, 0.5])
    other = replace(many[0], row="Other", settings="x")
    assert Standing([*many, other]).rows == ["Dist"]


def test_the_chance_of_a_difference_is_that_of_flipped_signs_over_scenes():
    standing = field([("Dist", 0.01, 100.0), ("Lost", 0.5, 1.0)])
    assert standing._chance("Dist", "Lost") == 2 / 2 ** len(SCENES)  # all scenes one way, or all the other way
    assert standing._chance("Dist", "Dist") == 1 and standing.told == {"Lost"}
    many = field([("Dist", 0.01, 100.0), *((f"L{n}", 0.5, 1.0) for n in range(7))])
    assert many.told == set() and many.resolution is None  # 28 pairs at .0078
    more = [attempt(row, f"{n}", {0: 1.0, 9: final}) for row, final in (("A", 0.01), ("B", 0.5)) for n in range(40)]
    assert Standing(more)._chance("A", "B") == 1 / 2**16  # of random signs what was found is one


def test_the_resolution_is_what_is_told_in_four_cases_of_five(monkeypatch):
    standing = Standing([attempt(row, f"{n}", {0: 1.0, 9: 0.1}) for row in "AB" for n in range(12)])
    drawn = np.random.default_rng(0).normal(size=(400, 12))
    monkeypatch.setattr(Standing, "_apart", lambda *_: drawn[0] / drawn[0].std(ddof=1))
    shift, told = standing.resolution / 12, 0
    for noise in drawn:
        monkeypatch.setattr(Standing, "_apart", lambda *_, noise=noise: noise + shift)
        told += standing._chance("A", "B") <= 0.05
    assert 0.75 < told / len(drawn) < 0.85


def test_a_run_under_other_settings_takes_no_place_and_a_tuned_one_is_named(tmp_path):
    runs = [attempt("A", scene, {0: 1.0, 9: 0.01}) for scene in SCENES]
    other = replace(runs[0], settings="x", started="2027-01-01T00:00:00+00:00", status="oom", final=inf, curve=[])
    assert Standing([*runs, other]).share("A").value == 1
    write_attempts([*runs, other], tmp_path)
    assert len(read_attempts(tmp_path)[0]) == len(runs) + 1
    write_completion(tmp_path, [0.8, 0.2], method="tuned/dist_mask", settings={"label": "Mine"}, renderer="dist")
    assert [one.row for one in attempts_of(read_records(tmp_path)[0], tmp_path)] == ["Mine, tuned"]


def test_an_error_is_reached_where_it_stays_reached():
    one = attempt("A", "s", {0: 8, 10: 1, 20: 4, 30: 2, 40: 1})
    assert one.reached(5) == (10, 0.01)
    assert one.reached(3) == (30, 0.03)  # it was below at 10, and above again at 20
    assert one.reached(0.5) is None
    assert replace(one, status="nan").reached(5) is None


def test_targets_are_shares_of_the_logarithm_between_start_and_reference():
    standing = Standing([attempt("Dist", "s", {0: 100, 7: 10, 9: 1}), attempt("B", "s", {0: 100, 3: 10.5})])
    assert standing.references == {("complete", "s, 20 points"): 1}
    assert standing.reached["complete", "s, 20 points", 0, "Dist", ""] == [(7, 0.007), *[(9, 0.009)] * 4]
    assert standing.reached["complete", "s, 20 points", 0, "B", ""] == [(inf, inf)] * 5  # 10.5 is above the root of 100


def test_the_shipped_references_are_used_where_there_are_any():
    known = suite().references["complete"]
    scene, error = next(iter(known.items()))
    assert Standing([attempt("A", scene, {0: 1.0, 1: 0.9})]).references == {("complete", f"{scene}, 20 points"): error}
    assert all(0 < error < 0.1 for error in known.values())


def test_rows_stand_by_what_they_reach_and_are_told_from_the_first():
    standing = field([("Dist", 0.011, 100.0), ("Exact", 0.01, 300.0), ("Same", 0.011, 100.0), ("Lost", 0.5, 1.0)])
    assert standing.rows == ["Exact", "Dist", "Same", "Lost"]
    assert [standing.share(row).value for row in standing.rows] == [1.0, 0.8, 0.8, 0.0]
    assert [standing.against(row) for row in standing.rows] == ["first", *["less"] * 3]
    assert standing.ratio("Exact").value == pytest.approx(3) and standing.ratio("Dist") is None
    assert standing.ratio("Lost") is None  # no target that both reach
    assert {*standing.units.values()} == {200}  # of a whole run of Dist
    assert standing.profile("Exact") == ([1.5, 1.5, 3, 3], [0, 0.2, 1, 1])


def test_a_number_that_is_none_is_not_reached_and_a_changed_renderer_has_another_name(tmp_path):
    asked = {"overrides": ["+experiment=core_complete", "renderer=newton", "renderer.steps=9", "task.points=20"]}
    write_completion(tmp_path, [0.8, 0.4, 0.2], **asked)
    line = '{"iteration": 1, "seconds": 2.0, "cost": 2000.0, "total": NaN, "chamfer_l1": NaN}'
    curve = next(tmp_path.glob("runs/*/curve.jsonl"))
    curve.write_text(curve.read_text().splitlines()[0] + "\n" + line + "\n")
    write_attempts(attempts_of(read_records(tmp_path)[0], tmp_path), tmp_path)
    ((found,), problems) = read_attempts(tmp_path)
    assert problems == [] and found.row == "Mine, steps=9" and [error for *_, error in found.curve] == [0.8, inf, 0.2]


def test_a_row_that_cost_nothing_has_no_line_and_leaves_the_axis_logarithmic():
    standing = field([("Dist", 0.01, 100.0)])
    late = [attempt("Late", scene, {0: 1.0}, status="timeout") for scene in SCENES]
    panel = _panel(Standing([*standing.everything, *late]), None)
    assert [line["name"] for line in panel["series"]] == ["Dist"] and panel["x"]["log"]


def test_a_row_without_a_problem_is_not_compared_and_a_failure_reaches_nothing():
    whole = field([("Dist", 0.01, 100.0), ("Part", 0.01, 100.0)]).attempts
    standing = Standing([replace(one, status="unsupported") if one.row == "Dist" else one for one in whole[:-1]])
    assert standing.ranked == ["Dist"] and standing.lacking("Part") == 1 and standing.against("Part") == ""
    assert standing.share("Dist").value == 0 and standing.failures("Dist") == {"unsupported": len(SCENES)}


def test_problems_that_the_reference_row_lacks_are_not_judged():
    whole = field([("Dist", 0.011, 100.0), ("B", 0.01, 100.0)]).attempts
    of_b = next(one for one in whole if one.row == "B")
    standing = Standing([*whole, replace(of_b, problem="another", scene="another")])
    assert {*standing.ranked} == {"Dist", "B"} and len(standing.attempts) == len(whole)
    tweaked = [replace(one, row="A tweak") for one in whole if one.row == "Dist"]
    named = [replace(one, row=DIST) if one.row == "Dist" else one for one in whole]
    assert Standing([*tweaked, *named]).reference == DIST


def test_a_start_that_was_not_measured_is_that_of_the_other_rows():
    whole = field([("Dist", 0.011, 100.0), ("B", 0.01, 100.0)]).attempts
    lost = [replace(one, start=inf, final=inf, status="crashed") if one.row == "B" else one for one in whole]
    standing = Standing(lost)
    assert standing.share("B").value == 0 and len(standing.of("B")) == len(SCENES)
    without = replace(whole[0], start=inf, final=inf, curve=[[0.0, 0.0, inf], [5.0, 1.0, inf]])
    assert Standing([without]).judged == [] and without.reached(inf) is None


def test_seconds_are_compared_on_the_same_machine_alone():
    whole = field([("Dist", 0.01, 100.0), ("Mine", 0.01, 200.0)]).attempts
    assert Standing(whole).ratio("Mine", SECONDS).value == pytest.approx(2)
    moved = [replace(one, cpu="another") if one.row == "Mine" else one for one in whole]
    assert Standing(moved).ratio("Mine", SECONDS) is None and Standing(moved).ratio("Mine").value == pytest.approx(2)
    slow = [[cost, 4 * seconds, error] for cost, seconds, error in whole[0].curve]
    there = [replace(one, cpu="another", curve=slow) for one in whole if one.row == "Dist"]
    loaded = [replace(one, waited=0.2) for one in there]
    assert Standing([*moved, *loaded]).ratio("Mine", SECONDS) is None
    assert Standing([*moved, *there]).ratio("Mine", SECONDS).value == pytest.approx(0.5)
    others = [replace(one, settings="x", started="2027", curve=[[0, 0, 1.0], [1, 1e-9, 0.01]]) for one in there[1:]]
    assert Standing([*moved, *there, *others]).ratio("Mine", SECONDS).value == pytest.approx(0.5)


def test_kept_attempts_are_read_as_they_were_and_joined_in_any_order(tmp_path):
    good = attempt("A b", "s", {0: 1.0, 5: 0.5}, reason='said "no", twice', started="2026-01-02T00:00:00+00:00")
    failed = replace(
        good, status="oom", final=inf, curve=[[0.0, 0.0, 1.0], [5.0, 0.005, inf]], started="2026-01-03T00:00:00+00:00"
    )
    older = replace(good, started="2026-01-01T00:00:00+00:00")
    other = replace(good, row="A-b")  # whose file has the same name
    for order in permutations([good, failed, older, other]):
        assert {one.key: one for one in joined(order)} == {good.key: failed, other.key: other}
    write_attempts([failed, other], tmp_path)
    assert {*map(repr, read_attempts(tmp_path)[0])} == {repr(failed), repr(other)}
    write_attempts([latest := replace(good, started="2026-01-04T00:00:00+00:00")], tmp_path)
    assert sorted(read_attempts(tmp_path)[0], key=lambda one: one.row) == [latest, other]
    assert [path.name for path in place(tmp_path).iterdir()] == ["a_b.csv"]


def test_two_halves_merged_are_the_whole(tmp_path):
    whole = field([("Dist", 0.01, 100.0), ("B", 0.02, 50.0)]).attempts
    write_attempts(whole[:5], tmp_path / "one")
    write_attempts(whole[5:], tmp_path / "two")
    merge.merge([tmp_path / "one", tmp_path / "two"], tmp_path / "both")
    by_key = [sorted(joined(of), key=lambda one: one.key) for of in (read_attempts(tmp_path / "both")[0], whole)]
    assert by_key[0] == by_key[1]


def test_a_file_that_cannot_be_read_is_told_and_others_are_kept(tmp_path):
    write_attempts([attempt("A", "s", {0: 1.0, 5: 0.5})], tmp_path)
    (place(tmp_path) / "b.csv").write_text("set,problem\ncomplete,s\n")
    found, problems = read_attempts(tmp_path)
    assert len(found) == 1 and problems[0].startswith("b.csv")
    with pytest.raises(ValueError, match=r"b\.csv"):  # whose lines would be lost
        write_attempts(found, tmp_path)
    for wrong in ({"final": -1.0}, {"final": 0.4}, {"set": "none"}, {"status": "fine"}):
        write_attempts([replace(found[0], **wrong)], tmp_path / str(wrong))
        assert read_attempts(tmp_path / str(wrong))[0] == []


def test_the_page_has_a_line_a_row_and_stands_beside_what_is_shipped(tmp_path, monkeypatch, capsys):
    shipped = tmp_path / "shipped"
    write_completion(tmp_path / "own", [0.8, 0.4, 0.05])
    (mine,) = attempts_of(read_records(tmp_path / "own")[0], tmp_path / "own")
    dist = attempt("Dist", "car test 0", {0: 0.8, 500: 0.011, 600: 0.01}, settings=mine.settings)
    write_attempts([dist], shipped)
    monkeypatch.setattr("bench.report.write.paper.SHIPPED", shipped)
    assert show(tmp_path / "own") == 0
    said = capsys.readouterr().out.splitlines()
    assert said[0].startswith("1 run of ") and "which 1 stand" in said[0]
    assert said[2].split()[:3] == ["Dist", "100", "%"] and said[3].startswith("Mine * ") and Path(said[-2]).is_file()
    data = "".join(path.read_text() for path in (Path(said[-1]).parent / "page" / "data").rglob("*.js"))
    assert "Mine" in data and "Dist" in data  # the page, too, is of the table that was written
    table = (tmp_path / "own" / "paper" / "suite.md").read_text()
    assert "| Dist |" in table and "| Mine |" in table and "reaches 100 %" in table
    assert [one.row for one in read_attempts(tmp_path / "own")[0]] == ["Mine"]


@each(
    "argument, said",
    [("suite=large", "unknown suite 'large'"), ("setting=tunde", "did you mean tuned"),
     ("set=pose,poze", "did you mean pose"), ("--plan", "no KEY=VALUE"),
     ("verify=0", "verify must be"), ("task.optimiser.budget=1e9", "is stated by the suite"),
     ("scale=smoke", "is stated by the suite"), ("+dataset.radius=.5", "is stated by the suite"),
     ("models.size=free", "is stated by the suite")],
)  # fmt: skip
def test_a_wrong_argument_is_told(argument, said, capsys):
    assert main([argument]) == 2
    assert said in capsys.readouterr().err


def test_what_is_not_its_own_is_passed_on():
    given = ["renderer=custom", "renderer._target_=a.B", "label=Mine", "dataset=sofa", "task.points=20"]
    own, passed = parsed(["suite=core", *given])
    assert own["suite"] == "core" and passed == given


def test_every_set_is_an_experiment_with_each_size():
    for name in suite().errors:
        sizes = read_yaml(Path("conf") / "experiment" / f"core_{name}.yaml")["sizes"]
        assert {*sizes} - {"chosen"} == {*suite().sizes.values()}


def test_a_tuned_row_stands_behind_its_renderers_and_changes_no_comparison(monkeypatch):
    rows = [("Dist", 0.011, 100.0), ("B", 0.01, 100.0), ("Lost", 0.5, 1.0)]
    for_all = field(rows).everything
    for_all += [replace(one, set="pose") for one in for_all]
    monkeypatch.setattr("bench.report.suite.standing.least_problems", lambda: {one.key[:3] for one in for_all})
    tuned = [
        attempt(f"{row}, tuned", scene, {0: 1.0, 9: final}, settings="own", preset=row.lower())
        for row, final in (("Dist", 0.01), ("B", 0.5), ("Lost", 0.5))
        for scene in SCENES
    ]
    before, standing = Standing(for_all), Standing(for_all + tuned[:-1])
    assert standing.rows == ["B", "B, tuned", "Dist", "Dist, tuned", "Lost", "Lost, tuned"]
    assert standing.ranked == before.ranked and standing.told == before.told
    assert standing.resolution == before.resolution
    assert standing.references == before.references and standing.not_run("Lost, tuned") == 1
    assert standing.lacking("Dist, tuned") == len(SCENES) and standing.not_run("Dist, tuned") == 0
    gains = [standing.gain(row) for row in standing.rows[:4]]
    assert gains[0] is None and [gain and round(gain.value, 9) for gain in gains[1:]] == [-1.0, None, 0.2]
    assert standing.line("Lost, tuned")["failed"] == "1 not run" and standing.line("B, tuned")["gain"] == gains[1]
    assert {line["name"] for line in _panel(standing, None)["series"]} == {"B", "Dist", "Lost"}
    assert {line["name"] for line in _panel(standing, "complete")["series"]} == {"B", "Dist, tuned", "Lost"}
    assert "tuned: complete of Dist." in "".join(_doubts(standing))
    assert "its line compares: Lost, tuned (1 not run)." in "".join(_doubts(standing))
    assert not any("fewer problems" in doubt for doubt in _doubts(before))


def test_a_tuned_setting_is_free_in_its_weights_and_rate_alone(tmp_path):
    found = {}
    for name, task in {
        "one": {"optimiser": {"learning_rate": 0.1, "budget": 9}, "silhouette_weight": 2.0},
        "two": {"optimiser": {"learning_rate": 0.2, "budget": 9}, "silhouette_weight": 3.0, "losses": {"eikonal": 1}},
        "more": {"optimiser": {"learning_rate": 0.1, "budget": 99}, "silhouette_weight": 2.0},
    }.items():
        for method in ("", "tuned/dist_mask"):
            own = {"task": {"points": "20"} | task, "label": "Mine, tuned" if method else None}
            write_completion(tmp_path / name / method, [0.8, 0.2], settings=own, method=method, renderer="dist")
            (found[name, method],) = attempts_of(read_records(tmp_path / name / method)[0], tmp_path / name / method)
    stated, tuned = (
        {name: one for (name, of), one in found.items() if of == method} for method in ("", "tuned/dist_mask")
    )
    assert len({one.settings for one in stated.values()}) == 3 and not stated["one"].tuned
    assert tuned["one"].settings == tuned["two"].settings != tuned["more"].settings
    assert (tuned["one"].row, tuned["one"].preset, tuned["one"].tuned) == ("Mine, tuned", "dist", True)


def test_tuned_settings_are_a_sweep_each_and_sets_without_one_are_left_out(capsys):
    own, passed = parsed(["setting=tuned", "renderer=newton,mesh_proxy_48", "set=pose,reconstruct,complete", "seed=0"])
    found = _sweeps(own, passed)
    assert [said for said, _ in found] == [
        "set 2 of 3: reconstruct, tuned/rgb_newton",
        "set 3 of 3: complete, tuned/newton_mask",
    ]
    assert {"silhouette=cross_entropy_sharp", "+method=tuned/rgb_newton", "seed=0"} < {*found[0][1]}
    assert "silhouette=own" in found[1][1] and not any(key.startswith("renderer=") for key in found[1][1])
    assert capsys.readouterr().out == "set 1 of 3: pose: left out, since conf/tuned.yaml has no setting for it\n"
    assert [said for said, _ in _sweeps(*parsed(["set=pose,render"]))] == ["set 1 of 2: pose", "set 2 of 2: render"]
    assert main(["setting=tuned", "renderer=mesh_proxy_48"]) == 2
    assert "no setting of mesh_proxy_48 for complete," in capsys.readouterr().err


MINE = '''
import time
from tests.user_renderer import Mine as Exact

class Shifted(Exact):
    """Source: none. Differentiable in: field and rays. Needs: a distance. Deviates from the paper: its hits are off."""
    def render(self, field, rays):
        found = super().render(field, rays)
        points = found.points + 0.01 * rays.directions
        return type(found)(found.distance + 0.01, found.status, points, found.residual, found.closest)

class Slow(Exact):
    """Source: none. Differentiable in: field and rays. Needs: a distance. Deviates from the paper: it sleeps."""
    def render(self, field, rays):
        time.sleep(0.05)
        return super().render(field, rays)
'''


@pytest.mark.slow
def test_a_shifted_renderer_reaches_less_and_one_that_sleeps_takes_longer(tmp_path, monkeypatch):
    (tmp_path / "odd.py").write_text(MINE)
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}:{Path.cwd()}")
    results = tmp_path / "results"
    asked = ["set=complete", "task.points=dense", "index=0,1", "dataset=sofa,plane", f"results_dir={results}"]
    own = {"Exact": "tests.user_renderer.Mine", "Shifted": "odd.Shifted", "Slow": "odd.Slow"}
    for label, target in own.items():
        assert main([*asked, "renderer=custom", f"renderer._target_={target}", f"label={label}"]) == 0
    standing = Standing(read_attempts(results)[0])
    assert standing.share("Shifted").value < standing.share("Exact").value == standing.share("Slow").value
    spent = {row: [(one.cost, one.seconds) for one in standing.of(row)] for row in standing.rows}
    assert [cost for cost, _ in spent["Slow"]] == [cost for cost, _ in spent["Exact"]]
    assert all(slow > 5 + exact / 2 for (_, slow), (_, exact) in zip(spent["Slow"], spent["Exact"], strict=True))
    assert main(["verify=1", f"results_dir={results}"]) == 0
    halves = [
        (one, [[*spent, float(f"{error / 2:.5g}")] for *spent, error in one.curve]) for one in read_attempts(results)[0]
    ]
    kept = [replace(one, final=curve[-1][2], curve=curve) for one, curve in halves]
    for path in place(results).iterdir():
        path.unlink()
    write_attempts(kept, results)
    assert main(["verify=1", f"results_dir={results}"]) == 1


def test_the_shipped_page_is_that_of_the_shipped_rows():
    standing = Standing(read_attempts(SHIPPED)[0])
    with (SHIPPED / "paper" / "suite.csv").open(encoding="utf-8") as file:
        shown = {line["row"]: float(line["share"]) for line in csv.DictReader(file)}
    assert {row: standing.share(row).value for row in standing.rows} == pytest.approx(shown)


def test_the_shipped_rows_are_of_todays_settings():
    """Else a fresh run would stand beside none of them: a new key of a task or a prior changes every hash."""
    each = {(one.set, one.tuned): one for one in read_attempts(SHIPPED)[0]}
    for (of_set, tuned), one in each.items():
        config = OmegaConf.to_container(composed(*one.overrides), resolve=True, throw_on_missing=False)
        assert one.settings == attempts.settings_of(config, of_set, tuned), of_set
    assert len(each) > 5
