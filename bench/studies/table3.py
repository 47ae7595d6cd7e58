"""Table 3 and Figs. 11 and 23 of DIST: shape from many views, from random initial codes."""

from bench.report.study import Result, Runs, Selection, compare, conditions, gallery, medians, records, table

PLACE = 40
READS = (Selection("table3"),)
REFERENCE = "multiview_dist"
# DIST (Liu et al. 2020), Table 3: Chamfer from truth to prediction x 1000, of 50 shapes of the test set of PMO.
PUBLISHED = {
    "car": {"PMO": 0.661, "PMO, random start": 1.187, "DIST, random start": 0.919},
    "plane": {"PMO": 1.129, "PMO, random start": 6.124, "DIST, random start": 1.595},
}
NOTES = (
    "Error: mean squared distance from points of the true surface to the nearest of the found one, in that direction "
    "only, in squared scene units, times 1000; that of a run that did not end ok is infinite.",
    f"{compare.RATIO} {compare.FAILURE}",
    "Runs start from random codes, one per shape, the same for each method, but where a row starts from an encoder's "
    f"code. {compare.FITTED}",
    "“Published” is DIST, Table 3, which does not say whether it has means or medians: 50 shapes of PMO's renderings "
    "of ShapeNet, with another prior and metric scale, which cannot be compared directly with the measured rows.",
)
ENCODER_KEY = "task.encoder.batch"  # set if a row starts from an encoder's code
PMO = {"multiview_mesh": "PMO, random start", "multiview_mesh_encoder": "PMO"}  # comparable published row of a preset
ON_MESH = (
    "“{row}” has its gradients through vertices of the prior's mesh, as PMO (Lin et al. 2019), but changes the code "
    "alone: read it beside “published: {published}”."
)
ENCODER = (
    "The encoder learns from photographs of decoded training codes by the same kind of cameras; a run starts from its "
    "mean over all photographs (PMO: one). Its training is in no column."
)
ERROR_COLUMNS = table.metrics(records.ONE_WAY, "chamfer_l2")
RUNS = (
    *(table.FAMILY, *table.IDENTITY, *ERROR_COLUMNS, *table.metrics("accuracy", "completeness", "mask_iou")),
    table.Column(f"{records.ONE_WAY}_start", value=lambda record: record["metrics_start"].get(records.ONE_WAY)),
    *table.LOOP,
)
MAX_SHAPES = 4  # per family in pictures


def make(runs: Runs) -> Result:
    """A line per family and method, with the start, the oracle and published numbers of each family."""
    compared = compare.Compared(runs, lambda _: REFERENCE, records.ONE_WAY, conditions.LABEL)
    starts = records.CHAMFER_SCALE * runs.number(f"start_{records.ONE_WAY}")
    encoded = runs.setting(ENCODER_KEY) != ""
    starts_by_kind = {"start: random codes": starts[~encoded], "start: encoder's codes": starts[encoded]}
    above = {
        **{
            name: errors.groupby(runs.frame.family, sort=False).median().dropna().to_dict()
            for name, errors in starts_by_kind.items()
        },
        compare.ORACLE: compare.oracles(runs, records.ONE_WAY),
    }
    published = {name: {row: {"": str(number)} for row, number in rows.items()} for name, rows in PUBLISHED.items()}
    on_mesh = [ON_MESH.format(row=row.name, published=PMO[row.preset]) for row in runs.rows() if row.preset in PMO]
    return compared.result(
        "Shape from many views, without a mask.",
        "Which method finds a shape by photographs from many views, without a mask?",
        plotted="Median error over {shapes and seeds}, over shapes alone, its ratio, and the median cost of runs that "
        "ended ok.",
        verdict=compared.best("errors × 1000, from truth to prediction"),
        remarks=(*NOTES, *on_mesh, *([ENCODER] if encoded.any() else [])),
        columns=compared.columns("Ratio to DIST"),
        lines=compared.extended_lines(above, published),
        run_columns=RUNS,
    )


def pictures(runs: Runs) -> Result:
    """A line per shape: the truth, the start, and the shape of each row."""
    shown = gallery.first_shapes(runs, MAX_SHAPES)
    names, records_by_scene = [row.name for row in shown.rows()], records.grouped(shown.records, medians.scene_of)
    scenes = {name: gallery.Scene(shown, group, gallery.SHAPES) for name, group in records_by_scene.items()}
    lines = {name: _cells(names, group, scenes[name]) for name, group in records_by_scene.items()}
    return Result(
        shown,
        "Shapes from many views in pictures.",
        f"The truth, the start, and the shape that each row found, of the {MAX_SHAPES} shapes of each family with the "
        "least numbers.",
        remarks=(
            f"{gallery.NORMALS_PHRASE}, seen from the first photograph's side.",
            "Start: the shape of the random code that rows begin with, but those with an encoder; a mesh row is "
            "no run of PMO's code.",
            "DIST, Figs. 11 and 23, shows shapes of ShapeNet beside PMO; these are of other families.",
            *gallery.missing_notes(scenes.values()),
        ),
        run_columns=(table.FAMILY, *table.IDENTITY, *ERROR_COLUMNS),
        figure=gallery.draw([gallery.Block("", ["truth", "start", *names], lines)]),
    )


def _cells(names: list[str], group: list[records.Record], scene: gallery.Scene) -> list[gallery.Cell]:
    record_by_row = {records.row_of(record).name: record for record in group}
    drawn = [r for r in group if records.setting(r["config"], *ENCODER_KEY.split(".")) is None]
    shared = [
        scene.shared(group, gallery.normals(gallery.GROUND_TRUTH)),
        scene.shared(drawn, gallery.normals(gallery.START)),
    ]
    return [*shared, *(scene.cell(record_by_row.get(name), gallery.normals(gallery.PREDICTED)) for name in names)]


PAGES = {"table3": make, "multiview_gallery": pictures}
