"""Sweeps are planned before they start, and have a row for every cell under every launcher."""

import json
import signal
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from omegaconf import OmegaConf

from bench.config import CONF, register
from bench.records.folder import identify
from bench.records.read import read_records
from bench.records.record import Record
from bench.report.write.html import write_index
from tests.report.page_data import Page
from tests.run.driving import FAILING, PATIENCE, ROOT, Outcome, command, driver, wait_for
from tests.run.test_process import CASES

LAUNCHERS = {
    "basic": ("", ()),
    "joblib": ("hydra_plugins.hydra_joblib_launcher", ("hydra.launcher.n_jobs=2",)),
    "workers": ("hydra_plugins.hydra_joblib_launcher", ()),
    "submitit_local": ("hydra_plugins.hydra_submitit_launcher", ("hydra.launcher.timeout_min=5",)),
    "ray_cluster": ("hydra_plugins.hydra_ray_launcher", ()),
}
LAUNCHED = ("basic", "workers")  # the others are in the slow tier: they take a minute to start
PINNED = ("workers",)  # our presets pin the threads of their runs
# The cells of a sweep under every launcher; `terminate` stands for a cell whose run folder cannot be made.
NO_FOLDER = "terminate"
HOWS = ("not", "loop", NO_FOLDER)
MORE = (
    "kill",
    "raise",
    "not_a_number",
    "leave",
    "segfault",
    "native_loop",
)  # under the basic launcher, which costs least
# A limit of its own for each: a short one for work that never ends, a generous one for work that ends at once.
LIMITS = {how: 1 if CASES[how][1] == "timeout" else PATIENCE for how in CASES} | {"not": PATIENCE}
LIMITED = (
    f"+renderer.limits={{{','.join(f'{how}:{seconds}' for how, seconds in LIMITS.items())}}}",
    "time_limit='${renderer.limits.${oc.select:renderer.how,not}}'",  # a sweep is planned from what has no `how` yet
)


@dataclass(frozen=True)
class Swept:
    """A sweep that has ended: its cells, its results and what it printed."""

    launcher: str
    hows: tuple[str, ...]
    results: Path
    outcome: Outcome

    @property
    def statuses(self) -> dict[str, str]:
        return {record["config"]["renderer"]["how"]: record["status"] for record in read_records(self.results)[0]}


def available(launcher: str) -> bool:
    package = LAUNCHERS[launcher][0]
    return not package or (find_spec("hydra_plugins") is not None and find_spec(package) is not None)


def need(launcher: str) -> None:
    if not available(launcher):
        pytest.skip(f"the plugin of {launcher} is not installed: pip install -e '.[joblib,submitit,ray]'")


