"""Names of runs by what differs among them: the renderer's row, the choices, and settings by key and value."""

import json
from collections.abc import Callable, Hashable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from bench.records.record import NEUTRAL_KEYS, renderer_name, row_name

CHOICES = ("task", "method", "renderer", "dataset")  # fields of a record, whose values are names by themselves
WORDS = {"index": "shape", "dataset.path": "", "_target_": ""}  # what stands before the value in place of the key
DEEPEST = 20  # levels of a configuration
SKIPPED = NEUTRAL_KEYS | {"label", "packages"}


@dataclass(frozen=True)
class Differences:
    """What tells runs apart.

    Args:
        keys: the keys in which the runs differ, without those that follow from keys before them.
        names: of each run, its values of these keys; of runs that differ in nothing, the name of their row.
    """

    keys: tuple[str, ...]
    names: tuple[str, ...]


def differences(
    records: Sequence[dict[str, Any]],
    *,
    apart: Callable[[dict[str, Any]], Hashable] | None = None,
    asked: Sequence[dict[str, str]] = (),
) -> Differences:
    """What tells runs apart, from their records, those of failed and of planned runs included.

    A key that divides the runs no further than those before it is left out: of `scale=smoke,desk` all sizes follow. A
    name has a key only where runs that would else have the same name differ in it.

    Args:
        records: of the runs.
        apart: what tells runs apart without being in their names, such as shape and seed; None for nothing.
        asked: of each run, the keys and values that its sweep asked for, which come before other settings.
    """
    classes: list[int] = _classes([apart(record) if apart else None for record in records])
    keys, names = [], [""] * len(records)
    for key, values in _parts(records, asked):
        refined = _classes(list(zip(classes, values, strict=True)))
        if len(set(refined)) == len(set(classes)):
            continue
        classes = refined
        keys.append(key)
        names = _extended(names, _heading(key, keys), values)
        if len(set(classes)) == len(records):
            break
    default = [row_name(record["config"], record["renderer"]) for record in records]
    return Differences(tuple(keys), tuple(name or other for name, other in zip(names, default, strict=True)))


def flat(node: dict[str, Any], prefix: str = "", depth: int = DEEPEST) -> dict[str, Any]:
    """The values of nested settings by dotted keys; what lies deeper than `depth` levels is left out, as "…"."""
    values: dict[str, Any] = {}
    for key, value in node.items():
        name, inner = f"{prefix}{key}", isinstance(value, dict)
        values |= flat(value, f"{name}.", depth - 1) if inner and depth else {name: "…" if inner else value}
    return values


def _parts(
    records: Sequence[dict[str, Any]], asked: Sequence[dict[str, str]]
) -> Iterator[tuple[str, list[str | None]]]:
    """Keys with the value of each run as text, None where it has none, in the order in which they make names."""
    yield "row", [renderer_name(record["config"], record["renderer"]) for record in records]
    yield "silhouette", [(record["config"].get("silhouette") or {}).get("_label_") for record in records]
    for key in CHOICES:
        yield key, [record.get(key) or None for record in records]
    own = [_settings(record["config"]) for record in records]
    for key in ("dataset.path", "index", "seed"):
        yield key, [values.get(key) for values in own]
    for settings in (asked, own):
        for key in sorted({key: None for values in settings for key in values}, key=_order):
            yield key, [values.get(key) for values in settings]


def _settings(config: dict[str, Any]) -> dict[str, str]:
    """The settings that may change a result, as text by dotted keys."""
    kept = {key: value for key, value in config.items() if key not in SKIPPED}
    return {key: _text(value) for key, value in flat(kept).items()}


def _order(key: str) -> tuple[bool, int]:
    """Names of choices before what follows from them, such as scale.name before view.resolution; then outer keys."""
    return not key.endswith(".name"), key.count(".")


def _text(value: Any) -> str:
    """A setting as one would type it."""
    if isinstance(value, str):
        return value
    if isinstance(value, int) and not isinstance(value, bool):
        return str(value)
    return f"{value:g}" if isinstance(value, float) and float(f"{value:g}") == value else json.dumps(value)


def _classes(values: list[Any]) -> list[int]:
    """A number for each value, the same for equal ones."""
    numbers: dict[Any, int] = {}
    return [numbers.setdefault(value, len(numbers)) for value in values]


def _heading(key: str, keys: Sequence[str]) -> str:
    """What stands before a value in a name: nothing for a choice, else the end of the key, where that is clear."""
    last = key.rpartition(".")[2]
    if key in (*CHOICES, "row", "silhouette", "stress"):
        return ""
    if key in WORDS or last in WORDS:
        return WORDS.get(key, WORDS.get(last, ""))
    if last == "name":
        return key.removesuffix(".name")
    return key if any(other.rpartition(".")[2] == last for other in keys if other != key) else last


def _extended(names: list[str], heading: str, values: list[str | None]) -> list[str]:
    """The names with the values behind them, where runs of one name differ in these."""
    found: dict[str, set[str | None]] = {}
    for name, value in zip(names, values, strict=True):
        found.setdefault(name, set()).add(value)
    return [
        ", ".join(filter(None, (name, f"{heading} {value}".strip()))) if value and len(found[name]) > 1 else name
        for name, value in zip(names, values, strict=True)
    ]
