"""Limits on time and memory: reached, told with their kind and number, and no hindrance below."""

import ctypes
import time

import pytest
import torch

from bench import limits
from bench.environment import MemoryPeak
from bench.limits import LimitReached, Limits
from bench.records import RunStatus
from renderers.field import Flops, Kind
from renderers.fields.analytic import Shape, sphere

CPU = torch.device("cpu")
POINTS = torch.zeros(5, 3)
FIELD = sphere(1.0)
MIB = 2**20


def reached(watched, *, within: float = 30.0) -> tuple[LimitReached, float]:
    """Asks until the limit is reached; the error, and the seconds that it took."""
    started = time.perf_counter()
    with pytest.raises(LimitReached) as caught:
        while time.perf_counter() - started < within:
            watched(POINTS)
    return caught.value, time.perf_counter() - started


def test_below_its_limits_a_field_gives_what_it_gives():
    points = torch.rand(7, 3, requires_grad=True)
    values = Limits(seconds=60, memory=8).watch(FIELD, CPU)(points)
    assert torch.equal(values, FIELD(points))
    (gradient,) = torch.autograd.grad(values.sum(), points)
    (expected,) = torch.autograd.grad(FIELD(points).sum(), points)
    assert torch.equal(gradient, expected)


def test_what_a_field_states_of_itself_passes_through():
    field = Shape(FIELD.function, Kind.LEVEL, lipschitz=3.0, flops=Flops(11, 13))
    watched = Limits(seconds=60, memory=8).watch(field, CPU)
    assert (watched.kind, watched.lipschitz, watched.flops) == (Kind.LEVEL, 3.0, Flops(11, 13))


def test_time_is_limited_from_when_the_watch_begins():
    limit = Limits(seconds=0.2, memory=8)
    time.sleep(0.25)
    error, took = reached(limit.watch(FIELD, CPU))
    assert error.status is RunStatus.TIMEOUT
    assert str(error) == "more than 0.2 s"
    assert 0.15 < took < 2


def test_time_is_limited_on_the_way_back_too():
    points = POINTS.clone().requires_grad_(True)
    watched = Limits(seconds=0.2, memory=8).watch(FIELD, CPU)
    values = watched(points + 1)
    time.sleep(0.25)
    with pytest.raises(LimitReached, match=r"more than 0\.2 s") as caught:
        values.sum().backward()
    assert caught.value.status is RunStatus.TIMEOUT
    assert points.grad is None


def test_memory_is_limited():
    limit = Limits(seconds=60, memory=0.125)
    watched, held = limit.watch(FIELD, CPU), []
    if watched.memory.growth() is None:
        pytest.skip("the memory of a process cannot be measured here")
    watched(POINTS)
    with pytest.raises(LimitReached, match=r"more than 0\.125 GiB of memory") as caught:
        for _ in range(100):
            held.append(torch.ones(32 * MIB // 4))
            time.sleep(1.1 * limits.BETWEEN)
            watched(POINTS)
    assert caught.value.status is RunStatus.OOM
    assert 3 <= len(held) <= 6  # of 32 MiB each


def test_memory_is_limited_on_the_way_back_too(monkeypatch):
    watched = Limits(seconds=60, memory=1).watch(FIELD, CPU)
    values = watched(POINTS.clone().requires_grad_(True) + 1)
    monkeypatch.setattr(watched, "looked", 0.0)
    monkeypatch.setattr(watched.memory, "growth", lambda: 2**30 + 1)
    with pytest.raises(LimitReached, match="more than 1 GiB of memory"):
        values.sum().backward()


def test_where_memory_cannot_be_measured_time_is_still_limited(monkeypatch):
    monkeypatch.setattr(MemoryPeak, "growth", lambda self: None)
    error, _ = reached(Limits(seconds=0.05, memory=1e-6).watch(FIELD, CPU))
    assert error.status is RunStatus.TIMEOUT


def test_the_memory_is_not_looked_at_in_every_evaluation(monkeypatch):
    looks = []
    monkeypatch.setattr(MemoryPeak, "growth", lambda self: looks.append(1) or 0)
    watched = Limits(seconds=60, memory=1).watch(FIELD, CPU)
    started = time.perf_counter()
    for _ in range(300):
        watched(POINTS)
    assert 1 <= len(looks) <= 1 + (time.perf_counter() - started) / limits.BETWEEN


@pytest.mark.parametrize("wrong", [0.0, -1.0, float("nan"), float("inf")])
@pytest.mark.parametrize("name", ["seconds", "memory"])
def test_numbers_that_cannot_be_are_told(name, wrong):
    with pytest.raises(ValueError, match=rf"limits\.{name} must be positive, not {wrong}"):
        Limits(**({"seconds": 1.0, "memory": 1.0} | {name: wrong}))


def held_but_free(mib: int) -> torch.Tensor:
    """Leaves memory in the process that it does not use: many blocks too small to be mapped, freed behind a last one.

    Returns:
        the last block, to be kept while the memory is to stay.
    """
    blocks = [torch.ones(16 * 1024) for _ in range(16 * mib)]  # of 64 KiB
    return blocks[-1]


def test_a_rise_shows_in_memory_that_the_process_still_holds():
    if not hasattr(ctypes.CDLL(None), "malloc_trim"):
        pytest.skip("this C library keeps its free memory to itself")
    last = held_but_free(128)
    memory = MemoryPeak(CPU)
    blocks = [torch.ones(16 * 1024) for _ in range(16 * 64)]
    growth = memory.growth()
    if growth is None:
        pytest.skip("the memory of a process cannot be measured here")
    assert 0.9 * 64 * MIB < growth < 1.3 * 64 * MIB
    assert len(blocks) + last.numel() > 0


def test_what_a_pause_takes_does_not_count():
    memory = MemoryPeak(CPU)
    if memory.growth() is None:
        pytest.skip("the memory of a process cannot be measured here")
    first = torch.ones(16 * MIB // 4)
    del first
    with memory.pause():
        paused = torch.ones(96 * MIB // 4)
        del paused
    assert 14 * MIB < memory.growth() < 40 * MIB
    again = torch.ones(48 * MIB // 4)
    assert 44 * MIB < memory.growth() < 80 * MIB
    assert again.numel()
