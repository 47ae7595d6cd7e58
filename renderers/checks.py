"""Checks of arguments; each message names the argument, the rule, the value found and the remedy."""

from math import isfinite


class BadInput(ValueError):
    """What a user gave cannot be used, as is found only while it is used; the message names the remedy."""


class BrokenContract(ValueError):
    """A renderer returned what it must not; the message says what, and what to return instead."""


def check_positive(name: str, value: float, remedy: str) -> None:
    """Raises ValueError unless `value` is finite and above zero."""
    if not isfinite(value) or value <= 0:
        raise ValueError(f"{name} must be positive, not {value}: {remedy}")


def check_at_least(name: str, value: float, least: float, remedy: str) -> None:
    """Raises ValueError unless `value` is finite and at least `least`."""
    if not isfinite(value) or value < least:
        raise ValueError(f"{name} must be at least {least}, not {value}: {remedy}")


def check_share(name: str, value: float, remedy: str) -> None:
    """Raises ValueError unless `value` is above 0 and at most 1."""
    if not 0 < value <= 1:
        raise ValueError(f"{name} must be above 0 and at most 1, not {value}: {remedy}")


def check_choice(name: str, value: str, choices: tuple[str, ...]) -> None:
    """Raises ValueError unless `value` is one of `choices`."""
    if value not in choices:
        raise ValueError(f"{name} must be one of {', '.join(choices)}, not {value!r}")
