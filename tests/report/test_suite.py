"""The suite: what an attempt has reached and when, how rows stand, and that results outlive their run folders."""

from collections import Counter
from dataclasses import replace
from itertools import permutations
from math import inf
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from bench import merge
from bench.records.read import read_records
from bench.records.record import TOO_EXPENSIVE
from bench.report.data.flips import p_values, signs
from bench.report.data.runs import Runs
from bench.report.data.statistics import holm
from bench.report.suite import attempts, standing
from bench.report.suite.attempts import (
    Attempt,
    Gathered,
    attempts_folder,
    attempts_of,
    gather,
    newest_attempts,
    read_attempts,
    suite,
    write_attempts,
)
from bench.report.suite.bias import bias_lines, bias_notes, depth_biases
from bench.report.suite.standing import (
    ALPHA,
    MAX_LEVEL,
    Ranking,
    Standing,
    bounds,
    compared,
    frame_of,
    progress_curve,
    ranking,
    seconds_per_unit,
    simulated_level,
    verified_ranking,
    with_progress,
)
from bench.report.suite.tuned import CANDIDATES, setting_overrides, stated_rate
from bench.report.suite.verdicts import leaders, row_alone
from bench.report.write import chart
from bench.studies import suite as study
from bench.studies import suite_tuned
from bench.suite import _expected_runtime, _sweeps, main, parse_arguments, print_standing
from bench.tables import choice
from tests.looped import each
from tests.report.test_report_paper import write_lines, write_run

DIST = choice("renderer", "dist")["_label_"]
SHIPPED = Path(__file__).resolve().parents[2] / "results"
SCENES = tuple(f"{family} test {index}" for family in ("vase", "lamp") for index in range(4))  # not among references


TEN = tuple(f"vase test {index}" for index in range(10))


def attempt(row: str, scene: str, errors: dict[float, float], **changed) -> Attempt:
    """One whose curve has these errors by cost, the first the start and the last the end; a second is 1000 values.

    Its budget is 1 unit, whatever its cost.
    """
    curve = [[cost, cost / 1000, error] for cost, error in errors.items()]
    known = {
        **{"set": "complete", "problem": f"{scene}, 20 points", "scene": scene, "budget": 1.0, "row": row},
        **{"preset": row.lower(), "status": "ok", "reason": "", "start": curve[0][2], "final": curve[-1][2]},
        **{
            "iterations": 40,
            "rays": 64,
            "cost": curve[-1][0],
            "operations": None,
            "seconds": 1.0,
            "waited": None,
            "cpu": "one",
            "device": "cpu",
        },
        **{"threads": 1, "kernels": "torch", "started": "2026-01-01T00:00:00+00:00", "commit": "", "code": "a"},
        **{"settings": "", "curve": curve, "overrides": ["+experiment=core_complete", "task.points=20"]},
    }
    return Attempt(**(known | changed))


def made(of: list[tuple[str, float, float]], scenes=SCENES) -> list[Attempt]:
    """Attempts of rows with their final error and what they pay for each of two steps, on all scenes."""
    return [
        attempt(row, scene, {0: 1.0, pay: max(final, 0.1), 2 * pay: final})
        for row, final, pay in of
        for scene in scenes
    ]


def judged(attempts: list[Attempt]) -> pd.DataFrame:
    """The compared attempts with their progress."""
    return with_progress(compared(frame_of(attempts)[0]))


def standing_of(attempts: list[Attempt]) -> Ranking:
    runs = judged(attempts)
    return ranking(runs[runs["complete"]])


def progress(attempts: list[Attempt]) -> dict[str, float]:
    return standing_of(attempts).progress


