"""The pictures of a run, rendered finer than the run did: the given view, and one from behind."""

from dataclasses import replace
from math import atan2, degrees
from pathlib import Path
from typing import Any

from bench.judge import look
from bench.pictures import Given, Looks, draw_all
from bench.stage import Stage
from datasets.scene import see
from datasets.truth import Truth
from renderers.camera import Camera
from renderers.field import Field

BEHIND = 160.0  # degrees about the vertical axis from the given camera to the one behind
BEHIND_ELEVATION = 25.0  # degrees


def draw_run(
    folder: Path,
    stage: Stage,
    fields: tuple[Field, Field],
    given: Given,
    curve: list[dict[str, Any]],
    title: str,
) -> None:
    """Writes the pictures of a run.

    Args:
        folder: the run folder.
        stage: what the run worked with.
        fields: before and after the optimisation.
        given: what it was given.
        curve: lines of curve.jsonl.
        title: of the summary.
    """
    front, back = _cameras(stage)
    found = [
        Looks(name, look(field, front, stage), look(field, back, stage))
        for name, field in zip(("before", "after"), fields, strict=True)
    ]
    truth = Truth(stage.scene.mesh)
    looks = (found[0], found[1], Looks("truth", see(truth, front), see(truth, back)))
    draw_all(folder, looks=looks, given=given, curve=curve, title=title)


def _cameras(stage: Stage) -> tuple[Camera, Camera]:
    """The scene's camera with finer pixels, and one behind the shape."""
    camera, size = stage.scene.view.camera, stage.evaluation.picture
    x, _, z = camera.center.tolist()
    views = replace(stage.views, resolution=size)
    behind = views.camera(degrees(atan2(x, z)) + BEHIND, BEHIND_ELEVATION)
    return camera.resized(size, size), behind
