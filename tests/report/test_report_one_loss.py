"""The page of all renderers under one loss, made from run folders whose errors and costs are known."""

import pytest

from bench.records.read import read_records
from bench.report.data.experiments import choose
from bench.report.data.subjects.completions import EVERY
from bench.report.pages.completion import one_loss
from tests.report.test_report_paper import told, write_run

# Error over DIST's, field values, seconds of the loop of a run.
METHODS = {"dist": (1.0, 1000, 4.0), "newton": (0.5, 500, 8.0), "neus": (0.25, 9000, 30.0), "volsdf": (2.0, 9000, 40.0)}


def compared(results, *, families=("sofa", "plane"), shapes=6, failed=()):
    """Runs of every method; the error of a shape is that of its method times the shape's own."""
    for name in families:
        for index, points in ((i, p) for i in range(shapes) for p in ("100", "20")):
            for renderer, (factor, values, seconds) in METHODS.items():
                ok = (renderer, name, index) not in failed
                error = factor * (1 + index) * (4 if points == "20" else 1) * (9 if name == "plane" else 1) / 1000
                write_run(
                    results,
                    "one_loss",
                    f"{renderer} with mask",
                    **{"task": "completion", "dataset": name, "renderer": renderer},
                    **{"method": f"{renderer}_mask", "status": "ok" if ok else "empty"},
                    metrics={"chamfer_l2": error} if ok else {},
                    evaluations={"value": values},
                    seconds={"forward": seconds / 2, "backward": seconds / 2},
                    settings={
                        "task": {"points": points, "_target_": "completion"},
                        "silhouette": {"_target_": "renderers.silhouette.Hinge", "_label_": "DIST's mask loss"},
                        **{"dataset": {"name": name}, "index": index},
                    },
                )
    return choose(read_records(results)[0], one_loss.READS[0], results)


def line(result, row, family=EVERY):
    """The only line of the page's data of a row and family."""
    found = result.data[(result.data["row"] == row) & (result.data["family"] == family)]
    assert len(found) == 1
    return found.iloc[0]


def test_a_line_has_errors_ratio_cost_and_both_fronts(tmp_path):
    result = one_loss.make(compared(tmp_path))
    newton = line(result, "newton with mask")
    assert newton["ratio"] == "0.500 [0.500, 0.500]; 12 of 12"
    assert (newton["evaluations"], newton["seconds"], newton["failed"]) == (500, 8.0, "0 of 24")
    assert newton["100"] == pytest.approx(0.5 * (6 + 9) / 2)  # of sofas 1 to 6 and planes 9 to 54
    own = line(result, "newton with mask", "plane")
    assert own["error"] == pytest.approx(0.5 * 720 ** (1 / 6) * 2 * 9)  # of shapes 1 to 6, points 1 and 4
    assert own["100"] == pytest.approx(0.5 * 3.5 * 9) and own["20"] == pytest.approx(0.5 * 3.5 * 9 * 4)
    fronts = {name: [line(result, f"{name} with mask")[f"front_{c}"] for c in one_loss.COSTS] for name in METHODS}
    assert fronts == {"dist": ["", "yes"], "newton": ["yes", "yes"], "neus": ["yes", "yes"], "volsdf": ["", ""]}
    assert line(result, "dist with mask")["ratio"] == ""
    assert "excludes 1 for 3 of 3 ratios to DIST over all families: newton with mask 0.500" in told(result)


def test_a_failure_counts_as_the_worst_error_of_its_shape(tmp_path):
    result = one_loss.make(compared(tmp_path, families=("sofa",), failed={("newton", "sofa", 0)}))
    newton = line(result, "newton with mask", "sofa")
    assert newton["failed"] == "2 of 12"
    assert newton["error"] == pytest.approx(2 * (0.5**5 * 2 * 720) ** (1 / 6))  # VolSDF's on the first shape


def test_without_the_reference_there_is_no_ratio_and_no_verdict(tmp_path):
    experiment = compared(tmp_path, shapes=1)
    kept = [record for record in experiment.records if record["renderer"] != "dist"]
    result = one_loss.make(type(experiment)(experiment.selection, tmp_path, kept))
    assert set(result.data["ratio"]) == {""} and "ratios to DIST" not in told(result)


def test_where_nothing_ended_well_there_is_no_verdict(tmp_path):
    every = {(renderer, "sofa", 0) for renderer in METHODS}
    result = one_loss.make(compared(tmp_path, families=("sofa",), shapes=1, failed=every))
    assert one_loss.answer(result.data, []).verdict == ""


def test_the_answer_names_the_best_and_the_quickest(tmp_path):
    result = one_loss.make(compared(tmp_path))
    verdict = one_loss.answer(result.data, []).verdict
    assert verdict.endswith("excludes 1 for *3 of 3* rows.")
    assert "(neus with mask, 30.0 s)" in verdict and "(dist with mask, 4.00 s)" in verdict
