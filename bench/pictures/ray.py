"""The picture of one ray: a slice of the field, the field along the ray, and a lane for each renderer."""

import textwrap
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.colors import to_hex, to_rgb
from matplotlib.figure import Figure
from matplotlib.image import imsave
from matplotlib.patches import ConnectionPatch
from matplotlib.patheffects import withStroke

from bench.evaluate.along_ray import MIN_SAMPLES, Lane, TrueRay
from bench.evaluate.ray_derivatives import AGREEMENT, Derivatives
from bench.evaluate.ray_scene import Search
from bench.pictures.figure_style import WIDTH, look, styled
from bench.pictures.style import silhouette_image
from renderers.camera import Rays
from renderers.field import Field

INK, FAINT, RULE, INSIDE, MAGNIFIED = "#1a1a1a", "#6b6b6b", "#9a9a9a", "#e6e6e6", "#c9a227"
WRONG = "#f2a600"  # as in the pictures of stress tests
PANEL_LEFT_FRACTION, PANEL_WIDTH_FRACTION = 0.08, 0.89
TITLE_INCHES, SLICE_INCHES, PROFILE_INCHES, LANE_INCHES, LINE_INCHES = 0.2, 1.5, 0.8, 0.55, 0.14
TITLE_CHARACTERS, TEXT_CHARACTERS = 104, 110  # per line
SLICE_SAMPLES, PROFILE_SAMPLES = (480, 200), 1500  # along and across the ray; along the ray
MIN_NUMBERED_FRACTION = 0.03  # a step that takes less of a panel has no number
HALO = [withStroke(linewidth=2.5, foreground="white")]
KEY = (
    "Dot, tick: evaluation. Arc: step. Area: weights. Triangle: hit. Cross: miss. Dashed: true hit. Bold: over 1 % off."
)


@dataclass(frozen=True)
class LanePanel:
    """A lane with its sentences, and the derivatives of its hit distance, if the reference has any."""

    lane: Lane
    text: str
    derivatives: Derivatives | None = None

    @property
    def sentences(self) -> str:
        return f"{self.text} {self.derivatives.sentences}" if self.derivatives else self.text


