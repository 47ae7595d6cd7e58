"""Sweeps are planned before they start, and have a record for every cell under every launcher."""

import json
import signal
import subprocess
import sys
from contextlib import nullcontext
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import psutil
import pytest

from bench.clusters import group_by_duration
from bench.records.read import read_records
from bench.report.write.html import write_index
from tests.composing import identified
from tests.looped import each
from tests.report.page_data import Page
from tests.runner.driving import FAILING, PATIENCE, ROOT, CommandResult, by_program, command, driver, errors, wait_for
from tests.runner.test_process import CASES

# The package that a launcher needs, and its settings.
LAUNCHERS = {
    "basic": ("", ()),
    "workers": ("", ("hydra.launcher.n_jobs=3",)),
    "slurm": ("submitit", ("hydra.launcher.cluster=local",)),
    "ray_cluster": ("ray", ()),
}
# The cells of a sweep; `terminate` stands for a cell whose run folder cannot be made.
NO_FOLDER = "terminate"
HOWS = ("not", "loop", NO_FOLDER)
# Seconds: a short limit for work that never ends, a long one for work that ends at once.
LIMITS = {how: 1 if CASES[how][1] == "timeout" else PATIENCE for how in CASES} | {"not": PATIENCE}
LIMITED = (
    f"+renderer.limits={{{','.join(f'{how}:{seconds}' for how, seconds in LIMITS.items())}}}",
    "time_limit='${renderer.limits.${oc.select:renderer.how,not}}'",  # the first composition of a sweep has no `how`
)


@dataclass(frozen=True)
class Swept:
    """A sweep that has ended: its results and its outputs."""

    results: Path
    outcome: CommandResult

    @property
    def statuses(self) -> dict[str, str]:
        return {record["config"]["renderer"]["how"]: record["status"] for record in read_records(self.results)[0]}


def need(launcher: str) -> None:
    package = LAUNCHERS[launcher][0]
    if package and find_spec(package) is None:
        pytest.skip(f"the package of {launcher} is not installed: pip install -e '.[submitit,ray]'")


def plan_of(results: Path) -> dict:
    (path,) = results.glob("sweeps/*/plan.json")
    return json.loads(path.read_text())


@pytest.fixture(scope="module")
def swept(tmp_path_factory) -> Swept:
    """A sweep by workers over a run that ends by itself, one that hangs and one without a folder."""
    need("workers")
    results = tmp_path_factory.mktemp("workers")
    arguments = ("hydra/launcher=workers", *LIMITED, "threads=null")
    cell = identified(*FAILING, *arguments, f"+renderer.how={NO_FOLDER}", f"results_dir={results}")
    blocked = results / "runs" / cell.id
    blocked.parent.mkdir()
    blocked.symlink_to(results / "nowhere")
    cells = f"+renderer.how={','.join(HOWS)}"
    return Swept(results, by_program("-m", "bench", "-m", *FAILING, *arguments, cells, f"results_dir={results}"))


def test_every_planned_cell_has_a_record_whatever_its_outcome(swept):
    planned = [cell["id"] for cell in plan_of(swept.results)["cells"]]
    records, problems = read_records(swept.results)
    assert problems == [] and sorted(record["id"] for record in records) == sorted(planned)
    assert swept.statuses == {"not": swept.statuses["not"], NO_FOLDER: "not_run", "loop": "timeout"}
    assert swept.statuses["not"] in ("ok", "not_reached")
    page = Page(swept.results)
    assert all(name in page.folders for name in planned)


def test_a_sweep_prints_its_plan_a_line_for_each_cell_and_its_folder_last(swept):
    code, out, err = swept.outcome
    assert code == 1 and "Traceback" not in out + err, err
    assert err.splitlines()[0] == "sweep: 3 runs, 2 at a time (hydra/launcher=workers); a line follows as each ends"
    lines = out.splitlines()
    assert Path(lines[-1]) == next(swept.results.glob("sweeps/*/plan.json")).parent
    of_cells = [line for line in lines if not line.startswith("first failure: ")]
    assert sum(str(swept.results / "runs") in line for line in of_cells) == len(HOWS) - 1  # all except NO_FOLDER
    assert "3 planned: " in out and "1 not_run" in out
    assert err.count("set results_dir to a folder you can write") == 1


