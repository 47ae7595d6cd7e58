"""Imported by the server of processes that tests run in: its runs do not find out anew what the machine and git say.

Half a second of each run is spared so. A run that is a program of its own does find out, such as that of test_run.
"""

from bench.machine import environment

RATE = 1e12  # operations a second, more than a core does, so that no run seems too fast

environment.gemm_peak = lambda *_, **__: RATE
environment._git = lambda *_: ""