@dataclass(frozen=True)
class RayPicture:
    """What the picture shows."""

    scene: str  # the scene and the pixel, in words
    result: str  # of all renderers, in words
    field: Field  # the input of the renderers
    rays: Rays  # the ray, [1, 3]
    truth: TrueRay
    window: tuple[float, float]  # the distances at the ends of the field's panel and of the lanes
    lanes: list[LanePanel]  # one per renderer

    @property
    def texts(self) -> list[str]:
        return [self.scene, self.result, *(f"{panel.lane.title}: {panel.sentences}" for panel in self.lanes)]

    @styled
    def draw(self) -> Figure:
        """Draws all panels; those below the slice share one axis, the distance along the ray."""
        heading, result = (textwrap.wrap(text, TITLE_CHARACTERS) for text in (self.scene, self.result))
        texts = [textwrap.wrap(panel.text, TEXT_CHARACTERS) for panel in self.lanes]
        top = TITLE_INCHES + 0.12 + LINE_INCHES * (len(heading) + len(result))
        height = top + SLICE_INCHES + PROFILE_INCHES + 1.0
        under_lane = [
            LINE_INCHES * (len(lines) + (panel.derivatives is not None))
            for lines, panel in zip(texts, self.lanes, strict=True)
        ]
        height += sum(LANE_INCHES + 0.3 + inches for inches in under_lane)
        figure = Figure(figsize=(WIDTH, height))

        def panel(inches: float, gap: float) -> Axes:
            nonlocal top
            axes = figure.add_axes(
                (PANEL_LEFT_FRACTION, 1 - (top + inches) / height, PANEL_WIDTH_FRACTION, inches / height)
            )
            axes.grid(False)
            top += inches + gap
            return axes

        slice_axes, profile = panel(SLICE_INCHES, 0.25), panel(PROFILE_INCHES, 0.55)
        self._slice(slice_axes)
        self._profile(profile)
        if self.window != (self.truth.entry, self.truth.leave):
            magnify(slice_axes, profile, self.window)
        colours = list[str]()
        for shown, lines, inches in zip(self.lanes, texts, under_lane, strict=True):
            colours.append(look(shown.lane.name).colour)
            shade = mixed(colours[-1], colours[:-1].count(colours[-1]))
            axes = panel(LANE_INCHES, 0.3 + inches)
            axes.set_xlim(*self.window)
            draw_lane(axes, shown.lane, shade)
            self._mark_truth(axes)
            axes.text(0, -0.05, "\n".join(lines), transform=axes.transAxes, va="top")
            if shown.derivatives:
                write_derivatives(axes, shown.derivatives, -0.05 - LINE_INCHES * len(lines) / LANE_INCHES)
        under_heading = 0.08 + LINE_INCHES * len(heading)
        figure.text(PANEL_LEFT_FRACTION, 1 - 0.08 / height, "\n".join(heading), color=FAINT, va="top")
        figure.text(PANEL_LEFT_FRACTION, 1 - under_heading / height, "\n".join(result), fontweight="bold", va="top")
        figure.text(PANEL_LEFT_FRACTION, 0.06 / height, KEY, fontsize=7, color=FAINT)
        return figure

    def _slice(self, axes: Axes) -> None:
        """The field on a plane through the ray, up in the world to the top; lengths are equal in both directions."""
        low, high = self.truth.entry, self.truth.leave
        half = (high - low) / 2 * SLICE_INCHES / (WIDTH * PANEL_WIDTH_FRACTION)
        along, across = np.linspace(low, high, SLICE_SAMPLES[0]), np.linspace(-half, half, SLICE_SAMPLES[1])
        values = self._values(torch.from_numpy(along)[None, :, None], torch.from_numpy(across)[:, None, None])
        axes.contour(along, across, values, levels=14, colors="#a9bacb", linewidths=0.6, linestyles="-")
        solid = thickened(values)
        if np.nanmin(solid) < 0 < np.nanmax(solid):
            axes.contourf(along, across, solid, levels=[np.nanmin(solid), 0], colors=["#cccccc"])
            axes.contour(along, across, solid, levels=[0], colors=INK, linewidths=1.6)
        axes.annotate(
            "", (high, 0), (low, 0), arrowprops={"arrowstyle": "-|>", "color": INK, "shrinkA": 0, "shrinkB": 0}
        )
        if self.truth.hit is not None:
            axes.plot(self.truth.hit, 0, "o", color=INK)
        axes.set(xlim=(low, high), ylim=(-half, half), xticks=[], yticks=[])
        title = (
            "Slice of the field through the ray, up in the world at the top. Grey: inside. Lines: equal field values"
        )
        axes.set_title(title, loc="left", pad=3, path_effects=HALO)
        axes.spines[:].set_visible(False)

    def _profile(self, axes: Axes) -> None:
        along = np.linspace(*self.window, PROFILE_SAMPLES)
        axes.plot(along, self._values(torch.from_numpy(along)[:, None], torch.zeros(1, 1)), color=INK)
        axes.axhline(0, color=RULE, lw=0.6)
        axes.set_xlim(*self.window)
        axes.set_xlabel("distance along the ray (scene units)", labelpad=1)
        title = f"Field along the ray, negative inside; kind: {self.field.kind.value}"
        axes.set_title(title, loc="left", pad=3, path_effects=HALO)
        axes.locator_params(axis="y", nbins=4)
        self._mark_truth(axes)

    def _values(self, along: torch.Tensor, across: torch.Tensor) -> np.ndarray:
        """The field at distances along the ray and heights above it, which broadcast."""
        origin, direction = self.rays.origins[0], self.rays.directions[0]
        vertical = torch.tensor([0.0, 1.0, 0.0] if abs(direction[1]) < 0.99 else [0.0, 0.0, 1.0])
        up = torch.nn.functional.normalize(vertical - vertical.dot(direction) * direction, dim=0)
        points = (origin + along * direction + across * up).to(origin.dtype)
        with torch.no_grad():
            values = torch.cat([self.field(batch) for batch in points.reshape(-1, 3).split(65_536)])
        return values.double().reshape(points.shape[:-1]).numpy()

    def _mark_truth(self, axes: Axes) -> None:
        low, high = self.window
        for start, stop in self.truth.spans:
            if start < high and stop > low:
                axes.axvspan(max(start, low), min(stop, high), color=INSIDE, lw=0, zorder=0)
        if self.truth.hit is not None:
            axes.axvline(self.truth.hit, color=INK, lw=0.8, ls=(0, (4, 2)), zorder=1)


def thickened(values: np.ndarray) -> np.ndarray:
    """The values minus their change over half a sample: a part thinner than the samples' spacing stays negative."""
    padded = np.pad(values, 1, mode="edge")
    neighbours = padded[:-2, 1:-1], padded[2:, 1:-1], padded[1:-1, :-2], padded[1:-1, 2:]
    return values - 0.5 * np.max([np.abs(values - neighbour) for neighbour in neighbours], axis=0)


