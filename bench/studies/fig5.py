"""Fig. 5 of DIST: loss and Chamfer distance over iterations and time, and their rank correlation."""

import math
from itertools import product
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from bench.report.data.records import CHAMFER_SCALE, Row, grouped, median_or_none, setting
from bench.report.data.runs import shared_loss
from bench.report.study import Result, Runs, Selection, chart, curves, format, style, table

PLACE = 220
READS = (Selection("fig5", alike=("dataset", "view", "prior", "task")),)
QUANTITIES = {"total": ("weighted loss", 1.0), "chamfer_l2": ("Chamfer × 1000 (scene units²)", CHAMFER_SCALE)}
TIME_AXES = {"iteration": "iteration", "seconds": "time (seconds)"}
COLUMNS = (
    *(*table.columns(table.word, row="Method"), *table.columns(table.integer, runs="Runs")),
    *table.columns(table.thousandfold, end="End", low="Smallest", high="Largest"),
    *(*table.columns(format.seconds, seconds="Runtime"), *table.columns(spearman="ρ")),
)
NOTES = (
    "Chamfer distance is chamfer_l2, in squared scene units, times 1000. The optimisation does not use it.",
    "A curve is the median over the runs of a row. A failed run counts as infinite after its end.",
    "ρ is the median over runs of Spearman's rank correlation of loss and Chamfer distance over the iterations. "
    "Iterations of a run are not independent, so ρ is not a significance test.",
)
Medians = dict[str, pd.DataFrame]  # a row's median curve by quantity


def make(runs: Runs) -> Result:
    """A curve per row, the median over its runs, and a line with its end."""
    histories = {record["folder"]: curves.read(runs.folder(record)) for record in runs.records}
    unread = [f"{record['name']}: {why}." for record in runs.named() if (why := histories[record["folder"]][1])]
    medians: dict[Row, Medians] = {}
    lines: list[dict[str, Any]] = []
    for row, records in runs.rows().items():
        row_curves = [histories[record["folder"]][0] for record in records]
        failed = [record["status"] != "ok" for record in records]
        medians[row] = {name: curves.median(row_curves, failed, name) for name in QUANTITIES}
        # A correlation per run, because losses of different shapes cannot be compared.
        rhos = [curves.spearman(curve.dropna(subset=[*QUANTITIES]), *QUANTITIES) for curve in row_curves]
        correlation = {"spearman": median_or_none(rhos), "n": len(rhos) - rhos.count(None)}
        seconds = medians[row]["chamfer_l2"]["seconds"]
        identity = {"row": row.name, "runs": len(records), "seconds": seconds.iloc[-1] if len(seconds) else None}
        lines.append({**identity, **_end_errors(row_curves, failed), **correlation})
    return Result(
        runs,
        "Loss and Chamfer distance as shapes are completed.",
        f"Loss and Chamfer distance over iterations{' and seconds' if runs.timed else ''}.",
        question="Does the error decrease when the loss decreases?",
        verdict=f"{_verdict(lines)} {_ends(lines)}".strip(),
        remarks=(*unread, _loss(runs), *NOTES),
        data=_data(runs, {folder: history for folder, (history, _) in histories.items()}, medians, lines),
        columns=COLUMNS,
        lines=lines,
        figure=draw(medians, [axis for axis in TIME_AXES if axis != "seconds" or runs.timed]),
    )


def _verdict(lines: list[dict[str, Any]]) -> str:
    """The rows in which loss and error fall together; rows with equal numbers count once. The paper: in all rows."""
    numbers = ("end", "low", "high", "spearman")
    with_rank = [line for line in lines if line["spearman"] is not None]
    same = grouped(with_rank, lambda line: tuple(line.get(name) for name in numbers)).values()
    ranks = {" = ".join(line["row"] for line in group): group[0]["spearman"] for group in same}
    apart = [f"{row} (*{value:.2f}*)" for row, value in ranks.items() if value < curves.HIGH_RHO]
    alike = f"{curves.HIGH_RHO} or more in {len(ranks) - len(apart)} of {format.plural(len(ranks), 'different row')}"
    judgement = f"not in {', '.join(apart)}" if apart else "as in the paper"
    return f"The median rank correlation ρ of loss and error is {alike}; {judgement}." if ranks else ""


def _ends(lines: list[dict[str, Any]]) -> str:
    return table.extremes(
        "Median error at the end (Chamfer × 1000)",
        {line["row"]: line.get("end") for line in lines},
        f"{format.plural(min(line['runs'] for line in lines), 'run')} per row",
        show=table.thousandfold,
    )


def _end_errors(histories: list[pd.DataFrame], failed: list[bool]) -> dict[str, Any]:
    """The errors at the end of a row's runs, infinite for failed runs; empty if one is missing."""
    ends = []
    for curve, has_failed in zip(histories, failed, strict=True):
        errors = curve["chamfer_l2"].dropna()
        if errors.empty and not has_failed:
            return {}
        ends.append(math.inf if has_failed else errors.iloc[-1])
    return {"end": float(np.median(ends)), "low": min(ends), "high": max(ends)}


def _loss(runs: Runs) -> str:
    weight, width = (setting(runs.requested(), "task", f"normal_{name}") for name in ("weight", "width"))
    normals = f"depths, normals over {width} scene units (weight {weight or 0:g}) and silhouette, as in DIST, Fig. 5"
    terms = normals if weight else "depths and the silhouette; DIST, Fig. 5, also has normals"
    differing = "each row has the silhouette loss of its renderer, so losses of different rows cannot be compared"
    return f"The loss has terms for {terms}; {'all rows share it' if shared_loss(runs.records) else differing}."


def draw(medians: dict[Row, Medians], axes: list[str]) -> Figure:
    panels = []
    for (name, (label, scale)), axis in product(QUANTITIES.items(), axes):
        lines = [
            chart.curve(row.name, row.preset, style.finite(curve[axis]), style.finite(scale * curve["median"]))
            for row, curve in ((row, by_name[name]) for row, by_name in medians.items())
        ]
        panels.append(chart.panel_data("", TIME_AXES[axis], label, lines))
    return chart.draw(panels, 4.6, len(QUANTITIES))


def _data(runs: Runs, histories: dict[str, pd.DataFrame], medians: dict[Row, Medians], lines: list) -> pd.DataFrame:
    """The CSV, with three kinds of lines: runs, medians over a row's runs, and a row's rank correlation."""
    rows: list[dict[str, Any]] = []
    identities = table.to_data(table.IDENTITY, runs.records).to_dict("records")
    for record, identity in zip(runs.records, identities, strict=True):
        rows += [{"kind": "run", **identity, **point} for point in _points(histories[record["folder"]]) or [{}]]
    for (row, by_name), line in zip(medians.items(), lines, strict=True):
        for name, curve in by_name.items():
            names = {"median": name, "low": f"{name}_low", "high": f"{name}_high"}
            points = _points(curve.rename(columns=names))
            rows += [{"kind": "median", "row": row.name, "n": line["runs"], **point} for point in points]
        rows.append({"kind": "correlation", "row": row.name, "n": line["n"], "spearman": line["spearman"]})
    return pd.DataFrame(rows, dtype=object)


def _points(line: pd.DataFrame) -> list[dict[str, Any]]:
    counts = ("iteration", "value_evaluations")
    return [
        {name: int(x) if name in counts and math.isfinite(x) else x for name, x in point.items()}
        for point in line.to_dict("records")
    ]


PAGES = {"fig5": make}
