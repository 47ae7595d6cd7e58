"""Any command line gives one clear line or a run with its settings: no traceback, no silent default."""

import math
from pathlib import Path

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from hypothesis import HealthCheck, given, seed, settings
from hypothesis import strategies as st
from omegaconf import OmegaConf

from bench.runner.command import EXIT_USAGE
from bench.runner.compose import dotted_keys
from tests.composing import composed
from tests.runner.driving import FAILING, command, record_of

LIMITS = ("time_limit=3", "memory_limit=2")
FIXED = {"results_dir", "priors_dir", "isolation", "time_limit", "memory_limit", "rerun", "tracker", "verbose", "label"}
GROUPS = ("task", "renderer", "dataset", "prior", "scale")
KEYS = [key for key in dotted_keys(composed()) if key.split(".")[0] not in FIXED and "_target_" not in key]
NUMBERS = st.integers(-3, 40) | st.sampled_from([0.0, 0.5, -1.5, 1e-9, 1e9, 10**30, math.inf, -math.inf, math.nan])
LITERALS = st.sampled_from(
    ["true", "false", "null", "abc", "dist", "sofa", "''", "[]", "[1,2]", "{a:1}", "[0,360]", "10%"]
)
ODD = st.text(st.characters(exclude_characters="\x00", exclude_categories=("Cs", "Cc")), min_size=1, max_size=8)
VALUES = NUMBERS.map(str) | LITERALS | ODD
OVERRIDES = st.builds("{}={}".format, st.sampled_from(KEYS), VALUES) | st.builds(
    "{}{}={}".format, st.sampled_from(["", "+", "~", "++"]), st.sampled_from([*KEYS, *GROUPS, "a.b", "sed"]), VALUES
)


@pytest.fixture(scope="module")
def results(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("fuzz")


def check(results: Path, overrides: list[str]) -> None:
    code, out, err = command(*FAILING_DIST, *LIMITS, *overrides, f"results_dir={results}")
    assert "Traceback" not in out + err, overrides
    if code == EXIT_USAGE:
        assert len(err.strip().splitlines()) == 1 and err.startswith("error: "), (overrides, err)
        return
    assert code in (0, 1), (overrides, code, err)
    record = record_of(out)
    assert (record["status"] == "ok" or record["reason"]) and "\n" not in record["reason"], overrides
    for override in OverridesParser.create().parse_overrides(overrides[-1:]):  # the last override of a key counts
        key = override.key_or_group
        if override.is_delete() or key in GROUPS or OmegaConf.select(OmegaConf.create(record["config"]), key) is None:
            continue
        value, typed = OmegaConf.select(OmegaConf.create(record["config"]), key), override.value()
        same = str(value) == str(typed) or str(value).lower() == str(typed).lower()
        number = isinstance(value, int | float) and float(value) == pytest.approx(float(typed), nan_ok=True)
        assert same or number or OmegaConf.is_config(value), (override.input_line, value)


FAILING_DIST = tuple(argument for argument in FAILING if not argument.startswith("renderer"))
RELAXED = settings(
    deadline=None, derandomize=True, suppress_health_check=list(HealthCheck), database=None, print_blob=False
)


@pytest.mark.slow
@seed(3)
@settings(RELAXED, max_examples=300, derandomize=False)
@given(overrides=st.lists(OVERRIDES, min_size=1, max_size=2))
def test_three_hundred_command_lines(results, overrides):
    check(results, overrides)
