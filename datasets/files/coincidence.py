"""Compares two things that must share a frame, and finds the change of axes, units or origin with which they fit."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import chain, permutations, product
from math import exp, inf, log

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.optimize import minimize
from scipy.spatial import cKDTree

from datasets.files.captures.hull import hull_mesh
from datasets.mesh import Mesh
from datasets.scene import Truth, sample_surface
from datasets.shot import Shot, mask_iou
from renderers.checks import BadInput

SAMPLES, FAST_SAMPLES = (50_000, 500), (5_000, 150)  # points to measure distances to, and points to measure them from
COUNTED_FRACTION = 0.9  # the nearest points; others may be outliers
RADIUS_QUANTILE = 0.99
MIN_GAIN = 3.0  # a change must fit so many times better
MAX_GAIN = 100  # a larger gain is no more exact
ROUNDING_GAIN = 1.5  # a simpler change may fit so many times worse than the best change
MIN_FRAME_FACTOR, MIN_FRAME_SHIFT = 1.5, 0.5  # less of a factor, or of a shift over the radius, may be a poor result
UNIT_METRES = {"millimetres": 0.001, "centimetres": 0.01, "inches": 0.0254, "metres": 1.0}
UNIT_RATIO_TOLERANCE = 1.02  # as a factor
SIZE_RATIO_TOLERANCE, REFINED_RATIO_TOLERANCE = 1.4, 1.06  # as factors: one size may be incomplete
REFINED_TURNS, REFINING_STEPS, FIRST_STEP = 2, 120, 0.1
FAST_GAIN, FAST_MISFIT, MAX_COMPARED = 1.5, 0.04, 16  # changes that are compared without approximation
MIN_OUTLINE_SIDE = 8  # pixels
OUTLINE_DETAIL, FAST_OUTLINE_DETAIL, HULL_SAMPLES = (8, 8000, 64), (4, 1000, 24), 48  # views, points, pixels; per axis


@dataclass(frozen=True)
class Change:
    """A point x becomes factor * turn @ x + shift; `turn` exchanges or reverses axes."""

    turn: Float[np.ndarray, "3 3"]
    factor: float
    shift: Float[np.ndarray, "3"]

    def apply(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        return self.factor * points @ self.turn.T + self.shift

    def undo(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """The points that `apply` changes to these."""
        return (points - self.shift) @ self.turn / self.factor

    @property
    def complexity(self) -> tuple[int, int]:
        """The number of components, where mirrors and factors that are no ratio of units count more, and the turn."""
        rank = next(i for i, turn in enumerate(turns()) if np.array_equal(turn, self.turn))
        turned = 0 if rank == 0 else 2 if np.linalg.det(self.turn) > 0 else 4
        scaled = 0 if self.factor == 1 else 2 if self.factor in _unit_ratios(self.factor, UNIT_RATIO_TOLERANCE) else 3
        return turned + scaled + 2 * bool(self.shift.any()), rank

    def __str__(self) -> str:
        ratio, size = max(self.factor, 1 / self.factor), "as large" if self.factor > 1 else "smaller"
        units = [f" ({text}?)" for text in _unit_ratios(self.factor, UNIT_RATIO_TOLERANCE).values()]
        digits = 4 if units else 2
        texts = [
            _turn_text(self.turn),
            f"{ratio:.{digits}g} times {size}{''.join(units[:1])}" if self.factor != 1 else "",
            f"moved by ({', '.join(f'{value:.3g}' for value in self.shift)})" if self.shift.any() else "",
        ]
        return " and ".join(filter(None, texts))


IDENTITY = Change(np.eye(3), 1.0, np.zeros(3))
Misfit = Callable[[Change], float]


@cache
def turns() -> tuple[Float[np.ndarray, "3 3"], ...]:
    """The 24 rotations that exchange axes, from the commonest on, and then the 24 mirrored ones."""
    signs = list(product((1.0, -1.0), repeat=3))
    matrices = [np.eye(3)[list(order)] * sign for order in permutations(range(3)) for sign in signs]
    return tuple(sorted(matrices, key=lambda m: (-round(np.linalg.det(m)), -np.sum(np.diag(m) == 1), *-np.diag(m))))


def _turn_text(turn: Float[np.ndarray, "3 3"]) -> str:
    """A turn in words; "" for none."""
    fixed = [i for i in range(3) if turn[i, i] == 1]
    if len(fixed) == 3:
        return ""
    if len(fixed) == 2:
        return f"mirrored in {'xyz'[int(np.argmin(np.diag(turn)))]}"
    if len(fixed) == 1 and np.linalg.det(turn) > 0:
        axis, sine = fixed[0], turn[fixed[0] - 1, fixed[0] - 2]
        angle = "180" if sine == 0 else f"{90 * sine:.0f}"
        return f"turned by {angle} degrees about {'xyz'[axis]}" + (
            " (z up against y up?)" if axis == 0 and sine else ""
        )
    axes = [f"{'-' if row.min() < 0 else ''}{'xyz'[int(np.abs(row).argmax())]}" for row in turn]
    return f"{'mirrored' if np.linalg.det(turn) < 0 else 'turned'}, with axes ({', '.join(axes)}) for (x, y, z)"


def _unit_ratios(factor: float, tolerance: float) -> dict[float, str]:
    """The ratios of two units that a factor is within a tolerance, nearest first, and their units in words."""
    ratios = {UNIT_METRES[old] / UNIT_METRES[new]: f"{old} against {new}" for old, new in permutations(UNIT_METRES, 2)}
    errors = {ratio: abs(log(factor / ratio)) for ratio in ratios}
    return {ratio: ratios[ratio] for ratio in sorted(ratios, key=errors.__getitem__) if errors[ratio] < log(tolerance)}


@dataclass(frozen=True)
class Measure:
    """A way to measure a misfit.

    Args:
        limit: a larger misfit is refused.
        good: a smaller misfit needs no change, and a change must have a smaller misfit.
        error: of the measure itself; smaller differences mean nothing.
        text: on a misfit, in words.
    """

    limit: float
    good: float
    error: float
    text: str


DISTANCE = Measure(0.2, 0.05, 0.005, "{thing} lies {misfit:.2g} times the radius of {reference} from it")
OUTLINE = Measure(0.5, 0.2, 0.03, "the outline of {thing} overlaps with {reference} by {overlap:.0%} (median)")


@dataclass(frozen=True)
class Comparison:
    """Two things that must coincide, as they are and after a change of the first one.

    Args:
        measure: of the misfits.
        misfit: without a change.
        change: the simplest change among those that fit best; `IDENTITY` if no change fits much better.
        changed_misfit: with the change.
        is_other_frame: whether the change shows that the two frames differ; a poor result alone would not need it.
    """

    measure: Measure
    misfit: float
    change: Change
    changed_misfit: float
    is_other_frame: bool

    @property
    def coincides(self) -> bool:
        """Whether the two things may be used as they are."""
        return self.misfit <= self.measure.limit and not self.is_other_frame

    def text(self, thing: str, reference: str) -> str:
        misfit = self.measure.text.format(thing=thing, reference=reference, misfit=self.misfit, overlap=1 - self.misfit)
        if self.change is IDENTITY:
            return misfit
        gain = self.misfit / max(self.changed_misfit, self.measure.error)
        gain_text = f"over {MAX_GAIN}" if gain > MAX_GAIN else f"{gain:.0f}"
        return f"{misfit}, and fits {gain_text} times better if it is {self.change}"


def settled(
    comparison: Comparison, doubt: str, *, unchecked: bool, override: str = "dataset.unchecked=true"
) -> tuple[str, ...]:
    """A note on two things that are used although they hardly coincide; empty for others.

    Args:
        doubt: the note.
        unchecked: whether two things that do not coincide are used.
        override: of the command line, which sets `unchecked`.

    Raises:
        BadInput: they do not coincide.
    """
    if not (comparison.coincides or unchecked):
        raise BadInput(f"{doubt}; or set {override}")
    return (doubt,) if comparison.misfit > comparison.measure.good else ()


def samples_of(mesh: Mesh) -> Float[np.ndarray, "n 3"]:
    return sample_surface(mesh, SAMPLES[0], seed=0).points


def compare_surfaces(
    shape: Mesh | Float[np.ndarray, "n 3"], reference: Float[np.ndarray, "m 3"], *, is_partial: bool
) -> Comparison:
    """Compares two surfaces by distances, relative to the radius of the reference.

    Args:
        shape: the surface that may be changed, or points on it.
        reference: points of the other surface.
        is_partial: whether the reference is a part of the shape, so that other points may be far from it. The misfit
            of an unchanged mesh is then exact, since a large mesh has few samples near a small reference.
    """
    points = samples_of(shape) if isinstance(shape, Mesh) else shape
    points, reference = (drawn[np.random.default_rng(0).permutation(len(drawn))] for drawn in (points, reference))
    centre, radius = _centre_and_radius(reference)

    def sampled(samples: int, queries: int, limit: float) -> Misfit:
        tree, reference_tree = cKDTree(points[:samples]), cKDTree(reference[:samples])

        def misfit(change: Change) -> float:
            if change is IDENTITY and is_partial and isinstance(shape, Mesh):
                # float32 suffices in the frame of the reference
                truth = Truth(replace(shape, vertices=(shape.vertices - centre) / radius), closed=False)
                distances = [radius * truth.distance((reference[:queries] - centre) / radius)]
            else:
                inverse = change.undo(reference[:queries])
                distances = [change.factor * tree.query(inverse, distance_upper_bound=limit / change.factor)[0]]
            if not is_partial:
                distances.append(reference_tree.query(change.apply(points[:queries]), distance_upper_bound=limit)[0])
            counted = [np.sort(values)[: int(np.ceil(COUNTED_FRACTION * len(values)))] for values in distances]
            return float(np.mean([values.clip(max=limit).mean() for values in counted])) / radius

        return misfit

    return _compare(DISTANCE, sampled(*SAMPLES, inf), sampled(*FAST_SAMPLES, radius), points, reference)


def points_in_sphere(points: Float[np.ndarray, "n 3"], to_world: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "m 3"]:
    """Transforms points of the file's world to the unit sphere's world, and keeps those inside the sphere."""
    to_sphere = np.linalg.inv(to_world)
    moved = points @ to_sphere[:3, :3].T + to_sphere[:3, 3]
    return moved[np.linalg.norm(moved, axis=1) <= 1]


def compare_outlines(
    shape: Mesh | Float[np.ndarray, "n 3"], shots: Sequence[Shot], to_world: Float[np.ndarray, "4 4"]
) -> Comparison:
    """Compares the outlines of points on a surface with the masks of photographs.

    Args:
        shape: the surface that may be changed, or points on it, in the world of a file. An unchanged mesh is cut off at
            the unit sphere before points are drawn, so that a large background leaves enough points on the object.
        shots: photographs with masks, of the unit sphere; points outside of it are left out.
        to_world: from the unit sphere to the world of the file.
    """
    points = samples_of(shape) if isinstance(shape, Mesh) else shape
    points = points[np.random.default_rng(0).permutation(len(points))]

    cut = shape.moved(np.linalg.inv(to_world)).cut_off() if isinstance(shape, Mesh) else None
    unchanged = points_in_sphere(points, to_world) if cut is None or not cut.area else samples_of(cut)

    def seen_by(count: int, samples: int, side: int) -> Misfit:
        chosen = [shots[i] for i in np.linspace(0, len(shots) - 1, min(count, len(shots))).round().astype(int)]

        def views(point_count: int) -> list[tuple[Float[np.ndarray, "3 4"], Bool[np.ndarray, "h w"]]]:
            fine_enough = int(point_count**0.5)  # so that points leave no gaps in an outline
            return [_small_view(shot, min(side, max(fine_enough, MIN_OUTLINE_SIDE))) for shot in chosen]

        changed_views = views(min(samples, len(points)))

        def misfit(change: Change) -> float:
            moved, compared = points_in_sphere(change.apply(points[:samples]), to_world), changed_views
            if change is IDENTITY:
                moved = unchanged[:samples]
                compared = views(len(moved))
            return 1 - float(np.median([mask_iou(_outline(moved, *view), view[1]) for view in compared]))

        return misfit

    hull = hull_mesh(shots, HULL_SAMPLES)
    reference = points if hull is None else hull.moved(to_world).used_vertices
    return _compare(OUTLINE, seen_by(*OUTLINE_DETAIL), seen_by(*FAST_OUTLINE_DETAIL), points[: SAMPLES[0]], reference)


def _small_view(shot: Shot, side: int) -> tuple[Float[np.ndarray, "3 4"], Bool[np.ndarray, "h w"]]:
    """The projection of a photograph and its mask, with `side` pixels along the longer side."""
    height, width = (max(1, round(length * side / max(shot.mask.shape))) for length in shot.mask.shape)
    camera = shot.camera.resized(height, width)
    mask = torch.nn.functional.interpolate(shot.mask[None, None].double(), (height, width), mode="area")[0, 0] > 0
    return (camera.intrinsics @ camera.world_to_camera[:3]).double().numpy(), mask.numpy()


def _outline(
    points: Float[np.ndarray, "n 3"], projection: Float[np.ndarray, "3 4"], mask: Bool[np.ndarray, "h w"]
) -> Bool[np.ndarray, "h w"]:
    """The pixels that points cover, in an image of a mask's size."""
    image = points @ projection[:, :3].T + projection[:, 3]
    image = image[image[:, 2] > 0]
    pixels = np.floor(image[:, :2] / image[:, 2:])
    columns, rows = pixels[((pixels >= 0) & (pixels < mask.shape[::-1])).all(axis=1)].astype(int).T
    outline = np.zeros_like(mask)
    outline[rows, columns] = True
    return outline


