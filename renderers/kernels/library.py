"""Compiled code that replaces PyTorch, with equal values up to rounding; built once per machine, if possible.

It computes values of float32 ReLU networks, and their gradients towards points and biases, on one thread of a CPU;
PyTorch computes all else. Renderers need these in different proportions, so ratios of runtimes depend on the engine; a
record names it under `kernels`. `IMPLICIT_BENCH_KERNELS=torch` uses PyTorch for everything.
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

KERNELS_VARIABLE = "IMPLICIT_BENCH_KERNELS"
TORCH, COMPILED = "torch", "compiled"
SOURCE = Path(__file__).with_name("decoder.cpp")
COMPILERS = ("g++", "clang++")
FLAGS = ("-std=c++17", "-O3", "-march=native", "-shared", "-fPIC")
REQUIRED_CPU_FLAGS = {"avx2", "fma"}
COMPILE_TIMEOUT_SECONDS = 60.0  # the compiler takes less than 2 s


@dataclass(frozen=True)
class Kernels:
    """The compiled library or None, and its description for records: "compiled", "torch", or "torch: REASON"."""

    library: ctypes.CDLL | None
    description: str

    def description_for(self, device: str, threads: int) -> str:
        """The description for a run on a type of device with a number of threads."""
        can_run = self.library is None or (device == "cpu" and threads == 1)
        return self.description if can_run else f"{TORCH}: compiled code is for one thread of a CPU"


@cache
def kernels() -> Kernels:
    """The compiled code for this processor; the first call on a machine builds it, in about a second.

    Raises:
        ValueError: if `IMPLICIT_BENCH_KERNELS` is neither torch nor compiled.
    """
    wanted = os.environ.get(KERNELS_VARIABLE) or COMPILED
    if wanted not in (TORCH, COMPILED):
        raise ValueError(f"{KERNELS_VARIABLE} must be {TORCH} or {COMPILED}, not {wanted!r}: unset it for {COMPILED}")
    if wanted == TORCH:
        return Kernels(None, TORCH)
    processor = _processor()
    if not set(processor.split()) >= REQUIRED_CPU_FLAGS:
        return Kernels(None, f"{TORCH}: the processor lacks {' or '.join(sorted(REQUIRED_CPU_FLAGS))}")
    try:
        library = _load(processor)
    except (OSError, RuntimeError, subprocess.SubprocessError) as error:  # such as no compiler or a full disk
        return Kernels(None, f"{TORCH}: {' '.join(str(error).split())[:200]}")
    pointer, count = ctypes.c_void_p, ctypes.c_int64
    library.decoder_values.argtypes, library.decoder_values.restype = [pointer, pointer, count, pointer], None
    library.decoder_gradients.argtypes = [pointer, pointer, count, pointer, pointer, pointer]
    library.decoder_gradients.restype = None
    return Kernels(library, COMPILED)


def _processor() -> str:
    """The name and the flags of this processor, for which the code is built; empty if unknown."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return ""
    return " ".join(line for line in lines[:40] if line.startswith(("model name", "flags")))


def _load(processor: str) -> ctypes.CDLL:
    """Loads the library from the user's cache, and builds it first if it is missing or damaged.

    Raises:
        OSError, RuntimeError, SubprocessError: if it cannot be built or loaded.
    """
    compiler = next((path for name in COMPILERS if (path := shutil.which(name))), None)
    if compiler is None:
        raise OSError(f"no compiler ({' or '.join(COMPILERS)})")
    cache_key_text = "\0".join([SOURCE.read_text(encoding="utf-8"), compiler, *FLAGS, processor])
    cached = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    path = Path(cached, "implicit-bench", "kernels", f"{hashlib.sha256(cache_key_text.encode()).hexdigest()[:16]}.so")
    try:
        return ctypes.CDLL(str(path))
    except OSError:
        _build(compiler, path)
        return ctypes.CDLL(str(path))


def _build(compiler: str, path: Path) -> None:
    """Compiles in a temporary folder, then moves the library to `path`, as other processes may do at the same time."""
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=path.parent) as folder:
        built = Path(folder, path.name)
        command = [compiler, *FLAGS, str(SOURCE), "-o", str(built)]
        process = subprocess.run(command, capture_output=True, text=True, timeout=COMPILE_TIMEOUT_SECONDS)
        if process.returncode:
            raise OSError(f"{Path(compiler).name}: {process.stderr.strip() or 'failed'}")
        built.replace(path)
