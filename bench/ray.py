"""`python -m bench.ray dataset=torus renderer=dist,newton,neus`: what renderers do along one ray, as a picture.

    python -m bench.ray dataset=torus renderer=dist,newton pixel=31,40    column and row, from 0 at the top left
    python -m bench.ray dataset=sofa split=train renderer=newton,dvr      a network: the prior at a training shape
    python -m bench.ray field=file field_path=RUN renderer=dist,neus      a network of yours, or a run's final field
    python -m bench.ray dataset=mesh dataset.path=FILE                    a mesh, as a grid of distances
    python -m bench.ray task=stability stress=thin_plate level=0.5        the stress at a level from 0, mild, to 1
    python -m bench.ray RUN_FOLDER pixel=31,40                            the scene and renderer of a task=ablation run
    python -m bench.ray RUN_FOLDER pixels=worst                           its 12 most wrong pixels, for the run's page

Without pixel=, it takes the pixel where the first renderer is most wrong. zoom=0.05 shows the ray within 0.05 scene
units of the true hit, zoom=0 all of it. A hit is wrong if it is off by more than a tenth of the pixel's width there.
A ray is rendered alone, so the errors of coarse-to-fine marching do not show.
Each renderer's derivatives of the hit distance are compared with central differences of the float64 reference. Their
parameters are the three most sensitive ones of the latent code or the family's formula, and the object's translation
for meshes and stresses.
The picture is RESULTS/ray.png, with a PDF. RESULTS is results_dir (by default results/local), or the folder of the
runs of RUN_FOLDER; into=FILE names another file. The configuration in a run folder is trusted, as by
`python -m bench`. A run of task=stability takes level= too.

pixels=worst writes RUN_FOLDER/rays: a PNG for each of the 12 most wrong pixels, which lie apart, with sentences in
rays.json. `python -m bench.report results_dir=RESULTS` then shows them on the run's page.
"""

import re
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from omegaconf import DictConfig

from bench.evaluate.along_ray import Lane, TrueRay, follow, sentences
from bench.evaluate.ray_derivatives import Parameters, true_derivatives, with_renderer
from bench.evaluate.ray_scene import Pixel, RayScene, Search
from bench.evaluate.reference import in_float64
from bench.pictures.ray import LanePanel, RayPicture, draw_map
from bench.records.format import number, plural
from bench.records.record import bad_link, read_record, to_json, write_text
from bench.records.results import PlannedRun
from bench.report.site.rays import MAP_FILE, MAX_RAYS, RAYS_FILE, RAYS_FOLDER, ray_file
from bench.runner.command import command_line
from bench.runner.compose import Composer
from bench.setup.inputs import RunInputs, Task, prepare_run
from bench.tasks.ablation import Ablation
from bench.tasks.stability.task import Stability
from bench.tasks.stability.trial import Conditions
from datasets.families import BUILDERS, CUBE_HALF_SIDE, Family
from datasets.mesh import extract, fit_in_sphere
from datasets.scene import Photographed, Split
from renderers.field import Field
from renderers.fields.analytic import Shape
from renderers.fields.grid import Grid
from renderers.rendering import Unsupported

DECIMAL = r"\d+(\.\d*)?(e-?\d+)?"
OPTIONS = {  # the pattern of a value, and an example
    "pixel": (r"\d+,\d+", "pixel=31,40, its column and row"),
    "pixels": ("worst", "pixels=worst, with a run folder"),
    "zoom": (DECIMAL, "zoom=0.05, in scene units"),
    "level": (DECIMAL, "level=0.5"),
    "into": (r".*\w.*", "into=ray.png"),
}
DEFAULT_LEVEL = 0.5
NEUTRAL_TASK = "capacity"  # takes every shape, and needs no prior
RUN_TASKS = ("ablation", "stability")
GRID_REACH = 1.05  # scene units: half the cube of the distances to a mesh
ZOOM_FRACTIONS = (0.001, 0.25)  # what happens on less or more of the ray is shown on the whole ray
RendererOfCell = tuple[PlannedRun, str, RunInputs]  # with the title of its lane


@dataclass(frozen=True)
class Options:
    """The options of this command; None stands for what it chooses itself."""

    run: Path | None = None
    pixel: Pixel | None = None
    pixels: str = ""
    zoom: float | None = None
    level: float | None = None
    into: Path | None = None


