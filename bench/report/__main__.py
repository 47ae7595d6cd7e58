"""`python -m bench.report [KEY=VALUE ...]`: writes all tables, figures and `index.html`, and prints their paths."""

import sys
from pathlib import Path

from bench.records.read import check_results, read_records
from bench.records.results import RESULTS, write_error_message
from bench.report.suite.attempts import attempts_of, read_attempts, write_attempts
from bench.report.sweeps import write_sweeps
from bench.report.write.html import MAX_MESHES, page_lock, write_page
from bench.report.write.paper import ship, write_columns, write_paper, write_readme

USAGE = f"""usage: python -m bench.report [results_dir=PATH] [meshes=all] [columns.PAGE=HEADING,HEADING] [ship=PATH]
  results_dir   the folder with the runs; `{RESULTS}` unless given
  meshes        of how many runs, the newest first, the mesh turns on the page; {MAX_MESHES} unless given, or all
  columns.PAGE  the columns of its LaTeX table, such as columns.table1=Strategy,Queries,Forward; all unless given
  ship          for maintainers (make results): writes the tables and README.md to this folder, and nothing else"""
KEY_FORMS = ("results_dir=PATH", "meshes=all", "columns.PAGE=HEADING,HEADING", "ship=PATH")
KEYS = {text.partition("=")[0]: text for text in KEY_FORMS}


def main(arguments: list[str]) -> int:
    """Writes all pages and `index.html`; returns 2 for a wrong argument, 1 if a page or a run is missing, else 0."""
    if arguments in (["-h"], ["--help"]):
        print(USAGE)
        return 0
    try:
        options = parse_options(arguments)
        status = _report(options)
        write_columns(Path(options.get("ship") or options.get("results_dir", RESULTS)), options)
        return status
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except OSError as error:
        if isinstance(error, BrokenPipeError):  # of the printed paths
            raise
        print(f"error: {write_error_message(error)}", file=sys.stderr)
        return 2


def _report(options: dict[str, str]) -> int:
    results_dir, meshes = Path(options.get("results_dir", RESULTS)), _meshes(options.get("meshes", str(MAX_MESHES)))
    if ship_folder := options.get("ship"):
        records, _ = read_records(results_dir)
        shipped_attempts, problems = read_attempts(results_dir)
        if problems:
            raise ValueError(f"{results_dir} keeps what cannot be read; mend it or move it away: {'; '.join(problems)}")
        rows = write_attempts([*attempts_of(records, results_dir), *shipped_attempts], Path(ship_folder))
        print(*rows, *ship(records, results_dir, Path(ship_folder)), write_readme(Path(ship_folder)), sep="\n")
        return 0
    check_results(results_dir)
    with page_lock(results_dir):
        return _write_all(results_dir, meshes)


def _write_all(results_dir: Path, meshes: int | None) -> int:
    records, unread = read_records(results_dir)
    failed_pages: list[str] = []
    page_paths = write_paper(records, results_dir, problems=failed_pages)
    for path in (*page_paths, *write_sweeps(records, results_dir, failed_pages)):
        print(path)
    for problem in [*(f"not read: {problem}" for problem in unread), *failed_pages]:
        print(problem, file=sys.stderr)
    print(write_page(records, unread, results_dir, meshes))
    return 1 if failed_pages or unread else 0


def parse_options(arguments: list[str]) -> dict[str, str]:
    """Splits the arguments into keys and values; raises ValueError if a key is unknown, or its value is missing."""
    options = {}
    for argument in arguments:
        key, _, value = argument.partition("=")
        kind = "columns.PAGE" if key.startswith("columns.") else key
        if kind not in KEYS:
            raise ValueError(f"argument must be one of {', '.join(KEYS.values())}, found {argument!r}")
        if not value:
            raise ValueError(f"{key} has no value: type {KEYS[kind]}")
        options[key] = value
    return options


def _meshes(text: str) -> int | None:
    if text == "all":
        return None
    if not text.isdecimal():
        raise ValueError(f"meshes must be a number of runs or all, found {text!r}")
    return int(text)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
