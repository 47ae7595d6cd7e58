"""`python -m bench.report [results_dir=PATH]`: writes the page of all runs and prints its path last."""

import sys
from pathlib import Path

from bench.report.html import write_index

USAGE = "usage: python -m bench.report [results_dir=PATH]   (results_dir is `results` unless given)"


def main(arguments: list[str]) -> None:
    """Writes `index.html`; exits with a message where the command line or the folder is wrong."""
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
        print(write_index(results_dir))
    except ValueError as error:
        sys.exit(str(error))


if __name__ == "__main__":
    main(sys.argv[1:])
