"""What the tests of the runner share."""

import signal
from collections.abc import Iterator

import pytest


@pytest.fixture(autouse=True)
def undrawn_sweeps(undrawn) -> None:
    """The sweep of test_launchers that runs in a program of its own draws its figure."""


@pytest.fixture
def interruptible() -> Iterator[None]:
    """Ctrl-C takes effect also where these tests are a shell's background job, which ignores it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)
