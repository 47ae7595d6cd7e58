"""Reads the candidates of a capacity run from its metrics, and draws their errors over their costs."""

from dataclasses import dataclass
from math import log10
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure

from bench.pictures import figure_style, style

KINDS = {  # from the beginning of a candidate's name to label, colour and marker
    "network": ("networks", "#0072b2", "s"),
    "fourier": ("Fourier features", "#56b4e9", "D"),
    "hash": ("hash grids", "#cc79a7", "^"),
    "grid": ("narrow-band grid", "#9a6a1f", "v"),
    "union": ("unions of boxes", "#009e73", "P"),
    "": ("single primitives", "#d55e00", "o"),
}
CONFIRMED_FROM = 0.8  # fraction of the draws of further views on which a chosen candidate must suffice
FLOPS = "flops_per_query"
AXES = {"stored": "stored numbers", "free": "free numbers", "bytes": "bytes", FLOPS: "FLOPs per evaluation"}


@dataclass(frozen=True)
class CandidateResult:
    """The result of a candidate; `error` is None if its fit failed."""

    name: str
    numbers: dict[str, Any]

    @property
    def error(self) -> float | None:
        """Of held-out rays, in scene units."""
        return self.numbers.get("error")

    @property
    def is_falling(self) -> bool:
        """Whether its fit was stopped while its error still fell."""
        return bool(self.numbers.get("falling"))

    def held(self, *, by_pixel: bool) -> float | None:
        """The fraction of draws of further views on which it suffices, under half a pixel or as good as the best."""
        return self.numbers.get("held_enough" if by_pixel else "held_within")

    @property
    def kind(self) -> str:
        return next(kind for kind in KINDS if self.name.startswith(kind))

    @property
    def label(self) -> str:
        return self.name.replace("_", " ")


@dataclass(frozen=True)
class Candidates:
    """The results of all candidates of a run, in the order of their fits."""

    results: list[CandidateResult]
    chosen: CandidateResult | None  # the recommended candidate
    best: CandidateResult | None  # the candidate with the smallest error
    measure: str  # of size, for the choice
    footprint: float | None  # half a pixel, in scene units

    def smallest(self, measure: str, *, by_pixel: bool) -> CandidateResult | None:
        """The confirmed candidate with the least `measure` that suffices, by half a pixel or by the best error."""
        if self.best is None or self.footprint is None:
            return None
        limit = self.footprint if by_pixel else self.best.numbers["error"] + self.best.numbers["standard_error"]
        sufficient = [result for result in self.results if result.error is not None and result.error <= limit]
        for result in (ordered := sorted(sufficient, key=lambda result: (result.numbers[measure], result.error))):
            held = result.held(by_pixel=by_pixel)
            if held is None:  # a record without checks of this candidate
                return result if result is ordered[0] else None
            if held >= CONFIRMED_FROM:
                return result
        return None

    @staticmethod
    def of(metrics: dict[str, Any]) -> "Candidates":
        fit_names = [name.removesuffix(".stored") for name in metrics if name.endswith(".stored")]
        names = [name for name in fit_names if name not in ("auto", "frugal")]  # further fits of candidates
        results = {
            name: CandidateResult(
                name, {key.removeprefix(f"{name}."): x for key, x in metrics.items() if key.startswith(f"{name}.")}
            )
            for name in names
        }
        chosen, best = (results.get(metrics.get(f"{which}_field", "")) for which in ("recommended", "best"))
        if chosen is not None:  # records of older versions have only the check of this candidate
            for key, older in (("held_enough", "held_out_seeds_held"), ("held_within", "held_out_seeds_within")):
                chosen.numbers.setdefault(key, metrics.get(older))
        measure, footprint = metrics.get("recommended_by", "stored"), metrics.get("footprint")
        return Candidates(list(results.values()), chosen, best, measure, footprint)


def marker_points(stored: int) -> float:
    """The diameter of a marker in points, linear in the logarithm of the stored numbers."""
    return 2.5 + 1.1 * log10(max(stored, 1))


@rc_context(style.SCREEN)
def draw_candidates(folder: Path, metrics: dict[str, Any], title: str) -> None:
    figure = Figure(figsize=(9.0, 4.0), layout="constrained")
    _panels(figure.subplots(1, 2, sharey=True), Candidates.of(metrics))
    figure.suptitle(title)
    style.save(figure, folder / "ladder.png")


def _panels(axes: np.ndarray, candidates: Candidates) -> None:
    fitted = [result for result in candidates.results if result.error is not None]
    for axis, key in zip(axes, (candidates.measure, FLOPS), strict=True):
        for kind, (label, colour, marker) in KINDS.items():
            fits = [result.numbers for result in fitted if result.kind == kind]
            if fits:
                x, y, spread = ([fit[name] for fit in fits] for name in (key, "error", "standard_error"))
                axis.errorbar(x, y, yerr=spread, fmt=marker, color=colour, ms=4, lw=0.8, label=label)
        axis.axhline(candidates.footprint, color="#888888", lw=0.9, ls="--", label="half a pixel")
        if candidates.best is not None:
            low, spread = (candidates.best.numbers[name] for name in ("error", "standard_error"))
            label = "one standard error of the best"
            axis.axhspan(low, low + spread, color="#cccccc", alpha=0.6, lw=0, label=label)
        if candidates.chosen is not None:
            point = candidates.chosen.numbers[key], candidates.chosen.error
            axis.plot(*point, "o", ms=9, mfc="none", mec="#111111", mew=1.2, label="recommended")
            axis.annotate(candidates.chosen.label, point, (0, 9), textcoords="offset points", ha="center", fontsize=7)
        axis.set(xscale="log", yscale="log", xlabel=AXES[key])
        style.log_axis(axis, "y", [result.error for result in fitted])
    axes[0].set_ylabel("held-out error (scene units)")
    figure_style.legend_below(axes[0].figure, axes[-1])
