"""The suite: the share of problems and targets that each renderer reaches over its cost, and the standing."""

import csv
from dataclasses import replace
from io import StringIO
from math import isfinite
from typing import Any

from bench.report.data.runs import together
from bench.report.study import Result, Runs, Selection, chart, format, statistics, table
from bench.report.suite.attempts import EXPERIMENT, GIVEN, attempts_of, place, read_attempts, suite
from bench.report.suite.standing import SECONDS, Standing
from bench.report.write import paper
from bench.tables import choice, names

PLACE = 1
DIFFERING = tuple(given for given, _ in GIVEN.values())
KEEPS = place
READS = tuple(Selection(f"{EXPERIMENT}{name}", DIFFERING) for name in suite().errors)
BESIDE = {  # of what the project ships: the table, the lines of it, the number, its heading here
    "outline": ("gradients", {"band": "silhouette"}, "image_cosine", "Outline gradient, cosine"),
    "hard": ("stability_cost", {}, "rank", "Hard scenes, mean rank"),
}
NOTES = (
    "A target is a share of what separates a problem's start from its reference error, in the logarithm: "
    f"{', '.join(f'{target:g}' for target in suite().targets)} of it may be left. It is reached at the first "
    "checkpoint from which the error stays there to the end of the run.",
    "A run that did not end ok reaches nothing. All rows have one setting and one loss of the mask in a set.",
    "Ratios: over the targets that both rows reach, the median over scenes of the geometric mean. Rows share a rank "
    "where the bootstrap over scenes does not tell their shares apart.",
    "Beside them stand, from the tables stability_cost and gradients, the rank over axes on which a renderer breaks, "
    "and the gradient at outlines, of one shape; of a variant, those of the renderer that it is one of.",
)


def make(*several: Runs | None) -> Result:
    """The chart of all sets and of each, and a line per row."""
    runs = together(*several)
    kept, problems = read_attempts(runs.results_dir)
    shipped, _ = read_attempts(paper.SHIPPED)
    standing = Standing.of_all([*shipped, *kept, *attempts_of(runs.records, runs.results_dir)])
    lines = [_line(standing, row) | _beside(standing.preset(row)) for row in standing.rows]
    panels = [_panel(standing, None), *(_panel(standing, name) for name in standing.sets)]
    figure = chart.draw_lead(panels, 5.4)
    return Result(
        replace(runs, records=[], left_out=0),  # what is kept counts, with or without its run
        "The suite.",
        "Share of problems and targets that a renderer has reached over its field values, divided by those of DIST's "
        "whole run in the set; a run ends at the set's budget.",
        question="Which renderer gets how much done, and at what cost?",
        verdict=_verdict(standing, lines),
        n=_sample(standing),
        interval="95 % intervals by the bootstrap over scenes",
        estimates=[line["share"] for line in lines],
        remarks=[*NOTES, *_doubts(standing), *(f"Not read: {problem}" for problem in problems)],
        columns=_columns(standing),
        lines=lines,
        figure=figure,
        chart={"panels": panels},
    )


def _line(standing: Standing, row: str) -> dict[str, Any]:
    failures, lacking = standing.failures(row), standing.lacking(row)
    failed = ", ".join(f"{count} {status}" for status, count in failures.most_common())
    return {
        **{"rank": standing.ranks.get(row), "row": row, "preset": standing.preset(row), "share": standing.share(row)},
        **{name: standing.share(row, name).value for name in standing.sets},
        **{"ratio": standing.ratio(row), "seconds": standing.ratio(row, SECONDS)},
        "failed": ", ".join(filter(None, [failed, f"{lacking} missing" if lacking else ""])),
    }


def _beside(preset: str) -> dict[str, float | None]:
    """What other tables say of a row's renderer: of the same preset, of the one it builds on, or of a variant of it."""
    found = dict[str, float | None]()
    for key, (name, wanted, number, _) in BESIDE.items():
        path = paper.SHIPPED / "paper" / f"{name}.csv"
        text = path.read_text(encoding="utf-8") if path.is_file() else ""
        lines = [line for line in csv.DictReader(StringIO(text)) if wanted.items() <= line.items() and line[number]]
        of = {line["renderer" if "renderer" in line else "preset"]: float(line[number]) for line in reversed(lines)}
        chain = _bases(preset)
        known = [of[one] for one in (*chain, *(other for other in of if _bases(other)[-1] == chain[-1])) if one in of]
        found[key] = known[0] if known else None
    return found


def _bases(preset: str) -> list[str]:
    """A preset and what it builds on, the last one a file of `conf/renderer`."""
    try:
        bases = [one for one in choice("renderer", preset).get("defaults", ()) if one in names("renderer")]
    except KeyError:
        bases = []
    return [preset, *(_bases(bases[0]) if bases else ())]


