"""Figures that answer the mouse: hovering says which setting, a click opens the run. They need no network."""

from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import numpy as np
import pandas as pd

from bench.report import format, style

if TYPE_CHECKING:
    from bench.report.speed import Setting, Trial

LIBRARY = "plotly.min.js"  # beside the pages that use it, so that they work without a network
SYMBOLS = {"o": "circle", "s": "square", "^": "triangle-up", "D": "diamond", "v": "triangle-down", "<": "triangle-left"}
OPEN = """
var chart = document.getElementsByClassName('plotly-graph-div')[0];
chart.on('plotly_click', function (event) {
  var link = event.points[0].customdata;
  if (link) { window.open(link, '_blank'); }
});
"""


def write_plotly(folder: Path) -> None:
    """Puts Plotly's own script into a folder, where the pages find it."""
    from plotly.offline import get_plotlyjs

    path = folder / LIBRARY
    if not path.is_file():
        path.write_text(get_plotlyjs(), encoding="utf-8")


def front(found: "list[tuple[Trial, list[Setting]]]", chances: dict[str, list[float]]) -> str:
    """Error against time: a large point a setting, which opens the run nearest to its median, a small one a run."""
    from plotly.subplots import make_subplots

    figure = make_subplots(cols=len(found), subplot_titles=[trial.title for trial, _ in found])
    seen: set[str] = set()
    for column, (trial, rows) in enumerate(found, start=1):
        for row, chance in zip(rows, chances[trial.task], strict=True):
            shown = _runs(row)
            common = {"legendgroup": row.renderer, "name": row.renderer, "marker": _marker(row.renderer)}
            small = {**common["marker"], "size": 5, "opacity": 0.35}
            figure.add_scatter(
                **{**common, "marker": small, "showlegend": False, "mode": "markers"},
                **{"x": shown["seconds"], "y": shown["error"], "text": shown["told"], "customdata": shown["link"]},
                hoverinfo="text", row=1, col=column,
            )  # fmt: skip
            cost, error = row.point
            if np.isfinite([cost, error]).all():
                nearest = shown.iloc[(shown["error"] - error).abs().argsort()[:1]]
                told = (
                    f"<b>{row.name}</b><br>{format.seconds(cost)}, error × 1000 {format.number(error)}<br>"
                    f"failed {row.failed} of {len(row.records)}<br>on the front with probability {chance:.2f}"
                    f"<br>{_settings(row)}"
                )
                figure.add_scatter(
                    **common, mode="markers", showlegend=row.renderer not in seen, hoverinfo="text", x=[cost],
                    y=[error], text=[told], customdata=list(nearest["link"]), row=1, col=column,
                )  # fmt: skip
                seen.add(row.renderer)
        figure.update_xaxes(type="log", title="time (seconds)", row=1, col=column)
        figure.update_yaxes(type="log", title=trial.heading, row=1, col=column)
    return _page(figure)


def curves(rows: "list[Setting]", shown: dict[str, list[pd.DataFrame]]) -> str:
    """Error over seconds and over evaluations, a line a run."""
    from plotly.subplots import make_subplots

    figure = make_subplots(cols=2)
    seen: set[str] = set()
    for row in rows:
        colour = style.look(row.renderer).colour
        for record, course in zip(row.records, shown[row.name], strict=True):
            links = [_link(record)] * len(course)
            for column, along in enumerate(("seconds", "value_evaluations"), start=1):
                figure.add_scatter(
                    x=course[along], y=course["error"], mode="lines+markers", name=row.name, legendgroup=row.name,
                    showlegend=row.name not in seen, line={"color": colour, "width": 1}, marker={"size": 4},
                    text=[_told(row, record)] * len(course), customdata=links, hoverinfo="text+x+y", row=1, col=column,
                    visible=True if row.name == row.renderer else "legendonly",
                )  # fmt: skip
                seen.add(row.name)
    for column, label in enumerate(("time (seconds)", "field values"), start=1):
        figure.update_xaxes(type="log", title=label, row=1, col=column)
        figure.update_yaxes(type="log", title="Chamfer × 1000 (scene units²)", row=1, col=column)
    return _page(figure)


def _page(figure: Any) -> str:
    figure.update_layout(template="plotly_white", hovermode="closest", legend={"itemsizing": "constant"})
    return figure.to_html(include_plotlyjs=LIBRARY, full_html=True, post_script=OPEN, div_id="figure")


def _runs(row: "Setting") -> pd.DataFrame:
    """The runs of a setting that ended ok."""
    from bench.report.experiments import measured
    from bench.report.speed import seconds

    found = []
    for record in row.records:
        cost, error = seconds(record), measured(record, row.trial.error)
        if record["status"] == "ok" and cost is not None and error is not None and np.isfinite(error):
            found.append(
                {
                    "seconds": cost,
                    "error": row.trial.factor * error,
                    "told": _told(row, record),
                    "link": _link(record),
                }
            )
    return pd.DataFrame(found, columns=["seconds", "error", "told", "link"])


def _told(row: "Setting", record: dict[str, Any]) -> str:
    return (
        f"<b>{row.name}</b><br>{record.get('scene') or record['dataset']}, seed {record['seed']}<br>{record['folder']}"
    )


def _settings(row: "Setting") -> str:
    config = row.records[0]["config"].get("renderer") or {}
    return "<br>".join(f"{key} = {value}" for key, value in config.items() if not key.startswith("_"))


def _link(record: dict[str, Any]) -> str:
    """The run's details on the report's page, as seen from the folder of the figures."""
    return f"../index.html#run-{quote(record['folder'], safe='')}"


def _marker(renderer: str) -> dict[str, Any]:
    look = style.look(renderer)
    return {"color": look.colour, "symbol": SYMBOLS.get(look.marker, "circle"), "size": 10}
