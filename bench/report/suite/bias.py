"""The depth bias of the rows of the suite: how far their final surfaces lie in front of the true one, or behind it.

It shows a small systematic error of hits that the scatter of final errors hides: their signs differ over pixels and
scenes. Sign tests over scenes compare each row with DIST's, with Holm's correction over the rows and sets of a budget.
They also hold for skewed differences, of which sign flips of means find too many.
"""

from collections.abc import Iterator

import numpy as np
import pandas as pd

from bench.records.format import number, plural
from bench.report.data import statistics
from bench.report.suite.standing import dist_row, units

# Printed biases are in thousandths of a scene unit.
PRINTED_FACTOR = 1000.0


def depth_biases(runs: pd.DataFrame, reference: str = "") -> pd.DataFrame:
    """A line per budget, set and row: the median `bias` over scenes, the median `difference` from a row, and its test.

    Args:
        runs: compared runs. Runs without a depth bias are left out.
        reference: the row that others are compared with; by default that of DIST.
    """
    lines = []
    runs = runs[runs["depth_bias"].notna()]
    reference = reference or dist_row(runs)
    for (budget, name), group in runs.groupby(["budget", "set"]):
        table = group.pivot_table(index="scene", columns="row", values="depth_bias")
        for row in table if reference in table else ():
            differences = (table[row] - table[reference]).dropna()
            p_value = statistics.sign_test_p_value([*differences], 0.0) if row != reference else np.nan
            line = {"budget": budget, "set": name, "row": row, "bias": table[row].median(), "reference": reference}
            lines.append(line | {"difference": differences.median(), "scenes": len(differences), "p": p_value})
    frame = pd.DataFrame(lines, columns=["budget", "set", "row", "bias", "reference", "difference", "scenes", "p"])
    frame["significant"] = False
    for _, p_values in frame.loc[frame["p"].notna()].groupby("budget")["p"]:
        frame.loc[p_values.index, "significant"] = statistics.holm(p_values)
    return frame


def bias_notes(biases: pd.DataFrame) -> Iterator[str]:
    """A sentence for each budget and set with a comparison."""
    for (budget, name), lines in biases.groupby(["budget", "set"]):
        others = lines[lines["p"].notna()]
        if others.empty:
            continue
        base = lines[lines["row"] == lines["reference"]].iloc[0]
        start = (
            f"Depth bias × {PRINTED_FACTOR:g} at {units(budget)} in {name}: {base['row']} has {scaled(base['bias'])}."
        )
        texts = []
        for sign, side in ((-1, "in front of"), (1, "behind")):
            chosen = others[others["significant"] & (np.sign(others["difference"]) == sign)].sort_values("difference")
            named = ", ".join(f"{line.row} ({scaled(abs(line.difference))})" for line in chosen.itertuples())
            texts += [f"Significantly {side} its surfaces are those of {named}."] if named else []
        rest = others[~others["significant"]]
        if len(rest):
            texts.append(f"{plural(len(rest), 'row')} cannot be distinguished: {', '.join(rest['row'])}.")
        yield " ".join([start, *texts, f"n = {int(others['scenes'].max())} scenes."])


def bias_lines(runs: pd.DataFrame, row: str) -> Iterator[str]:
    """A sentence for each budget and set in which a row has a comparison with DIST's, tested alone."""
    reference = dist_row(runs)
    for line in depth_biases(runs[runs["row"].isin([row, reference])], reference).itertuples():
        if line.row == row != reference:
            side = "behind" if line.difference > 0 else "in front of"
            test = f"p = {number(line.p)}, {'' if line.significant else 'not '}significant after Holm's correction"
            yield (
                f"{row}, {line.set} at {units(line.budget)}: its surfaces lie {number(abs(line.difference))} scene "
                f"units {side} those of {reference} (median of {plural(line.scenes, 'scene')}, sign test, {test})"
            )


def scaled(bias: float | None) -> str:
    return number(None if bias is None else PRINTED_FACTOR * bias)
