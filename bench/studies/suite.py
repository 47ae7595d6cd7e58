"""The suite: how much progress each renderer makes over its cost, which differ, and what a run costs in each set."""

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pandas as pd

from bench.report.data.runs import together
from bench.report.study import Result, Runs, Selection, chart, format, table
from bench.report.suite import standing
from bench.report.suite.attempts import EXPERIMENT, GIVEN, gather, place, suite
from bench.report.suite.standing import AREA, AT_1, AT_10, AT_SECONDS, BUDGETS, END, OUTCOMES, Ranking, ranking
from bench.report.write import paper
from bench.report.write.table import percent

PLACE = 1
KEEPS = place
READS = tuple(Selection(f"{EXPERIMENT}{name}", tuple(key for key, _ in GIVEN.values())) for name in suite().errors)
HEADINGS = {
    AT_1: "At 1 ×",
    AT_10: "At 10 ×",
    END: "At the end",
    AREA: "Mean, 0.3 × to 30 ×",
    AT_SECONDS: "In DIST's time",
}
COST = "field evaluations, DIST's run = 1"
LEAST_COST, POINTS = 0.05, 80  # of a line of the chart
WIDEST_BOUNDS = 1.25  # bounds on ratios of errors that lie further off say little
PROGRESS = (
    "Progress: 1 - log(error / best possible) / log(initial error / best possible), from 0 to 100 %. Each set weighs "
    "the same. A failed run has made none.",
    "Costs are field evaluations over those of DIST's whole run at the same problem; a gradient counts as two. No run "
    "had such a cost as its budget: progress within a longer run is interpolated between checkpoints.",
)
NOTES = (
    *PROGRESS,
    "Best possible error: of complete and multiview the prior's fit to the truth, of pose 0.1 degrees. Of reconstruct "
    "it is the best result of these renderers themselves.",
    "Wrong pixels: of renderings of the prior's networks, over the object's pixels: missed, spurious, or 0.02 scene "
    "units off in depth. They are no part of progress. All runs are on a CPU, with small networks and images.",
)


class Standing:
    """What both pages are made of: the attempts, the compared ones, their progress, and the rankings by it."""

    def __init__(self, runs: Runs) -> None:
        self.gathered = gather(paper.SHIPPED, runs.results_dir, runs.records)
        self.everything = standing.frame_of(self.gathered.everything)
        self.compared = standing.compared(self.everything, self.gathered.size)
        self.reached = standing.reached(self.compared)
        self.rankings = {outcome: ranking(self.reached, outcome) for outcome in OUTCOMES}
        self.whole = self.reached[self.reached["whole"]]
        self.rows = [*self.rankings[AT_1].progress]
        self.sets = [name for name in suite().errors if name in {*self.whole["set"]}]

    def sample(self) -> str:
        """The numbers of problems, scenes, seeds, renderers and failures, for captions."""
        problems = format.plural(len(self.whole.groupby(["set", "problem"])), "problem")
        scenes, seeds = (format.plural(self.whole[name].nunique(), name) for name in ("scene", "seed"))
        failed, runs = (~self.whole["ok"]).sum(), format.plural(len(self.whole), "run")
        renderers = format.plural(len(self.rows), "renderer")
        return f"{problems} ({scenes}, {seeds}) of {suite().id}, {renderers}; {failed or 'none'} of {runs} failed"

    def lines(self) -> list[dict[str, Any]]:
        """What the table has of each row."""
        wrong, lines = standing.wrong_pixels(self.compared), []
        hidden = {name: standing.sparse(self.whole, name) for name in BUDGETS}
        for row in self.rows:
            own, line = self.whole[self.whole["row"] == row], dict[str, Any]()
            for name, ranked in self.rankings.items():
                line[f"{name}_rank"] = "–".join(dict.fromkeys(map(str, ranked.rank(row))))
                line[name] = None if row in hidden.get(name, ()) else ranked.progress[row]
            failed = own[~own["ok"]].groupby(["set", "status"]).size()
            counts = [f"{n} of {(own['set'] == of).sum()} {of} ({status})" for (of, status), n in failed.items()]
            line |= {"row": row, "preset": own["preset"].iloc[0], "wrong": wrong.get(row)}
            lines.append(line | {"cost": (own["cost"] / own["unit"]).median(), "failed": ", ".join(counts)})
        return lines

    def panel(self, of_set: str | None) -> chart.Panel:
        """The progress of each row over its cost, in one set or in all."""
        runs = self.whole if of_set is None else self.whole[self.whole["set"] == of_set]
        lines = [line for row in self.rows if (line := _line(runs[(runs["row"] == row) & (runs["unit"] > 0)]))]
        title = f"{of_set or 'Progress over cost, all sets'}, {format.plural(runs['scene'].nunique(), 'scene')}"
        panel = chart.panel_data(title, COST, "progress", lines)
        panel["x"]["log"], panel["y"]["log"] = True, False
        return panel


