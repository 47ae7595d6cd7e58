"""Writes captions: what is plotted, n, the interval, what failed, and the machine; everything else becomes notes."""

import math
import textwrap
from collections import Counter
from collections.abc import Iterable
from operator import itemgetter
from typing import Any

from bench.records.format import plural
from bench.report.data.records import Record, doubtful, setting, solid, view
from bench.report.data.runs import Runs, shared_loss
from bench.report.data.statistics import Interval

SMOKE_WARNING = "Made at scale=smoke, to try things out: do not interpret these numbers."
MAX_REASON_LETTERS = 160  # the CSV has the full reason
MAX_LISTED_NAMES = 4  # more are counted
VARYING = "{shapes and seeds}"  # placeholder for what the runs of an experiment vary over
FEW = "fewer than six shapes"  # see statistics.MIN_SHAPES


def caption(runs: Runs, plotted: str, *, n: str, interval: str) -> str:
    """The caption of a `Result` in four sentences, after a warning if runs are of scale=smoke."""
    sample = (n or _sample(runs)) + (f"; {fill_varying(runs, interval)}" if interval else "") + "."
    setup = _setup(runs)
    first = [SMOKE_WARNING if has_smoke_runs(runs) else "", fill_varying(runs, plotted)]
    return " ".join(filter(None, [*first, f"n = {sample}", _outcome(runs), f"{setup}." if setup else ""]))


def has_smoke_runs(runs: Runs) -> bool:
    return any(setting(record["config"], "scale", "name") == "smoke" for record in runs.records)


def fill_varying(runs: Runs, text: str) -> str:
    """Replaces `VARYING` in a text by what the runs vary over, such as shapes and seeds."""
    shapes, views, seeds = _levels(runs)
    levels = [name for name, varies in (("views", views > 1), ("seeds", seeds > 1)) if varies]
    words = " and ".join(["shapes", *levels] if shapes > 1 else levels)
    return text.replace(VARYING, words if shapes > 1 else f"{words} of one shape" if words else "one shape")


def interval_text(interval: str, estimates: Iterable[Interval], *, drawn: bool) -> str:
    """The kind of interval of the shown estimates; with few shapes, a text that says that there is none."""
    has_interval = [estimate.has_ends for estimate in estimates]
    few_note = f"{FEW}: {'a small point per shape, ' if drawn else ''}no interval; n in brackets counts shapes"
    if all(has_interval):
        return interval
    return f"{interval}; {few_note}" if any(has_interval) else few_note


def undefined(values: Iterable[float]) -> str:
    """A note on probabilities and ranks that are not defined; empty if all are."""
    none = any(math.isnan(value) for value in values)
    return "One shape and one seed are one draw: from it no probability and no rank is given (–)." if none else ""


def warnings(runs: Runs, *, with_times: bool = True) -> list[str]:
    """Notes on differing settings, incomparable or doubtful times (if the page has times), and missing runs."""
    with_times = with_times and "machine" in runs.selection.setup
    timing = (_machines(runs), _loaded(runs)) if with_times else ()
    notes = (_mixed(runs), *timing, _omitted(runs), _renamed(runs))
    return [note for note in notes if note]


def _sample(runs: Runs) -> str:
    shapes, views, seeds = _levels(runs)
    parts = [plural(shapes, "shape"), *([plural(views, "view")] if views > 1 else []), plural(seeds, "seed")]
    return f"{plural(len(runs.records), 'run')} ({', '.join(parts)})"


def _levels(runs: Runs) -> tuple[int, int, int]:
    records = runs.records
    shapes = {(solid(record), record["config"].get("split")) for record in records}
    return len(shapes), *(len({getter(record) for record in records}) for getter in (view, itemgetter("seed")))


