"""The choices of Hydra's groups in conf: files, and the rows of tables; and which of them an experiment sweeps over.

A table is `conf/TABLE.yaml`, or a file of that name in the user's `--config-dir`, with `NAME: {key: value}` for each
row. A row holds what a file of its group would. For short, `base: NAME` stands for `defaults: [NAME, _self_]`, and keys
may be dotted. A method's row reads as a command line: `renderer: dist` chooses, `task.mask: false` sets.

A renderer, a file or a row, may have keys that are no arguments: `_rows_` maps an experiment to the place of the
renderer's row in its table, and `_label_` names the row. A renderer without `_rows_` has a row in every such
experiment, after the others. An experiment sweeps over `renderer: ${rows:EXPERIMENT}`.

A choice of `method/space` declares what may be tuned of a method: `${drawn:DIMENSION,LEAST,MOST}` is the value, in
that dimension, of the Sobol point whose number is `draw`. An experiment sweeps over `+method: ${spaces:NAME,...}`, all
spaces but those.
"""

import importlib.util
from collections.abc import Iterator, Sequence
from copy import deepcopy
from difflib import get_close_matches
from functools import cache
from math import inf
from pathlib import Path
from typing import Any

import yaml
from omegaconf import MISSING, DictConfig, OmegaConf

CONF = Path(__file__).resolve().parent.parent / "conf"
METHOD, SPACE, TUNED = "method", "method/space", "method/tuned"
GROUPS = {  # by the table's name
    **{"methods": METHOD, "tuned": TUNED, "variants": "renderer", "stresses": "stress"},
    **{"losses": "silhouette", "supervision": "supervision", "shapes": "dataset"},
}
CHOICES = ("task", "renderer", "dataset", "stress", "silhouette", "supervision", "prior", "scale")  # of a method's row
LOOK = "_look_"  # of a renderer or a method: its colour, marker and line in figures
DROPPED = ("base", "space", "chosen")  # keys of a row that are no part of what it holds
LABEL, ROWS = "_label_", "_rows_"  # of a renderer: its name in tables; the place of its row by experiment
DRAWS, DIMENSIONS = 64, 8  # of the Sobol points that search spaces are drawn from
SCRAMBLE = 1610  # seed with which no two of the first five dimensions correlate by 0.1 over the first 16 points
MANY = 20  # names, beyond which a message leaves variants out
ALL = 100  # and beyond which it names none
Node = dict[str, Any]


def register_rows(folders: Sequence[Path] = ()) -> None:
    """Makes the rows of our tables choices of their groups, and those of the same tables in other folders.

    Rows of folders of an earlier call are choices no more.

    Raises:
        ValueError: for a table that cannot be read, and for a row or file of another folder with the name of ours.
    """
    while _REPLACED:
        group, key, before = _REPLACED.pop()
        _stored(group).pop(key)
        _stored(group).update({} if before is None else {key: before})
    for folder in (CONF, *folders):
        for table, group in GROUPS.items():
            if not (path := folder / f"{table}.yaml").is_file():
                continue
            if folder == CONF:
                _store_ours(path, group, _text(path))
                continue
            for of, name, _ in _rows_of(path, group, _text(path)):
                if of != TUNED and name in names(of):  # settings that were tuned again are meant to take the place
                    raise ValueError(f"{path}: {name} is a {group} of {CONF} already: give the row another name")
                _REPLACED.append((of, f"{name}.yaml", _stored(of).get(f"{name}.yaml")))
            _store(path, group, _text(path))
        for group in GROUPS.values() if folder != CONF else ():
            for file in sorted((folder / group).glob("*.yaml")):
                if group != TUNED and file.stem in read_rows(CONF)[group]:
                    raise ValueError(f"{file}: {file.stem} is a row of {CONF} already: give the file another name")


_REPLACED: list[tuple[str, str, Any]] = []  # rows of other folders: group, key, and what stood there before


