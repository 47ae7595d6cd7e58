"""Names of runs in a list: the row's name, then the settings in which runs of that name differ.

What differs is found and written as `bench.records.names` does it for the rows of a sweep, so that a setting reads the
same in both. A list mixes all tasks and experiments, so a name begins with the row, and lacks what stands in columns of
its own, such as shape and seed.
"""

from bench.records.names import in_order, settings_of, told_apart
from bench.records.record import NEUTRAL_KEYS, row_name
from bench.report.data.records import OURS, Record, grouped, setting

CUSTOM = "custom"  # the choice of renderer that stands for a user's class
MOST = 3  # settings in a name
# Parts of a configuration that a list of runs shows in columns of their own, or that follow from others.
SHOWN = NEUTRAL_KEYS | {"dataset", "stress", "seed", "index", "split", "label", "experiment", "packages", "draw"}
# What is named first where several settings tell runs apart.
FIRST = ("renderer", "task", "field", "method", "silhouette", "scale", "view")


def names(records: list[Record]) -> list[str]:
    """The name of each run: that of its row, a user's renderer by its class, and the settings that differ.

    Settings are added as long as one tells apart runs of one task and row that those before it do not, so that what
    follows from another setting is not repeated; at most `MOST`.
    """
    found = [base_name(record) for record in records]
    settings = [settings_of(record["config"], SHOWN) for record in records]
    for places in grouped(range(len(records)), lambda place: (records[place]["task"], found[place])).values():
        alike = list(grouped(places, lambda place: str(settings[place])).values())  # most runs of a list have the same
        different = [settings[same[0]] for same in alike]
        rows = [found[places[0]]] * len(alike)
        told = told_apart(in_order(different, FIRST), classes=[0] * len(alike), names=rows, most=MOST)
        for same, name in zip(alike, told.names, strict=True):
            for place in same:
                found[place] = name
    return found


def base_name(record: Record) -> str:
    """The name of a record's row; of a user's renderer without a label, its class."""
    name = row_name(record["config"], record["renderer"])
    target = str(setting(record["config"], "renderer", "_target_") or "")
    if record["renderer"] == CUSTOM and target and not target.startswith(OURS):
        own = target.rpartition(".")[2]
        return name.replace(CUSTOM, own, 1) if name.startswith(CUSTOM) else name
    return name
