"""The choices of Hydra's groups: YAML files of conf and rows of its tables; and the sweep of an experiment over them.

A table is `conf/TABLE.yaml`, or a file of that name in the user's `--config-dir`, with `NAME: {key: value}` for each
row. A row has the same content as a file of its group. `base: NAME` is short for `defaults: [NAME, _self_]`, and keys
may be dotted. A method's row reads like a command line: `renderer: dist` chooses, `task.mask: false` sets.

A renderer (a file or a row) may have keys that are not arguments: `_rows_` maps an experiment to the rank of the
renderer's row in its table, and `_label_` names the row. A renderer without `_rows_` has a row in each such
experiment, after the others. An experiment sweeps over these renderers by `renderer: ${rows:EXPERIMENT}`.

A choice of `method/space` declares the settings of a method that may be tuned; see `bench.setup.spaces`.
"""

import pickle
import re
from collections.abc import Callable, Sequence
from copy import deepcopy
from dataclasses import dataclass
from difflib import get_close_matches
from functools import cache, partial
from importlib import import_module
from math import inf
from pathlib import Path
from typing import Any

import yaml
from omegaconf import MISSING, DictConfig, OmegaConf

CONF = Path(__file__).resolve().parent.parent / "conf"
METHOD, SPACE, TUNED = "method", "method/space", "method/tuned"
GROUP_OF_TABLE = {
    **{"methods": METHOD, "tuned": TUNED, "variants": "renderer", "stresses": "stress"},
    **{"losses": "silhouette", "supervision": "supervision", "shapes": "dataset"},
}
METHOD_ROW_GROUPS = ("task", "renderer", "dataset", "stress", "silhouette", "supervision", "prior", "scale", "effort")
LOOK_KEY = "_look_"  # key of a renderer or a method: its colour, marker and line in figures
TABLE_KEYS = ("base", "space", "chosen")  # keys of a row that are not part of its content
LABEL_KEY = "_label_"  # key of a renderer: its name in tables
ROWS_KEY = "_rows_"  # key of a renderer: the rank of its row in the table of each experiment
PACKAGE_LINE = re.compile(r"\s*#\s*@package\s+(\S+)")  # the first line of a file whose keys belong to another node
MAX_NAMES_WITH_VARIANTS = 20  # with more names, a message leaves out variants
MAX_NAMES_LISTED = 100
Node = dict[str, Any]


@dataclass(frozen=True)
class Choice:
    """A file or a row of a group: the path of its file, the content of a row, and the package of its keys in Hydra."""

    path: Path
    row: Node | None = None
    package: str | None = None

    @property
    def content(self) -> Node:
        """The keys of the file or row, without those of its bases; read-only."""
        return read_yaml(self.path) if self.row is None else self.row

    def load(self) -> tuple[DictConfig, str | None]:
        """The content as Hydra merges it, and the package of its keys; raises ValueError if it cannot be read."""
        if self.row is not None:
            look = (LOOK_KEY,) if self.package else ()  # it would become a key of the top level
            return OmegaConf.create({key: self.row[key] for key in self.row if key not in look}), self.package
        content, package = _load_file(self.path, _read_text(self.path))
        if self.package is not None and package != self.package:
            raise ValueError(
                f"{self.path} must begin with the line # @package {self.package}: its keys are those of the top level"
            )
        return pickle.loads(content), package


@cache
def _load_file(path: Path, text: str) -> tuple[bytes, str | None]:
    """The pickled content of a file, since it is copied in less time, and the package named in its first line."""
    package_line = PACKAGE_LINE.match(text)
    return pickle.dumps(_parse(path, text, OmegaConf.create)), package_line and package_line[1]


_choices: dict[str, dict[str, Choice]] = {}  # by group and name, of conf and the user's folders
_user_folders: list[Path] = []  # of this command


def register_rows(folders: Sequence[Path] = ()) -> None:
    """Lists the files and rows of conf and of the user's folders, in place of the earlier list; raises ValueError."""
    _user_folders[:] = folders
    _choices.clear()
    _choices.update({group: {**choices} for group, choices in _conf_choices().items()})
    user_groups = [group for folder in folders for group in choices_of(folder).items()]
    for group, name, choice in ((group, *item) for group, choices in user_groups for item in choices.items()):
        existing = _choices.setdefault(group, {}).get(name)
        if existing is None or group == TUNED:  # settings that the user tuned replace ours
            _choices[group][name] = choice
        elif existing.row is not None or choice.row is not None:
            kind = "file" if choice.row is None else "row"
            raise ValueError(f"{choice.path}: {name} is a {group} of {CONF} already: give the {kind} another name")