def write_completion(results: Path, errors: list[float], **changed) -> Path:
    """A run of the suite whose line n has these errors and n + 1 thousand values; the last error is that of its end."""
    settings = {
        "split": "test",
        "task": {"points": "20", "optimiser": {"ends": "budget", "budget": 4e5}},
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


def test_rows_are_compared_at_the_problems_that_all_whole_rows_have(monkeypatch):
    least = {("complete", f"{scene}, 20 points", 1.0) for scene in SCENES[:6]}
    monkeypatch.setattr("bench.report.suite.standing.problems_of", lambda _: least)
    whole = made([("Dist", 0.011, 100.0), ("B", 0.01, 100.0), ("Mine", 0.01, 100.0), ("Part", 0.01, 1.0)])
    some = [one for one in whole if one.row != "Mine" or one.key[:3] in least]
    runs = judged([one for one in some if one.row != "Part" or one.scene == SCENES[0]])
    assert {*runs["scene"]} == {*SCENES[:6]} and {*runs.loc[runs["complete"], "row"]} == {"B", "Dist", "Mine"}
    assert {*runs.loc[runs["row"] == "Part", "missing"]} == {5}
    assert {*judged(made([("Dist", 0.011, 100.0), ("B", 0.01, 100.0)]))["scene"]} == {*SCENES}


def test_each_set_weighs_the_same_and_a_run_under_other_settings_is_not_compared():
    many = [attempt("Dist", scene, {0: 1.0, 10: 0.01}) for scene in SCENES]
    lost = attempt("Dist", "s", {0: 90.0, 10: 90.0}, status="diverged", final=inf, set="pose", problem="s, 20 degrees")
    assert progress([*many, lost]) == {"Dist": 0.5}
    other = replace(many[0], row="Other", settings="x")
    assert {*judged([*many, other])["row"]} == {"Dist"}
    newer = replace(many[0], settings="x", started="2027-01-01T00:00:00+00:00", status="oom", final=inf)
    assert progress([*many, newer]) == {"Dist": 1.0}


def test_a_failed_run_has_made_no_progress_and_moves_no_initial_error():
    whole = made([("Dist", 0.01, 100.0), ("B", 0.02, 100.0)])
    lost = [
        replace(one, row=row, start=50.0, final=inf, status="crashed", curve=[])
        for row in ("Lost", "Gone", "Dead")
        for one in whole[: len(SCENES)]
    ]
    runs = judged([*whole, *lost])
    assert progress([*whole, *lost])["Lost"] == 0 and {*runs["initial"]} == {1.0}
    assert {*runs.loc[runs["row"] == "Lost", "progress"]} == {0.0}
    unknown = replace(whole[0], start=inf, final=inf, status="crashed", curve=[[0.0, 0.0, inf]])
    assert judged([unknown]).empty


def test_the_stated_references_are_used_where_there_are_any():
    scene, error = next(iter(suite().references["complete"].items()))
    assert judged([attempt("A", scene, {0: 1.0, 1: 0.9})])["reference"].tolist() == [error]
    assert judged([attempt("A", "s", {0: 1.0, 1: 0.9})])["reference"].tolist() == [0.9]
    assert all(0 < error < 0.1 for error in suite().references["complete"].values())


def test_the_chance_of_a_difference_is_that_of_flipped_signs_over_scenes():
    assert p_values(np.array([[1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0]])).tolist() == [0.25, 1.0, 1.0]
    assert signs(3).shape == (4, 3) and signs(40).shape == (2**15, 40) and (signs(40)[0] == 1).all()
    assert p_values(np.ones((40, 1))) == 1 / 2**15  # of random signs the first are those of the data
    assert holm(np.array([0.04, 0.01, 0.02])).tolist() == [True, True, True]
    assert holm(np.array([0.04, 0.02, 0.02])).tolist() == [False, False, False]  # 0.05 / 3 is less than 0.02


def test_rows_differ_by_the_correction_over_all_pairs_not_over_the_others_of_a_row():
    """Of 11 rows one is worse everywhere: p is 2 / 2**10 with 10 scenes, between 2 % of 10 rows and of 55 pairs."""
    rows = [("Dist", 0.01, 100.0), *((f"B{n}", 0.01, 100.0) for n in range(9)), ("Lost", 0.5, 100.0)]
    ten, twelve = (ranking(judged(made(rows, [f"{n}" for n in range(scenes)]))) for scenes in (10, 13))
    assert ALPHA / 55 < 2 / 2**10 < ALPHA / 10 and ten.better == set() and not ten.decidable
    assert twelve.better == {(row, "Lost") for row, *_ in rows[:-1]} and twelve.decidable
    assert twelve.rank("Lost") == "11" and twelve.rank("Dist") == "1–10"


def test_bounds_hold_the_ratios_that_flipped_signs_do_not_reject():
    scenes = [f"{n}" for n in range(10)]
    noise = np.random.default_rng(0).normal(0, 0.05, 10)
    b = [attempt("B", scene, {0: 1.0, 9: 0.2 * np.exp(shift)}) for scene, shift in zip(scenes, noise, strict=True)]
    dist = [attempt("Dist", scene, {0: 1.0, 9: 0.1}) for scene in scenes]
    low, high = bounds(judged([*dist, *b]))
    assert low < 2 * np.exp(noise.mean()) < high
    for end, inside in ((low, 1.001), (high, 0.999)):
        values = np.log(2) + noise
        assert (
            p_values((values - np.log(end * inside))[:, None])
            > ALPHA
            >= p_values((values - np.log(end / inside))[:, None])
        )
    assert bounds(judged([*dist[:5], *b[:5]])) is None  # 2 / 2**5 is more than 5 %
    failed = [replace(one, row="Lost", status="nan", final=inf) for one in b]
    assert bounds(judged([*dist, *b, *failed])) == (low, high)
    assert bounds(judged(dist)) is None
    assert bounds(judged(b)) is None  # without DIST


def test_a_number_that_is_none_is_not_reached_and_a_changed_renderer_has_another_name(tmp_path):
    asked = {"overrides": ["+experiment=core_complete", "renderer=newton", "renderer.steps=9", "task.points=20"]}
    write_completion(tmp_path, [0.8, 0.4, 0.2], **asked)
    line = '{"iteration": 1, "seconds": 2.0, "cost": 2000.0, "total": NaN, "chamfer_l1": NaN}'
    curve = next(tmp_path.glob("runs/*/curve.jsonl"))
    curve.write_text(curve.read_text().splitlines()[0] + "\n" + line + "\n")
    write_attempts(attempts_of(read_records(tmp_path)[0], tmp_path), tmp_path)
    ((found,), problems) = read_attempts(tmp_path)
    assert problems == [] and found.row == "Mine, steps=9" and [error for *_, error in found.curve] == [0.8, inf, 0.2]


def page(attempts: list[Attempt], folder: Path, monkeypatch) -> Standing:
    """What the pages are made of, if these attempts are shipped and there are no others."""
    write_attempts(attempts, folder / "shipped")
    monkeypatch.setattr("bench.report.write.paper.SHIPPED", folder / "shipped")
    return Standing(gather(folder / "shipped", folder / "none"))


def test_problems_that_the_reference_row_lacks_are_not_compared():
    whole = made([("Dist", 0.011, 100.0), ("B", 0.01, 100.0)])
    of_b = next(one for one in whole if one.row == "B")
    assert len(judged([*whole, replace(of_b, problem="another", scene="another")])) == len(whole)
    tweaked = [replace(one, row="A tweak") for one in whole if one.row == "Dist"]
    named = [replace(one, row=DIST) if one.row == "Dist" else one for one in whole]
    assert standing.dist_row(frame_of([*tweaked, *named])[0]) == DIST


@each(
    "better, said",
    [
        (
            "AC AD BC BD",
            "A (*90 %*) and B (*80 %*) make significantly more progress than 2 others.",
        ),
        ("AB AC AD", "A (*90 %*) makes significantly more progress than 3 others."),
        ("AC AD BD", "A (*90 %*) makes significantly more progress than all but B."),
        ("AD BD", "A (*90 %*) makes the most progress, significantly more than 1 other: D."),
        ("", "A (*90 %*) makes the most progress, and cannot be distinguished from any other."),
    ],
)
def test_the_answer_names_who_leads_by_a_rule(better, said):
    pairs = {tuple(pair) for pair in better.split()}
    ranked = Ranking(dict(zip("ABCD", (0.9, 0.8, 0.7, 0.6), strict=True)), pairs, 6, 0.01, 16)
    assert leaders(ranked, "Here").removeprefix("Here, ").startswith(said)


def test_kept_attempts_are_read_as_they_were_and_joined_in_any_order(tmp_path):
    good = attempt("A b", "s", {0: 1.0, 5: 0.5}, reason='said "no", twice', started="2026-01-02T00:00:00+00:00")
    failed = replace(
        good, status="oom", final=inf, curve=[[0.0, 0.0, 1.0], [5.0, 0.005, inf]], started="2026-01-03T00:00:00+00:00"
    )
    older = replace(good, started="2026-01-01T00:00:00+00:00")
    other = replace(good, row="A-b")  # whose file has the same name
    for order in permutations([good, failed, older, other]):
        assert {one.key: one for one in newest_attempts(order)} == {good.key: failed, other.key: other}
    write_attempts([failed, other], tmp_path)
    assert {*map(repr, read_attempts(tmp_path)[0])} == {repr(failed), repr(other)}
    write_attempts([latest := replace(good, started="2026-01-04T00:00:00+00:00")], tmp_path)
    assert sorted(read_attempts(tmp_path)[0], key=lambda one: one.row) == [latest, other]
    assert [path.name for path in attempts_folder(tmp_path).iterdir()] == ["a_b.csv"]


def test_two_halves_merged_are_the_whole(tmp_path):
    whole = made([("Dist", 0.01, 100.0), ("B", 0.02, 50.0)])
    write_attempts(whole[:5], tmp_path / "one")
    write_attempts(whole[5:], tmp_path / "two")
    merge.merge([tmp_path / "one", tmp_path / "two"], tmp_path / "both")
    by_key = [
        sorted(newest_attempts(of), key=lambda one: one.key) for of in (read_attempts(tmp_path / "both")[0], whole)
    ]
    assert by_key[0] == by_key[1]


def test_a_file_that_cannot_be_read_is_told_and_others_are_kept(tmp_path):
    write_attempts([attempt("A", "s", {0: 1.0, 5: 0.5})], tmp_path)
    (attempts_folder(tmp_path) / "b.csv").write_text("set,problem\ncomplete,s\n")
    found, problems = read_attempts(tmp_path)
    assert len(found) == 1 and problems[0].startswith("b.csv")
    with pytest.raises(ValueError, match=r"b\.csv"):  # whose lines would be lost
        write_attempts(found, tmp_path)
    back = [[0.0, 0.0, 1.0], [5.0, 0.005, 0.6], [4.0, 0.006, 0.5], [5.0, 0.007, 0.5]]
    for wrong in ({"final": -1.0}, {"final": 0.4}, {"set": "none"}, {"status": "fine"}, {"curve": back}, {"curve": []}):
        write_attempts([replace(found[0], **wrong)], tmp_path / str(wrong))
        assert read_attempts(tmp_path / str(wrong))[0] == []


def test_rows_are_compared_at_the_least_size_where_one_of_ones_own_lacks_more(monkeypatch):
    sizes = {"smoke": SCENES[:1], "quick": SCENES[:4], "core": SCENES}
    keys = {size: {("complete", f"{scene}, 20 points", 1.0) for scene in scenes} for size, scenes in sizes.items()}
    monkeypatch.setattr("bench.report.suite.attempts.problems_of", keys.get)

    def size(*rows: tuple[str, int]) -> str:
        local = [one for row, count in rows for one in made([(row, 0.1, 1.0)], SCENES[:count])]
        return Gathered([], local, []).size

    assert size() == size(("A", 8)) == size(("A", 5)) == size(("A", 8), ("B, tuned", 1)) == "quick"
    assert size(("A", 8), ("B", 1)) == "quick" and size(("A", 3), ("B", 1)) == "smoke"


def test_more_problems_of_ones_own_and_of_dist_leave_the_shipped_rows_compared(monkeypatch):
    monkeypatch.setattr(standing, "problems_of", lambda _: {("complete", f"{SCENES[0]}, 20 points", 1.0)})
    whole = made([("Dist", 0.011, 100.0), ("Mine", 0.01, 100.0)]) + made([("Shipped", 0.02, 100.0)], SCENES[:6])
    runs = judged(whole)
    assert {*runs.loc[runs["complete"], "row"]} == {"Dist", "Mine", "Shipped"} and {*runs["scene"]} == {*SCENES[:6]}


def test_a_few_problems_of_ones_own_are_compared_with_shipped_rows_at_these_alone(tmp_path, monkeypatch, capsys):
    shipped, own = tmp_path / "shipped", tmp_path / "own"
    smoke = {("complete", "car test 0, 20 points", 1.0)}
    monkeypatch.setattr("bench.report.suite.attempts.problems_of", lambda size: smoke if size == "smoke" else {"none"})
    monkeypatch.setattr("bench.report.suite.standing.problems_of", lambda size: smoke if size == "smoke" else {"none"})
    write_completion(own, [0.8, 0.4, 0.05])
    (mine,) = attempts_of(read_records(own)[0], own)
    known = {0: 0.8, 500: 0.0125, 600: 0.0124}
    dist = [attempt("Dist", scene, known, settings=mine.settings) for scene in ("car test 0", "car test 1")]
    write_attempts(dist, shipped)
    monkeypatch.setattr("bench.report.write.paper.SHIPPED", shipped)
    assert print_standing(own) == 0
    said = capsys.readouterr().out
    assert "progress on the 1 problem that all rows have, of 2 problems with results" in said
    assert "Mine * " in said and "Dist *" not in said
    assert "Mine, complete, car test 0, 20 points: initial error 0.800, final error 0.0500; best " in said
    data = "".join(path.read_text() for path in (own / "page" / "data").rglob("*.js"))
    assert "Mine" in data and "Dist" in data  # the page, too, is of the table that was written
    table = (own / "paper" / "suite.md").read_text()
    assert "| Dist |" in table and "| Mine |" in table and "at 1 unit: 1 problem of 1 scene" in table
    assert "1 scene cannot decide between 2 renderers" in table
    assert "1 scene cannot decide between 2 renderers, whatever their results. suite=core has 24 scenes." in said
    assert [one.row for one in read_attempts(own)[0]] == ["Mine"]


@each(
    "argument, said",
    [("suite=large", "unknown suite 'large'"), ("setting=tunde", "did you mean tuned"),
     ("set=pose,poze", "did you mean pose"), ("--plan", "no KEY=VALUE"),
     ("task.optimiser.start_noise=1e-3", "a second start is"),
     ("budget=5", "unknown budget '5': it has 1, 10"), ("seed=1", "is stated by the suite"),
     ("task.optimiser.budget=5e5", "is stated by the suite"),
     ("scale=smoke", "is stated by the suite"), ("+dataset.radius=.5", "is stated by the suite"),
     ("models.size=free", "is stated by the suite")],
)  # fmt: skip
def test_a_wrong_argument_is_told(argument, said, capsys):
    assert main([argument]) == 2
    assert said in capsys.readouterr().err


def test_a_label_of_a_shipped_row_is_refused(tmp_path, monkeypatch):
    write_attempts([attempt("Newton", "s", {0: 1.0, 5: 0.5})], tmp_path)
    monkeypatch.setattr("bench.report.write.paper.SHIPPED", tmp_path)
    reasons = {"Newton": "is the name of a shipped row", "Mine, tuned": "ends in ', tuned'"}
    for label, reason in reasons.items():  # its runs would replace shipped ones, or would count as tuned
        with pytest.raises(ValueError, match=f"label={label} {reason}"):
            parse_arguments(["renderer=custom", f"label={label}"])


def test_what_is_not_its_own_is_passed_on():
    given = ["renderer=custom", "renderer._target_=a.B", "label=Mine", "dataset=sofa", "task.points=20"]
    own, passed = parse_arguments(["suite=core", *given])
    assert (own["suite"], own["budget"]) == ("core", "1,10") and passed == given


@each("given, budgets", [([], "4.0e+05"), (["budget=10"], "4.0e+06"), (["suite=core"], "4.0e+05,4.0e+06")])
def test_a_sweep_has_the_chosen_budgets_in_units_of_its_set(given, budgets):
    ((_, keys),) = _sweeps(*parse_arguments(["set=complete", *given]), Path())
    assert f"task.optimiser.budget={budgets}" in keys


def test_a_tuned_row_changes_no_comparison_and_has_lines_in_its_sets(tmp_path, monkeypatch):
    stated = made([("Dist", 0.011, 100.0), ("B", 0.01, 100.0)])
    tuned = [attempt("Dist, tuned", scene, {0: 1.0, 9: 0.005}, settings="own", preset="dist") for scene in SCENES[:7]]
    runs = judged([*stated, *tuned])
    assert standing_of([*stated, *tuned]) == standing_of(stated) and {*progress([*stated, *tuned])} == {"Dist", "B"}
    assert {*runs["reference"]} == {0.01}
    page([*stated, *tuned], tmp_path, monkeypatch)
    nothing = [None] * (len(study.READS) - 1)
    lines = study.make_sets(Runs(study.READS[0], tmp_path / "none", []), *nothing).lines
    assert [line["row"] for line in lines] == ["B", "Dist", "Dist, tuned"] and lines[2]["progress_1"] == 1
    assert [line["problems"] for line in lines] == [8, 8, 7]  # means over other problems are not compared


def test_each_renderer_has_the_candidate_that_is_best_on_validation_shapes(tmp_path, capsys):
    errors = {"Dist": [3, 2, 1, 4], "Newton": [1, 2, 3, 4], "Mine": [4, 3, 2, 1]}  # in the order of the candidates
    presets = {"Dist": "dist", "Newton": "newton", "Mine": "custom"}
    runs = [
        replace(
            attempt(row, scene, {0: 9.0, 9: factor * error}, preset=presets[row], settings=candidate), overrides=changes
        )
        for row, numbers in errors.items()
        for candidate, error in zip(suite().candidates, numbers, strict=True)
        for changes in [setting_overrides("complete", candidate)]
        for scene, factor in (("sofa validation 0", 1), ("sofa validation 1", 0.5))
    ]
    arguments = ["setting=tuned", "set=complete", "verbose=true"]
    with pytest.raises(ValueError, match="setting=candidates set=complete budget=1"):
        _sweeps(*parse_arguments([*arguments, "renderer=naive"]), tmp_path)
    write_attempts(runs, tmp_path, CANDIDATES)
    assert not read_attempts(tmp_path)[0]
    shared = ["+experiment=core_complete", "sizes.chosen=desk", "task.optimiser.budget=4.0e+05"]
    rate = f"task.optimiser.learning_rate={3 * stated_rate('complete'):.3g}"
    ((title, keys),) = _sweeps(*parse_arguments([*arguments, "renderer=dist,newton"]), tmp_path)
    label = "label='${renderer._label_}, tuned'"
    assert title.endswith("faster") and keys == [*shared, "renderer=dist", label, rate, "verbose=true"]
    assert "complete, newton: the set's setting is the best" in capsys.readouterr().out
    ((_, keys),) = _sweeps(*parse_arguments([*arguments, "renderer=custom", "label=Mine"]), tmp_path)
    assert {"renderer=custom", "label='Mine, tuned'", "+task.optimiser.afforded_iterations=160"} < {*keys}


def test_with_its_own_setting_each_renderer_is_compared_on_the_same_problems(tmp_path, monkeypatch):
    """B has a better setting than that of the set, and Dist has not; C has no candidates, Poor too few iterations."""
    stated = made([("Dist", 0.011, 100.0), ("B", 0.1, 100.0), ("C", 0.02, 100.0)], TEN)
    poor = {"status": "not_reached", "reason": TOO_EXPENSIVE, "final": inf}
    stated += [attempt("Poor", scene, {0: 1.0, 9: 1.0}, **poor) for scene in TEN]
    tuned = [
        replace(
            attempt(f"{row}, tuned", scene, {0: 1.0, 9: final}, settings=candidate, preset=row.lower()),
            overrides=setting_overrides("complete", candidate),
        )
        for row, candidate, final in (("B", "slower", 0.01), ("B", "faster", 0.9), ("Dist", "slower", 0.5))
        for scene in TEN
    ]
    candidates = [
        replace(attempt(row, "vase validation 0", {0: 9.0, 9: error}, settings=name), overrides=changes)
        for row, errors in {"Dist": [1, 2, 3, 4], "B": [2, 1, 3, 4], "Poor": [1, 2, 3, 4]}.items()
        for name, error in zip(suite().candidates, errors, strict=True)
        for changes in [setting_overrides("complete", name)]
    ]
    write_attempts(candidates, tmp_path / "shipped", CANDIDATES)
    page([*stated, *tuned], tmp_path, monkeypatch)
    nothing = [None] * (len(study.READS) - 1)
    result = suite_tuned.make(Runs(study.READS[0], tmp_path / "none", []), *nothing)
    assert [(line["row"], line["complete"]) for line in result.lines] == [("B", "slower"), ("Dist", "stated")]
    of_b, of_dist = ((line["stated"], line["own"]) for line in result.lines)
    assert of_b[0] < 0.6 < of_b[1] and min(of_dist) > 0.95  # without stated references, the best row decides
    assert result.figure is not None
    assert result.verdict.startswith("Spearman's correlation of both orders is *-1.00* (2 renderers).")
    assert "1 of complete" in " ".join(result.remarks)


def test_candidates_are_the_same_for_all_renderers_on_validation_shapes():
    sweeps = _sweeps(*parse_arguments(["set=pose,complete", "setting=candidates", "renderer=dist,idr"]), Path())
    assert len(sweeps) == 2 * len(suite().candidates)
    assert all({"split=validation", "renderer=dist,idr"} < {*keys} for _, keys in sweeps)
    assert stated_rate("pose") == 0.1 and stated_rate("complete") == 0.0215
    record = {"config": {"split": "validation", "experiment": "core_pose"}, "folder": "a", "status": "ok"}
    assert not attempts_of([record], Path())


def test_a_results_folder_that_cannot_be_made_ends_the_suite_before_its_first_set(tmp_path, capsys):
    (tmp_path / "file").write_text("")
    assert main([f"results_dir={tmp_path / 'file' / 'results'}", "suite=smoke"]) == 2
    out, err = capsys.readouterr()
    assert "set 1" not in out and "cannot be made" in err and "name a folder that you may write to" in err


MINE = '''
import time
from tests.user_renderer import Mine as Exact

class Shifted(Exact):
    """Source: none. Differentiable in: field and rays. Needs: a distance. Deviates from the paper: its hits are off."""
    shift = 0.003
    def render(self, field, rays):
        found = super().render(field, rays)
        points = found.points + self.shift * rays.directions
        return type(found)(found.distance + self.shift, found.status, points, found.residual, found.closest)

class Far(Shifted):
    """Source: none. Differentiable in: field and rays. Needs: a distance. Deviates from the paper: its hits are off."""
    shift = 0.03

class Slow(Exact):
    """Source: none. Differentiable in: field and rays. Needs: a distance. Deviates from the paper: it sleeps."""
    def render(self, field, rays):
        time.sleep(0.05)
        return super().render(field, rays)
'''


@pytest.mark.slow
def test_a_handicap_is_significant_and_a_twin_is_not_on_twelve_scenes(tmp_path, monkeypatch):
    """Hits that are off by 0.03 scene units, half a pixel, cost progress. An offset of 0.003 shows as depth bias."""
    (tmp_path / "odd.py").write_text(MINE)
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}:{Path.cwd()}")
    monkeypatch.syspath_prepend(tmp_path)  # the sweep is composed in this process
    results = tmp_path / "results"
    asked = ["set=complete", f"results_dir={results}"]
    own = {"Exact": "tests.user_renderer.Mine", "Shifted": "odd.Shifted", "Far": "odd.Far", "Slow": "odd.Slow"}
    for label, target in own.items():
        assert main([*asked, "renderer=custom", f"renderer._target_={target}", f"label={label}"]) == 0
    runs = judged(read_attempts(results)[0])
    pairs = {row: ranking(runs[runs["row"].isin(["Exact", row])]) for row in ("Far", "Slow")}
    assert pairs["Far"].better == {("Exact", "Far")} and pairs["Far"].scenes == 12
    biases = depth_biases(runs, "Exact").set_index("row")
    assert biases["significant"].to_dict() == {"Exact": False, "Far": True, "Shifted": True, "Slow": False}
    assert -0.0045 < biases.loc["Shifted", "difference"] < -0.0015 and biases.loc["Slow", "p"] == 1
    assert pairs["Slow"].better == set() and pairs["Slow"].least_p == 1
    spent = {row: own.sort_values("problem")[["cost", "seconds"]].to_numpy() for row, own in runs.groupby("row")}
    assert (spent["Slow"][:, 0] == spent["Exact"][:, 0]).all()
    assert (spent["Slow"][:, 1] > 2 + spent["Exact"][:, 1] / 2).all()


