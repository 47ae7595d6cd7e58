"""A page that this version cannot draw names the version that drew it."""

import subprocess
from pathlib import Path

from bench.report.data.page_version import UNKNOWN, drawn_by, head


def test_the_version_of_a_page_is_the_commit_that_changed_it_last(tmp_path: Path):
    page = tmp_path / "page.csv"
    page.write_text("a\n")
    assert drawn_by(page) == UNKNOWN
    named = ("-c", "user.name=a", "-c", "user.email=a@example.com", "-c", "commit.gpgsign=false")
    for command in (("init", "-q"), ("add", "page.csv"), ("commit", "-qm", "page")):
        subprocess.run(["git", *named, *command], cwd=tmp_path, check=True)
    commit, _, day = drawn_by(page).partition(" of ")
    assert len(commit) >= 7 and len(day) == len("2026-01-01")


def test_the_head_of_a_page_names_its_version():
    assert head("a of 2026-01-01").startswith("Drawn by version a of 2026-01-01, with its statistics")
    assert head("") == ""