def started_program(arguments: tuple[str, ...]) -> subprocess.Popen:
    """A command line in a program of its own."""
    program = [sys.executable, "-m", "bench", *arguments]
    return subprocess.Popen(program, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def hows_of(launcher: str) -> tuple[str, ...]:
    return (*HOWS, *(MORE if launcher == "basic" else ()))


def plan_of(results: Path) -> dict:
    (path,) = results.glob("sweeps/*/plan.json")
    return json.loads(path.read_text())


def folder_of(results: Path, *arguments: str) -> Path:
    """The run folder of a cell."""
    register()
    GlobalHydra.instance().clear()
    with initialize_config_dir(str(CONF), version_base="1.3"):
        config = compose("config", [*arguments, f"results_dir={results}"], return_hydra_config=True)
    runtime = config.hydra.runtime
    OmegaConf.set_struct(config, False)
    del config["hydra"]
    return results / "runs" / identify(config, runtime).name


@dataclass(frozen=True)
class Started:
    """A sweep by a program of its own, or, without one, what it is to sweep over."""

    results: Path
    arguments: tuple[str, ...]
    program: subprocess.Popen | None

    def ended(self) -> Outcome:
        """What the sweep left; without a program it takes place now, in this process."""
        if self.program is None:
            return command(*self.arguments)
        out, err = self.program.communicate(timeout=8 * PATIENCE)
        return Outcome(self.program.returncode, out, err)


@pytest.fixture(scope="module")
def started(tmp_path_factory) -> Iterator[dict[str, Started]]:
    """One sweep under each launcher, all at once, since they mostly wait."""
    sweeps = {}
    for launcher in LAUNCHED:
        if not available(launcher):
            continue
        results = tmp_path_factory.mktemp(launcher)
        arguments = (f"hydra/launcher={launcher}", *LAUNCHERS[launcher][1], *LIMITED, "threads=null")
        blocked = folder_of(results, *FAILING, *arguments, f"+renderer.how={NO_FOLDER}")
        blocked.parent.mkdir()
        blocked.symlink_to(results / "nowhere")
        arguments = (*arguments, f"+renderer.how={','.join(hows_of(launcher))}")
        arguments = ("-m", *FAILING, *arguments, f"results_dir={results}")
        sweeps[launcher] = Started(results, arguments, None if launcher == "basic" else started_program(arguments))
    yield sweeps
    for sweep in sweeps.values():
        if sweep.program is not None:
            sweep.program.kill()
            sweep.program.wait()


@pytest.fixture(scope="module", params=LAUNCHED)
def swept(request, started) -> Swept:
    """One sweep under each launcher: a run that ends by itself, one killed, one that hangs, one without a folder."""
    launcher = request.param
    need(launcher)
    outcome = started[launcher].ended()
    assert outcome.code == 1, outcome.err
    return Swept(launcher, hows_of(launcher), started[launcher].results, outcome)


def test_every_planned_cell_is_a_row_whatever_becomes_of_it(swept):
    planned = [cell["id"] for cell in plan_of(swept.results)["cells"]]
    records, problems = read_records(swept.results)
    assert problems == []
    assert sorted(record["id"] for record in records) == sorted(planned)
    assert len(planned) == len(swept.hows)
    found = swept.statuses
    ends = {how: CASES[how][1] for how in swept.hows if how not in ("not", NO_FOLDER)}
    assert found == {"not": found["not"], NO_FOLDER: "not_run", **ends}
    assert found["not"] in ("ok", "not_reached")


def test_a_limit_holds_for_a_cell_and_no_other(swept):
    for record in read_records(swept.results)[0]:
        limited = record["status"] == "timeout"
        assert limited is (LIMITS[record["config"]["renderer"]["how"]] < PATIENCE)
        assert not limited or "more than time_limit=1 s" in record["reason"]


def test_a_sweep_prints_a_line_for_each_cell_and_its_folder_last(swept):
    code, out, err = swept.outcome
    assert code == 1, err
    assert "Traceback" not in out + err
    lines = out.splitlines()
    assert Path(lines[-1]) == next(swept.results.glob("sweeps/*/plan.json")).parent
    of_cells = [line for line in lines if not line.startswith("first failure: ")]
    assert sum(str(swept.results / "runs") in line for line in of_cells) == len(swept.hows) - 1  # all but NO_FOLDER


def test_its_page_has_every_cell(swept):
    page = Page(swept.results)
    assert all(cell["id"] in page.folders for cell in plan_of(swept.results)["cells"])


def test_its_runs_have_the_threads_that_the_launcher_pins(swept):
    threads = {record["environment"].get("threads") for record in read_records(swept.results)[0]} - {None}
    assert threads
    if swept.launcher in PINNED:
        assert threads == {1}


def test_where_a_run_folder_cannot_be_made_it_says_what_to_do(swept):
    counted = Counter(swept.statuses.values())
    assert counted["not_run"] == 1
    assert f"{len(swept.hows)} planned: " in swept.outcome.out and "1 not_run" in swept.outcome.out
    assert swept.outcome.err.count("set results_dir to a folder you can write") == 1


@pytest.mark.slow
@pytest.mark.parametrize("launcher", LAUNCHERS)
def test_every_way_to_fail_is_a_row_under_every_launcher(tmp_path, launcher):
    need(launcher)
    cells = (f"hydra/launcher={launcher}", f"+renderer.how={','.join(CASES)}", *LIMITED, "memory_limit=1.5")
    started_program(("-m", *FAILING, *cells, f"results_dir={tmp_path}")).communicate(timeout=8 * PATIENCE)
    records, problems = read_records(tmp_path)
    assert problems == []
    found = {record["config"]["renderer"]["how"]: record["status"] for record in records}
    assert found == {how: status for how, (_, status, _) in CASES.items()}
    assert len(plan_of(tmp_path)["cells"]) == len(records) == len(CASES)


def test_where_no_run_folder_can_be_made_every_planned_cell_is_still_a_row(isolated, tmp_path):
    (tmp_path / "r").mkdir()
    (tmp_path / "r" / "runs").touch()  # where a folder should be
    code, out, err = isolated("-m", *FAILING, "+renderer.how=not,raise")
    assert code == 1
    assert "Traceback" not in out + err
    assert "2 planned: 2 not_run" in out
    assert err.count("set results_dir to a folder you can write") == 2
    records, _ = read_records(tmp_path / "r")
    assert [record["status"] for record in records] == ["not_run"] * 2


def stopped(tmp_path: Path, number: signal.Signals) -> Outcome:
    """A sweep of three cells that is sent a signal when the first one is under way, which goes on for long."""
    arguments = ("-m", *FAILING, "+renderer.how=not", "+renderer.pause=900", "seed=0,1,2", f"results_dir={tmp_path}")
    with driver(tmp_path / "output", *arguments) as running:
        wait_for(lambda: list(tmp_path.glob("runs/*/record.json")), running)
        return running.send(number)


def test_the_plan_stands_before_the_first_cell_and_shows_what_was_not_run(tmp_path):
    assert stopped(tmp_path, signal.SIGKILL).code == -signal.SIGKILL
    cells = plan_of(tmp_path)["cells"]
    assert [cell["seed"] for cell in cells] == [0, 1, 2]
    records, problems = read_records(tmp_path)
    assert problems == []
    assert {record["id"] for record in records} == {cell["id"] for cell in cells}
    assert sorted(record["status"] for record in records) == ["killed", "not_run", "not_run"]
    assert "the same command runs it" in next(r for r in records if r["status"] == "not_run")["reason"]
    write_index(tmp_path)
    assert Page(tmp_path).text("status").count("not_run") == 2


def test_a_sweep_that_is_stopped_says_what_it_came_to(tmp_path):
    code, out, _ = stopped(tmp_path, signal.SIGINT)
    assert code == 130
    assert "3 planned: 2 not_run, 1 killed" in out
    assert Path(out.splitlines()[-1]) == next(tmp_path.glob("sweeps/*/plan.json")).parent
    assert (tmp_path / "index.html").is_file()


@pytest.fixture
def interruptible() -> Iterator[None]:
    """Ctrl-C takes effect also where these tests are a shell's background job, which ignores it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("interruptible")
@pytest.mark.parametrize("error", [AttributeError("a list was half made"), None], ids=["replaced", "swallowed"])
def test_a_sweep_stops_also_where_a_library_makes_something_else_of_the_interrupt(tmp_path, monkeypatch, error):
    def interrupted(text: str) -> None:
        try:
            signal.raise_signal(signal.SIGINT)
        except KeyboardInterrupt:
            if error is not None:
                raise error from None

    monkeypatch.setattr("bench.run.run.run_progress", lambda name: nullcontext(interrupted(name)))
    code, out, err = command("-m", *FAILING, "+renderer.how=not", "seed=0,1,2", f"results_dir={tmp_path}")
    assert code == 130
    assert "3 planned: 2 not_run, 1 killed" in out
    assert err.strip() == "error: killed: stopped by Ctrl-C; the same command starts it anew"


@pytest.mark.usefixtures("interruptible")
def test_a_sweep_that_is_stopped_just_after_a_record_is_written_says_so(tmp_path, monkeypatch):
    write, written = Record.write, []

    def interrupted(record: Record, folder: Path) -> None:
        write(record, folder)
        written.append(folder)
        if len(written) == 1:
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(Record, "write", interrupted)
    code, out, _ = command("-m", *FAILING, "+renderer.how=not", "seed=0,1,2", f"results_dir={tmp_path}")
    assert code == 130
    assert "3 planned: 2 not_run, 1 killed" in out


def test_a_cell_that_cannot_be_composed_stops_the_sweep_before_it_starts(isolated, tmp_path):
    code, _, err = isolated("-m", *FAILING, "scale=smoke,smok")
    assert code == 2
    assert err.strip() == "error: unknown scale 'smok': did you mean smoke?"
    assert not (tmp_path / "r" / "runs").exists()


def test_a_sweep_of_nothing_is_told(isolated):
    code, _, err = isolated("-m", *FAILING, "seed=range(0,0)")
    assert code == 2
    assert "error: the sweep has no cell" in err
    assert len(err.splitlines()) == 1
