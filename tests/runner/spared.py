"""Imported by the server of test processes: its runs neither call git nor measure the machine.

This saves half a second per run. Runs in a separate program, such as that of test_run, do measure.
"""

from bench.machine import environment

RATE = 1e12  # operations a second, more than a core does, so that no run seems too fast

environment.gemm_peak = lambda *_, **__: RATE
environment._git = lambda *_: ""
