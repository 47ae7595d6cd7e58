"""The reports of progress without a terminal, and the width of a line on one."""

import io

import pytest
from rich.console import Console
from rich.progress import Progress

from bench import progress
from tests.looped import each


@pytest.fixture
def clock(monkeypatch):
    """The seconds of the progress's clock; no variable asks for a terminal."""
    monkeypatch.delenv("FORCE_COLOR", raising=False)
    now = [100.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    return now


def test_a_long_phase_reports_its_progress_now_and_then(clock, capsys):
    with progress.run_progress("DIST") as report:
        for step in range(1, 101):
            clock[0] += 0.5
            report("training the prior", step, 100, 0.25)
    printed = capsys.readouterr()
    assert printed.out == "" and all(letter.isprintable() or letter == "\n" for letter in printed.err)
    assert printed.err.splitlines() == [
        "DIST: training the prior, 31%, about 34 s left",
        "DIST: training the prior, 61%, about 20 s left",
        "DIST: training the prior, 91%, about 4 s left",
    ]


def test_a_resumed_phase_is_estimated_from_its_own_steps(clock, capsys):
    with progress.run_progress("DIST") as report:
        for step in range(91, 101):
            clock[0] += 10.0
            report("training", step, 100)
    assert capsys.readouterr().err.splitlines()[0] == "DIST: training, 93%, about 70 s left"


def test_short_phases_report_nothing(clock, capsys):
    with progress.run_progress("DIST") as report:
        for phase in range(20):
            for step in range(1, 5):
                clock[0] += 2.0
                report(f"phase {phase}", step, 4)
    assert capsys.readouterr().err == ""


@each("width", [40, 79, 80, 120])
def test_a_line_of_progress_fits_its_terminal(width):
    file = io.StringIO()
    console = Console(width=width, force_terminal=True, color_system=None, file=file)
    shown = Progress(*progress.columns(width), console=console)
    shown.add_task("sweep", total=200, completed=20, status="3 failed")
    console.print(shown.get_renderable())
    (line,) = file.getvalue().splitlines()
    assert len(line) <= width
    assert "20/200" in line and "-:--:--" in line
    assert ("3 failed" in line) is (width >= 80)
