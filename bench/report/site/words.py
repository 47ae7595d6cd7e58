"""Texts on a run: its request, the meaning of its status, the command that repeats it."""

import shlex
from pathlib import Path
from typing import NamedTuple

from bench.records.record import NOT_RUN, RunStatus
from bench.records.results import RESULTS
from bench.report.data.records import Record, iterations_of, setting

TASKS = {
    "completion": "Complete a shape from sparse depth and its mask",
    "outline": "Find a shape by its mask in one view",
    "external": "Reconstruct by a code of others, and judge its mesh",
    "multiview": "Find a shape by photographs from known cameras, without a mask",
    "reconstruction": "Find shape and colour from photographs with cameras, without a prior",
    "hull": "Carve the visual hull of the masks, without a renderer",
    "poisson": "Fuse given depths into a surface, without a renderer",
    "stereo": "Match photographs and fuse the points into a surface, without a renderer",
    "pose": "Find the camera of a known shape by its depth and silhouette",
    "pose_icp": "Find the camera of a known shape by closest points, without a renderer",
    "deepsdf": "Complete a shape from signed distances near the depth image, without a renderer",
    "prior_fit": "Fit a prior's code to the true distances: the best that a method can hope for",
    "distance_fit": "Fit the field of a reconstruction to the true distances: the best that a method can hope for",
    "single_view": "Say shape and colour from one image, by a trained network",
    "ablation": "Measure what one rendering costs and how far it is from a float64 reference",
    "gradients": "Compare a renderer's gradients with float64 differences",
    "area_gradient": "Compare the gradient of a silhouette's area with float64 differences",
    "stability": "Search for the severity at which a renderer breaks",
    "capacity": "Measure how much model a shape needs",
}
OMITTED_KEYS = ("results_dir", "rerun")  # the command names no folder but the default one


class Help(NamedTuple):
    """The meaning of a status, and a remedy; it is empty if nothing is wrong."""

    meaning: str
    remedy: str = ""


STATUSES = {
    RunStatus.OK: Help("It ended as planned."),
    RunStatus.NAN: Help(
        "The loss became NaN.",
        "Lower task.optimiser.learning_rate. The curve shows the last iteration with a finite loss.",
    ),
    RunStatus.DIVERGED: Help(
        "The loss rose a hundredfold.",
        "Lower task.optimiser.learning_rate, or the weight of the loss that rises first.",
    ),
    RunStatus.NOT_REACHED: Help(
        "The loss did not fall.",
        "Try more iterations (task.optimiser.iterations), another seed, or a renderer that has the gradient which the "
        "task needs: `task=gradients` compares them.",
    ),
    RunStatus.EMPTY: Help(
        "The field ended without a surface.",
        "Lower task.optimiser.learning_rate, or raise the weight of the loss of the mask. strip.png shows when the "
        "surface was lost.",
    ),
    RunStatus.TIMEOUT: Help(
        "A limit of time, or of field values, was reached.",
        "Raise time_limit=SECONDS (null is none), or make the work smaller: scale=smoke, view.resolution=32.",
    ),
    RunStatus.OOM: Help(
        "A limit of memory was reached.",
        "Raise memory_limit=GIB where the machine has more, or make the work smaller: view.resolution, "
        "evaluation.grid.",
    ),
    RunStatus.CRASHED: Help(
        "An error ended it.",
        "verbose=true shows where the error came from, and isolation=off lets a debugger stop there. log.txt has "
        "all of it.",
    ),
    RunStatus.KILLED: Help("It was stopped from outside, or is still under way.", "The same command runs it again."),
    RunStatus.UNSUPPORTED: Help(
        "The renderer lacks what the task needs.",
        "This is an answer, not an error. The reason says what is lacking; another renderer or setting may have it.",
    ),
    RunStatus.REFUSED: Help("The configuration is invalid.", "The reason names the key and what to type instead."),
    NOT_RUN: Help(
        "A sweep planned it, and it has not been run.",
        "The command of the sweep runs what is missing, and reuses what is there.",
    ),
}


def request_sentence(record: Record) -> str:
    config = record["config"]
    task_sentence = TASKS.get(record["task"], f"task={record['task']}")
    resolution, points = setting(config, "view", "resolution"), setting(config, "task", "points")
    iterations, scale = iterations_of(record), setting(config, "scale", "name")
    details = [
        f"{record.get('scene') or record['dataset']}",
        f"{points} depth points" if points is not None else "",
        f"{resolution} × {resolution} pixels" if isinstance(resolution, int) else "",
        f"{iterations} iterations" if isinstance(iterations, int) else "",
        f"seed {record['seed']}" if record["seed"] is not None else "",
        f"scale={scale}" if scale else "",
    ]
    return f"{task_sentence}: {', '.join(filter(None, details))}."


def command(record: Record, results_dir: Path) -> str:
    folder = [] if results_dir.as_posix() == RESULTS else [f"results_dir={results_dir.as_posix()}"]
    overrides = map(str, record.get("overrides") or [])
    kept = [text for text in overrides if text.partition("=")[0] not in OMITTED_KEYS]
    return shlex.join(["python", "-m", "bench", *kept, *folder])
