"""How much model each scene needs as tables and figures, made from run folders whose numbers are known."""

from functools import cache

import numpy as np
import pytest
from omegaconf import OmegaConf

from bench.pictures.size_chart import KINDS
from bench.records.read import read_records
from bench.report.data.experiments import choose
from bench.report.data.records import setting
from bench.report.data.subjects.parsimony import NETWORK, PARSIMONY, SETTINGS, scene_runs
from bench.report.pages.parsimony import parsimony, parsimony_auto
from bench.report.write.paper import write_paper
from bench.report.write.result import latex
from tests.report.test_report_paper import write_run

PAPERS = 1_839_614
SIZES = {"sphere": 4, "box": 9, "union_3": 30, "grid_24": 3000, NETWORK: PAPERS}  # free numbers
STORED = SIZES | {"grid_24": 13_824}
COSTS = {"seconds": 2.0, "evaluations": 1000, "flops": 1_000_000}
VIEWS = {"fitted": 12, "held_out": 8, "share": 0.1}
CONFIG = {"task": {"checks": {"seeds": 20, "drawn": 8}}, "models": {"views": VIEWS, "fit": {"iterations": 100}}}


def climbed(
    results, scene, errors, *, needs, failed=(), at_auto=None, enough=1, status="ok", settings=None, **metrics
) -> None:
    """A run whose candidates have these errors in half pixels of 0.02; at `at_auto` the network came to auto's."""
    known = {"footprint": 0.02, "chamfer_l2": 0.001, "held_out_seeds": 20, "held_out_seeds_within": 0.6}
    known |= {"held_out_seeds_held": 0.95, "recommended_within": 0, "recommended_enough": enough}
    for name, error in errors.items():
        spent = {"free": SIZES[name], "stored": STORED[name], "bytes": 4 * STORED[name], **COSTS}
        spent |= {"flops_per_query": 2 * SIZES[name]}
        spent |= {"failed": "nan: why"} if name in failed else {"error": 0.02 * error, "standard_error": 0.001}
        spent |= dict.fromkeys((f"{cost}_at_auto" for cost in COSTS), at_auto if name == NETWORK else None)
        known |= {f"{name}.{key}": value for key, value in spent.items()}
    best = min((name for name in errors if name not in failed), key=lambda name: errors[name])
    known |= {"recommended_field": needs, "best_field": best, "recommended_by": "stored"}
    known |= {f"recommended_{size}": known[f"{needs}.{size}"] for size in ("free", "stored", "bytes")}
    known |= {"recommended_error": known[f"{needs}.error"], "saved_free": PAPERS / SIZES[needs]}
    known |= {"saved_stored": PAPERS / STORED[needs], "saved_bytes": PAPERS / STORED[needs]}
    known |= {"auto.field": needs, "auto.stored": STORED[needs], "auto.error": 0.02, "auto.standard_error": 0.001}
    known |= {
        "auto.seconds": 4.0,
        "auto.evaluations": 500,
        "auto.flops": 100_000,
        "auto.overhead": 1.5,
        "auto.overhead_judged": 2.5,
    }
    known |= {"frugal.stored": STORED[needs], "frugal.error": 0.03, "frugal.evaluations": 250}
    known |= {"frugal.seconds": 1.0, "precision.evaluations": 1000, "precision.evaluations_auto": 400}
    known |= {"precision.hits": 100, "precision.lost": 1, "precision.gained": 7} | metrics
    known = {name: value for name, value in known.items() if value is not ...}
    changed = {"status": status, "reason": "" if status == "ok" else "why", "metrics": known if status == "ok" else {}}
    write_run(
        *(results, "parsimony", None),
        **{"task": "capacity", "dataset": scene, "scene": f"{scene} test 0", "settings": settings or CONFIG, **changed},
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


def chosen(results):
    return choose(read_records(results)[0], PARSIMONY, results)


@cache
def made_of(results, function):
    """Made once: tests of the same runs only look at it."""
    return function(chosen(results))


def failures(made):
    """The notes of fits that failed."""
    return [note for note in made.notes if note.endswith(": why")]


def row(results, function, scene):
    return made_of(results, function).table.set_index("Scene").loc[scene]


def test_a_row_a_scene_the_least_need_first_and_a_failed_run_last(four):
    made = made_of(four, parsimony.make)
    assert list(made.table["Scene"]) == ["ball", "box", "car", "torus"]
    assert list(made.table.iloc[3])[1:] == ["crashed"] + ["–"] * (len(parsimony.COLUMNS) - 2)
    assert list(made.table["Why"][:3]) == ["both", "under half a pixel", "under half a pixel"]
    lost = made.data[made.data["scene"] == "torus"]
    assert (lost["status"].item(), lost["reason"].item()) == ("crashed", "why")
    assert "1 of 4 runs did not end ok: dist, torus: crashed (why)." in made.caption
    assert list(made_of(four, parsimony_auto.make).table["Choice of field=auto"]) == [
        "sphere",
        "box",
        "grid 24",
        "crashed",
    ]


def test_a_row_tells_the_need_and_what_it_saves(four):
    cells = row(four, parsimony.make, "box")
    assert cells["Recommended"] == "box"
    assert (cells["Stored numbers"], cells["Free numbers"], cells["Size of the file"]) == ("9", "9", "36 B")
    grid = row(four, parsimony.make, "car")
    assert (grid["Stored numbers"], grid["Free numbers"], grid["Size of the file"]) == ("13,824", "3,000", "55.3 kB")
    assert cells["Error × 1000"] == "10.0 ± 1.00"
    assert cells["Half a pixel × 1000"] == "20.0"
    assert (cells["Best candidate"], cells["Best error × 1000"]) == ("grid 24", "4.00 ± 1.00")
    assert (cells["Seeds within 1 s.e."], cells["Seeds held"]) == ("60 %", "95 %")
    assert cells["Saved stored numbers"] == cells["Saved free numbers"] == "204k×"
    assert (grid["Saved stored numbers"], grid["Saved free numbers"]) == ("133×", "613×")
    assert cells["Saved fit seconds"] == "–"  # the papers' network was not fitted
    assert cells["Chamfer × 1000"] == "1.00"


def test_captions_find_their_settings_where_the_configuration_has_them(compose_config):
    config = OmegaConf.to_container(compose_config("+experiment=parsimony"), resolve=True)
    found = {name: setting(config, *path) for name, path in SETTINGS.items()}
    assert all(isinstance(value, int | float) for value in found.values()), found


def test_plotted_numbers_stand_as_csv_a_line_per_candidate(four):
    made = made_of(four, parsimony.make)
    assert len(made.data) == 3 + 3 + 3 + 1
    ringed = made.data[made.data["recommended"] == True]  # noqa: E712, a column of objects
    assert list(ringed["rung"]) == ["sphere", "box", "grid_24"]
    assert list(made.data["error"].dropna())[:3] == pytest.approx([2e-4, 0.1, 4e-3])


def test_a_candidate_that_failed_is_counted_named_and_crossed(tmp_path):
    climbed(tmp_path, "car", {"sphere": 8, "box": 1, "grid_24": 0.2}, needs="grid_24", failed=("box",))
    made = parsimony.make(chosen(tmp_path))
    assert made.table["Failed candidates"].item() == "1 of 3"
    assert failures(made) == ["car, box: fit nan: why"]
    crosses = [line for line in made.figure.axes[0].lines if line.get_marker() == "x" and len(line.get_xdata())]
    assert [list(line.get_xdata()) for line in crosses] == [[9]]


def test_the_recommended_candidate_is_ringed_not_the_best(four):
    figure = made_of(four, parsimony.make).figure
    titles = [axis.get_title() for axis in figure.axes]
    assert titles == ["ball\nneeds sphere", "box\nneeds box", "car\nneeds grid 24", "torus\n"]
    ring = next(line for line in figure.axes[1].lines if line.get_label() == "recommended")
    assert np.column_stack(ring.get_data()).tolist() == [[9, pytest.approx(0.01)]]
    assert [text.get_text() for text in figure.axes[3].texts] == ["crashed"]
    assert len(figure.legends) == 1


def test_half_a_pixel_and_the_band_above_the_best_are_drawn(four):
    axis = made_of(four, parsimony.make).figure.axes[1]
    line = next(line for line in axis.lines if line.get_label() == "half a pixel")
    assert set(line.get_ydata()) == {0.02}
    band = next(patch for patch in axis.patches if patch.get_label() == "one standard error of the best")
    low, high = band.get_extents().transformed(axis.transData.inverted()).intervaly
    assert (low, high) == pytest.approx((0.004, 0.005))


def test_a_place_that_is_left_over_holds_the_legend(four):
    figure = parsimony.draw([*scene_runs(chosen(four)), scene_runs(chosen(four))[0]], "stored")
    assert len(figure.axes) == 8 and not figure.legends
    assert figure.axes[-1].get_legend() is not None


def by_free_numbers(results, scene) -> None:
    """A run whose choice was by free numbers."""
    climbed(results, scene, {"box": 8, "grid_24": 0.5}, needs="grid_24", recommended_by="free")


def test_a_choice_by_free_numbers_is_told(tmp_path):
    by_free_numbers(tmp_path, "car")
    made = parsimony.make(chosen(tmp_path))
    assert "free numbers" in made.title and "The size of a field is its free numbers." in made.notes
    assert made.figure.axes[0].get_xlabel() == "free numbers"


def test_captions_and_notes_say_by_which_size_the_choice_is(four):
    made = made_of(four, parsimony.make)
    assert "The size of a field is its stored numbers." in made.notes
    assert "stored numbers" in made.caption
    assert any("the smallest candidate by stored numbers whose error" in note for note in made.notes)


def test_choices_by_different_sizes_are_told(tmp_path):
    by_free_numbers(tmp_path, "car")
    climbed(tmp_path, "box", {"sphere": 7, "box": 0.5}, needs="box")
    told = "not the same for all scenes: stored numbers for box; free numbers for car."
    for page in (parsimony.make, parsimony_auto.make):
        assert any(note.endswith(told) for note in page(chosen(tmp_path)).notes)


@pytest.mark.parametrize(
    ("paths", "names"),
    [
        (("a/spot.obj", "a/cow.obj"), ["cow", "spot"]),
        (("a/spot.obj", "b/spot.obj"), ["a/spot.obj", "b/spot.obj"]),
    ],
)
def test_a_mesh_goes_by_the_name_of_its_file_where_that_is_its_own(tmp_path, paths, names):
    for path in paths:
        settings = {**CONFIG, "dataset": {"path": f"/somewhere/{path}"}}
        climbed(tmp_path, path.replace("/", "-"), {"sphere": 8, "box": 0.5}, needs="box", settings=settings)
    assert sorted(parsimony.make(chosen(tmp_path)).table["Scene"]) == names


def test_not_reached_is_not_not_fitted_and_not_failed(tmp_path):
    small, whole = {"sphere": 8, "box": 0.9}, {"sphere": 8, "box": 0.9, NETWORK: 3}
    climbed(tmp_path, "unfitted", small, needs="box")
    climbed(tmp_path, "beyond", whole, needs="box")
    climbed(tmp_path, "reached", whole, needs="box", at_auto=1_000.0)
    climbed(tmp_path, "broken", whole, needs="box", failed=(NETWORK,))
    climbed(tmp_path, "unknown", whole, needs="box", **{"auto.error": ..., "auto.failed": "diverged: why"})
    made = parsimony_auto.make(chosen(tmp_path))
    table, data = made.table.set_index("Scene"), made.data.set_index("scene")
    spent = {"unfitted": "–", "beyond": "not reached (1.00M)", "reached": "1.00k", "broken": "failed (1.00M)"}
    assert dict(table["Network: FLOPs"]) == {**spent, "unknown": "–"}
    ratios = {"unfitted": "–", "beyond": "> 0.500×", "reached": "250×", "broken": "–", "unknown": "–"}
    assert dict(table["Ratio of seconds"]) == ratios
    states = {
        "unfitted": "not fitted",
        "beyond": "not reached",
        "reached": "reached",
        "broken": "failed",
        "unknown": "",
    }
    assert dict(data["network"]) == states
    assert failures(made) == ["broken, the papers' network: nan: why", "unknown, field=auto: diverged: why"]
    left, order = made.figure.axes[0], [label.get_text() for label in made.figure.axes[0].get_yticklabels()]
    drawn = {
        (order[int(line.get_ydata()[0])], line.get_marker(), line.get_markerfacecolor() == "none"): line.get_xdata()[0]
        for line in left.lines
        if line.get_color() == KINDS["network"][1]
    }
    assert drawn == {("beyond", "s", True): 1e6, ("reached", "s", False): 1000, ("broken", "x", True): 1e6}
    notes = {(order[int(text.xy[1])], text.get_text()) for text in left.texts if text.get_text()}
    assert notes == {("unfitted", "network not fitted"), ("unknown", "field=auto failed: diverged")}


def test_what_frugality_saves_stands_beside_what_it_costs(four):
    cells = row(four, parsimony_auto.make, "box")
    assert (cells["Pixel precision: evaluations"], cells["Pixel precision: seconds"]) == ("0.250×", "0.500×")
    assert cells["Error in half pixels: plain, pixel precision"] == "0.500, 1.50"
    assert cells["Rendering: evaluations saved"] == "60 %"
    assert list(cells[["Hits missed", "Hits gained", "Hits"]]) == ["1", "7", "100"]
    assert (cells["Overhead"], cells["Overhead with evaluation"]) == ("1.50", "2.50")
    assert (
        "The overhead is at most 2 on 3 of 3 scenes; with evaluation, on 0." in made_of(four, parsimony_auto.make).notes
    )


def test_a_frugal_fit_that_failed_has_no_ratio(tmp_path):
    failed = {"frugal.error": ..., "frugal.failed": "nan: why", "auto.overhead": 2.5}
    climbed(tmp_path, "car", {"sphere": 8, "box": 0.9}, needs="box", **failed)
    made = parsimony_auto.make(chosen(tmp_path))
    assert made.table["Pixel precision: evaluations"].item() == "–"
    assert made.table["Error in half pixels: plain, pixel precision"].item() == "0.900, nan"
    assert failures(made) == ["car, the fit at pixel precision: nan: why"]
    assert [text.get_text() for text in made.figure.axes[1].texts] == ["fit at pixel precision failed: nan"]
    assert "The overhead is at most 2 on 0 of 1 scenes; with evaluation, on 0." in made.notes


def test_scenes_that_differ_in_their_shape_have_it_in_their_names(tmp_path):
    for index in (1, 0):
        climbed(tmp_path, "car", {"sphere": 8, "box": 0.9}, needs="box", settings={**CONFIG, "index": index})
    assert [run.name for run in scene_runs(chosen(tmp_path))] == ["car, shape 0", "car, shape 1"]


def test_the_report_writes_both_even_where_all_runs_failed(tmp_path):
    climbed(tmp_path, "car", {"sphere": 8}, needs="sphere", status="timeout")
    written = write_paper(read_records(tmp_path)[0], tmp_path)
    names = ["parsimony", "parsimony_auto"]
    assert [path.stem for path in written] == names
    assert all(path.with_suffix(".png").is_file() for path in written)
    assert "timeout" in (tmp_path / "paper" / "parsimony_auto.md").read_text()


def test_latex_has_the_sign_of_a_standard_error(four):
    assert r"10.0 $\pm$ 1.00" in latex(made_of(four, parsimony.make).shown(), "parsimony")