def _line(runs: pd.DataFrame) -> chart.Series | None:
    """The mean progress of a row's runs, to the median of their costs; none of runs that cost nothing."""
    end = float((runs["cost"] / runs["unit"]).median()) if len(runs) else 0.0
    if not end:
        return None
    costs = np.geomspace(min(LEAST_COST, end), end, POINTS)
    courses = pd.Series([np.interp(costs, *standing.course(run)) for run in runs.itertuples()], runs.index)
    mean = np.mean([np.mean([*group], axis=0) for _, group in courses.groupby(runs["set"])], axis=0)
    mean[-1] = runs.groupby("set")[END].mean().mean()
    return chart.curve(runs["row"].iloc[0], runs["preset"].iloc[0], costs, mean, symbol="")


def make(*several: Runs | None) -> Result:
    """The chart of all sets and of each, and a line per row."""
    runs = together(*several)
    made = Standing(runs)
    panels = [made.panel(name) for name in (None, *made.sets)]
    ranks = {HEADINGS[name]: {row: made.rankings[name].rank(row) for row in made.rows} for name in BUDGETS}
    return Result(
        replace(runs, records=[], left_out=0),  # what is kept counts, with or without its run
        "The suite.",
        "Progress of each renderer from the initial to the best possible error over its cost, with the ranks that it "
        "can have (in brackets). A cross: all runs failed.",
        question="Which renderer makes the most progress, and at what cost?",
        verdict=verdict(made),
        n=made.sample(),
        interval="ranks simultaneous at 95 % (flipped signs of scenes' differences, Holm's correction over all pairs)",
        remarks=[*NOTES, *_notes(made), *(f"Not read: {problem}" for problem in made.gathered.problems)],
        columns=_columns(),
        lines=made.lines(),
        figure=chart.draw_lead(panels, ranks),
        chart={"panels": panels},
    )