def _centre_and_radius(points: Float[np.ndarray, "n 3"]) -> tuple[Float[np.ndarray, "3"], float]:
    low, high = np.quantile(points, [1 - RADIUS_QUANTILE, RADIUS_QUANTILE], axis=0)
    centre = (low + high) / 2
    return centre, max(float(np.quantile(np.linalg.norm(points - centre, axis=1), RADIUS_QUANTILE)), 1e-300)


def _compare(
    measure: Measure,
    misfit: Misfit,
    fast_misfit: Misfit,
    points: Float[np.ndarray, "n 3"],
    reference: Float[np.ndarray, "m 3"],
) -> Comparison:
    """The comparison by a misfit.

    Args:
        fast_misfit: an approximation, for the search.
        points, reference: have the centres and radii at which the search begins.
    """
    unchanged = misfit(IDENTITY)
    comparison = Comparison(measure, unchanged, IDENTITY, unchanged, False)
    if unchanged <= measure.good:
        return comparison
    (centre, radius), (new_centre, new_radius) = map(_centre_and_radius, (points, reference))
    changes = _search(fast_misfit, centre, new_centre, (radius, new_radius))
    trials = [(misfit(change), change) for change in changes]
    best = min(value for value, _ in trials)
    similar = [trial for trial in trials if trial[0] <= max(ROUNDING_GAIN * best, best + measure.error)]
    changed, change = min(similar, key=lambda trial: (trial[1].complexity, trial[0]))
    if changed > measure.good or unchanged < MIN_GAIN * changed:
        return comparison
    moved = np.linalg.norm(change.apply(centre[None])[0] - centre) / new_radius
    is_scaled = max(change.factor, 1 / change.factor) >= MIN_FRAME_FACTOR
    is_other_frame = is_scaled or moved > MIN_FRAME_SHIFT or not np.array_equal(change.turn, IDENTITY.turn)
    return Comparison(measure, unchanged, change, changed, is_other_frame)


