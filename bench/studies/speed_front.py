"""The Pareto front of error over time, for completing a shape and rendering an image, of all renderers' settings."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from bench.report.study import (
    Result,
    Runs,
    Selection,
    chart,
    figure_style,
    format,
    merge_runs,
    records,
    statistics,
    table,
)
from bench.report.write.caption import undefined

PLACE = 80
READS = (Selection("speed_completion"), Selection("speed_rendering", alike=("view",)))
QUANTITIES = ("seconds", "error", "evaluations")
LIKELY = 0.9  # the fraction of bootstrap draws from which on a setting is called likely on the front
MIN_PLOTTED_ERROR = 1e-9  # smaller errors are raised to this, so that their logarithms are bounded
NOTES = (
    "Left: the final error of a completion over its runtime. Right: the depth error of one rendering (95th percentile "
    "over pixels; missed and spurious pixels are infinite) over its time.",
    "Error and time are infinite for a failed run, and for a run that a setting lacks and others have. A setting with "
    "an infinite median is only in the table.",
    "Filled points are on the front, numbered from the fastest. Hollow points are dominated: another setting is faster "
    "and has a smaller error.",
    "In brackets: the probability of being on the front, over 2,000 bootstrap draws of {shapes and seeds}. Settings "
    "that compute the same share their times.",
)
POINT = "Filled points are on the front, and hollow points are dominated. Click on a point for the runs of its setting."
Line = dict[str, Any]  # a setting


@dataclass(frozen=True)
class Trial:
    """A task of the chart: its error metric, and the columns of a run's seconds and field evaluations."""

    title: str
    error: str
    heading: str
    seconds: str
    values: tuple[str, ...]


COMPLETION = Trial("completing a shape", "chamfer_l2", "Chamfer × 1000 (scene units²)", "loop", ("values",))
RENDERING = Trial(
    *("rendering an image, without gradient", "error_p95", "depth error, 95th percentile × 1000 (scene units)"),
    *("forward_seconds", ("queries", "coarse_queries")),
)


def make(completion: Runs | None, rendering: Runs | None) -> Result:
    runs_by_trial = {COMPLETION: completion, RENDERING: rendering}
    panels = {trial: points(runs, trial) for trial, runs in runs_by_trial.items() if runs is not None}
    lines = [line for panel in panels.values() for line in panel]
    renderer_columns = dict.fromkeys(key for line in lines for key in line if key.startswith("renderer."))
    drawn = [_panel(trial, panel) for trial, panel in panels.items()]
    return Result(
        merge_runs(completion, rendering),
        "Error over time.",
        "Median error of each setting over its median time; medians over {shapes and seeds}.",
        question="How much time does accuracy cost?",
        verdict=_verdict(panels),
        interval="in the CSV, 95 % bootstrap intervals of interquartile means over {shapes and seeds}",
        estimates=[line["middle"] for line in lines],
        remarks=(*NOTES, undefined(line["on_front"] for line in lines)),
        columns=[*COLUMNS, *table.raw(*renderer_columns), table.text("resolution")],
        lines=lines,
        figure=draw(drawn, [*map(_front, panels.values())]),
        chart={"panels": drawn, "note": POINT},
    )


def points(runs: Runs, trial: Trial) -> list[Line]:
    keys = sorted({records.run_key(record) for record in runs.records}, key=str)
    cells = _cells(runs, trial, keys)
    groups = {
        row.name: [records.by_shape(dict(zip(keys, cells.loc[row.name, q], strict=True))) for q in QUANTITIES]
        for row in runs.rows()
    }
    medians = np.array([[float(statistics.median(statistics.flat(g))) for g in group] for group in groups.values()])
    dominated = statistics.dominated(*medians.T[:2])
    chances = statistics.front([(costs, errors) for costs, errors, *_ in groups.values()])
    lines = []
    for i, (row, row_records) in enumerate(runs.rows().items()):
        config, errors = row_records[0]["config"], groups[row.name][1]
        lines.append(
            {"trial": trial.title, "setting": row.name, "renderer": records.base_renderer(row_records[0])}
            | dict(zip(QUANTITIES, medians[i].tolist(), strict=True))
            | {"middle": statistics.bootstrap(errors, statistics.interquartile_mean), "shapes": len(errors)}
            | {"failed": sum(record["status"] != "ok" for record in row_records), "runs": len(row_records)}
            | {"missing": len(keys) - len({*map(records.run_key, row_records)})}
            | {"on_front": chances[i], "dominated": bool(dominated[i])}
            | {"resolution": records.setting(config, "view", "resolution")}
            | {f"renderer.{key}": value for key, value in (config.get("renderer") or {}).items() if key[0] != "_"}
        )
    return lines


