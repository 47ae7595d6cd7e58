"""Table 2 and Figs. 20 to 22 of DIST: shape completion over the sparsity of the depth image."""

from matplotlib.figure import Figure

from bench.report.study import Result, Runs, Selection, chart, compare, gallery, records, style, table

PLACE = 20
READS = (Selection("table2", ("task.points",)),)
REFERENCE = "dist_mask"
VARIANTS = ("_paper", "_official")  # ends of presets that the figure leaves out, to be read
# DIST (Liu et al. 2020), Table 2: median Chamfer x 1000 over 200 shapes of ShapeNet, in the order of `compare.ORDER`.
PUBLISHED = {
    "sofa": {
        "DeepSDF": (5.37, 5.56, 5.50, 5.93, 6.03, 7.63),
        "DIST": (4.12, 5.75, 5.49, 5.72, 5.57, 6.95),
        "DIST with mask": (4.12, 3.98, 4.31, 3.98, 4.30, 4.94),
    },
    "plane": {
        "DeepSDF": (3.71, 3.73, 4.29, 4.44, 4.40, 5.39),
        "DIST": (2.18, 4.08, 4.81, 4.44, 4.51, 5.30),
        "DIST with mask": (2.18, 2.08, 2.62, 2.26, 2.55, 3.60),
    },
    "table": {
        "DeepSDF": (12.93, 12.78, 11.67, 12.87, 13.76, 15.77),
        "DIST": (5.37, 12.05, 11.42, 11.70, 13.76, 15.83),
        "DIST with mask": (5.37, 5.15, 5.16, 5.26, 6.33, 7.62),
    },
}
NOTES = (
    f"{compare.RATIO} {compare.FAILURE}",
    "Dense depth implies the mask; “paper's setting” is that of DIST, B.4; the mean of the squared code is the "
    "official code's, the mean of the mask loss over all pixels is ours. The figure leaves out rows with "
    "the settings of papers.",
    f"{compare.FITTED} “Published” is DIST, Table 2: 200 shapes of ShapeNet with another prior and camera, and another "
    "number of points per share, so these numbers do not compare with the measured ones.",
)
RUNS = (
    table.FAMILY,
    table.configured("points", "task", "points"),
    *table.COMPLETION,
    table.Column("chamfer_l2_start", value=lambda record: record["metrics_start"].get("chamfer_l2")),
    *table.LOOP,
)
PICTURED = ("deepsdf", "dist_depth", "dist_mask")  # presets of the rows in pictures, where they were run
ARRAYS = ("given", *(kind + part for kind in (gallery.FOUND, gallery.TRUE) for part in ("normals", "hit")))
BOTH = (gallery.FRONT, gallery.BEHIND)


def make(runs: Runs) -> Result:
    """A line per family and row, with the oracle and published numbers beside each family."""
    found, oracle = compare.Compared(runs, lambda _: REFERENCE), compare.oracles(runs, compare.METRIC)
    published = {
        family: {row: dict(zip(compare.ORDER, numbers, strict=True)) for row, numbers in rows.items()}
        for family, rows in PUBLISHED.items()
    }
    columns = found.columns("Ratio to DIST with mask")
    return found.result(
        "Shape completion from one depth image, over its sparsity.",
        "Which method completes a shape best from sparse depth?",
        plotted="Median error over {shapes and seeds} at each number of given depth points, and over all.",
        verdict=found.best("errors × 1000 over all numbers of points"),
        remarks=(compare.ERROR, f"{_shapes(found)} {_iterations(runs)}", *NOTES),
        columns=[column for column in columns if column.key not in compare.COSTS],
        lines=found.beside({compare.ORACLE: oracle}, published),
        run_columns=RUNS,
        figure=draw(found, oracle),
    )


def draw(found: compare.Compared, oracle: dict[str, float]) -> Figure:
    """Draws a panel per family: the median of each row over the number of points, and the oracle."""
    places, panels = range(len(found.conditions)), []
    for family in found.families:
        lines = []
        for row in found.rows:
            medians = [found.median(family, row, at) for at in found.conditions]
            if not row.preset.endswith(VARIANTS) and any(median is not None for median in medians):
                lines.append(chart.curve(row.name, row.preset, places, style.finite(medians)))
        if family in oracle:
            lines.append(chart.level(compare.ORACLE, places, oracle[family]))
            lines.append(chart.level("1.5 times that", places, 1.5 * oracle[family], dash=":"))
        panels.append(chart.panel_data(family, "given depth points", compare.LABEL, lines, ticks=found.conditions))
    height = -(-len(panels) // 4)
    return chart.draw(panels, 2.4 * height + 0.7, height, sharey=True)


def _shapes(found: compare.Compared) -> str:
    counts = found.cells.groupby(["family", "row", "at"], observed=True).solid.nunique()
    return f"Shapes per cell: {counts.min()}{f' to {counts.max()}' if counts.nunique() > 1 else ''}."


def _iterations(runs: Runs) -> str:
    """The rows' iterations: the most frequent number, then the rows with another one."""
    counts = records.grouped(runs.records, records.iterations_of)
    names = {n: list(dict.fromkeys(records.row_of(record).name for record in own)) for n, own in counts.items() if n}
    most = max(names, key=lambda count: len(names[count]), default=None)
    others = [f"{', '.join(rows)} {count}" for count, rows in names.items() if count != most]
    return f"Iterations: {'; '.join([str(most), *others])}." if names else ""


def pictures(runs: Runs) -> Result:
    """A block per family: the given depths over their number, and each row's shape below them."""
    shown = gallery.first_shapes(runs, 1, PICTURED)
    scenes = {name: gallery.Scene(shown, own, ARRAYS) for name, own in shown.families().items()}
    return Result(
        shown,
        "Completed shapes in pictures.",
        "The shape with the least number of each family at each number of given depth points, from the given camera "
        "and from behind.",
        remarks=(
            f"{gallery.JUDGED}; given depths are yellow where they are near.",
            "Dense depth implies the mask, “DIST with mask” sees it at all numbers of points, and DeepSDF is given the "
            "true normals.",
            "DIST, Figs. 20 to 22, shows shapes of ShapeNet; these are of other families and another prior.",
            *gallery.missing(scenes.values()),
        ),
        run_columns=(*RUNS[:2], *table.COMPLETION),
        figure=gallery.draw([_block(name, of, scenes[name]) for name, of in shown.families().items()], across=2),
    )


def _block(name: str, of_family: list[records.Record], scene: gallery.Scene) -> gallery.Block:
    """The rows of a family over the number of points, behind them the truth."""
    found = records.grouped(of_family, _points)
    points = compare.ordered(found)
    given = [scene.shared(found[p][:1], gallery.depth) for p in points]
    rows = {"given depths": [*given, scene.shared(of_family, gallery.normals(gallery.TRUE), BOTH)]}
    for row, own in records.grouped(of_family, records.row_of).items():
        at = {_points(record): record for record in own}
        rows[row.name] = [scene.cell(at.get(p), gallery.normals(gallery.FOUND), BOTH) for p in points]
    return gallery.Block(name, [*map(compare.heading, points), "truth"], rows)


def _points(record: records.Record) -> str:
    return str(records.setting(record["config"], "task", "points"))


PAGES = {"table2": make, "completion_gallery": pictures}
