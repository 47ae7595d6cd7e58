"""A renderer whose hits are wrong on request, in each way that the first check of a run looks for."""

from dataclasses import replace

import torch

from bench.config import load
from renderers.rendering import Rendering

ENDLESS_HITS = 11


class WrongHits:
    """A shipped renderer, named by `name`, whose hits have wrong distances: `how` is one of WRONG."""

    def __init__(self, how: str = "short", name: str = "dist") -> None:
        self.how, self.inner = how, load("renderer", name)
        self.capabilities = self.inner.capabilities

    def render(self, field, rays):
        rendering = self.inner.render(field, rays)
        distance = WRONG[self.how](rendering)
        return replace(rendering, distance=distance, points=rays.at(distance))

    def silhouette_loss(self, field, rays, rendering, mask):
        return self.inner.silhouette_loss(field, rays, rendering, mask)


def _endless(rendering: Rendering) -> torch.Tensor:
    hits = rendering.hit.flatten().nonzero().squeeze(-1)[:ENDLESS_HITS]
    factor = torch.ones_like(rendering.distance).flatten().index_fill(0, hits, torch.nan)
    return rendering.distance * factor.view_as(rendering.distance)


WRONG = {
    "short": lambda rendering: 0.95 * rendering.distance,
    "behind": lambda rendering: -rendering.distance,
    "endless": _endless,
}
