"""A renderer that is one Python file and one YAML runs, and stands in Table 1, in the front and in the atlas."""

from pathlib import Path

import pandas as pd
import pytest

from bench.report.__main__ import main as report
from tests.runner.driving import command

SMALL = (
    "scale=smoke", "isolation=off", "threads=1", "evaluation.picture=null", "evaluation.grid=16",
    "evaluation.points=200",
)  # fmt: skip
NETWORK = (
    "prior.network.layers=2", "prior.network.width=16", "prior.network.code_length=4", "prior.network.skip=0",
    "prior.steps=20", "prior.samples=500", "view.resolution=16", "task.repeats=1",
)  # fmt: skip
RUNS = (
    ("+experiment=table1", "dataset=sphere", *NETWORK),
    ("+experiment=speed_rendering", "dataset=sphere", "prior=fit", *NETWORK),
    (
        "+experiment=stability",
        "stress=thin_plate",
        "scale.stability.search.levels=5",
        "scale.stability.search.repeats=2",
        "task.resolution=16",
    ),
)


@pytest.fixture(scope="module")
def results(tmp_path_factory) -> Path:
    """What the runs of a renderer of a user's own left, with its report."""
    folder = tmp_path_factory.mktemp("own")
    (folder / "conf" / "renderer").mkdir(parents=True)
    mine = "_target_: tests.user_renderer.Mine\n_label_: Mine\nsteps: 40\n"
    (folder / "conf" / "renderer" / "mine.yaml").write_text(mine)
    for overrides in RUNS:
        done = command(
            f"--config-dir={folder / 'conf'}", *overrides, *SMALL, "renderer=mine", "packages=[tests]",
            f"results_dir={folder / 'results'}",
        )  # fmt: skip
        assert done.code == 0, done.err
    report([f"results_dir={folder / 'results'}"])
    return folder / "results"


def test_it_has_its_rows_and_figures(results):
    for page in ("table1", "speed_front", "stability"):
        assert "Mine" in set(pd.read_csv(results / "paper" / f"{page}.csv").to_numpy().ravel()), page
    assert all((results / "paper" / f"{name}.png").stat().st_size > 1000 for name in ("speed_front", "stability"))
