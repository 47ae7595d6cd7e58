"""The shipped pages: drawn from kept rows or by a named version, with one statistic a page."""

import shutil
import subprocess

import pytest

from bench.records.shipped import SUFFIX
from bench.report.data.kept import read_rows
from bench.report.data.records import OURS, setting
from bench.report.write.paper import FOLDER, SHIPPED, find_paper, write_columns
from bench.report.write.result import latex
from tests.documentation import commands

PAGES = {page.name: page.shown for page in find_paper(SHIPPED)}
EXPERIMENTS = {path.name.removesuffix(SUFFIX) for path in (SHIPPED / FOLDER).glob(f"*{SUFFIX}")}
DRAWN = [
    name for name, page in PAGES.items() if not page.drawn_by and not name.startswith("suite")
]  # which keep their rows


@pytest.mark.parametrize("name", DRAWN)
def test_a_page_of_this_version_has_rows_and_the_intervals_of_its_verdict(name: str):
    page = PAGES[name]
    assert EXPERIMENTS & {*page.experiments}  # else its head says which version drew it
    assert "Student" not in page.caption
    if "sign test" in page.answer and "95 % intervals" in page.caption:
        assert "(of the sign test)" in page.caption and "bootstrap" not in page.caption


def test_a_row_has_one_look_in_all_shipped_figures():
    looks: dict[tuple[str, str], set[str]] = {}
    for page in PAGES.values():
        for series in (series for panel in (page.chart or {}).get("panels", ()) for series in panel["series"]):
            for part in ("colour", "symbol", "dash"):  # lines may have no symbols, and points have no line
                looks.setdefault((series["name"], part), set()).update(filter(None, [series.get(part)]))
    assert {key: found for key, found in looks.items() if len(found) > 1} == {}


def test_no_rows_are_in_the_format_of_before():
    assert [*(SHIPPED / FOLDER).glob("*.runs.csv")] == []


def test_the_shipped_ranking_has_one_row_a_renderer():
    rows = read_rows(SHIPPED / FOLDER, "stability")
    classes = {row["renderer"]: setting(row["config"], "renderer", "_target_") for row in rows}
    names = {str(setting(row["config"], "renderer", "_label_")): row["renderer"] for row in rows}
    ranked = [classes[names[line[0]]] for line in PAGES["stability_cost"].rows]
    assert all(target.startswith(OURS) for target in ranked)
    assert sorted(ranked) == sorted({*classes.values()})


def test_documented_columns_are_those_of_shipped_pages(tmp_path):
    given = dict(word.split("=", 1) for one in commands() for word in one.words if word.startswith("columns."))
    write_columns(shutil.copytree(SHIPPED / FOLDER, tmp_path / FOLDER).parent, given)
    assert len(given) == 2 and r"\begin{tabular}{lrr}" in (tmp_path / FOLDER / "table1.tex").read_text()


def test_shipped_latex_is_of_todays_writer_and_compiles(tmp_path):
    tables = [name for name, page in PAGES.items() if page.columns]
    for name in tables:
        text = (SHIPPED / FOLDER / f"{name}.tex").read_text()
        assert text == latex(PAGES[name], name) and text.isascii()
    if shutil.which("pdflatex") is None:
        pytest.skip("pdflatex is not installed")
    inputs = "".join(rf"\input{{{SHIPPED / FOLDER / name}}}\clearpage" for name in tables)
    packages = r"\documentclass{article}\usepackage{array,booktabs,graphicx}"
    (tmp_path / "all.tex").write_text(rf"{packages}\begin{{document}}{inputs}\end{{document}}")
    command = ["pdflatex", "-interaction=batchmode", "-halt-on-error", "all.tex"]
    ended = subprocess.run(command, cwd=tmp_path, capture_output=True, timeout=120)
    log = (tmp_path / "all.log").read_text(errors="replace")
    assert ended.returncode == 0 and "Overfull" not in log and "Float too large" not in log, log[-2000:]