@pytest.fixture(scope="module")
def shipped_standing() -> Standing:
    return Standing(gather(SHIPPED, SHIPPED))


def test_the_shipped_page_is_that_of_the_shipped_rows(shipped_standing):
    shown = pd.read_csv(SHIPPED / "paper" / "suite.csv").set_index("row")
    assert shipped_standing.budgets
    for budget, ranked in shipped_standing.rankings.items():
        assert shown[f"{budget:g}"].dropna().to_dict() == pytest.approx(ranked.progress, rel=1e-9)
        assert {row: str(shown.loc[row, f"{budget:g}_rank"]).removesuffix(".0") for row in ranked.progress} == {
            row: ranked.rank(row) for row in ranked.progress
        }


@pytest.mark.slow
def test_equal_rows_differ_in_at_most_one_of_twenty_draws(shipped_standing):
    """The level of the shipped design at each budget: rows are centred in each set, and scenes are drawn anew."""
    decided = [budget for budget, ranked in shipped_standing.rankings.items() if ranked.decidable]
    complete = shipped_standing.complete
    assert decided
    for _, runs in complete[complete["budget"].isin(decided)].groupby("budget"):
        assert 0 < simulated_level(runs, draws=500) <= MAX_LEVEL


def test_a_row_alone_is_decided_on_fewer_scenes_than_all_pairs():
    """Twelve rows on twelve scenes: 66 pairs cannot have a significant one, 11 can. A copy of a row does not differ."""
    errors = {f"Row {number}": 0.01 * 1.2**number for number in range(10)} | {"Dist": 0.02, "Mine": 0.012}
    runs = judged(made([(row, error, 100.0) for row, error in errors.items()], [*TEN, "vase test 10", "vase test 11"]))
    assert not verified_ranking(runs).better
    alone = verified_ranking(runs, "Mine")
    assert alone.pairs == 11 and {row for pair in alone.better for row in pair} == {*errors} - {"Row 1"}
    text = row_alone(alone, "Mine", "At 1 unit")
    assert text.startswith("Mine at 1 unit: significantly more progress than Row 2, Row 3, Dist, Row 4, ")
    assert "less than Row 0; no significant difference from Row 1 (12 scenes, Holm's correction over 11" in text
    few = ranking(runs[runs["scene"].isin(TEN[:4])], "Mine")
    undecided = "At 1 unit, 4 scenes cannot decide between Mine and others, whatever their results."
    assert row_alone(few, "Mine", "At 1 unit") == undecided