def make_sets(*several: Runs | None) -> Result:
    """A line per set and row, with what a whole run costs over DIST's; tuned rows too."""
    runs = together(*several)
    made = Standing(runs)
    reached = made.reached[made.reached["whole"] | made.reached["tuned"]]
    pairs, groups = standing.timed(made.whole, made.everything), reached.groupby(["set", "row"])
    lines = groups[[*BUDGETS]].mean().join(groups["preset"].first()).join(standing.costs(reached, pairs))
    lines = lines.join(pairs.groupby(["set", "row"])[AT_SECONDS].mean())
    for of_set, name in ((of_set, name) for of_set in made.sets for name in (*BUDGETS, AT_SECONDS)):
        measured = pairs if name == AT_SECONDS else reached
        rows = standing.sparse(measured[measured["set"] == of_set], name)
        lines.loc[lines.index.isin([(of_set, row) for row in rows]), name] = np.nan
    lines = lines.sort_index(key=lambda index: index.map([*made.sets, *made.rows, *reached["row"].unique()].index))
    lines = lines.reset_index().astype(object).where(lines.reset_index().notna(), None)
    ranked, sets = ranking(pairs, AT_SECONDS), " and ".join(pairs["set"].unique())
    seconds = {row: cost.value for row, cost in zip(lines["row"], lines["seconds"], strict=True) if cost}
    return Result(
        replace(runs, records=[], left_out=0),
        "The suite, set by set.",
        "Progress of each renderer in each set, and what a whole run costs over DIST's at the same problem.",
        question="What does a run of each renderer cost, and what progress does the time of one run of DIST give?",
        verdict=sets
        and f"{leaders(ranked, f'In {sets}, in the time of one run of DIST')} "
        + format.ends("Seconds of a run over DIST's", seconds, format.plural(ranked.scenes, "scene")),
        n=made.sample(),
        interval="medians over scenes with intervals of the sign test, 95 %",
        estimates=[*lines["evaluations"].dropna()],
        remarks=[
            *PROGRESS,
            f"All renderers were timed on a machine that was not loaded only in {sets or 'no set'}; field evaluations "
            f"and seconds there are of the same runs. Their engine: {', '.join(pairs['kernels'].unique()) or 'none'}.",
            f"In the time of one run of DIST {len(ranked.better)} of {ranked.pairs} pairs differ significantly.",
            "Tuned: with the setting of conf/tuned.yaml, chosen on validation shapes, and its loss of the mask, which "
            "may be another one. The two are not separated.",
        ],
        columns=[
            *(table.text("set", "Set"), table.text("row", "Renderer")),
            *(table.Column(name, HEADINGS[name], show=percent) for name in (*BUDGETS, AT_SECONDS)),
            *_interval("evaluations", "Field evaluations of a run, DIST = 1"),
            *_interval("seconds", "Seconds of a run, DIST = 1"),
            *(table.Column("scenes", "Scenes", show=table.whole), table.PRESET),
        ],
        lines=lines.to_dict("records"),
    )


def _interval(key: str, heading: str) -> tuple[table.Column, ...]:
    value = table.Column(key, heading, lambda line: line[key] and line[key].value)
    words = replace(value, words=lambda line: str(line[key] or format.MISSING))
    return words, *table.ends(key, lambda line: line[key])


def _columns() -> list[table.Column]:
    def words(line: dict[str, Any], outcome: str) -> str:
        return f"{percent(line.get(outcome))} ({line[f'{outcome}_rank']})"

    progress = (
        table.Column(name, heading, words=partial(words, outcome=name))
        for name, heading in HEADINGS.items()
        if name in OUTCOMES
    )
    return [
        *(table.text("row", "Renderer"), *progress, *(table.text(f"{name}_rank") for name in OUTCOMES)),
        *(table.Column("cost", "Cost of a run"), table.Column("wrong", "Wrong pixels", show=table.small_percent)),
        *(table.text("failed", "Failed"), table.PRESET),
    ]


def verdict(made: Standing) -> str:
    """The answer by rule: which renderers lead at the cost of one run of DIST, which differ at the end, what failed."""
    scenes = format.plural(made.rankings[END].scenes, "scene")
    if len(made.rows) < 2:
        return ""
    if not made.rankings[END].decidable:
        return f"{scenes} cannot decide between {len(made.rows)} renderers, whatever their results. {failures(made)}"
    return " ".join([leaders(made.rankings[AT_1]), at_end(made), failures(made)])


def leaders(ranked: Ranking, when: str = "At the cost of one run of DIST") -> str:
    """The rows that none is significantly better than, if they are better than all others; else the first row."""
    if not ranked.decidable:
        return f"{when}: {format.plural(ranked.scenes, 'scene')} cannot decide."
    beaten = {second for _, second in ranked.better}
    first, others = ([row for row in ranked.progress if (row in beaten) == is_beaten] for is_beaten in (False, True))
    names = [f"{row} (*{percent(ranked.progress[row])}*)" for row in first]
    if others and all((row, other) in ranked.better for row in first for other in others):
        more = f"significantly more progress than the {format.plural(len(others), 'other')}"
        if len(first) == 1:
            return f"{when}, {names[0]} makes {more}."
        return f"{when}, {', '.join(names[:-1])} and {names[-1]} make {more}, and cannot be distinguished."
    behind = ", ".join(row for row in ranked.progress if (first[0], row) in ranked.better)
    than = f"significantly more than {behind}" if behind else "and cannot be distinguished from any other"
    return f"{when}, {names[0]} makes the most progress, {than}."


