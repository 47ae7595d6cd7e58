"""Differentiable renderers of implicit surfaces (implicit-bench): from a field and rays to a rendering."""

from renderers.camera import Camera, Rays
from renderers.dist import DIST
from renderers.dvr import DVR
from renderers.field import Field, Kind, Meter
from renderers.idr import IDR
from renderers.naive import Naive
from renderers.newton import Newton
from renderers.range_analysis import RangeAnalysis
from renderers.relaxed_boundary import RelaxedBoundary
from renderers.rendering import Capabilities, Renderer, Rendering, Status
from renderers.volumes.neus import NeuS
from renderers.volumes.unisurf import UNISURF
from renderers.volumes.volsdf import VolSDF

__all__ = [
    "DIST",
    "DVR",
    "IDR",
    "UNISURF",
    "Camera",
    "Capabilities",
    "Field",
    "Kind",
    "Meter",
    "Naive",
    "NeuS",
    "Newton",
    "RangeAnalysis",
    "Rays",
    "RelaxedBoundary",
    "Renderer",
    "Rendering",
    "Status",
    "VolSDF",
]
