"""The environment of a run: versions, hardware, the machine's peak rate, memory, and disturbances of runtimes."""

import ctypes
import hashlib
import os
import platform
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import torch

from bench.records.record import CONCURRENT_RUNS_VARIABLE, MAX_WAIT_FRACTION, Record
from datasets.extras import version
from renderers.fields.mlp import bfloat16_is_faster
from renderers.kernels.library import kernels

ROOT = Path(__file__).resolve().parents[2]
# Rows of the square matrices of `gemm_peak`: up to two threads reach the same rate with the smaller ones.
GEMM_SIDE, SMALL_GEMM_SIDE, MAX_SMALL_GEMM_THREADS, GEMM_REPEATS = 1024, 512, 2, 6
PACKAGES = ("torch", "numpy", "scipy", "open3d", "pymeshlab", "trimesh", "scikit-image", "hydra-core")
CODE_ONLY = ("--", ".", ":(exclude)results")  # arguments of git: results are written by reports
DENORMAL_BITS = 713_623  # 1e-39, below float32's full precision, as bits, since the number itself may become 0
NUMBERS_PER_THREAD = 2**15  # PyTorch computes an operation on fewer numbers in one thread
MAX_GEMM_FRACTION = 1.2  # a GPU that exceeds its matrix product rate by more was not synchronised with the clock


def pick_device(wanted: str) -> torch.device:
    """The device of `device=auto|cpu|cuda`.

    Raises:
        ValueError: if cuda is requested but PyTorch sees no GPU.
    """
    if wanted == "cuda" and not torch.cuda.is_available():
        raise ValueError("device=cuda, but PyTorch sees no GPU: set device=cpu, or install a CUDA build of torch")
    return torch.device("cuda" if wanted == "cuda" or (wanted == "auto" and torch.cuda.is_available()) else "cpu")


def describe(device: torch.device) -> dict[str, Any]:
    """The environment as plain data for the record."""
    diff = _git("diff", "HEAD", *CODE_ONLY)
    return {
        "commit": _git("rev-parse", "HEAD"),
        "dirty": bool(diff),
        "diff": hashlib.sha256(diff.encode()).hexdigest()[:12] if diff else "",
        "implicit_bench": version("implicit-bench") or "",
        "python": platform.python_version(),
        **{package.replace("-", "_"): version(package) for package in PACKAGES},
        "torch": str(torch.__version__),  # with the build; its own class would load torch in the parent process
        "platform": platform.platform(),
        "cpu": cpu_name(),
        "cores": os.cpu_count(),
        "threads": torch.get_num_threads(),
        "runs_at_once": int(os.environ.get(CONCURRENT_RUNS_VARIABLE, "1")),
        "threads_wait": os.environ.get("OMP_WAIT_POLICY", "").lower() or None,
        "denormals_flushed": _denormals_flushed(),
        "kernels": kernels().description_for(device.type, torch.get_num_threads()),
        "device": torch.cuda.get_device_name(device) if device.type == "cuda" else "cpu",
        "load_at_start": os.getloadavg()[0],
        "gemm_peak_flops": gemm_peak(device),
        "bfloat16_peak_flops": gemm_peak(device, torch.bfloat16) if bfloat16_is_faster(device) else None,
    }


def cpu_name() -> str:
    """The name of this machine's processor."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), platform.machine())


@contextmanager
def using_threads(count: int) -> Iterator[None]:
    """A context in which PyTorch uses `count` threads of the CPU."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@contextmanager
def flushing_denormals() -> Iterator[None]:
    """A context in which this thread replaces denormal numbers by 0, since processors are many times slower with them.

    Threads that it starts do the same, such as those of PyTorch's operations. So does the backward pass, which on a CPU
    runs in the calling thread. If the processor does not support it, nothing changes.
    """
    before = sys.float_info.min / 2 == 0.0
    torch.set_flush_denormal(True)
    try:
        yield
    finally:
        torch.set_flush_denormal(before)


def _denormals_flushed() -> bool:
    """Whether all threads of PyTorch's operations replace denormal numbers by 0."""
    bits = torch.full((NUMBERS_PER_THREAD * torch.get_num_threads(),), DENORMAL_BITS, dtype=torch.int32, device="cpu")
    return not bool((bits.view(torch.float32) * 0.5).view(torch.int32).any())  # as bits: a comparison may flush it too


def gemm_peak(device: torch.device, dtype: torch.dtype = torch.float32) -> float:
    """Best rate of a matrix product on this device with the current threads, in operations per second."""
    small = device.type == "cpu" and torch.get_num_threads() <= MAX_SMALL_GEMM_THREADS
    side = SMALL_GEMM_SIDE if small else GEMM_SIDE
    draw = torch.Generator(device).manual_seed(0)  # a draw of the default generator would change the run's result
    matrix = torch.rand(side, side, generator=draw, device=device).to(dtype)
    least_seconds = float("inf")
    for _ in range(GEMM_REPEATS):
        stopwatch = Stopwatch(device)
        matrix @ matrix
        least_seconds = min(least_seconds, stopwatch.seconds())
    return 2 * side**3 / least_seconds


def seconds_at_peak(environment: dict[str, Any], flops: int, coarse_flops: int) -> float:
    """The seconds that operations take at the machine's peak rates; `coarse_flops` are those in bfloat16.

    A user's field may have coarse values although bfloat16 is not faster: they then count at the rate of float32.
    """
    peak = environment["gemm_peak_flops"]
    return flops / peak + coarse_flops / (environment.get("bfloat16_peak_flops") or peak)


