"""The choices of Hydra's groups in conf: files, and the rows of tables, which are choices like files.

A table is `conf/TABLE.yaml`, or a file of that name in the user's `--config-dir`, with `NAME: {key: value}` for each
row. A row holds what a file of its group would. For short, `base: NAME` stands for `defaults: [NAME, _self_]`, and keys
may be dotted. A method's row reads as a command line: `renderer: dist` chooses, `task.mask: false` sets.
"""

from collections.abc import Sequence
from copy import deepcopy
from functools import cache
from pathlib import Path
from typing import Any

import yaml
from hydra.core.config_store import ConfigStore

CONF = Path(__file__).resolve().parent.parent / "conf"
METHOD, SPACE, TUNED = "method", "method/space", "method/tuned"
GROUPS = {  # by the table's name
    **{"methods": METHOD, "tuned": TUNED, "variants": "renderer", "stresses": "stress"},
    **{"losses": "silhouette", "supervision": "supervision", "shapes": "dataset"},
}
CHOICES = ("task", "renderer", "dataset", "stress", "silhouette", "supervision", "prior", "scale")  # of a method's row
LOOK = "_look_"  # of a renderer or a method: its colour, marker and line in figures
DROPPED = ("base", "space", "chosen")  # keys of a row that are no part of what it holds
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
            for of, name, _ in _rows(path, group, _text(path)):
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
    place = ConfigStore.instance().repo
    for part in group.split("/"):
        place = place.setdefault(part, {})
    return place


def _store(path: Path, group: str, text: str) -> None:
    for of, name, node in _rows(path, group, text):
        whole = of.startswith(METHOD) or node == {group: None}
        kept = {key: value for key, value in node.items() if key != LOOK or not whole}
        ConfigStore.instance().store(group=of, name=name, node=kept, package="_global_" if whole else None)


_store_ours = cache(_store)


def read_rows(folder: Path) -> dict[str, dict[str, Node]]:
    """The rows of a folder's tables by group and name, each as a file of its group would hold it; read-only.

    Raises:
        ValueError: for a table that cannot be read.
    """
    found: dict[str, dict[str, Node]] = {group: {} for group in (*GROUPS.values(), SPACE)}
    for table, group in GROUPS.items():
        path = folder / f"{table}.yaml"
        for of, name, node in _rows(path, group, _text(path)) if path.is_file() else ():
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
def _rows(path: Path, group: str, text: str) -> list[tuple[str, str, Node]]:
    """The group, the name and the content of each row of a table, and of the space of each method that has one."""
    found = []
    for name, row in _mapping(path, text).items():
        if not isinstance(row, dict | None):
            raise ValueError(f"{path}: {name} must be a row, {{key: value}}, not {row!r}")
        found.append((group, name, {group: None} if row is None else _node(group, row)))
        if row and "space" in row:
            bases = [f"/{METHOD}/{name}", f"/{METHOD}/_drawn", "_self_"]
            found.append((SPACE, name, {"defaults": bases} | _nested(row["space"])))
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
    node = _nested({key: value for key, value in row.items() if key not in (*chosen, *DROPPED)})
    return ({"defaults": [*defaults, "_self_"]} if defaults else {}) | node


def _nested(row: Node) -> Node:
    """Dotted keys as nodes in nodes."""
    found: Node = {}
    for key, value in row.items():
        *above, last = key.split(".")
        node = found
        for part in above:
            node = node.setdefault(part, {})
        node[last] = deepcopy(value)
    return found
