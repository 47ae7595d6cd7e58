"""The prior that a run's configuration selects, before it is loaded or trained."""

import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from bench.config import load
from bench.machine.environment import using_threads
from bench.progress import Report
from bench.shape_prior import Prior, PriorSettings, prior_for
from datasets.scene import Dataset, OneView, SceneNetwork, Split
from datasets.textures import Texture
from renderers.checks import BadInput


@dataclass(frozen=True)
class PriorChoice:
    """The prior that a run's configuration selects.

    Args:
        source: settings of its training, or a trained network with codes.
        dataset: of its training shapes.
        scene_code: index of the scene's shape among the prior's codes; None if the prior was not trained on it.
        exists: False for an object of the user, such as photographs, if no other prior is named.
    """

    source: PriorSettings | SceneNetwork
    dataset: Dataset | None = None
    scene_code: int | None = None
    exists: bool = True

    @property
    def coloured(self) -> bool:
        return isinstance(self.source, PriorSettings) and self.source.colour is not None

    @property
    def width(self) -> int:
        return self.source.network.width if isinstance(self.source, PriorSettings) else self.source.decoder.width

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes on the measurements of a network of others."""
        return () if isinstance(self.source, PriorSettings) else self.source.notes

    def texture(self, dataset: Dataset, split: Split, index: int) -> Texture | None:
        """The colours of a shape; None if the prior has no colours, or the dataset only one view."""
        has_colours = self.coloured and not isinstance(dataset, OneView)
        return self.source.colour.texture_of(dataset, split, index) if has_colours else None

    def load(self, folder: Path, device: torch.device, threads: int, progress: Report) -> Prior:
        """Loads the prior; trains it with these threads if it is neither shipped nor in the folder."""
        if not isinstance(self.source, PriorSettings):
            return Prior(self.source.decoder, self.source.codes)
        with using_threads(threads):
            return prior_for(self.dataset, self.source, folder, device, progress)


def training_dataset(name: str | None) -> Dataset | None:
    """The dataset named by `prior.of`; None without a name."""
    try:
        return None if name is None else load("dataset", name)
    except ValueError:
        raise BadInput(f"prior.of={name} has no prior: name sofa, plane, table, car or a primitive") from None


@contextmanager
def prior_keys_in_errors(node: Mapping[str, Any]) -> Iterator[None]:
    """Context in which errors name keys of the prior, not of the dataset whose class provides it."""
    try:
        yield
    except ValueError as error:
        error.args = (re.sub(rf"(?<![\w/])dataset\.(?=(?:{'|'.join(node)})\b)", "prior.", str(error)),)
        raise
