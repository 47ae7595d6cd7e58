"""Names of runs by what differs among them: the renderer's row, the choices, and settings by key and value."""

import json
from collections.abc import Callable, Container, Hashable, Iterable, Iterator, Sequence
from functools import cache
from typing import Any

from bench.records.record import NEUTRAL_KEYS, renderer_name, row_name

CHOICES = ("task", "method", "renderer", "dataset")  # fields of a record, whose values are names by themselves
WORDS = {"index": "shape", "dataset.path": "", "_target_": ""}  # what stands before the value in place of the key
DEEPEST = 20  # levels of a configuration
SKIPPED = NEUTRAL_KEYS | {"label", "packages"}


class Node(dict):
    """Settings that several records share. Nothing may change them, so that they are looked up by what they are."""

    __hash__ = object.__hash__  # type: ignore[assignment]


def differences(
    records: Sequence[dict[str, Any]],
    *,
    apart: Callable[[dict[str, Any]], Hashable] | None = None,
    asked: Sequence[dict[str, str]] = (),
) -> list[str]:
    """The name of each run: its values of the keys in which runs differ; where there are none, the name of its row.

    A key that divides the runs no further than those before it is left out: of `scale=smoke,desk` all sizes follow. A
    name has a key only where runs that would else have the same name differ in it.

    Args:
        apart: what tells runs apart without being in their names, such as shape and seed; None for nothing.
        asked: of each run, the keys and values that its sweep asked for, which come before other settings.
    """
    classes = _classes([apart(record) if apart else None for record in records])
    names = told_apart(_parts(records, asked), classes=classes, names=[""] * len(records))
    rows = [row_name(record["config"], record["renderer"]) for record in records]
    return [name or row for name, row in zip(names, rows, strict=True)]


def told_apart(
    parts: Iterable[tuple[str, Sequence[str | None]]], *, classes: list[int], names: list[str], most: int | None = None
) -> list[str]:
    """Names with what tells runs apart behind them.

    Args:
        parts: keys with the value of each run as text, None where it has none, in the order in which they make names.
        classes: a number for each run; those of unequal numbers are told apart already, without it being in the name.
        names: of the runs, before anything is added.
        most: keys that are added; None for all that are needed.
    """
    keys: list[str] = []
    for key, values in parts:
        if len(keys) == most or len(set(classes)) == len(classes):
            break
        refined = _classes(list(zip(classes, values, strict=True)))
        if len(set(refined)) == len(set(classes)):
            continue
        classes = refined
        keys.append(key)
        names = _extended(names, _heading(key, keys), values)
    return names


def in_order(settings: Sequence[dict[str, str]], first: Sequence[str] = ()) -> Iterator[tuple[str, list[str | None]]]:
    """The keys of settings with the value of each run, in the order in which they make names.

    Names of choices come before what follows from them, such as scale.name before view.resolution; then settings of the
    top-level keys `first`, in their order; then outer keys.
    """

    def place(key: str) -> tuple[bool, int, int]:
        top = key.partition(".")[0]
        return not key.endswith(".name"), first.index(top) if top in first else len(first), key.count(".")

    for key in sorted({key: None for values in settings for key in values}, key=place):
        yield key, [values.get(key) for values in settings]


def settings_of(config: dict[str, Any], without: Container[str] = SKIPPED) -> dict[str, str]:
    """The settings that may be in a name, as text by dotted keys, but those of the top-level keys `without`."""
    kept = flat({key: value for key, value in config.items() if key not in without})
    return {key: _text(value) for key, value in kept.items() if _public(key)}


def flat(node: dict[str, Any], prefix: str = "", depth: int = DEEPEST) -> dict[str, Any]:
    """The values of nested settings by dotted keys; what lies deeper than `depth` levels is left out, as "…"."""
    values: dict[str, Any] = {}
    for key, value in node.items():
        if isinstance(value, dict) and depth:
            values |= flat(value, f"{prefix}{key}.", depth - 1)
        else:
            values[f"{prefix}{key}"] = "…" if isinstance(value, dict) else value
    return values


def _parts(
    records: Sequence[dict[str, Any]], asked: Sequence[dict[str, str]]
) -> Iterator[tuple[str, list[str | None]]]:
    yield "row", [renderer_name(record["config"], record["renderer"]) for record in records]
    yield "silhouette", [(record["config"].get("silhouette") or {}).get("_label_") for record in records]
    for key in CHOICES:
        yield key, [record.get(key) or None for record in records]
    own = [settings_of(record["config"]) for record in records]
    for key in ("dataset.path", "index", "seed"):
        yield key, [values.get(key) for values in own]
    for settings in (asked, own):
        yield from in_order(settings)


@cache
def _public(key: str) -> bool:
    """Whether a key is no mark of ours, such as `_label_`, which stands in the name of the row."""
    last = key.rpartition(".")[2]
    return last == "_target_" or not last.startswith("_")


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


def _extended(names: list[str], heading: str, values: Sequence[str | None]) -> list[str]:
    """The names with the values behind them, where runs of one name differ in these."""
    found: dict[str, set[str | None]] = {}
    for name, value in zip(names, values, strict=True):
        found.setdefault(name, set()).add(value)
    return [
        ", ".join(filter(None, (name, f"{heading} {value}".strip()))) if value and len(found[name]) > 1 else name
        for name, value in zip(names, values, strict=True)
    ]