def _search(
    misfit: Misfit, centre: Float[np.ndarray, "3"], new_centre: Float[np.ndarray, "3"], sizes: tuple[float, float]
) -> list[Change]:
    """The changes that fit about as well as the best: turns with some factors and shifts; the best turns also refined.

    Args:
        centre, new_centre: before and after the change.
        sizes: before and after the change.
    """

    def measured(changes: Iterable[Change]) -> list[tuple[float, Change]]:
        return sorted(((misfit(change), change) for change in changes), key=lambda trial: trial[0])

    ratio = sizes[1] / sizes[0]
    in_place_factors = (1.0, ratio, *_unit_ratios(ratio, SIZE_RATIO_TOLERANCE))
    trials_by_turn = [
        measured(
            [Change(turn, factor, IDENTITY.shift) for factor in in_place_factors]
            + [_centred(turn, factor, centre, new_centre) for factor in (1.0, ratio)]
        )
        for turn in turns()
    ]
    unturned, *turned = trials_by_turn
    best_turned = sorted(turned, key=lambda trials: trials[0][0])[:REFINED_TURNS]
    starts = [trials[0][1] for trials in (unturned, *best_turned)]
    refined = measured(change for start in starts for change in _refined(start, misfit, centre, sizes[1]))
    trials = [*chain(*trials_by_turn), *refined]
    limit = FAST_GAIN * min(value for value, _ in trials) + FAST_MISFIT
    similar = sorted((change for value, change in trials if value <= limit), key=lambda change: change.complexity)
    return [*similar[:MAX_COMPARED], *(change for _, change in refined)]