def _stored(group: str) -> dict[str, Any]:
    """What Hydra keeps of a group."""
    from hydra.core.config_store import ConfigStore  # only here: runs do without Hydra

    place = ConfigStore.instance().repo
    for part in group.split("/"):
        place = place.setdefault(part, {})
    return place


def _store(path: Path, group: str, text: str) -> None:
    from hydra.core.config_store import ConfigNode

    for of, name, node in _rows_of(path, group, text):
        whole = of.startswith(METHOD) or node == {group: None}
        kept = OmegaConf.create({key: value for key, value in node.items() if key != LOOK or not whole})
        _stored(of)[f"{name}.yaml"] = ConfigNode(f"{name}.yaml", kept, of, "_global_" if whole else None, None)


_store_ours = cache(_store)


def read_rows(folder: Path) -> dict[str, dict[str, Node]]:
    """The rows of a folder's tables by group and name, each as a file of its group would hold it; read-only.

    Raises:
        ValueError: for a table that cannot be read.
    """
    found: dict[str, dict[str, Node]] = {group: {} for group in (*GROUPS.values(), SPACE)}
    for table, group in GROUPS.items():
        path = folder / f"{table}.yaml"
        for of, name, node in _rows_of(path, group, _text(path)) if path.is_file() else ():
            found[of][name] = node
    return found


def names(group: str) -> list[str]:
    """The names of all choices of a group in conf, files and rows."""
    return sorted({path.stem for path in (CONF / group).glob("*.yaml")} | set(read_rows(CONF).get(group, ())))


def choice(group: str, name: str) -> Node:
    """What a file or a row of conf holds, without what it builds on; a method may be `tuned/NAME` or `space/NAME`.

    Raises:
        KeyError: where there is no such choice.
    """
    group, _, name = f"{group}/{name}".rpartition("/")
    path = CONF / group / f"{name}.yaml"
    return read_yaml(path) if path.is_file() else read_rows(CONF).get(group, {})[name]


def read_yaml(path: Path) -> Node:
    """What a YAML holds by name; read-only.

    Raises:
        ValueError: where it cannot be read.
    """
    return _mapping(path, _text(path))


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} cannot be read: {error}") from error


@cache
def _mapping(path: Path, text: str) -> Node:
    try:
        found = yaml.load(text, getattr(yaml, "CSafeLoader", yaml.SafeLoader)) or {}
    except yaml.YAMLError as error:
        raise ValueError(f"{path} cannot be read: {' '.join(str(error).split())}") from error
    if not isinstance(found, dict):
        raise ValueError(f"{path} must hold keys and values: see conf/renderer/dist.yaml")
    return found


@cache
def _rows_of(path: Path, group: str, text: str) -> list[tuple[str, str, Node]]:
    """The group, the name and the content of each row of a table, and of the space of each method that has one."""
    found = []
    for name, row in _mapping(path, text).items():
        if not isinstance(row, dict | None):
            raise ValueError(f"{path}: {name} must be a row, {{key: value}}, not {row!r}")
        found.append((group, name, {group: None} if row is None else _node(group, row)))
        if row and "space" in row:
            bases = [f"/{METHOD}/{name}", f"/{METHOD}/_drawn", "_self_"]
            found.append((SPACE, name, {"defaults": bases} | nested(row["space"])))
    return found


def look_of(name: str) -> Node:
    """The keys `colour`, `marker` and `line` of a method or renderer, over those of what it builds on; {} for others.

    A method has the colour of its renderer. Its tuned settings, and its space, look like the method.
    """
    name = name.rpartition("/")[2]
    group = METHOD if name in names(METHOD) else "renderer"
    alike = [name, *(other for other in names("renderer") if other.replace("_", "") == name)]  # a class, in lower case
    return next((_look(group, each) for each in alike if each in names(group)), {})


def _look(group: str, name: str) -> Node:
    own, found = choice(group, name), dict[str, Any]()
    for base in own.get("defaults", ()):
        if isinstance(base, str) and base != "_self_":
            found |= _look(group, base.removeprefix(f"/{group}/"))
        elif renderer := isinstance(base, dict) and base.get("override /renderer"):
            found |= _look("renderer", renderer)
    return found | own.get(LOOK, {})


