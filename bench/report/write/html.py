"""Writes `index.html`, and beside it in the folder `page` its scripts and the data that they show."""

import os
from importlib.util import find_spec
from pathlib import Path

from bench.records.files import file_lock, write_text
from bench.records.read import check_results
from bench.report.site.columns import columns_of
from bench.report.site.papers import papers
from bench.report.site.script import remove_others, to_script, write_script
from bench.report.write.runs import MOST_MESHES, write_runs

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
# Scripts and pictures come from beside the page, styles may be set by scripts, and nothing is asked of a network.
POLICY = (
    "default-src 'none'; script-src {scripts}; style-src {styles}; img-src {pictures}; "
    "base-uri 'none'; form-action 'none'"
)


def write_index(results_dir: Path, *, meshes: int | None = MOST_MESHES, anew: bool = True) -> Path:
    """Writes `index.html` and the folder `page` beside it from all run folders in `results_dir/runs`; gives the page.

    Args:
        results_dir: the results folder.
        meshes: of how many runs, the newest first, the mesh is made ready for the page; None for all.
        anew: whether all runs are read; otherwise those alone that have changed since the page was written.

    Raises:
        ValueError: if `results_dir` is not a folder.
    """
    check_results(results_dir)
    _refuse_links(results_dir)
    with file_lock(results_dir, FOLDER):  # another run's page would miss this run, or this one that run
        data, page = results_dir / FOLDER / "data", results_dir / "index.html"
        found = write_runs(results_dir, data, meshes=meshes, anew=anew)
        entries, wholes = papers(results_dir)
        lists = {
            "about": {"problems": found.problems, "oneFile": False},
            "papers": entries,
            "runs": columns_of(found.entries),
        }
        _copy_assets(results_dir / FOLDER)
        for name, content in lists.items():
            write_script(data / "list" / f"{name}.js", to_script("list", name, content))
        for key, whole in wholes.items():
            write_script(data / "paper" / f"{key}.js", to_script("paper", key, whole))
        remove_others(data / "paper", set(wholes))
        write_text(page, shell())
    return page


def update_index(results_dir: Path) -> Path:
    """As `write_index`, but reads the runs alone that have changed since: what a single run does at its end."""
    return write_index(results_dir, anew=False)


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
