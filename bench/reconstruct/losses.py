"""The losses of a reconstruction from images, each a switch (DVR, Sec. 3.4; DIST, B.3; IDR, Sec. 3.4)."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bench.reconstruct.pixels import Pixels
from bench.solve.latent_code import Terms
from bench.solve.observed_view import DEPTH_LOSSES, depth_error, gradients_at, normal_error
from renderers.boundary import rendered
from renderers.camera import Rays
from renderers.checks import BadInput, check_at_least, check_choice
from renderers.field import Field, Kind, Meter
from renderers.fields.coloured import Coloured
from renderers.rendering import Observed, Renderer, Volume
from renderers.silhouette import SilhouetteLoss

ANYWHERE = 512  # points of the cube at which a distance's gradient is measured
BESIDE = 2e-3  # scene units: side of the cube in which a point's neighbour is drawn; DVR's code: 1e-3 of a unit cube


@dataclass(frozen=True)
class Losses:
    """Weights of the terms; 0 leaves a term out. Sums over rays are divided by the number of all rays.

    Args:
        colour: of the l1 norm of colours, over hits on the foreground (DVR, Eq. 12); where a renderer sees a volume, of
            the sums along all rays on the foreground.
        colour_gradient: of the error of their differences to the right and below, of the upper left pixel in patches of
            2 x 2, an l2 norm for each channel (DVR's official code; the paper has no equation for it).
        depth: of the error of given depths over rays that hit (DVR, Eq. 13).
        depth_loss: "depth", or "points", the distance in space.
        silhouette: loss of the mask; DVR, Eqs. 14 and 15, are `silhouette=occupancy`.
        silhouette_weight: of that loss.
        smoothness: of the difference between unit normals at a hit and beside it (DVR, Eq. 16).
        normals: of 1 less the cosine between normals and given ones, the mean over hits (DIST, B.3).
        eikonal: of the squared difference of a distance's slope from 1, at hits on the foreground and in the whole cube
            (IDR, Sec. 3.4), two means. A level set has none.
    """

    colour: float
    colour_gradient: float
    depth: float
    depth_loss: str
    silhouette: SilhouetteLoss
    silhouette_weight: float
    smoothness: float
    normals: float
    eikonal: float

    def __post_init__(self) -> None:
        check_choice("task.losses.depth_loss", self.depth_loss, DEPTH_LOSSES)
        for name in ("colour", "colour_gradient", "depth", "silhouette_weight", "smoothness", "normals", "eikonal"):
            check_at_least(f"task.losses.{name}", getattr(self, name), 0, "0 switches the term off")

    def __call__(self, renderer: Renderer, shape: Coloured, metered: Meter, pixels: Pixels) -> Terms:
        """The weighted terms and their sum, `total`.

        Args:
            renderer: at the current iteration.
            shape: with gradients towards its parameters.
            metered: the same, counted.
            pixels: that are compared; for `colour_gradient` in groups of four, see `Stack.drawn`.
        """
        rendering = rendered(renderer, metered, pixels.rays)
        inside = rendering.hit if pixels.mask is None else rendering.hit & pixels.mask
        points, rays = rendering.points[inside], len(inside)
        slopes = gradients_at(metered, points)
        normals = torch.nn.functional.normalize(slopes, dim=-1)
        terms: Terms = {}
        if self.colour or self.colour_gradient:
            if rendering.volume is None:
                compared, colours = inside, shape.colours(points, slopes, pixels.rays.directions[inside])
            elif pixels.mask is None:
                raise BadInput(f"{type(renderer).__name__} needs masks: without them it would paint what is behind too")
            else:
                compared = pixels.mask
                colours = _summed_colours(shape, metered, pixels.rays, rendering.volume)[compared]
            difference = torch.zeros_like(pixels.colours).index_put((compared,), colours - pixels.colours[compared])
            if self.colour:
                terms["colour"] = self.colour * difference.abs().sum() / rays
            if self.colour_gradient:
                terms["colour_gradient"] = self.colour_gradient * _between_neighbours(difference, compared) / rays
        if self.depth and pixels.distance is not None:
            known = rendering.hit & pixels.distance.isfinite()
            at_one = pixels.at_one[known]
            found, given = (of[known] * at_one for of in (rendering.distance, pixels.distance))
            error = depth_error(self.depth_loss, found, given, at_one)
            terms["depth"] = self.depth * error.sum() / rays
        if self.silhouette_weight and pixels.mask is not None:
            observed = Observed(pixels.mask, pixels.guide)
            loss = self.silhouette(renderer, metered, pixels.rays, rendering, observed)
            terms["silhouette"] = self.silhouette_weight * loss
        if self.smoothness:
            beside = points + BESIDE * (torch.rand_like(points) - 0.5)
            neighbours = torch.nn.functional.normalize(gradients_at(metered, beside), dim=-1)
            terms["smoothness"] = self.smoothness * torch.linalg.vector_norm(normals - neighbours, dim=-1).sum() / rays
        if self.normals and pixels.normals is not None:
            terms["normals"] = self.normals * normal_error(normals, pixels.normals[inside])
        if self.eikonal and shape.kind is not Kind.LEVEL:
            anywhere = 2 * torch.rand(ANYWHERE, 3, device=points.device) - 1
            lengths = [torch.linalg.vector_norm(of, dim=-1) for of in (slopes, gradients_at(metered, anywhere))]
            terms["eikonal"] = self.eikonal * sum((one - 1).square().sum() / max(len(one), 1) for one in lengths)
        if not terms:
            raise BadInput("no term of the loss is left: give a weight of task.losses that the photographs can serve")
        return {"total": torch.stack(list(terms.values())).sum(), **terms}


def _summed_colours(shape: Coloured, field: Field, rays: Rays, volume: Volume) -> Float[Tensor, "n 3"]:
    """The colours that rays see in a volume in front of black: the weighted sums of its samples'."""
    some = rays[volume.ray]
    points = some.at(volume.distance)
    return volume.summed(shape.colours(points, gradients_at(field, points), some.directions), len(rays.origins))


def _between_neighbours(difference: Float[Tensor, "n 3"], inside: Bool[Tensor, " n"]) -> Float[Tensor, ""]:
    """The norm of the upper left pixel's differences to the right and below, over patches of 2 x 2 that are inside."""
    patches, whole = difference.view(-1, 2, 2, 3), inside.view(-1, 4).all(-1)
    corner = patches[:, 0, 0]
    slopes = torch.stack([patches[:, 0, 1] - corner, patches[:, 1, 0] - corner], dim=-1)
    return (torch.linalg.vector_norm(slopes, dim=-1).sum(-1) * whole).sum()