def test_a_budget_at_which_equal_rows_often_differ_has_no_significant_pair():
    """Twelve scenes of which one decides: its sign is missing in a third of all draws."""
    progress = {"A": [0.5] * 12, "B": [0.49] * 11 + [0.6]}
    lines = [
        {"set": "complete", "row": row, "scene": f"car test {scene}", "progress": value}
        for row, values in progress.items()
        for scene, value in enumerate(values)
    ]
    skewed = pd.DataFrame(lines)
    assert simulated_level(skewed) > 0.2
    even = skewed.assign(progress=[0.5] * 12 + [0.4 + 0.01 * (-1) ** scene for scene in range(12)])
    assert simulated_level(even) <= MAX_LEVEL and verified_ranking(even).better == {("A", "B")}
    both = replace(ranking(even), level=simulated_level(skewed))
    assert not both.decidable


def test_progress_is_that_of_the_logarithm_between_the_initial_error_and_the_reference():
    """Of errors 100, 10, 1: none, half and all; outside of them it is limited."""
    runs = judged([attempt("Dist", "s", {0: 100, 2e5: 10, 4e5: 1}), attempt("B", "s", {0: 100, 4e5: 10})])
    assert runs.set_index("row")["progress"].to_dict() == pytest.approx({"Dist": 1, "B": 0.5})
    costs, progress_at = progress_curve(next(runs[runs["row"] == "Dist"].itertuples()))
    assert (costs.tolist(), progress_at.tolist()) == ([0, 0.5, 1], [0, 0.5, 1])  # in units of 4e5
    above = judged([attempt("Dist", "s", {0: 100, 4e5: 1}), attempt("B", "s", {0: 100, 4e5: 300})])
    assert above.set_index("row")["progress"].to_dict() == {"Dist": 1, "B": 0}
    exact = [attempt("Dist", scene, {0: 1.0, 5: 0.0}) for scene in SCENES]
    assert progress(exact) == {"Dist": 1.0}  # a reference of 0 has no logarithm


