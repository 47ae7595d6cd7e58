"""A field under a similarity: the same shape, scaled, turned and shifted; gradients flow to all seven numbers."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from renderers.camera import rigid
from renderers.field import Bounds, Field, Wrapper, bounds_of


@dataclass(frozen=True)
class Moved(Wrapper):
    """A shape that was scaled, then moved: world = M (scale * local); values stay distances.

    Args:
        inner: the shape in its own axes.
        similarity: the six numbers of the rigid motion M, see `renderers.camera.rigid`, and the natural logarithm of
            the scale.
    """

    inner: Field
    similarity: Float[Tensor, "7"]

    def __call__(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        scale, motion = self._parts
        return scale * self.inner((points - motion[:3, 3]) @ motion[:3, :3] / scale)

    @property
    def bounds(self) -> Bounds | None:
        """The bounds that the field offers, moved as it is."""
        offered = bounds_of(self.inner)
        if offered is None:
            return None
        scale, motion = (part.detach() for part in self._parts)

        def bounds(middle: Tensor, half: Tensor) -> tuple[Tensor, Tensor]:
            turned = motion[:3, :3] / scale
            low, high = offered((middle - motion[:3, 3]) @ turned, half @ turned)
            return scale * low, scale * high

        return bounds

    @property
    def _parts(self) -> tuple[Tensor, Tensor]:
        return self.similarity[6].exp(), rigid(self.similarity[:6])
