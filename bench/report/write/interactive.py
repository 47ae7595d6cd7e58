"""Interactive figures: hovering shows the setting, a click opens the run. They work without a network."""

import math
from html import escape
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
import pandas as pd

from bench.pictures import style
from bench.records import format
from bench.report.data.records import SCALE, Record, Row, measured
from bench.report.data.speed import Placed, Setting, front_line, main_settings

SYMBOLS = {"o": "circle", "s": "square", "^": "triangle-up", "D": "diamond", "v": "triangle-down", "<": "triangle-left"}
OPEN = """
document.getElementById('figure').on('plotly_click', function (event) {
  var link = event.points[0].customdata;
  if (link) { window.open(link, '_blank'); }
});
"""


def front(panels: list[list[Placed]]) -> Any:
    """Error over time: a large point per setting, which opens the run closest to its median, a small one per run."""
    from plotly.subplots import make_subplots

    titles = [panel[0].row.trial.title for panel in panels]
    figure = make_subplots(cols=len(panels), subplot_titles=titles)
    seen: set[str] = set()
    for column, panel in enumerate(panels, start=1):
        where = {"row": 1, "col": column}
        line = front_line(panel)
        x, y = [point.x for point in line], [point.y for point in line]
        how = {"mode": "lines", "line": {"shape": "hv", "color": "#999999", "width": 1}, "hoverinfo": "skip"}
        figure.add_scatter(x=x, y=y, showlegend=False, **how, **where)
        for point in panel:
            renderer, runs = point.row.renderer, _runs(point.row)
            named = {"legendgroup": renderer, "name": renderer, "mode": "markers", "hoverinfo": "text"}
            small = {"color": style.look(renderer).colour, "size": 4, "opacity": 0.4}
            columns = {"x": runs["seconds"], "y": runs["error"], "text": runs["hover"], "customdata": runs["link"]}
            figure.add_scatter(marker=small, showlegend=False, **columns, **named, **where)
            large = {"x": [point.x], "y": [point.y], "text": [_about(point)], "customdata": [_nearest(point, runs)]}
            figure.add_scatter(marker=_marker(point), showlegend=renderer not in seen, **large, **named, **where)
            seen.add(renderer)
        figure.update_xaxes(type="log", title="time (seconds)", **where)
        figure.update_yaxes(type="log", title=panel[0].row.trial.heading, **where)
    return _styled(figure)


def curves(rows: list[Setting], shown: dict[Row, list[pd.DataFrame]]) -> Any:
    """Error over seconds and over evaluations, with a line per run."""
    from plotly.subplots import make_subplots

    figure = make_subplots(cols=2)
    seen: set[str] = set()
    shown_first = {row.row for row in main_settings(rows)}
    for row in rows:
        colour = style.look(row.renderer).colour
        for record, history in zip(row.records, shown[row.row], strict=True):
            links = [_link(record)] * len(history)
            for column, along in enumerate(("seconds", "value_evaluations"), start=1):
                figure.add_scatter(
                    x=history[along], y=history["error"], mode="lines+markers", name=row.name, legendgroup=row.name,
                    showlegend=row.name not in seen, line={"color": colour, "width": 1}, marker={"size": 4},
                    text=[_hover(row, record)] * len(history), customdata=links, hoverinfo="text+x+y",
                    row=1, col=column, visible=True if row.row in shown_first else "legendonly",
                )  # fmt: skip
                seen.add(row.name)
    for column, label in enumerate(("time (seconds)", "field values"), start=1):
        figure.update_xaxes(type="log", title=label, row=1, col=column)
        figure.update_yaxes(type="log", title="Chamfer × 1000 (scene units²)", row=1, col=column)
    return _styled(figure)


def write(figure: Any, path: Path) -> None:
    """Writes a page, and Plotly's script next to it, so that it works without a network."""
    figure.write_html(path, include_plotlyjs="directory", post_script=OPEN, div_id="figure")


def _styled(figure: Any) -> Any:
    return figure.update_layout(template="plotly_white", hovermode="closest", legend={"itemsizing": "constant"})


def _runs(row: Setting) -> pd.DataFrame:
    """The runs of a setting that ended ok."""
    found = []
    for record in row.records:
        cost, error = row.trial.seconds(record), measured(record, row.trial.error)
        if record["status"] == "ok" and cost is not None and error is not None and np.isfinite(error):
            found.append([cost, SCALE * error, _hover(row, record), _link(record)])
    return pd.DataFrame(found, columns=["seconds", "error", "hover", "link"])


def _nearest(point: Placed, runs: pd.DataFrame) -> str:
    """The link to the run closest to the setting's median; to the first one where all failed."""
    if not len(runs):
        return _link(point.row.records[0])
    return runs["link"].iloc[(runs["error"] - point.y).abs().argmin()]


def _about(point: Placed) -> str:
    cost, error = point.row.point
    settings = point.row.records[0]["config"].get("renderer") or {}
    lines = [
        f"<b>{escape(point.row.name)}</b>",
        f"{format.seconds(cost)}, error × 1000 {format.number(error)}",
        f"failed {point.row.failed} of {len(point.row.records)}",
        "" if math.isnan(point.chance) else f"on the front with probability {point.chance:.2f}",
        *(f"{key} = {escape(str(value))}" for key, value in settings.items() if not key.startswith("_")),
    ]
    return "<br>".join(filter(None, lines))


def _hover(row: Setting, record: Record) -> str:
    scene = record.get("scene") or record["dataset"]
    return f"<b>{escape(row.name)}</b><br>{escape(scene)}, seed {record['seed']}<br>{escape(record['folder'])}"


def _link(record: Record) -> str:
    """The run's details on the report's page, as seen from the folder of the figures."""
    return f"../index.html#run-{quote(record['folder'], safe='')}"


def _marker(point: Placed) -> dict[str, Any]:
    """The marker of a setting: filled on the front, hollow where dominated, a cross where a median is infinite."""
    look = style.look(point.row.renderer)
    symbol = "x-thin" if point.infinite else SYMBOLS.get(look.marker, "circle")
    hollow = "" if point.on_front else "-open"
    return {"color": look.colour, "symbol": symbol + hollow, "size": 10, "line": {"color": look.colour, "width": 2}}