def test_each_budget_is_compared_apart():
    """A row that lacks problems at 10 units is compared at 1 unit."""
    unit = made([("Dist", 0.02, 100.0), ("B", 0.01, 100.0)])
    ten = [replace(one, budget=10.0, final=0.001) for one in unit if one.row == "Dist" or one.scene == SCENES[0]]
    ten = [replace(one, curve=[one.curve[0], [1.0, 1.0, 0.001]], cost=1.0) for one in ten]
    made_of = Standing(Gathered([*unit, *ten], [], []))
    assert made_of.budgets == [1.0, 10.0] and [*made_of.rankings[1.0].progress] == ["B", "Dist"]
    assert made_of.rankings[10.0].progress == {"Dist": 1.0} and made_of.lacking == {(10.0, "B"): 7}
    assert {*made_of.complete.loc[made_of.complete["budget"] == 1, "reference"]} == {0.01}


def test_the_runtime_of_a_unit_is_of_timed_runs_of_one_machine():
    runs = made([("Dist", 0.01, 100.0)])  # a cost of 200 in a second
    loaded = replace(runs[0], row="B", waited=0.3)
    elsewhere = replace(runs[0], row="C", cpu="another")
    known = seconds_per_unit(frame_of([*runs, *runs, loaded, elsewhere])[0])
    assert known.loc[("complete", "Dist")].to_dict() == {"seconds": 4e5 / 200, "timed": len(runs)} and len(known) == 1


