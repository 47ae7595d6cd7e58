"""The suite: progress of each renderer over its cost, significant differences, and the cost of a run in each set."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bench.report.study import Result, Runs, Selection, chart, figure_style, format, merge_runs, table
from bench.report.suite import standing
from bench.report.suite.attempts import EXPERIMENT_PREFIX, PROBLEM_SETTINGS, attempts_folder, gather, suite
from bench.report.suite.standing import ALPHA, AREA, AT_1, AT_10, AT_SECONDS, BUDGETS, END, OUTCOMES, Ranking, Standing
from bench.report.write import paper
from bench.report.write.table import percent

PLACE = 1
KEEPS = attempts_folder
READS = tuple(
    Selection(f"{EXPERIMENT_PREFIX}{name}", tuple(key for key, _ in PROBLEM_SETTINGS.values()))
    for name in suite().errors
)
HEADINGS = {
    AT_1: "At 1 ×",
    AT_10: "At 10 ×",
    END: "At the end",
    AREA: "Mean, 0.3 × to 30 ×",
    AT_SECONDS: "In DIST's runtime",
}
COST = "field evaluations, DIST run = 1"
PROGRESS = (
    "Progress is 1 - log(error / best possible error) / log(initial error / best possible error), limited to 0 to "
    "100 %. All problem sets have the same weight. A failed run has a progress of 0 %.",
    "Cost: field evaluations relative to the whole DIST run of the same problem; a gradient counts as two. Progress at "
    "a cost is interpolated between the checkpoints of a run that may be longer; a shorter run has its final progress. "
    "Runs end after the iterations, or at the cost limit, of their problem set.",
    "The best possible error is the error of the prior's fit to the ground truth (complete, multiview), 0.1 degrees "
    "(pose), or the best result of the shipped renderers (reconstruct).",
    f"Significant: by a sign-flip test over scenes, with Holm's correction over all pairs at {ALPHA:g}. In simulated "
    "draws of equal renderers, 3 to 5 % have a false significant pair at these costs, and 12 % at the end.",
)
WRONG_PIXELS = (
    "Wrong pixels are missed, spurious, or more than 0.02 scene units off in depth, relative to the object's pixels, "
    "on the prior's networks. Progress does not include them. All runs are on a CPU, with small networks and images."
)


def make(*several: Runs | None) -> Result:
    """Charts of all sets together and of each set, and a line per row."""
    runs = merge_runs(*several)
    gathered = gather(paper.SHIPPED, runs.results_dir, runs.records)
    made = Standing(gathered)
    panels = [_panel(made, name) for name in (None, *made.sets)]
    ranks = {
        HEADINGS[name].removeprefix("At "): {row: made.rankings[name].rank(row) for row in made.rows}
        for name in BUDGETS
    }
    return Result(
        replace(runs, records=[], left_out=Counter()),  # kept attempts count even if their run folders are gone
        "The suite.",
        "Progress of each renderer from the initial to the best possible error, over its cost; in brackets, its "
        "possible ranks. A cross: all runs failed.",
        question="Which renderer makes the most progress, and at what cost?",
        verdict=verdict(made),
        n=_sample(made),
        interval="simultaneous 95 % ranks (sign-flip test over scenes, Holm's correction over all pairs)",
        remarks=[*PROGRESS, WRONG_PIXELS, *_notes(made), *(f"Not read: {problem}" for problem in gathered.problems)],
        columns=[
            table.text("row", "Renderer"),
            *(table.Column(name, HEADINGS[name], words=partial(_progress, name=name)) for name in OUTCOMES),
            *(table.text(f"{name}_rank") for name in OUTCOMES),
            *(table.Column("cost", "Cost of a run"), table.Column("wrong", "Wrong pixels", show=table.small_percent)),
            *(table.text("failed", "Failed"), table.PRESET),
        ],
        lines=_lines(made),
        figure=draw(panels, ranks),
        chart={"panels": panels},
    )


def make_sets(*several: Runs | None) -> Result:
    """A line per set and row, with the cost of a whole run relative to DIST's; also for tuned rows."""
    runs = merge_runs(*several)
    made = Standing(gather(paper.SHIPPED, runs.results_dir, runs.records))
    reached = made.reached[made.reached["complete"] | made.reached["tuned"]]
    pairs, groups = standing.timed(made.complete, made.everything), reached.groupby(["set", "row"])
    lines = groups[[*BUDGETS]].mean().join(groups["preset"].first()).join(standing.costs(reached, pairs))
    lines = lines.join(pairs.groupby(["set", "row"])[AT_SECONDS].mean())
    for of_set, name in ((of_set, name) for of_set in made.sets for name in (*BUDGETS, AT_SECONDS)):
        measured = pairs if name == AT_SECONDS else reached
        rows = standing.rows_with_few_checkpoints(measured[measured["set"] == of_set], name)
        lines.loc[lines.index.isin([(of_set, row) for row in rows]), name] = np.nan
    order = [*made.sets, *made.rows, *reached["row"].unique()]
    lines = lines.sort_index(key=lambda names: names.map(order.index)).reset_index()
    lines = lines.astype(object).where(lines.notna(), None)
    ranked, sets = standing.ranking(pairs, AT_SECONDS), " and ".join(pairs["set"].unique())
    seconds = {row: cost.value for row, cost in zip(lines["row"], lines["seconds"], strict=True) if cost}
    scenes = format.plural(ranked.scenes, "scene")
    return Result(
        replace(runs, records=[], left_out=Counter()),
        "The suite, set by set.",
        "Progress of each renderer in each problem set, and costs of a whole run relative to DIST on the same problem.",
        question="What does a run of each renderer cost, and how much progress fits in the runtime of one DIST run?",
        verdict=sets
        and f"{leaders(ranked, f'In {sets}, in the runtime of one DIST run')} "
        + format.ends("Runtime of a run relative to DIST", seconds, scenes),
        n=_sample(made),
        interval="medians over scenes with 95 % intervals (of the sign test)",
        estimates=[*lines["evaluations"].dropna()],
        remarks=[
            *PROGRESS,
            f"Only in {sets or 'no set'}, all renderers were timed on a machine without other load. Field evaluations "
            f"and runtimes there are from the same runs. Engine: {', '.join(pairs['kernels'].unique()) or 'none'}.",
            f"In the runtime of one DIST run, {len(ranked.better)} of {ranked.pairs} pairs differ significantly.",
            "Tuned: the settings of conf/tuned.yaml, chosen on validation shapes. They may have another silhouette "
            "loss. The effects of settings and loss are not separated.",
        ],
        columns=[
            *(table.text("set", "Set"), table.text("row", "Renderer")),
            *(table.Column(name, HEADINGS[name], show=percent) for name in (*BUDGETS, AT_SECONDS)),
            *table.estimate("evaluations", "Field evaluations of a run, DIST = 1", ends="evaluations_"),
            *table.estimate("seconds", "Runtime of a run, DIST = 1", ends="seconds_"),
            *(table.Column("scenes", "Scenes", show=table.integer), table.PRESET),
        ],
        lines=lines.to_dict("records"),
    )


