"""Photographs from one side: what renderers make of the side that none of them shows, and where their weights lie."""

from bench.report.study import Result, Runs, Selection, format, gallery, medians, records, table

PLACE = 51
READS = (Selection("unseen_back", setup=("scenes", "machine")),)
NAMES = ("seen_roughness", "unseen_roughness", "own_early_weight", "seen_chamfer_l1", "chamfer_l1", "mask_iou")
DEFINED = {"seen_roughness": "Roughness", "unseen_roughness": "Roughness", "own_early_weight": "Early weight"}
SCENES = 3  # of the figure
BACK = "back_"  # prefix of arrays of the view from behind
NOTES = (
    "All photographs are from within 45 degrees of one direction, and pictures from the opposite one.",
    "A row's name says its loss of the mask, and without one it is the renderer's own: read a renderer under two "
    "losses, or two renderers under one.",
)
COLUMNS = (
    table.text("method", "Method"),
    table.Column("seen_roughness", "Roughness, seen (degrees)"),
    table.Column("unseen_roughness", "unseen"),
    table.Column("own_early_weight", "Early weight", show=table.percent),
    table.Column("seen_chamfer_l1", "Chamfer-L1, seen", show=table.thousandfold),
    table.Column("chamfer_l1", "all", show=table.thousandfold),
    table.Column("mask_iou", "Mask IoU"),
    *medians.COST,
)
RUNS = (table.FAMILY, *table.IDENTITY, *table.metrics(*NAMES), *table.LOOP)


def make(runs: Runs) -> Result:
    """A line per row, and pictures from behind."""
    lines, every = medians.medians(runs, NAMES), records.grouped(runs.records, medians.scene_of)
    arrays = [BACK + part for part in ("truth", "colours", "normals", "hit")]
    scenes = {name: gallery.Scene(runs, every[name], arrays) for name in list(every)[:SCENES]}
    truth = ("truth", "normals", lambda found: [found[f"{BACK}truth"]])
    blocks = [
        gallery.colours_above_normals(scene, name, runs.rows(), every[name], truth, BACK)
        for name, scene in scenes.items()
    ]
    return Result(
        runs,
        "Photographs from one side, and the back that none shows.",
        f"Medians over {format.plural(len(every), 'scene')}, distances in scene units, times 1000; in the figure, "
        "colours above and normals below, from behind.",
        question="What leaves bumps on the side that no photograph shows?",
        verdict=format.ends(
            "Roughness of the unseen side above the truth's (degrees)",
            medians.whole(lines, "unseen_roughness"),
            format.plural(len(every), "scene"),
        ),
        remarks=(
            *(*NOTES, records.shared_settings(runs.records, {"field": ("field",)})),
            *(*records.definitions(runs.records, DEFINED), *gallery.missing(scenes.values())),
        ),
        columns=COLUMNS,
        lines=lines,
        run_columns=RUNS,
        figure=gallery.draw(blocks),
    )


PAGES = {"unseen_back": make}