def test_every_scene_has_every_set_and_amounts_rotate_over_the_scenes_of_a_family():
    problems = attempts.problems_of("core")
    assert len(problems) == 2 * 192 and {key[2] for key in problems} == {1, 10}
    scenes = Counter(text.split(",")[0] for _, text, budget in problems if budget == 1)
    assert len(scenes) == 24 and {*scenes.values()} == {8}
    sofas = Counter(text.split(", ")[1] for name, text, budget in problems if "sofa" in text and name == "complete")
    assert sofas == {"dense points": 4, "100 points": 4, "20 points": 4}
    assert {key[2] for key in attempts.problems_of("quick")} == {1} and len(attempts.problems_of("quick")) == 12 * 6
    assert attempts.problems_of("smoke") < attempts.problems_of("core")


def test_the_answer_says_what_differs_at_each_budget_what_failed_and_what_scenes_cannot_decide(tmp_path, monkeypatch):
    rows = [("Dist", 0.0101, 100.0), ("B", 0.01, 300.0)]
    lost = [attempt("Lost", scene, {0: 1.0, 50: 1.0}, status="diverged", final=inf) for scene in TEN]
    answer = study.verdict(page([*made(rows, TEN), *lost], tmp_path / "three", monkeypatch))
    assert answer.startswith("At 1 unit, B (*100 %*) makes significantly more progress than 2 others. 3 of 3 pairs")
    assert "Lost failed in complete at 1 unit (10 of 10); none of the 20 other runs failed." in answer
    few = [one for one in made(rows, TEN) if one.scene in TEN[:3]]
    said = study.verdict(page(few, tmp_path / "few", monkeypatch))
    assert said.startswith("At 1 unit, 3 scenes cannot decide ") and said.endswith("None of 6 runs failed.")


