"""A run warns if its times are unreliable: on a loaded machine, or without synchronisation."""

import os
import subprocess
import sys
import threading
import time
from dataclasses import dataclass, field

import pytest
import torch

from bench.machine import environment
from bench.machine.environment import Stopwatch
from bench.records.record import Record
from tests.looped import each

CPU = torch.device("cpu")
HAS_COUNTS = environment.scheduled() is not None


def record(**changed) -> Record:
    result = Record("id", "task", "renderer", "dataset", 0, {})
    result.environment = {"waited_share": changed.pop("share", 0.0), "load_at_start": changed.pop("load", 0.0)}
    result.environment |= {"device": changed.pop("device", "cpu"), "runs_at_once": changed.pop("runs_at_once", 1)}
    for name, value in changed.items():
        setattr(result, name, value)
    return result


@each(
    "changed, words",
    [
        ({}, []),
        ({"share": 0.04, "load": 99.0, "gemm_fraction": 0.9}, []),
        ({"share": 0.3}, ["loaded machine: threads waited 30% of their time"]),
        ({"share": None, "load": 99.0}, ["loaded machine: load 99.0 at the start"]),
        ({"share": None, "load": 0.1}, []),
        ({"runs_at_once": 4}, []),  # each run has separate processors
        ({"device": "a GPU"}, []),
        ({"runs_at_once": 4, "device": "a GPU"}, ["shared device: 4 runs at a time on it"]),
        ({"gemm_fraction": 3.0, "device": "a GPU"}, ["missing synchronisation: 3.0 times the machine's matrix"]),
        ({"share": 0.5, "gemm_fraction": 3.0, "device": "a GPU"}, ["loaded machine", "missing synchronisation"]),
        ({"gemm_fraction": 3.0}, []),  # on a CPU compiled code is faster than the product of PyTorch
    ],
)
def test_unreliable_times_have_a_warning(changed, words):
    lines = environment.doubts(record(**changed))
    assert [line.startswith(word) for line, word in zip(lines, words, strict=True)] == [True] * len(words)


@pytest.mark.skipif(not HAS_COUNTS, reason="this system does not count how long threads wait")
def test_a_busy_machine_is_detected():
    core = {sorted(os.sched_getaffinity(0))[0]}
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, core)
    others = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(2)]  # on the same core
    try:
        started, latest = environment.scheduled(), time.monotonic() + 120
        while not (share := environment.waited_share(started) or 0.0) > 0.3 and time.monotonic() < latest:
            sum(range(10**6))
        assert 0.3 < share < 1
    finally:
        for other in others:
            other.kill()
            other.wait()
        os.sched_setaffinity(0, before)


def test_the_waiting_time_is_unknown_if_threads_have_ended(monkeypatch):
    monkeypatch.setattr(environment, "scheduled", lambda: (500, 20))
    assert environment.waited_share((1000, 10)) is None and environment.waited_share((400, 15)) == 5 / 105


def products() -> set[float]:
    """The products of a denormal number and 1, in each thread of an operation."""
    count = environment.PER_THREAD * torch.get_num_threads()
    bits = torch.full((count,), environment.DENORMAL, dtype=torch.int32)
    return set((bits.view(torch.float32) * 1.0).view(torch.int32).tolist())


@pytest.mark.skipif(not torch.set_flush_denormal(False), reason="this processor does not round denormals to 0")
def test_forward_and_backward_threads_flush_denormals_within_the_block():
    results = {}

    class Noting(torch.autograd.Function):
        @staticmethod
        def forward(ctx, x):
            results["forward"] = products()
            return x.clone()

        @staticmethod
        def backward(ctx, *gradients):
            results["backward"] = products()
            return gradients[0]

    def work():  # the operations of this thread have no threads yet, as in the process of a run
        with environment.flushing_denormals():
            Noting.apply(torch.ones(1, requires_grad=True)).backward()
            results["stated"] = environment.describe(CPU)["denormals_flushed"]
        results["this thread after"] = sys.float_info.min / 2 > 0

    with environment.using_threads(2):
        thread = threading.Thread(target=work)
        thread.start()
        thread.join()
    assert results == {"forward": {0}, "backward": {0}, "stated": True, "this thread after": True}
    assert not environment.describe(CPU)["denormals_flushed"]


def test_the_description_can_be_read_without_torch():
    assert "torch" not in {type(value).__module__.partition(".")[0] for value in environment.describe(CPU).values()}


@dataclass
class Device:
    """Replaces a GPU whose work takes two seconds, and records its calls in order."""

    calls: list[str] = field(default_factory=list)

    def synchronize(self, device: torch.device) -> None:
        self.calls.append(f"wait for {device}")

    def current_stream(self, device: torch.device) -> str:
        return f"stream of {device}"

    def event(self, enable_timing: bool) -> "Device":
        assert enable_timing
        return self

    def record(self, stream: str) -> None:
        self.calls.append(f"event in {stream}")

    def elapsed_time(self, end: "Device") -> float:
        self.calls.append("read")
        return 2000.0


def test_a_stopwatch_reads_the_clock_on_a_cpu_and_events_of_a_gpu(monkeypatch):
    stopwatch, before = Stopwatch(torch.device("cpu")), time.perf_counter()
    time.sleep(0.02)
    assert 0.02 <= time.perf_counter() - before <= stopwatch.seconds() < 60
    device = Device()
    monkeypatch.setattr(torch.cuda, "Event", device.event)
    for name in ("synchronize", "current_stream"):
        monkeypatch.setattr(torch.cuda, name, getattr(device, name))
    stopwatch = Stopwatch(torch.device("cuda:0"))
    device.calls.append("work")
    assert stopwatch.seconds() == 2.0
    wait, event = "wait for cuda:0", "event in stream of cuda:0"
    assert device.calls == [wait, event, "work", event, wait, "read"]


def test_coarse_operations_have_the_rate_of_float32_if_bfloat16_has_none():
    assert environment.seconds_at_peak({"gemm_peak_flops": 10.0, "bfloat16_peak_flops": 30.0}, 20, 30) == 3.0
    assert environment.seconds_at_peak({"gemm_peak_flops": 10.0, "bfloat16_peak_flops": None}, 20, 30) == 5.0
