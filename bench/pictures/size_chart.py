"""Reads the candidates of a capacity run from its metrics, and draws their errors over their costs."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from bench.pictures import style

KINDS = {  # kinds of candidates by the beginning of their names: label, colour, marker
    "network": ("networks", "#0072b2", "s"),
    "grid": ("narrow-band grid", "#9a6a1f", "v"),
    "union": ("unions of boxes", "#009e73", "P"),
    "": ("one part", "#d55e00", "o"),
}
FLOPS = "flops_per_query"
AXES = {"stored": "stored numbers", "free": "free numbers", "bytes": "bytes", FLOPS: "FLOPs per query"}


@dataclass(frozen=True)
class CandidateResult:
    """The result of a candidate; `error` is None where its fit failed."""

    name: str
    numbers: dict[str, Any]

    @property
    def error(self) -> float | None:
        """The error on held-out rays, in scene units."""
        return self.numbers.get("error")

    @property
    def kind(self) -> str:
        """Its key in `KINDS`."""
        return next(kind for kind in KINDS if self.name.startswith(kind))

    @property
    def label(self) -> str:
        """Its name for readers."""
        return self.name.replace("_", " ")


@dataclass(frozen=True)
class Candidates:
    """The results of all candidates of a run, in the order of their fits."""

    results: list[CandidateResult]
    metrics: dict[str, Any]

    @staticmethod
    def of(metrics: dict[str, Any]) -> "Candidates":
        """The candidates of a record's metrics."""
        fits = [name.removesuffix(".stored") for name in metrics if name.endswith(".stored")]
        names = [name for name in fits if name not in ("auto", "frugal")]  # further fits of candidates
        numbers = {
            name: {k[len(name) + 1 :]: v for k, v in metrics.items() if k.startswith(f"{name}.")} for name in names
        }
        return Candidates([CandidateResult(name, numbers[name]) for name in names], metrics)

    @property
    def measure(self) -> str:
        """The measure of size by which the choice is made."""
        return self.metrics.get("recommended_by", "stored")

    @property
    def footprint(self) -> float:
        """Half a pixel, in scene units."""
        return self.metrics["footprint"]

    def result(self, name: str) -> CandidateResult | None:
        """The result of the candidate of that name; None where there is none."""
        return next((result for result in self.results if result.name == name), None)

    @property
    def chosen(self) -> CandidateResult | None:
        """The recommended candidate."""
        return self.result(self.metrics.get("recommended_field", ""))

    @property
    def best(self) -> CandidateResult | None:
        """The candidate with the least error."""
        return self.result(self.metrics.get("best_field", ""))


def panels(axes: np.ndarray, candidates: Candidates) -> None:
    """Draws the error over the size and over FLOPs per query: standard errors, half a pixel, the recommended one."""
    fitted = [result for result in candidates.results if result.error is not None]
    for axis, key in zip(axes, (candidates.measure, FLOPS), strict=True):
        for kind, (label, colour, marker) in KINDS.items():
            numbers = [result.numbers for result in fitted if result.kind == kind]
            if numbers:
                x, y, spread = ([own[name] for own in numbers] for name in (key, "error", "standard_error"))
                axis.errorbar(x, y, yerr=spread, fmt=marker, color=colour, ms=4, lw=0.8, label=label)
        axis.axhline(candidates.footprint, color="#888888", lw=0.9, ls="--", label="half a pixel")
        if candidates.best is not None:
            low, spread = (candidates.best.numbers[name] for name in ("error", "standard_error"))
            label = "one standard error of the best"
            axis.axhspan(low, low + spread, color="#cccccc", alpha=0.6, lw=0, label=label)
        if candidates.chosen is not None:
            at = candidates.chosen.numbers[key], candidates.chosen.error
            axis.plot(*at, "o", ms=9, mfc="none", mec="#111111", mew=1.2, label="recommended")
            axis.annotate(candidates.chosen.label, at, (0, 9), textcoords="offset points", ha="center", fontsize=7)
        axis.set(xscale="log", yscale="log", xlabel=AXES[key])
        style.log_axis(axis, "y", [result.error for result in fitted])
    axes[0].set_ylabel("held-out error (scene units)")
    style.legend_below(axes[0].figure, axes[-1])
