"""Depth files for tests: a sphere in front of a camera, and EXR files with any channels."""

import struct
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float

HEIGHT, WIDTH, FOCAL = 40, 48, 45.0
INTRINSICS = [FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2]
CENTRE, RADIUS = (0.1, -0.05, 3.0), 1.0  # of the sphere, in camera axes


def sphere_depths(*, along_ray: bool = False) -> Float[np.ndarray, "40 48"]:
    """Camera z of the sphere, or distances along rays, 0 beside it."""
    columns, rows = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    pixels = np.stack([(columns - WIDTH / 2) / FOCAL, (rows - HEIGHT / 2) / FOCAL, np.ones_like(rows)], axis=-1)
    lengths = np.linalg.norm(pixels, axis=-1)
    along = (pixels / lengths[..., None]) @ np.array(CENTRE)
    squared = along**2 - np.sum(np.square(CENTRE)) + RADIUS**2
    distances = np.where(squared > 0, along - np.sqrt(np.maximum(squared, 0)), 0.0)
    return distances if along_ray else distances / lengths


def write_exr(path: Path, channels: Mapping[str, np.ndarray]) -> None:
    """An EXR of 32-bit floats, not compressed, with any names of channels."""
    ordered = {name: np.asarray(channels[name], "<f4") for name in sorted(channels)}
    height, width = next(iter(ordered.values())).shape
    box = struct.pack("<4i", 0, 0, width - 1, height - 1)
    listed = b"".join(name.encode() + b"\0" + struct.pack("<4i", 2, 0, 1, 1) for name in ordered) + b"\0"
    attributes = (
        (b"channels", b"chlist", listed), (b"compression", b"compression", b"\0"), (b"dataWindow", b"box2i", box),
        (b"displayWindow", b"box2i", box), (b"lineOrder", b"lineOrder", b"\0"),
        (b"pixelAspectRatio", b"float", struct.pack("<f", 1)), (b"screenWindowCenter", b"v2f", bytes(8)),
        (b"screenWindowWidth", b"float", struct.pack("<f", 1)),
    )  # fmt: skip
    header = b"\x76\x2f\x31\x01" + struct.pack("<i", 2)
    header += b"".join(b"\0".join([*names, struct.pack("<i", len(value)) + value]) for *names, value in attributes)
    header += b"\0"
    rows = [b"".join(channel[i].tobytes() for channel in ordered.values()) for i in range(height)]
    chunks = [struct.pack("<2i", i, len(row)) + row for i, row in enumerate(rows)]
    starts = np.cumsum([len(header) + 8 * height, *map(len, chunks)])[:-1].astype("<u8")
    path.write_bytes(header + starts.tobytes() + b"".join(chunks))
