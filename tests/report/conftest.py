"""Shared by the tests of the report: its pictures are coarse, and one report is written for all that read it."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from bench.pictures import figure_style
from bench.report.__main__ import main


@pytest.fixture(scope="session", autouse=True)
def coarse_pictures() -> Iterator[None]:
    """A picture takes longer to write than all else together."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(figure_style.RC, "savefig.dpi", 50)
        yield


@pytest.fixture(scope="session")
def reported(tmp_path_factory) -> Path:
    """A results folder with the report of a table and of a table with figures; nothing is written to it."""
    from tests.report.test_report_paper import DYNAMIC, costs, write_judged, write_run

    results = write_judged(tmp_path_factory.mktemp("reported"))
    write_run(results, "table1", DYNAMIC, metrics=costs())
    main([f"results_dir={results}"])
    return results