def magnify(above: Axes, below: Axes, window: tuple[float, float]) -> None:
    above.axvspan(*window, color=MAGNIFIED, alpha=0.3, lw=0, zorder=0.5)
    for side, x in enumerate(window):
        ends = ((x, 0), (side, 1), above.get_xaxis_transform(), "axes fraction")
        line = ConnectionPatch(*ends, axesA=above, axesB=below, color=MAGNIFIED, lw=0.8, zorder=-1)
        above.figure.add_artist(line)


def draw_map(path: Path, search: Search) -> None:
    """Writes the searched pixels in the colours of silhouettes; hits off by more than the tolerance are orange."""
    hit, reference_hit = search.hit.numpy(), search.reference_hit.numpy()
    image = silhouette_image(hit, reference_hit)
    image[hit & reference_hit & (search.error > search.tolerance).numpy()] = to_rgb(WRONG)
    imsave(path, image)


def mixed(colour: str, repeat: int) -> str:
    """A colour for its repeated use: itself, then darker and lighter in turn."""
    target = np.zeros(3) if repeat % 2 else np.ones(3)
    share = 1 - 0.6 ** ((repeat + 1) // 2)
    return to_hex((1 - share) * np.array(to_rgb(colour)) + share * target)


def write_derivatives(axes: Axes, derivatives: Derivatives, height: float) -> None:
    """Writes the derivatives in a line under a lane, bold if they differ from the reference."""
    axes.text(0, height, "Derivatives (reference)", color=FAINT, transform=axes.transAxes, va="top", fontsize=7)
    weight = "bold" if derivatives.error > AGREEMENT else "normal"
    text = "     ".join(derivatives.pairs)
    axes.text(0.19, height, text, transform=axes.transAxes, va="top", fontsize=7, fontweight=weight)


def draw_lane(axes: Axes, lane: Lane, colour: str) -> None:
    """Draws steps as numbered arcs, samples as ticks, weights as an area, and the end; the x limits are set before."""
    low, high = axes.get_xlim()
    points = [(distance, len(call) >= MIN_SAMPLES) for call in lane.calls for distance in call]
    samples = [distance for distance, sampled in points if sampled and low <= distance <= high]
    steps = [distance for distance, sampled in points if not sampled]
    axes.vlines(samples, 0, 0.16, color=colour, lw=0.7)
    axes.plot(steps, [0] * len(steps), "o", color=colour, ms=3, zorder=4)
    for number, ((start, sampled), (stop, next_sampled)) in enumerate(pairwise([*points, (lane.end, False)]), 1):
        if lane.marches and not (sampled or next_sampled):
            _draw_step(axes, colour, str(number), (start, stop))
    if lane.weights is not None:
        distance, weight = lane.weights
        edges = np.concatenate([distance[:1], (distance[1:] + distance[:-1]) / 2, distance[-1:]])
        density = weight / np.maximum(np.diff(edges), 1e-9)
        heights = np.append(density, 0) / max(density.max(), 1e-30) * 0.85
        axes.fill_between(edges, 0, heights, step="post", color=colour, alpha=0.4, lw=0.8)
    rounding = 1e-4 * (high - low)
    if lane.hit is None:  # a ray that ends outside the panel has its cross at the edge
        axes.plot(min(max(lane.end, low), high), -0.2, "x", color=colour, ms=6, mew=1.8, zorder=5, clip_on=False)
    elif low - rounding <= lane.hit <= high + rounding:
        axes.plot(lane.hit, -0.2, "^", color=colour, ms=6, zorder=5, clip_on=False)
    axes.axhline(0, color=RULE, lw=0.6)
    axes.set(xlim=(low, high), ylim=(-0.34, 0.95), xticks=[], yticks=[])
    axes.set_title(lane.title, color=colour, fontweight="bold", loc="left", pad=1)
    axes.spines[:].set_visible(False)


def _draw_step(axes: Axes, colour: str, label: str, ends: tuple[float, float]) -> None:
    """Draws a step as an arc: above the ray if it goes forwards, below if backwards."""
    low, high = axes.get_xlim()
    length, middle, angles = ends[1] - ends[0], sum(ends) / 2, np.linspace(0, np.pi, 60)
    height = min(0.2 + 1.2 * abs(length) / (high - low), 0.75) * (1 if length > 0 else -0.35)
    curve = middle - length / 2 * np.cos(angles), height * np.sin(angles)
    axes.plot(*curve, color=colour, lw=1.1, solid_capstyle="butt")
    margin = 0.02 * (high - low)
    if abs(length) > MIN_NUMBERED_FRACTION * (high - low) and low + margin < middle < high - margin:
        axes.text(middle, height, label, ha="center", va="center", fontsize=7, color=colour, path_effects=HALO)
