"""The leaders of a ranking, or that it has none, as a sentence."""

from collections import Counter
from collections.abc import Iterable

from bench.records.format import plural
from bench.report.suite.standing import Ranking
from bench.report.write.table import percent

MAX_NAMED = 4  # rows in a verdict; the table has the ranks of all


def leaders(ranked: Ranking, when: str) -> str:
    """The rows that no row significantly beats, if they beat all others; else the first row."""
    beaten = {second for _, second in ranked.better}
    first = [row for row in ranked.progress if row not in beaten]
    names = short_names(ranked.progress)
    rows = [f"{names[row]} (*{percent(ranked.progress[row])}*)" for row in first]
    if beaten and all((row, other) in ranked.better for row in first for other in beaten):
        more = f"significantly more progress than {plural(len(beaten), 'other')}"
        if len(first) == 1:
            return f"{when}, {rows[0]} makes {more}."
        return f"{when}, {', '.join(rows[:-1])} and {rows[-1]} make {more}."
    behind = [row for row in ranked.progress if (first[0], row) in ranked.better]
    tied = [row for row in ranked.progress if row not in (first[0], *behind)]
    less = f"{plural(len(behind), 'other')}: {', '.join(names[row] for row in behind)}"
    if len(behind) > len(tied) > 0:
        others = " and ".join(filter(None, [", ".join(names[row] for row in tied[:-1]), names[tied[-1]]]))
        others = others if len(tied) <= MAX_NAMED else str(len(tied))
        return f"{when}, {rows[0]} makes significantly more progress than all but {others}."
    than = f"significantly more than {less}" if behind else "and cannot be distinguished from any other"
    return f"{when}, {rows[0]} makes the most progress, {than}."


def undecided(ranked: Ranking, when: str) -> str:
    """That a ranking is not decidable: for its few scenes alone, or for its simulated level."""
    rows = f"{len(ranked.progress)} renderers" + ("" if ranked.level else ", whatever their results")
    return f"{when}, {plural(ranked.scenes, 'scene')} cannot decide between {rows}."


def row_alone(ranked: Ranking, row: str, when: str) -> str:
    """Which rows differ from a row, by a ranking whose tested pairs are those of the row alone."""
    if not ranked.decidable:
        reason = "since equal rows would often differ by chance" if ranked.level else "whatever their results"
        return f"{when}, {plural(ranked.scenes, 'scene')} cannot decide between {row} and others, {reason}."
    worse = [other for other in ranked.progress if (row, other) in ranked.better]
    better = [other for other in ranked.progress if (other, row) in ranked.better]
    equal = [other for other in ranked.progress if other not in (row, *worse, *better)]
    texts = {
        "significantly more progress than": worse,
        "significantly less than": better,
        "no significant difference from": equal,
    }
    named = "; ".join(f"{text} {', '.join(rows)}" for text, rows in texts.items() if rows)
    sample = f"{plural(ranked.scenes, 'scene')}, Holm's correction over {ranked.pairs} pairs of this row"
    return f"{row} {when[0].lower()}{when[1:]}: {named} ({sample})."


def short_names(rows: Iterable[str]) -> dict[str, str]:
    """The names of rows without their settings, where that leaves them different."""
    first = {row: row.partition(",")[0] for row in rows}
    count = Counter(first.values())
    return {row: name if count[name] == 1 else row for row, name in first.items()}
