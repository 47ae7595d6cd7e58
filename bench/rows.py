"""The rows of experiments: which renderers and methods a sweep is over, and the settings that a method may draw.

A renderer, a file or a row of a table, may have keys that are no arguments: `_rows_` maps an experiment to the place of
the renderer's row in its table, and `_label_` names the row. A renderer without `_rows_` has a row in every such
experiment, after the others. An experiment sweeps over `renderer: ${rows:EXPERIMENT}`.

A choice of `method/space` declares what may be tuned of a method: `${drawn:DIMENSION,LEAST,MOST}` is the value, in
that dimension, of the Sobol point whose number is `draw`. An experiment sweeps over `+method: ${methods:space}`.
"""

import importlib.util
from collections.abc import Iterator
from functools import cache
from math import inf
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from bench.tables import LOOK, SPACE, TUNED, Node, read_rows, read_yaml

LABEL, ROWS = "_label_", "_rows_"  # of a renderer: its name in tables; the place of its row by experiment
MISSING = "???"
DRAWS, DIMENSIONS = 64, 8  # of the Sobol points that search spaces are drawn from
SCRAMBLE = 1610  # seed with which no two of the first five dimensions correlate by 0.1 over the first 16 points


def register_resolvers() -> None:
    """Makes known to OmegaConf what values of the configuration may ask for."""
    OmegaConf.register_new_resolver("rows", _rows, replace=True)
    OmegaConf.register_new_resolver("methods", _methods, replace=True)
    OmegaConf.register_new_resolver("drawn", _drawn, replace=True)
    OmegaConf.register_new_resolver("package_of", lambda path: path.split(".")[0], replace=True)
    OmegaConf.register_new_resolver("class_of", lambda path: path.split(".")[-1], replace=True)


def own_row(renderer: dict[str, Any], choice: str, runtime: DictConfig) -> dict[str, Any]:
    """A resolved `renderer` node without `_rows_`, its look, and a `_label_` inherited from what it builds on.

    Args:
        renderer: the node.
        choice: the name of its file or row.
        runtime: `hydra.runtime`, which has the folders of configurations.
    """
    own = _choices("renderer", runtime).get(choice, {})
    dropped = {ROWS, LOOK, LABEL} if "defaults" in own and LABEL not in own else {ROWS, LOOK}
    return {key: value for key, value in renderer.items() if key not in dropped}


def renderers_of(experiment: str, runtime: DictConfig) -> list[str]:
    """The renderers that have a row in an experiment, in the order of their places, then by name."""
    places = {}
    for name, own in _choices("renderer", runtime).items():
        place = own.get(ROWS, {experiment: inf}).get(experiment)
        if place is not None and own.get("_target_") != MISSING:  # custom: its class is on the command line
            places[name] = place
    return sorted(places, key=lambda name: (places[name], name))


def _rows(experiment: str, *, _root_: DictConfig) -> str:
    runtime = _root_.hydra.runtime
    if runtime.choices.get("method") is not None:  # a method sets its renderer
        return runtime.choices["renderer"]
    return ",".join(renderers_of(experiment, runtime))


def _methods(kind: str, *without: str, _root_: DictConfig) -> str:
    """The methods with a search space, to be swept over: of the kind `space` the spaces.

    Of the kind `tuned`, the settings that have been written for them, each behind its method.

    Args:
        without: names of methods that are left out.

    Raises:
        ValueError: for such a name that has no search space, and for another kind.
    """
    if kind not in ("space", "tuned"):
        raise ValueError(f"${{methods:KIND}} has the kinds space and tuned, not {kind!r}")
    spaces, tuned = (_choices(group, _root_.hydra.runtime) for group in (SPACE, TUNED))
    if unknown := {*without} - {*spaces}:
        raise ValueError(f"${{methods:{kind},...}} leaves out {', '.join(sorted(unknown))}: not in method/space")
    kept = [name for name in sorted(spaces) if name not in without]
    if kind == "space":
        return ",".join(f"space/{name}" for name in kept)
    return ",".join(f"{name},tuned/{name}" for name in kept if name in tuned)


def _drawn(dimension: int, least: float, most: float, *, _root_: DictConfig) -> float | int:
    """The value of draw `_root_.draw` in a range, even in its logarithm; a whole number for whole ends, else 3 digits.

    Raises:
        ValueError: without a draw, beyond the last one, or for a range or dimension that there is not.
    """
    draw = _root_.draw
    if draw is None or not 0 <= draw < DRAWS:
        raise ValueError(f"a method of method/space needs draw=0 to draw={DRAWS - 1}, found {draw}")
    if not (0 < least < most and 0 <= dimension < DIMENSIONS):
        raise ValueError(
            f"${{drawn:{dimension},{least},{most}}} must have a dimension from 0 to {DIMENSIONS - 1} and ends above 0"
        )
    value = least * (most / least) ** sobol_points()[draw][dimension]
    return round(value) if isinstance(least, int) and isinstance(most, int) else float(f"{value:.3g}")


@cache
def sobol_points() -> list[list[float]]:
    """The points [DRAWS, DIMENSIONS] of a scrambled Sobol sequence in the unit cube, the same for every method."""
    from scipy.stats import qmc  # only here: it takes a second

    return qmc.Sobol(DIMENSIONS, scramble=True, rng=SCRAMBLE).random(DRAWS).tolist()


def _choices(group: str, runtime: DictConfig) -> dict[str, Node]:
    """What each file or row of a group holds by itself; of two with the same name, the one that Hydra takes."""
    folders, found = [*_folders(runtime)], dict[str, Node]()
    for folder in folders:
        for path in sorted((folder / group).glob("*.yaml")):
            found.setdefault(path.stem, read_yaml(path))
    for folder in reversed(folders):
        found = read_rows(folder)[group] | found
    return found


def _folders(runtime: DictConfig) -> Iterator[Path]:
    """The folders of configurations, in the order in which Hydra searches them."""
    for source in runtime.config_sources:
        if source.schema == "file":
            yield Path(source.path)
        elif source.schema == "pkg" and (found := importlib.util.find_spec(source.path.replace("/", "."))):
            yield from map(Path, found.submodule_search_locations or [])
