"""Writes `index.html`, and beside it in the folder `page` its scripts and the data that they show.

The page names its scripts in the order in which they need each other. By its policy scripts and pictures come from
beside it, styles may be set by scripts, and nothing is asked of a network.
"""

import json
import os
import re
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from filelock import Timeout

from bench.records.read import check_results, read_records
from bench.records.record import file_lock, to_json_values, write_bytes, write_text
from bench.report.data.records import grouped
from bench.report.site.columns import columns
from bench.report.site.detail import bundle, detail
from bench.report.site.files import Folder
from bench.report.site.renderers import renderers
from bench.report.write.paper import papers

ASSETS = Path(__file__).parents[1] / "page"
PAGE_FOLDER = "page"  # of the results folder
SILENT_WAIT_SECONDS = 1.0  # seconds to wait in silence
LIBRARY = "plotly.min.js"
MAX_MESHES = 100  # of the newest runs; `bench.report meshes=all` makes all

# Within a JSON text these occur in strings only. Escaped, no string can end a script element or a line.
UNSAFE = re.compile("[<>&\u2028\u2029\x7f]")
DETAIL_FILE_PATTERN = re.compile(r"[0-9a-f]{2}([0-9a-f]{14})?\.js")  # of the files with details
# Letters of a run's key: those with the same share a file of details, since a small file takes a whole block of a disk.
KEY_PREFIX_LETTERS = 2
ENCODER = json.JSONEncoder(allow_nan=False, ensure_ascii=True, separators=(",", ":"), default=str)


def write_index(results_dir: Path, *, meshes: int | None = MAX_MESHES) -> Path:
    """Writes `index.html` and the folder `page` beside it from all run folders in `results_dir/runs`; gives the page.

    Args:
        meshes: of how many runs, the newest first, the mesh is made ready for the page; None for all.

    Raises:
        ValueError: if `results_dir` is not a folder, or one that the page is written to is a link out of it.
    """
    check_results(results_dir)
    with page_lock(results_dir):
        return write_page(*read_records(results_dir), results_dir, meshes)


@contextmanager
def page_lock(results_dir: Path) -> Iterator[None]:
    """Held while records are read and their page is written: of two that write, the last one's has the runs of both.

    Who waits for it longer than `PATIENCE` is told.
    """
    lock = file_lock(results_dir, PAGE_FOLDER)
    try:
        lock.acquire(timeout=SILENT_WAIT_SECONDS)
    except Timeout:
        print(f"waiting for another process that writes the page of {results_dir}", file=sys.stderr, flush=True)
        lock.acquire()
    try:
        yield
    finally:
        lock.release()


def write_page(records: list[dict[str, Any]], problems: list[str], results_dir: Path, meshes: int | None) -> Path:
    """Writes the page of records that were read within `page_lock`, as `write_index` does; gives it."""
    data, page = results_dir / PAGE_FOLDER / "data", results_dir / "index.html"
    folders = [Folder(results_dir, record["folder"]) for record in records]
    entries, content_by_key = papers(results_dir)
    _copy_assets(results_dir / PAGE_FOLDER)
    bundles = grouped(zip(folders, records, strict=True), lambda run: run[0].key[:KEY_PREFIX_LETTERS])
    details = (
        (name, bundle((folder, detail(record, folder, results_dir)) for folder, record in runs))
        for name, runs in bundles.items()
    )
    _write_all(data, "run", details)
    _write_meshes([folder for folder in folders if folder.has("mesh.ply")], data, meshes)
    _write_all(data, "paper", content_by_key.items())
    lists = {
        "about": {"problems": problems, "meshes": meshes},
        "papers": entries,
        "runs": columns(records, folders),
        "renderers": renderers(records, results_dir),
    }
    for name, content in lists.items():
        write_script(data, "list", name, content)
    write_text(page, (ASSETS / "index.html").read_text(encoding="utf-8"))
    return page


def _write_all(data: Path, kind: str, contents: Iterable[tuple[str, Any]]) -> None:
    keys = []
    for key, content in contents:
        write_script(data, kind, key, content)
        keys.append(key)
    remove_others(data / kind, keys)


def _write_meshes(folders: list[Folder], data: Path, max_meshes: int | None) -> None:
    """Writes the meshes of the newest runs; one that is there and newer than its mesh is kept."""
    kept = []
    for number, folder in enumerate(folders):
        source = folder.path / "mesh.ply"
        is_current = _is_newer(data / "mesh" / f"{folder.key}.js", source, folder.key)
        if not is_current and (max_meshes is None or number < max_meshes):
            write_script(data, "mesh", folder.key, _mesh(source))
            is_current = True
        if is_current:
            kept.append(folder.key)
    remove_others(data / "mesh", kept)


def _mesh(source: Path) -> dict[str, Any]:
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


def _copy_assets(folder: Path) -> None:
    for path in (*ASSETS.rglob("*.css"), *ASSETS.rglob("*.js")):
        write_file(folder / path.relative_to(ASSETS), path.read_bytes())
    write_file(folder / LIBRARY, (Path(find_spec("plotly").origin).parent / "package_data" / LIBRARY).read_bytes())


def to_script(kind: str, key: str, data: Any) -> str:
    """A script that hands data to the page: `implicitBench.receive(kind, key, data)`, in ASCII.

    Numbers that are not finite are the strings "inf", "-inf" and "nan".
    """
    arguments = (safe_json(argument) for argument in (kind, key, data))
    return f"implicitBench.receive({', '.join(arguments)});\n"


def safe_json(data: Any) -> str:
    """JSON in ASCII that can stand within a script element."""
    try:
        text = ENCODER.encode(data)
    except ValueError:  # a number that is not finite
        text = ENCODER.encode(to_json_values(data))
    return UNSAFE.sub(lambda match: f"\\u{ord(match[0]):04x}", text)


def remove_others(folder: Path, keys: Iterable[str]) -> None:
    """Removes the scripts of what is gone."""
    current = {f"{key}.js" for key in keys}
    if folder.is_dir():
        with os.scandir(folder) as entries:
            old_names = [
                entry.name
                for entry in entries
                if entry.name not in current and DETAIL_FILE_PATTERN.fullmatch(entry.name)
            ]
        for name in old_names:
            (folder / name).unlink(missing_ok=True)


def write_script(data: Path, kind: str, key: str, content: Any) -> None:
    """Writes the script that hands over the content of that kind and key."""
    write_file(data / kind / f"{key}.js", to_script(kind, key, content).encode("ascii"))


def write_file(path: Path, content: bytes) -> None:
    """Writes a file, unless it has that content already; what a link leads to may change."""
    if path.is_symlink() or not path.is_file() or path.read_bytes() != content:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_bytes(path, content)
