"""The suite: the share of problems and targets that each renderer reaches over its cost, and the standing."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

from bench.report.data.runs import together
from bench.report.study import Result, Runs, Selection, chart, format, table
from bench.report.suite.attempts import BY_ITSELF, EXPERIMENT, GIVEN, attempts_of, place, read_attempts, suite
from bench.report.suite.standing import Standing
from bench.report.write import paper

PLACE = 1
DIFFERING = tuple(given for given, _ in GIVEN.values())
KEEPS = place
READS = tuple(Selection(f"{EXPERIMENT}{name}", DIFFERING) for name in suite().errors)
NOTES = (
    "A target is a share of what separates a problem's start from its reference error, in the logarithm: "
    f"{', '.join(f'{target:g}' for target in suite().targets)} of it may be left. It is reached at the first "
    "checkpoint from which the error stays there to the end of the run. Each set weighs the same.",
    "A run ends after the iterations of its set, or at the set's budget of field values; thin lines begin where the "
    "row's runs have ended. A run that did not end ok reaches nothing. A set has one setting and one loss for all.",
    "Ratios: over the targets that both rows reach, the median over scenes of the geometric mean. Less, or not told: "
    "than the first row, by flipped signs over scenes, at 5 % over all pairs of rows (Bonferroni).",
    "Wrong pixels: of the prior's own networks, over the object's; missed, spurious, or .02 scene units off in depth. "
    "They do not count in what is reached.",
)


def make(*several: Runs | None) -> Result:
    """The chart of all sets and of each, and a line per row."""
    runs = together(*several)
    attempts, problems = read_attempts(paper.SHIPPED, runs.results_dir)
    standing = Standing([*attempts, *attempts_of(runs.records, runs.results_dir)])
    lines = [standing.line(row) for row in standing.rows]
    panels = [_panel(standing, None), *(_panel(standing, name) for name in standing.sets)]
    figure = chart.draw_lead(panels)
    return Result(
        replace(runs, records=[], left_out=0),  # what is kept counts, with or without its run
        "The suite.",
        "Share of problems and targets that a renderer has reached over its field values, divided by those of DIST's "
        "whole run at the same problem.",
        question="Which renderer gets how much done, and at what cost?",
        verdict=_verdict(standing),
        n=_sample(standing),
        interval="95 % intervals by the bootstrap over scenes",
        estimates=[line["share"] for line in lines],
        remarks=[*NOTES, *_doubts(standing), *(f"Not read: {problem}" for problem in problems)],
        columns=_columns(standing, lines),
        lines=lines,
        figure=figure,
        chart={"panels": panels},
    )


def _columns(standing: Standing, lines: list[dict[str, Any]]) -> list[table.Column]:
    """The columns; without those that may be known of no row."""

    def of_interval(name: str, heading: str, words: Callable[[Any], str] | None = None) -> table.Column:
        said = words or (lambda line: format.MISSING if line[name] is None else str(line[name]))
        return table.Column(name, heading, lambda line: line[name] and line[name].value, words=said)

    scenes = {name: format.plural(standing.scenes(name), "scene") for name in standing.sets}
    every = [
        table.text("row", "Renderer"),
        of_interval("share", "Reached", _share),
        table.text("against", "Against the first"),
        *(table.Column(name, f"{name}, {count}", show=table.percent) for name, count in scenes.items()),
        of_interval("gain", "Gain by tuning", _points),
        table.Column("at_dist", "At DIST's cost", show=table.percent),
        of_interval("ratio", "Field values over DIST's"),
        of_interval("seconds", "Seconds over DIST's"),
        table.Column("wrong", "Wrong pixels", show=table.small_percent),
        table.text("failed", "Failed"),
        table.PRESET,
    ]
    unknown = [name for name in ("gain", "seconds", "wrong") if all(line[name] is None for line in lines)]
    return [column for column in every if column.key not in unknown]


def _share(line: Any) -> str:
    """What a row reaches with its interval; nothing of one at tuned settings, which has other sets than the others."""
    share = line["share"]
    return format.MISSING if line["gain"] else f"{table.percent(share.value)} {share.ends(100)}".strip()


def _points(line: Any) -> str:
    gain = line["gain"]
    told = gain and f"{100 * gain.value:+.0f} {gain.ends(100)}, {format.plural(line['problems'], 'problem')}"
    return told or format.MISSING


def _better(standing: Standing, row: str, of_set: str | None) -> str:
    """Of a renderer's rows, at the set's setting and tuned, that which reaches more of all problems."""
    stated = row.removesuffix(BY_ITSELF)
    runs = {name: len(standing.of(name, of_set)) for name in (stated, stated + BY_ITSELF)}
    whole = [name for name, count in runs.items() if count == max(runs.values())]
    return max(whole, key=lambda name: standing.share(name, of_set).value)


def _panel(standing: Standing, of_set: str | None) -> chart.Panel:
    found = {row: standing.profile(row, of_set) for row in standing.rows}
    lines = [
        chart.curve(row, standing.preset(row), costs, shares, step=True)
        for row, (costs, shares) in found.items()
        if costs
        and costs[-1] > 0  # of a row whose runs ended before they cost anything there is no line
        and row == _better(standing, row, of_set)
    ]
    name = f"{of_set or 'all sets'}, {format.plural(standing.scenes(of_set), 'scene')}"
    panel = chart.panel_data(name, "field values over DIST's run", "share reached", lines)
    panel["x"]["log"] = True  # also where something is reached at the start, for nothing
    return panel


def _sample(standing: Standing) -> str:
    problems = {(one.set, one.problem) for one in standing.judged}
    seeds = {one.seed for one in standing.judged}
    parts = [format.plural(standing.scenes(), "scene"), format.plural(len(seeds), "seed")]
    sample = f"{format.plural(len(problems), 'problem')} ({', '.join(parts)}) of {suite().id}"
    failed = sum(standing.failures(row).total() for row in standing.rows)
    rows, runs = format.plural(len(standing.rows), "row"), format.plural(len(standing.attempts), "run")
    return f"{sample}, {rows}; {failed or 'none'} of {runs} did not end ok"


def _verdict(standing: Standing) -> str:
    if len(standing.ranked) < 2 or not standing.share(standing.ranked[0]).value:
        return ""
    first, *others = standing.ranked
    scenes, less = format.plural(standing.scenes(), "scene"), len(standing.told)
    said = [f"{first} reaches *{table.percent(standing.share(first).value)}*."]
    if standing.resolution is None:
        said.append(f"{scenes} are too few to tell any row from it.")
    else:
        said.append(f"{less or 'None'} of the {len(others)} others can be told to reach less.")
        said.append(f"{scenes} tell differences of some {100 * standing.resolution:.0f} points.")
    at = sorted(((standing.share_at_dist(row), row) for row in standing.ranked), reverse=True)[:3]
    if standing.reference in standing.ranked:
        listed = ", ".join(f"{row} *{table.percent(share)}*" for share, row in at)
        said.append(f"At the cost of one run of DIST: {listed}.")
    return " ".join([*said, "All on a CPU, with small networks and images."])


def _doubts(standing: Standing) -> list[str]:
    """Notes on what may not be trusted: several codes or settings, attempts that are not judged."""
    alike = {one.key for one in standing.alike}
    other = sorted({one.row for one in standing.everything if one.key not in alike})
    tuned = [row for row in standing.rows if row.endswith(BY_ITSELF)]
    drawn = [
        f"{name} of {row.removesuffix(BY_ITSELF)}"
        for row in tuned
        for name in standing.sets
        if standing.of(row, name) and row == _better(standing, row, name)
    ]
    alone = len(standing.alike) - len(standing.attempts)
    versions = len({one.code for one in standing.attempts})
    machines = len({one.machine for one in standing.attempts})
    loaded = sum(not one.timed for one in standing.attempts)
    fewer = [f"{row} ({count} not run)" for row in standing.rows if (count := standing.not_run(row))]
    told = {
        f"Of fewer problems than the others, so neither its number nor its line compares: {', '.join(fewer)}.": fewer,
        f"Not shown, since their set has other settings: runs of {', '.join(other)}.": other,
        f"Not shown: {format.plural(alone, 'run')} at problems that not all rows have.": alone,
        "Tuned: at the renderer's own setting and loss of conf/tuned.yaml, chosen on validation shapes, where there is "
        "one for a set. Gain: points over its row at the set's setting, at the same problems. A set's chart has the "
        f"better of two rows that have all its problems, tuned: {', '.join(drawn) or 'none'}.": tuned,
        f"Runs of {versions} versions of the code.": versions > 1,
        f"Runs of {machines} machines: seconds are compared with DIST's on the same one alone.": machines > 1,
        f"Seconds of {loaded} of {len(standing.attempts)} runs are left out: the machine was loaded.": loaded,
        "Not judged, since there is no start that is worse than the reference: "
        f"{'; '.join(standing.left_out)}.": standing.left_out,
    }
    return [text for text, holds in told.items() if holds]


PAGES = {"suite": make}
