"""Compiled code beside plain PyTorch, which does the same up to rounding: built once per machine, where possible.

Compiled are the values of float32 ReLU networks without a gradient, on one thread of a CPU. PyTorch computes all else:
values with a gradient, coarse values, and those of softplus networks, grids and formulas. Renderers ask for these in
different shares, so that a ratio of their seconds depends on the engine: a record names it under `kernels`.
`IMPLICIT_BENCH_KERNELS=torch` leaves all to PyTorch.
"""

import ctypes
import hashlib
import os
import shutil
import subprocess
import tempfile
from dataclasses import dataclass
from functools import cache
from pathlib import Path

VARIABLE = "IMPLICIT_BENCH_KERNELS"
TORCH, COMPILED = "torch", "compiled"
SOURCE = Path(__file__).with_name("decoder.cpp")
COMPILERS = ("g++", "clang++")
FLAGS = ("-std=c++17", "-O3", "-march=native", "-shared", "-fPIC")
NEEDED = {"avx2", "fma"}  # of the processor's flags
LONGEST = 60.0  # seconds for the compiler, which takes less than two


@dataclass(frozen=True)
class Kernels:
    """The library, or None; and for a record which of the two runs: "compiled", "torch", or why it is torch."""

    library: ctypes.CDLL | None
    said: str

    def said_of(self, device: str, threads: int) -> str:
        """The same of a run on that type of device with so many threads."""
        suits = self.library is None or (device == "cpu" and threads == 1)
        return self.said if suits else f"{TORCH}: compiled code is for one thread of a CPU"


@cache
def kernels() -> Kernels:
    """The compiled code for this processor; the first call on a machine builds it, in about a second.

    Raises:
        ValueError: where `IMPLICIT_BENCH_KERNELS` is something else than torch or compiled.
    """
    wanted = os.environ.get(VARIABLE) or COMPILED
    if wanted not in (TORCH, COMPILED):
        raise ValueError(f"{VARIABLE} must be {TORCH} or {COMPILED}, not {wanted!r}: unset it for {COMPILED}")
    if wanted == TORCH:
        return Kernels(None, TORCH)
    processor = _processor()
    if not set(processor.split()) >= NEEDED:
        return Kernels(None, f"{TORCH}: the processor lacks {' or '.join(sorted(NEEDED))}")
    try:
        library = _loaded(processor)
    except (OSError, RuntimeError, subprocess.SubprocessError) as error:  # no compiler, home or disk, or it failed
        return Kernels(None, f"{TORCH}: {' '.join(str(error).split())[:200]}")
    place, count = ctypes.c_void_p, ctypes.c_int64
    library.decoder_values.argtypes, library.decoder_values.restype = [place, place, count, place], None
    return Kernels(library, COMPILED)


def _processor() -> str:
    """The name and the flags of this processor, for which the code is built; empty where that is not known."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return ""
    return " ".join(line for line in lines[:40] if line.startswith(("model name", "flags")))


def _loaded(processor: str) -> ctypes.CDLL:
    """The library of the user's cache, built where there is none that can be loaded.

    Raises:
        OSError, RuntimeError, SubprocessError: where that is not possible.
    """
    compiler = next((found for name in COMPILERS if (found := shutil.which(name))), None)
    if compiler is None:
        raise OSError(f"no compiler ({' or '.join(COMPILERS)})")
    made_of = "\0".join([SOURCE.read_text(encoding="utf-8"), compiler, *FLAGS, processor])
    cached = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    path = Path(cached, "implicit-bench", "kernels", f"{hashlib.sha256(made_of.encode()).hexdigest()[:16]}.so")
    try:
        return ctypes.CDLL(str(path))
    except OSError:  # none yet, or a damaged one
        _build(compiler, path)
        return ctypes.CDLL(str(path))


def _build(compiler: str, path: Path) -> None:
    """Compiles into a folder of its own, and moves the library into place: others may do the same at once."""
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=path.parent) as folder:
        made = Path(folder, path.name)
        command = [compiler, *FLAGS, str(SOURCE), "-o", str(made)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=LONGEST)
        if done.returncode:
            raise OSError(f"{Path(compiler).name}: {done.stderr.strip() or 'failed'}")
        made.replace(path)
