"""Writes `index.html`, and beside it in the folder `page` its scripts and the data that they show."""

import json
import os
import re
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from bench.records.files import write_text
from bench.records.read import read_records
from bench.report.site.columns import columns
from bench.report.site.detail import detail
from bench.report.site.files import Folder
from bench.report.site.papers import papers
from bench.report.site.script import to_script, write_script

ASSETS = Path(__file__).parents[1] / "page"
FOLDER = "page"  # of the results folder
LIBRARY = "plotly.min.js"
STYLES = ("style.css",)
SCRIPTS = (  # in the order in which they need each other
    *("base/dom.js", "base/format.js", "base/store.js", "base/address.js", "base/runs.js"),
    *("parts/theme.js", "parts/status.js", "parts/filter.js", "parts/table.js", "parts/picks.js"),
    *("parts/chart.js", "parts/curve.js", "parts/mesh.js"),
    *(
        "views/overview.js",
        "views/columns.js",
        "views/board.js",
        "views/paper.js",
        "views/atlas.js",
        "views/run.js",
        "views/compare.js",
    ),
)
START = "app.js"  # after the data
LISTS = ("about", "papers", "runs")  # the data that are loaded at the start
DATA = tuple(f"data/{kind}" for kind in ("list", "run", "mesh", "paper"))
KEY = re.compile(r"[0-9a-f]{16}\.js")  # of the files with details
MOST_MESHES = 500  # of the newest runs; `bench.report meshes=all` makes all
# Scripts and pictures come from beside the page, styles may be set by scripts, and nothing is asked of a network.
POLICY = (
    "default-src 'none'; script-src {scripts}; style-src {styles}; img-src {pictures}; "
    "base-uri 'none'; form-action 'none'"
)


def write_index(results_dir: Path, *, meshes: int | None = MOST_MESHES) -> Path:
    """Writes `index.html` and the folder `page` beside it from all run folders in `results_dir/runs`; gives the page.

    Args:
        results_dir: the results folder.
        meshes: of how many runs, the newest first, the mesh is made ready for the page; None for all.

    Raises:
        ValueError: if `results_dir` is not a folder.
    """
    records, problems = read_records(results_dir)
    data = results_dir / FOLDER / "data"
    folders = [Folder(results_dir, record["folder"]) for record in records]
    entries, wholes = papers(results_dir)
    lists = {
        "about": {"problems": problems, "oneFile": False},
        "papers": entries,
        "runs": columns(records, results_dir),
    }
    _refuse_links(results_dir)
    _copy_assets(results_dir / FOLDER)
    for name, content in lists.items():
        write_script(data / "list" / f"{name}.js", to_script("list", name, content))
    for key, whole in wholes.items():
        write_script(data / "paper" / f"{key}.js", to_script("paper", key, whole))
    _remove_others(data / "paper", set(wholes))
    for record, folder in zip(records, folders, strict=True):
        details = detail(record, folder, results_dir)
        write_script(data / "run" / f"{folder.key}.js", to_script("run", folder.key, details))
    _remove_others(data / "run", {folder.key for folder in folders})
    _write_meshes(data / "mesh", [folder for folder in folders if folder.has("mesh.ply")], meshes)
    page = results_dir / "index.html"
    write_text(page, shell())
    return page


def _refuse_links(results_dir: Path) -> None:
    """Raises ValueError where a folder that the page is written to is a link, which may lead anywhere."""
    for name in (FOLDER, *(f"{FOLDER}/{inner}" for inner in ("base", "parts", "views", "data", *DATA))):
        if (results_dir / name).is_symlink():
            raise ValueError(f"{results_dir / name} is a link, and the page is not written through it: remove it")


def shell() -> str:
    """The page without its data."""
    beside = "'self' file:"
    policy = POLICY.format(scripts=beside, styles=f"{beside} 'unsafe-inline'", pictures=f"{beside} data:")
    names = [*SCRIPTS, *(f"data/list/{name}.js" for name in LISTS), START]
    return filled(
        policy,
        "\n".join(f'<link rel="stylesheet" href="{FOLDER}/{name}">' for name in STYLES),
        "\n".join(f'<script src="{FOLDER}/{name}"></script>' for name in names),
    )


def filled(policy: str, styles: str, scripts: str) -> str:
    """The text of `index.html` with these parts."""
    text = (ASSETS / "index.html").read_text(encoding="utf-8")
    for name, part in {"policy": policy, "styles": styles, "scripts": scripts}.items():
        text = text.replace(f"{{{{ {name} }}}}", part)
    return text


def library() -> Path:
    """Plotly's script, of the package that is installed."""
    return Path(find_spec("plotly").origin).parent / "package_data" / LIBRARY


def _copy_assets(folder: Path) -> None:
    for name in (*STYLES, *SCRIPTS, START):
        _copy(ASSETS / name, folder / name)
    _copy(library(), folder / LIBRARY)


def _copy(source: Path, target: Path) -> None:
    """Copies a file, unless the target has that content already."""
    content = source.read_bytes()
    if target.is_file() and target.read_bytes() == content:
        return
    target.parent.mkdir(parents=True, exist_ok=True)
    scratch = target.with_name(f".{target.name}.{os.getpid()}")
    scratch.write_bytes(content)
    scratch.replace(target)


def _remove_others(folder: Path, keys: set[str]) -> None:
    """Removes the scripts of what is gone."""
    for path in folder.glob("*.js") if folder.is_dir() else ():
        if KEY.fullmatch(path.name) and path.stem not in keys:
            path.unlink(missing_ok=True)


def _write_meshes(folder: Path, found: list[Folder], most: int | None) -> None:
    """Writes the meshes of the newest runs; one that is there and newer than its mesh is kept."""
    from bench.report.site.meshes import mesh_data

    for number, run in enumerate(found):
        path, source = folder / f"{run.key}.js", run.path / "mesh.ply"
        if _is_newer(path, source, run.key):
            continue
        if most is not None and number >= most:
            data: dict[str, Any] = {
                "none": f"Made for the newest {most} runs: `python -m bench.report meshes=all` makes all."
            }
        else:
            try:
                data = mesh_data(source)
            except (OSError, ValueError) as error:
                data = {"none": f"The mesh cannot be shown: {error}."}
        write_script(path, to_script("mesh", run.key, data))
    _remove_others(folder, {run.key for run in found})


def _is_newer(path: Path, source: Path, key: str) -> bool:
    """Whether a mesh was made after its source, and the script holds a mesh and nothing else."""
    try:
        if path.stat().st_mtime_ns <= source.stat().st_mtime_ns:
            return False
        head, tail = to_script("mesh", key, 0).split("0);")
        text = path.read_text(encoding="ascii")
        data = json.loads(text.removeprefix(head).removesuffix(f");{tail}"))
        return isinstance(data, dict) and "vertices" in data and text == to_script("mesh", key, data)
    except (OSError, ValueError, RecursionError):
        return False