def _cells(runs: Runs, trial: Trial, keys: list[records.RunKey]) -> pd.DataFrame:
    """The quantities of each row by the index of a run's key; infinite for failed and missing runs.

    Rows of a renderer with equal errors after equal numbers of field evaluations compute the same. They share their
    times, because otherwise noise would rank them.
    """
    values, *coarse_values = (runs.number(name, optional=True) for name in trial.values)
    quantities = {
        "seconds": runs.number(trial.seconds),
        "error": runs.error(trial.error).clip(lower=records.CHAMFER_SCALE * MIN_PLOTTED_ERROR),
        "evaluations": values + sum(counts.fillna(0) for counts in coarse_values),
    }
    cells = pd.DataFrame(quantities)
    cells.loc[(runs.frame.status != "ok").to_numpy(bool)] = math.inf
    cells = cells.assign(row=runs.frame.row, key=[keys.index(records.run_key(record)) for record in runs.records])
    wide = cells.pivot(index="row", columns="key", values=[*QUANTITIES]).fillna(math.inf)
    renderers = {row.name: records.base_renderer(row_records[0]) for row, row_records in runs.rows().items()}
    results = [(renderers[row], *wide.loc[row, ["error", "evaluations"]]) for row in wide.index]
    wide["seconds"] = wide["seconds"].groupby(pd.factorize(pd.Series(results))[0]).transform("median")
    return wide


def _finite(panel: list[Line]) -> list[Line]:
    return [line for line in panel if math.isfinite(line["seconds"]) and math.isfinite(line["error"])]


def _front(panel: list[Line]) -> list[Line]:
    return sorted((line for line in _finite(panel) if not line["dominated"]), key=lambda line: line["seconds"])


def _verdict(panels: dict[Trial, list[Line]]) -> str:
    for trial, panel in panels.items():
        if front := _front(panel):
            ends = [
                f"*{format.seconds(p['seconds'])}* for an error × 1000 of {format.number(p['error'])} ({p['setting']})"
                for p in (front[0], *front[1:][-1:])
            ]
            n = format.plural(panel[0]["shapes"], "shape")
            sure = sum(line["on_front"] >= LIKELY for line in front)
            on_front = f"{len(front)} of {len(panel)} settings are on this front, {sure} of them in "
            on_front += f"{100 * LIKELY:.0f} % of the bootstrap draws or more; n = {n}."
            return f"The front of {trial.title}, from the fastest to the best: {' to '.join(ends)}. {on_front}"
    return ""


@figure_style.styled
def draw(panels: list[chart.Panel], fronts: list[list[Line]]) -> Figure:
    figure = chart.draw(panels, 4.4, legend=5)
    for legend in figure.legends:
        for handle in legend.legend_handles:
            if isinstance(handle, Line2D):  # whether a point is filled says if it is on the front
                handle.set_markerfacecolor("none")
    for axis, front in zip(figure.axes, fronts, strict=True):
        numbers = records.grouped(enumerate(front, 1), lambda pair: (pair[1]["seconds"], pair[1]["error"]))
        for point, numbered in numbers.items():
            how = {"textcoords": "offset points", "ha": "right", "va": "top", "fontsize": 6}
            axis.annotate(", ".join(str(number) for number, _ in numbered), point, (-2, -3), **how)
        names = [axis.plot([], [], ls="none", label=f"{i} {_name(line)}")[0] for i, line in enumerate(front, 1)]
        below = {"loc": "upper center", "bbox_to_anchor": (0.5, -0.16), "ncols": 2}
        axis.legend(handles=names, **below, handlelength=0, handletextpad=0, fontsize=6)
    return figure


def _name(line: Line) -> str:
    return line["setting"] + ("" if math.isnan(line["on_front"]) else f" ({line['on_front']:.2f})")


def _panel(trial: Trial, panel: list[Line]) -> dict[str, Any]:
    drawn, axes = [], ("seconds", "error")
    names = {line["renderer"]: line["setting"].partition(",")[0] for line in reversed(panel)}  # of the first setting
    for (renderer, dominated), settings in records.grouped(
        _finite(panel), lambda p: (p["renderer"], p["dominated"])
    ).items():
        links = [chart.link_to_runs(p["setting"]) for p in settings]
        look = {"text": [*map(_hover, settings)], "link": links, "size": 11}
        look |= {"hollow": True} if dominated else {}
        drawn.append(chart.series(names[renderer], renderer, *([p[key] for p in settings] for key in axes), **look))
    drawn.append(chart.front(*([p[key] for p in panel] for key in axes)))
    return chart.panel_data(trial.title, "time (seconds)", trial.heading, drawn, height=440)


def _hover(line: Line) -> list[str]:
    return [
        _name(line),
        f"{format.seconds(line['seconds'])}, error × 1000 {format.number(line['error'])}",
        f"failed {_failed(line)}",
    ]


def _failed(line: Line) -> str:
    return f"{line['failed']} of {line['runs']}" + (f", {line['missing']} missing" if line["missing"] else "")


COLUMNS = (
    *table.columns(table.word, trial="Trial", setting="Setting", renderer=""),
    *(*table.columns(format.seconds, seconds="Time"), *table.columns(format.count, evaluations="Field evaluations")),
    *(table.Column("error", "Error × 1000"), table.Column("error_iqm", value=lambda line: line["middle"].value)),
    *table.ends("error", lambda line: line["middle"]),
    *table.raw("failed", "runs", "missing"),
    table.shown("Failed", _failed),
    *(table.Column("on_front", "P(on the front)"), table.Column("dominated")),
)

PAGES = {"speed_front": make}
