"""The axes of stress tests: a scene, the tested property, and the range of severities."""

from dataclasses import dataclass, fields, is_dataclass, replace
from math import exp, isfinite, log
from typing import Any
from zlib import crc32

import numpy as np
import torch

from bench.machine.limits import LimitReached
from bench.records.record import RunStatus
from bench.tasks.stability.distortions import NETWORK_DISTORTIONS
from bench.tasks.stability.fit import FITS, judge_fit
from bench.tasks.stability.judge import judge_gradient, judge_rendering
from bench.tasks.stability.scenes import SCENES, Scene, network_scene
from bench.tasks.stability.trial import Conditions, Failure, Outcome
from renderers.checks import check_choice
from renderers.rendering import Renderer, Unsupported

GROUPS = ("geometry", "viewing", "field", "network", "fit", "observation", "optimisation")
MEASURES = ("rendering", "gradient", "fit")


@dataclass(frozen=True)
class Sweep:
    """The range of severities of a stress.

    Args:
        mild, severe: the ends of the range; mild may be the larger number.
        log: whether levels between them are spaced evenly in the logarithm.
        unit: of a severity, in words.
    """

    mild: float
    severe: float
    log: bool
    unit: str

    def __post_init__(self) -> None:
        if not (isfinite(self.mild) and isfinite(self.severe) and self.mild != self.severe):
            ends = f"{self.mild} and {self.severe}"
            raise ValueError(f"task.stress.sweep must have two finite ends that differ, not {ends}")
        if self.log and min(self.mild, self.severe) <= 0:
            raise ValueError("task.stress.sweep.log needs positive ends: set log=false")

    def severity(self, level: float) -> float:
        """The severity at a level: 0 is the mild end, 1 the severe one, and the scale extends beyond both."""
        if self.log:
            return exp(log(self.mild) + level * (log(self.severe) - log(self.mild)))
        return self.mild + level * (self.severe - self.mild)


@dataclass(frozen=True)
class Stress:
    """One axis of the stress atlas.

    Args:
        scene: a name of `SCENES` or of `NETWORK_DISTORTIONS`; for measure=fit, one of `FITS`.
        measure: what is tested: "rendering", its "gradient", or the result of a "fit".
        group: of axes in the atlas.
        sweep: the range of severities.
        setting: the renderer's setting that takes the severity, if it is one.
        repeats: 1 if repeats of a trial cannot differ, then there is no interval; else null, for task.search.repeats.
    """

    scene: str
    measure: str
    group: str
    sweep: Sweep
    setting: str | None = None
    repeats: int | None = None

    def __post_init__(self) -> None:
        check_choice("task.stress.group", self.group, GROUPS)
        check_choice("task.stress.measure", self.measure, MEASURES)
        check_choice(
            "task.stress.scene", self.scene, FITS if self.measure == "fit" else (*SCENES, *NETWORK_DISTORTIONS)
        )
        if self.repeats not in (None, 1):
            raise ValueError(f"task.stress.repeats must be 1 or null, not {self.repeats}: set task.search.repeats")

    def stressed(self, renderer: Renderer, severity: float) -> Renderer:
        """The renderer with its setting at the severity; unchanged if the severity is not a renderer's setting.

        Raises:
            Unsupported: if the renderer has no such setting, or has switched it off by null.
        """
        if self.setting is None:
            return renderer
        settings = {field.name for field in fields(renderer)} if is_dataclass(renderer) else set()
        unstressed: Any = getattr(renderer, self.setting) if self.setting in settings else None
        if unstressed is None:
            raise Unsupported(
                f"{type(renderer).__name__} has no {self.setting}, or it is null: choose another renderer"
            )
        value = max(round(severity), 1) if isinstance(unstressed, int) else severity
        return replace(renderer, **{self.setting: value})  # type: ignore[type-var]

    def exam_generator(self, conditions: Conditions) -> Scene:
        """The function that generates the exams of a rendering or its gradient."""
        if (prior := conditions.prior) is None or self.scene not in NETWORK_DISTORTIONS:
            return SCENES[self.scene]
        return network_scene(self.scene, prior.decoder.to(conditions.device), prior.codes.to(conditions.device))

    @property
    def needs_prior(self) -> bool:
        """Whether the scenes are those of a prior's network, or fits of its codes."""
        return self.measure == "fit" or self.scene in NETWORK_DISTORTIONS

    def trial_seed(self, level: float, repeat: int) -> int:
        return crc32(f"{self.scene} {level:.6f} {repeat}".encode())

    def trial(self, renderer: Renderer, level: float, repeat: int, conditions: Conditions) -> Outcome:
        """Trial number `repeat` at a level, the same one for every renderer. An exception is recorded as a failure.

        Raises:
            Unsupported: if the renderer lacks the tested property, or has no such setting.
        """
        seed = self.trial_seed(level, repeat)
        torch.manual_seed(seed)  # for renderers and losses with random draws
        try:
            return self._judge(renderer, self.sweep.severity(level), np.random.default_rng(seed), conditions)
        except Unsupported:
            raise
        except LimitReached as limit:
            return Outcome(Failure.TIMEOUT if limit.status is RunStatus.TIMEOUT else Failure.OOM, message=str(limit))
        except (MemoryError, torch.OutOfMemoryError) as error:
            return Outcome(Failure.OOM, message=" ".join(str(error).split()))
        except Exception as error:  # noqa: BLE001 - a trial that fails is data, and the search goes on
            return Outcome(Failure.CRASHED, message=" ".join(f"{type(error).__name__}: {error}".split()))

    def _judge(self, renderer: Renderer, severity: float, draw: np.random.Generator, conditions: Conditions) -> Outcome:
        stressed = self.stressed(renderer, severity)
        if self.measure == "fit":
            return judge_fit(self.scene, severity, draw, renderer=stressed, conditions=conditions)
        exam = self.exam_generator(conditions)(severity, draw, conditions.resolution)
        return (judge_rendering if self.measure == "rendering" else judge_gradient)(exam, stressed, conditions)
