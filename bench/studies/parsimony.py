"""How much field a scene needs: the smallest sufficient candidate, and what field=auto and pixel precision save."""

import math
import textwrap
from collections.abc import Callable, Sequence
from pathlib import PurePath
from typing import Any

import pandas as pd
from matplotlib.figure import Figure

from bench.pictures import style
from bench.pictures.size_chart import AXES, FLOPS, KINDS, CandidateResult, Candidates
from bench.records import format
from bench.report.data.records import SCALE, Record, family, index, row_of, setting
from bench.report.data.runs import Runs, Selection
from bench.report.write import chart
from bench.report.write.result import Result
from bench.report.write.table import IDENTITY, Column, percent, shown, text, thousandfold, to_data, to_table

PLACE = 160
READS = (Selection("parsimony", setup=("scenes", "pixels", "machine"), alike=("models", "task")),)
NETWORK = "network_8x512"  # the papers' network: that of DeepSDF and DIST, without a code
TARGET = 2.0  # largest overhead of field=auto by design
COSTS = ("seconds", "flops", "evaluations")
REACHED, NOT_REACHED, FAILED, NOT_FITTED = "reached", "not reached", "failed", "not fitted"
SETTINGS = {  # settings that notes name
    "fitted": ("models", "views", "fitted"),
    "held_out": ("models", "views", "held_out"),
    "seeds": ("task", "checks", "seeds"),
    "drawn": ("task", "checks", "drawn"),
    "iterations": ("models", "fit", "iterations"),
}
NOTES = (
    "All candidates are fitted to depth and silhouettes of {fitted:g} views with the same rays and {iterations:g} "
    "iterations; the error is the mean distance along the normal over held-out rays, most of {held_out:g} other views.",
    "Recommended is the smallest candidate by {size} whose error is within one standard error (s.e.) of the best "
    "candidate's, or under half a pixel at the nearest distance: those are filled in the figure.",
    "Seeds: the share of {seeds:g} draws of {drawn:g} further views on which the recommended candidate is within one "
    "standard error of the draw's best; held also counts those on which it is under half a pixel.",
    "Saved: the papers' network (8 layers of 512, without a code) over the recommended candidate.",
)
AUTO_NOTES = (
    "The costs of field=auto are those of all candidates that it tried, in order of size; its overhead is their "
    f"seconds over those of its final fit, about {TARGET:g} at most by design, with evaluation also those of deciding.",
    "The papers' network has its costs at the first checkpoint with the error of field=auto, or less than a standard "
    "error more.",
    "“Not reached”: not by the end of its fit, whose cost is in brackets and bounds the ratios from below; – is where "
    "it was not fitted.",
    "Pixel precision: the recommended candidate fitted again with renderer.epsilon=auto, renderer.steps=auto and rays "
    "that follow the loss, over its plain fit; right, a triangle is hollow where the error is above half a pixel.",
    "Rendering: its held-out rays at pixel precision, over the configured epsilon and steps; hits of only the latter "
    "are missed, of only the former gained.",
)
Line = dict[str, Any]  # of a run


def make(runs: Runs) -> Result:
    """A line per scene: its recommended candidate, the reason, and the savings."""
    lines, size = scenes(runs)
    about = {name: setting(runs.requested(), *path) for name, path in SETTINGS.items()}
    about = {name: math.nan if value is None else value for name, value in about.items()}
    return Result(
        runs,
        f"The smallest sufficient field for each scene, by {AXES[size]}.",
        f"{AXES[size].capitalize()} of each candidate, by which the choice is made; filled is one that suffices.",
        question="How little model does a shape need?",
        verdict=_verdict(lines),
        interval="± is one standard error, by the jackknife over views",
        remarks=(*(note.format(**about, size=AXES[size]) for note in NOTES), _failed(lines)),
        data=to_data(CANDIDATES, [line | own for line in lines for own in _candidates(line)]),
        table=_table(COLUMNS, lines),
        figure=draw(lines, size),
    )


