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

import re
from collections.abc import Sequence
from copy import deepcopy
from dataclasses import dataclass
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
HEADER = re.compile(r"\s*#\s*@package\s+(\S+)")  # the first line of a file whose keys stand elsewhere
MANY = 20  # names, beyond which a message leaves variants out
ALL = 100  # and beyond which it names none
Node = dict[str, Any]


@dataclass(frozen=True)
class Choice:
    """A file or a row of a group: where it stands, what a row holds, and the package in which Hydra sets its keys."""

    path: Path
    row: Node | None = None
    package: str | None = None

    @property
    def content(self) -> Node:
        """What it holds by itself; read-only."""
        return read_yaml(self.path) if self.row is None else self.row

    def load(self) -> tuple[DictConfig, str | None]:
        """Its content as Hydra merges it, and the package of its keys.

        Raises:
            ValueError: for a file that cannot be read, or of an experiment or a method without its first line.
        """
        if self.row is not None:
            look = (LOOK,) if self.package else ()  # which would be a key of the top level
            return OmegaConf.create({key: self.row[key] for key in self.row if key not in look}), self.package
        node, package = _loaded(self.path, _text(self.path))
        if self.package is not None and package != self.package:
            raise ValueError(
                f"{self.path} must begin with the line # @package {self.package}: its keys are those of the top level"
            )
        return deepcopy(node), package


@cache
def _loaded(path: Path, text: str) -> tuple[DictConfig, str | None]:
    """The content of a file, and the package that its first lines name."""
    header = HEADER.match(text)
    try:
        node = OmegaConf.create(text)
    except yaml.YAMLError as error:
        raise ValueError(f"{path} cannot be read: {' '.join(str(error).split())}") from error
    if not isinstance(node, DictConfig):
        raise ValueError(f"{path} must hold keys and values: see conf/renderer/dist.yaml")
    return node, header and header[1]


_LISTED: dict[str, dict[str, Choice]] = {}  # by group and name: of conf, and of the folders of this command
_FOLDERS: list[Path] = []  # of the user's, in this command


def register_rows(folders: Sequence[Path] = ()) -> None:
    """Lists the files and rows of conf, and of the user's folders; what an earlier call listed is listed no more.

    Raises:
        ValueError: for a table that cannot be read, and for a row or file of another folder with the name of ours.
    """
    _FOLDERS[:] = folders
    _LISTED.clear()
    _LISTED.update({group: {**choices} for group, choices in _ours().items()})
    for group, name, choice in (
        (group, name, choice)
        for folder in folders
        for group, choices in choices_of(folder).items()
        for name, choice in choices.items()
    ):
        ours = _LISTED.setdefault(group, {}).get(name)
        if ours is None or group == TUNED:  # settings that were tuned again are meant to take the place of ours
            _LISTED[group][name] = choice
        elif ours.row is not None or choice.row is not None:
            what = "file" if choice.row is None else "row"
            raise ValueError(f"{choice.path}: {name} is a {group} of {CONF} already: give the {what} another name")


def listed(group: str) -> dict[str, Choice]:
    """The choices of a group by name, those of the user's folders among them; empty where it is no group."""
    return _LISTED.get(group, {})


def folders() -> list[Path]:
    """The user's folders of configurations."""
    return [*_FOLDERS]


def choices_of(folder: Path) -> dict[str, dict[str, Choice]]:
    """The files and rows of a folder, by group and name.

    Raises:
        ValueError: for a table that cannot be read.
    """
    groups: dict[str, dict[str, Choice]] = {group: {} for group in (*GROUPS.values(), SPACE)}
    files = [*folder.glob("*/*.yaml"), *folder.glob("hydra/*/*.yaml"), *folder.glob(f"{METHOD}/*/*.yaml")]
    for path in sorted([*files, *(folder.glob("config.yaml") if folder == CONF else ())]):
        group = path.parent.relative_to(folder).as_posix().removeprefix(".")
        package = "_global_" if group.startswith((METHOD, "experiment")) else None
        groups.setdefault(group, {})[path.stem] = Choice(path, package=package)
    for table, table_group in GROUPS.items():
        path = folder / f"{table}.yaml"
        for group, name, node in _rows_of(path, table_group, _text(path)) if path.is_file() else ():
            whole = group.startswith(METHOD) or node == {group: None}
            groups[group][name] = Choice(path, node, "_global_" if whole else None)
    return groups


_ours = cache(lambda: choices_of(CONF))


def names(group: str) -> list[str]:
    """The names of all choices of a group in conf, files and rows."""
    return sorted(_ours().get(group, ()))


def choice(group: str, name: str) -> Node:
    """What a file or a row of conf holds, without what it builds on; a method may be `tuned/NAME` or `space/NAME`.

    Raises:
        KeyError: where there is no such choice.
    """
    group, _, name = f"{group}/{name}".rpartition("/")
    return _ours()[group][name].content


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


def own_row(renderer: dict[str, Any], choice: str) -> dict[str, Any]:
    """A resolved `renderer` node without `_rows_`, its look, and a `_label_` inherited from what it builds on.

    Args:
        choice: the name of its file or row.
    """
    content = listed("renderer")[choice].content if choice in listed("renderer") else {}
    dropped = {ROWS, LOOK, LABEL} if "defaults" in content and LABEL not in content else {ROWS, LOOK}
    return {key: value for key, value in renderer.items() if key not in dropped}


def renderers_of(experiment: str) -> list[str]:
    """The renderers that have a row in an experiment, in the order of their places, then by name."""
    ranks = {}
    for name, choice in listed("renderer").items():
        rank = choice.content.get(ROWS, {experiment: inf}).get(experiment)
        if rank is not None and choice.content.get("_target_") != MISSING:  # custom: its class is on the command line
            ranks[name] = rank
    return sorted(ranks, key=lambda name: (ranks[name], name))


def _rows(experiment: str, *, _root_: DictConfig) -> str:
    choices = _root_.hydra.runtime.choices
    if choices.get("method") is not None:  # a method sets its renderer
        return choices["renderer"]
    return ",".join(renderers_of(experiment))


def _spaces(*without: str) -> str:
    """The spaces of the methods with a search space, to be swept over.

    Args:
        without: names of methods that are left out.

    Raises:
        ValueError: for such a name that has no search space.
    """
    spaces = listed(SPACE)
    if unknown := {*without} - {*spaces}:
        raise ValueError(f"${{spaces:...}} leaves out {', '.join(sorted(unknown))}: not in method/space")
    return ",".join(f"space/{name}" for name in sorted(spaces) if name not in without)


def _prior_kind(of: str | None, own: str) -> str:
    """A key of `scale.priors`: the kind of prior of the run's dataset, or of the one that `prior.of` names."""
    return own if of is None else str(choice("dataset", of).get("_prior_", "own") if of in names("dataset") else "own")


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
