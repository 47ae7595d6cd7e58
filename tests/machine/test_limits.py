"""Limits of evaluations and memory: they end work with their kind and number, and change nothing below."""

import ctypes
import itertools
import mmap

import pytest
import torch

from bench.machine import limits
from bench.machine.environment import MemoryPeak
from bench.machine.limits import MIN_VALUES_PER_CALL, LimitReached, Limits
from bench.records.record import RunStatus
from renderers.field import Flops, Kind
from renderers.fields.analytic import Shape, sphere

CPU = torch.device("cpu")
POINTS = torch.zeros(5, 3)
FIELD = sphere(1.0)
MIB = 2**20


def test_below_the_limits_values_and_properties_are_those_of_the_field():
    field = Shape(FIELD.function, Kind.LEVEL, lipschitz=3.0, flops=Flops(11, 13))
    watched, points = Limits(values=1e6, memory=8).watch(field, CPU), torch.rand(7, 3, requires_grad=True)
    assert (watched.kind, watched.lipschitz, watched.flops) == (Kind.LEVEL, 3.0, Flops(11, 13))
    values = watched(points)
    assert torch.equal(values, FIELD(points))
    (gradient,) = torch.autograd.grad(values.sum(), points)
    (expected,) = torch.autograd.grad(FIELD(points).sum(), points)
    assert torch.equal(gradient, expected)


def test_values_are_limited_from_when_the_watch_begins():
    limit = Limits(values=100, memory=8)
    for _ in range(2):
        watched = limit.watch(FIELD, CPU, "a step")
        watched(torch.zeros(60, 3))
        watched(torch.zeros(2, 20, 3))
        with pytest.raises(LimitReached) as caught:
            watched(POINTS)
        assert caught.value.status is RunStatus.TIMEOUT
        assert str(caught.value) == "more than 100 field values in a step"


def test_a_call_with_few_points_counts_as_the_least_number():
    watched = Limits(values=10 * MIN_VALUES_PER_CALL, memory=8).watch(FIELD, CPU)
    for _ in range(10):
        watched(torch.zeros(1, 3))
    assert watched.spent == 10 * MIN_VALUES_PER_CALL
    with pytest.raises(LimitReached, match=r"more than 320 field values"):
        watched(torch.zeros(1, 3))


def test_evaluations_of_the_backward_pass_are_limited():
    points = torch.zeros(60, 3, requires_grad=True)
    watched = Limits(values=100, memory=8).watch(FIELD, CPU)
    values = watched(points + 1)
    with pytest.raises(LimitReached, match=r"more than 100 field values") as caught:
        values.sum().backward()
    assert caught.value.status is RunStatus.TIMEOUT and points.grad is None


def test_memory_is_limited(clock):
    limit = Limits(values=1e6, memory=0.125)
    watched, held = limit.watch(FIELD, CPU), []
    if watched.memory.growth() is None:
        pytest.skip("the memory of a process cannot be measured here")
    watched(POINTS)
    with pytest.raises(LimitReached, match=r"more than 0\.125 GiB of memory") as caught:
        for _ in range(100):
            held.append(torch.ones(32 * MIB // 4))
            clock.sleep(1.1 * limits.MEMORY_CHECK_SECONDS)
            watched(POINTS)
    assert caught.value.status is RunStatus.OOM
    assert 3 <= len(held) <= 6  # blocks of 32 MiB


def test_evaluations_are_limited_also_if_memory_cannot_be_measured(monkeypatch):
    monkeypatch.setattr(MemoryPeak, "growth", lambda self: None)
    watched = Limits(values=MIN_VALUES_PER_CALL, memory=1e-6).watch(FIELD, CPU)
    watched(POINTS)
    with pytest.raises(LimitReached) as caught:
        watched(POINTS)
    assert caught.value.status is RunStatus.TIMEOUT


def test_the_memory_is_not_checked_in_every_evaluation(clock, monkeypatch):
    looks = []
    monkeypatch.setattr(MemoryPeak, "growth", lambda self: looks.append(1) or 0)
    watched = Limits(values=1e6, memory=1).watch(FIELD, CPU)
    for number in (1, 2):
        for _ in range(100):
            watched(POINTS)
        assert len(looks) == number
        clock.sleep(1.1 * limits.MEMORY_CHECK_SECONDS)


def test_invalid_limits_are_errors():
    for name, invalid in itertools.product(("values", "memory"), (0.0, -1.0, float("nan"), float("inf"))):
        with pytest.raises(ValueError, match=rf"limits\.{name} must be positive, not {invalid}"):
            Limits(**({"values": 1.0, "memory": 1.0} | {name: invalid}))


def held_but_free(mib: int) -> torch.Tensor:
    """Leaves unused memory in the process: many freed blocks, too small to be mapped, before a last block.

    Returns:
        the last block, which keeps the memory in the process.
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
    assert 0.9 * 64 * MIB < growth < 1.3 * 64 * MIB and len(blocks) + last.numel() > 0


def test_pages_of_files_do_not_count(tmp_path):
    """A process that was forked has the pages of its libraries when it first uses them."""
    (tmp_path / "library").write_bytes(bytes(64 * MIB))
    memory = MemoryPeak(CPU)
    if memory.growth() is None:
        pytest.skip("the memory of a process cannot be measured here")
    with (tmp_path / "library").open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as library:
        assert not any(library[::4096])
        block = torch.ones(32 * MIB // 4)
        assert 30 * MIB < memory.growth() < 48 * MIB
    assert block.numel()


def test_memory_within_a_pause_does_not_count():
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
    assert 44 * MIB < memory.growth() < 80 * MIB and again.numel()
