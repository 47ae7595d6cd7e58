"""Shapes that need no network: the mean of the training shapes, the one that looks most alike, and the best of them."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from bench.evaluate.evaluate import Surface, surface_metrics
from bench.progress import Report
from bench.records.files import digest, file_lock
from bench.shape_prior.store import load_whole, save_whole
from bench.single_view.images import ImagesOf
from datasets.dataset import Dataset, Split
from datasets.extract import extract
from datasets.mesh import Mesh
from datasets.truth import Truth, sample_surface
from renderers.fields.grid import Grid

VERSION = 1  # raise it when the mean changes
SAMPLES, REACH = 64, 1.05  # of the mean distance: per axis, and half the cube's side
COMPARED = 2000  # points of a surface in the search for the best shape


def mean_shape(dataset: Dataset, count: int, cache: Path, progress: Report) -> Mesh | None:
    """The zero set of the mean signed distance of the first `count` training shapes, kept in `cache`."""
    settings = {"dataset": dataset.identity(), "count": count, "samples": SAMPLES, "reach": REACH, "version": VERSION}
    name = f"mean-{dataset.name}-{digest(settings)}"
    path = cache / f"{name}.safetensors"
    with file_lock(cache, name):
        tensors = load_whole(path)
        if tensors is None:
            total = np.zeros((SAMPLES,) * 3)
            for index in range(count):
                progress("averaging shapes", index, count)
                total += Truth(dataset.mesh(Split.TRAIN, index)).distance_grid(SAMPLES, REACH)
            tensors = {"values": torch.from_numpy(total / count).float()}
            save_whole(tensors, path)
    return extract(Grid(tensors["values"], REACH), grid=2 * SAMPLES, reach=REACH)


def most_alike(image: Float[Tensor, "4 height width"], images: Sequence[ImagesOf]) -> int:
    """The shape one of whose images has the least mean squared difference from an image, mask included."""
    shown = [torch.stack([one.image(view) for view in range(len(one.cameras))]) for one in images]
    return int(torch.stack([(one - image).square().mean(dim=(1, 2, 3)).min() for one in shown]).argmin())


def best_shape(mesh: Mesh, dataset: Dataset, count: int) -> int:
    """The training shape with the least Chamfer-L1 from a true one: what no retrieval can do better than."""
    true = Surface(*sample_surface(mesh, COMPARED, 0))
    others = (dataset.mesh(Split.TRAIN, index) for index in range(count))
    scores = [surface_metrics(Surface(*sample_surface(m, COMPARED, 1)), true, threshold=1.0) for m in others]
    return int(np.argmin([score["chamfer_l1"] for score in scores]))
