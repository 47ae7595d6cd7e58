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

PENALTIES = ("sum", "mean", "gaussian")
RIDGE = 1e-3  # of the codes' mean variance, added to each variance, so that no direction costs without bounds

Terms = dict[str, Tensor]


@dataclass(frozen=True)
class CodePenalty:
    """What a code costs.

    Args:
        kind: "sum" or "mean" of the squared numbers (DeepSDF, Eq. 10; DIST, B.4), or "gaussian": the squared
            Mahalanobis distance to the prior's training codes, which knows what varies together.
        weight: of it.
    """

    kind: str
    weight: float

    def __post_init__(self) -> None:
        check_choice("task.code_penalty", self.kind, PENALTIES)
        check_at_least("task.code_weight", self.weight, 0, "0 switches the term off")

    def of(self, prior: Prior, device: torch.device) -> Callable[[Tensor], Tensor]:
        """The weighted penalty as a function of a code [code_length]."""
        if self.kind != "gaussian":
            return lambda code: self.weight * (code.square().sum() if self.kind == "sum" else code.square().mean())
        middle, root = _gaussian(prior.codes)
        middle, root = middle.to(device), root.to(device)
        solve = torch.linalg.solve_triangular
        return lambda code: self.weight * solve(root, (code - middle)[:, None], upper=False).square().sum()


@dataclass
class CodeProblem:
    """A code to be found, from zero, the mean shape. The loss is that of `compare` and the code's own."""

    decoder: Decoder
    penalty: Callable[[Tensor], Tensor]
    compare: Callable[[Field, int], Terms]  # of the counted field and the iteration, to weighted terms
    observed: Bool[Tensor, "height width"]
    rays_per_iteration: int
    code: Float[Tensor, "code_length"]
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
    return CodeProblem(decoder, penalty.of(prior, device), compare, observed.to(device), rays, code)


def _gaussian(codes: Float[Tensor, "shapes n"]) -> tuple[Float[Tensor, " n"], Float[Tensor, "n n"]]:
    """Mean of the codes and the lower Cholesky root of their covariance."""
    if len(codes) < 2:
        raise ValueError(
            "task.code_penalty=gaussian needs a prior of two shapes or more, this has 1: set task.code_penalty=sum"
        )
    centred = codes - codes.mean(0)
    covariance = centred.T @ centred / (len(codes) - 1)
    ridge = RIDGE * covariance.diagonal().mean().clamp_min(torch.finfo(codes.dtype).tiny)
    return codes.mean(0), torch.linalg.cholesky(covariance + ridge * torch.eye(codes.shape[1], dtype=codes.dtype))
