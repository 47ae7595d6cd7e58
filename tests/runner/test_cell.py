"""A configuration becomes objects, each node once; and a run takes its threads."""

from collections import Counter
from unittest.mock import Mock

import pytest
import torch

from bench import config as config_module
from bench.machine.environment import using_threads
from bench.records.record import Record
from bench.setup.inputs import RunContext, RunInputs, prepare_run
from renderers.checks import BadInput
from tests.tiny import inputs_from, plain, silent


@pytest.fixture(autouse=True)
def as_before():
    with using_threads(torch.get_num_threads()):
        yield


@pytest.fixture
def built(monkeypatch) -> Counter[str]:
    """How often each node was built."""
    counts: Counter[str] = Counter()
    build = config_module.build

    def counted(node, name, *rest, **more):
        counts[name] += 1
        return build(node, name, *rest, **more)

    monkeypatch.setattr(config_module, "build", counted)
    return counts


def test_a_run_builds_each_node_once(compose_config, built):
    prepare_run(plain(compose_config("scale=smoke")))
    assert set(built.values()) == {1}
    assert {"task", "renderer", "view", "dataset", "evaluation", "prior", "models"} <= set(built)


def test_a_node_that_cells_share_is_built_once_also_an_invalid_one(compose_config, built):
    shared, reasons = {}, []
    valid = plain(compose_config("scale=smoke"))
    wrong = valid | {"renderer": valid["renderer"] | {"steps": 0}}
    for config in (valid, wrong, valid | {"index": 3}, wrong):
        try:
            prepare_run(config, shared)
        except ValueError as error:
            reasons.append(str(error))
    assert reasons == ["steps must be at least 1, not 0: the paper uses 50 to 100"] * 2
    assert (built["renderer"], built["task"], built["dataset"], built["prior"]) == (2, 1, 1, 1)


def test_a_shape_has_a_code_of_the_prior_if_its_training_had_the_shape(compose_config):
    cells = [inputs_from(compose_config("split=train", "prior.shapes=2", f"index={index}")) for index in range(3)]
    assert [cell.prior_choice.scene_code for cell in cells] == [0, 1, None]
    with pytest.raises(BadInput, match="at the shape that it was fitted to"):
        cells[2].check_fitted()
    assert inputs_from(compose_config("split=test", "prior.shapes=2", "index=0")).prior_choice.scene_code is None


def test_a_narrow_network_takes_one_thread_and_a_wide_one_all(compose_config, monkeypatch):
    monkeypatch.setattr("bench.setup.inputs.DEFAULT_THREADS", 3)
    for width, threads in ((128, 1), (512, 3)):
        inputs_from(compose_config("scale=smoke", f"scale.network.width={width}")).configure_process()
        assert torch.get_num_threads() == threads


def test_the_run_takes_its_threads_and_its_check_does_not(compose_config):
    torch.set_num_threads(1)
    cell = inputs_from(compose_config("scale=smoke", "threads=2"))
    assert torch.get_num_threads() == 1
    cell.configure_process()
    assert torch.get_num_threads() == 2
    inputs_from(compose_config("scale=smoke")).configure_process()
    assert torch.get_num_threads() == 1


@pytest.mark.parametrize(("context", "name"), [("on_clock", "forward"), ("off_clock", "evaluation")])
def test_the_seconds_of_a_failed_block_are_kept(tmp_path, clock, context, name):
    run = RunContext(Mock(spec=RunInputs), tmp_path, Record("id", "task", "renderer", "dataset", 0, {}), silent)
    with pytest.raises(ZeroDivisionError), getattr(run, context)():
        clock.sleep(2.0)
        _ = 1 / 0
    assert run.record.seconds[name] == pytest.approx(2.0, abs=0.01)
