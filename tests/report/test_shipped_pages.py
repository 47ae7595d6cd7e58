"""The shipped pages: drawn from kept rows or by a named version, with one statistic a page."""

import pytest

from bench.report.data.kept import read_rows
from bench.report.data.records import OURS, setting
from bench.report.write.paper import FOLDER, SHIPPED, find_paper

PAGES = {page.name: page.shown for page in find_paper(SHIPPED)}
EXPERIMENTS = {row["config"]["experiment"] for row in read_rows(SHIPPED / FOLDER)}
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


def test_no_rows_are_in_the_format_of_before():
    assert [*(SHIPPED / FOLDER).glob("*.runs.csv")] == []


def test_a_ratio_with_seven_of_eight_shapes_is_no_difference():
    assert "0 of 2 ratios to Newton differ from 1; 2 cannot be distinguished" in PAGES["single_view_renderers"].answer


def test_the_shipped_ranking_has_one_row_a_renderer():
    rows = [row for row in read_rows(SHIPPED / FOLDER) if row["config"]["experiment"] == "stability"]
    classes = {row["renderer"]: setting(row["config"], "renderer", "_target_") for row in rows}
    names = {str(setting(row["config"], "renderer", "_label_")): row["renderer"] for row in rows}
    ranked = [classes[names[line[0]]] for line in PAGES["stability_cost"].rows]
    assert all(target.startswith(OURS) for target in ranked)
    assert sorted(ranked) == sorted({*classes.values()})
