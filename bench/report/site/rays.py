"""The most wrong pixels of a run, whose rays `python -m bench.ray RUN_FOLDER pixels=worst` drew into its folder."""

import json
import shlex
from pathlib import Path
from typing import Any

from bench.records.record import is_outside
from bench.report.data.records import Record
from bench.report.site.files import Folder
from bench.report.write.paper import link

RAYS_FOLDER, RAYS_FILE, MAP_FILE = "rays", "rays.json", "pixels.png"
COMMAND_TASK = "ablation"  # its pages show the command, since all its scenes have rays
MAX_RAYS = 12


def ray_file(number: int) -> str:
    return f"{number:02d}.png"


def rays(record: Record, folder: Folder) -> dict[str, Any] | None:
    """The rays of a run's folder, and the command that draws them; None if there are none, and for other tasks."""
    drawn = _drawn(folder)
    if not drawn and (record["task"] != COMMAND_TASK or not folder.has("record.json")):
        return None
    command = shlex.join(["python", "-m", "bench.ray", folder.path.as_posix(), "pixels=worst"])
    has_map = drawn and _has(folder, MAP_FILE)
    return {
        "command": command,
        "map": link("runs", folder.name, RAYS_FOLDER, MAP_FILE) if has_map else "",
        "rays": drawn,
    }


def _drawn(folder: Folder) -> list[dict[str, Any]]:
    """Each ray: its pixel, the address of its picture, its text, and its position in the image in percent."""
    if not _has(folder, RAYS_FILE):
        return []
    try:
        data = json.loads((folder.path / RAYS_FOLDER / RAYS_FILE).read_text(encoding="utf-8"))
        width, height = int(data["width"]), int(data["height"])
        pixels = [(int(ray["column"]), int(ray["row"]), str(ray["texts"][-1])) for ray in data["rays"][:MAX_RAYS]]
    except (OSError, ValueError, TypeError, KeyError, IndexError, OverflowError, RecursionError):
        return []  # a results folder may come from somebody else
    return [
        {
            "pixel": f"{column},{row}",
            "picture": link("runs", folder.name, RAYS_FOLDER, ray_file(number)),
            "text": text,
            "left": 100 * (column + 0.5) / width,
            "top": 100 * (row + 0.5) / height,
        }
        for number, (column, row, text) in enumerate(pixels, 1)
        if 0 <= column < width and 0 <= row < height and _has(folder, ray_file(number))
    ]


def _has(folder: Folder, name: str) -> bool:
    path: Path = folder.path / RAYS_FOLDER / name
    return path.is_file() and not is_outside(path, folder.results_dir)
