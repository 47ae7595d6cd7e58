"""Errors of gradients against central differences: at hits by angle of incidence, at the outline by blur."""

from collections.abc import Iterable, Sequence

import pandas as pd
from matplotlib.figure import Figure

from bench.report.study import Result, Runs, Selection, chart, format, style, table

PLACE = 200
READS = (Selection("gradients", alike=("dataset", "view", "prior", "task")),)
ANGLES = {"frontal": "#9ecae1", "oblique": "#4292c6", "grazing": "#08306b"}  # bands of hits, and their colours
OUTLINE = "silhouette"
BANDS = (*ANGLES, OUTLINE, "colour")
ERRORS = ("pooled_cosine", "pooled_scale", "cosine", "scale", "median_error", "p99_error")
COUNTS = ("pixels", "excluded")
IMAGE_METRICS = ("image_cosine", "image_scale")
NUMBERS = (*COUNTS, *(f"{to}_{error}" for to in ("code", "camera", "texture") for error in ERRORS), *IMAGE_METRICS)
VISIBILITY_HEADINGS = {  # headings of the metrics of the image at the outline
    **dict(zip(IMAGE_METRICS, ("Cosine", "Scale"), strict=True)),
    **{"image_error": "Error", "image_spread": "Noise of a ray", "values_per_ray": "Evaluations per ray"},
}
EDGES_NOTE = (
    "The silhouette's rays are no image, so edge sampling splits no pixels here. It has a band, like the relaxed "
    "boundary, and nearly the same numbers. The page “outline” has edge sampling with whole images."
)
NOTES = (
    "A pooled number compares the gradients of all pixels of a band as one long vector. A factor that differs between "
    "pixels lowers the pooled cosine, but not the cosine of a single pixel.",
    "An error is the length of the difference divided by the length of the true gradient. Hits are frontal, oblique or "
    "grazing, by the angle between ray and normal. The gradient of the silhouette is that of one image.",
    "Excluded: pixels where visibility changes, the root is not found again, or the renderer misses or hits another "
    "surface.",
    "Colour: the gradient of a smooth colour of point and normal, for shape (code), camera and colours (texture).",
    "The silhouette is at each renderer's default blur. The page “gradients_visibility” has equal blurs.",
    EDGES_NOTE,
)
VISIBLE_NOTES = (
    "A pixel at the outline is the mean distance of many rays; a miss has the distance of the far side of the unit "
    "sphere. The true gradient is a central difference of this image, so changes of visibility are included.",
    "Error: the length of the difference divided by the length of the true gradient, so a gradient of zero has "
    "an error of 1. Noise: the error with one ray per pixel. It falls with the square root of the number of rays.",
    "Blur: the length over which a renderer spreads the visibility gradient (NeuS: 1/s, VolSDF: beta, UNISURF: width "
    "of the occupancy, relaxed boundary: the band). A pixel at the outline is about 0.01 scene units wide.",
    "A blur of a pixel or more moves the gradient to neighbouring pixels. This lowers the cosine and the scale of a "
    "pixel, but not the sum over the image.",
    EDGES_NOTE,
    "For a disc, with default settings, the central difference has an error of 0.07 and a cosine of 0.997, because few "
    "rays of a pixel change sides.",
)


def make(runs: Runs) -> Result:
    data = _band_lines(runs, BANDS, NUMBERS)
    unseen = int((data.loc[data["band"].isin(ANGLES), ["code_median_error", "camera_median_error"]] == 0).sum().sum())
    return Result(
        runs,
        "Errors of the gradients.",
        "Cosine and scale of a renderer's gradient relative to the true gradient (1 if exact), pooled over a band of "
        "pixels and per pixel, and the relative error. The figure has the median relative error of hits and, for the "
        "silhouette, cosine and scale.",
        question="How accurate are the gradients of each renderer?",
        verdict=_verdict(data),
        remarks=(*NOTES, f"The figure's logarithmic axes leave out {unseen} errors of exactly zero." if unseen else ""),
        columns=COLUMNS,
        lines=data.to_dict("records"),
        data=data.drop(columns=["name", "preset"]),
        figure=draw(data),
    )


def make_visibility(runs: Runs) -> Result:
    data = _blur_lines(runs)
    return Result(
        runs,
        "Visibility gradients.",
        "At the outline, the gradient of the image of distances for the code, relative to the true gradient (if exact, "
        "cosine and scale are 1 and the error is 0).",
        question="Do the gradients include surface that enters or leaves the view?",
        verdict=_visibility_verdict(data),
        remarks=VISIBLE_NOTES,
        columns=VISIBILITY_COLUMNS,
        lines=data.to_dict("records"),
        data=data.drop(columns=["name", "preset", "band"]),
        figure=draw_visibility(data),
    )


def _band_lines(runs: Runs, bands: Iterable[str], names: Sequence[str]) -> pd.DataFrame:
    """A line per run and band, with the run's preset and readable name."""
    identity = table.to_data(table.IDENTITY, runs.records).assign(preset=list(runs.frame.preset), name=runs.names())
    tables = [
        identity.assign(band=band, **{name: runs.number(f"{band}.{name}", optional=True) for name in names})
        for band in bands
    ]
    return pd.concat(tables).sort_index(kind="stable")