def at_end(made: Standing) -> str:
    """How many pairs differ at the end of the runs, and what a run costs."""
    times = (made.whole["cost"] / made.whole["unit"]).groupby(made.whole["row"]).median()
    ends = " to ".join(f"*{times[row]:.2g}* ({row})" for row in (times.idxmin(), times.idxmax()))
    pairs = f"{len(made.rankings[END].better) or 'none'} of {made.rankings[END].pairs} pairs"
    return f"At the end, {pairs} can be distinguished. A run costs {ends} runs of DIST."


def failures(made: Standing) -> str:
    """The rows that failed in most problems of a set by name, the other failures as a sum."""
    groups = made.whole.groupby(["row", "set"])["ok"].agg(runs="size", failed=lambda ok: (~ok).sum())
    most = groups[2 * groups["failed"] > groups["runs"]]
    said = [f"{row} failed in {line.failed} of {line.runs} problems of {name}" for (row, name), line in most.iterrows()]
    failed, runs = (total - most["failed"].sum() for total in (groups["failed"].sum(), len(made.whole)))
    return (
        "; ".join(
            [*said, f"{failed or ('none' if said else 'None')} of {'the other ' if said else ''}{runs} runs failed"]
        )
        + "."
    )


def _notes(made: Standing) -> list[str]:
    """Notes that depend on the runs: rows without a number, the order without each set, tuned rows, machines."""
    runs, notes, pairs = made.whole, [], {name: len(ranked.better) for name, ranked in made.rankings.items()}
    if rows := standing.sparse(runs, AT_1):
        later = ranking(runs.assign(**{AT_1: runs[AT_1].where(~runs["row"].isin(rows), runs[f"{AT_1}_next"])}), AT_1)
        notes.append(
            f"A dash: fewer than {standing.FEWEST_CHECKPOINTS} checkpoints lie within that cost in some set, so the "
            "rank is of interpolated progress. With that of their next checkpoint, which costs more, "
            f"{len(later.better)} pairs differ at 1 ×, not {pairs[AT_1]}."
        )
    counts = ", ".join(f"{HEADINGS[name].lower()} {count}" for name, count in pairs.items())
    notes.append(f"Pairs that differ significantly, of {made.rankings[END].pairs}: {counts}.")
    for of_set in made.sets:
        low, high = standing.bounds(runs, of_set) or (0.0, np.inf)
        if max(1 / max(low, 1e-9), high) <= WIDEST_BOUNDS:
            within = f"{low:.2f} to {high:.2f} times the error of DIST"
            notes.append(
                f"All errors in {of_set} lie at the end within {within} (flipped signs, simultaneous at 95 %)."
            )
    for of_set in made.sets if len(made.sets) > 1 else ():
        rest = {name: ranking(runs[runs["set"] != of_set], name) for name in (AT_1, END)}
        orders = [f"{HEADINGS[name].lower()} {'; '.join(of.progress)} ({len(of.better)})" for name, of in rest.items()]
        notes.append(f"The order without {of_set} (pairs that differ): {'. '.join(orders)}.")
    lacking = made.compared[~made.compared["whole"] & ~made.compared["tuned"]].groupby("row")["missing"].first()
    versions, machines, loaded = (
        runs["code"].nunique(),
        runs.loc[runs["cpu"] != "", "machine"].nunique(),
        (~runs["timed"]).sum(),
    )
    possible = {
        f"Not compared, since problems lack: {', '.join(f'{row} ({n})' for row, n in lacking.items())}.": len(lacking),
        f"Runs of {versions} versions of the code and of {machines} machines.": versions * machines > 1,
        f"Seconds of {loaded} of {len(runs)} runs are left out: the machine was loaded.": loaded,
    }
    return [*notes, *(text for text, holds in possible.items() if holds)]


PAGES = {"suite": make, "suite_sets": make_sets}
