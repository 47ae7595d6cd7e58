"""Writes `index.html`, and beside it in the folder `page` its scripts and the data that they show."""

import json
import os
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from bench.records.files import file_lock, write_text
from bench.records.read import check_results, read_records
from bench.report.data.records import Record
from bench.report.site.columns import columns
from bench.report.site.detail import detail
from bench.report.site.files import Folder
from bench.report.site.papers import papers
from bench.report.site.script import remove_others, to_script, write_script

ASSETS = Path(__file__).parents[1] / "page"
FOLDER = "page"  # of the results folder
LIBRARY = "plotly.min.js"
STYLES = ("style.css",)
SCRIPTS = (  # in the order in which they need each other
    *("base/dom.js", "base/format.js", "base/store.js", "base/address.js", "base/runs.js"),
    *("parts/theme.js", "parts/choose.js", "parts/table.js", "parts/chart.js", "parts/curve.js", "parts/mesh.js"),
    *("views/papers.js", "views/board.js", "views/atlas.js", "views/run.js", "views/compare.js"),
)
START = "app.js"  # after the data
LISTS = ("about", "papers", "runs")  # the data that are loaded at the start
DATA = tuple(f"data/{kind}" for kind in ("list", "run", "mesh", "paper"))
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
    check_results(results_dir)
    _refuse_links(results_dir)
    with file_lock(results_dir, FOLDER):  # of two sweeps that end, the last one's page has the runs of both
        records, problems = read_records(results_dir)
        data, page = results_dir / FOLDER / "data", results_dir / "index.html"
        _copy_assets(results_dir / FOLDER)
        _write_details(records, results_dir, data / "run")
        _write_meshes(records, results_dir, data / "mesh", meshes)
        entries, wholes = papers(results_dir)
        for key, whole in wholes.items():
            write_script(data / "paper" / f"{key}.js", to_script("paper", key, whole))
        remove_others(data / "paper", wholes)
        about = {"problems": problems, "oneFile": False}
        lists = {"about": about, "papers": entries, "runs": columns(records, results_dir)}
        for name, content in lists.items():
            write_script(data / "list" / f"{name}.js", to_script("list", name, content))
        write_text(page, shell())
    return page


def _write_details(records: list[Record], results_dir: Path, place: Path) -> None:
    """Writes the details of each run, and removes those of runs that are gone."""
    folders = [Folder(results_dir, record["folder"]) for record in records]
    for record, folder in zip(records, folders, strict=True):
        write_script(place / f"{folder.key}.js", to_script("run", folder.key, detail(record, folder, results_dir)))
    remove_others(place, [folder.key for folder in folders])


def _write_meshes(records: list[Record], results_dir: Path, place: Path, most: int | None) -> None:
    """Writes the meshes of the newest runs; one that is there and newer than its mesh is kept."""
    folders = [Folder(results_dir, record["folder"]) for record in records]
    folders = [folder for folder in folders if folder.has("mesh.ply")]
    left_out = {"none": f"Made for the newest {most} runs: `python -m bench.report meshes=all` makes all."}
    for number, folder in enumerate(folders):
        path, source = place / f"{folder.key}.js", folder.path / "mesh.ply"
        if not _is_newer(path, source, folder.key):
            made = _mesh(source) if most is None or number < most else left_out
            write_script(path, to_script("mesh", folder.key, made))
    remove_others(place, [folder.key for folder in folders])


def _mesh(source: Path) -> dict[str, Any]:
    """The mesh as the page takes it, or why it cannot be shown."""
    from bench.report.site.meshes import mesh_data  # only here: runs without meshes need no trimesh

    try:
        return mesh_data(source)
    except (OSError, ValueError) as error:
        return {"none": f"The mesh cannot be shown: {error}."}


def _is_newer(path: Path, source: Path, key: str) -> bool:
    """Whether a mesh was made after its source, and the script holds a mesh and nothing else."""
    try:
        if path.is_symlink() or path.stat().st_mtime_ns <= source.stat().st_mtime_ns:
            return False
        head, tail = to_script("mesh", key, 0).split("0);")
        text = path.read_text(encoding="ascii")
        data = json.loads(text.removeprefix(head).removesuffix(f");{tail}"))
        return isinstance(data, dict) and "bdata" in data["x"] and text == to_script("mesh", key, data)
    except (OSError, ValueError, LookupError, TypeError, RecursionError):
        return False


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