def _node(group: str, row: Node) -> Node:
    chosen = [key for key in CHOICES if group.startswith(METHOD) and isinstance(row.get(key), str)]
    base = [row["base"]] if "base" in row else []
    defaults = [*base, *({f"override /{key}": row[key]} for key in chosen)]
    node = nested({key: value for key, value in row.items() if key not in (*chosen, *DROPPED)})
    return ({"defaults": [*defaults, "_self_"]} if defaults else {}) | node


def nested(row: Node) -> Node:
    """Dotted keys as nodes in nodes."""
    found: Node = {}
    for key, value in row.items():
        *above, last = key.split(".")
        node = found
        for part in above:
            node = node.setdefault(part, {})
        node[last] = deepcopy(value)
    return found


def nearest(word: str, known: list[str]) -> str:
    """A hint at the end of an error message: the nearest known names, or all of them."""
    last = [name for name in known if "." not in word and name.rsplit(".", 1)[-1] == word]
    folder = [name for name in known if "/" in word and name.startswith(word.rpartition("/")[0] + "/")]
    variants = [name for name in known if name.startswith(f"{word}_")]

    def alike(cutoff: float) -> list[str]:
        return [name for name in get_close_matches(word, folder or known, n=3, cutoff=cutoff) if name != word]

    close = last or alike(0.85) or variants or alike(0.5)
    if close:
        return f": did you mean {' or '.join(close)}?"
    roots = [name for name in known if not any(name.startswith(f"{other}_") for other in known)]
    shown = roots if len(known) > MANY else known
    if not shown:
        return ""
    if len(shown) > ALL:
        return f": none of {len(shown)} is like it; python -m bench --cfg job shows them"
    return f": it has {', '.join(sorted(shown))}" + (", and variants of these" if len(shown) < len(known) else "")


def register_resolvers() -> None:
    """Makes known to OmegaConf what values of the configuration may ask for."""
    OmegaConf.register_new_resolver("rows", _rows, replace=True)
    OmegaConf.register_new_resolver("spaces", _spaces, replace=True)
    OmegaConf.register_new_resolver("drawn", _drawn, replace=True)
    OmegaConf.register_new_resolver("package_of", lambda path: path.split(".")[0], replace=True)
    OmegaConf.register_new_resolver("stem_of", _stem, replace=True)
    OmegaConf.register_new_resolver("prior_kind", _prior_kind, replace=True)
    OmegaConf.register_new_resolver("class_of", lambda path: path.split(".")[-1], replace=True)


def own_row(renderer: dict[str, Any], choice: str, runtime: DictConfig) -> dict[str, Any]:
    """A resolved `renderer` node without `_rows_`, its look, and a `_label_` inherited from what it builds on.

    Args:
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


def _spaces(*without: str, _root_: DictConfig) -> str:
    """The spaces of the methods with a search space, to be swept over.

    Args:
        without: names of methods that are left out.

    Raises:
        ValueError: for such a name that has no search space.
    """
    spaces = _choices(SPACE, _root_.hydra.runtime)
    if unknown := {*without} - {*spaces}:
        raise ValueError(f"${{spaces:...}} leaves out {', '.join(sorted(unknown))}: not in method/space")
    return ",".join(f"space/{name}" for name in sorted(spaces) if name not in without)


def _prior_kind(of: str | None, own: str) -> str:
    """A key of `scale.priors`: the kind of prior of the run's dataset, or of the one that `prior.of` names."""
    return own if of is None else str(read_rows(CONF)["dataset"].get(of, {}).get("_prior_", "own"))


def _stem(path: str | None) -> str:
    """The name of a file, without suffix, by which a row is told from the same row of another file."""
    if path is None:
        return "no file"  # which the task refuses
    return Path(path).stem


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
