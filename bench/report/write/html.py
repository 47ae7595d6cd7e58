"""Writes `index.html`: the tables and figures of the experiments, then a row and details for every run."""

from collections import Counter
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from bench.records import format
from bench.records.read import read_records
from bench.records.record import row_name
from bench.report.write.paper import find_paper, link

# Colours of statuses; a status that is not listed is shown as bad.
TONES = {"ok": "good", "not_reached": "warn", "timeout": "warn", "unsupported": "mute", "not_run": "mute"}
FILES = ("record.json", "config.yaml", "curve.jsonl", "log.txt", "mesh.ply")
THUMBS = ("summary.png", "strip.png", "failure.png")
# Metrics with a column, and variants of `chamfer_l2`: these are listed in the details only.
COLUMNS = ("accuracy", "completeness", "fscore", "normal_consistency", "depth_mae", "mask_iou")
_NOT_OTHERS = ("chamfer_l2", "chamfer_l1", "chamfer_gt_to_pred", *COLUMNS)


def write_index(results_dir: Path) -> Path:
    """Writes `results_dir/index.html` from all run folders in `results_dir/runs` and gives its path.

    Raises:
        ValueError: if `results_dir` is not a folder.
    """
    records, problems = read_records(results_dir)
    page = results_dir / "index.html"
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parents[1]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    filters = (format.number, format.count, format.size, format.seconds)
    environment.filters |= {function.__name__: function for function in filters}
    text = environment.get_template("page.html").render(
        runs=[_run(record, results_dir / "runs" / record["folder"]) for record in records],
        papers=find_paper(results_dir),
        problems=problems,
        statuses=Counter(record["status"] for record in records),
        machines=Counter(_machine(record) for record in records if record["environment"].get("cpu")),
        tones=TONES,
    )
    # Names and reasons may contain bytes that are not text; the page must be written all the same.
    page.write_bytes(text.encode("utf-8", "backslashreplace"))
    return page


def _run(record: dict[str, Any], folder: Path) -> dict[str, Any]:
    """The values that the template shows for one run; links are relative to the page and lead to files that exist."""
    found = [path for suffix in ("png", "gif", "webp") for path in folder.glob(f"*.{suffix}")]
    pictures = sorted(found, key=lambda picture: (picture.name != "summary.png", picture.name))
    names = sorted({*record["metrics"], *record["metrics_start"]}, key=lambda name: (name in _NOT_OTHERS, name))
    machine, threads = _machine(record)
    return {
        **{name: record[name] for name in ("folder", "task", "dataset", "seed", "status", "reason")},
        **{name: record[name] for name in ("started", "environment", "reused", "notes")},
        "definitions": {name: text for name in names if (text := _definition(record["definitions"], name))},
        **{name: _number(record, name) for name in ("peak_memory_bytes", "flops", "gemm_fraction")},
        "name": row_name(record["config"], record["renderer"]),
        "scene": record.get("scene") or record["dataset"],  # a run that failed early has no scene
        "metrics": {name: _value(record["metrics"], name) for name in names},
        "start": {name: _number(record["metrics_start"], name) for name in names},
        "others": [name for name in names if name not in _NOT_OTHERS],
        "seconds": {name: _number(record["seconds"], name) for name in ("total", *record["seconds"])},
        "evaluations": {name: _number(record["evaluations"], name) for name in ("value", "gradient", "per_ray")},
        "machine": machine,
        "threads": threads,
        "files": {name: link("runs", folder.name, name) for name in FILES if (folder / name).is_file()},
        "thumb": next((link("runs", folder.name, path.name) for path in pictures if path.name in THUMBS), None),
        "pictures": {picture.name: link("runs", folder.name, picture.name) for picture in pictures},
    }


def _machine(record: dict[str, Any]) -> tuple[str, str]:
    """The machine that the run's times depend on: processor with accelerator, and threads."""
    environment = record["environment"]
    parts = [str(environment.get(name) or "") for name in ("cpu", "device")]
    label = " + ".join(part for part in parts if part and part != "cpu")
    return label or format.MISSING, str(environment.get("threads") or format.MISSING)


def _definition(definitions: dict[str, str], name: str) -> str:
    """The definition of a metric. A key is a list of names; `saved_...` matches a prefix, `NAME.error` a suffix."""
    keys = [([part.strip() for part in key.split(",")], text) for key, text in definitions.items()]
    last = name.rsplit(".", 1)[-1] if "." in name else None
    for fits in (
        lambda part: part == name,
        lambda part: part.endswith("...") and name.startswith(part[:-3]),
        lambda part: "." in part and part.rsplit(".", 1)[-1] == last,
    ):
        for parts, text in keys:
            if any(fits(part) for part in parts):
                return text
    return ""


def _value(values: dict[str, Any], name: str) -> int | float | str | None:
    """The number or text of that name."""
    value = values.get(name)
    return value if isinstance(value, str) else _number(values, name)


def _number(values: dict[str, Any], name: str) -> int | float | None:
    """The number of that name; None, shown as missing, where there is none."""
    value = values.get(name)
    return value if isinstance(value, int | float) else None
