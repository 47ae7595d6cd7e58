"""The stability atlas as tables and figures, made from run folders whose numbers are known."""

import json

import pytest

from bench.records.read import read_records
from bench.report.data.records import row_of
from bench.report.data.runs import choose, shared_loss
from bench.report.data.runs import named_rows as named_by_rows
from bench.report.data.subjects.atlas import STABILITY, atlas
from bench.report.pages.stability import stability, stability_curves
from bench.report.write.paper import write_paper
from tests.report.test_report_paper import told, write_run

SWEEP = {"mild": 1.0, "severe": 0.01, "log": True, "unit": "scene units"}


def broke(
    results,
    axis,
    label,
    level,
    *,
    status="ok",
    measure="rendering",
    criteria=None,
    loss=None,
    repeats=None,
    **metrics,
):
    """A run of the atlas whose breakdown lies at a level; with a curve of ten trials.

    With `repeats` of 1 there is no interval; `loss` is the label of its loss of the mask.
    """
    within = {"breakdown": None if not 0 <= level <= 1 else 0.01**level}
    ends = {"level": level, "level_low": level - 0.05, "level_high": level + 0.05}
    within |= {
        f"breakdown{end}": 0.01 ** (level + by) if 0 <= level + by <= 1 else None
        for end, by in (("_low", -0.05), ("_high", 0.05))
    }
    counts = {"trials": 10, "grid_trials": 40, "mild_trials": 5, "severe_trials": 5}
    counts |= {"mild_successes": 5 * (level > 0), "severe_successes": 5 * (level > 1), "evaluations_per_ray": 4.0}
    if repeats == 1:
        within |= {"breakdown_low": None, "breakdown_high": None}
        ends |= {"level_low": None, "level_high": None}
        counts |= {"mild_trials": 1, "severe_trials": 1, "mild_successes": int(level > 0), "severe_successes": 0}
    known = {**within, **ends, **counts, "failed_lost": 3, "failed_false": 1, **metrics}
    stress = {"scene": axis, "measure": measure, "group": "viewing", "sweep": SWEEP, "repeats": repeats}
    search = {"levels": 11, "repeats": 4}
    folder = write_run(
        *(results, "stability", label),
        task="stability",
        dataset=axis,
        status=status,
        reason="" if status == "ok" else "why",
        metrics=known if status == "ok" else {},
        settings={
            "task": {"stress": stress, "search": search, "fit_search": search, "criteria": criteria or {}},
            "stress": stress,
            "silhouette": {"_label_": loss} if loss else {},
        },
    )
    if status == "ok":
        lines = [
            {"trial": i, "level": i / 10, "severity": 0.01 ** (i / 10), "success": i / 10 < level} for i in range(11)
        ]
        (folder / "curve.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    return folder


def made(results, function):
    return function(choose(read_records(results)[0], STABILITY, results))


def test_a_breakdown_stands_with_its_interval(tmp_path):
    broke(tmp_path, "wires", "DIST", 0.5)
    table = made(tmp_path, stability.make)
    assert table.table.loc[0, "Axis"] == "wires"
    assert table.table.loc[0, "DIST"] == "0.100 (0.126 to 0.0794)"
    worst = "DIST: worst on wires 0.100 scene units (0.126 to 0.0794)."
    assert f"{worst} Failed trials: 3 missed, 1 spurious." in table.notes
    assert "n = 10 trials in all, of 1 axes and 1 renderers" in table.caption
    assert "25 % of a full grid's" in told(table)


def test_one_trial_per_level_has_no_interval_anywhere(tmp_path):
    broke(tmp_path, "camera_inside", "DIST", 0.5, repeats=1)
    broke(tmp_path, "camera_inside", "DVR", -0.1, repeats=1)
    result = made(tmp_path, stability.make)
    assert result.table.loc[0, ["DIST", "DVR"]].tolist() == ["0.100 (one trial)", "at once (1 of 1 failed)"]
    assert result.data[["breakdown_low", "breakdown_high", "level_low", "level_high"]].isna().all(axis=None)
    curves = made(tmp_path, stability_curves.make)
    assert curves.data["share"].notna().all() and curves.data[["low", "high"]].isna().all(axis=None)
    bars = [line for line in curves.figure.axes[0].lines if line.get_linewidth() == 2]
    assert not bars
    broke(tmp_path, "wires", "DIST", 0.5)
    repeated = made(tmp_path, stability_curves.make)
    assert len([line for axis in repeated.figure.axes for line in axis.lines if line.get_linewidth() == 2]) == 1


def test_how_far_surfaces_moved_is_told_and_not_ranked(tmp_path):
    for label, moved in (("DIST", 0.5), ("DVR", 0.001)):
        broke(tmp_path, "quantised", label, 0.5, surface_moved=moved)
        broke(tmp_path, "wires", label, 0.5)  # a second axis, since one alone gives no rank
    told_of = "Distance by which the surface moved at the breakdowns, in scene units: quantised 0.00100 to 0.500."
    assert told_of in made(tmp_path, stability.make).notes
    assert made(tmp_path, stability.make_cost).data["rank"].tolist() == [1.5, 1.5]


def test_a_loss_that_all_rows_share_is_in_the_caption_and_not_in_their_names(tmp_path):
    for label in ("DIST", "DVR"):
        broke(tmp_path, "wires", label, 0.5, loss="DIST's mask loss")
    result = made(tmp_path, stability.make)
    assert list(result.table.columns) == ["Axis", "Unit", "DIST", "DVR"]
    assert "every row with DIST's mask loss." in result.caption
    assert [record["name"] for record in result.runs.named()] == ["DIST", "DVR"]


def test_losses_that_differ_are_in_the_names_of_rows():
    def record(loss):
        return {"config": {"silhouette": {"_label_": loss} if loss else {}}, "renderer": "dist"}

    assert shared_loss([record("a"), record("a")]) == "a"
    assert shared_loss([record("a"), record("b")]) == shared_loss([record("a"), record(None)]) == ""
    assert shared_loss([record(None)]) == ""
    assert [row_of(one).name for one in named_by_rows([record("a"), record("b")])] == ["dist, a", "dist, b"]
    assert [row_of(one).name for one in named_by_rows([record("a"), record("a")])] == ["dist", "dist"]


def test_the_ends_of_a_sweep_have_the_count_behind_them(tmp_path):
    broke(tmp_path, "wires", "DIST", -0.1)
    broke(tmp_path, "wires", "DVR", 1.1)
    row = made(tmp_path, stability.make).table.iloc[0]
    assert row["DIST"] == "at once (5 of 5 failed, 48-100 %)"
    assert row["DVR"] == "none (0 of 5 failed, 0-52 %)"  # 0 of 5 still allows 52 %: 1 - 0.025^(1/5)


def test_what_did_not_end_ok_keeps_its_cell(tmp_path):
    broke(tmp_path, "wires", "DIST", 0.5)
    broke(tmp_path, "wires", "DVR", 0.5, status="crashed")
    broke(tmp_path, "alpha", "DIST", 0.5)
    broke(tmp_path, "alpha", "DVR", 0.5, status="unsupported")
    result = made(tmp_path, stability.make)
    assert list(result.table["DVR"]) == ["crashed", "–"]
    assert "2 of 4 runs did not end ok: DVR, wires: crashed (why); DVR, alpha: unsupported (why)." in result.caption
    assert made(tmp_path, stability_curves.make).figure is not None


def test_costs_are_of_the_axes_that_all_renderers_have(tmp_path):
    for label, level in (("DIST", 0.25), ("DVR", 0.75)):
        broke(tmp_path, "wires", label, level, evaluations_per_ray=2.0 if label == "DIST" else 90.0)
        broke(tmp_path, "thin_plate", label, -0.1 if label == "DIST" else 1.1)
        broke(tmp_path, "gap", label, 0.5)
        broke(tmp_path, "depth_noise", label, 0.5, measure="fit")
    broke(tmp_path, "alpha", "DIST", 0.9)
    broke(tmp_path, "alpha", "DVR", 0.9, status="unsupported")
    rows = made(tmp_path, stability.make_cost).data.set_index("row")
    columns = ["axes", "at_once", "never", "cost"]
    assert rows.loc["DIST", columns].tolist() == [3, 1, 0, 3.0]
    assert rows.loc["DVR", columns].tolist() == [3, 0, 1, 4.0]
    assert rows["rank"].to_dict() == {"DIST": pytest.approx(5.5 / 3), "DVR": pytest.approx(3.5 / 3)}


@pytest.mark.parametrize("status", ["timeout", "missing"])
def test_a_run_that_failed_or_is_missing_has_the_worst_rank(tmp_path, status):
    for label in ("DIST", "DVR"):
        broke(tmp_path, "wires", label, 0.5)
    if status != "missing":
        broke(tmp_path, "thin_plate", "DIST", 0.1, status=status)
    broke(tmp_path, "thin_plate", "DVR", 0.1)
    rows = made(tmp_path, stability.make_cost).data.set_index("row")
    assert rows["rank"].to_dict() == {"DIST": 1.75, "DVR": 1.25}
    if status != "missing":
        assert "DIST: worst on thin plate timeout" in " ".join(made(tmp_path, stability.make).notes)


def test_rows_of_other_criteria_are_not_compared(tmp_path):
    broke(tmp_path, "wires", "DIST", 0.5, criteria={"hits": 0.5})
    broke(tmp_path, "wires", "DVR", 0.5, criteria={"hits": 0.99})
    result = made(tmp_path, stability.make)
    assert list(result.table.columns) == ["Axis", "Unit", "DVR"]
    assert "Success: 0.99 of the true hits" in told(result) and "Not shown: 1 run" in told(result)


def test_axes_stand_in_their_groups(tmp_path):
    broke(tmp_path, "wires", "DIST", 0.5)
    records = read_records(tmp_path)[0]
    grid = atlas(choose(records, STABILITY, tmp_path))
    (row,) = grid.rows
    assert (grid.axes, row.name, grid.stress("wires", "group")) == (["wires"], "DIST", "viewing")


def test_curves_have_a_row_a_level_with_its_interval(tmp_path):
    broke(tmp_path, "wires", "DIST", 0.45)
    data = made(tmp_path, stability_curves.make).data
    assert len(data) == 11
    assert data["successes"].sum() == 5
    assert (data["low"] <= data["share"]).all() and (data["share"] <= data["high"]).all()
    assert data["level"].iloc[-1] == 1.0


def test_all_three_are_written(tmp_path):
    folder = broke(tmp_path, "wires", "DIST", 0.5)
    (folder / "curve.jsonl").write_text("not a line\n")
    written = write_paper(read_records(tmp_path)[0], tmp_path)
    assert [path.stem for path in written] == ["stability", "stability_cost", "stability_curves"]
    for path in written:
        assert path.with_suffix(".png").stat().st_size > 1000


def test_a_row_that_breaks_nowhere_is_told_without_a_worst_axis(tmp_path):
    broke(tmp_path, "wires", "DIST", 1.1)
    broke(tmp_path, "wires", "DVR", -0.1)
    notes = " ".join(made(tmp_path, stability.make).notes)
    assert "DIST: breaks on none of 1 axes. Failed trials:" in notes
    assert "DVR: worst on wires at once (5 of 5 failed, 48-100 %" in notes
