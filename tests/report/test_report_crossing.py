"""The pages of the crossing, made from run folders whose errors are known."""

import json
import math

import numpy as np
import pytest

from bench.records.read import read_records
from bench.report.compare import EVERY
from bench.report.data.runs import choose
from bench.studies import crossing
from bench.studies.crossing import READS, Crossed
from tests.report.test_report_paper import write_run

RENDERERS = {"dist": ("renderers.DIST", "DIST"), "idr": ("renderers.IDR", "IDR")}
LOSSES = {"Hinge": "DIST's mask loss", "CrossEntropy": "IDR's mask loss"}
# Errors factor in renderer, loss and both together, so that every number of the pages is known.
RENDERER, LOSS, BOTH = {"dist": 1.0, "idr": 1.5}, {"Hinge": 1.0, "CrossEntropy": 3.0}, 1.0


def crossed(results, *, both=BOTH, families=("sofa", "plane"), shapes=8, failed=()):
    """Runs of all settings; the error of a shape is that of its setting times the shape's own."""
    for name in families:
        for index in range(shapes):
            for points, (renderer, (target, label)), (loss, loss_label) in (
                (p, r, x) for p in ("100", "20") for r in RENDERERS.items() for x in LOSSES.items()
            ):
                factor = both if (renderer, loss) == ("idr", "CrossEntropy") else 1.0
                value = RENDERER[renderer] * LOSS[loss] * factor * (1 + index) * (2 if points == "20" else 1)
                ok = (name, index, renderer, loss) not in failed
                write_run(
                    results,
                    "crossing",
                    None,
                    **{"task": "completion", "dataset": name, "renderer": renderer, "method": ""},
                    **{"status": "ok" if ok else "empty", "metrics": {"chamfer_l2": value / 1000} if ok else {}},
                    evaluations={"value": 1000},
                    settings={
                        "task": {"points": points, "_target_": "completion"},
                        "renderer": {"_target_": target, "_label_": label},
                        "silhouette": {"_target_": f"renderers.silhouette.{loss}", "_label_": loss_label},
                        "dataset": {"name": name},
                        "index": index,
                    },
                )
    return choose(read_records(results)[0], READS[0], results)


def line(result, **wanted):
    """The only line of a page's data with these values."""
    found = result.data
    for key, value in wanted.items():
        found = found[found[key] == value]
    assert len(found) == 1
    return found.iloc[0]


def test_all_runs_are_one_experiment_with_a_cell_per_setting(tmp_path):
    found = Crossed(crossed(tmp_path, shapes=2))
    rows = found.settings
    assert (found.families, found.conditions) == (["sofa", "plane"], ["100", "20"])
    assert (found.renderers, found.losses) == (["dist", "idr"], ["Hinge", "CrossEntropy"])
    assert found.own == {"dist": "Hinge", "idr": "CrossEntropy"}
    assert found.median("sofa", rows["idr", "CrossEntropy"], "100") == pytest.approx(1.5 * 3 * 1.5)
    assert found.median("table", rows["idr", "Hinge"], "100") is None
    values = found.means(EVERY, rows["idr", "Hinge"])
    assert len(values) == 4 and values[("sofa", "0"), 0, 0] == pytest.approx(1.5 * math.sqrt(2))


def test_a_gap_under_own_losses_is_the_renderers_times_the_losses(tmp_path):
    result = crossing.make_gaps(crossed(tmp_path))
    gap = line(result, family=EVERY)
    assert gap["compared"] == "IDR over DIST" and gap["shapes"] == 16
    assert gap["own"] == pytest.approx(4.5)  # the methods' gap
    assert gap["renderer"] == pytest.approx(1.5) and gap["loss"] == pytest.approx(3)
    assert gap["Hinge"] == pytest.approx(1.5) and gap["CrossEntropy"] == pytest.approx(1.5)
    assert gap["own_better"] == 0
    assert gap["own_low"] == pytest.approx(4.5) and gap["own_high"] == pytest.approx(4.5)  # the same on every shape
    assert result.verdict == (
        "IDR over DIST: *4.50* [4.50, 4.50] times the error; of it the renderer 1.50 [1.50, 1.50], the loss 3.00 "
        "[3.00, 3.00]. The interval excludes 1 for *2 of 2* ratios under one loss: IDR over DIST under DIST's mask "
        "loss 1.50 [1.50, 1.50]; IDR over DIST under IDR's mask loss 1.50 [1.50, 1.50]."
    )


