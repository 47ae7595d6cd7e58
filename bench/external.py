"""`python -m bench.external RECIPE code=FOLDER dataset=photos dataset.path=FOLDER`: judges a code of others.

    python -m bench.external neus code=NeuS dataset=photos dataset.path=FOLDER               by NeuS/.venv/bin/python
    python -m bench.external MINE.yaml code=FOLDER python=FILE dataset=photos dataset.path=FOLDER time_limit=7200
    python -m bench.external neus code=NeuS 'container=[docker,run,...]' dataset=photos dataset.path=FOLDER

A recipe is a file of conf/external, or a YAML of yours; conf/README.md lists its keys. It runs programs: read it first.
Any other KEY=VALUE is passed to `python -m bench`. The name of the row has a star and the commit of the code.
"""

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from bench.config import build
from bench.records.record import RunStatus
from bench.runner.messages import quoted
from bench.setup.inputs import RunContext, RunInputs
from bench.tables import CONF, nearest, read_yaml
from bench.tasks.reconstruction.baselines import note_baseline
from bench.tasks.reconstruction.subject import PhotographTask
from datasets.files.captures.exports import LAYOUTS
from datasets.files.meshes import read_mesh
from datasets.mesh import Mesh
from datasets.shot import Shot
from renderers.checks import BadInput, check_choice, check_positive

COMMIT_DIGITS_IN_ROW = 7
OPTIONS = ("code", "python", "container", "time_limit")  # arguments of `External`; `python -m bench` reads the others
OUTPUT_FILE, SHOWN_CHARACTERS = "output.txt", 200  # what a code prints, and how much of it is in messages
IN_CODE = "{code}/"  # begins the pattern of a mesh that lies in the folder of the code


class CodeFailed(Exception):
    """A code of others gave no mesh; `status` is that of its run."""

    def __init__(self, message: str, status: RunStatus = RunStatus.CRASHED) -> None:
        super().__init__(message)
        self.status = status


@dataclass(frozen=True)
class Recipe:
    """How a code of others runs on exported photographs; conf/README.md lists the keys. Raises ValueError."""

    label: str
    commit: str
    layout: str
    commands: list[list[str]]
    mesh: str
    to_sphere: list[list[Any]] = field(default_factory=lambda: np.eye(4).tolist())
    photographs: str = "photographs"
    first_pixel: float = 0.0
    masks: bool = True
    run_in: str = "{work}"
    files: dict[str, str] = field(default_factory=dict)
    variables: dict[str, str] = field(default_factory=dict)
    container: tuple[str, ...] = ()
    ok_statuses: tuple[int, ...] = (0,)
    time_limit: float = 86_400.0

    def __post_init__(self) -> None:
        check_choice("layout", self.layout, tuple(LAYOUTS))
        check_positive("time_limit", self.time_limit, "3600 is an hour")
        if not re.fullmatch(r"[0-9a-f]{7,40}", self.commit):
            raise ValueError(f"commit must be 7 to 40 hexadecimal digits, not {self.commit!r}: type git log -1")
        if not self.commands or not all(self.commands):
            raise ValueError("commands must be a list of commands, each a list of words: [['{python}', train.py]]")
        numbers = [value for row in self.to_sphere for value in row if isinstance(value, int | float)]
        if [len(row) for row in self.to_sphere] != [4] * 4 or len(numbers) != 16:
            raise ValueError("to_sphere must have four rows of four numbers, the first such as [2, 0, 0, 0.1]")

    @property
    def row(self) -> str:
        return f"{self.label} ★ {self.commit[:COMMIT_DIGITS_IN_ROW]}"


def find_recipe(name: str) -> Path:
    """The file of a recipe: conf/external/NAME.yaml, or a path; raises ValueError if there is none."""
    choices = {path.stem: path for path in sorted((CONF / "external").glob("*.yaml"))}
    path = choices.get(name, Path(name))
    if not path.is_file():
        raise ValueError(f"unknown recipe {name!r}{nearest(name, [*choices])}; or give a YAML file of yours")
    return path.resolve()


def read_recipe(path: str | Path) -> Recipe:
    """Reads a recipe; raises ValueError if a key is unknown, missing or has an invalid value."""
    return build(read_yaml(Path(path)), f"recipe {path}", target="bench.external.Recipe")


