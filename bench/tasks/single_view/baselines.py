"""Baselines without a single-view network: the mean, most similar and best training shape, and a prior's code."""

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
from bench.shape_prior import load_or_make
from bench.solve.latent_code import CodePenalty, CodeProblem
from bench.solve.observed_view import DEPTH, ObservedView
from bench.solve.optimise import OptimiserSettings
from bench.tasks.single_view.images import ShapeImages
from datasets.mesh import Mesh, extract
from datasets.scene import Dataset, Split, Truth, sample_surface
from datasets.shot import Shot
from renderers.boundary import render_checked
from renderers.checks import check_at_least
from renderers.field import Field
from renderers.fields.grid import Grid
from renderers.silhouette import SilhouetteLoss

VERSION = 1  # raise it when the mean changes
GRID_SAMPLES = 64  # per axis, of the mean distance
COMPARED_POINTS = 2000  # per surface, in the search for the best shape


def mean_shape(dataset: Dataset, count: int, cache: Path, progress: Report) -> Mesh | None:
    """The zero set of the mean signed distance of the first `count` training shapes, stored in `cache`."""
    grid = {"samples": GRID_SAMPLES, "reach": REACH}
    name = f"mean-{dataset.name}-{digest({'dataset': dataset.identity(), 'count': count, **grid, 'version': VERSION})}"

    def make() -> dict[str, Tensor]:
        total = np.zeros((GRID_SAMPLES,) * 3)
        for index in range(count):
            progress("averaging shapes", index, count)
            total += Truth(dataset.mesh(Split.TRAIN, index)).distance_grid(GRID_SAMPLES, REACH)
        return {"values": torch.from_numpy(total / count).float()}

    return extract(Grid(load_or_make(cache, name, make)["values"], REACH), grid=2 * GRID_SAMPLES, reach=REACH)


def most_similar_shape(image: Float[Tensor, "4 height width"], images: Sequence[ShapeImages]) -> int:
    """The index of the shape with the image most similar to `image`: smallest mean squared difference, with mask."""
    return int(torch.stack([(shape.images() - image).square().mean(dim=(1, 2, 3)).min() for shape in images]).argmin())


def best_shape(mesh: Mesh, dataset: Dataset, count: int) -> int:
    """The index of the training shape with the smallest Chamfer-L1 to a true shape: the best possible retrieval."""
    true = sample_surface(mesh, COMPARED_POINTS, 0)
    shapes = (dataset.mesh(Split.TRAIN, index) for index in range(count))
    scores = [surface_metrics(sample_surface(m, COMPARED_POINTS, 1), true, threshold=1.0) for m in shapes]
    return int(np.argmin([score["chamfer_l1"] for score in scores]))


@dataclass(frozen=True)
class MaskSearch:
    """Finds the prior's code for the silhouette of an image with a renderer, in place of an encoder.

    The camera is known, depths are unknown (DIST, Eq. 5, without its first term).

    Args:
        silhouette: loss between silhouette and mask.
        silhouette_weight: of this loss.
        code: penalty on the code.
        optimiser: iterations and learning rate.
    """

    silhouette: SilhouetteLoss
    silhouette_weight: float
    code: CodePenalty
    optimiser: OptimiserSettings

    depth_loss: ClassVar[str] = DEPTH
    depth_weight: ClassVar[float] = 0.0
    least_reference: ClassVar[float] = 0.01  # see `optimise`: a start that covers the mask has almost no loss

    def __post_init__(self) -> None:
        check_at_least("task.search.silhouette_weight", self.silhouette_weight, 0, "10 works")

    def problem(self, shot: Shot, inputs: RunInputs) -> CodeProblem:
        """The problem of an image with a mask; it starts from code zero, the mean shape.

        The fraction of wrong pixels must fall, not the loss. DIST's loss is a mean over wrong pixels, where a spurious
        pixel weighs at most the march's epsilon. It is almost zero for a mean shape that covers the mask, and rises
        when the spurious pixels disappear first.
        """
        size = (shot.camera.height, shot.camera.width)
        none, rays = torch.zeros(size, dtype=torch.bool, device="cpu"), shot.camera.rays()
        view = ObservedView(self, inputs.renderer, rays, none.float(), (~none).float(), none, shot.mask)
        view = view.to(inputs.device)

        def wrong(field: Field) -> float:
            return float((render_checked(inputs.renderer, field, view.rays).hit != view.mask).float().mean())

        arguments = (inputs.prior, self.code, view.compare, none, none.numel(), inputs.device)
        return CodeProblem(*arguments, progress_measure=wrong)
