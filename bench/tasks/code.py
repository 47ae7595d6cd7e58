"""An inverse problem whose unknown is a prior's code, whatever its loss."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bench.autodecoder import Prior
from bench.starts import Starts, StartSettings
from bench.tasks.problem import NotReached
from renderers.checks import check_at_least, check_choice
from renderers.field import Counts, Field, Meter
from renderers.fields.mlp import Decoder
from renderers.fields.moved import Moved

Terms = dict[str, Tensor]


@dataclass(frozen=True)
class CodePenalty:
    """What a code costs (DeepSDF, Eq. 10; DIST, B.4).

    Args:
        weight: of its squared numbers.
        average: "sum" of them, or "mean".
    """

    weight: float
    average: str

    def __post_init__(self) -> None:
        check_at_least("task.code_weight", self.weight, 0, "0 switches the term off")
        check_choice("task.code_average", self.average, ("sum", "mean"))

    def __call__(self, code: Float[Tensor, " n"]) -> Float[Tensor, ""]:
        """The weighted penalty."""
        squares = code.square()
        return self.weight * (squares.sum() if self.average == "sum" else squares.mean())


@dataclass
class CodeProblem:
    """A code to be found, with a similarity where one is given. The loss is that of `compare` and the code's own."""

    decoder: Decoder
    penalty: CodePenalty
    compare: Callable[[Field, int], Terms]  # of the counted field and the iteration, to weighted terms
    observed: Bool[Tensor, "height width"]
    rays_per_iteration: int
    codes: list[Float[Tensor, " code_length"]]  # one a start
    similarities: list[Float[Tensor, "7"]]  # one a start, or none: see `renderers.fields.moved.Moved`
    starts: Starts
    photographs: Float[np.ndarray, "views height width 3"] | None = None  # that are given, for pictures
    judged_at: int | None = None  # at whose settings first and last loss are compared; None: each at its own
    counts: Counts = field(default_factory=Counts)

    @property
    def parameters(self) -> list[Tensor]:
        """What is free."""
        return [*self.codes, *self.similarities]

    @property
    def code(self) -> Float[Tensor, " code_length"]:
        """The code as it stands."""
        return self.codes[self.starts.best()]

    @property
    def similarity(self) -> Float[Tensor, "7"] | None:
        """The similarity as it stands, where it is free."""
        return self.similarities[self.starts.best()].detach() if self.similarities else None

    def field(self) -> Field:
        """The shape as it stands."""
        shape = self.decoder.at(self.code.detach())
        return shape if self.similarity is None else Moved(shape, self.similarity)

    def loss(self, iteration: int) -> Terms:
        """The terms and their sum."""
        start, own = self.starts.turn(iteration)
        penalty = {"code": self.penalty(self.codes[start])}
        try:
            terms = self.compare(Meter(self._shape(start), self.counts), own) | penalty
        except NotReached:
            if not self.starts.give_up(start, own):
                raise
            return {"total": penalty["code"], **penalty}
        total = torch.stack(list(terms.values())).sum()
        self.starts.note(start, own, total)
        return {"total": total, **terms}

    @torch.no_grad()
    def objective(self) -> float | None:
        """The loss as it stands, at the iteration `judged_at`; it is not counted. None where that is not set."""
        if self.judged_at is None:
            return None
        best = self.starts.best()
        terms = self.compare(self._shape(best), self.judged_at)
        return float(torch.stack(list(terms.values())).sum() + self.penalty(self.codes[best]))

    def _shape(self, start: int) -> Field:
        shape: Field = self.decoder.at(self.codes[start])
        return Moved(shape, self.similarities[start]) if self.similarities else shape


def code_problem(
    prior: Prior,
    penalty: CodePenalty,
    compare: Callable[[Field, int], Terms],
    *,
    observed: Bool[Tensor, "height width"],
    rays: int,
    device: torch.device,
    codes: Float[Tensor, "starts code_length"] | None = None,
    similarities: Float[Tensor, "starts 7"] | None = None,
    trial: int = 1,
) -> CodeProblem:
    """The problem of finding a prior's code.

    Args:
        rays: how many there are in an iteration.
        codes: to start from; none is code zero, the mean shape.
        similarities: to start from; none keeps the shape where it is.
        trial: see `bench.starts.StartSettings`.
    """
    decoder = prior.decoder.to(device).requires_grad_(False)
    first = torch.zeros(1, decoder.code_length) if codes is None else codes
    return CodeProblem(
        decoder,
        penalty,
        compare,
        observed.to(device),
        rays,
        _free(first, device),
        [] if similarities is None else _free(similarities, device),
        Starts(StartSettings(len(first), trial)),
    )


def _free(rows: Float[Tensor, "starts n"], device: torch.device) -> list[Float[Tensor, " n"]]:
    return [row.clone().to(device).requires_grad_() for row in rows]
