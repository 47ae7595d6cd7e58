"""What a run is set up with: how many threads it takes."""

import pytest
import torch

from bench.machine.environment import using_threads
from bench.setup.inputs import ALL_THREADS, set_up, threads_for
from tests.tiny import silent


@pytest.fixture(autouse=True)
def as_before():
    with using_threads(torch.get_num_threads()):
        yield


def test_a_narrow_network_takes_one_thread_and_a_wide_one_all():
    assert threads_for(128) == 1
    assert threads_for(512) == ALL_THREADS


def test_the_threads_that_are_asked_for_are_taken(compose_config):
    set_up(compose_config("scale=smoke"), silent)
    assert torch.get_num_threads() == 1
    set_up(compose_config("scale=smoke", "threads=2"), silent)
    assert torch.get_num_threads() == 2


def test_threads_are_as_before_behind_a_part_that_takes_others():
    torch.set_num_threads(1)
    with pytest.raises(ValueError), using_threads(2):
        assert torch.get_num_threads() == 2
        raise ValueError
    assert torch.get_num_threads() == 1
