"""Runs from Python: `bench.run` and `bench.load`, as in their examples."""

import doctest
from pathlib import Path
from subprocess import CompletedProcess

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from omegaconf import OmegaConf

import bench
from bench.report.data import frame
from bench.runner import library
from bench.runner.compose import parse_override
from tests.runner.driving import ROOT, by_program, command

SMALL = (
    "isolation=off", "threads=1", "task.points=20", "task.optimiser.iterations=8", "view.resolution=16",
    "evaluation.picture=null", "evaluation.grid=16", "evaluation.points=100", "evaluation.every=null",
)  # fmt: skip
EXAMPLES = {
    "run": library.run.__doc__,
    "load": frame.load.__doc__,
    "README": (ROOT / "bench" / "README.md").read_text(encoding="utf-8"),
}
LIGHT = """
import sys, bench
heavy = {"torch", "pandas", "numpy", "hydra", "matplotlib", "omegaconf"} & set(sys.modules)
assert not heavy, heavy
assert callable(bench.run)
"""


def completed(code: int, out: str, err: str) -> CompletedProcess[str]:
    return CompletedProcess([], code, out, err)


@pytest.fixture
def within(tmp_path, monkeypatch):
    """Makes an empty folder the working directory; `bench.run` runs in this process."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(library, "_command", lambda arguments: completed(*command(*arguments, *SMALL)))
    return tmp_path


@pytest.mark.parametrize("name", EXAMPLES)
def test_the_examples_run(within, name):
    if name == "load":
        bench.run(scale="smoke", renderer="newton")
    globs = {"bench": bench, "load": bench.load}
    examples = doctest.DocTestParser().get_doctest(EXAMPLES[name], globs, name, None, 0)
    assert len(examples.examples) >= 2
    runner, output = doctest.DocTestRunner(optionflags=doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE), []
    assert runner.run(examples, out=output.append).failed == 0, "".join(output)


TEXTS = st.text(st.characters(exclude_categories=["Cs", "Cc"]), max_size=12)
SCALARS = st.none() | st.booleans() | st.integers(-(10**9), 10**9) | st.floats(allow_nan=False) | TEXTS
VALUES = SCALARS | st.lists(SCALARS, max_size=4)


@given(VALUES)
@example("1e5")
@example("null")
@example("-inf")
@example("it's, a=b")
@example("a\\'b")
@example("${HOME}/x")
@example("李明.obj")
@example("~/chair (1).obj")
def test_a_value_from_python_arrives_unchanged(value):
    config = OmegaConf.create({"key": parse_override(library._override("key", value)).value()})
    assert OmegaConf.to_container(config, resolve=True) == {"key": value}


def test_an_array_is_a_list_a_path_is_text_and_a_method_is_added():
    assert library._override("label", Path("a/b.obj")) == "label=a/b.obj"
    assert library._override("method", "dist_mask") == "+method=dist_mask"
    assert library._override("key", np.array([[60.0, 24.5]])) == library._override("key", ((60.0, 24.5),))


@pytest.mark.parametrize(("code", "error"), [(2, ValueError), (1, OSError)])
def test_a_refused_run_is_an_error_with_the_line_of_the_command(monkeypatch, code, error):
    result = completed(code, "", "a note\nerror: unknown renderer 'dits'\n")
    monkeypatch.setattr(library, "_command", lambda _: result)
    with pytest.raises(error, match=r"^unknown renderer 'dits'$"):
        bench.run(renderer="dits")
    with pytest.raises(ValueError, match=r"takes a list of overrides, not 'completion': bench.run\(\['task=comp"):
        bench.run("completion")


def test_a_plan_is_no_run(monkeypatch):
    monkeypatch.setattr(library, "_command", lambda _: completed(0, "1 planned: 1 to run\n", ""))
    with pytest.raises(ValueError, match="'renderer=dist plan=true' does not: leave out plan=true"):
        bench.run(renderer="dist", plan=True)


def test_a_run_that_failed_is_a_record(within):
    failing = {"renderer._target_": "tests.failing.Failing"}
    record = bench.run(["+renderer.how=raise"], renderer="custom", scale="smoke", **failing)
    assert record.status == "crashed" and record.reason in str(record) and len(str(record)) < 300
    assert record.folder.parent == within / "results" / "local" / "runs"


def test_importing_bench_imports_nothing_that_is_slow():
    result = by_program("-c", LIGHT)
    assert result.code == 0, result.err
