"""README files show the numbers of `results/paper`, and no others."""

import html
import re
import shutil
from dataclasses import replace
from pathlib import Path

from bench.report.write.paper import write_readme
from bench.report.write.result import Shown

ROOT = Path(__file__).resolve().parents[2]
PAPER = ROOT / "results" / "paper"


def rows(text: str) -> list[list[str]]:
    """The rows of all Markdown tables of a text, cell by cell."""
    lines = [line for line in text.splitlines() if line.startswith("|") and not line.startswith("| ---")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


def test_the_results_page_is_that_of_the_committed_tables(tmp_path):
    shutil.copytree(PAPER, tmp_path / "paper")
    assert write_readme(tmp_path).read_text() == (ROOT / "results" / "README.md").read_text()


def test_the_results_page_follows_its_tables(tmp_path):
    folder = tmp_path / "paper"
    folder.mkdir()
    assert write_readme(tmp_path) is None
    mine = Shown(title="Mine.", question="Whose?", verdict="Of *1* run.", caption="Of one run.", columns=["a", "b"])
    (folder / "mine.json").write_text(replace(mine, rows=[["x", "1.5"]], notes=["A note"]).to_json())
    text = write_readme(tmp_path).read_text()
    assert (
        "- [Whose?](#mine)" in text
        and "Whose? **Of 1 run.**" in text
        and "Of one run." in text
        and ["x", "1.5"] in rows(text)
    )
    assert re.search(r"<details><summary>Notes</summary>\n\n- A note\n\n</details>", text)


def test_readme_quotes_what_results_say():
    quoted = [
        line.removeprefix("> ").strip() for line in (ROOT / "README.md").read_text().splitlines() if line[:2] == "> "
    ]
    said = " ".join(html.unescape(path.read_text()) for path in PAPER.glob("*.md"))
    assert quoted and [text for text in quoted if text not in said] == []


def test_readme_shows_the_numbers_of_table_1():
    mine = [row for row in rows((ROOT / "README.md").read_text()) if row[0] in STRATEGIES]
    heading, *theirs = rows((PAPER / "table1.md").read_text())
    expected = {row[0]: [row[heading.index(name)] for name in SHOWN] for row in theirs}
    assert len(mine) == len(STRATEGIES) and mine == [expected[row[0]] for row in mine]


def test_readme_tells_the_ratios_of_the_benchmark():
    heading, *lines = rows((PAPER / "benchmark.md").read_text())
    (line,) = [row for row in lines if row[:3] == ["256", "1", "newton"]]
    forward, step = (line[heading.index(name)] for name in ("Forward ratio", "Step ratio"))
    said = f"a rendering of Newton takes {forward} and a step {step} of the time of DIST, our default"
    assert said in " ".join((ROOT / "README.md").read_text().split())


PUBLISHED = ("Published queries", "Published time")
STRATEGIES = [row[0] for row in rows((PAPER / "table1.md").read_text())[1:]]
SHOWN = (
    "Strategy",
    "Size",
    "Queries",
    "Forward",
    "Step",
    "Missed / spurious / wrong depth",
    "Published queries",
    "Published time",
)
