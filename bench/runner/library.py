"""A run from Python: the command line in a new process, and the record of the run."""

import os
import re
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from bench.records.record import Record, read_record
from bench.runner.messages import OPTIONAL_GROUPS, quoted

UNQUOTED_TEXT = re.compile(r"[A-Za-z_/][\w./:@%+-]*", re.ASCII)  # Hydra reads it as the same text


def run(overrides: Sequence[str] = (), **choices: Any) -> Record:
    """Makes a run like `python -m bench`, in a new process, or reuses the finished run; returns its record.

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
        choices: overrides as keywords: `dataset="sofa"`, `seed=1`, `method="dist_mask"`, `results_dir="mine"`.

    Returns:
        The record, also of a failed run: see its `status` and `reason`.

    Raises:
        ValueError: if the run cannot be made, with the message of the command.
        OSError: if the record cannot be written.
    """
    if isinstance(overrides, str):
        raise ValueError(
            f"bench.run takes a list of overrides, not {overrides!r}: bench.run(['task=completion']), "
            "or bench.run(task='completion')"
        )
    arguments = [*(_override(key, value) for key, value in choices.items()), *overrides]
    result = _command(arguments)
    folder = Path(result.stdout.rstrip("\n").rpartition("\n")[2] or ".")
    if (folder / "record.json").is_file():
        record = Record.of(read_record(folder))
        record.config["results_dir"] = str(folder.absolute().parents[1])
        return record
    errors = [line.removeprefix("error: ") for line in result.stderr.splitlines() if line.startswith("error: ")]
    if result.returncode == 0:
        line = " ".join(arguments)
        raise ValueError(f"bench.run makes one run, and {line!r} does not: leave out plan=true and options such as -m")
    ending = f"the command ended with exit status {result.returncode}: {result.stderr.strip()[-2000:]}"
    raise (ValueError if result.returncode == 2 else OSError)(errors[-1] if errors else ending)


def _command(arguments: list[str]) -> subprocess.CompletedProcess[str]:
    """Runs the command line in a new process, which can import the same packages as this one."""
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
        except BaseException:  # a notebook interrupts only this process; the run must write its record
            process.terminate()
            process.communicate()
            raise
    return subprocess.CompletedProcess(process.args, process.returncode, out, err)


def _override(key: str, value: Any) -> str:
    """A keyword as an override of the command line."""
    return f"{'+' if key in OPTIONAL_GROUPS else ''}{key}={_as_typed(value)}"


def _as_typed(value: Any) -> str:
    """A value as the command line reads it; an array is a list, and a text stays that text."""
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    if isinstance(value, list | tuple):
        return f"[{','.join(map(_as_typed, value))}]"
    if isinstance(value, dict):
        return f"{{{','.join(f'{key}:{_as_typed(item)}' for key, item in value.items())}}}"
    if hasattr(value, "tolist"):  # a NumPy or PyTorch array
        return _as_typed(value.tolist())
    text = str(value)
    is_plain = UNQUOTED_TEXT.fullmatch(text) and text.lower() not in ("null", "true", "false", "nan", "inf")
    return text if is_plain or isinstance(value, int | float) else quoted(text.replace("${", "\\${"))
