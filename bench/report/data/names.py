"""Names of runs by what differs: the row's name, then the settings in which runs of that name differ."""

from collections.abc import Hashable
from typing import Any

from bench.records.names import flat
from bench.records.record import NEUTRAL_KEYS, row_name
from bench.report.data.records import OURS, Record, grouped, setting

CUSTOM = "custom"  # the file of conf/renderer that stands for a user's class
MOST = 3  # settings in a name
# Parts of a configuration that a list of runs shows in columns of their own, or that follow from others.
SHOWN = NEUTRAL_KEYS | {"dataset", "stress", "seed", "index", "split", "label", "experiment", "packages", "draw"}
# What is named first where several settings tell runs apart; the others follow in the order of their names.
FIRST = ("renderer", "task", "field", "method", "silhouette", "scale", "view")


def names(records: list[Record]) -> list[str]:
    """The name of each record: that of its row, a user's renderer by its class, and the settings that differ.

    Settings are added, in the order of `FIRST`, as long as one tells apart runs of one task and name that those before
    it do not, so that what follows from another setting is not repeated; at most `MOST`.
    """
    found = [base_name(record) for record in records]
    for places in grouped(range(len(records)), lambda place: (records[place]["task"], found[place])).values():
        for place, told in zip(places, _told_apart([records[place] for place in places]), strict=True):
            found[place] += told
    return found


def base_name(record: Record) -> str:
    """The name of a record's row; of a user's renderer without a label, its class."""
    name = row_name(record["config"], record["renderer"])
    target = str(setting(record["config"], "renderer", "_target_") or "")
    if record["renderer"] == CUSTOM and target and not target.startswith(OURS):
        own = target.rpartition(".")[2]
        return name.replace(CUSTOM, own, 1) if name.startswith(CUSTOM) else name
    return name


def _told_apart(records: list[Record]) -> list[str]:
    """For each record of one name the settings that differ among them, such as `, steps=20, alpha=1.5`."""
    known = [_settings(record["config"]) for record in records]
    if all(settings == known[0] for settings in known):
        return [""] * len(records)
    keys = sorted({key for settings in known for key in settings}, key=_order)
    varied = [key for key in keys if len({settings.get(key, "") for settings in known}) > 1]
    classes: list[Hashable] = [0] * len(records)
    chosen: list[str] = []
    for key in varied:
        finer = [(known, settings.get(key, "")) for known, settings in zip(classes, known, strict=True)]
        if len(set(finer)) > len(set(classes)):
            numbers = {each: number for number, each in enumerate(dict.fromkeys(finer))}
            classes = [numbers[each] for each in finer]
            chosen.append(key)
        if len(chosen) == MOST:
            break
    short = _short(chosen)
    return ["".join(f", {short[key]}={settings.get(key, 'none')}" for key in chosen) for settings in known]


def _order(key: str) -> tuple[int, str]:
    top = key.split(".")[0]
    return (FIRST.index(top) if top in FIRST else len(FIRST), key)


def _short(keys: list[str]) -> dict[str, str]:
    """The last part of each key, or all of it where two keys would be called the same."""
    last = [key.rpartition(".")[2] for key in keys]
    return {key: end if last.count(end) == 1 else key for key, end in zip(keys, last, strict=True)}


def _settings(config: dict[str, Any]) -> dict[str, str]:
    """The settings that may be part of a name, as text."""
    known = flat({top: value for top, value in config.items() if top not in SHOWN})
    return {key: "null" if value is None else str(value) for key, value in known.items() if _public(key)}


def _public(key: str) -> bool:
    last = key.rpartition(".")[2]
    return last == "_target_" or not last.startswith("_")
