"""After Figs. 12 and 24 of DIST: shape from many views where the initial similarity is wrong, and optimised as well."""

from collections.abc import Sequence
from typing import Any

from bench.report.data.records import ONE_WAY, SCALE, Record, error, family, grouped, row_of, setting, solid
from bench.report.study import Result, Runs, Selection, conditions, format, gallery, statistics, table

PLACE = 55
CONDITIONS = (
    conditions.Condition("shift", "shift (scene units)", 0.0),
    conditions.Condition("degrees", "rotation (degrees)", 0.0),
    conditions.Condition("scale", "size / true size", 1.0),
)
READS = (Selection("fig12", (*(f"task.{one.key}" for one in CONDITIONS), "task.similarity")),)
SUCCESS = 1.0  # squared scene units x 1000, about what DIST publishes in its Table 3
NOTES = (
    f"A success ended ok with an error below {SUCCESS:g}; its interval is Clopper and Pearson's, over shapes.",
    "One condition varies, the others are neutral; a shift's direction, a rotation's axis and the initial code are "
    "random, the same for every method.",
    "At zero displacement a similarity is optimised as well; “place known” is without one, and has no point.",
    "A run that did not end ok counts as infinite, drawn at the upper edge.",
    "The paper (Fig. 12) shows pictures of real chairs and no numbers; here shapes and photographs are synthetic.",
)
RUNS = conditions.run_columns(CONDITIONS, "similarity")
KNOWN = "place known"
UNITS = {"shift": "shifted by {:g}", "degrees": "turned by {:g}°", "scale": "{:g} times\nas large"}


def place_known(record: Record) -> bool:
    """Whether a run began in place, and no similarity was optimised."""
    return not setting(record["config"], "task", "similarity") and all(
        one.of(record) == one.neutral for one in CONDITIONS
    )


def make(runs: Runs) -> Result:
    """A line per family, method and value of a condition."""
    lines = conditions.lines_of([record for record in runs.made.records if not place_known(record)], CONDITIONS)
    known = grouped(filter(place_known, runs.records), lambda record: (family(record), row_of(record)))
    others = [
        {"family": name, "method": row.name, "condition": KNOWN, "runs": own, "error": conditions.middle(own)}
        for (name, row), own in known.items()
    ]
    return Result(
        runs,
        "Shape from many views, misplaced at the start.",
        f"Runs that succeeded, and {conditions.BELOW}, over the displacement.",
        question="Is a shape found from a wrong similarity?",
        verdict=_verdict(runs),
        interval=conditions.INTERVALS,
        estimates=[line["error"] for line in lines],
        remarks=NOTES,
        columns=(*conditions.NAMED, table.shown("Success", lambda line: _successes(line["runs"])), *conditions.MEDIAN),
        lines=lines + others,
        run_columns=RUNS,
        figure=conditions.draw(lines, CONDITIONS, SUCCESS) if lines else None,
    )


def _succeeded(record: Record) -> bool:
    return record["status"] == "ok" and SCALE * error(record, ONE_WAY) < SUCCESS


def _successes(records: Sequence[Record]) -> str:
    of_shape = [[_succeeded(run) for run in runs] for runs in grouped(records, solid).values()]
    return table.counted(
        sum(map(sum, of_shape)), len(records), statistics.share(list(map(sum, of_shape)), list(map(len, of_shape)))
    )


def _verdict(runs: Runs) -> str:
    """The share of successes of each row, over the runs that did not begin in place."""
    off = [record for record in runs.records if any(one.of(record) != one.neutral for one in CONDITIONS)]
    shares = {row.name: sum(map(_succeeded, own)) / len(own) for row, own in grouped(off, row_of).items()}
    shapes = format.plural(len({solid(record) for record in off}), "shape")
    return format.ends(
        f"Misplaced runs that end with an error below {SUCCESS:g}", shares, shapes, show=table.percent, most=True
    )


def pictures(runs: Runs) -> Result:
    """A block per family: the start over the displacement, and what each row found below it."""
    first = gallery.first_shapes(runs, 1)
    scenes = {name: gallery.Scene(first, records, gallery.SHAPES) for name, records in first.families().items()}
    return Result(
        first,
        "Shapes from many views, misplaced at the start, in pictures.",
        "The shape with the least number of each family: where it began, and what each row found, over the "
        "displacement.",
        remarks=(
            f"{gallery.JUDGED}, seen from the first photograph's side.",
            "Start: the shape of the random code, misplaced; at “known place” no similarity is optimised.",
            "DIST, Fig. 24, shows photographs of real chairs, and what PMO makes of them; these shapes are synthetic.",
            *gallery.missing(scenes.values()),
        ),
        run_columns=RUNS,
        figure=gallery.draw([_block(name, own, scenes[name]) for name, own in first.families().items()]),
    )


def _block(name: str, records: list[Record], scene: gallery.Scene) -> gallery.Block:
    of_place = dict(sorted(grouped(records, _place).items()))
    starts = [scene.shared(of, gallery.normals(gallery.START)) for of in of_place.values()]
    rows: dict[str, Any] = {"start": [*starts, scene.shared(records, gallery.normals(gallery.TRUE))]}
    for row, of_row in grouped(records, row_of).items():
        at = {_place(record): record for record in of_row}
        rows[row.name] = [scene.cell(at.get(place), gallery.normals(gallery.FOUND)) for place in of_place]
    return gallery.Block(name, [*map(_words, of_place), "truth"], rows)


def _place(record: Record) -> tuple[float, ...]:
    """How far off a run's start is, in each condition, and whether its place is known."""
    return (*(one.of(record) - one.neutral for one in CONDITIONS), place_known(record))


def _words(place: tuple[float, ...]) -> str:
    *offs, known = place
    found = [UNITS[one.key].format(off + one.neutral) for one, off in zip(CONDITIONS, offs, strict=True) if off]
    return "\n".join(found) or ("known\nplace" if known else "in place")


PAGES = {"fig12": make, "misplaced_gallery": pictures}
