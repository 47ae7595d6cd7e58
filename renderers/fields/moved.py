"""A field under a similarity: the same shape, scaled, turned and shifted; gradients flow to all seven numbers."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from renderers.camera import rigid
from renderers.field import Field, Wrapper


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
        scale = self.similarity[6].exp()
        motion = rigid(self.similarity[:6])
        local = (points - motion[:3, 3]) @ motion[:3, :3] / scale
        return scale * self.inner(local)
