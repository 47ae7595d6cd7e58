"""Shared by the tests of the report: pictures are coarse, and one report serves all tests that read it."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from bench.pictures import style
from bench.report.__main__ import main
from bench.report.write import paper


@pytest.fixture(scope="session", autouse=True)
def coarse_pictures() -> Iterator[None]:
    """Writes coarse pictures: a picture takes longer than all other files together."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(style.RC, "savefig.dpi", 50)
        yield


@pytest.fixture(scope="session")
def reported(tmp_path_factory) -> Path:
    """A results folder with the report of a table and of a table with figures; read-only."""
    from tests.report.test_report_paper import DYNAMIC, costs, write_gradients, write_run

    results = write_gradients(tmp_path_factory.mktemp("reported"))
    write_run(results, "table1", DYNAMIC, metrics=costs())
    main([f"results_dir={results}"])
    return results


@pytest.fixture(scope="session", autouse=True)
def without_shipped(tmp_path_factory) -> Iterator[None]:
    """Leaves the shipped tables out of reports: only the user's tables remain."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(paper, "SHIPPED", tmp_path_factory.getbasetemp() / "none")
        yield
