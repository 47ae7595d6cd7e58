"""The name of this machine's processor, without torch."""

import platform
from pathlib import Path


def cpu_name() -> str:
    """The processor's name as records have it under `environment.cpu`."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), platform.machine())
