"""Names of runs from their differences: the renderer's row, the choices, and settings by key and value."""

import json
from collections.abc import Callable, Container, Hashable, Iterable, Iterator, Sequence
from functools import cache
from typing import Any

from bench.records.record import NEUTRAL_KEYS, flat, renderer_name, row_name

CHOICE_FIELDS = ("task", "method", "renderer", "dataset")  # fields of a record whose values need no key
KEY_LABELS = {"index": "shape", "dataset.path": "", "_target_": ""}  # text before the value, instead of the key
EXCLUDED_KEYS = NEUTRAL_KEYS | {"label", "packages", "threads"}  # a swept key is named all the same


class SharedSettings(dict):
    """Settings that several records share. They must not be changed; their hash is their identity."""

    __hash__ = object.__hash__  # type: ignore[assignment]


def differences(
    records: Sequence[dict[str, Any]],
    *,
    distinguished_by: Callable[[dict[str, Any]], Hashable] | None = None,
    swept: Sequence[dict[str, str]] = (),
) -> list[str]:
    """The name of each run: its values of the keys in which runs differ. If there are none, the name of its row.

    A key that divides the runs no further than the keys before it is left out: `scale=smoke,desk` determines all sizes.
    A name has a key only if runs that would otherwise have the same name differ in it.

    Args:
        distinguished_by: a property that distinguishes runs without being in their names, such as shape and seed.
        swept: the keys and values of each run's sweep, which come before other settings.
    """
    groups = _group_numbers([distinguished_by(record) if distinguished_by else None for record in records])
    names = make_unique(_name_parts(records, swept), groups=groups, names=[""] * len(records))
    rows = [row_name(record["config"], record["renderer"]) for record in records]
    return [name or row for name, row in zip(names, rows, strict=True)]


def make_unique(
    parts: Iterable[tuple[str, Sequence[str | None]]], *, groups: list[int], names: list[str], limit: int | None = None
) -> list[str]:
    """Appends settings to names until the names distinguish all runs.

    Args:
        parts: keys with the value of each run as text, None if a run lacks the key, in the order of a name.
        groups: a number for each run; runs with different numbers need no different names.
        names: the names of the runs, before anything is appended.
        limit: the maximum number of keys; None for as many as needed.
    """
    keys: list[str] = []
    for key, values in parts:
        if len(keys) == limit or len(set(groups)) == len(groups):
            break
        refined_groups = _group_numbers(list(zip(groups, values, strict=True)))
        if len(set(refined_groups)) == len(set(groups)):
            continue
        groups = refined_groups
        keys.append(key)
        names = _append_values(names, _heading(key, keys), values)
    return names


def ordered_settings(
    settings: Sequence[dict[str, str]], first: Sequence[str] = ()
) -> Iterator[tuple[str, list[str | None]]]:
    """The keys of settings with the value of each run, in the order of a name.

    Names of choices come before the settings that they determine, such as scale.name before view.resolution. Then come
    settings of the top-level keys `first`, in their order, then outer keys.
    """

    def sort_key(key: str) -> tuple[bool, int, int]:
        top = key.partition(".")[0]
        return not key.endswith(".name"), first.index(top) if top in first else len(first), key.count(".")

    for key in sorted({key: None for values in settings for key in values}, key=sort_key):
        yield key, [values.get(key) for values in settings]


def settings_of(config: dict[str, Any], without: Container[str] = EXCLUDED_KEYS) -> dict[str, str]:
    """The settings that may be in a name, as text by dotted keys, without those of the top-level keys `without`."""
    flat_settings = flat({key: value for key, value in config.items() if key not in without})
    return {key: _as_typed(value) for key, value in flat_settings.items() if _is_named(key)}


def _name_parts(
    records: Sequence[dict[str, Any]], swept: Sequence[dict[str, str]]
) -> Iterator[tuple[str, list[str | None]]]:
    yield "row", [renderer_name(record["config"], record["renderer"]) for record in records]
    yield "silhouette", [(record["config"].get("silhouette") or {}).get("_label_") for record in records]
    for key in CHOICE_FIELDS:
        yield key, [record.get(key) or None for record in records]
    run_settings = [settings_of(record["config"]) for record in records]
    for key in ("dataset.path", "index", "seed"):
        yield key, [values.get(key) for values in run_settings]
    for settings in (swept, run_settings):
        yield from ordered_settings(settings)


@cache
def _is_named(key: str) -> bool:
    """Whether a key may be in a name; our marks may not, such as `_label_`, which is in the name of the row."""
    last_part = key.rpartition(".")[2]
    return last_part == "_target_" or not last_part.startswith("_")


def _as_typed(value: Any) -> str:
    """The value of a setting as a user types it."""
    if isinstance(value, str):
        return value
    if isinstance(value, int) and not isinstance(value, bool):
        return str(value)
    return f"{value:g}" if isinstance(value, float) and float(f"{value:g}") == value else json.dumps(value)


def _group_numbers(values: list[Any]) -> list[int]:
    numbers: dict[Any, int] = {}
    return [numbers.setdefault(value, len(numbers)) for value in values]


def _heading(key: str, keys: Sequence[str]) -> str:
    """The label before a value in a name: empty for a choice, else the last part of the key if it is unambiguous."""
    last_part = key.rpartition(".")[2]
    if key in (*CHOICE_FIELDS, "row", "silhouette", "stress"):
        return ""
    if key in KEY_LABELS or last_part in KEY_LABELS:
        return KEY_LABELS.get(key, KEY_LABELS.get(last_part, ""))
    if last_part == "name":
        return key.removesuffix(".name")
    return key if any(other.rpartition(".")[2] == last_part for other in keys if other != key) else last_part


def _append_values(names: list[str], heading: str, values: Sequence[str | None]) -> list[str]:
    """The names, with the values appended if runs of the same name differ in them."""
    alternatives: dict[str, set[str | None]] = {}
    for name, value in zip(names, values, strict=True):
        alternatives.setdefault(name, set()).add(value)
    return [
        ", ".join(filter(None, (name, f"{heading} {value}".strip()))) if value and len(alternatives[name]) > 1 else name
        for name, value in zip(names, values, strict=True)
    ]
