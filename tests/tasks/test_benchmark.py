"""Renderers timed in turn: whose costs stand where, and what the ratios are."""

from dataclasses import replace

import pytest
import torch

from bench.machine.limits import Limits
from bench.records.record import RunStatus
from bench.tasks import benchmark
from bench.tasks.benchmark import BASE, Benchmark
from bench.tasks.workbench import Clocked
from renderers.field import Counts
from tests.tasks.test_ablation import PRIOR, load, run_of, view

SETTINGS = Benchmark(
    beside=["newton", "dvr"], size=16, threads=1, rounds=2, limits=Limits(values=1e6, memory=8), wrong=0.02
)


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    run = run_of(tmp_path_factory.mktemp("run"), load("renderer", "dist"), PRIOR, view(32))
    SETTINGS.execute(run)
    return run


def test_every_renderer_has_its_costs_and_errors_under_its_name(done):
    metrics = done.record.metrics
    assert done.record.status is RunStatus.OK
    names = {key.split(".")[0] for key in metrics if "." in key}
    assert names == {BASE, "newton", "dvr"}
    assert metrics["rounds"] == 2
    defined = [part.strip() for key in done.record.definitions for part in key.split(",")]
    assert [key for key in metrics if not any(key.split(".")[-1].startswith(part) for part in defined)] == []
    for name in names:
        assert metrics[f"{name}.rays"] == 16**2
        assert metrics[f"{name}.hits"] > 20
        assert metrics[f"{name}.queries"] > 0
        assert metrics[f"{name}.forward_seconds"] > 0
    assert metrics["dvr.queries"] > 5 * metrics["newton.queries"]
    assert metrics["newton.depth_error_median"] < metrics[f"{BASE}.depth_error_median"]
    assert metrics[f"{BASE}.forward_ratio"] == metrics[f"{BASE}.step_cpu_ratio_high"] == 1


def test_ratios_are_of_the_same_round():
    def clocked(*seconds: float) -> Clocked:
        return Clocked([seconds[0]], [0.0], [seconds[1]], Counts(7, 3, coarse=5), 10, None)

    mine = [(clocked(2.0, 4.0), clocked(1.0, 1.0)), (clocked(9.0, 4.0), clocked(1.0, 1.0))]
    base = [(clocked(1.0, 8.0), clocked(2.0, 2.0)), (clocked(3.0, 2.0), clocked(4.0, 2.0))]
    costs = benchmark._costs([*mine, mine[0]], [*base, base[0]])
    assert (costs["forward_ratio"], costs["forward_ratio_low"], costs["forward_ratio_high"]) == (2.0, 2.0, 3.0)
    assert (costs["forward_cpu_ratio"], costs["forward_cpu_ratio_high"]) == (0.5, 2.0)
    assert (costs["step_ratio"], costs["step_ratio_low"]) == (0.5, 0.25)
    assert (costs["forward_seconds"], costs["forward_cpu"]) == (2.0, 4.0)
    assert (costs["queries"], costs["coarse_queries"], costs["peak_memory_bytes"]) == (7, 5, 10)


def test_a_limit_names_the_renderer(tmp_path):
    run = run_of(tmp_path, load("renderer", "dist"), PRIOR, view(32))
    replace(SETTINGS, limits=Limits(values=8000, memory=8)).execute(run)
    assert run.record.status is RunStatus.TIMEOUT
    assert run.record.reason.startswith("dvr: more than 8,000 field values")


def test_threads_are_those_asked_for_and_given_back(tmp_path, monkeypatch):
    seen, before = [], torch.get_num_threads()
    clock = benchmark.Workbench._clock
    monkeypatch.setattr(
        benchmark.Workbench, "_clock", lambda *given: seen.append(torch.get_num_threads()) or clock(*given)
    )
    replace(SETTINGS, threads=2, rounds=1, beside=[]).execute(
        run_of(tmp_path, load("renderer", "dist"), PRIOR, view(32))
    )
    assert set(seen) == {2}
    assert torch.get_num_threads() == before


@pytest.mark.parametrize("changed", [{"rounds": 0}, {"size": 2}, {"threads": 0}, {"wrong": 0.0}])
def test_bad_settings_are_refused(changed):
    with pytest.raises(ValueError, match=f"task.{next(iter(changed))}"):
        replace(SETTINGS, **changed)
