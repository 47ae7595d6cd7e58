"""The contract of a dataset: numbered closed meshes in three disjoint splits."""

from enum import StrEnum
from typing import Any, Protocol, runtime_checkable

from datasets.mesh import Mesh

SPLIT_STRIDE = 1_000_000  # distance between the seeds of two splits, more than a split has shapes


class Split(StrEnum):
    """Training is for priors, validation for tuning settings, test for results only."""

    TRAIN = "train"
    VALIDATION = "validation"
    TEST = "test"


@runtime_checkable
class Dataset(Protocol):
    """Numbered shapes, each a closed mesh in the unit sphere."""

    name: str

    def mesh(self, split: Split, index: int) -> Mesh:
        """Shape number `index` of a split; always the same one."""
        ...

    def identity(self) -> dict[str, Any]:
        """Plain data that determines the shapes: datasets of equal identity hold the same ones."""
        ...


def seed_of(split: Split, index: int) -> int:
    """The seed of a shape; no two splits share one."""
    if not 0 <= index < SPLIT_STRIDE:
        raise ValueError(f"index must lie between 0 and {SPLIT_STRIDE - 1}, not {index}")
    return list(Split).index(split) * SPLIT_STRIDE + index