@dataclass(frozen=True)
class External(PhotographTask):
    """Runs a code of others on the input photographs, and evaluates its mesh on the held-out ones."""

    path: str | None = None  # of the recipe
    code: str | None = None  # its folder, a git checkout
    python: str | None = None  # the program {python} of recipes; None: .venv/bin/python in `code`
    container: list[str] | None = None  # words before each command; None: the recipe's
    time_limit: float | None = None  # seconds of all commands; None: the recipe's

    def check(self, inputs: RunInputs) -> None:
        """Raises BadInput if the recipe is missing or invalid, or the code is not at the recipe's commit."""
        if self.path is None or self.code is None:
            raise BadInput("a recipe and its code are needed: python -m bench.external NAME code=FOLDER dataset=photos")
        wanted, git = read_recipe(self.path).commit, ["git", "-C", self.code, "rev-parse", "HEAD"]
        commit = subprocess.run(git, capture_output=True, text=True, check=False).stdout.strip()
        if not commit.startswith(wanted):
            state = f"is at commit {commit}" if commit else "is no git checkout"
            raise BadInput(
                f"code={self.code} {state}, and the recipe is for {wanted}: type git -C {self.code} checkout {wanted}, "
                "or set commit in a copy of the recipe"
            )

    def execute(self, run: RunContext) -> None:
        """Records the metrics of the mesh, or why the code gave none."""
        recipe, subject = read_recipe(self.path or ""), self.subject(run.inputs)
        if recipe.masks and any(shot.mask is None for shot in subject.input_shots):
            raise BadInput(f"{recipe.label} needs a mask of each photograph: add masks, or take another recipe")
        run.record.notes = [*run.record.notes, f"a code of others: {recipe.row}, with the colours of the photographs"]
        try:
            note_baseline(run, subject, lambda: self.mesh_of(recipe, subject.input_shots, run.folder / "external"))
        except CodeFailed as error:
            run.record.status, run.record.reason = error.status, str(error)
        else:
            subject.finish(run)

    def mesh_of(self, recipe: Recipe, shots: Sequence[Shot], work: Path) -> Mesh:
        """Exports photographs to `work`, runs the commands, and returns their mesh in the unit sphere."""
        work, code, started = work.resolve(), Path(self.code or "").resolve(), time.time()
        values = {"work": work, "code": code, "count": len(shots), "python": self.python or code / ".venv/bin/python"}

        def filled(text: str) -> str:
            return re.sub(r"\{(work|code|count|python)\}", lambda match: str(values[match[1]]), text)

        LAYOUTS[recipe.layout](shots, work / recipe.photographs, recipe.first_pixel)
        for name, text in recipe.files.items():
            (work / name).parent.mkdir(parents=True, exist_ok=True)
            (work / name).write_text(filled(text), encoding="utf-8")
        variables = {key: value for key, value in os.environ.items() if not key.startswith("PYTHON")}
        variables |= {key: filled(value) for key, value in recipe.variables.items()}
        limit = recipe.time_limit if self.time_limit is None else self.time_limit
        prefix = recipe.container if self.container is None else self.container
        for command in recipe.commands:
            words = [filled(word) for word in (*prefix, *command)]
            options = {"cwd": filled(recipe.run_in), "env": variables}
            try:
                status = _run(words, work / OUTPUT_FILE, started + limit, options)
            except subprocess.TimeoutExpired:
                message = f"the code took more than {limit:g} s: type time_limit=SECONDS{_output(work)}"
                raise CodeFailed(message, RunStatus.TIMEOUT) from None
            if status not in recipe.ok_statuses:
                remedy = f"correct what its output names{_output(work)}"
                raise CodeFailed(f"{' '.join(words)} ended with status {status}: {remedy}")
        return _newest_mesh(recipe, work, code, started)


def _run(words: list[str], log: Path, deadline: float, options: dict[str, Any]) -> int:
    """Runs a command, whose output is added to a file, to a deadline in seconds since 1970; returns its exit status.

    It and its children are ended by TimeoutExpired and other exceptions; raises CodeFailed if it cannot be started.
    """
    options = {"stdin": subprocess.DEVNULL, "stderr": subprocess.STDOUT, "start_new_session": True, **options}
    with log.open("ab") as output:
        try:
            process = subprocess.Popen(words, stdout=output, **options)
        except OSError as error:
            remedy = "type python=FILE, the Python of the code, or correct commands of the recipe"
            raise CodeFailed(f"{words[0]} cannot be started ({error.strerror}): {remedy}") from error
        try:
            return process.wait(max(deadline - time.time(), 0.0))
        except BaseException:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            raise


def _newest_mesh(recipe: Recipe, work: Path, code: Path, started: float) -> Mesh:
    """The newest mesh that was written after `started`, in the unit sphere; raises CodeFailed without any."""
    root = code if recipe.mesh.startswith(IN_CODE) else work
    written = [path for path in root.glob(recipe.mesh.removeprefix(IN_CODE)) if path.stat().st_mtime >= int(started)]
    if not written:
        message = f"the code ended, and wrote no {recipe.mesh} in {root}: correct mesh of the recipe"
        raise CodeFailed(f"{message}{_output(work)}")
    newest = max(written, key=lambda path: path.stat().st_mtime_ns)
    try:
        return read_mesh(newest).moved(np.array(recipe.to_sphere))
    except (OSError, ValueError) as error:
        raise CodeFailed(f"the mesh of the code cannot be read: {error}") from error


def _output(work: Path) -> str:
    """The file with the output of a code and its last characters, for a message."""
    text = " ".join((work / OUTPUT_FILE).read_text(encoding="utf-8", errors="replace").split())
    return f". Its output is in {work / OUTPUT_FILE}, and ends with: {text[-SHOWN_CHARACTERS:] or 'nothing'}"


def main(arguments: Sequence[str]) -> int:
    """Runs a recipe and writes the report; returns the exit status of `python -m bench`, or 2 for a wrong recipe."""
    if not arguments or {"-h", "--help"} & {*arguments}:
        print(__doc__)
        return 0 if arguments else 2
    try:
        recipe = read_recipe(path := find_recipe(arguments[0]))
    except (OSError, ValueError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    keys = [f"{'task.' if text.partition('=')[0] in OPTIONS else ''}{text}" for text in arguments[1:]]
    fixed = ["task=external", f"task.path={quoted(str(path))}", f"label={quoted(recipe.row)}", "time_limit=null"]
    defaults = {"+experiment=": "photos", "rerun=": "failed"}  # a repaired environment changes no hash of ours
    fixed += [f"{key}{value}" for key, value in defaults.items() if not any(text.startswith(key) for text in keys)]
    status = subprocess.call([sys.executable, "-m", "bench", *fixed, *keys])
    if status in (0, 1):
        results = [key for key in keys if key.startswith("results_dir=")]
        subprocess.call([sys.executable, "-m", "bench.report", *results])
    return status


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
