"""Pictures of a run's progress: the view at each checkpoint, as a strip (DIST, Figs. 6 and 9) or an animation."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from matplotlib import rc_context
from matplotlib.figure import Figure
from PIL import Image
from torch import Tensor

from bench.evaluate.state import State
from bench.pictures.run_figures import at_size, enlarged, in_size, normals_image, true_view, window
from bench.pictures.style import SCREEN, bare, save, silhouette_image
from bench.setup.inputs import RunInputs
from datasets.scene import View
from renderers.camera import Camera

MOST = 9  # columns of a strip
SILHOUETTE = "silhouette error"  # a row of a strip
FRAME = 0.73  # grey between the pictures of a strip
FRAME_SECONDS = 0.25
LAST_SECONDS = 1.5  # of the last frame


@dataclass(frozen=True)
class Shown:
    """A picture of a shape: its view, and its colours where it has some.

    Args:
        view: with the mask that silhouettes are compared with.
        colours: of all pixels.
        masked: False where the mask is not known.
    """

    view: View
    colours: Float[Tensor, "height width 3"] | None = None
    masked: bool = True

    def cells(self, truth: "Shown") -> dict[str, Float[np.ndarray, "height width 3"]]:
        """Pictures of it by the names of their rows: its colours and the error of its mask where the truth has them."""
        image = normals_image(self.view)
        cells = {"normals": image if bool(self.view.normals.any()) else np.ones_like(image)}
        if truth.colours is not None and self.colours is not None:
            on_white = torch.where(self.view.mask[..., None], self.colours, 1.0)
            cells = {"colours": (self.colours if self is truth else on_white).clamp(0, 1).numpy()} | cells
        if truth.masked:
            cells[SILHOUETTE] = silhouette_image(self.view.mask.numpy(), truth.view.mask.numpy())
        return cells

    def enlarged(self, camera: Camera) -> "Shown":
        """The same pixels in another size, that of a camera."""
        colours = None if self.colours is None else in_size(self.colours, camera)
        return Shown(enlarged(self.view, camera), colours, self.masked)


class Filmstrip:
    """Collects frames of a run; none where pictures are off."""

    def __init__(self, inputs: RunInputs, over: str = "after iterations", true: Shown | None = None):
        """Begins without frames.

        Args:
            over: what the frames' names mean, for the title.
            true: what frames are compared with; None for the scene's shape in its view.
        """
        self.inputs, self.over, self.true = inputs, over, true
        self.frames: dict[int | str, Shown] = {}

    def add(self, name: int | str, state: State, camera: Camera | None = None) -> None:
        """Adds a frame, which shows the mesh of a state at the resolution of pictures.

        Args:
            name: its label, such as an iteration.
            camera: of the frame; None for the scene's.
        """
        if self.inputs.evaluation.picture is not None:
            camera = self.inputs.scene.view.camera if camera is None else camera
            view = state.pictured(at_size(camera, self.inputs.evaluation.picture))
            self.frames[name] = Shown(view, state.colours(view))

    @rc_context(SCREEN)
    def save(self, folder: Path, title: str, chosen: str | None = None) -> None:
        """Writes strip.png into a run folder, and film.gif or film.webp where one is requested.

        Args:
            chosen: the frame of the run's result, where that is not the last one: it is shown, with its name in bold.
        """
        if not self.frames:
            return
        truth = self._truth()
        name = "measured" if self.true is None and self.inputs.scene.is_partial else "truth"
        strip = _strip(self._shown(chosen), {name: truth}, f"{title}; {self.over}", chosen)
        save(strip, folder / "strip.png")
        if self.inputs.evaluation.film is not None:
            _animate(folder / f"film.{self.inputs.evaluation.film}", list(self.frames.values()), truth)

    def _truth(self) -> Shown:
        size = self.inputs.evaluation.picture
        if self.true is None:
            return Shown(true_view(self.inputs.scene, at_size(self.inputs.scene.view.camera, size)))
        return self.true.enlarged(at_size(self.true.view.camera, size))

    def _shown(self, chosen: str | None) -> dict[int | str, Shown]:
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


def _strip(frames: dict[int | str, Shown], true: dict[str, Shown], title: str, chosen: str | None) -> Figure:
    """A figure with a column per frame and one for the truth, with its name: colours, normals, outlines, where known.

    It is one image on one axis, since a figure of twenty axes takes a second to draw.
    """
    shown = {str(name).replace("_", " "): frame for name, frame in frames.items()} | true
    (truth,) = true.values()
    part = window([frame.view.mask.numpy() for frame in shown.values()])
    columns = [frame.cells(truth) for frame in shown.values()]
    rows = list(columns[0])
    parts = [[_framed(column[row][part]) for row in rows] for column in columns]
    montage = np.concatenate([np.concatenate(column, axis=0) for column in parts], axis=1)
    size = montage.shape[0] / len(rows)
    figure = Figure(figsize=(1.25 * len(shown) + 0.4, 0.5 + 1.3 * len(rows)), layout="constrained")
    axis = bare(figure.subplots())
    axis.imshow(montage, interpolation="nearest")
    axis.set_xticks([size * (place + 0.5) for place in range(len(shown))], list(shown))
    axis.set_yticks([size * (place + 0.5) for place in range(len(rows))], rows, rotation=90, va="center")
    axis.tick_params(length=0, top=False, labeltop=True, labelbottom=False)
    if chosen is not None:
        axis.xaxis.get_major_ticks()[list(frames).index(chosen)].label2.set_fontweight("bold")
    figure.suptitle(f"{title}{' (red missed, blue spurious)' if SILHOUETTE in rows else ''}")
    return figure


def _framed(picture: Float[np.ndarray, "height width 3"]) -> Float[np.ndarray, "framed_height framed_width 3"]:
    return np.pad(picture, ((1, 1), (1, 1), (0, 0)), constant_values=FRAME)


def _animate(path: Path, frames: list[Shown], truth: Shown) -> None:
    pictures = [np.concatenate(list(frame.cells(truth).values()), axis=1) for frame in frames]
    images = [Image.fromarray((255 * picture).astype(np.uint8)) for picture in pictures]
    lasting = [round(1000 * FRAME_SECONDS)] * (len(images) - 1) + [round(1000 * LAST_SECONDS)]
    images[0].save(path, save_all=True, append_images=images[1:], duration=lasting, loop=0)
