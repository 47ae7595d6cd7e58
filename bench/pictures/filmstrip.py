"""Pictures of a run's progress: the view at each checkpoint, as a strip (DIST, Figs. 6 and 9) or an animation."""

from pathlib import Path

import numpy as np
from jaxtyping import Float
from matplotlib import rc_context
from matplotlib.figure import Figure
from PIL import Image

from bench.evaluate.evaluate import picture_view
from bench.pictures.run_figures import normals_image, window
from bench.pictures.style import SCREEN, bare, silhouette_image
from bench.setup.inputs import RunInputs
from datasets.scene import View, see
from datasets.truth import Truth
from renderers.camera import Camera
from renderers.field import Field

MOST = 9  # columns of a strip
FRAME = 0.73  # grey between the pictures of a strip
FRAME_SECONDS = 0.25
LAST_SECONDS = 1.5  # of the last frame


class Filmstrip:
    """Collects frames of a run; none where pictures are off."""

    def __init__(self, inputs: RunInputs, over: str = "after iterations"):
        """Begins without frames.

        Args:
            inputs: of the run.
            over: what the frames' names mean, for the title.
        """
        self.inputs, self.over = inputs, over
        self.frames: dict[int | str, View] = {}

    def add(self, name: int | str, field: Field, camera: Camera | None = None) -> None:
        """Adds a frame, rendered at the resolution of pictures.

        Args:
            name: its label, such as an iteration.
            field: that is rendered.
            camera: of the frame; None for the scene's.
        """
        if self.inputs.evaluation.picture is not None:
            camera = self.inputs.scene.view.camera if camera is None else camera
            self.frames[name] = picture_view(field, self._fine(camera), self.inputs)

    @rc_context(SCREEN)
    def save(self, folder: Path, title: str, chosen: str | None = None) -> None:
        """Writes strip.png into a run folder, and film.gif or film.webp where one is requested.

        Args:
            folder: the run folder.
            title: of the strip.
            chosen: the frame of the run's result, where that is not the last one: it is shown, with its name in bold.
        """
        if not self.frames:
            return
        truth = see(Truth(self.inputs.scene.mesh), self._fine(self.inputs.scene.view.camera))
        strip = _strip(self._shown(chosen), truth, f"{title}; {self.over}", chosen)
        strip.savefig(folder / "strip.png", dpi=110, bbox_inches="tight")
        if self.inputs.evaluation.film is not None:
            _animate(folder / f"film.{self.inputs.evaluation.film}", list(self.frames.values()), truth)

    def _shown(self, chosen: str | None) -> dict[int | str, View]:
        """Evenly spaced frames, with the chosen one; without a checkpoint one iteration before the last."""
        names = list(self.frames)
        last = names[-2:]
        if len(names) > 2 and all(isinstance(name, int) for name in last) and int(last[1]) - int(last[0]) == 1:
            del names[-2]
        places = np.unique(np.linspace(0, len(names) - 1, min(MOST, len(names))).round().astype(int))
        if chosen is not None and names.index(chosen) not in places:
            inner = places[1:-1]
            inner[np.abs(inner - names.index(chosen)).argmin()] = names.index(chosen)
        return {names[place]: self.frames[names[place]] for place in places}

    def _fine(self, camera: Camera) -> Camera:
        size = self.inputs.evaluation.picture
        return camera.resized(size, size)


def _strip(frames: dict[int | str, View], truth: View, title: str, chosen: str | None) -> Figure:
    """A figure with a column per frame and one for the truth: normals above, silhouette error below.

    It is one image on one axis, since a figure of twenty axes takes a second to draw.
    """
    shown = {str(name).replace("_", " "): view for name, view in frames.items()} | {"truth": truth}
    part = window([view.mask.numpy() for view in shown.values()])
    true = truth.mask.numpy()
    columns = [(normals_image(view)[part], silhouette_image(view.mask.numpy(), true)[part]) for view in shown.values()]
    montage = np.concatenate([np.concatenate([_framed(cell) for cell in column], axis=0) for column in columns], axis=1)
    size = montage.shape[0] / 2
    figure = Figure(figsize=(1.25 * len(shown) + 0.4, 3.1), layout="constrained")
    axis = bare(figure.subplots())
    axis.imshow(montage, interpolation="nearest")
    axis.set_xticks([size * (place + 0.5) for place in range(len(shown))], list(shown))
    axis.set_yticks([size * 0.5, size * 1.5], ["normals", "silhouette error"], rotation=90, va="center")
    axis.tick_params(length=0, top=False, labeltop=True, labelbottom=False)
    if chosen is not None:
        axis.xaxis.get_major_ticks()[list(frames).index(chosen)].label2.set_fontweight("bold")
    figure.suptitle(f"{title} (red missed, blue spurious)")
    return figure


def _framed(picture: Float[np.ndarray, "height width 3"]) -> Float[np.ndarray, "framed_height framed_width 3"]:
    return np.pad(picture, ((1, 1), (1, 1), (0, 0)), constant_values=FRAME)


def _animate(path: Path, views: list[View], truth: View) -> None:
    """Writes an animation: normals left, silhouette error right."""
    true = truth.mask.numpy()
    pictures = [
        np.concatenate([normals_image(view), silhouette_image(view.mask.numpy(), true)], axis=1) for view in views
    ]
    images = [Image.fromarray((255 * picture).astype(np.uint8)) for picture in pictures]
    lasting = [round(1000 * FRAME_SECONDS)] * (len(images) - 1) + [round(1000 * LAST_SECONDS)]
    images[0].save(path, save_all=True, append_images=images[1:], duration=lasting, loop=0)
