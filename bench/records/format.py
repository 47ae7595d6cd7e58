"""Formats numbers for readers: three significant digits, `∞` for infinite, `–` for missing."""

import math
from collections.abc import Mapping
from typing import Any

MISSING = "–"
INFINITE = "∞"


def number(x: int | float | str | None, scale: float = 1.0) -> str:
    """`x * scale` to three significant digits, such as 0.0123, 12.3, 1230 or 1.23e-7.

    An int below a million has all its digits. Zero is "0", None is missing, and not a number is "nan". A string is
    returned unchanged.
    """
    if isinstance(x, str):
        return x
    if isinstance(x, int) and not isinstance(x, bool) and scale == 1 and abs(x) < 10**6:
        return str(x)
    if x is None:
        return MISSING
    value = float(x) * scale
    if not math.isfinite(value):
        return "nan" if math.isnan(value) else f"{'-' if value < 0 else ''}{INFINITE}"
    if value == 0:
        return "0"
    mantissa, exponent = f"{value:.2e}".split("e")
    power = int(exponent)
    if -4 <= power < 6:
        return f"{float(f'{mantissa}e{exponent}'):.{max(0, 2 - power)}f}"
    return f"{mantissa}e{power}"


def values_in_words(values: dict[str, str]) -> str:
    """Numbers with their names, such as "12.5 before, 0.304 after"."""
    return ", ".join(f"{value} {name}" for name, value in values.items())


def breakdown(metrics: Mapping[str, Any], sweep: Mapping[str, Any]) -> str:
    """Where a renderer breaks under a stress, in words: a severity with its unit, or that it does not break.

    Args:
        metrics: of a finished run of task=stability.
        sweep: its severities: `mild` and `severe`, the ends, and their `unit`.
    """
    if metrics["severe_successes"] * metrics["mild_trials"] > metrics["mild_successes"] * metrics["severe_trials"]:
        return "has no breakdown: it succeeds more often at the severest severity than at the mildest"
    words = {"mild": "breaks at the mildest severity, ", "severe": "does not break up to the severest severity, "}
    level = metrics["level"] if metrics["level"] is not None else 0.5  # unknown: the severity alone
    end = "mild" if level < 0 else "severe" if level > 1 else ""
    severity = sweep[end] if end else metrics["breakdown"]
    return f"{words.get(end, 'breaks at ')}{number(severity)} {sweep['unit']}"


def plural(count: int, word: str) -> str:
    """A count with its word, such as 1 scene or 2 scenes."""
    return f"{count} {word}{'s' if count != 1 else ''}"


def count(n: int | float | None) -> str:
    """A count, with k, M, G, T, P for powers of 1000, such as 999, 12.3k or 1.43M."""
    if n is None or not math.isfinite(n):
        return number(n)
    if abs(n) < 999.5:
        return f"{n:.0f}"
    power = min(int(f"{abs(n):.2e}".split("e")[1]) // 3, 5)
    return f"{number(n, 1000.0**-power)}{' kMGTP'[power]}"


def seconds(x: int | float | None) -> str:
    """A duration with its unit: 12.3 ms, 12.3 s, 34.5 min, 2.31 h; minutes from 120 s, hours from 120 min."""
    if x is None or not math.isfinite(x):
        return number(x)
    if abs(x) < 1 and x != 0:
        return f"{number(x, 1000.0)} ms"
    if abs(x) < 120:
        return f"{number(x)} s"
    return f"{number(x, 1 / 60)} min" if abs(x) < 7200 else f"{number(x, 1 / 3600)} h"