def test_the_two_parts_make_the_gap_also_where_they_interact(tmp_path):
    gap = line(crossing.make_gaps(crossed(tmp_path, both=1 / 9)), family="sofa")
    assert gap["own"] == pytest.approx(0.5)
    assert gap["renderer"] == pytest.approx(0.5) and gap["loss"] == pytest.approx(1)  # 1.5 and 1/6; 3 and 1/3


def test_a_failure_has_the_largest_error_of_any_setting_on_its_shape(tmp_path):
    experiment = crossed(tmp_path, families=("sofa",), failed={("sofa", 3, "idr", "Hinge")})
    gap = line(crossing.make_gaps(experiment), family="sofa")
    assert gap["Hinge"] == pytest.approx((1.5**7 * 4.5) ** (1 / 8)) and gap["shapes"] == 8
    table = crossing.make(experiment).table
    row = table[(table["Renderer"] == "IDR") & (table["Loss of the mask"] == LOSSES["Hinge"])]
    assert row["Failed"].item() == "2 of 16"
    both = crossed(tmp_path / "both", families=("sofa",), failed={("sofa", 3, "idr", x) for x in LOSSES})
    gap = line(crossing.make_gaps(both), family="sofa")  # where both fail neither draws the ratio towards 1
    assert gap["CrossEntropy"] == pytest.approx((1.5**7 * 1) ** (1 / 8))


def test_a_shape_on_which_every_setting_fails_is_left_out(tmp_path):
    everywhere = {("sofa", 3, renderer, loss) for renderer in RENDERERS for loss in LOSSES}
    experiment = crossed(tmp_path, families=("sofa",), failed=everywhere)
    assert line(crossing.make_gaps(experiment), family="sofa")["shapes"] == 7
    data = crossing.make_front(experiment).data
    assert np.isfinite(data[["error", "low", "high"]].to_numpy(float)).all()


def test_a_renderer_without_a_run_that_ended_ok_is_not_on_the_front(tmp_path):
    everywhere = {("sofa", index, "dist", loss) for index in range(8) for loss in LOSSES}
    table = crossing.make_front(crossed(tmp_path, families=("sofa",), failed=everywhere)).table
    assert set(table["Renderer"]) == {"IDR"} and set(table["Best for its cost"]) == {"yes"}


def test_a_renderer_without_a_known_loss_has_no_own_gap(tmp_path):
    experiment = crossed(tmp_path, shapes=1, families=("sofa",))
    for record in experiment.records:
        if record["renderer"] == "idr":
            record["config"]["renderer"]["_target_"] = "mine.Renderer"
    gap = line(crossing.make_gaps(experiment), family="sofa")
    assert gap["Hinge"] == pytest.approx(1.5)
    assert not {"own", "renderer", "loss"} & {*gap.dropna().index}


def test_the_figure_has_a_panel_per_family_and_number_of_points(tmp_path):
    figure = crossing.make(crossed(tmp_path, shapes=2)).figure
    assert [axis.get_title() for axis in figure.axes] == [
        f"{name}, {points} pts" for points in (100, 20) for name in ("sofa", "plane")
    ]
    shown = figure.axes[0].lines
    assert len(shown) == 2 * (2 + 1)  # of each renderer: its shapes under each loss, and its medians
    medians = [y for drawn in shown for y in drawn.get_ydata() if drawn.get_label() == "IDR"]
    assert medians == pytest.approx([1.5 * 1.5, 1.5 * 3 * 1.5])


def test_an_earlier_setting_of_a_renderer_is_left_out(tmp_path):
    crossed(tmp_path, families=("sofa",), shapes=1)
    folder = next(
        path for path in (tmp_path / "runs").iterdir() if '"renderer": "dist"' in (path / "record.json").read_text()
    )
    record = json.loads((folder / "record.json").read_text())
    record["config"]["renderer"]["epsilon"] = 1e-3
    record["started"] = "2020-01-01T00:00:00+00:00"
    (tmp_path / "runs" / "odd").mkdir()
    (tmp_path / "runs" / "odd" / "record.json").write_text(json.dumps(record | {"id": "odd"}))
    result = crossing.make(choose(read_records(tmp_path)[0], READS[0], tmp_path))
    assert len(result.table) == 4 and "Not shown: 1 run" in " ".join(result.notes)
