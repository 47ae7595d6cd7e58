"""An inverse problem whose unknown is a prior's code, whatever its loss."""

from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bench.autodecoder import Prior
from renderers.checks import check_at_least, check_choice
from renderers.field import Counts, Field, Meter
from renderers.fields.mlp import Decoder

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
    """A code to be found, from zero, the mean shape. The loss is that of `compare` and the code's own."""

    decoder: Decoder
    penalty: CodePenalty
    compare: Callable[[Field, int], Terms]  # of the counted field and the iteration, to weighted terms
    observed: Bool[Tensor, "height width"]
    rays_per_iteration: int
    code: Float[Tensor, " code_length"]
    counts: Counts = field(default_factory=Counts)

    @property
    def parameters(self) -> list[Tensor]:
        """The code."""
        return [self.code]

    def field(self) -> Field:
        """The shape as it stands."""
        return self.decoder.at(self.code.detach())

    def loss(self, iteration: int) -> Terms:
        """The terms and their sum."""
        terms = self.compare(Meter(self.decoder.at(self.code), self.counts), iteration)
        terms["code"] = self.penalty(self.code)
        return {"total": torch.stack(list(terms.values())).sum(), **terms}


def code_problem(
    prior: Prior,
    penalty: CodePenalty,
    compare: Callable[[Field, int], Terms],
    *,
    observed: Bool[Tensor, "height width"],
    rays: int,
    device: torch.device,
) -> CodeProblem:
    """The problem of finding a prior's code; `rays` is how many of what is compared there are in an iteration."""
    decoder = prior.decoder.to(device).requires_grad_(False)
    code = torch.zeros(decoder.code_length, device=device, requires_grad=True)
    return CodeProblem(decoder, penalty, compare, observed.to(device), rays, code)