def test_its_runs_have_the_threads_that_the_launcher_pins(swept):
    assert {record["environment"].get("threads") for record in read_records(swept.results)[0]} - {None} == {1}


@pytest.mark.slow
@pytest.mark.parametrize("launcher", LAUNCHERS)
def test_every_way_to_fail_has_a_record_under_every_launcher(tmp_path, launcher):
    need(launcher)
    settings = (f"hydra/launcher={launcher}", *LAUNCHERS[launcher][1], *LIMITED, "memory_limit=1.5")
    cells = (*settings, f"+renderer.how={','.join(CASES)}")
    by_program("-m", "bench", "-m", *FAILING, *cells, f"results_dir={tmp_path}")
    records, problems = read_records(tmp_path)
    assert problems == []
    statuses = {record["config"]["renderer"]["how"]: record["status"] for record in records}
    assert statuses == {how: status for how, (_, status, _) in CASES.items()}
    assert len(plan_of(tmp_path)["cells"]) == len(records) == len(CASES)


def stopped(tmp_path: Path, number: signal.Signals) -> CommandResult:
    """Sends a signal to a sweep of three cells while its first cell runs, which takes long."""
    arguments = ("-m", *FAILING, "+renderer.how=not", "+renderer.pause=900", "seed=0,1,2", f"results_dir={tmp_path}")
    with driver(tmp_path / "output", *arguments) as running:
        wait_for(lambda: list(tmp_path.glob("runs/*/record.json")), running)
        return running.send(number)


@pytest.mark.slow
def test_the_plan_is_written_before_the_first_cell_and_shows_what_was_not_run(tmp_path):
    assert stopped(tmp_path, signal.SIGKILL).code == -signal.SIGKILL
    cells = plan_of(tmp_path)["cells"]
    assert [cell["seed"] for cell in cells] == [0, 1, 2]
    records, problems = read_records(tmp_path)
    assert problems == [] and {record["id"] for record in records} == {cell["id"] for cell in cells}
    assert sorted(record["status"] for record in records) == ["killed", "not_run", "not_run"]
    reasons = {record["status"]: record["reason"] for record in records}
    assert "the same command runs it" in reasons["not_run"] and "before it could say why" in reasons["killed"]
    write_index(tmp_path)
    assert Page(tmp_path).text("status").count("not_run") == 2


