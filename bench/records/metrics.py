"""What is known of metrics by their names: heading, factor of printed numbers, and which direction is better."""

from dataclasses import dataclass

PREFIXES = ("own_", "seen_")  # of the same metric of the renderer's own image, and of what photographs see


@dataclass(frozen=True)
class Metric:
    """A metric that tables show.

    Args:
        label: its heading, with the factor or the unit.
        factor: of the printed number.
        better: lower or higher.
    """

    label: str
    factor: float = 1.0
    better: str = "lower"


SHOWN = {  # in the order of tables
    "chamfer_l2": Metric("Chamfer (x1000)", 1000.0),
    "seen_chamfer_l1": Metric("Chamfer-L1 of what is seen (x1000)", 1000.0),
    "accuracy": Metric("accuracy (x1000)", 1000.0),
    "completeness": Metric("completeness (x1000)", 1000.0),
    "fscore": Metric("F-score", better="higher"),
    "normal_consistency": Metric("normal consistency", better="higher"),
    "iou": Metric("IoU of volumes", better="higher"),
    "fitted_mask_iou": Metric("mask IoU from the best view", better="higher"),
    "depth_mae": Metric("depth error (x1000)", 1000.0),
    "mask_iou": Metric("mask IoU", better="higher"),
    "psnr": Metric("PSNR (dB)", better="higher"),
    "ssim": Metric("SSIM", better="higher"),
    "rotation_error_deg": Metric("rotation error (degrees)"),
    "translation_error": Metric("translation error (x1000)", 1000.0),
}
FURTHER = {  # that tables do not show, but whose direction is known
    **dict.fromkeys(("chamfer_l1", "chamfer_gt_to_pred", "depth_error_capped"), "lower"),
    "mask_iou_least": "higher",
}


def better(name: str) -> str:
    """Which direction of a metric is better: lower, higher, or empty where that is not known."""
    for known in (name, *(name.removeprefix(prefix) for prefix in PREFIXES)):
        if known in SHOWN:
            return SHOWN[known].better
        if known in FURTHER:
            return FURTHER[known]
    return ""
