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

from bench.evaluate.colours import colours_in_view
from bench.evaluate.refined import refined_view
from bench.evaluate.state import State
from bench.pictures.run_figures import at_size, enlarged, in_size, normals_image, true_view, window
from bench.pictures.style import SCREEN, bare, save, silhouette_image
from bench.setup.inputs import RunInputs
from datasets.scene import View
from renderers.camera import Camera

MAX_STRIP_COLUMNS = 9
SILHOUETTE_ROW = "silhouette error"
BORDER_GREY = 0.73
FRAME_SECONDS = 0.25
LAST_FRAME_SECONDS = 1.5


@dataclass(frozen=True)
class Shown:
    """A picture of a shape."""

    view: View  # with the mask for the comparison of silhouettes
    colours: Float[Tensor, "height width 3"] | None = None  # of all pixels
    has_mask: bool = True  # whether the mask is known

    def pictures(self, truth: "Shown") -> dict[str, Float[np.ndarray, "height width 3"]]:
        """Pictures by the names of their rows. Colours and the silhouette error are included if the truth has them."""
        image = normals_image(self.view)
        pictures = {"normals": image if bool(self.view.normals.any()) else np.ones_like(image)}
        if truth.colours is not None and self.colours is not None:
            on_white = torch.where(self.view.mask[..., None], self.colours, 1.0)
            pictures = {"colours": (self.colours if self is truth else on_white).clamp(0, 1).numpy()} | pictures
        if truth.has_mask:
            pictures[SILHOUETTE_ROW] = silhouette_image(self.view.mask.numpy(), truth.view.mask.numpy())
        return pictures

    def enlarged(self, camera: Camera) -> "Shown":
        colours = None if self.colours is None else in_size(self.colours, camera)
        return Shown(enlarged(self.view, camera), colours, self.has_mask)


class Filmstrip:
    """Collects frames of a run, unless pictures are off."""

    def __init__(self, inputs: RunInputs, over: str = "after iterations"):
        """Starts without frames; `over` is the meaning of their names, for the title."""
        self.inputs, self.over = inputs, over
        self.frames: dict[int | str, Shown] = {}

    def add(self, name: int | str, state: State, camera: Camera | None = None) -> None:
        """Adds a frame that shows the mesh of a state, from a camera or the scene's, at the resolution of pictures."""
        if self.inputs.evaluation.picture is not None:
            camera = self.inputs.scene.view.camera if camera is None else camera
            view = refined_view(state, at_size(camera, self.inputs.evaluation.picture))
            self.frames[name] = Shown(view, colours_in_view(state, view))

    @rc_context(SCREEN)
    def save(self, folder: Path, title: str, chosen: str | None = None, truth: Shown | None = None) -> None:
        """Writes strip.png into a run folder, and film.gif or film.webp if requested.

        `chosen` names the frame of the result, if it is not the last. `truth`, for comparison, is by default the
        scene's.
        """
        if not self.frames:
            return
        size, name = self.inputs.evaluation.picture, "truth"
        if truth is None:
            scene = self.inputs.scene
            name = "measured" if scene.is_partial else name
            true = Shown(true_view(scene, at_size(scene.view.camera, size)))
        else:  # the scene is not read, since photographs have none
            true = truth.enlarged(at_size(truth.view.camera, size))
        strip = _strip(self._selected_frames(chosen), {name: true}, f"{title}; {self.over}", chosen)
        save(strip, folder / "strip.png")
        if self.inputs.evaluation.film is not None:
            shown = [np.concatenate(list(frame.pictures(true).values()), axis=1) for frame in self.frames.values()]
            first, *others = [Image.fromarray((255 * picture).astype(np.uint8)) for picture in shown]
            durations = [round(1000 * FRAME_SECONDS)] * len(others) + [round(1000 * LAST_FRAME_SECONDS)]
            path = folder / f"film.{self.inputs.evaluation.film}"
            first.save(path, save_all=True, append_images=others, duration=durations, loop=0)

    def _selected_frames(self, chosen: str | None) -> dict[int | str, Shown]:
        """Evenly spaced frames and the chosen one. A checkpoint one iteration before the last is left out."""
        names = list(self.frames)
        last = names[-2:]
        if len(names) > 2 and all(isinstance(name, int) for name in last) and int(last[1]) - int(last[0]) == 1:
            del names[-2]
        indices = np.unique(np.linspace(0, len(names) - 1, min(MAX_STRIP_COLUMNS, len(names))).round().astype(int))
        if chosen is not None and names.index(chosen) not in indices:
            inner_indices = indices[1:-1]
            inner_indices[np.abs(inner_indices - names.index(chosen)).argmin()] = names.index(chosen)
        return {names[index]: self.frames[names[index]] for index in indices}


def _strip(frames: dict[int | str, Shown], last_column: dict[str, Shown], title: str, chosen: str | None) -> Figure:
    """A figure with a column per frame and a named one for the truth; rows are colours, normals and silhouette errors.

    It is one image on one axis, since a figure with twenty axes takes a second to draw.
    """
    shown = {str(name).replace("_", " "): frame for name, frame in frames.items()} | last_column
    (truth,) = last_column.values()
    square = window([frame.view.mask.numpy() for frame in shown.values()])
    columns = [frame.pictures(truth) for frame in shown.values()]
    rows = list(columns[0])
    border = {"pad_width": ((1, 1), (1, 1), (0, 0)), "constant_values": BORDER_GREY}
    framed = [[np.pad(column[row][square], **border) for row in rows] for column in columns]
    montage = np.concatenate([np.concatenate(column, axis=0) for column in framed], axis=1)
    size = montage.shape[0] / len(rows)
    figure = Figure(figsize=(1.25 * len(shown) + 0.4, 0.5 + 1.3 * len(rows)), layout="constrained")
    axis = bare(figure.subplots())
    axis.imshow(montage, interpolation="nearest")
    axis.set_xticks([size * (index + 0.5) for index in range(len(shown))], list(shown))
    axis.set_yticks([size * (index + 0.5) for index in range(len(rows))], rows, rotation=90, va="center")
    axis.tick_params(length=0, top=False, labeltop=True, labelbottom=False)
    if chosen is not None:
        axis.xaxis.get_major_ticks()[list(frames).index(chosen)].label2.set_fontweight("bold")
    figure.suptitle(f"{title}{' (red missed, blue spurious)' if SILHOUETTE_ROW in rows else ''}")
    return figure