def test_stopped_workers_write_the_records_of_their_runs(tmp_path):
    cells = ("-m", *FAILING, "+renderer.how=not", "+renderer.pause=900", "seed=0,1,2", f"results_dir={tmp_path}")
    program = [sys.executable, "-m", "bench", *cells, "hydra/launcher=workers"]
    with subprocess.Popen(program, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as running:
        wait_for(lambda: len(list(tmp_path.glob("runs/*/record.json"))) == 2)
        running.terminate()
        out, err = running.communicate(timeout=PATIENCE)
    assert running.returncode == 130 and errors(err) == ["error: stopped by SIGTERM"]
    assert "3 planned: 2 killed, 1 not_run" in out
    killed = [record["reason"] for record in read_records(tmp_path)[0] if record["status"] == "killed"]
    assert killed == ["stopped by SIGTERM; the same command starts it anew"] * 2


@pytest.mark.usefixtures("interruptible")
@pytest.mark.parametrize("error", [AttributeError("a list was half made"), None], ids=["replaced", "swallowed"])
def test_a_sweep_stops_also_if_a_library_replaces_or_swallows_the_interrupt(tmp_path, monkeypatch, error):
    def interrupted(text: str) -> None:
        try:
            signal.raise_signal(signal.SIGINT)
        except KeyboardInterrupt:
            if error is not None:
                raise error from None

    monkeypatch.setattr("bench.runner.run.run_progress", lambda name: nullcontext(interrupted(name)))
    code, out, err = command("-m", *FAILING, "+renderer.how=not", "seed=0,1,2", f"results_dir={tmp_path}")
    assert code == 130 and "3 planned: 2 not_run, 1 killed" in out
    assert errors(err)[0] == "error: killed: stopped by Ctrl-C; the same command starts it anew"
    assert Path(out.splitlines()[-1]) == next(tmp_path.glob("sweeps/*/plan.json")).parent
    assert (tmp_path / "index.html").is_file()


def test_a_sweep_of_nothing_is_an_error(isolated):
    code, _, err = isolated("-m", *FAILING, "seed=range(0,0)")
    assert code == 2 and err.startswith("error: the sweep has no cell") and len(err.splitlines()) == 1


@each("seconds, jobs", [
    ([], []), ([60.0, 60.0, 60.0], [[0], [1], [2]]), ([30.0, 30.0, 30.0], [[0, 1], [2]]),
    ([90.0, 10.0, 10.0, 41.0], [[0], [1, 2], [3]]),  # the first run takes longer than a job
])  # fmt: skip
def test_a_job_has_as_many_runs_as_its_minutes_hold(seconds, jobs):
    assert group_by_duration(seconds, 60.0) == jobs


@pytest.mark.parametrize("settings, words", [
    ("timeout_min=10 minutes_per_job=5", "seconds end its run: set hydra.launcher.timeout_min=11 or more, or time_l"),
    ("timeout_min=40", "minutes_per_job=60 is more than hydra.launcher.timeout_min=40, "),
    ("array_size=0", "hydra.launcher.array_size must be positive, not 0: leave it out"),
    ("cluster=locl", "hydra.launcher.cluster must be slurm or local, not 'locl'"),
])  # fmt: skip
def test_what_a_job_cannot_do_is_refused_before_anything_is_written(tmp_path, settings, words):
    need("slurm")
    wrong = ("time_limit=601", *(f"hydra.launcher.{setting}" for setting in settings.split()))
    for more in ((), ("plan=true",)):
        result = command("-m", *FAILING, "hydra/launcher=slurm", *wrong, *more, f"results_dir={tmp_path / 'r'}")
        assert result.code == 2 and words in errors(result.err)[0] and len(errors(result.err)) == 1
    assert not (tmp_path / "r").exists()


def test_without_slurm_nothing_runs_and_the_plan_stays(tmp_path, monkeypatch):
    need("slurm")
    monkeypatch.setattr("bench.clusters.which", lambda _: None)
    code, out, err = command("-m", *FAILING, "+renderer.how=not", "hydra/launcher=slurm", f"results_dir={tmp_path}")
    assert code == 2 and "error: no Slurm is here: type this on a machine of the cluster, or hydra.launcher.c" in err
    assert "1 planned: 1 not_run" in out and len(plan_of(tmp_path)["cells"]) == 1


@pytest.mark.slow
@pytest.mark.parametrize("number, words", [(signal.SIGKILL, " was lost; "), (signal.SIGUSR1, ": stopped by SIGUSR1; ")])
def test_a_job_that_a_signal_ends_loses_no_run(tmp_path, number, words):
    need("slurm")
    jobs = ("cluster=local", "minutes_per_job=3", "minutes_per_run=1", "tasks_per_node=2", "array_size=1")
    cells = ("+renderer.how=not,raise", "+renderer.pause=0.3", "seed=range(0,6)", f"results_dir={tmp_path}")
    arguments = ("-m", *FAILING, "hydra/launcher=slurm", *(f"hydra.launcher.{key}" for key in jobs), *cells)

    def by_end() -> tuple[dict[str, dict], set[str]]:
        """The records of runs that ended by themselves, and the statuses of the others."""
        records = read_records(tmp_path)[0]
        ended = {r["id"]: r for r in records if r["ended"] and r["status"] != "killed"}
        return ended, {r["status"] for r in records if r["id"] not in ended}

    with driver(tmp_path / "output", *arguments) as running:
        wait_for(lambda: by_end()[0], running)
        first, *others = tmp_path.glob("sweeps/.hydra/.submitit/[0-9]*")  # named by the processes of jobs
        assert others == []
        psutil.Process(int(first.name)).children()[0].send_signal(number)
        code, _, err = running.ended()
    before, left = by_end()
    assert code == 1 and f"error: job {first.name}{words}" in err, err
    assert "12 runs in 2 jobs, 2 at a time in each, by hydra.launcher.minutes_per_job=3" in err
    assert "not_run" in left and 5 < len(before) < 12
    again = by_program("-m", "bench", *arguments)
    assert again.code == 1 and "error: job" not in again.err
    after, left = by_end()
    assert len(after) == 12 and all(after[name]["started"] == record["started"] for name, record in before.items())
    assert {record["environment"].get("runs_at_once") for record in after.values()} == {2}
