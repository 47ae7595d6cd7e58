"""After Figs. 12 and 24 of DIST: shape from many views if the initial similarity is wrong, and optimised too."""

from collections.abc import Sequence
from itertools import product
from typing import Any

from matplotlib.figure import Figure

from bench.report.data.records import CHAMFER_SCALE, ONE_WAY, Record, error, family, grouped, row_of, setting, solid
from bench.report.study import Result, Runs, Selection, chart, conditions, gallery, statistics, table

PLACE = 55
CONDITIONS = (
    conditions.Condition("shift", "shift (scene units)", 0.0),
    conditions.Condition("degrees", "rotation (degrees)", 0.0),
    conditions.Condition("scale", "size / true size", 1.0),
)
KEYS = (*(f"task.{condition.key}" for condition in CONDITIONS), "task.similarity")
READS = (Selection("fig12", KEYS, setup=Selection.WITHOUT_MACHINE, may_differ=("prior.truncation",)),)
MAX_ERROR = 1.0  # squared scene units x 1000: about the errors of DIST, Table 3; a success has less
NOTES = (
    f"A success is a run that ended ok with an error (Chamfer × 1000) below {MAX_ERROR:g}. The interval "
    "of the success rate is over shapes (Clopper and Pearson).",
    "One condition varies, and the others are neutral. The direction of a shift, the axis of a rotation and the "
    "initial code are random, and the same for all methods.",
    "A run also optimises a similarity transform (position, rotation and size), even at zero displacement. Only runs "
    "of “place known” do not. They are not in the figure.",
    "A failed run counts as infinite and is drawn at the upper edge.",
    "“DIST, paper's” has 72 photographs and 180 iterations. At scale=desk, the other methods have 24 and 60.",
    "The paper (Fig. 12) shows pictures of real chairs and no numbers. Here shapes and photographs are synthetic.",
)
RUNS = conditions.run_columns(CONDITIONS, "similarity")
PLACE_KNOWN = "place known"
UNITS = {"shift": "shifted by {:g}", "degrees": "turned by {:g}°", "scale": "{:g} times\nas large"}


def is_place_known(record: Record) -> bool:
    """Whether a run began in place, and optimised no similarity."""
    is_neutral = all(condition.value_of(record) == condition.neutral for condition in CONDITIONS)
    return is_neutral and not setting(record["config"], "task", "similarity")


def make(runs: Runs) -> Result:
    lines = conditions.lines_of([record for record in runs.executed.records if not is_place_known(record)], CONDITIONS)
    records_by_row = grouped(filter(is_place_known, runs.records), lambda record: (family(record), row_of(record)))
    lines_of_known = [
        {"family": name, "method": row.name, "condition": PLACE_KNOWN}
        | {"runs": group, "error": conditions.median_error(group)}
        for (name, row), group in records_by_row.items()
    ]
    return Result(
        runs,
        "Shape from many views, misplaced at the start.",
        f"Successful runs, and {conditions.ERROR_TEXT}, over the initial displacement.",
        question="Is a shape reconstructed if its initial position, rotation or size is wrong?",
        verdict=_verdict(runs),
        interval=conditions.INTERVALS,
        estimates=[line["error"] for line in lines],
        remarks=NOTES,
        columns=(
            *conditions.NAME_COLUMNS,
            table.shown("Success", lambda line: _successes(line["runs"])),
            *conditions.MEDIAN_COLUMNS,
        ),
        lines=lines + lines_of_known,
        run_columns=RUNS,
        figure=draw(lines) if lines else None,
    )


def draw(lines: Sequence[dict[str, Any]]) -> Figure:
    lines_by_family, panels = grouped(lines, lambda line: line["family"]), []
    for (name, family_lines), condition in product(lines_by_family.items(), CONDITIONS):
        shown = [line for line in family_lines if line["key"] == condition.key]
        curves = [
            chart.curve(*row, [line["value"] for line in row_lines], [line["error"] for line in row_lines])
            for row, row_lines in grouped(shown, lambda line: (line["method"], line["preset"])).items()
        ]
        if curves:
            curves.append(chart.level("a success is below", [line["value"] for line in shown], MAX_ERROR))
        panels.append(chart.panel_data(name, condition.label, conditions.LABEL, curves))
    return chart.draw(panels, 2.1 * len(lines_by_family) + 0.5, len(lines_by_family), legend=3, sharey="row")


