"""Scenes that make renderers fail, with closed-form truth and one number for their severity."""

from datasets.stress.scenes import SCENES, Exam
from datasets.stress.solids import FirstHit, Solid

__all__ = ["SCENES", "Exam", "FirstHit", "Solid"]
