"""The pages of effort and of outlines, made from run folders whose numbers are known."""

import pytest

from tests.report.test_report_paper import page_of, write_run

LABELS = {"dist_all_pixels": "DIST, effort=full", "dist_needed": "DIST, effort=needed", "mine": "Mine"}


def made(results, experiment, preset, shape, metrics, *, cost=100, status="ok", settings=None):
    """A run of a shape; without metrics if it is not ok."""
    label = LABELS.get(preset, preset)
    return write_run(
        *(results, experiment, label),
        **{"task": "completion", "method": preset, "dataset": "car", "index": shape, "status": status},
        **{"scene": f"car {shape}", "reason": "" if status == "ok" else "why"},
        metrics=metrics if status == "ok" else {},
        evaluations={"value": cost, "gradient": 0, "cost": cost},
        settings=settings or {},
    )


def completed(results, *, shapes=8, error=1.5, cost=40, status="ok"):
    """Runs of DIST at full effort and with less of it, with errors of that ratio."""
    for shape in range(shapes):
        full = 1e-4 * (1 + shape)
        made(results, "effort", "dist_all_pixels", shape, {"chamfer_l2": full})
        made(results, "effort", "dist_needed", shape, {"chamfer_l2": error * full}, cost=cost, status=status)


def test_a_row_is_compared_with_the_same_renderer_at_full_effort(tmp_path):
    completed(tmp_path)
    made(tmp_path, "effort", "mine", 0, {"chamfer_l2": 1e-4})
    page = page_of(tmp_path, "effort")
    rows = page.table.set_index("Method")
    assert rows.loc[LABELS["dist_needed"], ["Error ratio", "Cost ratio"]].tolist() == [
        "1.50 [1.50, 1.50]; 0 of 8",
        "0.400 [0.400, 0.400]",
    ]
    assert rows.loc[["Mine", LABELS["dist_all_pixels"]], "Error ratio"].tolist() == ["", ""]
    assert "effort=needed: DIST (cost *0.400×*, error 1.50×)." in page.verdict
    assert "*1 of 1* error ratios differ significantly from 1" in page.verdict


@pytest.mark.parametrize(("how", "words"), [
    ({"status": "crashed"}, ("DIST (cost *no cost*, error 1.00×)", "not significantly different from 1")),
    ({"shapes": 6, "error": 1.0}, ("error 1.00×", "not significantly different from 1")),
    ({"shapes": 1}, ("error 1.50×",)),
])  # fmt: skip
def test_failures_and_few_shapes_are_no_significant_difference(tmp_path, how, words):
    completed(tmp_path, **how)
    verdict = page_of(tmp_path, "effort").verdict
    assert [word for word in words if word not in verdict] == [] and "1 of 1" not in verdict


def test_outlines_are_compared_with_their_start(tmp_path):
    for shape in range(8):
        for rays, (error, chamfer) in {1: (20.0, 0.01), 4: (5.0, 0.02)}.items():
            metrics = {"area_error": error, "chamfer_l1": chamfer, "start_area_error": 10.0 * (1 + (shape > 3))}
            settings = {"view": {"resolution": 24, "rays_per_pixel": rays}}
            made(tmp_path, "outline", "outline_relaxed", shape, metrics, settings=settings)
    page = page_of(tmp_path, "outline")
    assert "*0.250* (outline_relaxed)" in page.verdict and page.verdict.endswith("n = 8 shapes.")
    text = " ".join(page.notes)
    assert "an error of 15 pixels (median over shapes)" in text
    assert "Area error with 1 ray over that of the start, not tested: outline_relaxed, 1.41 [1.00, 2.00]." in text
    assert "Chamfer-L1 with 4 rays over that with 1, not tested: outline_relaxed, 2.00 [2.00, 2.00]." in text
