"""Shape from one image, by the renderer whose gradients taught the network: the same training, another renderer."""

from typing import Any

from bench.report.study import Result, Runs, Selection, compare, format, single_view, table

PLACE = 39
READS = (Selection("single_view_renderers", setup=("machine",)),)
FIRST = "single_view_by_newton"  # the row that others are compared with
NOTES = (
    f"{single_view.OVER} A failed run counts as infinite.",
    "Each network was trained once, so that a test over shapes says nothing of another training.",
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
    return Result(
        runs,
        "Shape from one image, by the renderer of the training.",
        "Chamfer-L1 in scene units, times 1000; medians over shapes.",
        question="Does it matter which renderer teaches a network of one image?",
        verdict=" ".join(filter(None, map(_verdict, of_family))),
        interval=single_view.INTERVALS,
        estimates=[line["interval"] for line in lines],
        remarks=(single_view.trainings(runs), *NOTES),
        columns=COLUMNS,
        lines=lines,
        run_columns=single_view.RUNS,
        figure=single_view.draw(runs),
    )


def _verdict(lines: list[dict[str, Any]]) -> str:
    """The ratios of a family's networks to the first row; one of 0, where that row failed, says nothing."""
    taught = [line for line in lines if line["preset"] not in single_view.BASELINES]
    known = {line["method"]: line[FIRST] for line in taught if line.get(FIRST) and line[FIRST].value > 0}
    n = format.plural(max((len(ratio.points) for ratio in known.values()), default=0), "unseen shape")
    ratios = {name: ratio.value for name, ratio in known.items()}
    ends = format.ends(f"Chamfer-L1 over that of Newton's network, {lines[0]['family']}", ratios, n)
    return f"{ends} {compare.differing(list(known.items()), 'to Newton')}".strip()


PAGES = {"single_view_renderers": make}