def _blur_lines(runs: Runs) -> pd.DataFrame:
    """A line per run and measured blur, the smallest first; nan for a renderer without a blur."""
    prefix = f"{OUTLINE}_"
    keys = {key.partition(".")[0].removeprefix(prefix) for key in runs.frame if key.startswith(prefix)}
    data = _band_lines(runs, [*(prefix + blur for blur in sorted(keys, key=float)), OUTLINE], [*VISIBILITY_HEADINGS])
    data.insert(data.columns.get_loc("band"), "blur", pd.to_numeric(data["band"].str.removeprefix(prefix), "coerce"))
    blurred = data["blur"].notna() & data[[*VISIBILITY_HEADINGS]].notna().any(axis=1)
    sharp = data["blur"].isna() & ~data.index.isin(data.index[blurred])
    return data[blurred | sharp].reset_index(drop=True)


def _verdict(data: pd.DataFrame) -> str:
    hits = data[data["band"].isin(ANGLES)]
    cosines = hits["code_pooled_cosine"].where(hits["status"] == "ok").groupby(hits["name"], sort=False)
    least = cosines.min(min_count=len(ANGLES))  # NaN if a band is missing
    reached = f"{(least >= 0.99).sum()} of {len(least)}"
    names = "; ".join(map(str, least.index[least >= 0.99]))
    which = f"the code: {names}" if names else "the code"
    title = f"{reached} rows reach a pooled cosine of 0.99 in all bands of hits, for {which}. Cosine of the lowest band"
    return table.extremes(title, least.to_dict(), "one shape", show=_cosine, largest_first=True)


def _visibility_verdict(data: pd.DataFrame) -> str:
    measured = data[(data["status"] == "ok") & data["image_cosine"].notna()]
    blurred, sharp = measured[measured["blur"].notna()], measured[measured["blur"].isna()]
    parts = []
    if len(blurred):
        best = blurred.loc[blurred["image_cosine"].round(2).idxmax()]  # the first of equal ones
        parts.append(
            f"{best['name']} has a cosine of *{best['image_cosine']:.2f}* and a scale of {best['image_scale']:.2f} at "
            f"a blur of {best['blur']:g} scene units"
        )
    if len(sharp):
        most = sharp[[*IMAGE_METRICS]].max()
        ends = f"a cosine of at most {most.iloc[0]:.3g} and a scale of at most {most.iloc[1]:.3g}"
        parts.append(f"Renderers that differentiate only hits have {ends}")
    return f"{'. '.join(parts)} (n = one shape)." if parts else ""


def draw(data: pd.DataFrame) -> Figure:
    status = dict(zip(data["name"], data["status"], strict=True))
    rows = [name if end == "ok" else f"{name} ({end.replace('_', ' ')})" for name, end in status.items()]

    def points(name: str, column: str, band: str, colour: str, symbol: str) -> chart.Series:
        band_data = data[data["band"] == band]
        positions = band_data["name"].map(list(status).index).tolist()
        return {"name": name, "x": style.finite(band_data[column]), "y": positions, "colour": colour, "symbol": symbol}

    panels = []
    for to in ("code", "camera"):
        drawn = [points(band, f"{to}_median_error", band, colour, "o") for band, colour in ANGLES.items()]
        panels.append(chart.panel_data(f"gradient for the {to}", "median relative error (ratio)", "", drawn, rows=rows))
    drawn = [
        points(name.replace("image_", ""), name, OUTLINE, "#444444", symbol)
        for name, symbol in zip(IMAGE_METRICS, "DP", strict=True)
    ]
    panels.append(chart.panel_data(OUTLINE, "cosine and scale (exact: 1)", "", drawn, rows=rows))
    panels[-1]["x"]["log"] = False
    return chart.draw(panels, 0.2 * len(rows) + 1.3, legend=5, sharey=True)


def draw_visibility(data: pd.DataFrame) -> Figure:
    sharp, blurs, panels = data[data["blur"].isna() & data["image_cosine"].notna()], data["blur"].dropna(), []
    for name in IMAGE_METRICS if len(blurs) else ():
        lines = [
            chart.curve(row, preset, row_data["blur"], style.finite(row_data[name]))
            for (row, preset), row_data in data[data["blur"].notna()].groupby(["name", "preset"], sort=False)
        ]
        for end in ("min", "max") if len(sharp) else ():
            label = f"without a blur: least and most of {sharp['name'].nunique()} rows"
            lines.append(chart.level(label, blurs, getattr(sharp[name], end)()))
        lines.append(chart.level("exact", blurs, 1.0, dash=":"))
        panels.append(chart.panel_data("", "blur (scene units)", VISIBILITY_HEADINGS[name].lower(), lines))
    return chart.draw(panels, 2.8)


def _cosine(value: float | None) -> str:
    return format.number(value) if value is None else f"{value:.5f}"


def _column(name: str) -> table.Column:
    show = table.integer if name in COUNTS else _cosine if name.endswith("cosine") else format.number
    return table.Column(name, name.replace("_", " ").capitalize(), show=show)


COLUMNS = (
    *table.columns(table.word, name="Renderer", band="Band"),
    *map(_column, NUMBERS),
    table.text("status", "Status"),
)
VISIBILITY_COLUMNS = (
    table.text("name", "Renderer"),
    table.Column("blur", "Blur (scene units)", show=lambda x: "" if x is None else f"{x:g}"),
    *table.columns(**VISIBILITY_HEADINGS),
    table.text("status", "Status"),
)

PAGES = {"gradients": make, "gradients_visibility": make_visibility}
