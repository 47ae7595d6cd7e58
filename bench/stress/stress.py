"""What is made worse and worse until a renderer fails: a scene, what is judged there, and from where to where."""

from dataclasses import dataclass, fields, is_dataclass, replace
from math import exp, isfinite, log
from typing import Any
from zlib import crc32

import numpy as np
import torch

from bench.limits import LimitReached
from bench.records import RunStatus
from bench.stress.conditions import Conditions
from bench.stress.fit import FITS, FitTrial, judge_fit
from bench.stress.gradient import judge_gradient
from bench.stress.outcome import Failure, Outcome
from bench.stress.rendering import judge_rendering
from bench.stress.theory import THEORIES, Prediction
from bench.tasks.problem import Unsupported
from datasets.stress import SCENES
from renderers.checks import check_choice
from renderers.rendering import Renderer

GROUPS = ("geometry", "viewing", "field", "observation", "optimisation")
MEASURES = ("rendering", "gradient", "fit")


@dataclass(frozen=True)
class Sweep:
    """The severities of a stress.

    Args:
        mild, severe: its ends; mild may be the larger.
        log: whether levels between them are evenly spaced in the logarithm.
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
        """The severity at a level, 0 the mild end and 1 the severe one; beyond them the sweep goes on."""
        if self.log:
            return exp(log(self.mild) + level * (log(self.severe) - log(self.mild)))
        return self.mild + level * (self.severe - self.mild)


@dataclass(frozen=True)
class Stress:
    """One axis of the atlas.

    Args:
        scene: a name of `datasets.stress.SCENES`; for measure=fit, one of `bench.stress.fit.FITS`.
        measure: what is judged: "rendering", its "gradient", or the end of a "fit".
        group: under which the atlas shows it.
        sweep: the severities.
        setting: the renderer's own setting that the severity is, if it is one.
        among: another setting that tells the renderers meant, where several have one of that name.
        theory: a name of `bench.stress.theory.THEORIES`, if there is one.
    """

    scene: str
    measure: str
    group: str
    sweep: Sweep
    setting: str | None = None
    among: str | None = None
    theory: str | None = None

    def __post_init__(self) -> None:
        check_choice("task.stress.group", self.group, GROUPS)
        check_choice("task.stress.measure", self.measure, MEASURES)
        check_choice("task.stress.scene", self.scene, FITS if self.measure == "fit" else tuple(SCENES))
        if self.theory is not None:
            check_choice("task.stress.theory", self.theory, tuple(THEORIES))

    def stressed(self, renderer: Renderer, severity: float) -> Renderer:
        """The renderer, with the setting that the severity is.

        Raises:
            Unsupported: where it has no such setting.
        """
        if self.setting is None:
            return renderer
        own = {f.name for f in fields(renderer)} if is_dataclass(renderer) else set()
        wanted = sorted({self.setting, self.among or self.setting})
        if not set(wanted) <= own:
            names = " and ".join(wanted)
            raise Unsupported(f"{type(renderer).__name__} is not a renderer with {names}: choose another")
        present: Any = getattr(renderer, self.setting)
        value = max(round(severity), 1) if isinstance(present, int) else severity
        return replace(renderer, **{self.setting: value})  # type: ignore[type-var]

    def trial(self, renderer: Renderer, level: float, repeat: int, conditions: Conditions) -> Outcome:
        """The trial of that number at a level; every renderer has the same one. Whatever it raises is its failure.

        Raises:
            Unsupported: where the renderer cannot do what is judged, or has no such setting.
        """
        seed = crc32(f"{self.scene} {level:.6f} {repeat}".encode())
        torch.manual_seed(seed)  # of renderers and losses that draw
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
            return judge_fit(FitTrial(self.scene, conditions.fit, severity, draw), stressed, conditions)
        exam = SCENES[self.scene](severity, draw, conditions.resolution)
        return (judge_rendering if self.measure == "rendering" else judge_gradient)(exam, stressed, conditions)

    def predicted(self, renderer: Renderer, conditions: Conditions) -> list[Prediction]:
        """Where theory has the renderer fail; empty where there is none."""
        if self.theory is None:
            return []
        return THEORIES[self.theory](renderer, conditions.resolution, conditions.criteria)
