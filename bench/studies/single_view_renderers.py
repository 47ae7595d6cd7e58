"""Shape from one image, by the renderer whose gradients taught the network: the same training, another renderer."""

from typing import Any

from bench.records import format
from bench.report.data.runs import Runs, Selection
from bench.report.single_view import BASELINES, INTERVALS, OVER, RUNS, columns, draw, lines_of, over_column
from bench.report.write.result import Result
from bench.report.write.table import Column, text, to_data, to_table

PLACE = 39
READS = (Selection("single_view_renderers", setup=("machine",)),)
FIRST = "single_view_by_newton"  # the row that others are compared with
NOTES = (
    "The same network, shapes, images, rays, number of steps and losses, IDR's cross entropy of the mask included; no "
    "step learns from the visual hull.",
    f"{OVER} A failed run counts as infinite.",
    "“Trained in” and “field values”: of the training, once for the family, beside another training.",
)
COLUMNS = (
    *columns("Renderer", over_column("Over Newton", FIRST)),
    *(Column("normal_consistency", "Normals"), Column("psnr", "PSNR")),
    Column("training", "Trained in", show=format.seconds),
    Column("training_values", "Field values", show=format.count),
    text("failed", "Failed"),
)


def make(runs: Runs) -> Result:
    """A line per family and row."""
    lines = [line for name in runs.families() for line in lines_of(runs, name, (FIRST, *BASELINES))]
    said = [told for name in runs.families() if (told := _least([x for x in lines if x["family"] == name]))]
    once = ", one training each" if runs.frame.seed.nunique() == 1 else ""
    verdict = f"Chamfer-L1 over that of the network that Newton taught, on the same unseen shapes{once}: "
    return Result(
        runs,
        "Shape from one image, by the renderer of the training.",
        "Chamfer-L1 in scene units, times 1000; medians over shapes.",
        question="Does it matter which renderer teaches a network of one image?",
        verdict=f"{verdict}{'; '.join(said)}." if said else "",
        interval=INTERVALS,
        estimates=[line["interval"] for line in lines],
        remarks=NOTES,
        data=to_data(RUNS, runs.records),
        table=to_table(COLUMNS, lines),
        figure=draw(runs),
    )


def _least(lines: list[dict[str, Any]]) -> str:
    """The least ratio of a family to the first row, of how many; empty where there is nothing to compare."""
    ratios = {line["method"]: line[FIRST] for line in lines if line.get(FIRST) and line["preset"] not in BASELINES}
    if not ratios:
        return ""
    row = min(ratios, key=lambda name: ratios[name].value)
    value, _, rest = str(ratios[row]).partition(" ")
    among = f", the least of {len(ratios)}" if len(ratios) > 1 else ""
    return f"{lines[0]['family']}: {row} *{value}* {rest}".rstrip() + among


PAGES = {"single_view_renderers": make}
