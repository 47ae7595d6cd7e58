"""The errors of a new prior near the surfaces of training and held-out shapes; its record has them."""

import torch
from jaxtyping import Float
from torch import Tensor

from bench.progress import Report
from bench.shape_prior import DistanceSamples, Prior, PriorSettings, distance_samples, truncated
from datasets.scene import Dataset, Split
from renderers.field import LatentDecoder

VALIDATION_SHAPES = 8  # a new prior is evaluated on so many
EVALUATED_DISTANCE = 0.02  # scene units: a prior is evaluated at samples this close to the surface


def prior_errors(
    prior: Prior, dataset: Dataset, samples: DistanceSamples, settings: PriorSettings, progress: Report
) -> dict[str, float]:
    """Mean error near the surface, in scene units, of training and held-out shapes, with newly fitted codes.

    A network of one shape is evaluated at its code.
    """
    if settings.of_one_shape:
        return {"training": surface_error(prior.decoder, prior.codes, samples)}
    count, delta = VALIDATION_SHAPES, settings.truncation
    validation = distance_samples(dataset, Split.VALIDATION, settings, count, progress)
    training = DistanceSamples(samples.points[:count], samples.distances[:count])
    return {
        "training": fit_error(prior.decoder, training, delta),
        "validation": fit_error(prior.decoder, validation, delta),
        "mean_shape": fit_error(prior.decoder, validation, delta, steps=0),
    }


def fit_error(decoder: LatentDecoder, samples: DistanceSamples, truncation: float | None, *, steps: int = 200) -> float:
    """The `surface_error` with codes fitted to the samples from zero.

    Args:
        decoder: is not changed.
        samples: of training or other shapes.
        truncation: see `PriorSettings`.
        steps: of Adam, with a rate that falls to zero; 0 evaluates the mean shape.
    """
    shapes, count = samples.distances.shape
    codes = torch.zeros(shapes, decoder.code_length, requires_grad=True)
    optimiser = torch.optim.Adam([codes], lr=1e-2)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, max(steps, 1))
    rows = torch.arange(shapes)[:, None]
    for _ in range(steps):
        indices = torch.randint(count, (shapes, min(count, 256)))
        field = truncated(decoder.at(codes)(samples.points[rows, indices]), truncation)
        error = (field - truncated(samples.distances[rows, indices], truncation)).abs()
        optimiser.zero_grad()
        error.mean().backward()
        optimiser.step()
        schedule.step()
    return surface_error(decoder, codes, samples)


@torch.no_grad()
def surface_error(
    decoder: LatentDecoder, codes: Float[Tensor, "shapes code_length"], samples: DistanceSamples
) -> float:
    """Mean error of the distance within `EVALUATED_DISTANCE` of the surface, in scene units, at given codes."""
    errors = []
    for code, points, distances in zip(codes, samples.points, samples.distances, strict=True):
        close = distances.abs() < EVALUATED_DISTANCE
        errors.append((decoder.at(code)(points[close]) - distances[close]).abs())
    return torch.cat(errors).mean().item()
