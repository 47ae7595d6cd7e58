"""The files of a run that the page links to: existing files inside the results folder."""

import os
from functools import cached_property
from pathlib import Path

from bench.records.record import PICTURE_FILES, is_outside
from bench.report.write.paper import key_of, link

LINKED_FILES = ("record.json", "config.yaml", "curve.jsonl", "log.txt", "mesh.ply", "field.safetensors")
PICTURE_SUFFIXES = (".png", ".gif", ".webp")
PICTURE_TEXTS = {
    "summary.png": "Depth, normals, errors of the silhouette and the shape from behind: before, after, truth",
    "strip.png": "The way from the start to the end, in frames",
    "film.gif": "The way from the start to the end, moving",
    "film.webp": "The way from the start to the end, moving",
    "curve.png": "Loss and error over the iterations",
    "input.png": "What was given",
    "outline.png": "The part of each pixel that the shape covers: result, truth and difference",
    "distances.png": "Mesh and truth, coloured by the distance to the other",
    "failure.png": "Both sides of the breakdown: distances, true distances, kinds of errors",
}


class Folder:
    """A run folder, with links relative to `index.html`."""

    def __init__(self, results_dir: Path, name: str) -> None:
        self.name, self.path = name, results_dir / "runs" / name
        self.results_dir = results_dir
        self.linked = self.path.is_symlink() or self.path.parent.is_symlink()

    @property
    def key(self) -> str:
        return key_of(self.name)

    @cached_property
    def _linked(self) -> dict[str, bool]:
        try:
            with os.scandir(self.path) as entries:
                return {entry.name: entry.is_symlink() for entry in entries if entry.is_file()}
        except OSError:
            return {}

    def has(self, name: str) -> bool:
        """Whether it has this file, and the file is inside the results folder."""
        if name not in self._linked:
            return False
        linked = self.linked or self._linked[name]  # only links are resolved, as that is slow
        return not linked or not is_outside(self.path / name, self.results_dir)

    def thumb(self) -> str:
        return next((name for name in PICTURE_FILES if self.has(name)), "")

    def pictures(self) -> list[str]:
        """The names of its pictures, the one that represents the run first."""
        pictures = sorted(name for name in self._linked if Path(name).suffix in PICTURE_SUFFIXES and self.has(name))
        ranks = {name: rank for rank, name in enumerate(PICTURE_FILES)}
        return sorted(pictures, key=lambda name: ranks.get(name, len(ranks)))

    def link(self, name: str) -> str:
        return link("runs", self.name, name)

    def links(self) -> dict[str, str]:
        folder = self.link("")
        return {name: folder + name for name in LINKED_FILES if self.has(name)}
