"""The metrics that readers are shown first: their names in words, their factor and which direction is better."""

from typing import NamedTuple


class Metric(NamedTuple):
    """A metric of records as readers see it; `better` is lower, higher, or empty where neither is."""

    key: str
    label: str
    factor: float = 1.0
    better: str = ""


COMPARED = (  # before and after an optimisation
    Metric("chamfer_l2", "Chamfer (x1000)", 1000.0, "lower"),
    Metric("seen_chamfer_l1", "Chamfer-L1 of what is seen (x1000)", 1000.0, "lower"),
    Metric("accuracy", "accuracy (x1000)", 1000.0, "lower"),
    Metric("completeness", "completeness (x1000)", 1000.0, "lower"),
    Metric("fscore", "F-score", 1.0, "higher"),
    Metric("normal_consistency", "normal consistency", 1.0, "higher"),
    Metric("iou", "IoU of volumes", 1.0, "higher"),
    Metric("fitted_mask_iou", "mask IoU from the best view", 1.0, "higher"),
    Metric("depth_mae", "depth error (x1000)", 1000.0, "lower"),
    Metric("mask_iou", "mask IoU", 1.0, "higher"),
    Metric("psnr", "PSNR (dB)", 1.0, "higher"),
    Metric("ssim", "SSIM", 1.0, "higher"),
    Metric("rotation_error_deg", "rotation error (degrees)", 1.0, "lower"),
    Metric("translation_error", "translation error (x1000)", 1000.0, "lower"),
)
MEASURED = (  # of tasks that optimise nothing
    Metric("forward_seconds", "forward (s)", 1.0, "lower"),
    Metric("step_seconds", "step (s)", 1.0, "lower"),
    Metric("queries", "values of a rendering", 1.0, "lower"),
    Metric("error_p95", "depth error, 95 % (x1000)", 1000.0, "lower"),
    Metric("breakdown", "breaks at"),
    Metric("trials", "trials"),
    Metric("recommended_error", "error of the chosen field (x1000)", 1000.0, "lower"),
    Metric("frontal.code_pooled_cosine", "gradient's cosine, frontal", 1.0, "higher"),
    Metric("grazing.code_pooled_cosine", "gradient's cosine, grazing", 1.0, "higher"),
    Metric("silhouette.image_cosine", "cosine at the outline", 1.0, "higher"),
)
# The metric that a task's runs are sorted by; of a task that is not here the first of these that its runs have.
FIRST = {
    "pose": "rotation_error_deg",
    "pose_icp": "rotation_error_deg",
    "reconstruction": "seen_chamfer_l1",
    "single_view": "iou",
    "ablation": "step_seconds",
}