def parse_arguments(arguments: Sequence[str]) -> tuple[Options, list[str]]:
    """The options of this command and the arguments of `python -m bench`; raises ValueError for a wrong option."""
    values, others = dict[str, Any](), list[str]()
    for argument in arguments:
        key, _, text = argument.partition("=")
        if key in OPTIONS:
            pattern, example = OPTIONS[key]
            if not re.fullmatch(pattern, text):
                raise ValueError(f"cannot read {argument!r}: type {example}")
            read = {"pixel": lambda text: tuple(map(int, text.split(","))), "into": Path, "pixels": str}.get(key, float)
            values[key] = read(text)
        elif key == "field" and text in BUILDERS:
            raise ValueError(f"{argument} names the field that a task optimises: a scene's shape is dataset={text}")
        elif "=" not in argument and Path(argument).is_dir() and "run" not in values:
            values["run"] = Path(argument)
        else:
            others.append(argument)
    if "run" in values and others:
        raise ValueError(f"{values['run']} states its scene and renderer: remove {others[0]}, or the folder")
    if "pixels" in values and ("run" not in values or "pixel" in values or "into" in values):
        raise ValueError("pixels=worst needs a run folder, and neither pixel= nor into=: type RUN_FOLDER pixels=worst")
    task = [] if any(text.startswith(("task=", "+method=")) for text in others) else [f"task={NEUTRAL_TASK}"]
    return Options(**values), [*task, *others]


def run_of(folder: Path) -> PlannedRun:
    """The run of a folder; raises OSError or ValueError if it cannot be read, or is of another task."""
    if not (folder / "record.json").is_file():
        raise ValueError(f"{folder} has no record.json: name the folder of a run, RESULTS/runs/NAME")
    if link := bad_link(folder, folder.parent):
        raise ValueError(f"{folder}: {link} is a link out of the folder: remove it")
    record = read_record(folder)
    if record["task"] not in RUN_TASKS:
        remedy = f"field=file field_path={folder} takes its final field"
        raise ValueError(f"{folder} is a run of task={record['task']}, not of task={RUN_TASKS[0]}: {remedy}")
    names = {key: record[key] for key in ("task", "renderer", "dataset", "seed", "config")}
    return PlannedRun(folder.name, [], **names)


def scene_of(cell: PlannedRun, task: Task, inputs: RunInputs, level: float | None) -> RayScene:
    """The scene of a configuration, on the CPU; raises ValueError if it has no field to render."""
    if isinstance(task, Stability):
        return _stress_scene(cell.dataset, task, inputs, DEFAULT_LEVEL if level is None else level)
    if level is not None:
        raise ValueError(f"level={level:g} is of a stress: add task=stability stress=thin_plate, or leave it out")
    if isinstance(inputs.dataset, Photographed) or inputs.scene.is_partial:
        remedy = "field=file field_path=RUN takes the final field of a run"
        raise ValueError(f"dataset={cell.dataset} has pictures, and no field: {remedy}")
    name, camera = inputs.scene_name, inputs.scene.view.camera
    if isinstance(task, Ablation) and task.size:
        camera = camera.resized(task.size, task.size)
    if inputs.prior_choice.scene_code is not None:
        prior, exact = inputs.fitted(), in_float64(inputs.fitted())
        decoders = [each.decoder.cpu().requires_grad_(False) for each in (prior, exact)]
        codes = [each.codes[0].detach().cpu() for each in (prior, exact)]
        fields = [decoder.at(code) for decoder, code in zip(decoders, codes, strict=True)]
        parameters = Parameters.of_translation(*fields)
        if len(codes[0]):
            names = [f"code[{index}]" for index in range(len(codes[0]))]
            parameters = Parameters.of_field(names, codes[1], lambda code: decoders[0].at(code.float()), decoders[1].at)
        return RayScene(f"{name}, a network", *fields, camera, parameters)
    if isinstance(inputs.dataset, Family):
        field_at, values = _formula(inputs.dataset, Split(cell.config["split"]), cell.config["index"])
        shape, numbers = field_at([*values.values()]), torch.tensor([*values.values()], dtype=torch.float64)
        parameters = Parameters.of_field([*values], numbers, field_at, field_at)
        return RayScene(f"{name}, a formula", shape, shape, camera, parameters)
    samples = inputs.evaluation.grid
    values = torch.from_numpy(inputs.scene.raycaster.distance_grid(samples, GRID_REACH))
    fields = Grid(values, GRID_REACH), Grid(values.double(), GRID_REACH)
    parameters = Parameters.of_translation(*fields)
    return RayScene(
        f"{name}, a grid of {samples} x {samples} x {samples} distances to its mesh", *fields, camera, parameters
    )


