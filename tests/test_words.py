"""The linter of words finds vague names, constants explained by comments, and unclear prose."""

import pytest

from tests.words import faults_of_code, faults_of_prose


@pytest.mark.parametrize(
    "source, fault",
    [
        ("found = 1", "'found'"),
        ("def f(own): pass", "'own'"),
        ("LIMIT = 3  # of the rays", "'LIMIT' needs its comment"),
        ("for one in range(3): pass", "'one'"),
    ],
)
def test_a_vague_name_is_found_in_code(source, fault):
    (message,) = faults_of_code(source)
    assert fault in message


def test_keys_of_records_and_clear_names_pass():
    source = "class Record:\n    asked: str\n\nMAX_RAYS = 3  # a processor's cache holds them\nhits = 2\n"
    assert list(faults_of_code(source)) == []


def test_prose_has_no_private_words_and_no_long_sentence():
    assert "'beside'" in next(faults_of_prose("The table stands beside it."))
    assert "26 words" in next(faults_of_prose(" ".join(["word"] * 26) + "."))
    assert list(faults_of_prose("`beside` is a key. The renderer marches.")) == []
