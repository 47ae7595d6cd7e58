"""Mitsuba 3 as an outside judge: its `sdfgrid` and our renderers show the same grids (extra `[mitsuba]`)."""

import importlib.util
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median

import numpy as np
import pytest
import torch
from torch import Tensor

from bench.config import load
from datasets.scene import Split, Truth
from datasets.views import ViewSampler
from renderers.camera import Rays
from renderers.fields.grid import Grid
from renderers.rendering import Renderer

if importlib.util.find_spec("mitsuba") is None:
    pytest.skip('it needs Mitsuba 3: pip install -e ".[mitsuba]"', allow_module_level=True)
# Distances ray by ray, as the variant of LLVM does not work everywhere; the time is that of its own depth image.
JUDGE = """
import sys, time
import numpy as np
import mitsuba as mi
mi.set_variant("scalar_rgb")
given = np.load(sys.argv[1])
grid = mi.TensorXf(np.ascontiguousarray(given["values"]))
shape = {"type": "sdfgrid", "grid": grid, "normals": "analytic"}
film = {"type": "hdrfilm", "width": int(given["size"]), "height": int(given["size"]), "rfilter": {"type": "box"}}
look = mi.ScalarTransform4f().look_at(origin=given["eye"].tolist(), target=[0.5] * 3, up=[0, 1, 0])
camera = {"type": "perspective", "fov": 50.0, "to_world": look, "film": film}
scene = mi.load_dict({"type": "scene", "shape": shape, "sensor": camera, "integrator": {"type": "depth"}})
def one(o, d):
    return scene.ray_intersect(mi.Ray3f(mi.Point3f(*o), mi.Vector3f(*d))).t
rays = zip(given["origins"].tolist(), given["directions"].tolist())
distance, times = np.array([one(o, d) for o, d in rays], dtype=np.float32), []
for _ in range(1 + int(sys.argv[3])):
    started = time.perf_counter()
    mi.render(scene, spp=1)
    times.append(time.perf_counter() - started)
np.savez(sys.argv[2], distance=distance, seconds=np.median(times[1:]))
"""

SAMPLES, REACH, PIXELS, REPEATS = 96, 1.05, 128, 3
SHAPES = (("sofa", 0), ("plane", 0), ("table", 0), ("car", 0), ("sofa", 1))
OURS = ("newton", "idr", "dist", "dvr", "mesh_proxy")
AGREE = 1e-4  # scene units: both solve for the same trilinear interpolation, Mitsuba in float32
pytestmark = pytest.mark.slow
RAYS: Rays = ViewSampler(2.5, 50.0, (0.0, 0.0), (0.0, 0.0), PIXELS).camera(40.0, 25.0).rays()


@pytest.fixture(scope="module", params=SHAPES, ids=lambda shape: f"{shape[0]} {shape[1]}")
def grid(request) -> Grid:
    family, index = request.param
    distances = Truth(load("dataset", family).mesh(Split.TEST, index)).distance_grid(SAMPLES, REACH)
    return Grid(torch.from_numpy(distances).float(), REACH)


def theirs(grid: Grid, folder: Path) -> tuple[Tensor, Tensor, float]:
    """Mitsuba's distances, what it hits, and its median seconds, from a process of its own.

    Its grid fills the unit cube, and its first axis is z.
    """
    flat = RAYS.flat()
    values = grid.values.permute(2, 1, 0)[..., None].contiguous() / (2 * grid.reach)
    origins = (flat.origins + grid.reach) / (2 * grid.reach)
    given, found = folder / "given.npz", folder / "found.npz"
    rays = {"origins": origins.numpy(), "directions": flat.directions.numpy()}
    np.savez(given, values=values.numpy(), eye=origins[0].numpy(), size=PIXELS, **rays)
    done = subprocess.run(
        [sys.executable, "-c", JUDGE, given, found, str(REPEATS)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    answer = np.load(found)
    distance = torch.from_numpy(answer["distance"]) * 2 * grid.reach
    return distance, distance.isfinite(), float(answer["seconds"])


def timed(work: Callable[[], object]) -> float:
    """Median seconds of some repeats."""
    times = []
    for _ in range(REPEATS):
        started = time.perf_counter()
        work()
        times.append(time.perf_counter() - started)
    return median(times)


@torch.no_grad()
def test_depths_agree_within_the_error_of_the_grid(grid, tmp_path, capsys):
    distance, hit, seconds = theirs(grid, tmp_path)
    lines = [f"{'Mitsuba':12} {int(hit.sum()):6} hits{'':42} {1000 * seconds:8.1f} ms"]
    for name in OURS:
        renderer: Renderer = load("renderer", name)
        rendering = renderer.render(grid, RAYS)
        both = rendering.hit.flatten() & hit
        off = (rendering.distance.flatten() - distance).abs()[both]
        apart = int((rendering.hit.flatten() != hit).sum())
        took = timed(lambda renderer=renderer: renderer.render(grid, RAYS))
        near = int((off > AGREE).sum())
        words = f"{name:12} {int(rendering.hit.sum()):6} hits, {apart:4} apart, {near:4} off by more than {AGREE:g}"
        lines.append(f"{words}, median {off.median():.1e} {1000 * took:8.1f} ms")
        if name in ("newton", "dvr"):  # the others converge to an epsilon, or mesh the grid anew
            assert apart <= 0.002 * hit.numel()
            assert near <= 0.005 * int(both.sum())
            assert off.median() < 1e-5
        assert off.median() < 2 * REACH / (SAMPLES - 1)
    with capsys.disabled():
        print("\n" + "\n".join(lines))
