"""The suite with each renderer's own learning rate and rays, compared with the settings that a set has for all."""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

from matplotlib.figure import Figure

from bench.report.study import Result, Runs, figure_style, format, merge_runs, statistics, table
from bench.report.suite.attempts import (
    TUNED_SUFFIX,
    Attempt,
    attempts_folder,
    gather,
    selections,
)
from bench.report.suite.standing import ALPHA, KEY, Gathered, Standing, units
from bench.report.suite.tuned import (
    CANDIDATES,
    STATED,
    Chosen,
    candidate_of,
    chosen_settings,
    renderer_of,
)
from bench.report.suite.verdicts import leaders
from bench.report.write import paper
from bench.report.write.table import percent

PLACE = 3
UNITS_OF_COST = 1.0
KEEPS = partial(attempts_folder, subfolder=CANDIDATES)
READS = selections()
NOTES = (
    "Candidates of a setting are that of the set (stated), a third of its learning rate (slower), three times its rate "
    "(faster), and fewer rays for at least 160 iterations. They are the same for all renderers. The silhouette "
    "loss is that of the set.",
    "The mean logarithm of the final errors on validation shapes chooses a candidate for each renderer and set. A "
    "failed run counts with its initial error, and a larger final error with itself. If the set's setting is chosen, "
    "its runs count.",
    "Significant: as on the page of the suite, by a sign-flip test over scenes with Holm's correction over all pairs "
    f"at {percent(ALPHA)}. Both columns have the same problems.",
)


def with_chosen_settings(attempts: Iterable[Attempt], chosen: Chosen) -> list[Attempt]:
    """The attempts that have their renderer's chosen setting, under the name of its row without settings."""
    kept = []
    for attempt in attempts:
        plain = replace(attempt, row=attempt.row.removesuffix(TUNED_SUFFIX), settings="")
        setting = chosen.get((attempt.budget, attempt.set, renderer_of(plain)))
        if setting == (candidate_of(attempt) if attempt.tuned else STATED):
            kept.append(plain)
    return kept


def make(*several: Runs | None) -> Result:
    """A line per renderer: its progress with the set's settings and with its own, on the same problems."""
    runs = merge_runs(*several)
    gathered = gather(paper.SHIPPED, runs.results_dir, runs.records)
    every_choice, problems = chosen_settings(paper.SHIPPED, runs.results_dir)
    chosen = {key: setting for key, setting in every_choice.items() if key[0] == UNITS_OF_COST}
    tuned = Standing(Gathered(with_chosen_settings(gathered.everything, chosen), [], []))
    keys = {*tuned.complete[[*KEY, "row"]].itertuples(index=False, name=None)}
    shared = [attempt for attempt in gathered.everything if attempt.key[:4] in keys]
    stated = Standing(Gathered(shared, [], []))
    ranked_rows = tuned.rankings[UNITS_OF_COST].progress if tuned.rankings else ()
    lines = [_line(row, tuned, stated, chosen) for row in ranked_rows]
    return Result(
        replace(runs, records=[], left_out=Counter()),
        "The suite, with each renderer's own settings.",
        "Progress at 1 unit of cost with the set's settings (open circles) and with a renderer's own (full circles).",
        question="Does the order of the renderers depend on the learning rate and the rays that all of them share?",
        verdict=verdict(tuned, stated),
        n=_sample(tuned),
        interval="simultaneous 95 % ranks, as on the page of the suite" if lines else "",
        remarks=[*NOTES, *_notes(chosen, problems)] if lines else [],
        columns=[
            table.text("row", "Renderer"),
            table.text("stated_text", "The set's settings"),
            table.text("own_text", "Its own settings"),
            *(table.text(name, name) for name in tuned.sets),
            *(table.Column(name) for name in ("stated", "own")),
            table.PRESET,
        ],
        lines=lines,
        figure=draw(lines) if lines else None,
    )


def _line(row: str, tuned: Standing, stated: Standing, chosen: Chosen) -> dict[str, Any]:
    runs = tuned.complete[tuned.complete["row"] == row]
    first = runs.iloc[0]
    line: dict[str, Any] = {"row": row, "preset": first["preset"]}
    for name, standing in (("stated", stated), ("own", tuned)):
        ranked = standing.rankings[UNITS_OF_COST]
        line |= {name: ranked.progress[row], f"{name}_text": f"{percent(ranked.progress[row])} ({ranked.rank(row)})"}
    return line | {name: chosen[UNITS_OF_COST, name, renderer_of(first)].replace("_", " ") for name in tuned.sets}


def _sample(tuned: Standing) -> str:
    scenes = format.plural(tuned.complete["scene"].nunique(), "scene")
    problems = format.plural(len(tuned.complete.groupby(["set", "problem"])), "problem")
    return f"{problems} of {scenes} ({', '.join(tuned.sets)}), {format.plural(len(tuned.rows), 'renderer')}"


def verdict(tuned: Standing, stated: Standing) -> str:
    """The correlation of both orders, the leaders with their own settings, and the pairs that differ in both."""
    if len(tuned.rows) < 2:
        return ""
    ranked, before = tuned.rankings[UNITS_OF_COST], stated.rankings[UNITS_OF_COST]
    order = list(ranked.progress)
    rho, _ = statistics.rank_correlation([*range(len(order))], [[*before.progress].index(row) for row in order])
    turned = sum(pair[::-1] in before.better for pair in ranked.better)
    lead = leaders(ranked, f"With their own settings, at {units(UNITS_OF_COST)}")
    return (
        f"Spearman's correlation of both orders is *{rho:.2f}* ({format.plural(len(order), 'renderer')}). {lead} "
        f"*{len(ranked.better)}* of {ranked.pairs} pairs differ significantly, with the sets' settings "
        f"{len(before.better)}; "
        f"{turned or 'none'} of them in the other direction."
    )


def _notes(chosen: Chosen, problems: dict[str, int]) -> list[str]:
    counts = Counter(setting.replace("_", " ") for setting in chosen.values()).most_common()
    sample = ", ".join(f"{count} of {name}" for name, count in problems.items())
    return [
        f"Number of choices, over renderers and sets: {', '.join(f'{name} {count}' for name, count in counts)}.",
        f"Validation problems per renderer: {sample}. So few problems may choose a setting by chance.",
        f"The runs of the candidates are in the folder `{CANDIDATES}` next to those of the suite.",
    ]


@figure_style.styled
def draw(lines: Sequence[dict[str, Any]]) -> Figure:
    """Draws a row per renderer: an open circle for the set's settings, a full one for its own."""
    figure = Figure(figsize=(figure_style.WIDTH, 0.6 + 0.3 * len(lines)), layout="constrained")
    axis = figure.subplots()
    for index, line in enumerate(lines):
        colour = figure_style.look(line["preset"]).colour
        axis.plot([line["stated"], line["own"]], [index, index], color=colour)
        axis.plot(
            line["stated"], index, "o", color=colour, mfc="white", label="the set's settings" if not index else None
        )
        axis.plot(line["own"], index, "o", color=colour, label="its own settings" if not index else None)
    axis.set_yticks(range(len(lines)), [line["row"] for line in lines])
    axis.invert_yaxis()
    axis.xaxis.set_major_formatter(lambda share, _: percent(share))
    axis.set_xlabel("progress at 1 unit of cost")
    axis.legend()
    return figure


PAGES = {"suite_tuned": make}