class Stopwatch:
    """Measures the seconds of a device's work from its creation: by events of a GPU, else by the wall clock.

    It waits until the device has finished all earlier work, and the measured work.
    """

    def __init__(self, device: torch.device) -> None:
        self.device = device if device.type == "cuda" else None
        if self.device is not None:
            torch.cuda.synchronize(self.device)
        self.start = self._mark()

    def seconds(self) -> float:
        """The seconds so far."""
        end = self._mark()
        if self.device is None:
            return end - self.start
        torch.cuda.synchronize(self.device)
        return self.start.elapsed_time(end) / 1000  # milliseconds

    def _mark(self) -> Any:
        """The time, or on a GPU an event after all work submitted so far."""
        if self.device is None:
            return time.perf_counter()
        event = torch.cuda.Event(enable_timing=True)
        event.record(torch.cuda.current_stream(self.device))
        return event


class MemoryPeak:
    """Measures the largest growth of memory since its creation.

    On a GPU it is memory allocated by PyTorch; on a CPU the resident set, whose high-water mark Linux can reset. Pages
    of files are left out, since a forked process loads those of its libraries when it first uses them. `growth` is
    None if neither is available.
    """

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self.earlier = 0  # growth before the last pause
        was_reset = self._reset()
        if device.type == "cuda":
            self.start: int | None = torch.cuda.memory_allocated(device)
        else:
            self.start = _resident_bytes().get("RssAnon") if was_reset else None

    def growth(self) -> int | None:
        """The largest growth so far, in bytes."""
        if self.start is None:
            return None
        if self.device.type == "cuda":
            peak: int = torch.cuda.max_memory_allocated(self.device)
        else:
            resident = _resident_bytes()
            peak = max(resident["VmHWM"] - resident["RssFile"] - resident["RssShmem"], resident["RssAnon"])
        return max(peak - self.start, self.earlier)

    def repeatable(self) -> int | None:
        """`growth` on a GPU; None on a CPU, where five runs of one command differed by 15 %."""
        return self.growth() if self.device.type == "cuda" else None

    @contextmanager
    def pause(self) -> Iterator[None]:
        """A context whose memory does not count."""
        before = self.growth()
        yield
        after = self.growth()
        if before is not None and after is not None and after > before:
            self.earlier = before
            self._reset()

    def _reset(self) -> bool:
        """Resets the high-water mark; False if that is not possible."""
        if self.device.type == "cuda":
            torch.cuda.reset_peak_memory_stats(self.device)
            return True
        with suppress(OSError, AttributeError):  # glibc only: returns freed memory, so that later allocations count
            ctypes.CDLL(None).malloc_trim(0)
        try:
            Path("/proc/self/clear_refs").write_text("5")
        except OSError:
            return False
        return True


def scheduled() -> tuple[int, int] | None:
    """Nanoseconds that this process's living threads ran, and that they waited for a processor; None if unknown."""
    ran = waited = 0
    try:
        for task in Path("/proc/self/task").iterdir():
            with suppress(FileNotFoundError, ProcessLookupError):  # a thread that has just ended
                numbers = (task / "schedstat").read_text().split()
                ran, waited = ran + int(numbers[0]), waited + int(numbers[1])
    except (OSError, ValueError, IndexError):
        return None
    return ran, waited


def waited_share(before: tuple[int, int] | None) -> float | None:
    """The fraction of time that this process's threads waited for a processor, of the time that they ran or waited.

    It is measured since `before`, the result of an earlier `scheduled`; None if unknown.
    """
    counts = scheduled()
    if before is None or counts is None:
        return None
    ran, waited = counts[0] - before[0], counts[1] - before[1]
    return waited / (ran + waited) if ran > 0 and waited >= 0 else None  # counts of ended threads are lost


def doubts(record: Record) -> list[str]:
    """Reasons not to trust the record's times, one line each."""
    lines = []
    share, load = record.environment.get("waited_share"), record.environment.get("load_at_start")
    if share is not None and share > MAX_WAIT_FRACTION:
        lines.append(f"loaded machine: threads waited {share:.0%} of their time for a processor; times are too long")
    elif share is None and load is not None and load > (os.cpu_count() or 1):
        lines.append(f"loaded machine: load {load:.1f} at the start; times may be too long")
    on_device = record.environment.get("device") != "cpu"
    if on_device and (runs := record.environment.get("runs_at_once", 1)) > 1:
        lines.append(f"shared device: {runs} runs at a time on it; times are too long")
    # A CPU's clock always waits, and its compiled code can be faster than PyTorch's matrix product.
    if on_device and record.gemm_fraction is not None and record.gemm_fraction > MAX_GEMM_FRACTION:
        lines.append(
            f"missing synchronisation: {record.gemm_fraction:.1f} times the machine's matrix product rate is more "
            f"than it can do; the clock did not wait for the device"
        )
    return lines


def _resident_bytes() -> dict[str, int]:
    """The bytes of this process's resident set: now, by kind, and the maximum since the last reset (`VmHWM`)."""
    lines = (line.split() for line in Path("/proc/self/status").read_text().splitlines())
    return {words[0].rstrip(":"): int(words[1]) * 1024 for words in lines if words[0].startswith(("Rss", "VmHWM"))}


def _git(*arguments: str) -> str:
    """The output of git for our repository; empty for an installed package, which may lie in another repository."""
    if not (ROOT / ".git").exists():
        return ""
    try:
        return subprocess.run(
            ["git", *arguments], cwd=ROOT, capture_output=True, text=True, timeout=10, check=True
        ).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return ""
