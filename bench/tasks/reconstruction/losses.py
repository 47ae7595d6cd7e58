"""The losses of a reconstruction from images, each optional (DVR, Sec. 3.4; DIST, B.3; IDR, Sec. 3.4)."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from bench.solve.latent_code import Terms, total
from bench.solve.observed_view import DEPTH_LOSSES, depth_error, normal_error
from bench.solve.pixel_area import observation_of
from bench.tasks.reconstruction.background import Background
from bench.tasks.reconstruction.pixels import Pixels
from renderers.boundary import render_checked
from renderers.camera import Rays
from renderers.checks import BadInput, check_at_least, check_choice, check_positive
from renderers.field import Coloured, Field, Kind, Meter, gradients_at
from renderers.rendering import RayObservation, Renderer, Rendering, Volume
from renderers.silhouette import SilhouetteLoss

CUBE_POINTS = 512  # random points of the cube, for `eikonal` and `heat`
BLENDED, SAMPLES = COLOURS = ("blended", "samples")
NEIGHBOUR_CUBE_SIDE = 2e-3  # scene units: a neighbour is drawn in this cube; DVR's code: 1e-3 of a unit cube


@dataclass(frozen=True)
class Losses:
    """Weights of the terms; 0 leaves a term out. Sums over rays are divided by the number of all rays.

    With several rays per pixel, the colour of a pixel is the mean over its rays; a surface's, over those that hit. With
    masks, only pixels that the object fills are compared. Colour errors are divided by the number of pixels. The
    silhouette loss compares covered fractions (`bench.solve.pixel_area`).

    Args:
        colour: weight of the l1 error of colours, over hits on the foreground (DVR, Eq. 12). Volume renderers: of the
            colours summed along all rays on the foreground.
        colour_gradient: weight of the error of colour differences to the right and below, of the upper left pixel in
            patches of 2 x 2, an l2 norm for each channel (DVR's official code; the paper has no equation for it).
        depth: weight of the error of given depths over rays that hit (DVR, Eq. 13).
        depth_loss: "depth", or "points", the distance in space.
        silhouette: the silhouette loss; DVR, Eqs. 14 and 15, are `silhouette=occupancy`.
        silhouette_weight: weight of the silhouette loss.
        smoothness: weight of the difference between unit normals at a hit and at a random neighbour (DVR, Eq. 16).
        normals: weight of 1 minus the cosine between normals and given ones, the mean over hits (DIST, B.3).
        eikonal: weight of the squared difference of a distance's slope from 1, two means: at hits on the foreground and
            in the cube (IDR, Sec. 3.4). A level set has none.
        colour_of: what a volume renderer compares: "blended", the colour summed along a ray, or "samples", each
            sample's colour, where the errors are weighted and not the colours. The light that passes all samples is
            compared as black ("Radiance Surfaces", arXiv 2501.18627: the loss of each sample as a surface).
        heat: weight of the heat loss of a distance u, the mean in the cube of exp(-2 rate |u|) (|grad u|^2 + 1) / 2
            (HotSpot, Wang et al., CVPR 2025, arXiv 2411.14628). A level set has none.
        heat_rate: absorption of the heat, per scene unit: the loss acts within about its inverse of the surface.
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
    colour_of: str = BLENDED
    heat: float = 0.0
    heat_rate: float = 10.0

    def __post_init__(self) -> None:
        check_choice("task.losses.depth_loss", self.depth_loss, DEPTH_LOSSES)
        check_choice("task.losses.colour_of", self.colour_of, COLOURS)
        if self.colour_of == SAMPLES and self.colour_gradient:
            raise ValueError("task.losses.colour_gradient compares blended colours: 0 suits colour_of=samples")
        check_positive("task.losses.heat_rate", self.heat_rate, "10 acts within 0.1 scene units of the surface")
        weights = (
            "colour",
            "colour_gradient",
            "depth",
            "silhouette_weight",
            "smoothness",
            "normals",
            "eikonal",
            "heat",
        )
        for name in weights:
            check_at_least(f"task.losses.{name}", getattr(self, name), 0, "0 switches the term off")

    def __call__(
        self, renderer: Renderer, shape: Coloured, metered: Meter, pixels: Pixels, background: Background | None = None
    ) -> Terms:
        """The weighted terms and their sum, `total`.

        Args:
            renderer: the renderer at the current iteration.
            shape: the field, with gradients for its parameters.
            metered: the same field with counted evaluations.
            pixels: the compared pixels; for `colour_gradient` in groups of four, see `Stack.draw`.
            background: the colours behind the shape. With it, colours are compared along all rays, without masks.
        """
        rendering = render_checked(renderer, metered, pixels.rays)
        inside = pixels.inside(rendering.hit)
        points, rays = rendering.points[inside], inside.numel()
        gradients = gradients_at(metered, points)
        normals = torch.nn.functional.normalize(gradients, dim=-1)
        terms: Terms = {}
        if self.colour or self.colour_gradient:
            terms |= self._colour_terms(renderer, shape, metered, pixels, rendering, gradients, background)
        if self.depth and pixels.distance is not None:
            measured = rendering.hit & pixels.distance.isfinite()
            scale = pixels.depth_per_distance[measured]
            depths, given_depths = (distance[measured] * scale for distance in (rendering.distance, pixels.distance))
            error = depth_error(self.depth_loss, depths, given_depths, scale)
            terms["depth"] = self.depth * error.sum() / rays
        if self.silhouette_weight and pixels.mask is not None:
            observed = RayObservation(pixels.mask, pixels.guide)
            if pixels.several:
                unknown = torch.full_like(pixels.covered, torch.nan)
                guide = unknown if pixels.guide is None else pixels.guide
                observed = observation_of(pixels.covered, guide, rendering)
            loss = self.silhouette(renderer, metered, pixels.rays, rendering, observed)
            terms["silhouette"] = self.silhouette_weight * loss
        if self.smoothness:
            nearby_points = points + NEIGHBOUR_CUBE_SIDE * (torch.rand_like(points) - 0.5)
            neighbours = torch.nn.functional.normalize(gradients_at(metered, nearby_points), dim=-1)
            terms["smoothness"] = self.smoothness * torch.linalg.vector_norm(normals - neighbours, dim=-1).sum() / rays
        if self.normals and pixels.normals is not None:
            terms["normals"] = self.normals * normal_error(normals, pixels.normals[inside])
        if (self.eikonal or self.heat) and shape.kind is not Kind.LEVEL:
            random_points = 2 * torch.rand(CUBE_POINTS, 3, device=points.device) - 1
            slopes = [torch.linalg.vector_norm(g, dim=-1) for g in (gradients, gradients_at(metered, random_points))]
            if self.eikonal:
                errors = sum((slope - 1).square().sum() / max(len(slope), 1) for slope in slopes)
                terms["eikonal"] = self.eikonal * errors
            if self.heat:
                remaining = (-2 * self.heat_rate * metered(random_points).abs()).exp()
                terms["heat"] = self.heat * (remaining * (slopes[1].square() + 1) / 2).mean()
        if not terms:
            raise BadInput("no term of the loss is left: give a weight of task.losses that the photographs can serve")
        return {"total": total(terms), **terms}

    def _colour_terms(
        self,
        renderer: Renderer,
        shape: Coloured,
        metered: Meter,
        pixels: Pixels,
        rendering: Rendering,
        gradients: Float[Tensor, "hits 3"],
        background: Background | None,
    ) -> Terms:
        """The terms of colours; `gradients` are those of the field at hits inside of the masks."""
        count, volume = len(pixels.colours), rendering.volume
        if volume is not None and pixels.mask is None and background is None:
            reason = "needs masks: without them it would paint what is behind too"
            raise BadInput(f"{type(renderer).__name__} {reason}; +task.background=sphere learns what is behind")
        if self.colour and self.colour_of == SAMPLES:
            if volume is None:
                raise BadInput(f"{type(renderer).__name__} has no samples: take task.losses.colour_of=blended")
            if pixels.mask is None:
                raise BadInput("task.losses.colour_of=samples needs masks: take colour_of=blended")
            return {"colour": self.colour * _sample_errors(shape, metered, pixels, volume)[pixels.mask].sum() / count}
        flat, all_rays = pixels.rays.flat(), torch.ones_like(rendering.hit)
        if volume is None:
            inside = pixels.inside(rendering.hit)
            surface = shape.colours(rendering.points[inside], gradients, pixels.rays.directions[inside])
            behind = torch.zeros_like(flat.directions) if background is None else background(flat)
            colours, compared_rays = behind.index_put((inside.flatten(),), surface), inside
        else:
            colours = volume.weighted_sum(_sample_colours(shape, metered, flat, volume), len(flat.origins))
            compared_rays = pixels.inside(all_rays)
            if background is not None:
                colours = colours + (1 - rendering.opacity.flatten()[:, None]) * background(flat)
        per_pixel = (compared_rays if background is None else all_rays).view(count, -1)
        compared = per_pixel.any(-1)
        mean = (colours.view(count, -1, 3) * per_pixel[..., None]).sum(1) / per_pixel.sum(-1).clamp_min(1)[:, None]
        difference = torch.where(compared[:, None], mean - pixels.colours, 0.0)
        terms: Terms = {}
        if self.colour:
            terms["colour"] = self.colour * difference.abs().sum() / count
        if self.colour_gradient:
            terms["colour_gradient"] = self.colour_gradient * _neighbour_error(difference, compared) / count
        return terms

    def check_rays_per_pixel(self, *, depths: bool) -> None:
        """Raises BadInput for losses of depths, normals and samples, which need one ray per pixel.

        Args:
            depths: whether depths are given.
        """
        used = {"depths.points=none": depths, "losses.normals=0": bool(self.normals)}
        used["losses.colour_of=blended"] = self.colour_of == SAMPLES
        if remedies := " ".join(f"task.{remedy}" for remedy, is_used in used.items() if is_used):
            reason = "several rays per pixel compare only colours and silhouettes"
            raise BadInput(f"{reason}: remove view.rays_per_pixel, or set {remedies}")


def _sample_errors(shape: Coloured, field: Field, pixels: Pixels, volume: Volume) -> Float[Tensor, " n"]:
    """The l1 error of each ray: of the samples' colours by their weights, and of black by the weight that is left."""
    count = len(pixels.colours)
    errors = (_sample_colours(shape, field, pixels.rays, volume) - pixels.colours[volume.ray]).abs().sum(dim=-1)
    passing = 1 - volume.weighted_sum(torch.ones_like(errors), count)
    return volume.weighted_sum(errors, count) + passing * pixels.colours.sum(dim=-1)


def _sample_colours(shape: Coloured, field: Field, rays: Rays, volume: Volume) -> Float[Tensor, "samples 3"]:
    """The colours of all samples with a weight, seen along their rays."""
    sample_rays = rays[volume.ray]
    points = sample_rays.at(volume.distance)
    return shape.colours(points, gradients_at(field, points), sample_rays.directions)


def _neighbour_error(difference: Float[Tensor, "n 3"], inside: Bool[Tensor, " n"]) -> Float[Tensor, ""]:
    """The norm of the upper left pixel's differences to the right and below, summed over 2 x 2 patches inside."""
    patches, patch_inside = difference.view(-1, 2, 2, 3), inside.view(-1, 4).all(-1)
    corner = patches[:, 0, 0]
    differences = torch.stack([patches[:, 0, 1] - corner, patches[:, 1, 0] - corner], dim=-1)
    return (torch.linalg.vector_norm(differences, dim=-1).sum(-1) * patch_inside).sum()