def test_a_budget_with_only_some_of_the_sets_names_them(tmp_path, monkeypatch):
    rows = [("Dist", 0.0101, 100.0), ("B", 0.01, 300.0)]
    runs = made(rows, TEN)
    others = [replace(run, set="pose") for run in runs]
    more = [replace(run, budget=10.0) for run in runs]
    shown = page([*runs, *others, *more], tmp_path / "both", monkeypatch)
    answer = study.verdict(shown)
    assert "At 1 unit, B" in answer and "At 10 units (complete), B" in answer
    caption = study._sample(shown)
    assert "at 1 unit: 20 problems of 10 scenes" in caption and "at 10 units (complete): 10 problems" in caption
    three = page([*runs, *others, *(replace(run, set="area") for run in runs), *more], tmp_path / "three", monkeypatch)
    assert study._when(three, 10.0) == "10 units (complete)" and study._when(three, 1.0) == "1 unit"
    most = page(
        [*runs, *others, *more, *(replace(run, set="area") for run in [*runs, *more])], tmp_path / "most", monkeypatch
    )
    assert study._when(most, 10.0) == "10 units (without pose)"
    half = [run for run in more if run.problem in sorted({run.problem for run in runs})[:5]]
    shown = page([*runs, *others, *half], tmp_path / "half", monkeypatch)
    fewer = [note for note in study._notes(shown) if note.startswith("At 10 units, complete has ")]
    assert fewer == ["At 10 units, complete has 5 of its 10 problems."]


def test_an_order_without_a_set_is_left_out_if_equal_rows_often_differ_in_it(tmp_path, monkeypatch):
    runs = made([("Dist", 0.5, 100.0), ("B", 0.01, 300.0)], TEN)
    shown = page([*runs, *(replace(run, set="pose") for run in runs)], tmp_path, monkeypatch)
    assert sum(note.startswith("Without the set") for note in study._notes(shown)) == 2
    monkeypatch.setattr("bench.report.suite.standing.simulated_level", lambda of_sets, row="": 0.2)
    assert not any(note.startswith("Without the set") for note in study._notes(shown))


def test_without_anything_to_compare_both_pages_are_empty(tmp_path, monkeypatch):
    page([], tmp_path, monkeypatch)
    runs = [None] * (len(study.READS) - 1)
    for make in (*study.PAGES.values(), suite_tuned.make):
        result = make(Runs(study.READS[0], tmp_path / "none", []), *runs)
        assert (result.verdict, len(result.lines)) == ("", 0)


def test_settings_are_one_at_all_budgets_and_tuned_ones_are_free_in_rate_and_rays_alone(tmp_path):
    found, loop = {}, {"ends": "budget", "budget": 4e5}
    for name, task in {
        "one": {"optimiser": {"learning_rate": 0.1, **loop}, "silhouette_weight": 2.0},
        "two": {"optimiser": {"learning_rate": 0.2, "afforded_iterations": 160, **loop}, "silhouette_weight": 2.0},
        "more": {"optimiser": {"learning_rate": 0.1, **loop, "budget": 4e6}, "silhouette_weight": 2.0},
        "code": {"optimiser": {"learning_rate": 0.1, **loop}, "silhouette_weight": 2.0, "depth_weight": 9},
    }.items():
        for label in ("Mine", "Mine, tuned"):
            own, folder = {"task": {"points": "20"} | task, "label": label}, tmp_path / name / label
            write_completion(folder, [0.8, 0.2], settings=own, renderer="dist")
            (found[name, label],) = attempts_of(read_records(folder)[0], folder)
    stated, tuned = (
        {name: one for (name, of), one in found.items() if of == label} for label in ("Mine", "Mine, tuned")
    )
    assert len({one.settings for one in stated.values()}) == 3 and not stated["one"].tuned
    assert stated["one"].settings == stated["more"].settings and stated["more"].budget == 10
    assert tuned["one"].settings == tuned["two"].settings == tuned["more"].settings != tuned["code"].settings
    assert (tuned["one"].row, tuned["one"].preset, tuned["one"].tuned) == ("Mine, tuned", "dist", True)


def test_a_row_that_its_budget_pays_too_few_iterations_for_cannot_run_and_is_not_compared(tmp_path, monkeypatch):
    reason = f"{TOO_EXPENSIVE} 4 iterations, fewer than 10: set task.optimiser.budget=1e6 or more"
    dear = [
        attempt("Mesh", scene, {0: 1.0, 9: 1.0}, status="not_reached", final=inf, reason=reason) for scene in SCENES
    ]
    rows = made([("Dist", 0.011, 100.0), ("B", 0.01, 100.0)])
    made_of = page([*rows, *dear], tmp_path, monkeypatch)
    assert made_of.cannot_run == {(1.0, "Mesh"): "complete"} and made_of.lacking == {}
    assert made_of.rankings == Standing(Gathered(rows, [], [])).rankings and made_of.rows == ["B", "Dist", "Mesh"]
    result = study.make(Runs(study.READS[0], tmp_path / "none", []), *[None] * (len(study.READS) - 1))
    assert dict(zip(result.table["Renderer"], result.table["At 1 unit"], strict=True))["Mesh"] == "cannot run"
    assert "At 1 unit, Mesh cannot run in complete." in result.notes
    some = [replace(one, reason="", status="diverged") if n % 2 else one for n, one in enumerate(dear)]
    assert page([*rows, *some], tmp_path / "some", monkeypatch).cannot_run == {}


def test_rows_with_other_settings_are_named(tmp_path, monkeypatch):
    rows = made([("Dist", 0.011, 100.0), ("B", 0.01, 100.0)])
    other = [replace(one, row="Mine", settings="x") for one in rows[:3]]
    assert page([*rows, *other], tmp_path, monkeypatch).other_settings == {"Mine": 3}


