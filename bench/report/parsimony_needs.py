"""What a scene needs over how complex it is, told from the data alone."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.transforms import Bbox

from bench.report import style
from bench.report.caption import counted_outcome, joined, omitted, setup
from bench.report.experiments import Experiment
from bench.report.ladder import KINDS, RungResult
from bench.report.parsimony_runs import SceneRun, over, scene_runs
from bench.report.tables import Result

MOST = 10.0  # half pixels: no ray's error is larger
CAPTION = (
    "Over the held-out error that the best single part leaves, a ball or a box of one kind or another of at most 11 "
    "free numbers, in half pixels: how far the scene is from one part, told by the data alone. No ray counts for more "
    "than {most:g} half pixels; bars are one standard error by the jackknife over views. The dashed line is the size "
    "of the papers' network, the dotted one a tenth of it."
)
SIDES = ((0, 9, "center"), (0, -9, "center"), (6, 0, "left"), (-6, 0, "right"), (3, 9, "left"), (-3, 9, "right"))
SIDES += ((3, -9, "left"), (-3, -9, "right"), (0, 18, "center"), (0, -18, "center"), (0, 27, "center"))
LETTER, LINE = 3.6, 8.0  # points: about what a letter takes, and a line


@dataclass(frozen=True)
class Need:
    """A point of the chart: a scene, what the best single part leaves of it, and what it needs."""

    run: SceneRun
    chosen: RungResult
    complexity: float  # half pixels
    spread: float  # of that: one standard error

    @property
    def numbers(self) -> int:
        """Free numbers that are needed."""
        return self.chosen.numbers["parameters"]


def make(experiment: Experiment) -> Result:
    """A point a scene."""
    runs = scene_runs(experiment)
    needs = [need for run in runs if (need := _need(run)) is not None]
    unknown = [run.name for run in runs if run.ok and not any(need.run is run for need in needs)]
    told = f"Without a single part's error, and so not drawn: {', '.join(unknown)}." if unknown else ""
    return Result(
        name="parsimony_needs",
        title="Free numbers that each scene needs, over its complexity.",
        caption=joined(
            setup(experiment, network=False),
            CAPTION.format(most=MOST),
            f"{len(needs)} of {len(runs)} scenes are drawn.",
            told,
            counted_outcome(experiment),
            omitted(experiment),
        ),
        data=pd.DataFrame([_raw(run, _need(run)) for run in runs], dtype=object),
        figure=draw(needs, papers_size(runs)),
    )


def papers_size(runs: list[SceneRun]) -> float | None:
    """Free numbers of the papers' network, as the runs have them."""
    known = (run.number("saved_parameters") for run in runs)
    sizes = (run.number("recommended_parameters") for run in runs)
    return next((saved * size for saved, size in zip(known, sizes, strict=True) if saved and size), None)


@style.styled
def draw(needs: list[Need], papers: float | None) -> Figure:
    """The needed size over the complexity, a colour a kind of rung."""
    figure = Figure(figsize=(style.WIDTH, 3.4), layout="constrained")
    axes = figure.subplots()
    for kind, (label, colour, marker) in KINDS.items():
        own = [need for need in needs if need.chosen.kind == kind]
        if own:
            x, y, bars = ([getattr(n, name) for n in own] for name in ("complexity", "numbers", "spread"))
            axes.errorbar(x, y, xerr=bars, fmt=marker, color=colour, ms=6, elinewidth=0.7, label=label)
    if papers is not None:
        for size, line, label in ((papers, "--", "papers' network"), (papers / 10, ":", "a tenth of it")):
            axes.axhline(size, color="#777777", lw=0.9, ls=line, label=label)
    axes.axvline(1.0, color="#bbbbbb", lw=0.8, zorder=0)
    axes.annotate("half a pixel", (1.0, 0.45), (3, 0), xycoords=("data", "axes fraction"), **_SMALL)
    axes.set(
        xlim=(-0.5, MOST + 0.5), xlabel="what the best single part leaves: held-out error (half pixels)", yscale="log"
    )
    axes.set_ylabel("free numbers of the recommended field")
    axes.margins(y=0.1)
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=6)
    _name(figure, axes, needs)
    return figure


_SMALL: dict[str, Any] = {"textcoords": "offset points", "fontsize": 6, "color": "#777777", "va": "center"}


def _name(figure: Figure, axes: Axes, needs: list[Need]) -> None:
    """Writes each scene's name beside its point, on the first side where it covers no point, name or axis."""
    figure.draw_without_rendering()  # places the axes
    points = axes.transData.transform([(need.complexity, need.numbers) for need in needs] or np.empty((0, 2)))
    points = points * 72 / figure.dpi
    inside = Bbox(axes.get_window_extent().get_points() * 72 / figure.dpi)
    taken = [Bbox.from_bounds(x - 4, y - 4, 8, 8) for x, y in points]
    for need, at, own in zip(needs, points, list(taken), strict=True):
        boxes = [_box(at, side, len(need.run.name)) for side in SIDES]
        free = [
            inside.x0 <= box.x0 and not any(box.overlaps(other) for other in taken if other is not own) for box in boxes
        ]
        place = free.index(True) if True in free else 0
        dx, dy, side = SIDES[place]
        where = need.complexity, need.numbers
        axes.annotate(need.run.name, where, (dx, dy), textcoords="offset points", ha=side, va="center", fontsize=7)
        taken.append(boxes[place])


def _box(at: np.ndarray, side: tuple[int, int, str], letters: int) -> Bbox:
    """About where a name of so many letters would stand, in points."""
    dx, dy, align = side
    width = LETTER * letters
    left = at[0] + dx - {"left": 0.0, "center": width / 2, "right": width}[align]
    return Bbox.from_bounds(left, at[1] + dy - LINE / 2, width, LINE)


def _need(run: SceneRun) -> Need | None:
    """None where the run did not end ok, or has no single part that could be fitted."""
    chosen, parts = run.ladder.chosen, [rung for rung in run.ladder.rungs if rung.kind == "" and rung.error is not None]
    if not run.ok or chosen is None or not parts:
        return None
    best = min(parts, key=lambda rung: rung.error)
    spread = best.numbers.get("standard_error") or 0.0
    return Need(run, chosen, best.error / run.ladder.footprint, spread / run.ladder.footprint)


def _raw(run: SceneRun, need: Need | None) -> dict[str, Any]:
    saved = run.number("saved_parameters")
    return {
        **run.identity,
        "single_part_error_footprints": None if need is None else need.complexity,
        "single_part_standard_error_footprints": None if need is None else need.spread,
        "footprint": run.number("footprint"),
        "recommended_field": run.word("recommended_field"),
        "kind": None if need is None else KINDS[need.chosen.kind][0],
        "recommended_parameters": run.number("recommended_parameters"),
        "share_of_papers_network": over(1.0, saved),
    }
