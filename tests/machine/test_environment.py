"""A run says where its times are not to be trusted: on a loaded machine, or where the clock did not wait."""

import os
import subprocess
import sys
import time

import pytest

from bench.machine import environment
from bench.records.record import Record
from tests.looped import each

HAS_COUNTS = environment.scheduled() is not None


def record(**changed) -> Record:
    made = Record("id", "task", "renderer", "dataset", 0, {})
    made.environment = {"waited_share": changed.pop("share", 0.0), "load_at_start": changed.pop("load", 0.0)}
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
        ({"gemm_fraction": 3.0}, ["missing synchronisation: 3.0 times the machine's matrix product rate"]),
        ({"share": 0.5, "gemm_fraction": 3.0}, ["loaded machine", "missing synchronisation"]),
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
