"""`python -m bench.report [results_dir=PATH]`: writes all tables, figures and `index.html`, and prints their paths."""

import sys
from pathlib import Path

from bench.records.read import read_records
from bench.report.data.frame import NO_PARQUET, write_frame
from bench.report.write.html import write_index
from bench.report.write.paper import write_paper, write_readme
from bench.report.write.sweeps import write_sweeps

USAGE = "usage: python -m bench.report [results_dir=PATH]   (results_dir is `results` unless given)"


def main(arguments: list[str]) -> None:
    """Writes `runs.csv`, all pages, the tables of sweeps, `README.md` and `index.html`.

    Exits with a message where an argument is wrong.
    """
    if arguments in (["-h"], ["--help"]):
        print(USAGE)
        return
    results_dir = Path("results")
    for argument in arguments:
        key, _, value = argument.partition("=")
        if key != "results_dir" or not value:
            sys.exit(f"argument must be results_dir=PATH, found {argument!r}\n{USAGE}")
        results_dir = Path(value)
    try:
        records = read_records(results_dir)[0]
        frames = write_frame(records, results_dir)
        if len(frames) == 1:
            print(f"note: {NO_PARQUET}", file=sys.stderr)
        for path in (*frames, *write_paper(records, results_dir), *write_sweeps(records, results_dir)):
            print(path)
        write_readme(results_dir)
        print(write_index(results_dir))
    except ValueError as error:
        sys.exit(str(error))


if __name__ == "__main__":
    main(sys.argv[1:])