def make_auto(runs: Runs) -> Result:
    """A line per scene: the costs of field=auto and of the network to its error, and of a fit at pixel precision."""
    lines, _ = scenes(runs)
    return Result(
        runs,
        "Savings of field=auto and of pixel precision.",
        "Costs of field=auto and of the papers' network to the same error, and costs and error of a fit at pixel "
        "precision over those of the plain fit.",
        question="What does field=auto cost, and what does pixel precision save?",
        verdict=_verdict_auto(pd.DataFrame(lines)),
        interval="± is one standard error, by the jackknife over views",
        remarks=AUTO_NOTES,
        data=to_data(AUTO, lines),
        table=_table(AUTO, lines),
        figure=draw_auto(lines),
    )


def scenes(runs: Runs) -> tuple[list[Line], str]:
    """A line per run, the smallest need first, those that did not end ok last; and the measure of size that all share.

    Where runs chose by different measures it is "stored", which all of them have.
    """
    lines = [_scene(record, name) for record, name in zip(runs.records, _names(runs.records), strict=True)]
    measures = {line["candidates"].measure for line in lines if line["ok"]}
    size = measures.pop() if len(measures) == 1 else "stored"
    return sorted(lines, key=lambda line: (not line["ok"], line.get(f"recommended_{size}") or 0, line["scene"])), size


def _names(records: list[Record]) -> list[str]:
    """The scenes' names, a mesh's of its file unless two share it, with row, shape and seed where these differ."""
    families = [family(record) for record in records]
    stems = {name: PurePath(name).stem for name in families}
    unique = len(set(stems.values())) == len(stems)
    parts = [
        [stems[name] if unique else name for name in families],
        [row_of(record).name for record in records],
        [f"shape {index(record)}" for record in records],
        [f"seed {record['seed']}" for record in records],
    ]
    return list(map(", ".join, zip(*(part for i, part in enumerate(parts) if not i or len({*part}) > 1), strict=True)))


def _scene(record: Record, name: str) -> Line:
    """The run's identity, its metrics where it ended ok, and its ratios."""
    metrics = record["metrics"] if record["status"] == "ok" else {}
    candidates = Candidates.of(metrics)
    ok = record["status"] == "ok" and None not in (candidates.chosen, candidates.best)
    status = record["status"].replace("_", " ") if record["status"] != "ok" else "no field recommended"
    line = {"scene": name, "ok": ok, "said": status, "candidates": candidates}
    line |= {column.key: column.of(record) for column in IDENTITY}
    return line | ({**metrics, **_savings(metrics, candidates)} if ok else {"network": ""})


def _savings(metrics: Line, candidates: Candidates) -> Line:
    """The network's state and costs, and what field=auto and pixel precision save, by their names in the CSV.

    The ratios of costs are those of the network over those of `field=auto`, lower bounds where the error was not
    reached. Numbers of the fit at pixel precision are over those of the plain fit; None where a fit failed. The last is
    the share of evaluations that rendering held-out rays at pixel precision saves.
    """
    state = _state(metrics, candidates.result(NETWORK))
    end = "_at_auto" if state == REACHED else ""
    network = {cost: metrics.get(f"{NETWORK}.{cost}{end}") if state not in ("", NOT_FITTED) else None for cost in COSTS}
    bound = network if state in (REACHED, NOT_REACHED) else {}
    plain = candidates.chosen.numbers if metrics.get("frugal.error") is not None else {}
    share = over(metrics.get("precision.evaluations_auto"), metrics.get("precision.evaluations"))
    frugal = ("evaluations", "seconds", "error")
    return {
        "network": state,
        **{f"network.{cost}": network[cost] for cost in COSTS},
        **{f"ratio.{cost}": over(bound.get(cost), metrics.get(f"auto.{cost}")) for cost in COSTS},
        **{f"frugal_over_plain.{name}": over(metrics.get(f"frugal.{name}"), plain.get(name)) for name in frugal},
        "precision.saved": None if share is None else 1 - share,
    }


def _state(metrics: Line, network: CandidateResult | None) -> str:
    """Whether the papers' network reached the error of field=auto; empty where there is no such error."""
    if metrics.get("auto.error") is None:
        return ""
    if network is None:
        return NOT_FITTED
    if network.numbers.get("seconds_at_auto") is not None:
        return REACHED
    return FAILED if network.error is None else NOT_REACHED


def over(first: float | None, second: float | None) -> float | None:
    """The ratio of the two; None where one is missing, or the second is 0."""
    return None if first is None or not second else first / second


