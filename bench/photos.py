"""`python -m bench.photos FOLDER`: says what photographs a folder has, and draws the visual hull over their masks."""

import argparse
import sys
from pathlib import Path

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure

from bench.pictures.style import SCREEN, bare, silhouette_image
from datasets.captures.hull import MaskFit
from datasets.captures.sphere import likely_cause
from datasets.own_photographs import AXES, GOOD_OVERLAP, PHOTOS_HINT, WARN_BELOW, Capture, ReadSettings, read_capture
from renderers.camera import sphere_span

MOST = 8  # photographs in the picture
OUTLINE = "#e5007d"
NAMED = 5  # photographs that fit worst


def told(fit: MaskFit, capture: Capture) -> list[str]:
    """The fit of the visual hull in words."""
    overlaps = fit.overlaps
    middle, order = float(np.median(overlaps)), np.argsort(overlaps)
    found = [f"the visual hull and the masks overlap by {middle:.0%} (median; {GOOD_OVERLAP:.0%} and more is good)"]
    worst = [place for place in order[:NAMED] if overlaps[place] < WARN_BELOW]
    if worst:
        named = ", ".join(f"{capture.shots[place].name} {overlaps[place]:.0%}" for place in worst)
        found.append(f"note: least in {named}: look at their masks and cameras")
    if middle < WARN_BELOW and not likely_cause(capture.shots):
        found.append("note: cameras and masks hardly fit: one wrong one is enough; or try --axes flipped")
    return found


@rc_context(SCREEN)
def draw(capture: Capture) -> Figure:
    """Photographs, evenly spaced and the one that fits worst, with the unit sphere; the hull over the masks below."""
    silhouettes, overlaps = (capture.fit.silhouettes, capture.fit.overlaps) if capture.fit else ((), ())
    chosen = np.linspace(0, len(capture.shots) - 1, min(MOST, len(capture.shots))).round().astype(int)
    if overlaps and (worst := int(np.argmin(overlaps))) not in chosen:
        chosen[np.abs(chosen - worst).argmin()] = worst
    shots = [capture.shots[place] for place in chosen]
    figure = Figure(figsize=(1.6 * len(shots), 3.6 if overlaps else 2.0), layout="constrained")
    axes = figure.subplots(2 if overlaps else 1, len(shots), squeeze=False)
    outlined = ""
    for axis, shot in zip(axes[0], shots, strict=True):
        bare(axis).imshow(shot.colours.numpy())
        axis.set_title(Path(shot.name).stem)
        within = sphere_span(shot.camera.rays())[2].numpy()
        if within.any() and not within.all():
            axis.contour(within, [0.5], colors=OUTLINE, linewidths=0.8)
            outlined = "; the line is the unit sphere"
    figure.suptitle(f"{capture.format}: {len(shots)} of {len(capture.shots)} photographs{outlined}")
    if overlaps:
        for axis, place in zip(axes[1], chosen, strict=True):
            picture = silhouette_image(silhouettes[place], np.asarray(capture.shots[place].mask))
            bare(axis).imshow(picture, interpolation="nearest")
            axis.set_title(f"overlap {overlaps[place]:.0%}")
        axes[1, 0].set_ylabel("hull and mask")
        figure.supxlabel("grey both, red mask without hull, blue hull without mask")
    return figure


def main(arguments: list[str] | None = None) -> int:
    """Reads the command line; 0 where the photographs can be used."""
    parser = argparse.ArgumentParser(prog="python -m bench.photos", description=__doc__)
    parser.add_argument("folder", type=Path, help="with photographs and their cameras, see datasets/README.md")
    parser.add_argument("--longest", type=int, default=128, help="pixels of the longer side (default: %(default)s)")
    parser.add_argument("--axes", choices=tuple(AXES), default="stated", help="flipped: y and z turned round")
    parser.add_argument("--images", help="the folder of COLMAP's images, where it is not the usual one")
    parser.add_argument("--without-masks", action="store_true", help="as if there were none")
    parser.add_argument("--into", type=Path, default=Path("photos.png"), help="the picture (default: %(default)s)")
    given = parser.parse_args(arguments)
    into = given.into / "photos.png" if given.into.is_dir() else given.into.with_suffix(".png")
    try:
        into.parent.mkdir(parents=True, exist_ok=True)
        reading = ReadSettings(given.longest, not given.without_masks, given.axes, images=given.images, unchecked=True)
        capture = read_capture(given.folder, reading)
        draw(capture).savefig(into, dpi=110)
    except (OSError, ValueError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(capture.summary)
    for note in capture.notes:
        if PHOTOS_HINT not in note:  # which is told below
            print(f"note: {note}")
    if capture.fit:
        print("\n".join(told(capture.fit, capture)))
    print(into)
    return 0


if __name__ == "__main__":
    sys.exit(main())