def _lines(made: Standing) -> list[dict[str, Any]]:
    wrong, lines = standing.wrong_pixels(made.compared), []
    for row in made.rows:
        runs = made.complete[made.complete["row"] == row]
        line = {"row": row, "preset": runs["preset"].iloc[0], "cost": made.costs[row], "wrong": wrong.get(row)}
        for name, ranked in made.rankings.items():
            line[f"{name}_rank"] = ranked.rank(row)
            line[name] = None if row in made.hidden[name] else ranked.progress[row]
        failed = runs[~runs["ok"]].groupby(["set", "status"]).size()
        counts = [f"{n} of {(runs['set'] == name).sum()} {name} ({status})" for (name, status), n in failed.items()]
        lines.append(line | {"failed": ", ".join(counts)})
    return lines


def _progress(line: dict[str, Any], name: str) -> str:
    return f"{percent(line[name])} ({line[f'{name}_rank']})"


def _sample(made: Standing) -> str:
    """The numbers of problems, scenes, seeds, renderers and failures, for captions."""
    problems = format.plural(len(made.complete.groupby(["set", "problem"])), "problem")
    scenes, seeds = (format.plural(made.complete[name].nunique(), name) for name in ("scene", "seed"))
    failed, runs = (~made.complete["ok"]).sum(), format.plural(len(made.complete), "run")
    renderers = format.plural(len(made.rows), "renderer")
    return f"{problems} ({scenes}, {seeds}) of {suite().id}, {renderers}; {failed or 'none'} of {runs} failed"