def _candidates(line: Line) -> list[Line]:
    """The candidates of a run with their kind and numbers; one without any where it did not end ok."""
    found = line["candidates"]
    return [
        {**one.numbers, "rung": one.name, "kind": KINDS[one.kind][0]}
        | {"recommended": one is found.chosen, "best": one is found.best}
        for one in (found.results if line["ok"] else ())
    ] or [{}]


def _failed(lines: list[Line]) -> str:
    """The fits that failed, in a sentence; empty where none did."""
    fits = [
        f"{line['scene']}, {one.label} ({one.numbers.get('failed', 'failed')})"
        for line in lines
        for one in line["candidates"].results
        if one.error is None
    ]
    return textwrap.shorten(f"Failed fits: {'; '.join(fits)}.", 300, placeholder=" …") if fits else ""


def _table(columns: Sequence[Column], lines: list[Line]) -> pd.DataFrame:
    """The readable table of all runs; those that did not end ok come last, with their status and no numbers."""
    table = to_table(columns, [line for line in lines if line["ok"]])
    rest = [[line["scene"], line["said"], *[format.MISSING] * (table.shape[1] - 2)] for line in lines if not line["ok"]]
    return pd.DataFrame([*table.to_numpy().tolist(), *rest], columns=table.columns)


def _verdict(lines: list[Line]) -> str:
    """What suffices for how many scenes; empty where no run ended ok."""
    chosen = [(line["candidates"].chosen, line["scene"]) for line in lines if line["ok"]]
    if not chosen:
        return ""
    most, scene = max(chosen, key=lambda pair: pair[0].numbers["stored"])
    return (
        f"A single part suffices for *{sum(one.kind == '' for one, _ in chosen)} of {len(chosen)}* scenes; the most is "
        f"{most.label} of {most.numbers['stored']:,.0f} stored numbers, for {scene}."
    )


def _verdict_auto(data: pd.DataFrame) -> str:
    """The overhead of the choice, and what pixel precision saves; empty where no run has them."""
    names = ("auto.overhead", "frugal_over_plain.evaluations")
    known, saved = (data[name].dropna().astype(float) if name in data else pd.Series(dtype=float) for name in names)
    if not len(known):
        return ""
    held = f"{(known <= TARGET).sum()} of n = {len(known)} scenes"
    rest = f"; pixel precision needs {format.number(saved.median())} times the field values of a plain fit"
    return (
        f"field=auto takes *{format.number(known.median())}* times the seconds of its final fit (median; at most "
        f"{TARGET:g} on {held}){rest if len(saved) else ''}."
    )


@style.styled
def draw(lines: list[Line], size: str) -> Figure:
    """Draws the candidates of each scene over their size, filled those that suffice, a ring around the recommended."""
    figure, ((axis,),) = chart.sheet(0.26 * len(lines) + 1.2)
    for place, line in enumerate(lines):
        found = line["candidates"]
        if not line["ok"]:
            continue
        enough = max(found.best.numbers["error"] + found.best.numbers["standard_error"], found.footprint)
        for one in found.results:
            _, colour, marker = KINDS[one.kind]
            fill = colour if one.error is not None and one.error <= enough else "none"
            marker = "x" if one.error is None else marker
            axis.plot(one.numbers[size], place, marker, color=colour, mfc=fill, ms=5, mew=1)
        axis.plot(found.chosen.numbers[size], place, "o", ms=10, mfc="none", mec="#111111", mew=1.2)
    for label, colour, marker in KINDS.values():
        axis.plot([], [], marker, color=colour, label=label)
    how = {"ls": "none", "color": "#666666"}
    axis.plot([], [], "s", mfc="none", label="does not suffice", **how)
    axis.plot([], [], "x", label="failed fit", **how)
    axis.plot([], [], "o", ms=10, mfc="none", mec="#111111", mew=1.2, label="recommended", ls="none")
    axis.set(xscale="log", xlabel=AXES[size], ylim=(len(lines) - 0.5, -0.5))
    axis.set_yticks(range(len(lines)), [line["scene"] + ("" if line["ok"] else _lost(line)) for line in lines])
    style.legend_below(figure, axis, columns=4)
    return figure


