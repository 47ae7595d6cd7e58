"""An inverse problem whose unknown is a prior's code, with any loss."""

from collections.abc import Callable
from dataclasses import dataclass, field
from math import log, pi
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bench.evaluate.evaluate import CHECKPOINT_METRICS, Evaluation, chamfer_only, evaluate
from bench.evaluate.state import State
from bench.pictures.run_figures import InputView, draw_run
from bench.shape_prior import Prior
from bench.solve.optimise import NotReached, Starts, StartSettings
from renderers.checks import check_at_least, check_choice
from renderers.field import Counts, Field, Meter, Moved

Terms = dict[str, Tensor]
BEGUN = 0.8  # size of a prior's shape against its own, where its size is looked for: it may grow, and move aside


@dataclass(frozen=True)
class CodePenalty:
    """The penalty of a code (DeepSDF, Eq. 10; DIST, B.4).

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


def turned(count: int) -> Float[Tensor, "count 7"]:
    """Similarities, see `renderers.field.Moved`: evenly spaced rotations about the vertical axis, of size `BEGUN`."""
    found = torch.zeros(count, 7)
    found[:, 4] = (torch.arange(count) / count + 0.5) % 1 * 2 * pi - pi
    found[:, 6] = log(BEGUN)
    return found


@dataclass
class CodeProblem:
    """The problem of finding a prior's code, and a similarity where one is given.

    Args:
        prior: whose code is sought.
        penalty: of the code.
        compare: gives the weighted terms of the loss, at a counted field and an iteration.
        observed: pixels of the scene's view whose depth is given.
        rays_per_iteration: their number.
        device: of all tensors.
        initial: codes, one per start; None is code zero, the mean shape.
        misplaced: initial similarities, one per start, see `renderers.field.Moved`; None keeps the shape.
        trial: see `bench.solve.optimise.StartSettings`.
        photographs: the given ones, for pictures.
        compared_at: iteration at which the first and the last loss are evaluated; None: each at its own.
        judged: gives of a field what must fall in place of the loss; None: the loss.
        mask, coloured: whether a mask is given, and colours, for pictures.
    """

    prior: Prior
    penalty: CodePenalty
    compare: Callable[[Field, int], Terms]
    observed: Bool[Tensor, "height width"]
    rays_per_iteration: int
    device: torch.device
    initial: Float[Tensor, "starts code_length"] | None = None
    misplaced: Float[Tensor, "starts 7"] | None = None
    trial: int = 1
    photographs: Float[np.ndarray, "views height width 3"] | None = None
    compared_at: int | None = None
    judged: Callable[[Field], float] | None = None
    mask: bool = True
    coloured: bool = False
    counts: Counts = field(default_factory=Counts)

    tracked: ClassVar[tuple[str, ...]] = CHECKPOINT_METRICS
    shown: ClassVar[None] = None

    def __post_init__(self) -> None:
        self.decoder = self.prior.decoder.to(self.device).requires_grad_(False)
        self.observed = self.observed.to(self.device)
        first = torch.zeros(1, self.decoder.code_length) if self.initial is None else self.initial
        self.codes = self._free(first)
        self.similarities = [] if self.misplaced is None else self._free(self.misplaced)
        self.parameters = [*self.codes, *self.similarities]
        self.starts = Starts(StartSettings(len(first), self.trial))

    @property
    def code(self) -> Float[Tensor, " code_length"]:
        """The current code."""
        return self.codes[self.starts.best()]

    @property
    def similarity(self) -> Float[Tensor, "7"] | None:
        """The current similarity, where it is optimised."""
        return self.similarities[self.starts.best()].detach().clone() if self.similarities else None

    def field(self) -> Field:
        """The current shape."""
        shape = self.decoder.at(self.code.detach())
        return shape if self.similarity is None else Moved(shape, self.similarity)

    def camera(self) -> None:
        """None: the scene's camera sees the shape."""

    def evaluate(self, state: State) -> Evaluation:
        """The current shape against the truth."""
        return evaluate(state)

    def checkpoint(self, state: State) -> dict[str, float]:
        """The Chamfer distances of the current shape."""
        return chamfer_only(state)

    def draw(self, folder: Path, states: tuple[State, State], curve: list[dict[str, Any]], title: str) -> None:
        """Writes the pictures of the run; see `bench.solve.solve.Problem`."""
        view, observed = states[0].inputs.scene.given()[0], self.observed.cpu().numpy()
        given = InputView(view, observed, self.photographs, self.mask, self.coloured)
        draw_run(folder, states, given, curve, title)

    def loss(self, iteration: int) -> Terms:
        """The terms and their sum."""
        start, step = self.starts.turn(iteration)
        penalty = {"code": self.penalty(self.codes[start])}
        try:
            terms = self.compare(Meter(self._shape(start), self.counts), step) | penalty
        except NotReached:
            if not self.starts.give_up(start, step):
                raise
            return {"total": penalty["code"], **penalty}
        total = torch.stack(list(terms.values())).sum()
        self.starts.note(start, step, total)
        return {"total": total, **terms}

    @torch.no_grad()
    def objective(self) -> float | None:
        """What `judged` gives, or the current loss at iteration `compared_at`, not counted; None without either."""
        best = self.starts.best()
        if self.judged is not None:
            return self.judged(self._shape(best))
        if self.compared_at is None:
            return None
        terms = self.compare(self._shape(best), self.compared_at)
        return float(torch.stack(list(terms.values())).sum() + self.penalty(self.codes[best]))

    def _shape(self, start: int) -> Field:
        shape: Field = self.decoder.at(self.codes[start])
        return Moved(shape, self.similarities[start]) if self.similarities else shape

    def _free(self, rows: Float[Tensor, "starts n"]) -> list[Float[Tensor, " n"]]:
        return [row.clone().to(self.device).requires_grad_() for row in rows]
