"""The commands in conf/README.md plan the runs that shipped pages show: the same shapes, rows and settings."""

import re
import shlex
from pathlib import Path
from typing import Any

import pytest

from bench.records.record import flat, row_name
from bench.records.shipped import SUFFIX
from bench.report.data.kept import read_rows
from bench.report.write.paper import FOLDER, SHIPPED
from bench.tables import choice, names
from tests.composing import cells_of
from tests.documentation import text_of

COMMAND = re.compile(r"`-m \+experiment=([^`]+)`")
NAMED = re.compile(r"^\| \[?`(\w+)`")  # experiments whose command is their name alone
# What changes no result, or names files of the machine; and sizes, whose values stand in other keys too.
IGNORED = re.compile(
    r"(sizes|scale|results_dir|priors_dir|threads|device|time_limit|packages|verbose|rerun)\b|dataset\.path"
)
EXPERIMENTS = sorted(path.name.removesuffix(SUFFIX) for path in (SHIPPED / FOLDER).glob(f"*{SUFFIX}"))


def described(config: dict[str, Any], dataset: str, renderer: str) -> tuple[tuple[str, ...], dict[str, str]]:
    path = config["dataset"].get("path")
    settings = {key: str(value) for key, value in flat(config, "").items() if not IGNORED.match(key)}
    if settings.get("task.stress.measure", "fit") != "fit":  # renderings and gradients do not read the settings of fits
        settings = {key: "" if key.startswith("task.fit.") else value for key, value in settings.items()}
    return (row_name(config, renderer), Path(path).stem if path and dataset == "mesh" else dataset), settings


def planned(experiment: str, at_most: int | None = None) -> list[tuple[tuple[str, ...], dict[str, str]]]:
    """The cells of the commands in the tables that link to results, of those whose runs name the experiment."""
    lines = [line for line in text_of("conf/README.md").splitlines() if line.startswith("|")]
    linked = [line for line in lines if "../results" in line or NAMED.match(line)]
    commands = [COMMAND.findall(line) or NAMED.findall(line) for line in linked]
    found = []
    for command in dict.fromkeys(command for of in commands for command in of):
        name, *words = shlex.split(command)
        if name not in names("experiment") or choice("experiment", name).get("experiment") != experiment:
            continue
        cells = cells_of(f"+experiment={name}", *words, at_most=at_most)
        found += [described(cell.config, cell.dataset, cell.renderer) for cell in cells]
    return found


@pytest.mark.parametrize("at_most", [2, pytest.param(None, marks=pytest.mark.slow)])  # composing takes minutes
@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_the_command_of_a_page_plans_the_runs_that_it_shows(experiment: str, at_most: int | None):
    records = read_rows(SHIPPED / FOLDER, experiment)
    rows = [described(record["config"], record["dataset"], record["renderer"]) for record in records]
    cells = planned(experiment, at_most)
    assert cells, "conf/README.md has no command of this experiment"
    common = set.intersection(*({*settings} for _, settings in [*rows, *cells]))

    def kinds(runs: list[tuple[tuple[str, ...], dict[str, str]]]) -> set[tuple[Any, ...]]:
        return {(*name, *sorted((key, settings[key]) for key in common)) for name, settings in runs}

    plan, shown = kinds(cells), kinds(rows)
    assert plan <= shown if at_most else plan == shown, nearest(plan - shown, shown - plan)


def nearest(plan: set[tuple[Any, ...]], shown: set[tuple[Any, ...]]) -> str:
    """Counts, and in what a run of one side differs from the one of the other side that is most like it."""
    first = min(plan or shown, key=str)
    other = min(shown if plan else [], key=lambda run: len({*run} - {*first}), default=())
    counts = f"{len(plan)} runs are planned alone, {len(shown)} shown alone"
    return f"{counts}, such as {sorted({*first} - {*other}, key=str)} for {sorted({*other} - {*first}, key=str)}"
