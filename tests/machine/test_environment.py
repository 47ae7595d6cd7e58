"""A run says where its times are not to be trusted: on a loaded machine, or where the clock did not wait."""

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
    made = Record("id", "task", "renderer", "dataset", 0, {})
    made.environment = {"waited_share": changed.pop("share", 0.0), "load_at_start": changed.pop("load", 0.0)}
    made.environment |= {"device": changed.pop("device", "cpu"), "runs_at_once": changed.pop("beside", 1)}
    for name, value in changed.items():
        setattr(made, name, value)
    return made


@each(
    "changed, words",
    [
        ({}, []),
        ({"share": 0.04, "load": 99.0, "gemm_fraction": 0.9}, []),
        ({"share": 0.3}, ["loaded machine: threads waited 30% of their time"]),
        ({"share": None, "load": 99.0}, ["loaded machine: load 99.0 at the start"]),
        ({"share": None, "load": 0.1}, []),
        ({"beside": 4}, []),  # each has processors of its own
        ({"device": "a GPU"}, []),
        ({"beside": 4, "device": "a GPU"}, ["shared device: 4 runs at a time on it"]),
        ({"gemm_fraction": 3.0, "device": "a GPU"}, ["missing synchronisation: 3.0 times the machine's matrix"]),
        ({"share": 0.5, "gemm_fraction": 3.0, "device": "a GPU"}, ["loaded machine", "missing synchronisation"]),
        ({"gemm_fraction": 3.0}, []),  # of a CPU, whose compiled code is faster than PyTorch's product
    ],
)
def test_it_warns_where_there_is_a_reason(changed, words):
    lines = environment.doubts(record(**changed))
    assert [line.startswith(word) for line, word in zip(lines, words, strict=True)] == [True] * len(words)


@pytest.mark.skipif(not HAS_COUNTS, reason="this system does not count how long threads wait")
def test_a_busy_machine_is_seen():
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


def test_threads_that_ended_meanwhile_make_it_unknown(monkeypatch):
    monkeypatch.setattr(environment, "scheduled", lambda: (500, 20))
    assert environment.waited_share((1000, 10)) is None
    assert environment.waited_share((400, 15)) == 5 / 105


def products() -> set[float]:
    """Of a denormal number and one, in each thread of an operation."""
    count = environment.NUMBERS_PER_THREAD * torch.get_num_threads()
    bits = torch.full((count,), environment.DENORMAL_BITS, dtype=torch.int32)
    return set((bits.view(torch.float32) * 1.0).view(torch.int32).tolist())


@pytest.mark.skipif(not torch.set_flush_denormal(False), reason="this processor does not round denormals to 0")
def test_within_it_forward_and_backward_threads_take_denormals_as_0():
    found = {}

    class Noting(torch.autograd.Function):
        @staticmethod
        def forward(ctx, x):
            found["forward"] = products()
            return x.clone()

        @staticmethod
        def backward(ctx, *gradients):
            found["backward"] = products()
            return gradients[0]

    def work():  # in a thread whose operations have no threads yet, as those of a run's process
        with environment.flushing_denormals():
            Noting.apply(torch.ones(1, requires_grad=True)).backward()
            found["said"] = environment.describe(CPU)["denormals_flushed"]
        found["this thread after"] = sys.float_info.min / 2 > 0

    with environment.using_threads(2):
        thread = threading.Thread(target=work)
        thread.start()
        thread.join()
    assert found == {"forward": {0}, "backward": {0}, "said": True, "this thread after": True}
    assert not environment.describe(CPU)["denormals_flushed"]


def test_the_description_can_be_read_without_torch():
    assert "torch" not in {type(value).__module__.partition(".")[0] for value in environment.describe(CPU).values()}


@dataclass
class Device:
    """Stands in for a GPU whose work takes two seconds; notes what it is asked for, in order."""

    asked: list[str] = field(default_factory=list)

    def synchronize(self, device: torch.device) -> None:
        self.asked.append(f"wait for {device}")

    def current_stream(self, device: torch.device) -> str:
        return f"stream of {device}"

    def event(self, enable_timing: bool) -> "Device":
        assert enable_timing
        return self

    def record(self, stream: str) -> None:
        self.asked.append(f"event in {stream}")

    def elapsed_time(self, end: "Device") -> float:
        self.asked.append("read")
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
    device.asked.append("work")
    assert stopwatch.seconds() == 2.0
    wait, event = "wait for cuda:0", "event in stream of cuda:0"
    assert device.asked == [wait, event, "work", event, wait, "read"]


def test_coarse_operations_take_float32s_rate_where_bfloat16_has_none():
    assert environment.seconds_at_peak({"gemm_peak_flops": 10.0, "bfloat16_peak_flops": 30.0}, 20, 30) == 3.0
    assert environment.seconds_at_peak({"gemm_peak_flops": 10.0, "bfloat16_peak_flops": None}, 20, 30) == 5.0


def test_a_measurement_of_the_machine_changes_no_draw_of_a_run():
    torch.manual_seed(0)
    expected = torch.rand(3)
    torch.manual_seed(0)
    for dtype in (torch.float32, torch.bfloat16):
        environment.gemm_peak(torch.device("cpu"), dtype)
    assert torch.equal(torch.rand(3), expected)
