"""A run from Python: the command line in a process of its own, and the record that it leaves."""

import os
import re
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from bench.records.record import Record, read_record

GROUPS = ("method", "experiment")  # none is chosen by default, so that the command line has a plus in front
PLAIN = re.compile(r"[\w./:@%+-]+")  # a text that Hydra takes as it is


class Outcome(NamedTuple):
    """What a command left: its exit status, standard output and standard error."""

    code: int
    out: str
    err: str


def run_once(overrides: Sequence[str], choices: Mapping[str, Any]) -> Record:
    """Makes a run as `python -m bench` does, in a process of its own, or reuses the finished one; gives its record.

    It needs no `if __name__ == "__main__"`, and works in a notebook. Results go to `results/local` in the working
    directory, or to `results_dir`.

    >>> import bench
    >>> record = bench.run(task="completion", renderer="newton", scale="smoke", overrides=["task.points=50"])
    >>> print(record.status)
    ok
    >>> sorted(path.name for path in record.folder.glob("*.json*"))
    ['curve.jsonl', 'record.json']

    Args:
        overrides: as on the command line, such as `renderer.steps=30`.
        choices: likewise, as keywords: `dataset="sofa"`, `seed=1`, `method="dist_mask"`, `results_dir="mine"`.

    Returns:
        The record, also of a run that failed: see its `status` and `reason`.

    Raises:
        ValueError: for what no run can be made of, with the line that the command prints.
        OSError: where no record could be written.
    """
    if isinstance(overrides, str):
        raise ValueError(
            f"bench.run takes a list of overrides, not {overrides!r}: bench.run(['task=completion']), "
            "or bench.run(task='completion')"
        )
    given = [*(_override(key, value) for key, value in choices.items()), *overrides]
    done = _command(given)
    last = Path(done.out.rstrip("\n").rpartition("\n")[2] or ".")
    if (last / "record.json").is_file():
        record = Record.of(read_record(last))
        record.config["results_dir"] = str(last.absolute().parents[1])
        return record
    said = [line.removeprefix("error: ") for line in done.err.splitlines() if line.startswith("error: ")]
    if done.code == 0:
        line = " ".join(given)
        raise ValueError(f"bench.run makes one run, and {line!r} does not: leave out plan=true and options such as -m")
    why = said[-1] if said else f"the command ended with exit status {done.code}: {done.err.strip()[-2000:]}"
    raise (ValueError if done.code == 2 else OSError)(why)


def _command(arguments: list[str]) -> Outcome:
    """The command line in a new process, which imports what this one can import."""
    paths = os.pathsep.join(str(Path(path).absolute()) for path in sys.path)
    with subprocess.Popen(
        [sys.executable, "-m", "bench", *arguments],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        encoding="utf-8",
        errors="replace",
        env={**os.environ, "PYTHONPATH": paths},
    ) as process:
        try:
            out, err = process.communicate()
        except BaseException:  # of a notebook, which interrupts this process alone: the run must write its record
            process.terminate()
            process.communicate()
            raise
    return Outcome(process.returncode, out, err)


def _override(key: str, value: Any) -> str:
    """A keyword as an override of the command line."""
    return f"{'+' if key in GROUPS else ''}{key}={_text(value)}"


def _text(value: Any) -> str:
    """A value as the command line reads it."""
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    if isinstance(value, list | tuple):
        return f"[{','.join(map(_text, value))}]"
    text = str(value)
    if isinstance(value, int | float) or PLAIN.fullmatch(text):
        return text
    escaped = re.sub(r"(\\*)'", r"\1\1\\'", text)
    return f"'{escaped}'"
