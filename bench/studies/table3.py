"""Table 3 and Figs. 11 and 23 of DIST: shape from many views, from random initial codes."""

from bench.report.study import Result, Runs, Selection, compare, conditions, gallery, medians, records, table

PLACE = 40
READS = (Selection("table3", must_agree=("task.images.views",)),)
NOTES = (
    "Error: mean squared distance from points of the true surface to the nearest points of the reconstruction, not the "
    "reverse, in squared scene units, times 1000. A failed run has an infinite error.",
    f"{compare.RATIO} {compare.FAILURE}",
    "Runs start from one random code per shape, the same for all methods. Rows with an encoder start from its code. "
    f"{compare.FITTED}",
    "“Published” is DIST, Table 3, which does not say whether it has means or medians: 50 shapes of PMO's renderings "
    "of ShapeNet. Prior and scale differ, so these numbers cannot be compared directly with the measured rows.",
)
ENCODER_KEY = "task.encoder.batch"  # set if a row starts from an encoder's code
PMO = {"multiview_mesh": "PMO, random start", "multiview_mesh_encoder": "PMO"}  # comparable published row of a preset
ON_MESH = (
    "“{row}” has gradients through the vertices of the prior's mesh, like PMO (Lin et al. 2019), but changes only the "
    "code. Its published counterpart is “published: {published}”."
)
ENCODER = (
    "The encoder is trained on photographs of decoded training codes. A run starts from the mean of its codes over all "
    "photographs (PMO: one photograph). No column includes its training."
)
ERROR_COLUMNS = table.metrics(records.ONE_WAY, "chamfer_l2")
RUNS = (
    *(table.FAMILY, *table.IDENTITY, *ERROR_COLUMNS, *table.metrics("accuracy", "completeness", "mask_iou")),
    table.Column(f"{records.ONE_WAY}_start", value=lambda record: record["metrics_start"].get(records.ONE_WAY)),
    *table.LOOP,
)
START = f"start_{records.ONE_WAY}"
MAX_SHAPES = 4  # per family in pictures


def _above(compared: compare.Compared) -> compare.Above:
    runs, errors = compared.runs, records.CHAMFER_SCALE * compared.runs.number(START, optional=True)
    encoded = runs.setting(ENCODER_KEY) != ""
    starts = {"initial error, random": errors[~encoded], "initial error, encoder": errors[encoded]}
    medians_of = {
        name: values.groupby(runs.frame.family, sort=False).median().dropna().to_dict()
        for name, values in starts.items()
    }
    return {**medians_of, compare.ORACLE: compared.oracles}


def _notes(compared: compare.Compared) -> list[str]:
    on_mesh = [ON_MESH.format(row=row.name, published=PMO[row.preset]) for row in compared.rows if row.preset in PMO]
    return [*NOTES, *on_mesh, ENCODER if (compared.runs.setting(ENCODER_KEY) != "").any() else ""]


def pictures(runs: Runs) -> Result:
    shown = gallery.first_shapes(runs, MAX_SHAPES)
    names, records_by_scene = [row.name for row in shown.rows()], records.grouped(shown.records, medians.scene_of)
    scenes = {name: gallery.Scene(shown, group, gallery.SHAPES) for name, group in records_by_scene.items()}
    lines = {name: _cells(names, group, scenes[name]) for name, group in records_by_scene.items()}
    return Result(
        shown,
        "Shapes from many views in pictures.",
        f"Ground truth, initial shape and result of each row, for the first {MAX_SHAPES} shapes of each family.",
        remarks=(
            f"{gallery.NORMALS_PHRASE}, seen from the side of the first photograph.",
            "Start: the shape of the random initial code, of rows without an encoder. Mesh rows do not run PMO's code.",
            "DIST, Figs. 11 and 23, compares with PMO on shapes of ShapeNet. These are shapes of other families.",
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


PAGE = compare.Comparison(
    title="Shape from many views, without a mask.",
    question="Which method best reconstructs a shape from photographs of many views, without a mask?",
    reference="multiview_dist",
    name="DIST",
    notes=_notes,
    plotted="Median error over {shapes and seeds}; median over shapes alone, with its ratio to DIST; median cost of "
    "runs that ended ok.",
    least_of="Chamfer × 1000 (scene units²) from ground truth to prediction",
    metric=records.ONE_WAY,
    label=conditions.LABEL,
    above=_above,
    published="dist_table3",
    run_columns=RUNS,
)
PAGES = {"table3": PAGE, "multiview_gallery": pictures}
