"""Fig. 4 of DIST: the images of each strategy of sphere tracing compared with the reference."""

from bench.report.study import Result, Runs, Selection, gallery, table

PLACE = 210
READS = (Selection("fig4", alike=("dataset", "view", "prior", "task")),)
NOTES = (
    "Pictures are cropped to the part with hits.",
    "A row that did not finish at the requested size is shown at its largest finished size.",
)
MAX_COLUMNS = 5
COLUMNS = (  # a line is a record and the counts of its picture
    *table.through(lambda line: line[0], *table.IDENTITY),
    *table.through(lambda line: line[1], *map(table.Column, gallery.COUNT_KEYS)),
    *table.through(lambda line: line[0], table.metric("depth_error_median")),
)


def make(runs: Runs) -> Result:
    chosen = runs.of_newest_scene()
    comparison = gallery.compare_with_reference(chosen, MAX_COLUMNS)
    data = table.to_data(COLUMNS, zip(chosen.records, comparison.counts, strict=True))
    wrong = dict(zip(chosen.names(), (data["lost"] + data["false"]).astype(float), strict=True))
    return Result(
        chosen,
        "Errors of each strategy in the image.",
        "Above, normals (right, up, towards the camera as red, green, blue); below, their angle to the normals of the "
        "reference.",
        question="How many pixels does each strategy get wrong, and which?",
        verdict=table.extremes("Missed and spurious pixels", wrong, "one shape", show=table.integer),
        remarks=(*comparison.missing, *NOTES),
        data=data,
        figure=gallery.draw(comparison.blocks, largest=comparison.largest),
    )


PAGES = {"fig4": make}
