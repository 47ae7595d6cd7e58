"""`python -m bench.photos FOLDER`: says what photographs a folder has, and draws the visual hull over their masks."""

import argparse
import sys
from pathlib import Path

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure

from bench.pictures.style import SCREEN, bare, silhouette_image
from datasets.captures.capture import AXES, Capture, read_capture
from datasets.captures.hull import hull_mesh, hull_views

MOST = 8  # photographs in the picture
SAMPLES = 96  # of the hull, per axis
DOUBTFUL = 0.8  # of the masks: where the hull covers less, cameras and masks hardly fit


@rc_context(SCREEN)
def draw(capture: Capture) -> tuple[Figure, float | None]:
    """The photographs, with the hull's silhouette over the masks below; and the share of the masks that it covers."""
    chosen = np.unique(np.linspace(0, len(capture.shots) - 1, min(MOST, len(capture.shots))).round().astype(int))
    shots = [capture.shots[place] for place in chosen]
    figure = Figure(figsize=(1.6 * len(shots), 3.6 if capture.masks else 2.0), layout="constrained")
    axes = figure.subplots(2 if capture.masks else 1, len(shots), squeeze=False)
    for axis, shot in zip(axes[0], shots, strict=True):
        bare(axis).imshow(shot.colours.numpy())
        axis.set_title(Path(shot.name).stem)
    figure.suptitle(f"{capture.format}: {len(shots)} of {len(capture.shots)} photographs")
    if not capture.masks:
        return figure, None
    covered = []
    for axis, shot, seen in zip(axes[1], shots, hull_views(shots, hull_mesh(capture.shots, SAMPLES)), strict=True):
        assert shot.mask is not None
        covered.append(float((seen & shot.mask).sum() / shot.mask.sum()))
        bare(axis).imshow(silhouette_image(seen.numpy(), shot.mask.numpy()), interpolation="nearest")
        axis.set_title(f"{covered[-1]:.0%} of the mask")
    axes[1, 0].set_ylabel("hull and mask")
    figure.supxlabel("grey both, red mask without hull, blue hull without mask")
    return figure, float(np.median(covered))


def main(arguments: list[str] | None = None) -> int:
    """Reads the command line; 0 where the photographs can be used."""
    parser = argparse.ArgumentParser(prog="python -m bench.photos", description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--longest", type=int, default=128, help="pixels of a photograph's longer side")
    parser.add_argument("--axes", choices=tuple(AXES), default="stated")
    parser.add_argument("--without-masks", action="store_true")
    parser.add_argument("--into", type=Path, default=Path("photos.png"), help="the picture's file")
    given = parser.parse_args(arguments)
    try:
        capture = read_capture(given.folder, longest=given.longest, masks=not given.without_masks, axes=given.axes)
        figure, covered = draw(capture)
        figure.savefig(given.into, dpi=110)
    except (OSError, ValueError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(capture.summary)
    for note in capture.notes:
        print(f"note: {note}")
    if covered is not None:
        print(f"the visual hull covers {covered:.0%} of the masks (median of the photographs in the picture)")
        if covered < DOUBTFUL:
            print("note: cameras and masks hardly fit: look at the picture, and try --axes flipped")
    print(given.into)
    return 0


if __name__ == "__main__":
    sys.exit(main())
