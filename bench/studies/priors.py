"""The best possible fit of each prior to unseen shapes, with pictures and the length of its gradient."""

import math

from bench.report.study import Result, Runs, compare, format, gallery, records, statistics, table

PLACE = 70
READS = (compare.PRIORS,)
PICTURED_SHAPES = 3  # per family
DEFINED = {
    "chamfer_l2": "Fit",
    "floor_chamfer_l2": "Floor",
    "distance_error": "Error of the distance",
    "slope_median": "|gradient|",
    "slope_p99": "|gradient|, 99 %",
}
NOTES = (
    "A latent code of each prior is fitted to the signed distances of an unseen shape (DeepSDF, Eq. 10). The floor is "
    "the Chamfer distance between two samples of the true surface. A failed run counts as infinite.",
)


def _ratio(record: records.Record) -> float | None:
    fit, floor = (records.measured(record, name) for name in ("chamfer_l2", "floor_chamfer_l2"))
    return None if fit is None or not floor else fit / floor


RUNS = (table.FAMILY, *table.IDENTITY, *table.metrics(*DEFINED), table.Column("ratio", value=_ratio))
COLUMNS = (
    *table.columns(table.word, family="Family", shapes="Shapes"),
    *(table.Column(name, DEFINED[name], show=table.thousandfold) for name in ("chamfer_l2", "floor_chamfer_l2")),
    *table.columns(ratio="Fit / floor", largest="largest"),
    *(table.Column(name, DEFINED[name]) for name in ("distance_error", "slope_median", "slope_p99")),
)


def make(runs: Runs) -> Result:
    ratios = [_ratio(record) if record["status"] == "ok" else None for record in runs.records]
    values = runs.frame[["family"]].assign(
        **{name: runs.error(name, 1) for name in DEFINED},
        ratio=[math.inf if ratio is None else ratio for ratio in ratios],
    )
    lines = [
        {"family": name, "shapes": len(shapes), "largest": float(shapes.ratio.max())}
        | {column: float(statistics.median(shapes[column].to_numpy())) for column in (*DEFINED, "ratio")}
        for name, shapes in values.groupby("family", sort=False)
    ]
    median, largest = (format.number(float(summary(values.ratio.to_numpy()))) for summary in (statistics.median, max))
    return Result(
        runs,
        "The best fit of each prior to unseen shapes.",
        "Chamfer distance times 1000 (squared scene units) of each prior's best fit, and its smallest measurable value "
        "(floor), medians over shapes. Pictures: normals of ground truth and fit.",
        question="How well can a prior represent an unseen shape?",
        verdict=f"The best fit has *{median}* times the smallest measurable error (median), at most {largest} "
        f"times; n = {format.plural(len(values), 'shape')}.",
        remarks=(*NOTES, *records.definitions(runs.records, DEFINED)),
        columns=COLUMNS,
        lines=lines,
        run_columns=RUNS,
        figure=gallery.draw([_block(runs, name, shapes[:PICTURED_SHAPES]) for name, shapes in runs.families().items()]),
    )


def _block(runs: Runs, name: str, shown: list[records.Record]) -> gallery.Block:
    cells, titles = [], []
    for record in shown:
        scene, ratio = gallery.Scene(runs, [record], gallery.REFERENCE), _ratio(record)
        cells += [scene.shared([record], gallery.normals("reference_")), scene.cell(record, gallery.normals())]
        titles += ["truth", "fit" if ratio is None else f"fit: {format.number(ratio)} × floor"]
    return gallery.Block("", titles, {name: cells})


PAGES = {"priors": make}
