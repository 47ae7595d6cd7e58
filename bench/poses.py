"""Camera poses that are to be found: where one starts, and how far off it is."""

from dataclasses import dataclass, replace
from math import atan2, degrees, radians, sqrt

import torch
from jaxtyping import Float
from torch import Tensor

from bench.metrics import DEFINITIONS as IMAGE_DEFINITIONS
from bench.metrics import image_metrics
from datasets.scene import View
from renderers.camera import Camera, rigid
from renderers.checks import check_at_least, check_positive

DEFINITIONS = {
    "rotation_error_deg": "angle of the rotation between the found and the true camera, in degrees",
    "translation_error": "distance between the object's origin as the found and as the true camera have it before them,"
    " in scene units",
    "success": "1 where both errors are at most task.success_degrees and task.success_distance, else 0",
}
JUDGED = DEFINITIONS | {name: IMAGE_DEFINITIONS[name] for name in ("depth_mae", "mask_iou")}


@dataclass(frozen=True)
class PoseStart:
    """Where the search for a camera starts, and what counts as found.

    Args:
        degrees: of the rotation, about a random axis through the object's origin, that the start is off.
        shift: length of the translation, in a random direction, that it is off besides, in scene units.
        starts: how many there are: the one that is given, and others that are turned from it at random.
        spread: largest angle of these turns, in degrees.
        success_degrees, success_distance: errors that still count as found, in degrees and scene units.
    """

    degrees: float
    shift: float
    starts: int
    spread: float
    success_degrees: float
    success_distance: float

    def __post_init__(self) -> None:
        check_at_least("task.starts", self.starts, 1, "1 is the given start alone, 8 repair most failures")
        for name in ("degrees", "spread"):
            if not 0 <= getattr(self, name) <= 180:
                raise ValueError(f"task.{name} must lie between 0 and 180 degrees, not {getattr(self, name)}")
        check_at_least("task.shift", self.shift, 0, "0.1 is a tenth of the object's radius")
        check_positive("task.success_degrees", self.success_degrees, "5 is usual")
        check_positive("task.success_distance", self.success_distance, "0.05 is usual")

    def cameras(self, true: Camera, seed: int) -> list[Camera]:
        """The cameras to start from; the first is off by just the given amounts."""
        generator = torch.Generator().manual_seed(seed)
        axis, direction = _directions(2, generator)
        turned = of_moved_object(true, torch.cat([torch.zeros(3), radians(self.degrees) * axis]))
        given = of_moved_object(turned, torch.cat([self.shift * direction, torch.zeros(3)]))
        angles = radians(self.spread) * torch.rand(self.starts - 1, 1, generator=generator)
        turns = angles * _directions(self.starts - 1, generator)
        return [given, *(of_moved_object(given, torch.cat([torch.zeros(3), turn])) for turn in turns)]

    def metrics(self, found: Camera, true: Camera) -> dict[str, float]:
        """The numbers of `DEFINITIONS`."""
        rotation, translation = pose_error(found, true)
        success = rotation <= self.success_degrees and translation <= self.success_distance
        return {"rotation_error_deg": rotation, "translation_error": translation, "success": float(success)}

    def remarks(self, metrics: dict[str, float]) -> list[str]:
        """What is to be said of the errors of a camera: that it was not found, if so. It changes no status."""
        if metrics["success"]:
            return []
        rotation, distance = metrics["rotation_error_deg"], metrics["translation_error"]
        return [f"the pose was not found: it is {rotation:.1f} degrees and {distance:.3f} scene units off"]

    def judge(self, seen: View, true: View) -> dict[str, float]:
        """The numbers of `JUDGED`: the errors of a camera, and how what it sees differs from what is given."""
        images = image_metrics(seen.depth.numpy(), seen.mask.numpy(), true.depth.numpy(), true.mask.numpy())
        return self.metrics(seen.camera, true.camera) | images


def of_moved_object(camera: Camera, twist: Float[Tensor, "6"]) -> Camera:
    """The camera that sees an unmoved object as this one sees it after a rigid motion; gradients flow to the twist.

    The motion is about the object's origin, so that a turn does not carry it out of the image.

    Args:
        camera: any.
        twist: see `renderers.camera.rigid`.
    """
    return replace(camera, world_to_camera=camera.world_to_camera @ rigid(twist))


def pose_error(found: Camera, true: Camera) -> tuple[float, float]:
    """The angle in degrees and the distance in scene units between two cameras, as `DEFINITIONS` has them."""
    mine, theirs = found.world_to_camera.detach().double().cpu(), true.world_to_camera.double().cpu()
    between = mine[:3, :3] @ theirs[:3, :3].T
    sine, cosine = (between - between.T).norm() / sqrt(8), (between.diagonal().sum() - 1) / 2
    return degrees(atan2(sine.item(), cosine.item())), (mine[:3, 3] - theirs[:3, 3]).norm().item()


def _directions(count: int, generator: torch.Generator) -> Float[Tensor, "count 3"]:
    return torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=1)