def group_choices(group: str) -> dict[str, Choice]:
    """The choices of a group by name, including those of the user's folders; empty for an unknown group."""
    return _choices.get(group, {})


def folders() -> list[Path]:
    return [*_user_folders]


def choices_of(folder: Path) -> dict[str, dict[str, Choice]]:
    """The files and rows of a folder, by group and name; raises ValueError if a table cannot be read."""
    groups: dict[str, dict[str, Choice]] = {group: {} for group in (*GROUP_OF_TABLE.values(), SPACE)}
    files = [*folder.glob("*/*.yaml"), *folder.glob("hydra/*/*.yaml"), *folder.glob(f"{METHOD}/*/*.yaml")]
    for path in sorted([*files, *(folder.glob("config.yaml") if folder == CONF else ())]):
        group = path.parent.relative_to(folder).as_posix().removeprefix(".")
        package = "_global_" if group.startswith((METHOD, "experiment")) else None
        groups.setdefault(group, {})[path.stem] = Choice(path, package=package)
    for table, table_group in GROUP_OF_TABLE.items():
        path = folder / f"{table}.yaml"
        for group, name, node in _rows_of(path, table_group, _read_text(path)) if path.is_file() else ():
            is_global = group.startswith(METHOD) or node == {group: None}
            groups[group][name] = Choice(path, node, "_global_" if is_global else None)
    return groups


_conf_choices = cache(lambda: choices_of(CONF))


def names(group: str) -> list[str]:
    """The names of all choices of a group in conf, files and rows."""
    return sorted(_conf_choices().get(group, ()))


def choice(group: str, name: str) -> Node:
    """The keys of a file or a row of conf, without those of its bases; a method may be `tuned/NAME` or `space/NAME`."""
    group, _, name = f"{group}/{name}".rpartition("/")
    return _conf_choices()[group][name].content


def read_yaml(path: Path) -> Node:
    """The content of a YAML file, a mapping; read-only. Raises ValueError if it cannot be read."""
    return _parse_mapping(path, _read_text(path))


def extensions() -> dict[str, str]:
    """The classes and functions of the layers above the core by their purpose: conf/extensions.yaml."""
    return read_yaml(CONF / "extensions.yaml")


def extension(purpose: str) -> Any:
    """A class or function of `extensions`, imported at its use."""
    module, _, name = extensions()[purpose].rpartition(".")
    return getattr(import_module(module), name)


def _read_text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} cannot be read: {error}") from error


@cache
def _parse_mapping(path: Path, text: str) -> Node:
    return _parse(path, text, lambda text: yaml.load(text, getattr(yaml, "CSafeLoader", yaml.SafeLoader)) or {})


def _parse(path: Path, text: str, parse: Callable[[str], Any]) -> Any:
    try:
        content = parse(text)
    except yaml.YAMLError as error:
        raise ValueError(f"{path} cannot be read: {' '.join(str(error).split())}") from error
    if not isinstance(content, dict | DictConfig):
        raise ValueError(f"{path} must hold keys and values: see conf/renderer/dist.yaml")
    return content


@cache
def _rows_of(path: Path, group: str, text: str) -> list[tuple[str, str, Node]]:
    """The group, the name and the content of each row of a table, and of each method's search space."""
    rows = []
    for name, row in _parse_mapping(path, text).items():
        if not isinstance(row, dict | None):
            raise ValueError(f"{path}: {name} must be a row, {{key: value}}, not {row!r}")
        rows.append((group, name, {group: None} if row is None else _row_node(group, row)))
        if row and "space" in row:
            bases = [f"/{METHOD}/{name}", f"/{METHOD}/_drawn", "_self_"]
            rows.append((SPACE, name, {"defaults": bases} | nest_keys(row["space"])))
    return rows