def _succeeded(record: Record) -> bool:
    return record["status"] == "ok" and CHAMFER_SCALE * error(record, ONE_WAY) < MAX_ERROR


def _successes(records: Sequence[Record]) -> str:
    shapes = grouped(records, solid).values()
    successes = [sum(map(_succeeded, runs)) for runs in shapes]
    rate = statistics.share(successes, [len(runs) for runs in shapes])
    return table.count_with_interval(sum(successes), len(records), rate)


def _verdict(runs: Runs) -> str:
    """The fraction of successes of each row, over misplaced runs, and over those that start at the true place."""
    misplaced, undisplaced = list[Record](), list[Record]()
    for record in runs.records:
        if any(c.value_of(record) != c.neutral for c in CONDITIONS):
            misplaced.append(record)
        elif not is_place_known(record):
            undisplaced.append(record)
    ends = table.extremes(
        f"Misplaced runs that end with an error (Chamfer × 1000) below {MAX_ERROR:g}",
        _shares(misplaced),
        conditions.shapes_text(misplaced),
        show=table.percent,
        largest_first=True,
    )
    others = " to ".join(sorted({*map(table.percent, _shares(undisplaced).values())}))
    return f"{ends} Of runs that start at the true place, and also optimise it: {others}." if others else ends


def _shares(chosen: list[Record]) -> dict[str, float]:
    return {row.name: sum(map(_succeeded, group)) / len(group) for row, group in grouped(chosen, row_of).items()}


def pictures(runs: Runs) -> Result:
    first = gallery.first_shapes(runs, 1)
    scenes = {name: gallery.Scene(first, records, gallery.SHAPES) for name, records in first.families().items()}
    return Result(
        first,
        "Shapes from many views, misplaced at the start, in pictures.",
        "The first shape of each family: its initial shape and the result of each row, over the initial displacement.",
        remarks=(
            f"{gallery.NORMALS_PHRASE}, seen from the side of the first photograph.",
            "Start: the misplaced shape of the random code. At “known place”, no similarity transform is optimised.",
            "DIST, Fig. 24, shows photographs of real chairs with the results of PMO. These shapes are synthetic.",
            *gallery.missing_notes(scenes.values()),
        ),
        run_columns=RUNS,
        figure=gallery.draw([_block(name, records, scenes[name]) for name, records in first.families().items()]),
    )


def _block(name: str, records: list[Record], scene: gallery.Scene) -> gallery.Block:
    by_start = dict(sorted(grouped(records, _start).items()))
    starts = [scene.shared(group, gallery.normals(gallery.START)) for group in by_start.values()]
    rows: dict[str, Any] = {"start": [*starts, scene.shared(records, gallery.normals(gallery.GROUND_TRUTH))]}
    for row, row_records in grouped(records, row_of).items():
        record_of = {_start(record): record for record in row_records}
        rows[row.name] = [scene.cell(record_of.get(start), gallery.normals(gallery.PREDICTED)) for start in by_start]
    return gallery.Block(name, [*map(_heading, by_start), "truth"], rows)


def _start(record: Record) -> tuple[float, ...]:
    """The displacement of a run's start in each condition, and whether its place is known."""
    return (*(c.value_of(record) - c.neutral for c in CONDITIONS), is_place_known(record))


def _heading(start: tuple[float, ...]) -> str:
    *offsets, place_known = start
    parts = [UNITS[c.key].format(offset + c.neutral) for c, offset in zip(CONDITIONS, offsets, strict=True) if offset]
    return "\n".join(parts) or ("known\nplace" if place_known else "in place")


PAGES = {"fig12": make, "misplaced_gallery": pictures}