def _panel(made: Standing, of_set: str | None) -> chart.Panel:
    """The progress of each row over its cost, in one set or in all sets."""
    runs = made.complete if of_set is None else made.complete[made.complete["set"] == of_set]
    lines = [line for row in made.rows if (line := _line(runs[(runs["row"] == row) & (runs["unit"] > 0)]))]
    title = f"{of_set or 'Progress over cost, all sets'}, {format.plural(runs['scene'].nunique(), 'scene')}"
    panel = chart.panel_data(title, COST, "progress", lines)
    panel["x"]["log"], panel["y"]["log"] = True, False
    return panel


def _line(runs: pd.DataFrame) -> chart.Series | None:
    """The mean progress of a row's runs, up to the median of their costs; None for runs without cost."""
    end = float((runs["cost"] / runs["unit"]).median()) if len(runs) else 0.0
    if not end:
        return None
    costs = np.geomspace(min(0.05, end), end, 80)
    curves = pd.Series([np.interp(costs, *standing.progress_curve(run)) for run in runs.itertuples()], runs.index)
    mean = np.mean([np.mean([*group], axis=0) for _, group in curves.groupby(runs["set"])], axis=0)
    mean[-1] = runs.groupby("set")[END].mean().mean()
    failed = not runs["ok"].any()
    return chart.curve(runs["row"].iloc[0], runs["preset"].iloc[0], costs, mean, symbol="", failed=failed)


@figure_style.styled
def draw(panels: Sequence[chart.Panel], ranks: Mapping[str, Mapping[str, str]]) -> Figure:
    """Draws the first panel large, with the names of its lines, the ranks to its right, and the other panels below.

    Args:
        panels: fractions from 0 to 1 over costs, on a logarithmic axis.
        ranks: by their titles, the rank of each row, such as 5, or the ranks that it can have, such as 1–4.
    """
    figure = Figure(figsize=(figure_style.WIDTH, 5.6), layout="constrained")
    above, below = figure.subfigures(2, 1, height_ratios=(1.55, 1))
    lead, *others = above.subplots(1, 1 + len(ranks), width_ratios=(5.6, *[1.0] * len(ranks)))
    _fractions(lead, panels[0])
    lead.set_title(panels[0]["title"], loc="left", pad=46)  # points, above the names
    _name_lines(lead, panels[0]["series"])
    for axis, (title, rows) in zip(others, ranks.items(), strict=True):
        _ranks(axis, title, rows, panels[0]["series"], named=axis is others[0])
    small = below.subplots(1, max(len(panels) - 1, 1), sharey=True, squeeze=False)[0]
    for axis, panel in zip(small, panels[1:], strict=False):
        _fractions(axis, panel)
        axis.set_title(panel["title"], loc="left")
    below.supxlabel(panels[0]["x"]["title"], fontsize=lead.yaxis.label.get_size())
    return figure


def _fractions(axis: Axes, panel: chart.Panel) -> None:
    """Draws lines of fractions, with a point at the end of each, or a cross if the row failed."""
    for line in panel["series"]:
        axis.plot(line["x"], line["y"], color=line["colour"], ls=line["dash"])
        end = {"marker": "x" if line.get("failed") else "o", "color": line["colour"], "clip_on": False, "zorder": 3}
        axis.plot(line["x"][-1], line["y"][-1], **end)
    costs = [cost for line in panel["series"] for cost in (line["x"][0], 1.6 * line["x"][-1])]
    axis.set(xscale="log", xlim=(min(costs, default=0.1), max(costs, default=10.0)), ylim=(0, 1))
    axis.minorticks_off()
    axis.xaxis.set_major_formatter(lambda cost, _: f"{cost:g} ×")
    axis.set_yticks([0, 0.25, 0.5, 0.75, 1], ["initial error", "25 %", "50 %", "75 %", "best possible"])