def _row_node(group: str, row: Node) -> Node:
    chosen = [key for key in METHOD_ROW_GROUPS if group.startswith(METHOD) and isinstance(row.get(key), str)]
    base = [row["base"]] if "base" in row else []
    defaults = [*base, *({f"override /{key}": row[key]} for key in chosen)]
    node = nest_keys({key: value for key, value in row.items() if key not in (*chosen, *TABLE_KEYS)})
    return ({"defaults": [*defaults, "_self_"]} if defaults else {}) | node


def nest_keys(row: Node) -> Node:
    """The row with nested nodes in place of dotted keys."""
    root: Node = {}
    for key, value in row.items():
        *outer_keys, inner = key.split(".")
        node = root
        for outer in outer_keys:
            node = node.setdefault(outer, {})
        node[inner] = deepcopy(value)
    return root


def nearest(word: str, options: list[str]) -> str:
    """A hint for the end of an error message: the names most similar to `word`, or all of them."""
    same_last_part = [name for name in options if name.rpartition(".")[-1] == word.rpartition(".")[-1]]
    same_folder = [name for name in options if "/" in word and name.startswith(word.rpartition("/")[0] + "/")]
    variants = [name for name in options if name.startswith(f"{word}_")]

    def similar(cutoff: float) -> list[str]:
        return [name for name in get_close_matches(word, same_folder or options, n=3, cutoff=cutoff) if name != word]

    first = [] if "." in word else same_last_part
    close = first or similar(0.85) or same_last_part or variants or similar(0.5)
    if close:
        return f": did you mean {' or '.join(close)}?"
    without_variants = [name for name in options if not any(name.startswith(f"{other}_") for other in options)]
    shown = without_variants if len(options) > MAX_NAMES_WITH_VARIANTS else options
    if not shown:
        return ""
    if len(shown) > MAX_NAMES_LISTED:
        return f": none of {len(shown)} is like it; python -m bench --cfg job shows them"
    return f": it has {', '.join(sorted(shown))}" + (", and variants of these" if len(shown) < len(options) else "")


def register_resolvers() -> None:
    """Registers the resolvers that values of the configuration use, such as `${rows:table1}`."""
    register = partial(OmegaConf.register_new_resolver, replace=True)
    register("rows", _rows)
    register("spaces", lambda *without: extension("spaces")(*without))
    register("drawn", _drawn)
    register("package_of", lambda path: path.split(".")[0])
    register("stem_of", lambda path: "no file" if path is None else Path(path).stem)  # a task refuses no file
    register("prior_kind", _prior_kind)
    register("class_of", lambda path: path.split(".")[-1])


def without_row_keys(renderer: dict[str, Any], choice: str) -> dict[str, Any]:
    """A resolved `renderer` node without `_rows_`, its look, and a `_label_` that its choice inherits from a base."""
    content = group_choices("renderer")[choice].content if choice in group_choices("renderer") else {}
    inherited = {LABEL_KEY} if "defaults" in content and LABEL_KEY not in content else set[str]()
    return {key: value for key, value in renderer.items() if key not in {ROWS_KEY, LOOK_KEY} | inherited}


def renderers_of(experiment: str) -> list[str]:
    """The renderers that have a row in an experiment, in the order of their ranks, then by name."""
    ranks = {}
    for name, choice in group_choices("renderer").items():
        rank = choice.content.get(ROWS_KEY, {experiment: inf}).get(experiment)
        if rank is not None and choice.content.get("_target_") != MISSING:  # without renderer=custom
            ranks[name] = rank
    return sorted(ranks, key=lambda name: (ranks[name], name))


def _rows(experiment: str, *, _root_: DictConfig) -> str:
    choices = _root_.hydra.runtime.choices
    if choices.get("method") is not None:  # a method sets its renderer
        return choices["renderer"]
    return ",".join(renderers_of(experiment))


def _drawn(dimension: int, low: float, high: float, *, _root_: DictConfig) -> float | int:
    return extension("drawn")(_root_.draw, dimension, low, high)


def _prior_kind(dataset: str | None, default: str) -> str:
    """The kind of prior, a key of `scale.priors`: `default`, or that of the dataset `prior.of`."""
    if dataset is None:
        return default
    return str(choice("dataset", dataset).get("_prior_", "own") if dataset in names("dataset") else "own")
