"""Metrics by name: heading, factor of printed numbers, better direction. `RENDERING_METRICS` are of task=ablation."""

from typing import Any, NamedTuple

METRIC_PREFIXES = ("own_", "seen_")  # on the renderer's own image, and on the surface that photographs see
LOWER, HIGHER = "lower", "higher"


class Metric(NamedTuple):
    """A metric as readers see it.

    Args:
        label: its heading, with the factor or the unit.
        factor: multiplies the printed number.
        better: `LOWER`, `HIGHER`, or empty if neither is better.
    """

    label: str
    factor: float = 1.0
    better: str = ""


TABLE_METRICS = {  # the order is that of tables
    "chamfer_l2": Metric("Chamfer (x1000)", 1000.0, LOWER),
    "seen_chamfer_l1": Metric("Chamfer-L1 of what is seen (x1000)", 1000.0, LOWER),
    "accuracy": Metric("accuracy (x1000)", 1000.0, LOWER),
    "completeness": Metric("completeness (x1000)", 1000.0, LOWER),
    "fscore": Metric("F-score", better=HIGHER),
    "normal_consistency": Metric("normal consistency", better=HIGHER),
    "iou": Metric("IoU of volumes", better=HIGHER),
    "fitted_mask_iou": Metric("mask IoU from the best view", better=HIGHER),
    "depth_mae": Metric("depth error (x1000)", 1000.0, LOWER),
    "mask_iou": Metric("mask IoU", better=HIGHER),
    "dtu_overall": Metric("DTU overall (mm)", better=LOWER),
    "tnt_fscore": Metric("F-score, Tanks and Temples", better=HIGHER),
    "psnr": Metric("PSNR (dB)", better=HIGHER),
    "psnr_image": Metric("PSNR of whole images (dB)", better=HIGHER),
    "ssim": Metric("SSIM", better=HIGHER),
    "colour_error": Metric("error of colours (x1000)", 1000.0, LOWER),
    "rotation_error_deg": Metric("rotation error (degrees)", better=LOWER),
    "translation_error": Metric("translation error (x1000)", 1000.0, LOWER),
}
RENDERING_METRICS = {
    "pixel_errors": Metric("wrong pixels", better=LOWER),
    "lost": Metric("missed pixels", better=LOWER),
    "false": Metric("spurious pixels", better=LOWER),
    "depth_error_median": Metric("median depth error (x1000)", 1000.0, LOWER),
    "depth_error_p99": Metric("depth error, 99th percentile (x1000)", 1000.0, LOWER),
    "cost": Metric("field evaluations of a rendering", better=LOWER),
    "forward_seconds": Metric("rendering (ms)", 1000.0, LOWER),
    "step_seconds": Metric("step (ms)", 1000.0, LOWER),
}
LISTED_METRICS = TABLE_METRICS | RENDERING_METRICS
OTHER_DIRECTIONS = {  # which direction is better, for metrics that tables do not show
    **dict.fromkeys(("chamfer_l1", "chamfer_gt_to_pred"), LOWER),
    **dict.fromkeys(("seen_roughness", "unseen_roughness", "own_early_weight", "floaters"), LOWER),
    **dict.fromkeys(("dtu_accuracy", "dtu_completeness"), LOWER),
    **dict.fromkeys(("mask_iou_least", "tnt_precision", "tnt_recall"), HIGHER),
}
NON_NEGATIVE = {  # distances and angles; roughness is a logarithm
    *("chamfer_l2", "chamfer_l1", "chamfer_gt_to_pred", "accuracy", "completeness", "depth_mae", "colour_error"),
    *("dtu_overall", "dtu_accuracy", "dtu_completeness", "rotation_error_deg", "translation_error"),
}


def better_direction(name: str) -> str:
    """Which direction of a metric is better: `LOWER`, `HIGHER`, or empty if unknown."""
    for base_name in _with_base_names(name):
        if metric := LISTED_METRICS.get(base_name):
            return metric.better
        if base_name in OTHER_DIRECTIONS:
            return OTHER_DIRECTIONS[base_name]
    return ""


def metric_fault(metrics: dict[str, Any]) -> str:
    """What is wrong with the first metric that has an impossible value; empty if there is none.

    A metric with a better direction must be a number in its range: distances are from 0 on, overlaps at most 1.
    """
    for name, value in metrics.items():
        if value is None or not better_direction(name):
            continue
        if not isinstance(value, int | float) or isinstance(value, bool):
            return f"{name} must be a number, found {value!r}"
        is_negative = value < 0 and not NON_NEGATIVE.isdisjoint(_with_base_names(name))
        if is_negative or (value > 1 + 1e-6 and better_direction(name) == HIGHER and "psnr" not in name):
            return f"{name} must be {'at least 0' if is_negative else 'at most 1'}, found {value}"
    return ""


def _with_base_names(name: str) -> tuple[str, ...]:
    """The name of a metric, and its names without a prefix."""
    return (name, *(name.removeprefix(prefix) for prefix in METRIC_PREFIXES))
