"""Sentences that every caption has: on what it was measured, what failed, what was left out."""

import textwrap
from collections import Counter
from typing import Any

from bench.report.experiments import Experiment, setting

LONGEST_REASON = 160  # characters of a reason in a caption; the CSV has all of it


def setup(experiment: Experiment, *, network: bool = True) -> str:
    """Scenes, asked resolution, the prior's network where it has a part, machine and threads, as one sentence."""
    config, records = experiment.asked(), experiment.records
    scenes = list(dict.fromkeys(str(record.get("scene") or "") for record in records))
    known = [scene for scene in scenes if scene] or [records[0]["dataset"]]
    sizes = {setting(record["config"], "view", "resolution") for record in records}
    resolution = sizes.pop() if len(sizes) == 1 else None
    machines = [_machine(*machine) for machine in experiment.machines()]
    parts = [
        f"{'Scene' if len(known) == 1 else f'{len(known)} scenes:'} {_listed(known)}",
        f"{resolution}×{resolution} pixels" if resolution else "",
        _network(setting(config, "prior", "network") or setting(config, "scale", "network")) if network else "",
        machines[0] if len(machines) == 1 else "",
    ]
    return joined("; ".join(part for part in parts if part) + ".", _compared(experiment), _loaded(experiment))


def outcome(experiment: Experiment) -> str:
    """How many rows ended ok, and each that did not with its status and reason."""
    pairs = zip(experiment.names(), experiment.records, strict=True)
    failed = [_failure(name, record) for name, record in pairs if record["status"] != "ok"]
    total = len(experiment.records)
    if not failed:
        return f"All {total} runs ended ok." if total > 1 else "The run ended ok."
    return f"{len(failed)} of {total} runs did not end ok: {'; '.join(failed)}."


def counted_outcome(experiment: Experiment) -> str:
    """How many of many runs did not end ok, by status."""
    statuses = Counter(record["status"] for record in experiment.records if record["status"] != "ok")
    total = len(experiment.records)
    if not statuses:
        return f"All {total} runs ended ok."
    told = ", ".join(f"{count} {status}" for status, count in statuses.most_common())
    return f"{statuses.total()} of {total} runs did not end ok ({told}); the CSV says why."


def omitted(experiment: Experiment) -> str:
    """How many records of this experiment are not shown, and why; empty where all are."""
    if not experiment.left_out:
        return ""
    runs = "1 run" if experiment.left_out == 1 else f"{experiment.left_out} runs"
    return f"Not shown: {runs} of this experiment with another scene, setting or machine."


def joined(*sentences: str) -> str:
    """The sentences that are not empty, as one paragraph."""
    return " ".join(sentence for sentence in sentences if sentence)


def _compared(experiment: Experiment) -> str:
    """A warning where the rows' times are of different machines or numbers of threads."""
    machines = experiment.machines()
    if len(machines) < 2:
        return ""
    told = [f"{_machine(*machine) or 'an unnamed one'} ({_listed(rows)})" for machine, rows in machines.items()]
    return f"Times do not compare between rows of different machines or threads: {'; '.join(told)}."


def _loaded(experiment: Experiment) -> str:
    """A warning where other work, or a missing synchronisation, spoilt times."""
    pairs = zip(experiment.names(), experiment.records, strict=True)
    doubtful = ("loaded machine", "missing synchronisation")
    names = [name for name, record in pairs if any(note.startswith(doubtful) for note in record["notes"])]
    told = "all rows" if len(names) == len(experiment.records) > 1 else _listed(names)
    return f"Times in doubt, see the notes of the run: {told}." if names else ""


def _machine(cpu: Any, device: Any, threads: Any) -> str:
    parts = [str(part) for part in (cpu, device) if part and part != "cpu"]
    return "; ".join([" + ".join(parts), *([f"{threads} thread{'s' if threads != 1 else ''}"] if threads else [])])


def _failure(name: str, record: dict[str, Any]) -> str:
    reason = textwrap.shorten(record["reason"] or "no reason recorded", LONGEST_REASON, placeholder=" …")
    return f"{name}: {record['status']} ({reason.rstrip('.')})"


def _network(network: Any) -> str:
    layers, width = setting(network, "layers"), setting(network, "width")
    return f"decoder of {layers} layers of {width}" if layers and width else ""


def _listed(names: list[str], most: int = 4) -> str:
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")
