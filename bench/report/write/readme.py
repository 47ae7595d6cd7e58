"""Writes `results/README.md` with all tables and figures of `results/paper`, so that no number is copied by hand."""

import re
from pathlib import Path

from bench.records.files import write_text
from bench.report.write.paper import FOLDER, find_paper

HEAD = """# Results

Written by `python -m bench.report` from [{folder}]({folder}): do not edit. Each table is there as CSV (raw numbers, in
scene units), Markdown and LaTeX, each figure as PNG and PDF. `python -m bench -m +experiment=NAME` makes the runs that
a page reads; the README of `conf` lists the experiments and how long they take.

"""


def write_readme(results_dir: Path) -> Path | None:
    """Writes `results_dir/README.md` and gives its path; None where `results_dir/paper` has no table or figure."""
    found = [page for page in find_paper(results_dir) if page["title"]]
    if not found:
        return None
    contents = [f"- [{page['title'].rstrip('.')}](#{page['name']})" for page in found]
    parts = [_section(results_dir / FOLDER / f"{page['name']}.md", page["name"]) for page in found]
    path = results_dir / "README.md"
    write_text(path, HEAD.format(folder=FOLDER) + "\n".join(contents) + "\n\n" + "\n".join(parts))
    return path


def _section(path: Path, name: str) -> str:
    """A page's Markdown under a heading, with folded notes and links relative to the folder above."""
    text = path.read_text(encoding="utf-8", errors="replace").replace(f"]({name}.png)", f"]({FOLDER}/{name}.png)")
    text = re.sub(r"((?:^- .*\n)+)", r"<details><summary>Notes</summary>\n\n\1\n</details>\n", text, flags=re.MULTILINE)
    title, rest = re.fullmatch(r"\*\*(.*?)\*\*\s*(.*)", text, re.DOTALL).groups()
    return f'## <a id="{name}"></a>{title}\n\n{rest}'