def _name_lines(axis: Axes, lines: Sequence[chart.Series]) -> None:
    """Writes the name of each line above the axes, joined to its end; next to its end if that is below 0.5."""
    above, across = axis.get_xaxis_transform(), axis.transScale + axis.transLimits
    position = -1.0
    for line in sorted(lines, key=lambda line: line["x"][-1]):
        end, name = (line["x"][-1], line["y"][-1]), line["name"].partition(",")[0]
        look = {"color": line["colour"], "fontsize": figure_style.RC["legend.fontsize"]}
        if end[1] < 0.5:
            axis.annotate(name, end, (4, 0), textcoords="offset points", va="center", **look)
            continue
        position = max(across.transform(end)[0], position + 0.08)  # at least this fraction of the width between names
        cost = across.inverted().transform((position, 0))[0]
        axis.plot([end[0], cost], [end[1], 1.02], transform=above, lw=0.6, color=line["colour"], clip_on=False)
        axis.text(cost, 1.03, name, transform=above, rotation=40, rotation_mode="anchor", **look)


def _ranks(axis: Axes, title: str, rows: Mapping[str, str], lines: Sequence[chart.Series], *, named: bool) -> None:
    """Draws the ranks that each row can have as a bar."""
    for number, line in enumerate(lines):
        low, *_, high = [int(rank) for rank in 2 * rows[line["name"]].split("–")]
        axis.barh(number, high - low + 0.7, left=low - 0.35, height=0.55, color=line["colour"])
    count = len(lines)
    axis.set(xlim=(0.3, count + 0.7), ylim=(count - 0.4, -0.6), xticks=[1, count], xlabel="rank")
    axis.set_title(title, loc="left")
    axis.set_yticks(range(count), [line["name"].partition(",")[0] if named else "" for line in lines])
    for label, line in zip(axis.get_yticklabels(), lines, strict=True):
        label.set_color(line["colour"])
    axis.tick_params(axis="y", length=0)
    axis.grid(False, axis="y")


def verdict(made: Standing) -> str:
    """The verdict by rule: leaders at the cost of one run of DIST, differences at the end, failures."""
    if len(made.rows) < 2:
        return ""
    if not made.rankings[END].decidable:
        scenes = format.plural(made.rankings[END].scenes, "scene")
        return f"{scenes} cannot decide between {len(made.rows)} renderers, whatever their results. {failures(made)}"
    return " ".join([leaders(made.rankings[AT_1]), at_end(made), failures(made)])


def leaders(ranked: Ranking, when: str = "At the cost of one DIST run") -> str:
    """The rows that no row significantly beats, if they beat all others; else the first row."""
    if not ranked.decidable:
        return f"{when}, no decision is possible with {format.plural(ranked.scenes, 'scene')}."
    beaten = {second for _, second in ranked.better}
    first = [row for row in ranked.progress if row not in beaten]
    rows = [f"{row} (*{percent(ranked.progress[row])}*)" for row in first]
    if beaten and all((row, other) in ranked.better for row in first for other in beaten):
        more = f"significantly more progress than the {format.plural(len(beaten), 'other')}"
        if len(first) == 1:
            return f"{when}, {rows[0]} makes {more}."
        return f"{when}, {', '.join(rows[:-1])} and {rows[-1]} make {more}. These {len(rows)} cannot be distinguished."
    behind = [row for row in ranked.progress if (first[0], row) in ranked.better]
    less = f"{format.plural(len(behind), 'other')}: {'; '.join(behind)}"
    than = f"significantly more than {less}" if behind else "and cannot be distinguished from any other"
    return f"{when}, {rows[0]} makes the most progress, {than}."


