"""Networks with a known field, and all objects that a task needs with them; nothing is trained."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from omegaconf import DictConfig, OmegaConf

from bench.config import EvaluationSettings
from bench.records.record import Record
from bench.setup.inputs import FieldChoice, RunContext, RunInputs, prepare_run
from bench.setup.priors import PriorChoice
from bench.shape_prior import Prior
from datasets.mesh import Mesh
from datasets.scene import Scene, SceneNetwork, Truth, View, see
from datasets.views import ViewSampler
from renderers.camera import Camera
from renderers.field import Kind
from renderers.fields.mlp import Decoder
from renderers.rendering import Capabilities

CPU = torch.device("cpu")
TRIANGLE = Mesh(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]), np.array([[0, 2, 1]]))
PEAK = 1e10  # operations per second of the machine in a record


class Blind:
    """A renderer without any gradient, which is never asked to render."""

    capabilities = Capabilities((Kind.DISTANCE,), field_gradient=False, ray_gradient=False)

    def render(self, field, rays):
        raise AssertionError

    def silhouette_loss(self, field, rays, rendering, mask):
        raise AssertionError


def altered(settings: Any, changed: dict[str, Any]) -> Any:
    """Settings with other values; "optimiser.iterations" is a value of nested settings."""
    for name, value in changed.items():
        field, _, rest = name.partition(".")
        settings = replace(settings, **{field: altered(getattr(settings, field), {rest: value}) if rest else value})
    return settings


def phases_of(run: RunContext, task: Any) -> list[str]:
    """The phases that a task reports when it is executed, in their order."""
    phases: dict[str, None] = {}
    task.execute(replace(run, progress=lambda phase, finished, total, loss=None: phases.setdefault(phase)))
    return list(phases)


def curve_of(folder: Path) -> list[dict[str, Any]]:
    """The lines of a run's curve."""
    return [json.loads(line) for line in (folder / "curve.jsonl").read_text(encoding="utf-8").splitlines()]


def plain(config: DictConfig) -> Any:
    """A composed configuration as plain data, resolved."""
    return OmegaConf.to_container(config, resolve=True, throw_on_missing=False)


def inputs_from(config: DictConfig) -> RunInputs:
    """The inputs of the run of a composed configuration."""
    return prepare_run(plain(config))[1]


def silent(phase: str, finished: int, total: int, loss: float | None = None) -> None:
    """No progress is shown."""


def plane_decoder(normal: Any, code_weights: Any, offset: float) -> Decoder:
    """The field normal . x + code_weights . code - offset, exactly, in float64: two neurons, one for each sign."""
    row = torch.tensor([*code_weights, *normal], dtype=torch.float64)
    decoder = Decoder(layers=1, width=2, code_length=len(code_weights), skip=0, narrow=False).double()
    with torch.no_grad():
        decoder.hidden[0].weight.copy_(torch.stack([row, -row]))
        decoder.hidden[0].bias.copy_(torch.tensor([-offset, offset]))
        decoder.last.weight.copy_(torch.tensor([[1.0, -1.0]]))
        decoder.last.bias.zero_()
    return decoder.requires_grad_(False)


def ball_prior(radius: float = 0.5, width: int = 128) -> Prior:
    """A polyhedron near a sphere about the first three numbers of a code; the fourth number adds to the radius.

    It has two codes. Its field is nearly a distance: max(normal . x, 0) has the mean |x| / 4 over all directions.
    """
    heights = 1 - (2 * torch.arange(width) + 1) / width
    turns = torch.pi * (1 + 5**0.5) * torch.arange(width)
    across = (1 - heights.square()).sqrt()
    normals = torch.stack([across * turns.cos(), across * turns.sin(), heights], dim=1)
    decoder = Decoder(layers=1, width=width, code_length=4, skip=0, narrow=False).requires_grad_(False)
    decoder.hidden[0].weight.copy_(torch.cat([-normals, torch.full((width, 1), -0.5), normals], dim=1))
    decoder.hidden[0].bias.zero_()
    decoder.last.weight.fill_(4 / width)
    decoder.last.bias.fill_(-radius)
    return Prior(decoder, torch.tensor([[0.05, -0.1, 0.1, 0.05], [-0.1, 0.0, 0.0, 0.0]]))


def camera_of(pixels: int, *, field_of_view: float = 50.0, angles: tuple[float, float] = (0.0, 0.0)) -> Camera:
    """A camera 2.5 from the origin, at which it looks, y up: at z = 2.5, or at these angles in degrees."""
    return ViewSampler(2.5, field_of_view, (0.0, 0.0), (0.0, 0.0), pixels).camera(*angles)


def mesh_of(mesh: trimesh.Trimesh) -> Mesh:
    """A mesh of trimesh as a `Mesh`."""
    return Mesh(np.array(mesh.vertices), np.array(mesh.faces))


def icosphere(radius: float, centre: Any = (0.0, 0.0, 0.0), subdivisions: int = 4) -> Mesh:
    """A sphere of triangles."""
    return mesh_of(trimesh.creation.icosphere(subdivisions, radius).apply_translation(centre))


def scene_of(mesh: Mesh, camera: Camera) -> Scene:
    """A mesh, seen by a camera."""
    return Scene("a shape", mesh, see(Truth(mesh), camera))


def run_of(folder: Path, renderer: Any, prior: Prior, camera: Camera, **changed: Any) -> RunContext:
    """A run under way in a folder; its scene has a blank image, since tasks that measure need none."""
    blank = torch.zeros(camera.height, camera.width)
    view = View(camera, blank, blank[..., None].expand(-1, -1, 3), blank.bool())
    scene = Scene("a scene", TRIANGLE, view)
    sizes = {"grid": 16, "points": 50, "fscore_threshold": 0.02, "picture": 8}
    inputs = RunInputs(
        renderer=renderer, scene_name=scene.name, make_scene=lambda: scene, make_prior=lambda: prior,
        make_renderer=lambda _: (renderer, []), views=ViewSampler(2.5, 50.0, (0.0, 0.0), (0.0, 0.0), camera.height),
        evaluation=EvaluationSettings(**sizes, gallery=None, every=None, film=None), seed=0, device=CPU,
        cache=folder / "cache", field=FieldChoice("prior", None),
        prior_choice=PriorChoice(SceneNetwork(prior.decoder, prior.codes, ()), scene_code=0),
    )  # fmt: skip
    record = Record("id", "task", "renderer", "dataset", 0, {"label": None}, scene=scene.name)
    record.environment = {"gemm_peak_flops": PEAK}
    return RunContext(replace(inputs, **changed), folder, record, silent)