def _formula(family: Family, split: Split, index: int) -> tuple[Callable[[Iterable[Any]], Field], dict[str, float]]:
    """A family's formula as a function of its parameters, moved and scaled as the mesh of a shape; its parameters."""
    values = family.draw(split, index)

    def build(numbers: Iterable[Any]) -> Shape:
        return BUILDERS[family.name](SimpleNamespace(**dict(zip(values, numbers, strict=True))))

    mesh = extract(build(values.values()), grid=family.resolution, reach=CUBE_HALF_SIDE)
    assert mesh is not None  # the scene has been made
    centre, factor = fit_in_sphere(mesh.used_vertices, family.radius)
    return lambda numbers: build(numbers).translate((-centre).tolist()).scale(float(factor)), values


def _stress_scene(name: str, task: Stability, inputs: RunInputs, level: float) -> RayScene:
    if not 0 <= level <= 1:
        raise ValueError(f"level={level:g} must be from 0, mild, to 1, severe")
    stress, severity = task.stress, task.stress.sweep.severity(level)
    if stress.measure == "fit" or stress.setting is not None:
        raise ValueError(f"stress={name} varies a fit or a renderer's setting, and no scene: type stress=thin_plate")
    prior, device = inputs.prior if stress.needs_prior else None, torch.device("cpu")
    conditions = Conditions(task.resolution, task.fit, task.criteria, task.limits, device, prior)
    draw = np.random.default_rng(stress.trial_seed(level, 0))
    case = stress.exam_generator(conditions)(severity, draw, task.resolution)
    title = f"{name.replace('_', ' ')} at {number(severity)} {stress.sweep.unit}"
    parameters = Parameters.of_translation(case.field, case.truth.field)
    return RayScene(title, case.field, case.truth.field, case.camera, parameters)


def show(cells: list[PlannedRun], options: Options) -> None:
    """Renders a ray by the renderer of each configuration; prints sentences, and the path of the picture last.

    Raises ValueError if they differ in more than the renderer, or a renderer cannot render the scene.
    """
    for key in cells[0].config.keys() - {"renderer", "label"}:
        if any(cell.config.get(key) != cells[0].config[key] for cell in cells):
            raise ValueError(f"one ray has one scene, but {key} has several values: give several only to renderer")
    runs = [prepare_run(cell.config) for cell in cells]
    task, inputs = runs[0]
    inputs.configure_process()
    scene = scene_of(cells[0], task, inputs, options.level)
    renderers = [(cell, _title(cell, cells), inputs) for cell, (_, inputs) in zip(cells, runs, strict=True)]
    pixel, search = options.pixel, ""
    if pixel is None:
        try:
            result = scene.search(inputs.renderer)
        except Unsupported as error:
            raise ValueError(f"renderer={cells[0].renderer}: {error}") from error
        if options.run and options.pixels:
            return save_worst(scene, renderers[0], result, options.run / RAYS_FOLDER)
        (pixel, _), search = result.worst(1)[0], f", where {cells[0].renderer} is off most: {result.summary}"
    picture = picture_of(scene, pixel, search, renderers, options.zoom)
    print(*picture.texts, sep="\n")
    results_dir = options.run.resolve().parents[1] if options.run else Path(cells[0].config["results_dir"])
    _save(picture, options.into or results_dir / "ray.png")


def save_worst(scene: RayScene, renderer: RendererOfCell, search: Search, folder: Path) -> None:
    """Writes the pictures of the most wrong pixels, the map of the searched ones, and the texts of all as JSON."""
    folder.mkdir(exist_ok=True)
    rays = list[dict[str, Any]]()
    for rank, (pixel, error) in enumerate(search.worst(MAX_RAYS), 1):
        picture = picture_of(scene, pixel, f", off by {error:.2g} scene units", [renderer], None)
        picture.draw().savefig(folder / ray_file(rank), dpi=150)
        texts = [picture.scene, picture.result, picture.lanes[0].sentences]
        rays.append({"column": pixel[0], "row": pixel[1], "error": error, "texts": texts})
        print(f"{rank} of {MAX_RAYS}: {picture.texts[0]}", file=sys.stderr)
    draw_map(folder / MAP_FILE, search)
    size = {"width": scene.camera.width, "height": scene.camera.height}
    write_text(folder / RAYS_FILE, to_json({**size, "rays": rays}))
    print(folder / RAYS_FILE)


