"""A renderer that fails on request, in each way in which a run can fail."""

import ctypes
import os
import re
import signal
import time

import torch

from renderers import IDR, Capabilities, Kind
from renderers.boundary import RENDERING_TENSORS
from renderers.rendering import Rendering


class Failing:
    """IDR, except that its third rendering with a gradient fails; a wrong silhouette loss is wrong from the start.

    Args:
        how: the way to fail, one of FAILURES.
        pause: seconds before each rendering.
        limits: seconds for each way to fail. Unused here: the `time_limit` of a sweep over `how` refers to it.
    """

    capabilities = Capabilities(needs=(Kind.DISTANCE,), field_gradient=True, ray_gradient=True)

    def __init__(self, how: str = "not", pause: float = 0.0, limits: dict | None = None):
        self.how, self.pause, self.renderings = how, pause, 0
        self.tracer = IDR(
            steps=10, epsilon=1e-3, least_slope=1e-3, mask_sharpness=50.0, mask_weight=100.0, sphere_radius=1.0
        )

    def render(self, field, rays):
        time.sleep(self.pause)
        rendering = self.tracer.render(field, rays)
        self.renderings += torch.is_grad_enabled()
        return FAILURES[self.how](rendering) if self.renderings == 3 else rendering

    def silhouette_loss(self, field, rays, rendering, mask):
        loss = self.tracer.silhouette_loss(field, rays, rendering, mask)
        return LOSSES.get(self.how, lambda loss: loss)(loss)


def _raise(rendering: Rendering) -> Rendering:
    raise RuntimeError("it failed on request")


def _not_a_number(rendering: Rendering) -> Rendering:
    return Rendering(**{**vars(rendering), "distance": rendering.distance * float("nan")})


def _short(rendering: Rendering) -> Rendering:
    return Rendering(**{name: getattr(rendering, name)[:-1] for name in RENDERING_TENSORS})


def _loop(rendering: Rendering) -> Rendering:
    while True:
        time.sleep(0.1)


def _native_loop(rendering: Rendering) -> Rendering:
    re.match("(a+)+$", "a" * 60 + "b")  # for years, without letting another thread run
    return rendering


def _leave(rendering: Rendering) -> Rendering:
    os._exit(0)


def _kill(rendering: Rendering) -> Rendering:
    os.kill(os.getpid(), signal.SIGKILL)
    return rendering


def _terminate(rendering: Rendering) -> Rendering:
    os.kill(os.getpid(), signal.SIGTERM)  # as a batch system does
    time.sleep(10)
    return rendering


def _segfault(rendering: Rendering) -> Rendering:
    ctypes.string_at(0)
    return rendering


def _hog(rendering: Rendering) -> Rendering:
    tensors = []
    while True:
        tensors.append(torch.ones(2**24))  # 64 MiB, written to


_WAYS = (_raise, _not_a_number, _short, _loop, _native_loop, _leave, _kill, _terminate, _segfault, _hog)
FAILURES = {way.__name__[1:]: way for way in _WAYS} | dict.fromkeys(
    ("not", "detached_loss"), lambda rendering: rendering
)
LOSSES = {"detached_loss": lambda loss: loss.detach() + 1}
