"""Shape from one image, by the renderer whose gradients taught the network: the same training, another renderer."""

from typing import Any

from bench.report.study import Result, Runs, Selection, format, single_view, table

PLACE = 39
READS = (Selection("single_view_renderers", setup=("machine",)),)
FIRST = "single_view_by_newton"  # the row that others are compared with
NOTES = (
    "The same network, shapes, images, rays, number of steps and losses, IDR's cross entropy of the mask included; no "
    "step learns from the visual hull.",
    f"{single_view.OVER} A failed run counts as infinite.",
    "“Trained in” and “field values”: of the training, once for the family, beside another training.",
)
COLUMNS = (
    *single_view.columns("Renderer", single_view.over_column("Over Newton", FIRST)),
    *(table.Column("normal_consistency", "Normals"), table.Column("psnr", "PSNR")),
    table.Column("training", "Trained in", show=format.seconds),
    table.Column("training_values", "Field values", show=format.count),
    table.text("failed", "Failed"),
)


def make(runs: Runs) -> Result:
    """A line per family and row."""
    of_family = [single_view.lines_of(runs, name, (FIRST, *single_view.BASELINES)) for name in runs.families()]
    lines = [line for own in of_family for line in own]
    said = [*filter(None, map(_least, of_family))]
    once = ", one training each" if runs.frame.seed.nunique() == 1 else ""
    verdict = f"Chamfer-L1 over that of the network that Newton taught, on the same unseen shapes{once}: "
    return Result(
        runs,
        "Shape from one image, by the renderer of the training.",
        "Chamfer-L1 in scene units, times 1000; medians over shapes.",
        question="Does it matter which renderer teaches a network of one image?",
        verdict=f"{verdict}{'; '.join(said)}." if said else "",
        interval=single_view.INTERVALS,
        estimates=[line["interval"] for line in lines],
        remarks=NOTES,
        columns=COLUMNS,
        lines=lines,
        run_columns=single_view.RUNS,
        figure=single_view.draw(runs),
    )


def _least(lines: list[dict[str, Any]]) -> str:
    """The least ratio of a family to the first row, of how many; empty where there is nothing to compare.

    A ratio to a row that failed where the other did not is 0 or unknown, and says nothing.
    """
    taught = [line for line in lines if line["preset"] not in single_view.BASELINES]
    ratios = {line["method"]: line[FIRST] for line in taught if line.get(FIRST) and line[FIRST].value > 0}
    if not ratios:
        return ""
    row = min(ratios, key=lambda name: ratios[name].value)
    among = f", the least of {len(ratios)}" if len(ratios) > 1 else ""
    return f"{lines[0]['family']}: {row} *{format.number(ratios[row].value)}* {ratios[row].ends()}{among}"


PAGES = {"single_view_renderers": make}
