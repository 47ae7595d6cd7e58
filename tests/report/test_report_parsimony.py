"""How much model each scene needs as tables and figures, made from run folders whose numbers are known."""

import pytest

from bench.report.write.result import latex
from bench.studies import parsimony
from tests.report.test_report_paper import page_of, told, write_run

NETWORK, PAPERS = "network_8x512", 1_839_614  # the papers' network, and its numbers
SIZES = {"sphere": 4, "box": 9, "union_3": 30, "grid_24": 3000, NETWORK: PAPERS}  # free numbers
STORED = SIZES | {"grid_24": 13_824}
COSTS = {"seconds": 2.0, "evaluations": 1000, "flops": 1_000_000}
VIEWS = {"fitted": 12, "held_out": 8, "share": 0.1}
CONFIG = {"task": {"checks": {"seeds": 20, "drawn": 8}}, "models": {"views": VIEWS, "fit": {"iterations": 100}}}


def climbed(results, scene, errors, *, needs, failed=(), status="ok", pixels=None, rounds=None, **metrics) -> None:
    """A run whose candidates have these errors in half pixels of 0.02."""
    known = {"footprint": 0.02, "chamfer_l2": 0.001, "held_out_seeds": 20, "held_out_seeds_within": 0.6}
    known |= {"held_out_seeds_held": 0.95, "recommended_within": 0, "recommended_enough": 1}
    for name, error in errors.items():
        spent = {"free": SIZES[name], "stored": STORED[name], "bytes": 4 * STORED[name], **COSTS}
        spent |= {"flops_per_query": 2 * SIZES[name]}
        spent |= {"failed": "nan: why"} if name in failed else {"error": 0.02 * error, "standard_error": 0.001}
        known |= {f"{name}.{key}": value for key, value in spent.items()}
    best = min((name for name in errors if name not in failed), key=lambda name: errors[name])
    known |= {"recommended_field": needs, "best_field": best, "recommended_by": "stored"}
    known |= {f"recommended_{size}": known[f"{needs}.{size}"] for size in ("free", "stored", "bytes")}
    known |= {"recommended_error": known[f"{needs}.error"], "saved_free": PAPERS / SIZES[needs]}
    known |= {"saved_stored": PAPERS / STORED[needs], "saved_bytes": PAPERS / STORED[needs]}
    known |= {"auto.field": needs, "auto.stored": STORED[needs], "auto.error": 0.02, "auto.standard_error": 0.001}
    known |= {"auto.seconds": 4.0, "auto.evaluations": 500, "auto.flops": 100_000, "auto.overhead": 1.5}
    known |= {"frugal.stored": STORED[needs], "frugal.error": 0.03, "frugal.evaluations": 250}
    known |= {"frugal.seconds": 1.0} | metrics
    known = {name: value for name, value in known.items() if value is not ...}
    changed = {"status": status, "reason": "" if status == "ok" else "why", "metrics": known if status == "ok" else {}}
    settings = CONFIG if rounds is None else {**CONFIG, "task": {**CONFIG["task"], "rounds": rounds}}
    settings = settings if pixels is None else {**settings, "view": {"resolution": pixels}}
    identity = {"task": "capacity", "dataset": scene, "scene": f"{scene} test 0", "settings": settings}
    write_run(results, "parsimony", None, **identity, **changed)


@pytest.fixture(scope="module")
def four(tmp_path_factory):
    """Scenes of three needs, and one that crashed, in no order."""
    tmp_path = tmp_path_factory.mktemp("four")
    climbed(tmp_path, "car", {"sphere": 8, "union_3": 2, "grid_24": 0.9}, needs="grid_24")
    climbed(tmp_path, "torus", {"sphere": 9, "box": 5}, needs="box", status="crashed")
    climbed(tmp_path, "box", {"sphere": 7, "box": 0.5, "grid_24": 0.2}, needs="box")
    climbed(tmp_path, "ball", {"sphere": 0.01, "box": 5, "grid_24": 0.2}, needs="sphere", recommended_within=1)
    return tmp_path


@pytest.fixture(scope="module")
def page(four):
    """Made once: tests of the same runs only look at it."""
    return page_of(four, "parsimony")


def test_a_row_a_scene_the_least_need_first_and_a_failed_run_last(page):
    assert list(page.table["Scene"]) == ["ball 0", "box 0", "car 0", "torus 0"]
    empty = list(page.table.iloc[3])[2:]
    assert set(empty) == {"crashed", "–"} and len(empty) == len(page.table.columns) - 2
    lost = page.data[page.data["scene"] == "torus 0"]
    assert (lost["status"].item(), lost["reason"].item()) == ("crashed", "why")
    assert "1 of 4 runs did not end ok: dist, 64 resolution, torus: crashed (why)." in told(page)
    assert page.verdict.startswith("*4 to ") and " in 3 scenes. " in page.verdict and "all three in *2*" in page.verdict


def test_a_row_has_a_choice_by_each_quantity(page):
    table = page.table.set_index("Scene")
    cells, headings = table.loc["box 0"], [choice[2] for choice in parsimony.CHOICES.values()]
    shown = [cells[next(name for name in table if name.startswith(f"F{heading[1:]}"))] for heading in headings]
    assert shown == ["box: 9 numbers, 10.0", "box: 18 FLOPs, 10.0", "grid 24, unchecked: 13,824 numbers, 4.00"]
    best = "grid 24: 13,824 numbers, 4.00 ± 1.00"
    assert (cells["Half a pixel (scene units × 1000)"], cells["Least error × 1000"]) == ("20.0", best)
    assert r"4.00 $\pm$ 1.00" in latex(page.shown(), "parsimony")


