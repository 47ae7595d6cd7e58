"""What makes two runs the same: their configuration, the code, and the files that they read."""

import hashlib
import importlib.util
from dataclasses import dataclass
from functools import cached_property, lru_cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from bench.records import digest
from bench.report.records import NEUTRAL_KEYS

ROOT = Path(__file__).resolve().parent.parent
OURS = ("renderers", "datasets", "bench")
PASSIVE = ("bench/report", "bench/trackers", "bench/merge.py", "bench/plan.py", "bench/progress.py", "bench/summary.py")
NO_STRESS = "none"
LIBRARIES = ("torch", "numpy", "scipy", "open3d", "pymeshlab", "trimesh", "scikit-image")


@dataclass(frozen=True)
class Identity:
    """Which run a configuration asks for.

    Args:
        choices: task, renderer and dataset, by the names of the chosen YAMLs; a stress stands in the dataset's place.
        config: the resolved configuration, as plain data.
    """

    choices: dict[str, str]
    config: dict[str, Any]

    @cached_property
    def config_hash(self) -> str:
        """Of the configuration, whatever the order of its keys, without those that change no result."""
        return digest({key: value for key, value in self.config.items() if key not in NEUTRAL_KEYS})

    @property
    def name(self) -> str:
        """Of the run's folder."""
        return "-".join([*self.choices.values(), self.config_hash])

    @cached_property
    def code(self) -> str:
        """Of the code that runs, ours and the user's, the libraries beneath, and the files that keys `path` name."""
        named = [str(package) for package in self.config.get("packages") or []]
        named += [target.split(".")[0] for target in _values(self.config, "_target_")]
        users = tuple(sorted(set(named) - set(OURS)))
        files = [_content(Path(path)) for path in _values(self.config, "path")]
        return digest([_our_code(), *(_package(name) for name in users), *files])


def identify(config: DictConfig, choices: DictConfig) -> Identity:
    """The identity of a configuration; `choices` are those of `hydra.runtime`.

    Raises:
        ValueError: where the command line takes a part out that every run has.
    """
    for part in ("task", "renderer", "dataset"):
        if part not in choices:
            raise ValueError(f"every run has a {part}: leave ~{part} out")
    # As far as it can be resolved: a value that is missing is an error of the run, not of its record.
    values: Any = OmegaConf.to_container(config, resolve=True, throw_on_missing=False)
    seen = choices["dataset"] if choices.get("stress", NO_STRESS) == NO_STRESS else choices["stress"]
    named = {"task": choices["task"], "renderer": choices["renderer"], "dataset": seen}
    return Identity({name: str(choice) for name, choice in named.items()}, values)


@lru_cache(maxsize=1)
def _our_code() -> str:
    files = [path for package in OURS for path in sorted((ROOT / package).rglob("*.py"))]
    acting = [path for path in files if not path.relative_to(ROOT).as_posix().startswith(PASSIVE)]
    shipped = sorted((ROOT / "datasets" / "priors").glob("*.safetensors"))
    return digest([*map(_content, [*acting, *shipped]), *(version(library) for library in LIBRARIES)])


@lru_cache
def _package(name: str) -> str:
    """Of a user's package or module; empty where there is none, which is an error of the run."""
    try:
        spec = importlib.util.find_spec(name)
    except (ImportError, ValueError):
        return ""
    if spec is None:
        return ""
    if spec.submodule_search_locations is not None:
        files = [path for folder in spec.submodule_search_locations for path in sorted(Path(folder).rglob("*.py"))]
    else:  # a module, with those beside it that it may import
        files = sorted(Path(spec.origin or "").parent.glob("*.py"))
    return digest([_content(path) for path in files])


def _content(path: Path) -> str:
    """Of a file's name and bytes, or of all files of a folder; empty where there is none."""
    try:
        if path.is_dir():
            return digest([_content(child) for child in sorted(path.iterdir()) if child.is_file()])
        return digest([path.name, hashlib.sha256(path.read_bytes()).hexdigest()])
    except OSError:
        return ""


def _values(node: Any, name: str) -> list[str]:
    """All strings that stand under a key of that name, at any depth."""
    if not isinstance(node, dict):
        return []
    own = [node[name]] if isinstance(node.get(name), str) else []
    return own + [value for child in node.values() for value in _values(child, name)]