def picture_of(
    scene: RayScene, pixel: Pixel, search: str, renderers: list[RendererOfCell], zoom: float | None
) -> RayPicture:
    """The picture of the ray of a pixel, which was chosen as the words `search` say."""
    ray, truth, panels = scene.ray(pixel, scene.camera), scene.true_ray(pixel), list[LanePanel]()
    true = None
    if truth.hit is not None:
        true = true_derivatives(scene.parameters, scene.ray(pixel, scene.camera.double()), truth.hit, scene.lipschitz)
    for cell, title, inputs in renderers:
        inputs.configure_process()  # renderers may draw: each from the same seed
        lane = follow(cell.renderer, title, inputs.renderer, scene.field, ray)
        inputs.configure_process()
        derivatives = true and with_renderer(true, inputs.renderer, scene.parameters, ray)
        panels.append(LanePanel(lane, sentences(lane, truth), derivatives))
    lanes = [panel.lane for panel in panels]
    texts = f"{scene.name}; pixel={pixel[0]},{pixel[1]}{search}", result_of(lanes, truth)
    return RayPicture(*texts, scene.field, ray, truth, window_of(lanes, truth, zoom), panels)


def _title(cell: PlannedRun, cells: list[PlannedRun]) -> str:
    """The title of a renderer's lane: its preset, its settings that differ, and its label."""
    common = set.intersection(*(set(other.overrides) for other in cells))
    settings = [text for text in cell.overrides if text.startswith("renderer.") and text not in common]
    label = cell.config["label"] or cell.config["renderer"].get("_label_")
    return " ".join([cell.renderer, *settings, *([f"({label})"] if label else [])])


def result_of(lanes: list[Lane], truth: TrueRay) -> str:
    wrong = [lane.title.partition(" (")[0] for lane in lanes if not lane.agrees(truth)]
    limit, reference = f" within {truth.tolerance:.1g} scene units", "The reference has no hit: "
    right = f"{len(lanes) - len(wrong)} of {plural(len(lanes), 'renderer')} right"
    text = right + limit if truth.hit is not None else reference + right
    return f"{text}; wrong: {', '.join(wrong)}" if wrong else text


def window_of(lanes: list[Lane], truth: TrueRay, zoom: float | None) -> tuple[float, float]:
    """The part of the ray that is shown: within `zoom` of the true hit; by default, where the renderers decide."""
    length = truth.leave - truth.entry
    if zoom is None and truth.hit is not None:
        zoom = 2 * max(max(*lane.extent(truth.hit), abs(lane.end - truth.hit)) for lane in lanes)
        zoom = zoom if ZOOM_FRACTIONS[0] < zoom / length < ZOOM_FRACTIONS[1] else 0
    if truth.hit is None or not zoom:
        return truth.entry, truth.leave
    return max(truth.hit - zoom, truth.entry), min(truth.hit + zoom, truth.leave)


def _save(picture: RayPicture, into: Path) -> None:
    name = into.name.removesuffix(".png").removesuffix(".pdf")
    figure, path = picture.draw(), into.with_name(f"{name}.png")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=150)
        figure.savefig(into.with_name(f"{name}.pdf"))
    except OSError as error:
        raise ValueError(f"into={into} cannot be written ({error.strerror}): name a file in another folder") from error
    print(path)


def main() -> int:
    try:
        options, arguments = parse_arguments(sys.argv[1:])
        if options.run is not None:
            show([run_of(options.run)], options)
            return 0
    except (OSError, ValueError) as error:
        print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
        return 2

    def sweep(composer: Composer, config: DictConfig) -> list[str]:
        show(composer.cells(composer.swept(config)), options)
        return []

    sys.argv[1:] = ["-m", *arguments]  # several renderers are lanes of one picture
    return command_line(lambda run: None, sweep)


if __name__ == "__main__":
    sys.exit(main())
