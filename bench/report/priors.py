"""How well each prior shows unseen shapes at best: pictures, the length of its gradient, and the metric's floor."""

import zipfile
import zlib
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bench.report import format, pictures, statistics, style
from bench.report.caption import joined, omitted, outcome, setup
from bench.report.experiments import Experiment, definitions, family, identity, measured
from bench.report.tables import Result

SHOWN = 3  # shapes of a family in the figure
SCALE = 1000.0
DEFINED = {
    "chamfer_l2": "Fit",
    "floor_chamfer_l2": "Floor",
    "distance_error": "Error of the distance",
    "slope_median": "|gradient|",
    "slope_p99": "|gradient|, 99 %",
}


def make(experiment: Experiment) -> Result:
    """A row a family: the fit of its shapes beside the floor."""
    families = dict.fromkeys(family(record) for record in experiment.records)
    rows = {name: [r for r in experiment.records if family(r) == name] for name in families}
    return Result(
        name="priors",
        title="The priors at their best.",
        caption=joined(
            setup(experiment),
            "A code of each prior is fitted to the signed distances of an unseen shape (DeepSDF, Eq. 10). Chamfer "
            "distance times 1000 (squared scene units) of the fit, beside its floor, that of two samplings of the "
            "truth; medians over shapes, a run that did not end ok counts as infinite. Pictures: normals of the truth "
            "and of the fit, in pairs. Histograms: length of the field's gradient within 0.02 of the true surface, all "
            "shapes of a family together; 1 for a distance.",
            outcome(experiment),
            omitted(experiment),
        ),
        data=pd.DataFrame([_raw(record) for record in experiment.records], dtype=object),
        table=pd.DataFrame([_row(name, records) for name, records in rows.items()]),
        notes=definitions(experiment.records, DEFINED),
        figure=draw(experiment, rows),
    )


@style.styled
def draw(experiment: Experiment, rows: dict[str, list[dict[str, Any]]]) -> Figure:
    """A line a family: pairs of pictures, then the histogram."""
    figure = Figure(figsize=(style.WIDTH, 1.05 * len(rows) + 0.45), layout="constrained")
    figure.get_layout_engine().set(w_pad=0.02, h_pad=0.02, wspace=0.01, hspace=0.01)
    axes = figure.subplots(
        len(rows), 2 * SHOWN + 1, squeeze=False, gridspec_kw={"width_ratios": [1] * 2 * SHOWN + [1.7]}
    )
    for line, (name, records) in zip(axes, rows.items(), strict=True):
        for axis in line[:-1]:
            style.bare(axis)
        line[0].set_ylabel(name)
        for place, record in enumerate(records[:SHOWN]):
            _pair(line[2 * place], line[2 * place + 1], experiment, record)
        _histogram(line[-1], [_lengths(experiment, record) for record in records])
    for axis, title in zip(axes[0], ("truth", "fit") * SHOWN, strict=False):
        axis.set_title(title)
    axes[0, -1].set_title("length of the gradient")
    return figure


def _pair(true: Axes, found: Axes, experiment: Experiment, record: dict[str, Any]) -> None:
    images, why = pictures.load(experiment.folder(record))
    if images is None:
        found.text(0.5, 0.5, why or record["status"], ha="center", va="center", fontsize=5, transform=found.transAxes)
        return
    both = ((true, images.reference_normals, images.reference_hit), (found, images.normals, images.hit))
    for axis, normals, hit in both:
        axis.imshow(np.where(hit[..., None], np.nan_to_num(normals) / 2 + 0.5, 1.0).clip(0, 1), interpolation="auto")
    ratio = _ratio(record)
    found.set_xlabel("" if ratio is None else f"{format.number(ratio)} × floor", fontsize=6, labelpad=1)


def _histogram(axis: Axes, lengths: list[np.ndarray]) -> None:
    together = np.concatenate(lengths)
    if together.size:
        axis.hist(together.clip(0, 2), bins=np.linspace(0, 2, 41), color="#0072b2", density=True)
    axis.axvline(1.0, color="#777777", lw=0.8, ls=":")
    axis.set(yticks=[], xlim=(0, 2))


def _lengths(experiment: Experiment, record: dict[str, Any]) -> np.ndarray:
    path = experiment.folder(record) / "images.npz"
    try:
        with path.open("rb") as raw, np.lib.npyio.NpzFile(raw, allow_pickle=False) as file:
            found = np.asarray(file["gradient_length"], dtype=float)
    except (KeyError, OSError, ValueError, EOFError, zipfile.BadZipFile, zlib.error):
        return np.empty(0)
    return found[np.isfinite(found)]


def _ratio(record: dict[str, Any]) -> float | None:
    fit, floor = measured(record, "chamfer_l2"), measured(record, "floor_chamfer_l2")
    return None if fit is None or not floor else fit / floor


def _row(name: str, records: list[dict[str, Any]]) -> dict[str, str]:
    ratios = [_worst(_ratio(record), record) for record in records]
    return {
        "Family": name,
        "Shapes": str(len(records)),
        "Fit": _middle(records, "chamfer_l2", SCALE),
        "Floor": _middle(records, "floor_chamfer_l2", SCALE),
        "Fit / floor": format.number(float(statistics.median(ratios))),
        "largest": format.number(max(ratios)),
        "Error of the distance": _middle(records, "distance_error"),
        "|gradient|": _middle(records, "slope_median"),
        "|gradient|, 99 %": _middle(records, "slope_p99"),
    }


def _middle(records: list[dict[str, Any]], name: str, scale: float = 1.0) -> str:
    values = [_worst(measured(record, name), record) for record in records]
    return format.number(float(statistics.median(values)), scale)


def _worst(value: float | None, record: dict[str, Any]) -> float:
    return np.inf if value is None or record["status"] != "ok" else value


def _raw(record: dict[str, Any]) -> dict[str, Any]:
    names = ("chamfer_l2", "floor_chamfer_l2", "distance_error", "slope_median", "slope_p99")
    numbers = {name: measured(record, name) for name in names}
    return {"family": family(record), **identity(record), **numbers, "ratio": _ratio(record)}
