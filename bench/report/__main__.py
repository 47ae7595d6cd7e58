"""`python -m bench.report [results_dir=PATH]`: writes the page and the table of all runs; prints the page last."""

import sys
from pathlib import Path

from bench.report.frame import write_frame
from bench.report.html import write_index
from bench.report.records import read_records

USAGE = "usage: python -m bench.report [results_dir=PATH]   (results_dir is `results` unless given)"


def main(arguments: list[str]) -> None:
    """Writes `runs.csv` and `index.html`; exits with a message where the command line or the folder is wrong."""
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
        print(write_frame(read_records(results_dir)[0], results_dir))
        print(write_index(results_dir))
    except ValueError as error:
        sys.exit(str(error))


if __name__ == "__main__":
    main(sys.argv[1:])
