"""Finds the renderers that have a row in an experiment's table, from the files of the group `renderer`.

A file's key `_rows_` maps an experiment to the place of its row, and `_label_` names the row; a file without `_rows_`
has a row in every such experiment, after the others. An experiment sweeps over `renderer: ${rows:EXPERIMENT}`. The
files are those of conf/renderer and of the user's `--config-dir`.
"""

import importlib.util
from collections.abc import Iterator
from math import inf
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

GROUP = "renderer"
LABEL, ROWS = "_label_", "_rows_"


def register_rows() -> None:
    """Registers the resolver `${rows:EXPERIMENT}`, which gives an experiment's renderers as the values of a sweep."""
    OmegaConf.register_new_resolver("rows", _rows, replace=True)


def own_row(renderer: dict[str, Any], choice: str, runtime: DictConfig) -> dict[str, Any]:
    """A resolved `renderer` node without `_rows_`, and without a `_label_` inherited from a file that it builds on.

    Args:
        renderer: the node.
        choice: the name of its file.
        runtime: `hydra.runtime`, which has the folders of configurations.
    """
    path = _paths(runtime).get(choice)
    file = OmegaConf.create() if path is None else _content(path)
    inherits = "defaults" in file and LABEL not in file
    dropped = {ROWS, LABEL} if inherits else {ROWS}
    return {key: value for key, value in renderer.items() if key not in dropped}


def renderers_of(experiment: str, runtime: DictConfig) -> list[str]:
    """The renderers that have a row in an experiment, in the order of their places, then by name."""
    places = {}
    for name, path in _paths(runtime).items():
        file = _content(path)
        place = file.get(ROWS, {experiment: inf}).get(experiment)
        if place is not None and not OmegaConf.is_missing(file, "_target_"):  # custom: its class is on the command line
            places[name] = place
    return sorted(places, key=lambda name: (places[name], name))


def _rows(experiment: str, *, _root_: DictConfig) -> str:
    runtime = _root_.hydra.runtime
    if runtime.choices.get("method") is not None:  # a method sets its renderer
        return runtime.choices[GROUP]
    return ",".join(renderers_of(experiment, runtime))


def _paths(runtime: DictConfig) -> dict[str, Path]:
    """The files of the group by name; of two with the same name, the one that Hydra takes."""
    paths: dict[str, Path] = {}
    for folder in _folders(runtime):
        for path in sorted((folder / GROUP).glob("*.yaml")):
            paths.setdefault(path.stem, path)
    return paths


def _content(path: Path) -> DictConfig:
    """The content of a file, without the files that it builds on."""
    node = OmegaConf.load(path)
    if not isinstance(node, DictConfig):
        raise ValueError(f"{path} must hold keys and values: see conf/renderer/dist.yaml")
    return node


def _folders(runtime: DictConfig) -> Iterator[Path]:
    """The folders of configurations, in the order in which Hydra searches them."""
    for source in runtime.config_sources:
        if source.schema == "file":
            yield Path(source.path)
        elif source.schema == "pkg" and (found := importlib.util.find_spec(source.path.replace("/", "."))):
            yield from map(Path, found.submodule_search_locations or [])
