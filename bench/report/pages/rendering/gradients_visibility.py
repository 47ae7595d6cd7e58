"""What comes into view: the gradient of the image at the outline, by the length over which a renderer spreads it."""

import math
from collections.abc import Iterator

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bench.pictures import style
from bench.records import format
from bench.report.data.experiments import Experiment
from bench.report.data.records import Record, measured, row_of
from bench.report.pages.rendering.gradients import READS as READS
from bench.report.write import chart
from bench.report.write.answer import Answer
from bench.report.write.result import Result
from bench.report.write.table import IDENTITY, Column, shown, text, through, to_data, to_table

PLACE = 205
BAND = "silhouette"
OWN = ""  # the blur of the renderer itself, in place of a number
NOTES = (
    "A pixel at the outline is the mean over many rays of the distance that each sees, with the far side of the unit "
    "sphere behind. The truth are central differences of that image, in which visibility changes.",
    "Error: length of the difference of the two gradients over that of the true one, all pixels and directions "
    "together; that of a gradient of zeros is 1. Noise: what the rays of a pixel differ by, in the same unit: it is "
    "the error of one ray per pixel, and falls with the square root of their number.",
    "Cosine and scale are of each pixel's own gradient. A blur of a pixel or more moves the gradient to the pixels "
    "beside, which lowers both; the sum over an image it keeps.",
    "Blur: the length over which a renderer spreads the gradient of visibility: NeuS 1/s, VolSDF beta, UNISURF the "
    "width of the occupancy, the relaxed boundary its band; a pixel at the outline is about 0.01 scene units wide. A "
    "renderer without one has one row.",
    "The truth has an error of its own, since few of a pixel's rays change sides: of a disc, at the defaults, 0.07 of "
    "its length, and a cosine of 0.997 with the exact one.",
    "UNISURF's interval keeps its proportion to the blur. No schedule is at work.",
)
NUMBERS = ("image_cosine", "image_scale", "image_error", "image_spread", "values_per_ray")
HEADINGS = ("Cosine", "Scale", "Error", "Noise of a ray", "Values per ray")
Line = tuple[Record, str]  # of a record and a blur


def make(experiment: Experiment) -> Result:
    """Makes the page, with a line per renderer and blur, including failed runs."""
    lines = [(record, blur) for record in experiment.named() for blur in _blurs(record)]
    data = to_data(COLUMNS, lines)
    return Result(
        experiment,
        "Gradients of what comes into view.",
        "At the outline, the gradient of the image of distances towards the code against the true one: cosine and "
        "scale are 1 and the error is 0 where it is exact.",
        remarks=NOTES,
        data=data,
        table=to_table(COLUMNS, lines),
        figure=draw(data.assign(name=[r["name"] for r, _ in lines], preset=[row_of(r).preset for r, _ in lines])),
    )


@style.styled
def draw(data: pd.DataFrame) -> Figure:
    """The error and the noise over the blur, and the error over the cost; a line per renderer."""
    figure, axes = chart.sheet(2.8, 1, 3)
    by_blur, noise, by_cost = axes[0]
    for name, rows in data.groupby("name", sort=False):
        preset, status = rows[["preset", "status"]].iloc[0]
        label = str(name) if status == "ok" else f"{name} ({status})"
        swept = rows[rows["blur"] != OWN].astype({"blur": float}).sort_values("blur")
        chart.line(by_cost, preset, *_known(swept, "values_per_ray", "image_error"), label=label)
        chart.line(by_blur, preset, *_known(swept, "blur", "image_error"))
        chart.line(noise, preset, *_known(swept, "blur", "image_spread"))
        if swept.empty:
            chart.points(by_cost, preset, *_known(rows, "values_per_ray", "image_error"))
            for axis, metric in ((by_blur, "image_error"), (noise, "image_spread")):
                for value in rows[metric].dropna():
                    axis.axhline(value, color=style.look(preset).colour, ls=style.look(preset).line, lw=0.8)
    _dress(by_blur, "blur (scene units)", "relative error of the gradient")
    _dress(noise, "blur (scene units)", "noise of one ray (relative)")
    _dress(by_cost, "field values per ray", "relative error of the gradient")
    style.legend_below(figure, by_cost, columns=4)
    return figure


def _dress(axis: Axes, across: str, up: str) -> None:
    axis.set(xlabel=across, ylabel=up)
    drawn = [line for line in axis.lines if line.get_marker() != "None" and len(line.get_xdata())]
    if not drawn:
        chart.say(axis, "no numbers", va="baseline", color="#777777")
        return
    style.log_axis(axis, "x", [x for line in drawn for x in line.get_xdata()])
    style.log_axis(axis, "y", [y for line in axis.lines for y in line.get_ydata()])


def _known(rows: pd.DataFrame, *names: str) -> list[list[float]]:
    """The values of two columns, where both are finite and above 0, so that logarithmic axes can show them."""
    some = rows[[*names]].apply(pd.to_numeric, errors="coerce")
    some = some[(some > 0).all(axis=1) & some.map(math.isfinite).all(axis=1)]
    return [some[name].tolist() for name in names]


def _blurs(record: Record) -> Iterator[str]:
    """The blurs of which a record has numbers, from the least; of none, its own."""
    keys = {key.partition(".")[0] for key in record["metrics"] if key.startswith(f"{BAND}_")}
    yield from sorted((key.removeprefix(f"{BAND}_") for key in keys), key=float) or [OWN]


def _number(name: str, heading: str) -> Column:
    def value(line: Line) -> float | None:
        record, blur = line
        return measured(record, f"{BAND}_{blur}.{name}" if blur else f"{BAND}.{name}")

    return Column(name, heading, value, format.number)


COLUMNS = (  # of a record and a blur
    shown("Renderer", lambda line: line[0]["name"]),
    *through(lambda line: line[0], *IDENTITY),
    text("blur", "Blur (scene units)", lambda line: line[1] and f"{float(line[1]):g}"),
    *(_number(name, heading) for name, heading in zip(NUMBERS, HEADINGS, strict=True)),
    shown("Status", lambda line: line[0]["status"]),
)


def answer(data: pd.DataFrame, notes: list[str]) -> Answer:
    """The best cosine at the outline, and the best of the renderers that differentiate hits alone."""
    known = data[data["status"] == "ok"].dropna(subset="image_cosine")
    blurred, sharp = known.dropna(subset="blur"), known[known["blur"].isna()]
    said = []
    if len(blurred):
        best = blurred.loc[blurred["image_cosine"].idxmax()]
        said.append(
            f"{best['row']} has a cosine of *{best['image_cosine']:.2f}* and a scale of {best['image_scale']:.2f} "
            f"at a blur of {best['blur']:g} scene units"
        )
    if len(sharp):
        said.append(
            f"renderers that differentiate hits alone have at most {sharp['image_cosine'].max():.3g} and "
            f"{sharp['image_scale'].max():.3g}"
        )
    return Answer("Does what comes into view have a gradient?", f"{'; '.join(said)}." if said else "")
