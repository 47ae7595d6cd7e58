"""A run's own chart of its ladder: error over size, and over what a value costs."""

from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.figure import Figure

from bench.pictures import STYLE
from bench.report.ladder import Ladder, panels


def draw_ladder(folder: Path, metrics: dict[str, Any], title: str) -> None:
    """Writes ladder.png into a run folder."""
    matplotlib.use("Agg")
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(9.0, 4.0), layout="constrained")
        panels(figure.subplots(1, 2, sharey=True), Ladder.of(metrics))
        figure.suptitle(title)
        figure.savefig(folder / "ladder.png", dpi=110)
