"""Writes `index.html`, and into the folder `page` its scripts and their data.

The page lists its scripts in the order of their dependencies. Its policy allows scripts and pictures only from its own
folder, styles set by scripts, and no network.
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
from bench.report.site.detail import detail
from bench.report.site.files import Folder
from bench.report.site.renderers import renderers
from bench.report.write.paper import COPIES, PAGE_FOLDER, papers

ASSETS = Path(__file__).parents[1] / "page"
SILENT_WAIT_SECONDS = 1.0
LIBRARY = "plotly.min.js"
MAX_MESHES = 100  # `bench.report meshes=all` makes all

# In JSON these occur only in strings. Escaped, no string can end a script element or a line.
UNSAFE = re.compile("[<>&\u2028\u2029\x7f]")
DETAIL_FILE_PATTERN = re.compile(r"[0-9a-f]{2}([0-9a-f]{14})?\.js")
# Runs whose keys begin with the same letters share a file of details, as a small file occupies a whole disk block.
KEY_PREFIX_LETTERS = 2
ENCODER = json.JSONEncoder(allow_nan=False, ensure_ascii=True, separators=(",", ":"), default=str)


def write_index(results_dir: Path, *, meshes: int | None = MAX_MESHES) -> Path:
    """Writes `index.html` and the folder `page` from all run folders, with meshes of the newest; returns the page.

    Raises ValueError if `results_dir` is no folder, or a folder of the page is a link that leads out of it.
    """
    check_results(results_dir)
    with page_lock(results_dir):
        return write_page(*read_records(results_dir), results_dir, meshes)


@contextmanager
def page_lock(results_dir: Path) -> Iterator[None]:
    """Locks the page from reading records until it is written, so that the last writer sees the runs of both."""
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
    """Writes and returns the page of records that were read within `page_lock`, see `write_index`."""
    data, page = results_dir / PAGE_FOLDER / "data", results_dir / "index.html"
    folders = [Folder(results_dir, record["folder"]) for record in records]
    entries, content_by_key, copied = papers(results_dir)
    _copy_assets(results_dir / PAGE_FOLDER)
    _copy_pictures(results_dir.joinpath(*COPIES), copied)
    bundles = grouped(zip(folders, records, strict=True), lambda run: run[0].key[:KEY_PREFIX_LETTERS])
    details = (
        (name, {folder.key: detail(record, folder, results_dir) for folder, record in runs})
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
    """Writes the meshes of the newest runs, and keeps those that are up to date."""
    kept = []
    for number, folder in enumerate(folders):
        source = folder.path / "mesh.ply"
        is_current = _is_newer(data / "mesh" / f"{folder.key}.js", source, folder.key)
        if not is_current and (max_meshes is None or number < max_meshes):
            from bench.report.site.meshes import mesh_data  # imported here: runs without meshes need no trimesh

            try:
                mesh = mesh_data(source)
            except (OSError, ValueError) as error:
                mesh = {"none": f"The mesh cannot be shown: {error}."}
            write_script(data, "mesh", folder.key, mesh)
            is_current = True
        if is_current:
            kept.append(folder.key)
    remove_others(data / "mesh", kept)


def _is_newer(path: Path, source: Path, key: str) -> bool:
    """Whether a script is newer than its mesh file, and holds a mesh and nothing else."""
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


def _copy_pictures(folder: Path, sources: Iterable[Path]) -> None:
    current = {source.name: source for source in sources}
    for name, source in current.items():
        write_file(folder / name, source.read_bytes())
    for path in folder.glob("*.png"):
        if path.name not in current:
            path.unlink()


def to_script(kind: str, key: str, data: Any) -> str:
    """A script, in ASCII, that hands data to the page: `implicitBench.receive(kind, key, data)`."""
    arguments = (safe_json(argument) for argument in (kind, key, data))
    return f"implicitBench.receive({', '.join(arguments)});\n"


def safe_json(data: Any) -> str:
    """JSON in ASCII that is safe inside a script element."""
    try:
        text = ENCODER.encode(data)
    except ValueError:  # an infinite number or nan
        text = ENCODER.encode(to_json_values(data))
    return UNSAFE.sub(lambda match: f"\\u{ord(match[0]):04x}", text)


def remove_others(folder: Path, keys: Iterable[str]) -> None:
    current = {f"{key}.js" for key in keys}
    if folder.is_dir():
        with os.scandir(folder) as entries:
            names = {entry.name for entry in entries if DETAIL_FILE_PATTERN.fullmatch(entry.name)}
        for name in names - current:
            (folder / name).unlink(missing_ok=True)


def write_script(data: Path, kind: str, key: str, content: Any) -> None:
    write_file(data / kind / f"{key}.js", to_script(kind, key, content).encode("ascii"))


def write_file(path: Path, content: bytes) -> None:
    """Writes a file unless it has that content already; a link is always replaced."""
    if path.is_symlink() or not path.is_file() or path.read_bytes() != content:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_bytes(path, content)
