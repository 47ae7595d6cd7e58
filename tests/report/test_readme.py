"""README files show the numbers of `results/paper`, and no others."""

import re
import shutil
from dataclasses import replace
from pathlib import Path

from bench.report.write.paper import write_readme
from bench.report.write.result import Shown, read_shown
from tests import readme

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
        "| [Whose?](#mine) | Of 1 run. |" in text
        and "Whose? **Of 1 run.**" in text
        and "Of one run." in text
        and ["x", "1.5"] in rows(text)
    )
    assert re.search(r"<details><summary>Notes</summary>\n\n- A note\n\n</details>", text)


def test_the_recommendation_and_the_table_of_the_readme_are_those_of_the_committed_results():
    text = (ROOT / "README.md").read_text()
    assert readme.table() in text and readme.recommendation() in text


def test_the_readme_is_short():
    assert readme.wrongs((ROOT / "README.md").read_text()) == []


def test_each_number_of_an_answer_is_in_the_table_that_it_names():
    readme = (ROOT / "README.md").read_text()
    answers = re.findall(r"^\| .+\? \| \[[^]]*\]\(results/README.md#(\w+)\)(.*) \|$", readme, re.MULTILINE)
    assert len(answers) == len(re.findall(r"^\| .+\? \|", readme, re.MULTILINE)) >= 3  # each begins with its table
    for name, text in answers:
        shown = read_shown(PAPER / f"{name}.json")
        known = [float(x) for x in re.findall(r"\d+\.\d+", shown.verdict + str(shown.rows))]
        for number in re.findall(r"\d+\.\d+", text):
            places = len(number.partition(".")[2])
            assert any(round(x, places) == float(number) for x in known), (name, number)
