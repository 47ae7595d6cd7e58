"""`python -m bench.photos FOLDER`: describes photographs, and draws the visual hull over their masks."""

import argparse
import sys
from pathlib import Path

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure

from bench.pictures.style import SCREEN, bare, silhouette_image
from bench.records.results import RESULTS
from bench.tables import choice
from datasets.files.captures.frames import AXES
from datasets.files.captures.hull import MaskFit
from datasets.files.captures.sphere import likely_cause
from datasets.files.own_photographs import (
    GOOD_OVERLAP,
    PHOTOS_HINT,
    WARN_BELOW,
    Capture,
    ReadSettings,
    read_capture,
)
from renderers.camera import sphere_span

MAX_SHOWN_PHOTOGRAPHS = 8
OUTLINE_COLOUR = "#e5007d"
MAX_NAMED_PHOTOGRAPHS = 5


def describe_fit(fit: MaskFit, capture: Capture) -> list[str]:
    overlaps = fit.overlaps
    median, order = float(np.median(overlaps)), np.argsort(overlaps)
    lines = [f"the visual hull and the masks overlap by {median:.0%} (median; {GOOD_OVERLAP:.0%} and more is good)"]
    worst = [index for index in order[:MAX_NAMED_PHOTOGRAPHS] if overlaps[index] < WARN_BELOW]
    if worst:
        worst_names = ", ".join(f"{capture.shots[index].name} {overlaps[index]:.0%}" for index in worst)
        lines.append(f"note: least in {worst_names}: look at their masks and cameras")
    if median < WARN_BELOW and not likely_cause(capture.shots):
        lines.append("note: cameras and masks hardly fit: one wrong one is enough")
    return lines


@rc_context(SCREEN)
def draw(capture: Capture) -> Figure:
    """Evenly spaced photographs and the one with the worst fit, with the unit sphere; below, hull and masks."""
    silhouettes, overlaps = (capture.fit.silhouettes, capture.fit.overlaps) if capture.fit else ((), ())
    indices = np.linspace(0, len(capture.shots) - 1, min(MAX_SHOWN_PHOTOGRAPHS, len(capture.shots))).round().astype(int)
    if overlaps and (worst := int(np.argmin(overlaps))) not in indices:
        indices[np.abs(indices - worst).argmin()] = worst
    shots = [capture.shots[index] for index in indices]
    figure = Figure(figsize=(1.6 * len(shots), 3.6 if overlaps else 2.0), layout="constrained")
    axes = figure.subplots(2 if overlaps else 1, len(shots), squeeze=False)
    outline_note = ""
    for axis, shot in zip(axes[0], shots, strict=True):
        bare(axis).imshow(shot.colours.numpy())
        axis.set_title(Path(shot.name).stem)
        in_sphere = sphere_span(shot.camera.rays())[2].numpy()
        if in_sphere.any() and not in_sphere.all():
            axis.contour(in_sphere, [0.5], colors=OUTLINE_COLOUR, linewidths=0.8)
            outline_note = "; the line is the unit sphere of a run"
    figure.suptitle(f"{capture.format}: {len(shots)} of {len(capture.shots)} photographs{outline_note}")
    if overlaps:
        for axis, index in zip(axes[1], indices, strict=True):
            picture = silhouette_image(silhouettes[index], np.asarray(capture.shots[index].mask))
            bare(axis).imshow(picture, interpolation="nearest")
            axis.set_title(f"overlap {overlaps[index]:.0%}")
        axes[1, 0].set_ylabel("hull and mask")
        figure.supxlabel("grey both, red mask without hull, blue hull without mask")
    return figure


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m bench.photos", description=__doc__)
    parser.add_argument("folder", type=Path, help="with photographs and their cameras, see datasets/README.md")
    longest, held_out = choice("scale", "desk")["reconstruction"]["longest"], choice("task", "_photographs")["held_out"]
    run = "as task.{} of a run (default: %(default)s)".format
    parser.add_argument("--longest", type=int, default=longest, help=f"pixels of the longer side, {run('longest')}")
    text = f"N: the sphere ignores each N-th photograph, {run('held_out')}"
    parser.add_argument("--held-out", type=int, default=held_out, help=text)
    parser.add_argument("--axes", choices=tuple(AXES), default="stated", help="flipped: y and z turned round")
    parser.add_argument("--images", help="the folder of COLMAP's images, where it is not the usual one")
    parser.add_argument("--without-masks", action="store_true", help="as if there were none")
    into = Path(RESULTS) / "photos.png"
    parser.add_argument("--into", type=Path, default=into, help="the picture (default: %(default)s)")
    options = parser.parse_args(arguments)
    into = options.into / "photos.png" if options.into.is_dir() else options.into
    try:
        if into.suffix.lower() not in ("", ".png"):
            raise ValueError(f"--into must end in .png, or name a folder that exists, found {into}")
        into = into.with_suffix(".png")
        into.parent.mkdir(parents=True, exist_ok=True)
        masks = not options.without_masks
        reading = ReadSettings(options.longest, masks, options.axes, options.held_out, options.images, unchecked=True)
        capture = read_capture(options.folder, reading)
        draw(capture).savefig(into, dpi=110)
    except (OSError, ValueError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(capture.summary)
    print(f"a run has this sphere with task.longest={options.longest} task.held_out={options.held_out}")
    for note in capture.notes:
        if PHOTOS_HINT not in note:  # the fit is printed below
            print(f"note: {note}")
    if capture.fit:
        print("\n".join(describe_fit(capture.fit, capture)))
    print(into)
    return 0


if __name__ == "__main__":
    sys.exit(main())