@style.styled
def draw_auto(lines: list[Line]) -> Figure:
    """Draws, left, operations of field=auto and the network to the same error; right, the fit at pixel precision."""
    figure, ((left, right),) = chart.sheet(0.24 * len(lines) + 1.5, 1, 2, sharey=True, width_ratios=(1.25, 1))
    told = {"": "", NOT_FITTED: "", REACHED: "", NOT_REACHED: ", not reached in its fit", FAILED: ", fit failed"}
    for place, line in enumerate(lines):
        state, blue = line["network"], KINDS["network"][1]
        above = (line.get("frugal.error") or 0) > line.get("footprint", math.inf)
        for axis, key, marker, colour, filled, label in (
            (left, "auto.flops", "o", "#111111", True, "field=auto, all trials"),
            (
                left,
                "network.flops",
                "x" if state == FAILED else "s",
                blue,
                state == REACHED,
                f"papers' network{told[state]}",
            ),
            (right, FRUGAL[0], "D", "#6a3d9a", True, "evaluations"),
            (right, FRUGAL[1], "^", "#cc79a7", not above, f"error, {'above' if above else 'under'} half a pixel"),
        ):
            if (x := line.get(key)) is not None:
                axis.plot(x, place, marker, color=colour, mfc=colour if filled else "none", ms=5, label=label)
    for axis, keys in ((left, ("auto.flops", "network.flops")), (right, FRUGAL)):
        style.log_axis(axis, "x", [x for line in lines for key in keys if (x := line.get(key))])
    left.margins(x=0.1)
    right.axvline(1, color="#777777", lw=0.9)
    left.set(xlabel="FLOPs to the error of field=auto", ylim=(len(lines) - 0.5, -0.5))
    right.set(xlabel="fit at pixel precision / plain fit")
    left.set_yticks(range(len(lines)), [line["scene"] + _lost(line) for line in lines])
    for axis, side, columns in ((left, "left", 2), (right, "right", 1)):
        style.legend_of(figure, dict(sorted(style.labelled(axis).items())), columns=columns, side=side)
    return figure


def _lost(line: Line) -> str:
    """What a scene lacks, in brackets behind its name: its status, or the fits that failed."""
    fits = [f"{name} {reason}" for name in ("auto", "frugal") if (reason := _reason(line, name))]
    said = ", ".join(fits if line["ok"] else [line["said"]])
    return f" ({said})" if said else ""


def _reason(line: Line, fit: str) -> str:
    """The status of a failed fit; empty for others."""
    return (line.get(f"{fit}.failed") or "").partition(":")[0]


def factor(x: float | None, *, above: bool = False) -> str:
    """A ratio as text, such as 0.43× or 184k×; > 45× where `above` says that it is a lower bound."""
    if x is None or math.isnan(x):
        return format.MISSING
    return f"{'> ' if above else ''}{format.count(x) if abs(x) >= 1000 else format.number(x)}×"


def _spread(numbers: Line, beginning: str = "") -> str:
    """A mean error with its standard error, times 1000."""
    mean, error = (numbers.get(f"{beginning}{name}") for name in ("error", "standard_error"))
    told = format.number(mean, SCALE)
    return told if mean is None or error is None else f"{told} ± {format.number(error, SCALE)}"


def _why(line: Line) -> str:
    within, enough = (line.get(f"recommended_{name}") for name in ("within", "enough"))
    return ("both" if enough else "within 1 s.e.") if within else "under half a pixel"


def _network(cost: str, show: Callable[[Any], str]) -> Column:
    """The network's cost, for readers with its state where it did not reach the error."""

    def words(line: Line) -> str:
        spent = show(line[f"network.{cost}"])
        return f"{line['network']} ({spent})" if line["network"] in (NOT_REACHED, FAILED) else spent

    return Column(f"network.{cost}", f"Network: {cost.replace('flops', 'FLOPs')}", words=words)


def _ratio(cost: str, heading: str) -> Column:
    key = f"ratio.{cost}"
    return Column(key, heading, words=lambda line: factor(line[key], above=line["network"] == NOT_REACHED))


def _errors(line: Line) -> str:
    """The errors of the plain fit and of that at pixel precision, in half pixels."""
    plain, frugal = (over(line.get(key), line["footprint"]) for key in ("recommended_error", "frugal.error"))
    return f"{format.number(plain)}, {_reason(line, 'frugal') or format.number(frugal)}"


def _field(name: str | None) -> str:
    return (name or format.MISSING).replace("_", " ")


