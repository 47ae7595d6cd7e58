"""`python -m tests.compare_results BEFORE AFTER`: whether runs gave the same numbers, without times.

Each folder holds results folders of the same names, each with one run. Prints a row per run. Exits with 1 if a metric
or a count differs in the last digit, or is on one side only.
"""

import sys
from pathlib import Path
from typing import Any

from bench.records.record import read_record

PARTS = ("metrics", "metrics_start", "evaluations")
TIMING_WORDS = ("seconds", "overhead", "gemm", "peak_memory")


def numbers(record: dict[str, Any]) -> dict[str, Any]:
    """All metrics and counts of a record by name, without times."""
    flat = {f"{section}.{name}": value for section in PARTS for name, value in record[section].items()}
    flat |= {"status": record["status"], "flops": record["flops"]}
    return {name: value for name, value in flat.items() if not any(word in name for word in TIMING_WORDS)}


def record_of(results: Path) -> dict[str, Any]:
    """The record of the one run of a results folder."""
    (folder,) = [path for path in (results / "runs").iterdir() if not path.name.startswith(".")]
    return read_record(folder)


def compared(before: Path, after: Path) -> tuple[int, list[str]]:
    """The number of equal numbers in the runs of two results folders, and a line for each other number."""
    first, second = numbers(record_of(before)), numbers(record_of(after))
    names = dict.fromkeys([*first, *second])
    different = [name for name in names if repr(first.get(name)) != repr(second.get(name))]
    return len(names) - len(different), [f"{name}: {first.get(name)!r}, {second.get(name)!r}" for name in different]


def main(before: Path, after: Path) -> int:
    """Compares the results folders of the same name; gives the exit status."""
    failed = 0
    for folder in sorted(path for path in before.iterdir() if (path / "runs").is_dir()):
        if not (after / folder.name / "runs").is_dir():
            print(f"| {folder.name} | no run after |")
            failed = 1
            continue
        same, different = compared(folder, after / folder.name)
        print(f"| {folder.name} | {record_of(folder)['status']} | {same} | {len(different)} |")
        print("".join(f"    {line}\n" for line in different), end="")
        failed |= bool(different)
    return failed


if __name__ == "__main__":
    sys.exit(main(*map(Path, sys.argv[1:3])))
