"""Differentiable renderers of implicit surfaces (implicit-bench): from a field and rays to a rendering."""

from renderers.camera import Camera, Rays
from renderers.dist import DIST
from renderers.dvr import DVR
from renderers.field import Field, Kind, Meter
from renderers.idr import IDR
from renderers.later.mesh_proxy import MeshProxy
from renderers.later.neus import NeuS
from renderers.later.range_analysis import RangeAnalysis
from renderers.later.relaxed_boundary import RelaxedBoundary
from renderers.later.unisurf import UNISURF
from renderers.later.volsdf import VolSDF
from renderers.naive import Naive
from renderers.newton.newton import Newton
from renderers.rendering import Capabilities, Renderer, Rendering, Status

__all__ = [
    "DIST",
    "DVR",
    "IDR",
    "UNISURF",
    "Camera",
    "Capabilities",
    "Field",
    "Kind",
    "MeshProxy",
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
