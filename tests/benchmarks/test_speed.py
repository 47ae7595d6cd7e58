"""The rate of DIST relative to the limits of the machine, on the 8x512 network: `make bench`, on a quiet machine.

Rates are compared within one process, with the same weights, camera and threads.
"""

from collections.abc import Callable
from dataclasses import asdict

import pytest
import torch

from bench.config import load
from bench.machine.environment import MemoryPeak, gemm_peak
from bench.shape_prior import initialise_to_sphere
from datasets.views import ViewSampler
from renderers.field import Counts, Meter
from renderers.fields.mlp import Decoder

pytestmark = pytest.mark.slow
CPU = torch.device("cpu")
MIN_FRACTION_OF_GEMM = 0.7
MAX_STEP_BYTES = 2 * 2**30  # at 512 x 512 pixels
THREADS = 2


@pytest.fixture(scope="module", autouse=True)
def threads():
    before = torch.get_num_threads()
    torch.set_num_threads(THREADS)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def decoder() -> Decoder:
    torch.manual_seed(0)
    decoder = Decoder(layers=8, width=512, code_length=256, skip=4, narrow=True)
    initialise_to_sphere(decoder, radius=0.5)
    return decoder.requires_grad_(False)


def step(decoder: Decoder, size: int, *, backward: bool, **settings) -> Callable[[], Counts]:
    """Gives a function to be timed: a rendering of DIST or a step of an optimisation, which returns its counts."""
    renderer = load("renderer", "dist", **settings)
    rays = ViewSampler(2.5, 50.0, (0.0, 360.0), (15.0, 35.0), size).camera(30.0, 25.0).rays()
    code = torch.zeros(decoder.code_length, requires_grad=backward)
    mask = torch.ones(rays.shape, dtype=torch.bool)

    def work() -> Counts:
        counts = Counts()
        field = Meter(decoder.at(code), counts)
        with torch.set_grad_enabled(backward):
            rendering = renderer.render(field, rays)
            if backward:
                silhouette = renderer.silhouette_loss(field, rays, rendering, mask)
                (rendering.distance[rendering.hit].sum() + silhouette).backward()
        assert rendering.hit.any()
        return counts

    return work


@pytest.mark.parametrize("backward", [False, True], ids=["forward", "forward and backward"])
def test_rendering_reaches_most_of_the_rate_of_a_matrix_product(benchmark, decoder, backward):
    work = step(decoder, 256, backward=backward)
    before = gemm_peak(CPU)
    counts = benchmark.pedantic(work, rounds=5, warmup_rounds=1)
    peak = max(before, gemm_peak(CPU))
    flops = counts.flops(decoder.at(torch.zeros(decoder.code_length)))
    share = flops / benchmark.stats.stats.median / peak
    benchmark.extra_info |= {"share_of_gemm": share, "gemm_gflops": peak / 1e9, **asdict(counts)}
    print(f"\n{share:.2f} of {peak / 1e9:.0f} GFLOP/s; {counts}")
    assert share >= MIN_FRACTION_OF_GEMM


def test_memory_stays_low_and_does_not_grow_with_the_steps(decoder):
    rises = {}
    for steps in (50, 400):
        work = step(decoder, 512, backward=True, steps=steps, n_gradient_samples=1)
        memory = MemoryPeak(CPU)
        work()
        rises[steps] = memory.growth()
    print("\n" + ", ".join(f"{steps} steps: {rise / 2**20:.0f} MiB" for steps, rise in rises.items()))
    assert max(rises.values()) < MAX_STEP_BYTES and rises[400] < 1.1 * rises[50]
