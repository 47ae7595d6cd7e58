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


def climbed(results, scene, errors, *, needs, failed=(), status="ok", **metrics) -> None:
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
    write_run(
        *(results, "parsimony", None),
        **{"task": "capacity", "dataset": scene, "scene": f"{scene} test 0", "settings": CONFIG, **changed},
    )


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
    assert list(page.table.iloc[3])[1:] == ["crashed"] + ["–"] * (len(parsimony.COLUMNS) - 2)
    assert list(page.table["Why"][:3]) == ["both", "under half a pixel", "under half a pixel"]
    lost = page.data[page.data["scene"] == "torus 0"]
    assert (lost["status"].item(), lost["reason"].item()) == ("crashed", "why")
    assert "1 of 4 runs did not end ok: dist, torus: crashed (why)." in told(page)
    most = "The largest field needed is grid 24 with 13,824 stored numbers, for car 0."
    assert page.verdict == f"A single part suffices for *2 of 3* scenes. {most}"


def test_a_row_tells_the_need_and_what_it_saves(page):
    table = page.table.set_index("Scene")
    cells, grid = table.loc["box 0"], table.loc["car 0"]
    assert cells["Recommended"] == "box"
    assert (cells["Stored numbers"], cells["Free numbers"], cells["Size of the file"]) == ("9", "9", "36 B")
    assert (grid["Stored numbers"], grid["Free numbers"], grid["Size of the file"]) == ("13,824", "3,000", "55.3 kB")
    assert (cells["Error × 1000"], cells["Half a pixel × 1000"]) == ("10.0 ± 1.00", "20.0")
    assert (cells["Best candidate"], cells["Best error × 1000"]) == ("grid 24", "4.00 ± 1.00")
    assert (cells["Seeds held"], cells["Saved stored numbers"]) == ("95 %", "204k×")
    assert grid["Saved stored numbers"] == "133×"
    assert r"10.0 $\pm$ 1.00" in latex(page.shown(), "parsimony")


def test_candidates_stand_as_csv_a_line_each(page):
    data = page.data
    assert len(data) == 3 + 3 + 3 + 1
    assert list(data.loc[data["recommended"].eq(True), "rung"]) == ["sphere", "box", "grid_24"]
    assert list(data["error"].dropna())[:3] == pytest.approx([2e-4, 0.1, 4e-3])


def test_what_suffices_is_filled_and_the_recommended_is_ringed(page):
    axis = page.figure.axes[0]
    assert [label.get_text() for label in axis.get_yticklabels()] == ["ball 0", "box 0", "car 0", "torus 0 (crashed)"]
    drawn = [(*(float(x[0]) for x in line.get_data()), line) for line in axis.lines if len(line.get_xdata())]
    rings = [(x, y) for x, y, line in drawn if line.get_markersize() == 10]
    assert rings == [(4, 0), (9, 1), (13_824, 2)]
    hollow = [(x, y) for x, y, line in drawn if line.get_markersize() < 10 and line.get_markerfacecolor() == "none"]
    assert hollow == [(9, 0), (4, 1), (4, 2), (30, 2)]


def test_a_candidate_that_failed_is_counted_and_crossed(tmp_path):
    climbed(tmp_path, "car", {"sphere": 8, "box": 1, "grid_24": 0.2}, needs="grid_24", failed=("box",))
    page = page_of(tmp_path, "parsimony")
    assert page.table["Failed candidates"].item() == "1 of 3"
    assert page.data.set_index("rung").loc["box", "failed"] == "nan: why"
    crosses = [line for line in page.figure.axes[0].lines if line.get_marker() == "x" and len(line.get_xdata())]
    assert [list(line.get_xdata()) for line in crosses] == [[9]]


def test_pages_say_by_which_size_the_choice_is(page, tmp_path):
    climbed(tmp_path, "car", {"box": 8, "grid_24": 0.5}, needs="grid_24", recommended_by="free")
    other = page_of(tmp_path, "parsimony")
    assert "free numbers" in other.title and other.figure.axes[0].get_xlabel() == "free numbers"
    assert "the smallest candidate by stored numbers whose error" in told(page)


def test_field_auto_and_pixel_precision_stand_beside(page, tmp_path):
    names = ["Overhead of field=auto", "Evaluations at pixel precision"]
    assert page.table.set_index("Scene").loc["box 0", names].tolist() == ["1.50", "0.250×"]
    climbed(tmp_path, "car", {"sphere": 8, "box": 0.9}, needs="box", **{"frugal.error": ..., "auto.overhead": ...})
    assert page_of(tmp_path, "parsimony").table[names].iloc[0].tolist() == ["–", "–"]


def test_a_page_is_made_even_where_all_runs_failed(tmp_path):
    climbed(tmp_path, "car", {"sphere": 8}, needs="sphere", status="timeout")
    page = page_of(tmp_path, "parsimony")
    assert page.table["Recommended"].tolist() == ["timeout"] and page.verdict == ""
