"""Differentiable renderers of implicit surfaces (implicit-bench): from a field and rays to a rendering."""

from typing import TYPE_CHECKING, Any

from renderers.camera import Camera, Rays
from renderers.dist import DIST
from renderers.dvr import DVR
from renderers.field import Field, Kind, Meter
from renderers.idr import IDR
from renderers.later.neus import NeuS
from renderers.later.range_analysis import RangeAnalysis
from renderers.later.relaxed_boundary import RelaxedBoundary
from renderers.later.unisurf import UNISURF
from renderers.later.volsdf import VolSDF
from renderers.naive import Naive
from renderers.newton import Newton
from renderers.rendering import Capabilities, Renderer, Rendering, Status

if TYPE_CHECKING:
    from renderers.later.mesh_proxy import MeshProxy

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


def __getattr__(name: str) -> Any:
    """Imports MeshProxy at its first use: open3d and scikit-image take more than a second."""
    if name == "MeshProxy":
        from renderers.later.mesh_proxy import MeshProxy

        return MeshProxy
    raise AttributeError(f"module 'renderers' has no attribute {name!r}")
