"""Fig. 5 of DIST: loss and Chamfer distance over iterations and time, and their rank correlation."""

import math
from itertools import product
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from bench.report.data.records import SCALE, Row, grouped, median_of_known, setting
from bench.report.data.runs import shared_loss
from bench.report.study import Result, Runs, Selection, chart, curves, format, style, table

PLACE = 220
READS = (Selection("fig5", alike=("dataset", "view", "prior", "task")),)
QUANTITIES = {"total": ("weighted loss", 1.0), "chamfer_l2": ("Chamfer × 1000 (scene units²)", SCALE)}
ALONG = {"iteration": "iteration", "seconds": "time (seconds)"}
COLUMNS = (
    *(table.text("row", "Method"), table.Column("runs", "Runs", show=table.whole)),
    *(
        table.Column(key, heading, show=table.thousandfold)
        for key, heading in (("end", "End"), ("low", "least"), ("high", "most"))
    ),
    *(table.Column("seconds", "Loop", show=format.seconds), table.Column("spearman", "ρ")),
)
HIGH = 0.7  # a correlation that is called high
NOTES = (
    "Chamfer distance is chamfer_l2, in squared scene units, times 1000; it is measured during the optimisation, but "
    "not used by it.",
    "A line is the median over a row's runs; after its end a failed run counts as infinite.",
    "ρ is Spearman's rank correlation of loss and Chamfer over the iterations of a run that have both, in the median "
    "of a row's runs: points of one run are not independent, so it is no test.",
)
Medians = dict[str, pd.DataFrame]  # of each quantity


def make(runs: Runs) -> Result:
    """A curve per row, the median over its runs, and a line with its end."""
    read = {record["folder"]: curves.read(runs.folder(record)) for record in runs.records}
    unread = [f"{record['name']}: {why}." for record in runs.named() if (why := read[record["folder"]][1])]
    medians: dict[Row, Medians] = {}
    lines: list[dict[str, Any]] = []
    for row, records in runs.rows().items():
        own = [read[record["folder"]][0] for record in records]
        failed = [record["status"] != "ok" for record in records]
        medians[row] = {name: curves.median(own, failed, name) for name in QUANTITIES}
        found = [curves.spearman(curve.dropna(subset=[*QUANTITIES]), *QUANTITIES) for curve in own]
        # Each of one run: losses of shapes do not compare.
        correlation = {"spearman": median_of_known(found), "n": len(found) - found.count(None)}
        seconds = medians[row]["chamfer_l2"]["seconds"]
        about = {"row": row.name, "runs": len(records), "seconds": seconds.iloc[-1] if len(seconds) else None}
        lines.append({**about, **_end(own, failed), **correlation})
    return Result(
        runs,
        "Loss and Chamfer distance as shapes are completed.",
        f"Loss and Chamfer distance over iterations{' and seconds' if runs.timed else ''}.",
        question="Does the error fall with the loss?",
        verdict=f"{_verdict(lines)} {_ends(lines)}".strip(),
        remarks=(*unread, _loss(runs), *NOTES),
        data=_data(runs, {folder: found for folder, (found, _) in read.items()}, medians, lines),
        columns=COLUMNS,
        lines=lines,
        figure=draw(medians, [along for along in ALONG if along != "seconds" or runs.timed]),
    )


def _verdict(lines: list[dict[str, Any]]) -> str:
    """In which rows loss and error fall together, of rows equal in every digit once; the paper says in all."""
    numbers = ("end", "low", "high", "spearman")
    with_rank = [line for line in lines if line["spearman"] is not None]
    same = grouped(with_rank, lambda line: tuple(line.get(name) for name in numbers)).values()
    ranks = {" = ".join(line["row"] for line in of): of[0]["spearman"] for of in same}  # one computation counts once
    apart = [f"{row} (*{value:.2f}*)" for row, value in ranks.items() if value < HIGH]
    alike = f"{len(ranks) - len(apart)} of {format.plural(len(ranks), 'different row')} (ρ of {HIGH} or more)"
    said = f"not in {', '.join(apart)}" if apart else "as in the paper"
    return f"Loss and error fall together in {alike}; {said}." if ranks else ""


def _ends(lines: list[dict[str, Any]]) -> str:
    return format.ends(
        "Median error at the end (Chamfer × 1000)",
        {line["row"]: line.get("end") for line in lines},
        f"{format.plural(min(line['runs'] for line in lines), 'run')} a row",
        show=table.thousandfold,
    )


def _end(own: list[pd.DataFrame], failed: list[bool]) -> dict[str, Any]:
    """The errors at the end of a row's runs, infinite of failed ones; nothing where one is not known."""
    ends = []
    for curve, lost in zip(own, failed, strict=True):
        known = curve["chamfer_l2"].dropna()
        if known.empty and not lost:
            return {}
        ends.append(math.inf if lost else known.iloc[-1])
    return {"end": float(np.median(ends)), "low": min(ends), "high": max(ends)}


def _loss(runs: Runs) -> str:
    """The terms of the loss, and whether those of different rows can be compared."""
    weight, width = (setting(runs.requested(), "task", f"normal_{name}") for name in ("weight", "width"))
    normals = (
        f"depths, normals over {width} scene units (weight {weight or 0:g}) and the silhouette, as the paper's Fig. 5"
    )
    terms = normals if weight else "depths and the silhouette; the paper's Fig. 5 has normals as well"
    own = "each row has the silhouette loss of its renderer, so that losses of different rows do not compare"
    return f"The loss has {terms}; {'it is the same for every row' if shared_loss(runs.records) else own}."


def draw(medians: dict[Row, Medians], over: list[str]) -> Figure:
    """Draws loss above and Chamfer below, over iterations and seconds, a line per row."""
    panels = []
    for (name, (label, scale)), along in product(QUANTITIES.items(), over):
        lines = [
            chart.curve(row.name, row.preset, style.finite(own[name][along]), style.finite(scale * own[name]["median"]))
            for row, own in medians.items()
        ]
        panels.append(chart.panel_data("", ALONG[along], label, lines))
    return chart.draw(panels, 4.6, len(QUANTITIES))


def _data(runs: Runs, read: dict[str, pd.DataFrame], medians: dict[Row, Medians], lines: list[Any]) -> pd.DataFrame:
    """The CSV, with three kinds of lines: of runs, of medians over a row's runs, and of a row's rank correlation."""
    rows: list[dict[str, Any]] = []
    for record, identity in zip(
        runs.records, table.to_data(table.IDENTITY, runs.records).to_dict("records"), strict=True
    ):
        rows += [{"kind": "run", **identity, **point} for point in _points(read[record["folder"]]) or [{}]]
    for (row, own), line in zip(medians.items(), lines, strict=True):
        for name, shown in own.items():
            names = {"median": name, "low": f"{name}_low", "high": f"{name}_high"}
            found = _points(shown.rename(columns=names))
            rows += [{"kind": "median", "row": row.name, "n": line["runs"], **point} for point in found]
        rows.append({"kind": "correlation", "row": row.name, "n": line["n"], "spearman": line["spearman"]})
    return pd.DataFrame(rows, dtype=object)


def _points(line: pd.DataFrame) -> list[dict[str, Any]]:
    """The lines of a curve, with counts as integers."""
    counts = ("iteration", "value_evaluations")
    return [
        {name: int(x) if name in counts and math.isfinite(x) else x for name, x in point.items()}
        for point in line.to_dict("records")
    ]


PAGES = {"fig5": make}
