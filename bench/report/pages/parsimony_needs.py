"""Size of the recommended field over the complexity of a scene, measured as the error of the best single part."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.transforms import Bbox

from bench.pictures import style
from bench.pictures.size_chart import KINDS, CandidateResult
from bench.report.data.experiments import Experiment
from bench.report.data.parsimony import PARSIMONY, SceneRun, over, scene_runs
from bench.report.pages.parsimony import INTERVAL, SCENE
from bench.report.write.caption import WITHOUT_NETWORK, captioned
from bench.report.write.result import Result
from bench.report.write.table import Column, through, to_data

PLACE = 180
READS = (PARSIMONY,)
MOST = 10.0  # half pixels: largest error of a ray
NOTES = (
    "A single part is a sphere or a kind of box with at most 11 parameters: the error of the best one measures the "
    f"complexity of the scene from the data alone. The error of a ray is at most {MOST:g} half pixels.",
    "The dashed line is the size of the papers' network, the dotted one a tenth of it.",
)
# Places of a name relative to its point: offsets in points, and the alignment.
SIDES = ((0, 9, "center"), (0, -9, "center"), (6, 0, "left"), (-6, 0, "right"), (3, 9, "left"), (-3, 9, "right"))
SIDES += ((3, -9, "left"), (-3, -9, "right"), (0, 18, "center"), (0, -18, "center"), (0, 27, "center"))
LETTER, LINE = 3.6, 8.0  # points: approximate width of a letter, and height of a line


@dataclass(frozen=True)
class Need:
    """A point of the chart: a scene, the error of the best single part, and the recommended candidate."""

    run: SceneRun
    chosen: CandidateResult
    complexity: float  # error of the best single part in half pixels
    spread: float  # its standard error

    @property
    def parameters(self) -> int:
        """The number of parameters of the recommended candidate."""
        return self.chosen.numbers["parameters"]


def make(experiment: Experiment) -> Result:
    """Makes the page, with a point per scene."""
    runs = scene_runs(experiment)
    pairs = [(run, _need(run)) for run in runs]
    needs = [need for _, need in pairs if need is not None]
    unknown = [run.name for run, need in pairs if run.ok and need is None]
    return Result(
        title="Parameters that each scene needs over its complexity.",
        **captioned(
            experiment,
            "Number of parameters of the recommended field over the held-out error of the best single part, in half "
            f"pixels; {len(needs)} of {len(runs)} scenes are drawn.",
            interval=INTERVAL,
            notes=(
                f"Not drawn, as no single part was fitted: {', '.join(unknown)}." if unknown else "",
                *NOTES,
            ),
            parts=WITHOUT_NETWORK,
        ),
        data=to_data(COLUMNS, pairs),
        figure=draw(needs, papers_size(runs)),
    )


def papers_size(runs: list[SceneRun]) -> float | None:
    """The number of parameters of the papers' network, computed from the runs' savings; None where unknown."""
    known = (run.number("saved_parameters") for run in runs)
    sizes = (run.number("recommended_parameters") for run in runs)
    return next((saved * size for saved, size in zip(known, sizes, strict=True) if saved and size), None)


@style.styled
def draw(needs: list[Need], papers: float | None) -> Figure:
    """Draws the size over the complexity, with a colour per kind of candidate."""
    figure = Figure(figsize=(style.WIDTH, 3.4), layout="constrained")
    axes = figure.subplots()
    for kind, (label, colour, marker) in KINDS.items():
        of_kind = [need for need in needs if need.chosen.kind == kind]
        if of_kind:
            x, y, bars = ([getattr(n, name) for n in of_kind] for name in ("complexity", "parameters", "spread"))
            axes.errorbar(x, y, xerr=bars, fmt=marker, color=colour, ms=6, elinewidth=0.7, label=label)
    if papers is not None:
        for size, line, label in ((papers, "--", "papers' network"), (papers / 10, ":", "a tenth of it")):
            axes.axhline(size, color="#777777", lw=0.9, ls=line, label=label)
    axes.axvline(1.0, color="#bbbbbb", lw=0.8, zorder=0)
    axes.annotate("half a pixel", (1.0, 0.45), (3, 0), xycoords=("data", "axes fraction"), **_SMALL)
    axes.set(xlim=(-0.5, MOST + 0.5), xlabel="held-out error of the best single part (half pixels)", yscale="log")
    axes.set_ylabel("parameters of the recommended field")
    axes.margins(y=0.1)
    style.legend_below(figure, axes, columns=6)
    _name(figure, axes, needs)
    return figure


_SMALL: dict[str, Any] = {"textcoords": "offset points", "fontsize": 6, "color": "#777777", "va": "center"}


def _name(figure: Figure, axes: Axes, needs: list[Need]) -> None:
    """Writes each scene's name next to its point, on the first side where it covers no point, name or axis."""
    figure.draw_without_rendering()  # places the axes
    points = axes.transData.transform([(need.complexity, need.parameters) for need in needs] or np.empty((0, 2)))
    points = points * 72 / figure.dpi
    inside = Bbox(axes.get_window_extent().get_points() * 72 / figure.dpi)
    taken = [Bbox.from_bounds(x - 4, y - 4, 8, 8) for x, y in points]
    for need, at, this in zip(needs, points, list(taken), strict=True):
        boxes = [_box(at, side, len(need.run.name)) for side in SIDES]
        free = [
            inside.x0 <= box.x0 and not any(box.overlaps(other) for other in taken if other is not this)
            for box in boxes
        ]
        place = free.index(True) if True in free else 0
        dx, dy, side = SIDES[place]
        where = need.complexity, need.parameters
        axes.annotate(need.run.name, where, (dx, dy), textcoords="offset points", ha=side, va="center", fontsize=7)
        taken.append(boxes[place])


def _box(at: np.ndarray, side: tuple[int, int, str], letters: int) -> Bbox:
    """The approximate box of a name of so many letters, in points."""
    dx, dy, align = side
    width = LETTER * letters
    left = at[0] + dx - {"left": 0.0, "center": width / 2, "right": width}[align]
    return Bbox.from_bounds(left, at[1] + dy - LINE / 2, width, LINE)


def _need(run: SceneRun) -> Need | None:
    """The point of a run; None where the run did not end ok, or no single part was fitted."""
    chosen = run.candidates.chosen
    parts = [result for result in run.candidates.results if result.kind == "" and result.error is not None]
    if not run.ok or chosen is None or not parts:
        return None
    best = min(parts, key=lambda result: result.error)
    spread = best.numbers.get("standard_error") or 0.0
    return Need(run, chosen, best.error / run.candidates.footprint, spread / run.candidates.footprint)


def _of_need(key: str, value: Callable[[Need], Any]) -> Column:
    return Column(key, value=lambda pair: None if pair[1] is None else value(pair[1]))


COLUMNS = (  # of a run and its need
    *through(lambda pair: pair[0], *SCENE),
    _of_need("single_part_error_footprints", lambda need: need.complexity),
    _of_need("single_part_standard_error_footprints", lambda need: need.spread),
    *through(lambda pair: pair[0], Column("footprint"), Column("recommended_field")),
    _of_need("kind", lambda need: KINDS[need.chosen.kind][0]),
    *through(lambda pair: pair[0], Column("recommended_parameters")),
    Column("share_of_papers_network", value=lambda pair: over(1.0, pair[0].number("saved_parameters"))),
)
