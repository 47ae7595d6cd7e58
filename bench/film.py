"""How a run came to its end: what the camera saw at each look, as a strip (DIST, Figs. 6 and 9) or a film."""

from pathlib import Path

import matplotlib
import numpy as np
import torch
from jaxtyping import Float
from matplotlib.figure import Figure
from PIL import Image

from bench.images import picture_normals
from bench.judge import look
from bench.pictures import STYLE, bare, silhouette_image, window
from bench.stage import Stage
from datasets.scene import View, see
from datasets.truth import Truth
from renderers.camera import Camera
from renderers.field import Field

MOST = 9  # columns of a strip
FRAME_SECONDS = 0.25
LAST_SECONDS = 1.5  # the end stays for longer


class Film:
    """Frames of a run; none are taken where pictures are off."""

    def __init__(self, stage: Stage):
        """For a run; the truth is seen by the scene's camera with the pixels of pictures."""
        self.stage = stage
        self.frames: dict[int, View] = {}

    def shoot(self, iteration: int, field: Field, camera: Camera) -> None:
        """Takes the frame before an iteration, with the camera's view in the pixels of pictures."""
        if self.stage.evaluation.picture is not None:
            self.frames[iteration] = look(field, self._fine(camera), self.stage)

    def save(self, folder: Path, title: str) -> None:
        """Writes strip.png into a run folder, and film.gif or film.webp where one is asked for."""
        if not self.frames:
            return
        truth = see(Truth(self.stage.scene.mesh), self._fine(self.stage.scene.view.camera))
        matplotlib.use("Agg")
        with matplotlib.rc_context(STYLE):
            _strip(self.frames, truth, title).savefig(folder / "strip.png", dpi=110, bbox_inches="tight")
        if self.stage.evaluation.film is not None:
            _animate(folder / f"film.{self.stage.evaluation.film}", list(self.frames.values()), truth)

    def _fine(self, camera: Camera) -> Camera:
        size = self.stage.evaluation.picture
        return camera.resized(size, size)


def _strip(frames: dict[int, View], truth: View, title: str) -> Figure:
    """A column for each of some evenly chosen frames and for the truth: normals above, silhouette error below."""
    known = list(frames.items())
    if len(known) > 2 and known[-1][0] - known[-2][0] == 1:
        del known[-2]  # the last look, a step before the end
    places = np.unique(np.linspace(0, len(known) - 1, min(MOST, len(known))).round().astype(int))
    chosen = [known[place] for place in places]
    part = window([view.mask.numpy() for _, view in chosen] + [truth.mask.numpy()])
    figure = Figure(figsize=(1.25 * (len(chosen) + 1), 3.2), layout="constrained")
    axes = figure.subplots(2, len(chosen) + 1, squeeze=False)
    for column, (iteration, view) in enumerate(chosen):
        bare(axes[0, column]).imshow(_normals(view)[part])
        error = silhouette_image(view.mask.numpy(), truth.mask.numpy())
        bare(axes[1, column]).imshow(error[part], interpolation="nearest")
        axes[0, column].set_title(f"{iteration}")
    bare(axes[0, -1]).imshow(_normals(truth)[part])
    bare(axes[1, -1]).imshow(silhouette_image(truth.mask.numpy(), truth.mask.numpy())[part], interpolation="nearest")
    axes[0, -1].set_title("truth")
    axes[0, 0].set_ylabel("normals")
    axes[1, 0].set_ylabel("silhouette error")
    figure.suptitle(f"{title}; after iterations (red lost, blue false)")
    return figure


def _animate(path: Path, views: list[View], truth: View) -> None:
    """Normals beside the silhouette error, a frame a look."""
    true = truth.mask.numpy()
    pictures = [np.concatenate([_normals(view), silhouette_image(view.mask.numpy(), true)], axis=1) for view in views]
    images = [Image.fromarray((255 * picture).astype(np.uint8)) for picture in pictures]
    lasting = [round(1000 * FRAME_SECONDS)] * (len(images) - 1) + [round(1000 * LAST_SECONDS)]
    images[0].save(path, save_all=True, append_images=images[1:], duration=lasting, loop=0)


def _normals(view: View) -> Float[np.ndarray, "height width 3"]:
    shown = torch.where(view.mask[..., None], picture_normals(view) / 2 + 0.5, 1.0)
    return shown.clamp(0, 1).numpy()
