"""Table 2 and Figs. 20 to 22 of DIST: shape completion over the sparsity of the depth image."""

from matplotlib.figure import Figure

from bench.report.study import Result, Runs, Selection, chart, compare, gallery, records, style, table

PLACE = 20
READS = (Selection("table2", ("task.points",), may_differ=("prior.truncation",)),)
HIDDEN_SUFFIXES = ("_paper", "_official")  # the figure leaves out these presets, to stay readable
NOTES = (
    f"{compare.RATIO} {compare.FAILURE}",
    "Dense depth includes the mask. “Paper's setting” is DIST, B.4, with the official code's mean of the squared "
    "latent code, and our mean of the silhouette loss over all pixels. The figure leaves out the papers' settings.",
    f"{compare.FITTED} “Published” is DIST, Table 2: 200 shapes of ShapeNet, with another prior and camera, and other "
    "numbers of points per percentage. These numbers do not compare with the measured ones.",
)
RUNS = (
    table.FAMILY,
    table.configured("points", "task", "points"),
    *table.COMPLETION,
    table.Column("chamfer_l2_start", value=lambda record: record["metrics_start"].get("chamfer_l2")),
    *table.LOOP,
)
PICTURED_PRESETS = ("deepsdf", "dist_depth", "dist_mask")
ARRAYS = (
    "given",
    *(kind + array for kind in (gallery.PREDICTED, gallery.GROUND_TRUTH) for array in ("normals", "hit")),
)
BOTH_SIDES = (gallery.FRONT, gallery.BEHIND)


def draw(compared: compare.Compared) -> Figure:
    conditions, oracle, panels = compared.conditions, compared.oracles, []
    positions = range(len(conditions))
    for family in compared.families:
        lines = []
        for row in compared.rows:
            medians = [compared.median(family, row, condition) for condition in conditions]
            if not row.preset.endswith(HIDDEN_SUFFIXES) and any(median is not None for median in medians):
                lines.append(chart.curve(row.name, row.preset, positions, style.finite(medians)))
        if family in oracle:
            lines.append(chart.level(compare.ORACLE, positions, oracle[family]))
            lines.append(chart.level("1.5 times the oracle", positions, 1.5 * oracle[family], dash=":"))
        panels.append(chart.panel_data(family, "observed depth points", compare.LABEL, lines, ticks=conditions))
    height = -(-len(panels) // 3)  # at most three panels side by side, so that the labels of the points have room
    return chart.draw(panels, 2.1 * height + 0.7, height, sharey=True)


def _notes(compared: compare.Compared) -> tuple[str, ...]:
    counts = compared.cells.groupby(["family", "row", "condition"], observed=True).solid.nunique()
    shapes = f"Shapes per family and row: {counts.min()}{f' to {counts.max()}' if counts.nunique() > 1 else ''}."
    return compare.ERROR, f"{shapes} {_iterations(compared.runs)}", *NOTES


def _iterations(runs: Runs) -> str:
    groups = records.grouped(runs.records, records.iterations_of)
    names = {n: list(dict.fromkeys(records.row_of(r).name for r in group)) for n, group in groups.items() if n}
    usual = max(names, key=lambda count: len(names[count]), default=None)
    others = [f"{count} of {'; '.join(rows)}" for count, rows in names.items() if count != usual]
    return f"Iterations of a run: {'. Others: '.join([str(usual), *others])}." if names else ""


def pictures(runs: Runs) -> Result:
    shown = gallery.first_shapes(runs, 1, PICTURED_PRESETS)
    scenes = {name: gallery.Scene(shown, group, ARRAYS) for name, group in shown.families().items()}
    return Result(
        shown,
        "Completed shapes in pictures.",
        "The first shape of each family for each number of depth points, seen by the given camera and from behind.",
        remarks=(
            f"{gallery.NORMALS_PHRASE}; observed depths are yellow near the camera.",
            "Dense depth includes the mask, and “DIST with mask” always has the mask. DeepSDF has the true normals.",
            "DIST, Figs. 20 to 22, shows shapes of ShapeNet. These are shapes of other families, from another prior.",
            *gallery.missing_notes(scenes.values()),
        ),
        run_columns=(*RUNS[:2], *table.COMPLETION),
        figure=gallery.draw([_block(name, group, scenes[name]) for name, group in shown.families().items()], across=2),
    )


def _block(name: str, family_records: list[records.Record], scene: gallery.Scene) -> gallery.Block:
    by_points = records.grouped(family_records, _points)
    points = compare.ordered(by_points)
    given_depths = [scene.shared(by_points[p][:1], gallery.depth) for p in points]
    rows = {
        "given depths": [*given_depths, scene.shared(family_records, gallery.normals(gallery.GROUND_TRUTH), BOTH_SIDES)]
    }
    for row, row_records in records.grouped(family_records, records.row_of).items():
        by_row_points = {_points(record): record for record in row_records}
        rows[row.name] = [
            scene.cell(by_row_points.get(p), gallery.normals(gallery.PREDICTED), BOTH_SIDES) for p in points
        ]
    return gallery.Block(name, [*map(compare.heading, points), "truth"], rows)


def _points(record: records.Record) -> str:
    return str(records.setting(record["config"], "task", "points"))


PAGE = compare.Comparison(
    title="Shape completion from one depth image, by its number of points.",
    question="Which method completes a shape best from sparse depth?",
    reference="dist_mask",
    name="DIST with mask",
    notes=_notes,
    plotted="Median error over {shapes and seeds} for each number of depth points, and for all numbers together.",
    least_of="Chamfer × 1000 (scene units²) over all numbers of depth points",
    above=lambda compared: {compare.ORACLE: compared.oracles},
    published="dist_table2",
    hidden=compare.COSTS,
    run_columns=RUNS,
    figure=draw,
)
PAGES = {"table2": PAGE, "completion_gallery": pictures}
