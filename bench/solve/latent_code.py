"""The inverse problem of finding a prior's code, with any loss."""

from collections.abc import Callable
from dataclasses import dataclass, field
from math import log, nan, pi
from typing import ClassVar

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bench.evaluate.evaluate import CHECKPOINT_METRICS, Evaluation, chamfer_only, evaluate
from bench.evaluate.state import State
from bench.shape_prior import Prior
from bench.solve.optimise import CannotContinue, Starts, StartSettings
from bench.solve.pixel_draw import PixelDraw
from renderers.checks import check_at_least, check_choice
from renderers.field import Counts, Field, Meter, Moved

Terms = dict[str, Tensor]
INITIAL_SCALE = 0.8  # if the size is unknown too: below 1, so that the shape can grow and move


def total(terms: Terms) -> Float[Tensor, ""]:
    """The sum of weighted terms."""
    return torch.stack([*terms.values()]).sum()


@dataclass(frozen=True)
class CodePenalty:
    """The penalty on a code (DeepSDF, Eq. 10; DIST, B.4).

    Args:
        weight: of the squared entries.
        average: "sum" of the squares, or "mean".
    """

    weight: float
    average: str

    def __post_init__(self) -> None:
        check_at_least("task.code.weight", self.weight, 0, "0 switches the term off")
        check_choice("task.code.average", self.average, ("sum", "mean"))

    def __call__(self, code: Float[Tensor, " n"]) -> Float[Tensor, ""]:
        """The weighted penalty."""
        squares = code.square()
        return self.weight * (squares.sum() if self.average == "sum" else squares.mean())


def initial_rotations(count: int) -> Float[Tensor, "count 7"]:
    """Similarities, see `renderers.field.Moved`: equally spaced rotations about the y axis, of size `INITIAL_SCALE`."""
    similarities = torch.zeros(count, 7)
    similarities[:, 4] = (torch.arange(count) / count + 0.5) % 1 * 2 * pi - pi
    similarities[:, 6] = log(INITIAL_SCALE)
    return similarities


@dataclass
class CodeProblem:
    """The problem of finding a prior's code, and optionally a similarity.

    Args:
        prior: has the unknown code.
        penalty: on the code.
        compare: returns the weighted terms of the loss of a field at an iteration.
        observed: pixels of the scene's view whose depth is observed.
        rays: number of rays of an iteration; with `draw`, that of each drawn pixel.
        device: of all tensors.
        initial: codes, one per start; None is code zero, the mean shape.
        initial_similarities: one per start, see `renderers.field.Moved`; None does not move the shape.
        trial: see `bench.solve.optimise.StartSettings`.
        photographs: the observed photographs, for pictures.
        progress_measure: a function of a field whose value must fall; None: the loss must fall.
        mask, coloured: whether a mask and colours are observed, for pictures.
        draw: the pixels that each iteration compares.
        held_out: returns the weighted terms of the loss of a field on the held-out pixels of `draw`.
    """

    prior: Prior
    penalty: CodePenalty
    compare: Callable[[Field, int], Terms]
    observed: Bool[Tensor, "height width"]
    rays: int
    device: torch.device
    initial: Float[Tensor, "starts code_length"] | None = None
    initial_similarities: Float[Tensor, "starts 7"] | None = None
    trial: int = 1
    photographs: Float[np.ndarray, "views height width 3"] | None = None
    progress_measure: Callable[[Field], float] | None = None
    mask: bool = True
    coloured: bool = False
    draw: PixelDraw | None = None
    held_out: Callable[[Field], Terms] | None = None
    counts: Counts = field(default_factory=Counts)

    tracked: ClassVar[tuple[str, ...]] = CHECKPOINT_METRICS

    def __post_init__(self) -> None:
        self.decoder = self.prior.decoder.to(self.device).requires_grad_(False)
        self.observed = self.observed.to(self.device)
        initial = torch.zeros(1, self.decoder.code_length) if self.initial is None else self.initial
        self.codes = self._free(initial)
        self.similarities = [] if self.initial_similarities is None else self._free(self.initial_similarities)
        self.parameters = [*self.codes, *self.similarities]
        self.starts = Starts(StartSettings(len(initial), self.trial))

    @property
    def code(self) -> Float[Tensor, " code_length"]:
        """The current code."""
        return self.codes[self.starts.best()]

    @property
    def similarity(self) -> Float[Tensor, "7"] | None:
        """The current similarity; None if it is not optimised."""
        return self.similarities[self.starts.best()].detach().clone() if self.similarities else None

    def field(self) -> Field:
        """The current shape."""
        shape = self.decoder.at(self.code.detach())
        return shape if self.similarity is None else Moved(shape, self.similarity)

    def camera(self) -> None:
        """Returns None: the scene's camera is used."""

    def evaluate(self, state: State) -> Evaluation:
        """The errors of the current shape against the ground truth."""
        return evaluate(state)

    def checkpoint(self, state: State) -> dict[str, float]:
        """The Chamfer distances of the current shape."""
        return chamfer_only(state)

    def loss(self, step: int, start: int = 0) -> Terms:
        """The terms and their sum."""
        penalty = {"code": self.penalty(self.codes[start])}
        try:
            terms = self.compare(Meter(self._shape(start), self.counts), step) | penalty
        except CannotContinue:
            if self.starts.is_alone:
                raise
            terms = {"code": nan * penalty["code"]}  # this start takes no step
        return {"total": total(terms), **terms}

    @property
    def rays_per_iteration(self) -> int:
        """The mean number of rays of an iteration."""
        return self.rays if self.draw is None else self.rays * self.draw.per_iteration

    @torch.no_grad()
    def held_out_loss(self) -> float:
        """The loss of the held-out pixels."""
        assert self.held_out is not None and self.draw is not None
        self.draw.drawn += len(self.draw.held_out)
        return float(total(self.held_out(Meter(self._shape(self.starts.best()), self.counts))))

    @torch.no_grad()
    def objective(self) -> float | None:
        """The current shape's `progress_measure`, not counted as cost; None without it."""
        return None if self.progress_measure is None else self.progress_measure(self._shape(self.starts.best()))

    def _shape(self, start: int) -> Field:
        shape: Field = self.decoder.at(self.codes[start])
        return Moved(shape, self.similarities[start]) if self.similarities else shape

    def _free(self, rows: Float[Tensor, "starts n"]) -> list[Float[Tensor, " n"]]:
        return [row.clone().to(self.device).requires_grad_() for row in rows]
