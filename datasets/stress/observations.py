"""Observations of a view for a fit, and disturbances of them."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from renderers.camera import Camera


@dataclass(frozen=True)
class Observation:
    """The observations given to a fit."""

    camera: Camera  # assumed by the fit
    depth: Float[Tensor, "height width"]
    observed: Bool[Tensor, "height width"]
    mask: Bool[Tensor, "height width"]


Disturb = Callable[[Observation, float, np.random.Generator], Observation]


def depth_noise(given: Observation, severity: float, draw: np.random.Generator) -> Observation:
    """Normal noise of a standard deviation, in scene units, on each depth."""
    noise = torch.from_numpy(draw.normal(size=given.depth.shape)).float()
    return replace(given, depth=given.depth + severity * noise)


def depth_outliers(given: Observation, severity: float, draw: np.random.Generator) -> Observation:
    """A share of the depths is replaced by random ones between 1.5 and 3.5."""
    wild = torch.from_numpy(draw.uniform(1.5, 3.5, given.depth.shape)).float()
    return replace(given, depth=torch.where(_drawn(given, severity, draw), wild, given.depth))


def depth_steps(given: Observation, severity: float, draw: np.random.Generator) -> Observation:
    """Depths are rounded to multiples of a step, in scene units."""
    return replace(given, depth=severity * torch.round(given.depth / severity))


def missing_depth(given: Observation, severity: float, draw: np.random.Generator) -> Observation:
    """A share of the depths is missing."""
    return replace(given, observed=given.observed & ~_drawn(given, severity, draw))


def mask_errors(given: Observation, severity: float, draw: np.random.Generator) -> Observation:
    """A share of the mask's pixels is wrong; the depths are unchanged."""
    return replace(given, mask=given.mask ^ _drawn(given, severity, draw))


def wrong_focal_length(given: Observation, severity: float, draw: np.random.Generator) -> Observation:
    """The assumed focal length is too long by a share."""
    return replace(given, camera=given.camera.zoomed(1 + severity))


def wrong_pose(given: Observation, severity: float, draw: np.random.Generator) -> Observation:
    """The assumed camera is turned about its centre by an angle, in degrees."""
    axis = draw.normal(size=3)
    turn = torch.from_numpy(np.radians(severity) * axis / np.linalg.norm(axis)).float()
    return replace(given, camera=given.camera.moved(torch.cat([torch.zeros(3), turn])))


DISTURBANCES: dict[str, Disturb] = {
    function.__name__: function
    for function in (
        depth_noise, depth_outliers, depth_steps, missing_depth, mask_errors, wrong_focal_length, wrong_pose,
    )
}  # fmt: skip


def _drawn(given: Observation, share: float, draw: np.random.Generator) -> Bool[Tensor, "height width"]:
    return torch.from_numpy(draw.uniform(size=given.depth.shape) < share)
