"""The list of planted mistakes fits the project, so that `make mutants` can plant each."""

import ast
from pathlib import Path

import pytest
import yaml

from tests.mutants import MUTANTS, ROOT, planted_in


@pytest.mark.parametrize("mutant", MUTANTS, ids=lambda mutant: f"{mutant.file}: {mutant.old[:40]}")
def test_a_mistake_can_be_planted(mutant):
    planted = planted_in(ROOT / mutant.file, mutant)
    assert planted != (ROOT / mutant.file).read_text()
    ast.parse(planted) if mutant.file.endswith(".py") else yaml.safe_load(planted)
    assert all(Path(ROOT, name).exists() for name in mutant.tests.split())


def test_there_are_enough_of_them():
    assert len({(mutant.file, mutant.old) for mutant in MUTANTS}) == len(MUTANTS) >= 40
