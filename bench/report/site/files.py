"""The files of a run that the page links to: those that are there, and lie within the results folder."""

import os
from functools import cached_property
from pathlib import Path

from bench.records.record import PICTURE_FILES, is_outside
from bench.report.write.paper import key_of, link

LINKED_FILES = ("record.json", "config.yaml", "curve.jsonl", "log.txt", "mesh.ply", "field.safetensors")
PICTURE_SUFFIXES = (".png", ".gif", ".webp")  # of pictures
PICTURE_TEXTS = {  # what the pictures of a run show
    "summary.png": "Depth, normals, errors of the silhouette and the shape from behind: before, after, truth",
    "strip.png": "The way from the start to the end, in frames",
    "film.gif": "The way from the start to the end, moving",
    "film.webp": "The way from the start to the end, moving",
    "curve.png": "Loss and error over the iterations",
    "input.png": "What was given",
    "failure.png": "The first failure: kinds of pixels, beside the true distance",
}


class Folder:
    """A run's folder as the page sees it, with links relative to `index.html`."""

    def __init__(self, results_dir: Path, name: str) -> None:
        self.name, self.path = name, results_dir / "runs" / name
        self.results_dir = results_dir
        self.linked = self.path.is_symlink() or self.path.parent.is_symlink()

    @property
    def key(self) -> str:
        """The name of the run's files among those of the page."""
        return key_of(self.name)

    @cached_property
    def _linked(self) -> dict[str, bool]:
        """Its files, and whether each is a link."""
        try:
            with os.scandir(self.path) as entries:
                return {entry.name: entry.is_symlink() for entry in entries if entry.is_file()}
        except OSError:
            return {}

    def has(self, name: str) -> bool:
        """Whether it has this file, and not a link to something outside of the results folder."""
        if name not in self._linked:
            return False
        linked = self.linked or self._linked[name]  # others are not resolved, which takes time
        return not linked or not is_outside(self.path / name, self.results_dir)

    def thumb(self) -> str:
        """The picture that stands for the run; empty without one."""
        return next((name for name in PICTURE_FILES if self.has(name)), "")

    def pictures(self) -> list[str]:
        """The names of its pictures, the one that stands for the run first."""
        pictures = sorted(name for name in self._linked if Path(name).suffix in PICTURE_SUFFIXES and self.has(name))
        ranks = {name: rank for rank, name in enumerate(PICTURE_FILES)}
        return sorted(pictures, key=lambda name: ranks.get(name, len(ranks)))

    def link(self, name: str) -> str:
        """The address of one of its files."""
        return link("runs", self.name, name)

    def links(self) -> dict[str, str]:
        """The addresses of the files that every run may have, by their names."""
        folder = self.link("")
        return {name: folder + name for name in LINKED_FILES if self.has(name)}