def _centred(
    turn: Float[np.ndarray, "3 3"], factor: float, centre: Float[np.ndarray, "3"], target: Float[np.ndarray, "3"]
) -> Change:
    """The change that moves a centre to a target."""
    return Change(turn, factor, target - factor * turn @ centre)


def _refined(start: Change, misfit: Misfit, centre: Float[np.ndarray, "3"], size: float) -> Iterator[Change]:
    """A change after optimising its factor and shift, and the same with fewer components.

    Args:
        size: after the change.
    """
    target = start.apply(centre[None])[0]

    def stepped(step: Float[np.ndarray, "4"]) -> Change:
        return _centred(start.turn, start.factor * exp(step[0]), centre, target + step[1:] * size)

    simplex = FIRST_STEP * np.concatenate([np.zeros((1, 4)), np.eye(4)])
    options = {"initial_simplex": simplex, "maxfev": REFINING_STEPS}
    step = minimize(lambda step: misfit(stepped(step)), np.zeros(4), method="Nelder-Mead", options=options).x
    change = stepped(step)
    for factor in (1.0, change.factor, *_unit_ratios(change.factor, REFINED_RATIO_TOLERANCE)):
        yield Change(change.turn, factor, IDENTITY.shift)
        yield _centred(change.turn, factor, centre, change.apply(centre[None])[0])
