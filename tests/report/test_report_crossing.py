"""The pages of the crossing, made from run folders whose errors are known."""

import math

import pytest

from bench.records.read import read_records
from bench.report.compare import EVERY
from bench.report.data.runs import choose
from bench.studies import crossing
from bench.studies.crossing import READS
from tests.report.test_report_paper import write_run

RENDERERS = {"dist": ("renderers.DIST", "DIST"), "idr": ("renderers.IDR", "IDR")}
LOSSES = {"Hinge": "DIST's mask loss", "CrossEntropy": "IDR's mask loss"}
# Errors factor in renderer, loss and both together, so that every number of the pages is known.
RENDERER, LOSS, BOTH = {"dist": 1.0, "idr": 1.5}, {"Hinge": 1.0, "CrossEntropy": 3.0}, 1.0


def crossed(results, *, both=BOTH, families=("sofa", "plane"), shapes=6, failed=()):
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
                    seconds={"forward": 1.0, "backward": 1.0},
                    settings={
                        "task": {"points": points, "_target_": "completion"},
                        "renderer": {"_target_": target, "_label_": label},
                        "silhouette": {"_target_": f"renderers.silhouette.{loss}", "_label_": loss_label},
                    },
                    index=index,
                )
    return choose(read_records(results)[0], READS[0], results)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The runs without a failure, written once."""
    return crossed(tmp_path_factory.mktemp("whole"))


def line(result, **wanted):
    """The only line of a page's data with these values."""
    found = result.data
    for key, value in wanted.items():
        found = found[found[key] == value]
    assert len(found) == 1
    return found.iloc[0]


def test_all_runs_are_one_experiment_with_a_cell_per_setting(whole):
    settings = crossing.crossed(whole)
    found, rows = settings.found, settings.rows
    assert (found.families, found.conditions) == (["sofa", "plane"], ["100", "20"])
    assert (settings.renderers, settings.losses) == (["dist", "idr"], ["Hinge", "CrossEntropy"])
    assert settings.own == {"dist": "Hinge", "idr": "CrossEntropy"}
    assert found.median("sofa", rows["idr", "CrossEntropy"], "100") == pytest.approx(1.5 * 3 * 3.5)
    assert found.median("table", rows["idr", "Hinge"], "100") is None
    values = found.means(EVERY, rows["idr", "Hinge"])
    assert len(values) == 12 and values[("sofa", "0"), 0, 0] == pytest.approx(1.5 * math.sqrt(2))


def test_a_gap_under_own_losses_is_the_renderers_times_the_losses(whole):
    result = crossing.make_gaps(whole)
    gap = line(result, family=EVERY)
    assert gap["compared"] == "IDR over DIST" and gap["shapes"] == 12
    assert gap["own"] == pytest.approx(4.5)  # the methods' gap
    assert gap["renderer"] == pytest.approx(1.5) and gap["loss"] == pytest.approx(3)
    assert gap["Hinge"] == pytest.approx(1.5) and gap["CrossEntropy"] == pytest.approx(1.5)
    assert gap["own_better"] == 0
    assert gap["own_low"] == pytest.approx(4.5) and gap["own_high"] == pytest.approx(4.5)  # the same on every shape
    assert result.verdict == (
        "IDR over DIST: *4.50* [4.50, 4.50] times the error; of it the renderer 1.50 [1.50, 1.50], the loss 3.00 "
        "[3.00, 3.00]. By the sign test over shapes with Holm's correction, *2 of 2* ratios under one loss differ from "
        "1: IDR over DIST under DIST's mask loss 1.50 [1.50, 1.50]; IDR over DIST under IDR's mask loss 1.50 "
        "[1.50, 1.50]."
    )


def test_the_two_parts_make_the_gap_also_where_they_interact(tmp_path):
    gap = line(crossing.make_gaps(crossed(tmp_path, both=1 / 9, families=("sofa",), shapes=1)), family="sofa")
    assert gap["own"] == pytest.approx(0.5)
    assert gap["renderer"] == pytest.approx(0.5) and gap["loss"] == pytest.approx(1)  # 1.5 and 1/6; 3 and 1/3


def test_a_failure_has_the_largest_error_of_any_setting_on_its_shape(tmp_path):
    experiment = crossed(tmp_path, families=("sofa",), failed={("sofa", 3, "idr", "Hinge")})
    gap = line(crossing.make_gaps(experiment), family="sofa")
    assert (gap["Hinge"], gap["Hinge_high"]) == pytest.approx((1.5, 4.5)) and gap["shapes"] == 6
    table = crossing.make(experiment).table
    assert table.set_index("Method").loc["IDR, DIST's mask loss", "Failed"] == "2 of 12"
    both = crossed(tmp_path / "both", families=("sofa",), failed={("sofa", 3, "idr", x) for x in LOSSES})
    gap = line(crossing.make_gaps(both), family="sofa")  # where both fail neither draws the ratio towards 1
    assert (gap["CrossEntropy"], gap["CrossEntropy_low"]) == pytest.approx((1.5, 1))


def test_a_shape_on_which_every_setting_fails_is_left_out(tmp_path):
    everywhere = {("sofa", 3, renderer, loss) for renderer in RENDERERS for loss in LOSSES}
    experiment = crossed(tmp_path, families=("sofa",), failed=everywhere)
    assert line(crossing.make_gaps(experiment), family="sofa")["shapes"] == 5


def test_a_renderer_without_a_known_loss_has_no_own_gap(tmp_path):
    experiment = crossed(tmp_path, shapes=1, families=("sofa",))
    for record in experiment.records:
        if record["renderer"] == "idr":
            record["config"]["renderer"]["_target_"] = "mine.Renderer"
    gap = line(crossing.make_gaps(experiment), family="sofa")
    assert gap["Hinge"] == pytest.approx(1.5)
    assert not {"own", "renderer", "loss"} & {*gap.dropna().index}


def test_the_table_has_the_mean_that_the_verdict_quotes(whole):
    result = crossing.make(whole)
    means = result.table[result.table["Family"] == EVERY].set_index("Method")["Median over shapes"]
    least, method = means.iloc[0].split()[0], means.index[0]
    assert method == "DIST, DIST's mask loss" and f"*{least}* ({method}, " in result.verdict
    assert list(means.index) == [f"{renderer}, {loss}" for renderer in ("DIST", "IDR") for loss in LOSSES.values()]
    assert float(means.iloc[3].split()[0]) == pytest.approx(4.5 * float(least), rel=0.01)


def test_the_figure_has_a_panel_per_family_with_the_mean_of_each_setting(whole):
    figure = crossing.make(whole).figure
    assert [axis.get_title() for axis in figure.axes] == ["sofa", "plane"]
    means = {line.get_label(): list(line.get_ydata()) for line in figure.axes[0].lines}
    one = means["DIST"][0]
    shown = {"DIST": [one, 3 * one], "IDR": [1.5 * one, 4.5 * one]}
    assert means == {name: pytest.approx(values, rel=1e-4) for name, values in shown.items()}