FRUGAL = ("frugal_over_plain.evaluations", "frugal_over_plain.error")
SIZES = ("stored", "free", "bytes")
SCENE = (text("scene", "Scene"), *(text(column.key) for column in IDENTITY))
CANDIDATES = (  # of a run and a candidate
    *SCENE,
    *map(Column, ("footprint", "chamfer_l2", "recommended_within", "recommended_enough")),
    *map(Column, ("held_out_seeds", "held_out_seeds_within", "held_out_seeds_held")),
    *(Column(f"saved_{name}") for name in (*SIZES, FLOPS, "seconds")),
    *map(Column, ("rung", "kind", "recommended", "best", *SIZES, "sparse_bytes", FLOPS, "error", "standard_error")),
    *map(Column, ("seconds", "evaluations", "flops", "failed", *(f"{cost}_at_auto" for cost in COSTS))),
)
COLUMNS = (  # of a run
    SCENE[0],
    shown("Recommended", lambda line: line["candidates"].chosen.label),
    shown("Stored numbers", lambda line: f"{line['candidates'].chosen.numbers['stored']:,}"),
    shown("Free numbers", lambda line: f"{line['candidates'].chosen.numbers['free']:,}"),
    shown("Size of the file", lambda line: format.size(line["candidates"].chosen.numbers["bytes"])),
    shown("Error × 1000", lambda line: _spread(line["candidates"].chosen.numbers)),
    *(Column("footprint", "Half a pixel × 1000", show=thousandfold), shown("Why", _why)),
    shown("Best candidate", lambda line: line["candidates"].best.label),
    shown("Best error × 1000", lambda line: _spread(line["candidates"].best.numbers)),
    Column("held_out_seeds_within", "Seeds within 1 s.e.", show=percent),
    Column("held_out_seeds_held", "Seeds held", show=percent),
    Column("saved_stored", "Saved stored numbers", show=factor),
    Column("saved_free", "Saved free numbers", show=factor),
    Column("saved_flops_per_query", "Saved FLOPs per query", show=factor),
    Column("saved_seconds", "Saved fit seconds", show=factor),
    Column("chamfer_l2", "Chamfer × 1000", show=thousandfold),
    shown("Failed candidates", lambda line: "{} of {}".format(*_fits(line["candidates"]))),
)
AUTO = (  # of a run
    *(*SCENE, Column("auto.field", "Choice of field=auto", show=_field)),
    Column("auto.error", "Error × 1000", words=lambda line: _spread(line, "auto.")),
    *(Column("auto.standard_error"), Column("recommended_field", "Recommended among all", show=_field)),
    Column("recommended_error", "Its error × 1000", show=thousandfold),
    Column("footprint", "Half a pixel × 1000", show=thousandfold),
    Column("auto.seconds", "Seconds", show=format.seconds),
    *(Column("auto.flops", "FLOPs", show=format.count), Column("auto.evaluations", "Evaluations", show=format.count)),
    *(Column("auto.overhead", "Overhead"), Column("auto.overhead_judged", "Overhead with evaluation"), text("network")),
    *(_network("seconds", format.seconds), _network("flops", format.count), _network("evaluations", format.count)),
    *(_ratio("seconds", "Ratio of seconds"), _ratio("flops", "Ratio of FLOPs"), Column("ratio.evaluations")),
    *(Column(f"frugal.{name}") for name in ("standard_error", *COSTS)),
    Column("frugal_over_plain.evaluations", "Pixel precision: evaluations", show=factor),
    Column("frugal_over_plain.seconds", "Pixel precision: seconds", show=factor),
    Column("frugal_over_plain.error"),
    Column("frugal.error", "Error in half pixels: plain, pixel precision", words=_errors),
    Column("precision.saved", "Rendering: evaluations saved", show=percent),
    *(Column("precision.evaluations"), Column("precision.evaluations_auto")),
    Column("precision.lost", "Hits missed", show=format.count),
    Column("precision.gained", "Hits gained", show=format.count),
    Column("precision.hits", "Hits", show=format.count),
)


def _fits(candidates: Candidates) -> tuple[int, int]:
    """The numbers of failed and of all candidates."""
    return sum(one.error is None for one in candidates.results), len(candidates.results)


PAGES = {"parsimony": make, "parsimony_auto": make_auto}