@pytest.mark.parametrize(("held", "choice"), [
    ({"box.held_enough": 0.5, "union_3.held_enough": 0.85}, "union 3: 30 numbers, 16.0"),
    ({"box.held_enough": 0.5, "union_3.held_enough": 0.5, "grid_24.held_enough": 0.5}, "none passes further views"),
    ({"held_out_seeds_held": 0.25}, "none passes further views"),  # only the recommended candidate has a check
])  # fmt: skip
def test_a_choice_that_further_views_do_not_confirm_is_not_made(tmp_path, held, choice):
    climbed(tmp_path, "car", {"sphere": 8, "box": 0.9, "union_3": 0.8, "grid_24": 0.2}, needs="box", **held)
    assert page_of(tmp_path, "parsimony").table.filter(like="Fewest numbers under").iloc[0].item() == choice


def test_resolutions_are_lines_of_a_scene_and_fronts_of_its_panel(tmp_path):
    for pixels, errors in ((96, {"sphere": 8, "box": 1.5}), (48, {"sphere": 8, "box": 0.7})):
        climbed(tmp_path, "car", errors, needs="box", pixels=pixels)
    page = page_of(tmp_path, "parsimony")
    assert list(page.table["Pixels"]) == ["48", "96"] and len(page.chart["panels"]) == 1
    fronts = [each["name"] for each in page.chart["panels"][0]["series"] if each.get("step")]
    assert fronts == ["front of error and FLOPs", "front of error and FLOPs at 48 pixels"]
    assert page.chart["panels"][0]["title"].endswith(", 96 pixels")
    assert page.verdict.count("scenes and resolutions") == 1


def test_of_a_scene_with_other_rounds_the_newest_run_is_shown_and_other_scenes_stay(tmp_path):
    climbed(tmp_path, "ball", {"sphere": 0.01, "box": 5}, needs="sphere", rounds=4)
    climbed(tmp_path, "car", {"sphere": 8, "box": 0.9}, needs="box", rounds=4)
    climbed(tmp_path, "car", {"sphere": 8, "box": 0.7}, needs="box", rounds=5)
    page = page_of(tmp_path, "parsimony")
    assert list(page.table["Scene"]) == ["ball 0", "car 0"] and "Not shown: 1 run of parsimony" in told(page)
    assert page.data.loc[page.data["rung"].eq("box"), "error"].tolist() == pytest.approx([0.1, 0.014])


def test_candidates_stand_as_csv_a_line_each(page):
    data = page.data
    assert len(data) == 3 + 3 + 3 + 1
    assert list(data.loc[data["recommended"].eq(True), "rung"]) == ["sphere", "box", "grid_24"]
    assert list(data["error"].dropna())[:3] == pytest.approx([2e-4, 0.1, 4e-3])


def test_choices_have_rings_and_the_front_and_half_a_pixel_are_drawn(page):
    panel = next(panel for panel in page.chart["panels"] if panel["title"] == "car 0")
    rings = {each["name"]: (each["x"], each["y"]) for each in panel["series"] if each["colour"] == "#111111"}
    assert set(map(str, rings.values())) == {"([6000.0], [18.0])"} and len(rings) == 2
    lines = {each["name"]: each["y"] for each in panel["series"] if "dash" in each}
    assert lines == {"front of error and FLOPs": [160, 40, 18], "half a pixel": [20, 20]}
    small, large = (
        each["size"] for each in panel["series"] if each["name"] in ("single primitives", "narrow-band grid")
    )
    assert small < large and len(page.figure.axes) == 4


def test_a_candidate_that_failed_is_counted_and_crossed_and_one_that_was_stopped_is_hollow(tmp_path):
    errors = {"sphere": 8, "box": 1, "grid_24": 0.2}
    climbed(tmp_path, "car", errors, needs="grid_24", failed=("box",), **{"sphere.falling": True})
    page = page_of(tmp_path, "parsimony")
    assert (page.table["Failed candidates"].item(), page.table["Error still fell"].item()) == ("1 of 3", "1 of 3")
    assert page.data.set_index("rung").loc["box", "failed"] == "nan: why"
    crosses = [line for line in page.figure.axes[0].lines if line.get_marker() == "x" and len(line.get_xdata())]
    assert [list(line.get_xdata()) for line in crosses] == [[18]]
    assert next(each["x"] for each in page.chart["panels"][0]["series"] if each.get("hollow")) == [8]


def test_the_evaluations_at_pixel_precision_are_relative_to_the_first_fit(page, tmp_path):
    name = "At pixel precision: evaluations, error × 1000"
    assert page.table.set_index("Scene").loc["box 0", name].startswith("box: 0.250×, ")
    climbed(tmp_path, "car", {"sphere": 8, "box": 0.9}, needs="box", **{"frugal.error": ...})
    assert page_of(tmp_path, "parsimony").table[name].tolist() == ["–"]


def test_a_page_is_made_even_where_all_runs_failed(tmp_path):
    climbed(tmp_path, "car", {"sphere": 8}, needs="sphere", status="timeout")
    page = page_of(tmp_path, "parsimony")
    assert page.table["Least error × 1000"].tolist() == ["timeout"] and page.verdict == ""
