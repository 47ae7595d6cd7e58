"""The overhead of the harness: per run, for a large results folder, and for a mistake on the command line."""

import json
import statistics
import subprocess
import sys
import time

import pytest

from bench.records.record import Record, RunStatus
from bench.report.write.html import write_index
from tests.runner.driving import FAILING, ROOT

pytestmark = pytest.mark.slow

CELL = ("renderer=custom", "renderer._target_=tests.failing.Failing", "+renderer.how=not")
RECORDS = 10_000


def test_a_run_costs_little_more_than_its_work(tmp_path, capsys):
    """The overhead of a sweep per run, for runs of 10 s."""
    cells = 4
    arguments = (*FAILING, *CELL[2:], "task.optimiser.iterations=8", "+renderer.pause=1.0", "seed=0,1,2,3")
    inside, outside = {}, {}
    for isolation in ("off", "process"):
        results = tmp_path / isolation
        command = [sys.executable, "-m", "bench", "-m", *arguments, f"isolation={isolation}", f"results_dir={results}"]
        started = time.perf_counter()
        subprocess.run(command, cwd=ROOT, check=False, capture_output=True)
        spent = sum(json.loads(path.read_text())["seconds"]["total"] for path in results.glob("runs/*/record.json"))
        inside[isolation] = spent / cells
        outside[isolation] = (time.perf_counter() - started - spent) / cells
    with capsys.disabled():
        print(f"\na run takes {inside} s, and a sweep of {cells} takes {outside} s more for each run")
    assert inside["process"] - inside["off"] < 0.01 * inside["off"] + 0.5
    assert outside["process"] < 0.01 * inside["off"] + 0.5 + 2.0 / cells  # 2 s to start the program


def test_ten_thousand_records_index_in_ten_seconds(tmp_path, capsys):
    config = {"task": {"iterations": 100}, "renderer": {"steps": 50}, "view": {"resolution": 64}, "seed": 0}
    metrics = {name: 0.5 for name in ("chamfer_l2", "accuracy", "completeness", "fscore", "depth_mae", "mask_iou")}
    for number in range(RECORDS):
        folder = tmp_path / "runs" / f"completion-dist-sofa-{number:012x}"
        folder.mkdir(parents=True)
        record = Record(folder.name, "completion", "dist", "sofa", number, config, status=RunStatus.OK)
        record.metrics, record.seconds, record.environment = metrics, {"total": 1.0}, {"cpu": "a", "threads": 2}
        (folder / "record.json").write_text(json.dumps({"schema": 1, **vars(record)}))
    started = time.perf_counter()
    page = write_index(tmp_path)
    took = time.perf_counter() - started
    with capsys.disabled():
        size = (page.parent / "page" / "data" / "list" / "runs.js").stat().st_size
        print(f"\n{RECORDS} records: {took:.1f} s, a list of {size / 2**20:.1f} MiB")
    assert took < 10


@pytest.mark.parametrize("arguments", [["--help"], ["rendrer=dist"], ["renderer=dits"]])
def test_help_and_a_typo_are_answered_within_two_seconds(arguments, capsys):
    times = []
    for _ in range(5):
        started = time.perf_counter()
        subprocess.run([sys.executable, "-m", "bench", *arguments], cwd=ROOT, check=False, capture_output=True)
        times.append(time.perf_counter() - started)
    with capsys.disabled():
        spread = f"({min(times):.2f}-{max(times):.2f}, n = {len(times)})"
        print(f"\n{arguments[0]}: {statistics.median(times):.2f} s {spread}")
    assert statistics.median(times) < 2