def _columns(standing: Standing) -> list[table.Column]:
    def ratio(line: Any, name: str) -> str:
        return format.MISSING if line[name] is None else str(line[name])

    def value(line: Any, name: str) -> float | None:
        return None if line[name] is None else line[name].value

    return [
        table.Column("rank", "Rank", show=table.whole),
        table.text("row", "Renderer"),
        table.Column(
            "share",
            "Reached",
            lambda line: line["share"].value,
            words=lambda line: f"{table.percent(line['share'].value)} {line['share'].ends(100)}".strip(),
        ),
        *(table.Column(name, name, show=table.percent) for name in standing.sets),
        *(
            table.Column(name, heading, lambda line, n=name: value(line, n), words=lambda line, n=name: ratio(line, n))
            for name, heading in (("ratio", "Field values over DIST's"), ("seconds", "Seconds over DIST's"))
        ),
        *(table.Column(key, heading) for key, (*_, heading) in BESIDE.items()),
        table.text("failed", "Failed"),
        table.PRESET,
    ]


def _panel(standing: Standing, of_set: str | None) -> chart.Panel:
    found = {row: standing.profile(row, of_set) for row in standing.rows}
    end = max((costs[-1] for costs, _ in found.values() if costs), default=1.0)
    lines = [
        chart.curve(row, standing.preset(row), [*costs, end], [*shares, shares[-1]], step=True)
        for row, (costs, shares) in found.items()
        if costs
    ]
    return chart.panel_data(of_set or "all sets", "field values over DIST's run", "share reached", lines)


def _sample(standing: Standing) -> str:
    problems = {(one.set, one.problem) for one in standing.judged}
    seeds = {one.seed for one in standing.judged}
    parts = [_scenes(standing), format.plural(len(seeds), "seed")]
    sample = f"{format.plural(len(problems), 'problem')} ({', '.join(parts)}) of {suite().id}"
    failed = sum(standing.failures(row).total() for row in standing.rows)
    return f"{sample}, {len(standing.rows)} rows; {failed or 'none'} of {len(standing.attempts)} runs did not end ok"


def _verdict(standing: Standing, lines: list[dict[str, Any]]) -> str:
    ranked = [line for line in lines if line["rank"]]
    if not ranked or not isfinite(ranked[0]["share"].value):
        return ""
    best = ranked[0]
    said = [f"{best['row']} reaches *{table.percent(best['share'].value)}* of problems and targets, the most."]
    alike = [line["row"] for line in ranked[1:] if line["rank"] == best["rank"]]
    if standing.resolution is not None:
        told = f"{_scenes(standing)} tell differences of *{table.percent(standing.resolution)}*"
        said.append(f"{told}: {len(alike) or 'none'} of {len(ranked) - 1} others are not told from it.")
    known = [line for line in ranked if line["ratio"] is not None]
    differ = dict(zip((one["row"] for one in known), statistics.differ([one["ratio"] for one in known]), strict=True))
    fewer = [one for one in known if differ[one["row"]] and one["ratio"].value < 1]
    if fewer and (least := min(fewer, key=lambda line: line["ratio"].value)):
        said.append(f"Fewest field values: {least['row']}, *{format.number(least['ratio'].value)}* of DIST's.")
    elif any(differ.values()):
        alike = [row for row, found in differ.items() if not found]
        said.append(f"Fewest field values: {' or '.join([*alike, str(standing.reference)])}.")
    for key, text, better in (
        ("outline", "For outlines that must move: {} (cosine *{}*).", max),
        ("hard", "Where the field is no distance: {} (mean rank *{}*).", min),
    ):
        if found := {line["row"]: line[key] for line in ranked if line[key] is not None}:
            row = better(found, key=lambda name: found[name])
            said.append(text.format(row, format.number(found[row])))
    return " ".join([*said, "Of other than small networks and images on a CPU it says nothing."])


def _scenes(standing: Standing) -> str:
    return format.plural(len(standing.scenes), "scene")


def _doubts(standing: Standing) -> list[str]:
    """Notes on what may not be trusted: several codes or settings, attempts that are not judged."""
    stated = {(one.set, one.settings) for one in standing.attempts if one.row == standing.reference}
    other = sorted({one.row for one in standing.attempts if stated and (one.set, one.settings) not in stated})
    alone = len(standing.everything) - len(standing.attempts)
    versions = len({one.code for one in standing.attempts})
    machines = len({one.machine for one in standing.attempts})
    loaded = sum(not one.timed for one in standing.attempts)
    return [
        f"Of other settings than the suite's, so not to be compared: {', '.join(other)}." if other else "",
        f"Not shown: {alone} runs at problems that DIST has no run at: python -m bench.suite renderer=dist makes them."
        if alone
        else "",
        f"Runs of {versions} versions of the code." if versions > 1 else "",
        f"Runs of {machines} machines: seconds are compared with DIST's on the same one alone." if machines > 1 else "",
        f"Seconds of {loaded} of {len(standing.attempts)} runs are left out: the machine was loaded." if loaded else "",
        f"Not judged, since there is no start that is worse than the reference: {'; '.join(standing.left_out)}."
        if standing.left_out
        else "",
    ]


PAGES = {"suite": make}
