"""The prior that a run asks for, before it is loaded or trained."""

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
from datasets.network_files import SceneNetwork
from datasets.scene import Dataset, OneView, Split
from datasets.textures import Texture
from renderers.checks import BadInput


@dataclass(frozen=True)
class PriorChoice:
    """The prior that a run asks for.

    Args:
        source: settings of its training, or the network whose codes it is.
        dataset: that it is trained on.
        scene_code: number of the scene's shape among the prior's codes; None where it is not one of these.
        exists: False for an object of the user's, such as photographs, where no other prior is named.
    """

    source: PriorSettings | SceneNetwork
    dataset: Dataset | None = None
    scene_code: int | None = None
    exists: bool = True

    @property
    def coloured(self) -> bool:
        """Whether it has colours."""
        return isinstance(self.source, PriorSettings) and self.source.colour is not None

    @property
    def width(self) -> int:
        """Neurons per layer."""
        return self.source.network.width if isinstance(self.source, PriorSettings) else self.source.decoder.width

    @property
    def notes(self) -> tuple[str, ...]:
        """What was measured of a network of others."""
        return () if isinstance(self.source, PriorSettings) else self.source.notes

    def texture(self, dataset: Dataset, split: Split, index: int) -> Texture | None:
        """The colours of a shape; None where the prior has no colours, or one view is all that is known."""
        return (
            self.source.texture(dataset, split, index) if self.coloured and not isinstance(dataset, OneView) else None
        )

    def load(self, folder: Path, device: torch.device, threads: int, progress: Report) -> Prior:
        """Loads the prior; trains it, with these threads, where it is neither shipped nor in the folder."""
        if not isinstance(self.source, PriorSettings):
            return Prior(self.source.decoder, self.source.codes)
        with using_threads(threads):
            return prior_for(self.dataset, self.source, folder, device, progress)


def learnt_dataset(name: str | None) -> Dataset | None:
    """The dataset that `prior.of` names."""
    try:
        return None if name is None else load("dataset", name)
    except ValueError:
        raise BadInput(f"prior.of={name} has no prior: name sofa, plane, table, car or a primitive") from None


@contextmanager
def naming_prior_keys(node: Mapping[str, Any]) -> Iterator[None]:
    """Within it, an error of a dataset's class that stands in for a prior names the keys of that prior."""
    try:
        yield
    except ValueError as error:
        error.args = (re.sub(rf"(?<![\w/])dataset\.(?=(?:{'|'.join(node)})\b)", "prior.", str(error)),)
        raise
