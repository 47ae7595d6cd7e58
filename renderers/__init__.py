"""Differentiable renderers of implicit surfaces. They turn a field and rays into a rendering, and know no task."""

from renderers.camera import Camera, Rays
from renderers.dist import DIST
from renderers.dvr import DVR
from renderers.field import Field, Kind, Meter
from renderers.idr import IDR
from renderers.naive import Naive
from renderers.newton import Newton
from renderers.rendering import Capabilities, Renderer, Rendering, Status

__all__ = [
    "DIST",
    "DVR",
    "IDR",
    "Camera",
    "Capabilities",
    "Field",
    "Kind",
    "Meter",
    "Naive",
    "Newton",
    "Rays",
    "Renderer",
    "Rendering",
    "Status",
]
