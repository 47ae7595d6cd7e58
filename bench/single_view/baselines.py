"""Shapes that need no network: of the training shapes the mean, the most alike and the best; and a prior's code."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from bench.evaluate.evaluate import surface_metrics
from bench.evaluate.state import REACH
from bench.progress import Report
from bench.records.record import digest
from bench.setup.inputs import RunInputs
from bench.shape_prior import kept
from bench.single_view.images import ImagesOf
from bench.solve.latent_code import CodePenalty, CodeProblem
from bench.solve.observed_view import DEPTH, ObservedView
from bench.solve.optimise import OptimiserSettings
from datasets.mesh import Mesh, extract
from datasets.scene import Dataset, Split, Truth, sample_surface
from datasets.shot import Shot
from renderers.boundary import rendered
from renderers.checks import check_at_least
from renderers.field import Field
from renderers.fields.grid import Grid
from renderers.silhouette import SilhouetteLoss

VERSION = 1  # raise it when the mean changes
SAMPLES = 64  # of the mean distance, per axis
COMPARED = 2000  # points of a surface in the search for the best shape


def mean_shape(dataset: Dataset, count: int, cache: Path, progress: Report) -> Mesh | None:
    """The zero set of the mean signed distance of the first `count` training shapes, kept in `cache`."""
    settings = {"dataset": dataset.identity(), "count": count, "samples": SAMPLES, "reach": REACH, "version": VERSION}
    name = f"mean-{dataset.name}-{digest(settings)}"

    def make() -> dict[str, Tensor]:
        total = np.zeros((SAMPLES,) * 3)
        for index in range(count):
            progress("averaging shapes", index, count)
            total += Truth(dataset.mesh(Split.TRAIN, index)).distance_grid(SAMPLES, REACH)
        return {"values": torch.from_numpy(total / count).float()}

    return extract(Grid(kept(cache, name, make)["values"], REACH), grid=2 * SAMPLES, reach=REACH)


def most_alike(image: Float[Tensor, "4 height width"], images: Sequence[ImagesOf]) -> int:
    """The shape one of whose images has the least mean squared difference from an image, mask included."""
    return int(torch.stack([(one.images() - image).square().mean(dim=(1, 2, 3)).min() for one in images]).argmin())


def best_shape(mesh: Mesh, dataset: Dataset, count: int) -> int:
    """The training shape with the least Chamfer-L1 from a true one: what no retrieval can do better than."""
    true = sample_surface(mesh, COMPARED, 0)
    others = (dataset.mesh(Split.TRAIN, index) for index in range(count))
    scores = [surface_metrics(sample_surface(m, COMPARED, 1), true, threshold=1.0) for m in others]
    return int(np.argmin([score["chamfer_l1"] for score in scores]))


@dataclass(frozen=True)
class MaskSearch:
    """How a renderer finds the prior's code whose silhouette is that of an image, in place of an encoder.

    The camera is known, and depths are not (DIST, Eq. 5, without its first term).

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
    least_reference: ClassVar[float] = 0.01  # see `optimise`: a start that covers the mask has next to no loss

    def __post_init__(self) -> None:
        check_at_least("task.search.silhouette_weight", self.silhouette_weight, 0, "10 works")

    def problem(self, shot: Shot, inputs: RunInputs) -> CodeProblem:
        """The problem of an image with a mask; it starts from code zero, the mean shape.

        The share of pixels whose hit differs from the mask must fall, not the loss: DIST's is a mean over wrong pixels,
        of which a hit beside the mask weighs no more than the march's epsilon. So it is next to nothing for a mean
        shape that covers the mask, and rises where these pixels are mended first.
        """
        size = (shot.camera.height, shot.camera.width)
        none = torch.zeros(size, dtype=torch.bool, device="cpu")
        given = ObservedView(
            self, inputs.renderer, shot.camera.rays(), none.float(), (~none).float(), none, shot.mask
        ).to(inputs.device)

        def wrong_fraction(field: Field) -> float:
            return float((rendered(inputs.renderer, field, given.rays).hit != given.mask).float().mean())

        return CodeProblem(
            inputs.prior, self.code, given.compare, none, none.numel(), inputs.device, progress_measure=wrong_fraction
        )
