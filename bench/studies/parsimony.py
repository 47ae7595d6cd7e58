"""The smallest field that is sufficient for a scene."""

from typing import Any

from matplotlib.figure import Figure

from bench.pictures.size_chart import AXES, FLOPS, KINDS, Candidates
from bench.report.study import Result, Runs, Selection, chart, figure_style, format, medians, records, table

PLACE = 160
READS = (Selection("parsimony", setup=("scenes", "pixels", "machine"), alike=("models", "task")),)
COSTS = ("seconds", "flops", "evaluations")
NOTES = (
    "All candidates are fitted to depth and silhouettes of the same views with the same rays. Rounds end when the "
    "error decreases by no more than its noise; costs are of all rounds. The error is the mean distance along the "
    "normal over held-out rays, most of them of other views.",
    "Recommended: the smallest candidate by {size} whose error is within one standard error (s.e.) of the best "
    "candidate's error, or under half a pixel at the nearest distance. The figure shows such candidates filled.",
    "Seeds held: the percentage of draws of further views for which the recommended candidate is within one standard "
    "error of the best candidate, or under half a pixel.",
    "Saved: the papers' network (8 layers of 512, without a code) relative to the recommended candidate. Overhead: the "
    "seconds of all candidates that field=auto tried, relative to its final fit.",
    "Pixel precision: the recommended candidate fitted again with renderer.epsilon=auto, renderer.steps=auto and rays "
    "that follow the loss, relative to its plain fit.",
)
Line = dict[str, Any]  # a run


def make(runs: Runs) -> Result:
    """A line per scene: its recommended candidate, the reason, and the savings."""
    lines, size = scenes(runs)
    return Result(
        runs,
        f"The smallest sufficient field for each scene, by {AXES[size]}.",
        f"{AXES[size].capitalize()} of each candidate, by which one is recommended; filled candidates suffice.",
        question="How small can the model of a shape be?",
        verdict=_verdict([line for line in lines if line["ok"]]),
        interval="± is one standard error, by the jackknife over views",
        remarks=[*(note.format(size=AXES[size]) for note in NOTES), _falling(lines)],
        data=table.to_data(CANDIDATES, [line | candidate for line in lines for candidate in _candidates(line)]),
        columns=COLUMNS,
        lines=lines,
        figure=draw(lines, size),
    )


def scenes(runs: Runs) -> tuple[list[Line], str]:
    """A line per run, the smallest recommended field first, failed runs last; and the measure of size."""
    lines = [_scene(record, medians.scene_of(record)) for record in runs.records]
    size = next((line["candidates"].measure for line in lines if line["ok"]), "stored")
    return sorted(lines, key=lambda line: (not line["ok"], line.get(f"recommended_{size}") or 0, line["scene"])), size


def _scene(record: records.Record, name: str) -> Line:
    """The run's identity, metrics, and recommended and best candidate; `problem` says why these are missing."""
    metrics = record["metrics"] if record["status"] == "ok" else {}
    candidates = Candidates.of(metrics)
    line = {"scene": name, "candidates": candidates} | {column.key: column.of(record) for column in table.IDENTITY}
    if candidates.chosen is None or candidates.best is None:
        status = record["status"].replace("_", " ") if record["status"] != "ok" else "no field recommended"
        return line | {"ok": False, "problem": status, "lost": format.MISSING}
    for role, candidate in (("chosen", candidates.chosen), ("best", candidates.best)):
        line |= {f"{role}.name": candidate.label} | {f"{role}.{key}": value for key, value in candidate.numbers.items()}
    frugal, plain = metrics.get("frugal.evaluations"), candidates.chosen.numbers.get("evaluations")
    fitted = metrics.get("frugal.error") is not None and frugal is not None and plain
    lost = sum(candidate.error is None for candidate in candidates.results)
    line |= {"frugal_evaluations": frugal / plain if fitted else None, "lost": f"{lost} of {len(candidates.results)}"}
    return line | metrics | {"ok": True, "problem": ""}


def _candidates(line: Line) -> list[Line]:
    """The candidates of a run with their kind and numbers; one empty line for a failed run."""
    candidates = line["candidates"]
    return [
        {**candidate.numbers, "rung": candidate.name, "kind": KINDS[candidate.kind][0]}
        | {"recommended": candidate is candidates.chosen, "best": candidate is candidates.best}
        for candidate in (candidates.results if line["ok"] else ())
    ] or [{}]


def _falling(lines: list[Line]) -> str:
    """A sentence on the fits that still improved at their end, with their scenes."""
    fits = [(candidate, line["scene"]) for line in lines for candidate in line["candidates"].results]
    names = [f"{candidate.label} ({scene})" for candidate, scene in fits if candidate.numbers.get("falling")]
    return f"Not converged (the last round still reduced the error): {', '.join(names)}." if names else ""


