"""The suite: progress of each renderer at equal costs, significant differences, and its progress in each set."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from bench.report.study import Result, Runs, chart, figure_style, format, merge_runs, statistics, table
from bench.report.suite import standing
from bench.report.suite.attempts import (
    SECOND_START_NOISE,
    attempts_folder,
    gather,
    selections,
    suite,
)
from bench.report.suite.bias import PRINTED_FACTOR, bias_notes, depth_biases, scaled
from bench.report.suite.standing import ALPHA, KEY, MAX_LEVEL, Standing, units
from bench.report.suite.verdicts import leaders, undecided
from bench.report.write import paper
from bench.report.write.table import percent

PLACE = 1
KEEPS = attempts_folder
READS = selections()
COST = "field evaluations, in units"
CANNOT_RUN = "cannot run"
MENTIONED_FRACTION_OF_LARGER_ERRORS = 0.05
MENTIONED_CHANGE_OF_PROGRESS = 0.05
NEAR_DIST = (0.8, 1.25)  # ratios of errors to DIST's; bounds outside of them say little and are not shown
UNITS = ", ".join(f"{unit:.2g} ({name})" for name, unit in suite().units.items())
PROGRESS = (
    "Every run spends the same number of field evaluations, whatever the number of its iterations. A gradient counts "
    f"as two. One unit of cost is, in field evaluations: {UNITS}. In reconstruct, colours and second derivatives are "
    "not counted. A surface has one colour per hit, a volume one per sample.",
    "Progress is 1 - log(error / best possible error) / log(initial error / best possible error), limited to 0 to "
    "100 %. All problem sets have the same weight. A failed run has a progress of 0 %.",
    "The best possible error is no renderer's: the error of the prior's fit to the true distances (complete, "
    "multiview, area), of the same network's fit to them (reconstruct), or 0.1 degrees (pose). For shapes, most of "
    "it is the distance between two samplings of 10,000 points: smaller differences of surfaces are not seen.",
    "Each iteration compares all pixels, or a random one of each block of 2, 4 or 8 pixels per side: the smallest "
    "block with which the budget pays for 40 iterations at their initial cost, else the largest. In reconstruct, it "
    "draws 256 rays, or 256 divided by the pixels of such a block. With fewer than 10 iterations, a run has no result. "
    "A renderer for which most runs of a set have none cannot run at this budget, and is not compared.",
    "Learning rates, blurs, samples and sharpness follow the fraction of the budget that is spent. So a run over 10 "
    "units is not the continuation of a run over 1 unit. In a set, all renderers have one learning rate. Except in "
    "area, they have one silhouette loss. Both were chosen in runs of fixed length: 100 iterations in complete, 200 "
    "in reconstruct. Pose and multiview have the defaults of their tasks, multiview without a silhouette loss.",
    "Area is multiview with four rays per pixel. Masks state the fraction of each pixel that the shape covers. "
    "Renderers with opacities compare areas, the others have DIST's mask loss. The weights of both losses were chosen "
    "on four validation shapes, for the relaxed boundary and NeuS.",
    "Significant: by a sign-flip test over scenes, with Holm's correction over all pairs of a budget at "
    f"{percent(ALPHA)}. If more than {100 * MAX_LEVEL:.1f} % of simulated draws of equal renderers have a false pair "
    "at that level, no pair counts as significant. All scenes are of four families of shapes, so the test covers no "
    "others.",
)

BIAS = (
    "Depth bias: the median over pixels of the final surface's depth minus the true one, in scene units. It is "
    "negative in front of the true surface. The table has its median over scenes. A small systematic error of hits "
    "shows there, and not in the final error. Sign tests over scenes compare rows with DIST, with Holm's correction "
    f"over rows and sets of a budget at {percent(statistics.ALPHA)}."
)
TUNED = (
    "Tuned: each renderer with its own learning rate and rays, chosen on validation shapes. With fewer problems than "
    "other rows of its set, such a row is not comparable with them: the page suite_tuned compares the same problems."
)


def make(*several: Runs | None) -> Result:
    runs = merge_runs(*several)
    gathered = gather(paper.SHIPPED, runs.results_dir, runs.records)
    made = Standing(gathered)
    panels = [_panel(made, name) for name in (None, *made.sets)]
    ranks = {
        units(budget): {row: ranked.rank(row) for row in ranked.progress} for budget, ranked in made.rankings.items()
    }
    return Result(
        replace(runs, records=[], left_out=Counter()),  # kept attempts count even if their run folders are gone
        "The suite.",
        "Progress of each renderer from the initial to the best possible error, at equal costs; in brackets, its "
        "possible ranks. Each budget has its own runs, so a renderer has a line per budget. A cross: all runs failed. "
        "A dash: no rank.",
        question="Which renderer makes the most progress, at the same cost?",
        verdict=verdict(made),
        n=_sample(made),
        interval="simultaneous 95 % ranks (sign-flip test over scenes, Holm's correction over all pairs)",
        remarks=[*PROGRESS, *_notes(made), *(f"Not read: {problem}" for problem in gathered.problems)],
        columns=[
            table.text("row", "Renderer"),
            *(table.Column(f"{b:g}", f"At {_when(made, b)}", words=partial(_progress, budget=b)) for b in made.budgets),
            *(table.text(f"{b:g}_rank") for b in made.budgets),
            *(table.text("failed", "Failed"), table.PRESET),
        ],
        lines=_lines(made),
        figure=draw(panels, ranks),
        chart={"panels": panels},
    )


def make_sets(*several: Runs | None) -> Result:
    """A line per set and row: progress, iterations and rays at each budget, and the runtime; also for tuned rows."""
    runs = merge_runs(*several)
    made = Standing(gather(paper.SHIPPED, runs.results_dir, runs.records))
    reached = made.reached[made.reached["complete"] | made.reached["tuned"]]
    groups, per_budget = reached.groupby(["set", "row"]), reached.groupby(["budget", "set", "row"])
    lines = groups.agg(preset=("preset", "first"), problems=("problem", "nunique"))
    for name, statistic in (("progress", "mean"), ("iterations", "median"), ("rays", "median")):
        values = per_budget[name].agg(statistic).unstack("budget")
        lines = lines.join(values.rename(columns=lambda budget, name=name: f"{name}_{budget:g}"))
    biases = depth_biases(made.complete)
    by_budget = biases.set_index(["budget", "set", "row"])["bias"].unstack("budget")
    lines = lines.join(by_budget.rename(columns=lambda budget: f"bias_{budget:g}"))
    lines = lines.join(standing.seconds_per_unit(made.everything))
    order = [*made.sets, *made.rows, *reached["row"].unique()]
    lines = lines.sort_index(key=lambda names: names.map(order.index)).reset_index()
    lines = lines.astype(object).where(lines.notna(), None)
    budgets = made.budgets
    return Result(
        replace(runs, records=[], left_out=Counter()),
        "The suite, set by set.",
        "Progress of each renderer in each problem set, iterations and rays that its budget pays for, and runtime.",
        question="How much progress does each renderer make in each set, and how long does a unit of cost take?",
        verdict=_first_of_sets(made),
        n=_sample(made),
        remarks=[
            *PROGRESS,
            "The test is over all sets together, so this page has no intervals.",
            "Iterations and rays are medians over problems. In multiview, neighbouring views count as one ray per "
            "pixel. Runtimes are medians over runs at 1 unit on a machine without other load: "
            f"{format.plural(int(lines['timed'].sum()), 'run')}, others are not timed.",
            *([TUNED] if reached["tuned"].any() else []),
            *([BIAS, *bias_notes(biases)] if len(biases) else []),
        ],
        columns=[
            *(table.text("set", "Set"), table.text("row", "Renderer")),
            table.Column("problems", "Problems", show=table.integer),
            *(table.Column(f"progress_{b:g}", f"At {units(b)}", show=percent) for b in budgets),
            *(table.Column(f"iterations_{b:g}", f"Iterations, at {units(b)}", show=table.integer) for b in budgets),
            *(table.Column(f"rays_{b:g}", f"Rays, at {units(b)}", show=table.integer) for b in budgets),
            *(
                table.Column(f"bias_{b:g}", f"Depth bias × {PRINTED_FACTOR:g}, at {units(b)}", show=scaled)
                for b in by_budget
            ),
            table.Column("seconds", "Runtime of 1 unit (s)"),
            *(table.Column("timed", "Timed runs", show=table.integer), table.PRESET),
        ],
        lines=lines.to_dict("records"),
    )


def _lines(made: Standing) -> list[dict[str, Any]]:
    lines = []
    for row in made.rows:
        runs = made.complete[made.complete["row"] == row]
        line = {"row": row, "preset": made.compared.loc[made.compared["row"] == row, "preset"].iloc[0]}
        for budget, ranked in made.rankings.items():
            if row in ranked.progress:
                line |= {f"{budget:g}": ranked.progress[row], f"{budget:g}_rank": ranked.rank(row)}
            elif (budget, row) in made.cannot_run:
                line[f"{budget:g}_rank"] = CANNOT_RUN
        counts = [CANNOT_RUN for _, name in made.cannot_run if name == row]
        for budget, group in runs.groupby("budget"):
            if failed := (~group["ok"]).sum():
                counts.append(f"{failed} of {len(group)} at {units(budget)}")
        lines.append(line | {"failed": "; ".join(counts)})
    return lines


def _progress(line: dict[str, Any], budget: float) -> str:
    value, rank = line.get(f"{budget:g}"), line.get(f"{budget:g}_rank", "")
    return rank if value is None else f"{percent(value)} ({rank})"


def _sample(made: Standing) -> str:
    parts = []
    for budget, runs in made.complete.groupby("budget"):
        problems = format.plural(len(runs.groupby(["set", "problem"])), "problem")
        scenes, renderers = (
            format.plural(runs[name].nunique(), word) for name, word in (("scene", "scene"), ("row", "renderer"))
        )
        failed = f"{(~runs['ok']).sum() or 'none'} failed"
        count = format.plural(len(runs), "run")
        parts.append(f"{count} at {_when(made, budget)}: {problems} of {scenes}, {renderers}, {failed}")
    return f"{'; '.join(parts) or 'no runs'}; suite {suite().id}"


def _sets_at(made: Standing, budget: float) -> list[str]:
    at_budget = {*made.complete.loc[made.complete["budget"] == budget, "set"]}
    return [name for name in made.sets if name in at_budget]


def _when(made: Standing, budget: float) -> str:
    """The budget, with the sets that have it, or the fewer ones that lack it, unless it has all."""
    sets = _sets_at(made, budget)
    missing = [name for name in made.sets if name not in sets]
    named = f"without {', '.join(missing)}" if len(missing) < len(sets) else ", ".join(sets)
    return units(budget) + (f" ({named})" if missing else "")


def _panel(made: Standing, of_set: str | None) -> chart.Panel:
    runs = made.complete if of_set is None else made.complete[made.complete["set"] == of_set]
    groups = runs.groupby(["budget", "row"])
    lines = [
        _line(groups.get_group(key))
        for key in ((b, row) for b in made.budgets for row in made.rows)
        if key in groups.groups
    ]
    counts = runs.groupby("budget")["scene"].nunique()
    fewer = [f", {count} at {units(float(b))}" for b, count in counts.items() if count < counts.max()]
    scenes = format.plural(int(counts.max() if len(counts) else 0), "scene")
    sets = ", all sets" if all(_sets_at(made, budget) == made.sets for budget in made.budgets) else ""
    is_whole = counts.equals(made.complete.groupby("budget")["scene"].nunique().reindex(counts.index))
    of_part = f"{of_set}{'' if is_whole else f', {scenes}'}"
    title = of_part if of_set else f"Progress over cost{sets}, {scenes}{''.join(fewer)}"
    panel = chart.panel_data(title, COST, "progress", lines)
    panel["x"]["log"], panel["y"]["log"] = True, False
    return panel


def _line(runs: pd.DataFrame) -> chart.Series:
    budget = float(runs["budget"].iloc[0])
    costs = budget * np.geomspace(0.03, 1, 40)
    curves = pd.Series([np.interp(costs, *standing.progress_curve(run)) for run in runs.itertuples()], runs.index)
    mean = np.mean([np.mean([*group], axis=0) for _, group in curves.groupby(runs["set"])], axis=0)
    # The last step exceeds the budget, so the curve would miss its end.
    mean[-1] = runs.groupby("set")["progress"].mean().mean()
    failed = not runs["ok"].any()
    return chart.curve(runs["row"].iloc[0], runs["preset"].iloc[0], costs, mean, symbol="", failed=failed)


@figure_style.styled
def draw(panels: Sequence[chart.Panel], ranks: Mapping[str, Mapping[str, str]]) -> Figure:
    """Draws the first panel large, to its right the names of its lines with their ranks, and the other panels below.

    Args:
        panels: fractions from 0 to 1 over costs, on a logarithmic axis.
        ranks: by panel title, the rank of each row as text: one rank (5), or a range (1–4).
    """
    figure = Figure(figsize=(figure_style.WIDTH, 5.6), layout="constrained")
    above, below = figure.subfigures(2, 1, height_ratios=(1.55, 1))
    widths = 5.2, 0.4, *[1.0] * len(ranks)
    lead, key, *others = above.subplots(1, len(widths), width_ratios=widths, squeeze=False)[0]
    _fractions(lead, panels[0])
    lead.set_title(panels[0]["title"], loc="left")
    lead.set_ylabel(panels[0]["y"]["title"])
    lines = [*{line["name"]: line for line in panels[0]["series"]}.values()]
    _names(key, lines)
    for axis, (title, rows) in zip(others, ranks.items(), strict=True):
        _ranks(axis, title, rows, lines)
    small = below.subplots(1, max(len(panels) - 1, 1), sharey=True, squeeze=False)[0]
    for axis, panel in zip(small, panels[1:], strict=False):
        _fractions(axis, panel)
        axis.set_title(panel["title"], loc="left")
    small[0].set_ylabel(panels[0]["y"]["title"])
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
    axis.xaxis.set_major_formatter(lambda cost, _: f"{cost:g}")
    axis.set_yticks([0, 0.25, 0.5, 0.75, 1], ["initial, 0 %", "25 %", "50 %", "75 %", "best, 100 %"])


def _names(axis: Axes, lines: Sequence[chart.Series]) -> None:
    """Draws a piece of each line, with its name."""
    for number, line in enumerate(lines):
        axis.plot([0, 1], [number, number], color=line["colour"], ls=line["dash"])
    _rows(axis, [line["name"].partition(",")[0] for line in lines])
    for label, line in zip(axis.get_yticklabels(), lines, strict=True):
        label.set_color(line["colour"])
    axis.spines[:].set_visible(False)
    axis.set_xticks([])


def _rows(axis: Axes, names: Sequence[str]) -> None:
    axis.set_ylim(len(names) - 0.4, -0.6)
    axis.set_yticks(range(len(names)), names)
    axis.tick_params(axis="y", length=0)
    axis.grid(False, axis="y")


def _ranks(axis: Axes, title: str, rows: Mapping[str, str], lines: Sequence[chart.Series]) -> None:
    for number, line in enumerate(lines):
        if line["name"] not in rows:
            axis.text(0.7, number, "–", color=line["colour"], va="center_baseline")
            continue
        ends = [int(rank) for rank in rows[line["name"]].split("–")]
        low, high = ends[0], ends[-1]
        axis.barh(number, high - low + 0.7, left=low - 0.35, height=0.55, color=line["colour"])
    count = len(lines)
    axis.set(xlim=(0.3, count + 0.7), xticks=[1, count], xlabel="rank")
    axis.set_title(title, loc="left")
    _rows(axis, [""] * count)


def verdict(made: Standing) -> str:
    """The verdict by rule: the leaders and the number of different pairs at each budget, and failures."""
    if len(made.rows) < 2:
        return ""
    parts = []
    for budget, ranked in made.rankings.items():
        if ranked.decidable:
            pairs = f"{len(ranked.better) or 'None'} of {ranked.pairs} pairs"
            when = f"At {_when(made, budget)}"
            parts.append(f"{leaders(ranked, when)} {pairs} differ.")
        else:
            parts.append(undecided(ranked, f"At {units(budget)}"))
    return " ".join([*parts, failures(made)])


def failures(made: Standing) -> str:
    """The rows that failed in most problems of a set at a budget, and the number of other failures."""
    groups = made.complete.groupby(["row", "budget", "set"])["ok"].agg(runs="size", failed=lambda ok: (~ok).sum())
    most = groups[2 * groups["failed"] > groups["runs"]]
    failed, runs = (total - most["failed"].sum() for total in (groups["failed"].sum(), len(made.complete)))
    if most.empty:
        return f"{failed or 'None'} of {runs} runs failed."
    names = [
        f"{row} failed in {name} at "
        + " and ".join(f"{units(key[1])} ({line.failed} of {line.runs})" for key, line in at_budgets.iterrows())
        for (row, name), at_budgets in most.groupby(level=["row", "set"], sort=False)
    ]
    return f"{'; '.join(names)}; {failed or 'none'} of the {runs} other runs failed."


def _first_of_sets(made: Standing) -> str:
    means, firsts = made.complete.groupby(["budget", "set", "row"])["progress"].mean(), dict[float, list[str]]()
    for (budget, name), rows in means.groupby(["budget", "set"], sort=False):
        best = rows.droplevel(["budget", "set"])
        firsts.setdefault(budget, []).append(f"{name} *{percent(best.max())}* ({best.idxmax()})")
    most = (f"Most progress at {units(budget)}: {'; '.join(sets)}." for budget, sets in firsts.items())
    seconds = standing.seconds_per_unit(made.everything)["seconds"].dropna()
    ends = f"{format.seconds(seconds.min())} to {format.seconds(seconds.max())}" if len(seconds) else ""
    return " ".join([*most, *([f"A unit takes {ends} (median per set and renderer)."] if ends else [])])


def _notes(made: Standing) -> list[str]:
    """Notes that depend on the runs: the smallest p, bounds of errors, the order without each set, machines."""
    notes, runs = [], made.complete
    for budget, ranked in made.rankings.items():
        at_budget = runs[runs["budget"] == budget]
        required = f"Holm's correction first requires {ALPHA / max(ranked.pairs, 1):.2g}"
        least = f"The smallest p value is {ranked.least_p:.2g}. {required}"
        possible = (
            f"sign flips of {format.plural(ranked.scenes, 'scene')} cannot give less than {ranked.possible_p:.2g}"
        )
        pairs = f"{len(ranked.better)} of {ranked.pairs} pairs differ significantly"
        if ranked.level > MAX_LEVEL:
            pairs = f"no pair counts as significant, since {percent(ranked.level)} of simulated draws have a false pair"
        notes.append(f"At {units(budget)}, {pairs}. {least}; {possible}.")
        counts, totals = (each.groupby("set")["problem"].nunique() for each in (at_budget, runs))
        for name, count in counts[counts < totals.reindex(counts.index)].items():
            notes.append(f"At {units(budget)}, {name} has {count} of its {totals[name]} problems.")
        further = at_budget[at_budget["ok"] & (at_budget["final"] > at_budget["initial"])]
        counts = further.groupby("set").size() / at_budget[at_budget["ok"]].groupby("set").size()
        for name, fraction in counts[counts > MENTIONED_FRACTION_OF_LARGER_ERRORS].items():
            notes.append(
                f"At {units(budget)}, {percent(fraction)} of the runs of {name} that ended ok have a larger error at "
                "their end than at their start, although their loss fell. Their progress is 0 %."
            )
        for name in made.sets:
            ends = standing.bounds(at_budget[at_budget["set"] == name])
            if ends and NEAR_DIST[0] <= ends[0] <= ends[1] <= NEAR_DIST[1]:
                notes.append(
                    f"At {units(budget)}, in {name}, mean final errors are {ends[0]:.2f} to {ends[1]:.2f} times DIST's "
                    "(geometric means over scenes, simultaneous 95 % intervals). Renderers that failed in more than "
                    "half of their runs are left out. Other failed runs count with their initial error."
                )
        if text := _second_starts(made, budget):
            notes.append(text)
        for name in sets if len(sets := _sets_at(made, budget)) > 1 else ():
            others = standing.verified_ranking(at_budget[at_budget["set"] != name])
            if ranked.decidable and others.decidable:
                lead = leaders(others, f"Without the set {name}, at {units(budget)}")
                order = f"The order is: {'; '.join(others.progress)}. Different pairs: {len(others.better)}."
                notes.append(f"{lead} {order}")
    for (budget, row), sets in made.cannot_run.items():
        notes.append(f"At {units(budget)}, {row} cannot run in {sets}.")
    if made.other_settings:
        rows = ", ".join(f"{row} ({format.plural(n, 'run')})" for row, n in made.other_settings.items())
        notes.append(f"Not compared, because their settings are not those of the set: {rows}.")
    over = (runs["cost"] / runs["set"].map(suite().units) / runs["budget"] - 1).groupby(runs["row"]).max()
    if len(over):
        notes.append(f"The last step may exceed the budget: by at most {percent(over.max())} ({over.idxmax()}).")
    if made.lacking:
        rows = ", ".join(f"{row} at {units(b)} ({format.plural(n, 'problem')})" for (b, row), n in made.lacking.items())
        notes.append(f"Not compared, because runs are missing: {rows}.")
    machines, loaded = runs.loc[runs["cpu"] != "", "machine"].nunique(), (~runs["timed"]).sum()
    versions, kinds = format.plural(runs["commit"].nunique(), "commit"), format.plural(machines, "machine")
    notes.append(f"The runs are of {versions} and {kinds}; other threads or kernels count as another machine.")
    notes.append(f"{loaded} of {len(runs)} runs have no runtime, because the machine had other load.")
    return [note.replace("*", "") for note in notes]  # without the marks of numbers in verdicts


def _second_starts(made: Standing, budget: float) -> str:
    """How much noise in the initial parameters changes the progress of runs; empty without second starts."""
    runs = made.second_starts[made.second_starts["budget"] == budget]
    changes = (runs["progress"] - runs["first"]).rename("change")
    moved = changes[runs[["progress", "first"]].max(axis=1) > 0].abs()
    if moved.empty:
        return ""
    large = percent((moved > MENTIONED_CHANGE_OF_PROGRESS).mean())
    of_sets = runs.assign(change=changes).groupby(["row", "set"])["change"].mean()
    means = of_sets.groupby("row").mean().abs()
    return (
        f"Sensitivity at {units(budget)}: {format.plural(len(runs), 'run')} have a second start, with noise of "
        f"{SECOND_START_NOISE:g} in the initial parameters. In {len(moved)} of these pairs, a run makes progress. The "
        f"progress of {large} of them differs by more than {100 * MENTIONED_CHANGE_OF_PROGRESS:g} points, and the "
        f"median difference is {100 * moved.median():.1f} points. The mean over sets of a renderer changes by at most "
        f"{100 * means.max():.1f} points ({means.idxmax()}), over {len(runs[KEY].drop_duplicates())} problems."
    )


PAGES = {"suite": make, "suite_sets": make_sets}
