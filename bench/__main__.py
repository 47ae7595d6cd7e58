"""`python -m bench task=completion renderer=dist`: one run, or with -m a sweep."""

from __future__ import annotations  # of a run's process, which imports this module again, nothing else is loaded

import os
import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from bench.records.read import Plan


def main() -> int:
    """Runs the command line; 0 if every run ended ok."""
    from bench.run.command import command_line
    from bench.run.run import run_one
    from bench.run.sweep import run_sweep

    return command_line(run_one, lambda composer, config: run_sweep(composer, config, _summarise))


def _summarise(plan: Plan) -> list[str]:
    """Writes and prints what a sweep came to; gives the status of each of its cells."""
    from bench.report.sweeps import write_sweep
    from bench.report.write.html import write_index
    from bench.run.summary import show_sweep

    table = write_sweep(plan)
    return show_sweep(plan, write_index(plan.results_dir), table)


def console() -> int:
    """`implicit-bench WORD ...` is `python -m bench.WORD ...`, and with the word run it is `python -m bench ...`."""
    word, *more = sys.argv[1:] or ["--help"]
    known = _words()
    if word in ("-h", "--help"):
        print("usage: implicit-bench WORD ...", *known.values(), sep="\n  ")
        return 0
    if word not in known:
        from bench.tables import nearest

        print(f"error: unknown word {word!r}{nearest(word, [*known])}", file=sys.stderr)
        return 2
    os.execv(sys.executable, [sys.executable, "-m", "bench" if word == "run" else f"bench.{word}", *more])


def _words() -> dict[str, str]:
    """The words of `implicit-bench`, which are the modules that `python -m` runs, with the first lines of these."""
    here, found = Path(__file__).parent, {}
    for file in sorted([*here.glob("*.py"), *here.glob("*/__main__.py")]):
        first = file.read_text(encoding="utf-8").partition("\n")[0].strip('"').replace("`", "")
        if first.startswith("python -m bench"):
            word = file.stem if file.stem != "__main__" else "run" if file.parent == here else file.parent.name
            found[word] = re.sub(r"python -m bench[.\w]*", f"implicit-bench {word}", first)
    return found


if __name__ == "__main__":
    try:
        from bench.run.process import start_early

        start_early(sys.argv[1:])
        sys.exit(main())
    except KeyboardInterrupt:  # before the command line was read
        sys.exit("error: stopped by Ctrl-C; nothing was run")