def _verdict(lines: list[Line]) -> str:
    """What suffices for how many scenes; empty where no run ended ok."""
    if not lines:
        return ""
    most = max(lines, key=lambda line: line["chosen.stored"])
    single = sum(line["candidates"].chosen.kind == "" for line in lines)
    return (
        f"A single part suffices for *{single} of {len(lines)}* scenes. The largest field needed is "
        f"{most['chosen.name']} with {most['chosen.stored']:,.0f} stored numbers, for {most['scene']}."
    )


@figure_style.styled
def draw(lines: list[Line], size: str) -> Figure:
    """Draws the candidates of each scene over their size: filled if sufficient, with a ring if recommended."""
    figure, ((axis,),) = chart.sheet(0.26 * len(lines) + 1.2)
    ring = {"ms": 10, "mfc": "none", "mec": "#111111", "mew": 1.2, "ls": "none"}
    for index, line in enumerate(lines):
        if not line["ok"]:
            continue
        max_error = max(line["best.error"] + line["best.standard_error"], line["footprint"])
        for candidate in line["candidates"].results:
            _, colour, marker = KINDS[candidate.kind]
            fill = colour if candidate.error is not None and candidate.error <= max_error else "none"
            marker = "x" if candidate.error is None else marker
            axis.plot(candidate.numbers[size], index, marker, color=colour, mfc=fill, ms=5, mew=1)
        axis.plot(line[f"chosen.{size}"], index, "o", **ring)
    for label, colour, marker in KINDS.values():
        axis.plot([], [], marker, color=colour, label=label)
    how = {"ls": "none", "color": "#666666"}
    axis.plot([], [], "s", mfc="none", label="does not suffice", **how)
    axis.plot([], [], "x", label="failed fit", **how)
    axis.plot([], [], "o", label="recommended", **ring)
    axis.set(xscale="log", xlabel=AXES[size], ylim=(len(lines) - 0.5, -0.5))
    names = [f"{line['scene']} ({line['problem']})" if line["problem"] else line["scene"] for line in lines]
    axis.set_yticks(range(len(lines)), names)
    figure_style.legend_below(figure, axis, columns=4)
    return figure


def _factor(x: float | None) -> str:
    """A ratio as text, such as 0.43× or 184k×."""
    if x is None:
        return format.MISSING
    return f"{format.count(x) if abs(x) >= 1000 else format.number(x)}×"


def _whole(count: int | None) -> str:
    return format.MISSING if count is None else f"{count:,}"


def _label(line: Line, role: str) -> str:
    """The name of the recommended or best candidate; without a recommended one, the problem."""
    return line.get(f"{role}.name") or (line["problem"] if role == "chosen" else format.MISSING)


def _spread(line: Line, role: str) -> str:
    """The mean error of a candidate with its standard error, times 1000."""
    if f"{role}.error" not in line:
        return format.MISSING
    return " ± ".join(table.thousandfold(line[f"{role}.{name}"]) for name in ("error", "standard_error"))


def _why(line: Line) -> str:
    within, enough = (line.get(f"recommended_{name}") for name in ("within", "enough"))
    return ("both" if enough else "within 1 s.e.") if within else "under half a pixel" if enough else format.MISSING


SIZES = ("stored", "free", "bytes")
SCENE = (table.text("scene", "Scene"), *(table.text(column.key) for column in table.IDENTITY))
CANDIDATES = (  # a line is a run and a candidate
    *SCENE,
    *table.raw("footprint", "chamfer_l2", "recommended_within", "recommended_enough"),
    *table.raw("held_out_seeds", "held_out_seeds_within", "held_out_seeds_held"),
    *table.raw(*(f"saved_{name}" for name in (*SIZES, FLOPS, "seconds")), "rung", "kind", "recommended", "best"),
    *table.raw(*SIZES, "sparse_bytes", FLOPS, "error", "standard_error", *COSTS, "iterations", "falling", "failed"),
    *table.raw(*(f"{cost}_at_auto" for cost in COSTS)),
)
COLUMNS = (  # a line is a run
    SCENE[0],
    table.shown("Recommended", lambda line: _label(line, "chosen")),
    *table.columns(_whole, **{"chosen.stored": "Stored numbers", "chosen.free": "Free numbers"}),
    table.Column("chosen.bytes", "Size of the file", show=table.size),
    table.shown("Error × 1000", lambda line: _spread(line, "chosen")),
    *(*table.columns(table.thousandfold, footprint="Half a pixel × 1000"), table.shown("Why", _why)),
    table.shown("Best candidate", lambda line: _label(line, "best")),
    table.shown("Best error × 1000", lambda line: _spread(line, "best")),
    *table.columns(table.percent, held_out_seeds_held="Seeds held"),
    *table.columns(_factor, saved_stored="Saved stored numbers", saved_seconds="Saved fit seconds"),
    table.Column("auto.overhead", "Overhead of field=auto"),
    *table.columns(_factor, frugal_evaluations="Evaluations at pixel precision"),
    table.text("lost", "Failed candidates"),
)
PAGES = {"parsimony": make}