def at_end(made: Standing) -> str:
    """The number of significantly different pairs at the end of the runs, and the cost of a run."""
    rows = min(made.costs, key=made.costs.__getitem__), max(made.costs, key=made.costs.__getitem__)
    pairs = f"{len(made.rankings[END].better) or 'none'} of {made.rankings[END].pairs} pairs"
    costs = " to ".join(f"*{made.costs[row]:.2g}* ({row})" for row in rows)
    return f"At the end of the runs, {pairs} differ significantly. A run costs {costs} times a DIST run."


def failures(made: Standing) -> str:
    """The rows that failed in most problems of a set, and the number of other failures."""
    groups = made.complete.groupby(["row", "set"])["ok"].agg(runs="size", failed=lambda ok: (~ok).sum())
    most = groups[2 * groups["failed"] > groups["runs"]]
    failed, runs = (total - most["failed"].sum() for total in (groups["failed"].sum(), len(made.complete)))
    if most.empty:
        return f"{failed or 'None'} of {runs} runs failed."
    names = [
        f"{row} failed in {line.failed} of {line.runs} problems of {name}" for (row, name), line in most.iterrows()
    ]
    return f"{'; '.join(names)}; {failed or 'none'} of the other {runs} runs failed."


def _notes(made: Standing) -> list[str]:
    """Notes that depend on the runs: missing numbers, bounds, the order without each set, machines."""
    runs, notes = made.complete, []
    if (rows := made.hidden[AT_1]) and made.rankings[AT_1].decidable:
        later = runs.assign(**{AT_1: runs[AT_1].where(~runs["row"].isin(rows), runs[f"{AT_1}_next"])})
        ranked = standing.ranking(later, AT_1)
        notes.append(
            f"A dash: in some set, fewer than {standing.MIN_CHECKPOINTS} checkpoints lie within that cost, and the "
            "ranks use interpolated progress. With the progress of the next checkpoint, "
            f"{len(ranked.better)} pairs differ significantly at 1 ×, instead of {len(made.rankings[AT_1].better)}. "
            f"{leaders(ranked, 'Then')}"
        )
    counts = ", ".join(f"{len(ranked.better)} ({HEADINGS[name].lower()})" for name, ranked in made.rankings.items())
    end = made.rankings[END]
    least = f"The smallest p at the end is {end.least_p:.2g}; significance needs {ALPHA / max(end.pairs, 1):.2g}."
    notes.append(f"Significantly different pairs, of {end.pairs}: {counts}. {least}")
    for name in made.sets:
        if ends := standing.bounds(runs, name):
            notes.append(
                f"In {name}, every renderer's mean final error is {ends[0]:.2f} to {ends[1]:.2f} times DIST's "
                "error (geometric means over scenes, simultaneous 95 % intervals of the sign-flip test)."
            )
    for name in made.sets if len(made.sets) > 1 else ():
        first, end = (standing.ranking(runs[runs["set"] != name], outcome) for outcome in (AT_1, END))
        notes.append(
            f"{leaders(first, f'Without {name}, at 1 ×')} The order is: {'; '.join(first.progress)}. Pairs that "
            f"differ significantly at the end: {len(end.better)}. First there: {'; '.join([*end.progress][:3])}."
        )
    if made.lacking:
        rows = ", ".join(f"{row} ({format.plural(count, 'problem')})" for row, count in made.lacking.items())
        notes.append(f"Not compared, because runs are missing: {rows}.")
    machines, loaded = runs.loc[runs["cpu"] != "", "machine"].nunique(), (~runs["timed"]).sum()
    code = f"{format.plural(runs['code'].nunique(), 'version')} of the code, {machines} machines or engines"
    notes.append(f"Runs: {code}; {loaded} of {len(runs)} have no runtime, because the machine had other load.")
    return [note.replace("*", "") for note in notes]  # without the marks of numbers in verdicts


PAGES = {"suite": make, "suite_sets": make_sets}
