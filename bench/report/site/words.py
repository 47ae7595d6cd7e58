"""What a run was asked, in words; the command that makes it again; the lines that open it in Python."""

import shlex
from pathlib import Path
from typing import Any

from bench.report.data.records import Record, iterations_of, setting

TASKS = {
    "completion": "Complete a shape from sparse depth and its mask",
    "multiview": "Find a shape by photographs from known cameras, without a mask",
    "reconstruction": "Find shape and colour from photographs with cameras, without a prior",
    "hull": "Carve the visual hull of the masks, without a renderer",
    "poisson": "Fuse given depths into a surface, without a renderer",
    "stereo": "Match photographs and fuse the points into a surface, without a renderer",
    "pose": "Find the camera of a known shape by its depth and silhouette",
    "pose_icp": "Find the camera of a known shape by closest points, without a renderer",
    "deepsdf": "Complete a shape from signed distances near the depth image, without a renderer",
    "prior_fit": "Fit a prior's code to the true distances: the best that a method can hope for",
    "single_view": "Say shape and colour from one image, by a trained network",
    "ablation": "Measure what one rendering costs and how far it is from a float64 reference",
    "benchmark": "Time renderers in turn in one process",
    "gradients": "Compare a renderer's gradients with float64 differences",
    "stability": "Search for the severity at which a renderer breaks",
    "capacity": "Measure how much model a shape needs",
}
LEFT_OUT = ("results_dir", "rerun")  # of a command, which stands for any folder


def asked(record: Record) -> str:
    """What the run was asked to do, as a sentence."""
    config = record["config"]
    said = TASKS.get(record["task"], f"task={record['task']}")
    resolution, points = setting(config, "view", "resolution"), setting(config, "task", "points")
    iterations, scale = _known(iterations_of, record), setting(config, "scale", "name")
    parts = [
        f"{record.get('scene') or record['dataset']}",
        f"{points} depth points" if points is not None else "",
        f"{resolution} × {resolution} pixels" if isinstance(resolution, int) else "",
        f"{iterations} iterations" if iterations is not None else "",
        f"seed {record['seed']}" if record["seed"] is not None else "",
        f"scale={scale}" if scale else "",
    ]
    return f"{said}: {', '.join(filter(None, parts))}."


def command(record: Record, results_dir: Path) -> tuple[str, str]:
    """The command that makes the run again, for a shell, and a remark on how sure it is."""
    overrides = [str(override) for override in record.get("overrides") or []]
    if overrides:
        kept = [override for override in overrides if override.partition("=")[0] not in LEFT_OUT]
        return _command(
            kept, results_dir
        ), "As it was typed. Configurations are code: read one that is not yours first."
    config = record["config"]
    seen = "stress" if config.get("stress") else "dataset"  # a stress takes the dataset's place in a record
    known = {"task": record["task"], "renderer": record["renderer"], seen: record["dataset"]}
    known |= {"scale": setting(config, "scale", "name")}
    known |= {key: config.get(key) for key in ("experiment", "method")}
    known |= {"method": record.get("method")}
    known |= {key: config.get(key) for key in ("split", "index")} | {"seed": record["seed"]}
    added = ("experiment", "method")
    words = [f"{'+' * (key in added)}{key}={value}" for key, value in known.items() if value not in (None, "")]
    remark = (
        "This record is of a version that did not keep its command: these are its choices, and config.yaml has all "
    )
    return _command(words, results_dir), remark + "settings."


def python(record: Record, folder: Path, files: dict[str, str]) -> str:
    """The lines that open the run in Python."""
    lines = [
        "from pathlib import Path",
        "from bench.records.record import read_record",
        "",
        f"folder = Path({str(folder)!r})",
        "record = read_record(folder)",
        'print(record["status"], record["metrics"])',
    ]
    if "curve.jsonl" in files:
        lines += ["", "import pandas as pd", "", 'curve = pd.read_json(folder / "curve.jsonl", lines=True)']
    if "mesh.ply" in files:
        lines += ["", "import trimesh", "", 'mesh = trimesh.load(folder / "mesh.ply")']
    return "\n".join(lines)


def _command(words: list[str], results_dir: Path) -> str:
    folder = [] if results_dir.as_posix() == "results" else [f"results_dir={results_dir.as_posix()}"]
    return shlex.join(["python", "-m", "bench", *words, *folder])


def _known(of: Any, record: Record) -> Any:
    value = of(record)
    return value if isinstance(value, int) else None
