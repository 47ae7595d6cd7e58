"""README files show the numbers of `results/paper`, and no others."""

import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from bench.report.data.kept import read_rows
from bench.report.write.paper import write_paper, write_readme
from bench.report.write.result import Shown, read_shown, write_shown
from tests import readme
from tests.documentation import LINK

ROOT = Path(__file__).resolve().parents[2]
PAPER = ROOT / "results" / "paper"


def rows(text: str) -> list[list[str]]:
    """The rows of all Markdown tables of a text, cell by cell."""
    lines = [line for line in text.splitlines() if line.startswith("|") and not line.startswith("| ---")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


def test_the_results_page_is_that_of_the_committed_tables(tmp_path):
    shutil.copytree(PAPER, tmp_path / "paper")
    text = write_readme(tmp_path).read_text()
    assert text == (ROOT / "results" / "README.md").read_text()
    links = [path for path, _ in LINK.findall(text)]
    assert sorted(path for path in links if path.endswith(".md") and path.startswith("paper/")) == sorted(
        f"paper/{page.name}" for page in PAPER.glob("*.md")
    )
    assert all((ROOT / "results" / path).exists() for path in links)


def test_the_results_page_follows_its_tables(tmp_path):
    folder = tmp_path / "paper"
    folder.mkdir()
    assert write_readme(tmp_path) is None
    mine = Shown(title="Mine.", question="Whose?", verdict="Of *1* run.", caption="Of one run.", columns=["a", "b"])
    mine = replace(mine, rows=[["x", "1.5"]], notes=["A note"], experiments=["mine_1", "mine_2"])
    write_shown(mine, folder / "mine")
    text = write_readme(tmp_path).read_text()
    assert ["[Whose?](paper/mine.md)", "Of 1 run.", "`mine_1`, `mine_2`"] in rows(text)
    page = (folder / "mine.md").read_text()
    assert "Whose? **Of 1 run.**" in page and "Of one run." in page and ["x", "1.5"] in rows(page)
    assert page.endswith("\n\n- A note\n")


def test_the_answers_of_the_readme_are_those_of_the_committed_results():
    text = (ROOT / "README.md").read_text()
    assert all(part in text for part in (readme.recommendation(), readme.table(), readme.hard_scenes()))


@pytest.mark.usefixtures("undrawn")
def test_the_ranks_that_the_readme_names_are_those_of_the_kept_rows(tmp_path):
    rows = read_rows(PAPER, "stability")
    write_paper(rows, tmp_path, only="stability_cost")
    drawn, committed = (read_shown(folder / "stability_cost.json") for folder in (tmp_path / "paper", PAPER))
    assert drawn.verdict == committed.verdict and drawn.rows == committed.rows


def test_the_readme_is_short():
    assert readme.wrongs((ROOT / "README.md").read_text()) == []
