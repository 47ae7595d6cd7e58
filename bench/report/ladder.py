"""The rungs of a capacity run, read from its metrics, and how they are drawn."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from bench.report import style

KINDS = {  # of rungs, by the beginning of their names
    "network": ("networks", "#0072b2", "s"),
    "grid": ("narrow-band grid", "#9a6a1f", "v"),
    "union": ("unions of boxes", "#009e73", "P"),
    "": ("one part", "#d55e00", "o"),
}
AXES = {"parameters": "free numbers", "flops_per_query": "FLOPs a query"}


@dataclass(frozen=True)
class RungResult:
    """What a rung came to; `error` is None where its fit failed."""

    name: str
    numbers: dict[str, Any]

    @property
    def error(self) -> float | None:
        """On held-out rays, in scene units."""
        return self.numbers.get("error")

    @property
    def kind(self) -> str:
        """The beginning of its name that `KINDS` has."""
        return next(kind for kind in KINDS if self.name.startswith(kind))

    @property
    def label(self) -> str:
        """For readers."""
        return self.name.replace("_", " ")


@dataclass(frozen=True)
class Ladder:
    """All rungs of a run, in the order of their fits."""

    rungs: list[RungResult]
    metrics: dict[str, Any]

    @staticmethod
    def of(metrics: dict[str, Any]) -> "Ladder":
        """The ladder of a record's metrics."""
        names = [name.removesuffix(".parameters") for name in metrics if name.endswith(".parameters")]
        own = [name for name in names if name not in ("auto", "frugal")]
        numbers = {
            name: {k[len(name) + 1 :]: v for k, v in metrics.items() if k.startswith(f"{name}.")} for name in own
        }
        return Ladder([RungResult(name, numbers[name]) for name in own], metrics)

    @property
    def footprint(self) -> float:
        """Half a pixel, in scene units."""
        return self.metrics["footprint"]

    def rung(self, name: str) -> RungResult | None:
        """The rung of that name."""
        return next((rung for rung in self.rungs if rung.name == name), None)

    @property
    def chosen(self) -> RungResult | None:
        """The recommended one."""
        return self.rung(self.metrics.get("recommended_field", ""))

    @property
    def best(self) -> RungResult | None:
        """The one of the least error."""
        return self.rung(self.metrics.get("best_field", ""))


def panels(axes: np.ndarray, ladder: Ladder) -> None:
    """Error over free numbers and over FLOPs a query, with the recommended rung ringed."""
    for axis, (key, heading) in zip(axes, AXES.items(), strict=True):
        panel(axis, ladder, key)
        name_chosen(axis, ladder, key)
        axis.set_xlabel(heading)
    axes[0].set_ylabel("held-out error (scene units)")
    handles, labels = axes[-1].get_legend_handles_labels()
    axes[0].figure.legend(handles, labels, loc="outside lower center", ncols=4)


def panel(axis: Axes, ladder: Ladder, key: str) -> None:
    """Error over one cost, with standard errors, the footprint, and the band of one standard error above the best."""
    for kind, (label, colour, marker) in KINDS.items():
        own = [rung for rung in ladder.rungs if rung.kind == kind and rung.error is not None]
        if own:
            x, y, spread = (np.array([rung.numbers[name] for rung in own]) for name in (key, "error", "standard_error"))
            axis.errorbar(x, y, yerr=spread, fmt=marker, color=colour, ms=4, lw=0.8, label=label)
    chosen, best = ladder.chosen, ladder.best
    axis.axhline(ladder.footprint, color="#888888", lw=0.9, ls="--", label="half a pixel")
    if best is not None:
        top = best.numbers["error"] + best.numbers["standard_error"]
        axis.axhspan(
            best.numbers["error"], top, color="#cccccc", alpha=0.6, lw=0, label="one standard error of the best"
        )
    if chosen is not None:
        at = chosen.numbers[key], chosen.numbers["error"]
        axis.plot(*at, "o", ms=9, mfc="none", mec="#111111", mew=1.2, label="recommended")
    axis.set(xscale="log", yscale="log")
    style.log_axis(axis, "y", [rung.error for rung in ladder.rungs if rung.error is not None])


def name_chosen(axis: Axes, ladder: Ladder, key: str) -> None:
    """Writes the recommended rung's name above its ring."""
    if (chosen := ladder.chosen) is not None:
        at = chosen.numbers[key], chosen.numbers["error"]
        axis.annotate(chosen.label, at, (0, 9), textcoords="offset points", ha="center", fontsize=7)
