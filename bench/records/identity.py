"""The identity of a run: hashes of its configuration, of the code, and of the files that it reads."""

import hashlib
import importlib.util
from dataclasses import dataclass
from functools import cached_property, lru_cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from bench.records.files import digest
from bench.records.record import NEUTRAL_KEYS
from bench.records.rows import own_row

ROOT = Path(__file__).resolve().parents[2]
OURS = ("renderers", "datasets", "bench")
PASSIVE = (
    *("bench/report", "bench/trackers", "bench/merge", "bench/progress.py"),
    *("bench/run/sweep.py", "bench/run/summary.py"),
    *("bench/records/format.py", "bench/records/read.py", "bench/records/plans.py"),
    *("bench/pictures/style.py", "bench/pictures/size_chart.py"),
)
NO_STRESS = "none"
LIBRARIES = ("torch", "numpy", "scipy", "open3d", "pymeshlab", "trimesh", "scikit-image")


@dataclass(frozen=True)
class Identity:
    """The run that a configuration describes.

    Args:
        choices: names of the chosen YAMLs of task, renderer, dataset and method; a stress takes the dataset's place,
            and the method is empty where none is chosen.
        config: the resolved configuration, as plain data.
    """

    choices: dict[str, str]
    config: dict[str, Any]

    @cached_property
    def config_hash(self) -> str:
        """Hash of the configuration without the keys that change no result; the order of keys does not matter."""
        return digest({key: value for key, value in self.config.items() if key not in NEUTRAL_KEYS})

    @property
    def name(self) -> str:
        """Name of the run's folder."""
        return "-".join([*filter(None, self.choices.values()), self.config_hash])

    @cached_property
    def code(self) -> str:
        """Hash of our code and the user's, of the versions of libraries, and of the files that keys `path` name."""
        named = [str(package) for package in self.config.get("packages") or []]
        named += [target.split(".")[0] for target in _values(self.config, "_target_")]
        users = tuple(sorted(set(named) - set(OURS)))
        files = [_content(Path(path)) for path in _values(self.config, "path")]
        return digest([_our_code(), *(_package(name) for name in users), *files])


def identify(config: DictConfig, runtime: DictConfig) -> Identity:
    """The identity of a configuration; `runtime` is `hydra.runtime`, which has the names of the chosen YAMLs.

    Raises:
        ValueError: where the command line removes a part that every run has.
    """
    choices = runtime.choices
    for part in ("task", "renderer", "dataset"):
        if part not in choices:
            raise ValueError(f"every run needs a {part}: remove ~{part} from the command line")
    # Missing values are kept: they are an error of the run, which its record reports.
    values: Any = OmegaConf.to_container(config, resolve=True, throw_on_missing=False)
    if isinstance(values.get("renderer"), dict):
        values["renderer"] = own_row(values["renderer"], str(choices["renderer"]), runtime)
    seen = choices["dataset"] if choices.get("stress", NO_STRESS) == NO_STRESS else choices["stress"]
    named = {"task": choices["task"], "renderer": choices["renderer"], "dataset": seen}
    named["method"] = choices.get("method") or ""
    return Identity({name: str(choice) for name, choice in named.items()}, values)


@lru_cache(maxsize=1)
def _our_code() -> str:
    files = [path for package in OURS for path in sorted((ROOT / package).rglob("*.py"))]
    acting = [path for path in files if not path.relative_to(ROOT).as_posix().startswith(PASSIVE)]
    shipped = sorted((ROOT / "datasets" / "priors").glob("*.safetensors"))
    return digest([*map(_content, [*acting, *shipped]), *(version(library) for library in LIBRARIES)])


@lru_cache
def _package(name: str) -> str:
    """Hash of a user's package or module; empty where there is none, which the run reports as an error."""
    try:
        spec = importlib.util.find_spec(name)
    except (ImportError, ValueError):
        return ""
    if spec is None:
        return ""
    if spec.submodule_search_locations is not None:
        files = [path for folder in spec.submodule_search_locations for path in sorted(Path(folder).rglob("*.py"))]
    else:  # a module, with those in the same folder, which it may import
        files = sorted(Path(spec.origin or "").parent.glob("*.py"))
    return digest([_content(path) for path in files])


def _content(path: Path) -> str:
    """Hash of a file's name and bytes, or of all files of a folder; empty where there is none."""
    try:
        if path.is_dir():
            return digest([_content(child) for child in sorted(path.iterdir()) if child.is_file()])
        return digest([path.name, hashlib.sha256(path.read_bytes()).hexdigest()])
    except OSError:
        return ""


def _values(node: Any, name: str) -> list[str]:
    """All strings under a key of that name, at any depth."""
    if not isinstance(node, dict):
        return []
    found = [node[name]] if isinstance(node.get(name), str) else []
    return found + [value for child in node.values() for value in _values(child, name)]
