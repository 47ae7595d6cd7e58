"""Checks of arguments; each message names the argument, the rule, the wrong value and the remedy."""

from math import isfinite


class BadInput(ValueError):
    """A user's input cannot be used, which is known only while it is read; the message names the remedy."""


class BrokenContract(ValueError):
    """A renderer returned something invalid; the message names it, and what to return instead."""


def check_positive(name: str, value: float, remedy: str) -> None:
    """Raises ValueError unless `value` is finite and above zero."""
    if not isfinite(value) or value <= 0:
        raise ValueError(f"{name} must be positive, not {value}: {remedy}")


def check_at_least(name: str, value: float, minimum: float, remedy: str) -> None:
    """Raises ValueError unless `value` is finite and at least `minimum`."""
    if not isfinite(value) or value < minimum:
        raise ValueError(f"{name} must be at least {minimum}, not {value}: {remedy}")


def check_fraction(name: str, value: float, remedy: str) -> None:
    """Raises ValueError unless `value` is above 0 and at most 1."""
    if not 0 < value <= 1:
        raise ValueError(f"{name} must be above 0 and at most 1, not {value}: {remedy}")


def check_choice(name: str, value: str, choices: tuple[str, ...]) -> None:
    """Raises ValueError unless `value` is one of `choices`."""
    if value not in choices:
        raise ValueError(f"{name} must be one of {', '.join(choices)}, not {value!r}")
