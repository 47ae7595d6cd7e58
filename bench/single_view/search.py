"""The prior's code whose silhouette is that of an image, found by a renderer: optimisation in place of an encoder."""

from dataclasses import dataclass
from typing import ClassVar

import torch

from bench.setup.inputs import RunInputs
from bench.solve.latent_code import CodePenalty, CodeProblem
from bench.solve.observed_view import DEPTH, GivenView
from bench.solve.problem import OptimiserSettings
from datasets.shot import Shot
from renderers.checks import check_at_least
from renderers.silhouette import SilhouetteLoss


@dataclass(frozen=True)
class MaskSearch:
    """How the code is found; the camera is known, and depths are not (DIST, Eq. 5, without its first term).

    Args:
        silhouette: loss of the mask.
        silhouette_weight: of it.
        code: penalty of the code.
        optimiser: iterations and learning rate.
    """

    silhouette: SilhouetteLoss
    silhouette_weight: float
    code: CodePenalty
    optimiser: OptimiserSettings

    depth_loss: ClassVar[str] = DEPTH
    depth_weight: ClassVar[float] = 0.0

    def __post_init__(self) -> None:
        check_at_least("task.search.silhouette_weight", self.silhouette_weight, 0, "10 works")

    def problem(self, shot: Shot, inputs: RunInputs) -> CodeProblem:
        """The problem of an image with a mask; it starts from code zero, the mean shape."""
        size = (shot.camera.height, shot.camera.width)
        none = torch.zeros(size, dtype=torch.bool, device="cpu")
        given = GivenView(self, inputs.renderer, shot.camera.rays(), none.float(), (~none).float(), none, shot.mask).to(
            inputs.device
        )
        return CodeProblem(inputs.prior, self.code, given.compare, none, none.numel(), inputs.device)