def _setup(runs: Runs) -> str:
    """The known parts of the setup: scenes, machine, and the resolution, prior and loss if all runs share them."""
    if not runs.records:
        return ""
    scenes = list(dict.fromkeys(str(record.get("scene") or "") for record in runs.records))
    shown = [scene for scene in scenes if scene] or [runs.records[0]["dataset"]]
    sizes = {setting(record["config"], "view", "resolution") for record in runs.records}
    resolution = sizes.pop() if len(sizes) == 1 else None
    config = runs.requested()
    network = setting(config, "prior", "network") or setting(config, "scale", "network") or {}
    is_own_network = runs.records[0]["dataset"] != "network"  # a note of the run describes other networks
    layers, width = (setting(network, "layers"), setting(network, "width")) if is_own_network else (None, None)
    machines = [_machine(*machine) for machine in runs.machines()]
    parts = {
        "scenes": f"{'Scene' if len(shown) == 1 else f'{len(shown)} scenes:'} {_listed(shown)}",
        "pixels": f"{resolution}×{resolution} pixels" if resolution else "",
        "network": f"decoder of {layers} layers of {width}" if layers and width else "",
        "machine": f"{len(machines)} machines, see the notes" if len(machines) > 1 else "".join(machines),
    }
    loss = shared_loss(runs.records)
    known_parts = [parts[name] for name in runs.selection.setup if parts[name]]
    text = "; ".join(known_parts + ([f"every row with {loss}"] if loss else []))
    return text[:1].upper() + text[1:]


def _outcome(runs: Runs) -> str:
    failed = [record for record in runs.named() if record["status"] != "ok"]
    total = len(runs.records)
    if not total:  # a page of stored attempts
        return ""
    if not failed:
        return f"All {total} runs ended ok." if total > 1 else "The run ended ok."
    if len(failed) <= MAX_LISTED_NAMES:
        listed = "; ".join(_failure(record) for record in failed)
    else:
        statuses = Counter(record["status"] for record in failed).most_common()
        listed = ", ".join(f"{count} {status}" for status, count in statuses) + "; reasons in the CSV"
    subject = f"{len(failed)} of {total} runs" if total > 1 else "The run"
    return f"{subject} did not end ok: {listed}."


def _omitted(runs: Runs) -> str:
    if not runs.left_out:
        return ""
    counts = [f"{plural(count, 'run')} of {name}" for name, count in runs.left_out.items()]
    return f"Not shown: {', '.join(counts)} at another scale or on another scene, or replaced by newer ones."


def _renamed(runs: Runs) -> str:
    rows = [f"{row} ({_listed(keys)})" for row, keys in runs.renamed.items()]
    remedy = (
        "Only the settings requested last are shown: run each setting with another label=NAME. In a study of your own, "
    )
    remedy += "name such a key in its Selection"
    return f"Several settings have the same label: {_listed(rows)}. {remedy}." if rows else ""


def _mixed(runs: Runs) -> str:
    keys = runs.mixed()
    return f"Runs differ in {_listed(keys)}: do not compare rows with different values." if keys else ""


def _machines(runs: Runs) -> str:
    machines = runs.machines()
    if len(machines) < 2:
        return ""
    each = [f"{_machine(*machine) or 'unnamed machine'}: {_listed(rows, '; ')}" for machine, rows in machines.items()]
    return f"Do not compare times of different machines, numbers of threads or kernels. {'. '.join(each)}."


def _loaded(runs: Runs) -> str:
    names = [record["name"] for record in runs.named() if doubtful(record)]
    few = "; ".join(names) if len(names) <= MAX_LISTED_NAMES else f"{len(names)} of {len(runs.records)} runs"
    rows = "all rows" if len(names) == len(runs.records) > 1 else few
    says = (
        "Times are not reliable, see the notes of the runs" if runs.timed else "No runtimes, since the machine had load"
    )
    return f"{says}: {rows}." if names else ""


def _machine(cpu: Any, device: Any, threads: Any, compiled: bool) -> str:
    parts = [str(name) for name in (cpu, device) if name and name != "cpu"]
    more = [plural(threads, "thread")] if threads else []
    return "; ".join([" + ".join(parts), *more, *(["compiled kernels"] if compiled else [])])


def _failure(record: Record) -> str:
    reason = textwrap.shorten(record["reason"] or "no reason recorded", MAX_REASON_LETTERS, placeholder=" …")
    return f"{record['name']}: {record['status']} ({reason.rstrip('.')})"


def _listed(names: list[str], separator: str = ", ") -> str:
    more = len(names) - MAX_LISTED_NAMES
    return separator.join(names[:MAX_LISTED_NAMES]) + (f" and {more} more" if more > 0 else "")