def test_a_class_of_ones_own_with_the_name_of_a_shipped_row_is_another_row(tmp_path):
    write_attempts([attempt("Newton", "s", {0: 1.0, 5: 0.5})], tmp_path / "shipped")
    write_attempts([attempt("Newton", "s", {0: 1.0, 5: 0.4}, preset="custom")], tmp_path / "own")
    gathered = gather(tmp_path / "shipped", tmp_path / "own")
    assert [one.row for one in gathered.everything] == ["Newton", "Newton, yours"]


def test_every_problem_has_a_reference_that_no_renderer_wrote():
    for name, problem, _ in attempts.problems_of("core"):
        assert standing._reference(name, problem.split(",")[0]) > 0


def test_a_failed_run_has_the_cost_of_its_loop(tmp_path):
    write_completion(tmp_path, [0.8, 0.4, 0.2], status="diverged", reason="the loss rose")
    (found,) = attempts_of(read_records(tmp_path)[0], tmp_path)
    assert (found.final, found.cost, found.curve[-1][0]) == (inf, 2000, 1000)


def test_the_expected_runtime_is_that_of_the_shipped_rows_at_the_budgets_of_the_size(tmp_path, monkeypatch):
    write_attempts([replace(one, set=name) for name in suite().errors for one in made([("A", 0.1, 9.0)])], tmp_path)
    monkeypatch.setattr("bench.report.write.paper.SHIPPED", tmp_path)
    write_attempts([replace(one, set="pose") for one in made([("B", 0.1, 9.0)])], tmp_path)
    quick = _expected_runtime(
        {"suite": "quick", "set": "pose,complete", "budget": "1"}, []
    )  # 36 runs of 1 unit, of a second each
    assert quick == "36 runs of each renderer; the shipped ones need about 108 s (A) of one processor"
    assert "72.0 s (B) of" in _expected_runtime({"suite": "quick", "set": "pose", "budget": "1"}, ["b"])
    seconds = 192 * (2 + 1) + 192 * (2 + 10)
    assert f"{seconds / 60:.1f} min (A)" in _expected_runtime(
        {"suite": "core", "set": ",".join(suite().errors), "budget": "1,10"}, ["new"]
    )


def test_a_depth_bias_that_is_equal_over_scenes_is_significant_and_scatter_is_not():
    """Each row relative to DIST's; runs without a bias, as those of pose, are left out."""
    biases = {"Dist": [0.0] * 10, "Near": [-0.003, -0.002] * 5, "Wide": [0.1, -0.01] * 5, "Twin": [0.0] * 10}
    runs = [
        replace(attempt(row, scene, {0: 1.0, 4e5: 0.1}), depth_bias=values[index])
        for row, values in biases.items()
        for index, scene in enumerate(TEN)
    ]
    frame = judged([*runs, *(replace(run, set="pose", depth_bias=None) for run in runs)])
    lines = depth_biases(frame).set_index("row")
    assert lines["significant"].to_dict() == {"Dist": False, "Near": True, "Twin": False, "Wide": False}
    assert lines.loc["Near", "difference"] == pytest.approx(-0.0025) and {*lines["set"]} == {"complete"}
    (note,) = bias_notes(lines.reset_index())
    assert "in front of its surfaces are those of Near (2.50)" in note and "2 rows cannot be disting" in note
    (line,) = bias_lines(frame, "Near")
    assert "0.00250 scene units in front of those of Dist (median of 10 scenes, sign test, p = 0.00195, sig" in line
    assert not [*bias_lines(frame, "Dist")]
    assert depth_biases(frame[frame["set"] == "pose"]).empty


def test_a_file_of_attempts_without_a_depth_bias_is_read(tmp_path):
    (path,) = write_attempts([attempt("Dist", "a", {0: 1.0, 9: 0.5})], tmp_path)
    table = pd.read_csv(path, dtype=str, keep_default_na=False).drop(columns="depth_bias")
    table.to_csv(path, index=False)
    ((read,), problems) = read_attempts(tmp_path)
    assert read.depth_bias is None and not problems


def test_a_second_start_shows_the_spread_and_changes_no_comparison(tmp_path):
    for name, noise, final in (("first", 0.0, 0.1), ("second", 1e-6, 0.2)):
        own = {"task": {"points": "20", "optimiser": {"ends": "budget", "budget": 4e5, "start_noise": noise}}}
        write_completion(tmp_path / name, [1.0, final], settings=own)
    runs = [
        one for name in ("first", "second") for one in attempts_of(read_records(tmp_path / name)[0], tmp_path / name)
    ]
    assert runs[0].settings == runs[1].settings and len(newest_attempts(runs)) == 2
    write_attempts(runs, tmp_path)
    gathered = gather(tmp_path / "nothing", tmp_path)
    assert gathered.everything == gathered.local == runs[:1]
    assert gathered.second_starts == [replace(runs[1], row=runs[0].row)]
    first, second = (replace(one, scene=SCENES[0]) for one in (*gathered.everything, *gathered.second_starts))
    best = attempt("Dist", SCENES[0], {0: 1.0, 9: 0.01}, problem=first.problem, settings=first.settings)
    made = Standing(Gathered([first, best], [], [], [second]))
    (run,) = made.second_starts.itertuples()
    assert (run.first, run.progress) == (pytest.approx(0.5), pytest.approx(-np.log10(0.2) / 2))
    assert "100 % of them differs by more than 5 points, and the median difference is 15.1" in study._second_starts(
        made, 1.0
    )


def test_a_figure_names_its_axes_and_shows_the_style_of_each_line():
    lines = [chart.curve(name, "", [1, 2], [0.1, 0.2], dash=dash) for name, dash in (("A, 1", ":"), ("B", "--"))]
    figure = study.draw([chart.panel_data(title, "cost", "progress", lines) for title in "ab"], {"1 unit": {"B": "1"}})
    progress, names, *_ = figure.axes
    assert [axis.get_ylabel() for axis in (progress, figure.axes[-1])] == ["progress", "progress"]
    assert [text.get_text() for text in names.get_yticklabels()] == ["A", "B"]
    assert [line.get_linestyle() for line in names.lines] == [":", "--"]
