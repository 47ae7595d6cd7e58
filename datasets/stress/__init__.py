"""Scenes that make renderers fail: closed-form truth, and one number that says how severe each is."""

from datasets.stress.scenes import SCENES, Exam
from datasets.stress.solids import FirstHit, Solid

__all__ = ["SCENES", "Exam", "FirstHit", "Solid"]
