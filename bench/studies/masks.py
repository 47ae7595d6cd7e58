"""Reconstruction from photographs with masks, and without them in front of a textured room."""

from bench.report.study import Selection, compare

PLACE = 48
READS = (Selection("masks"),)
NOTES = (
    "Error: Chamfer-L1 over what photographs see, in scene units, times 1000. A failed run counts as infinite.",
    f"{compare.RATIO} {compare.FAILURE}",
    "The cameras stand in a room with a texture, the same in all photographs. Rows without masks learn the room as a "
    "network of direction and inverse radius (`+task.background=sphere`), and compare the colours of all pixels.",
)

PAGES = {
    "masks": compare.Comparison(
        title="Photographs with and without masks.",
        question="How much worse is a reconstruction without masks?",
        reference="masks_neus",
        name="NeuS with masks",
        notes=lambda _: NOTES,
        metric="seen_chamfer_l1",
        label="Chamfer-L1 × 1000\n(scene units)",
    )
}
