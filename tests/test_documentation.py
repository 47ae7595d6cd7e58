"""The README files show commands that compose, code that runs, and links whose targets exist."""

import importlib.util
import json
import os
import re
import shutil
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest
from hydra.types import RunMode

import bench
import bench.studies
from bench import tables
from bench.config import build, check_names
from bench.records.results import PlannedRun
from bench.report.__main__ import main as report
from bench.report.write import paper
from bench.runner.command import config_dirs, options_of, overrides_of
from bench.runner.compose import Composer, composing
from tests import documentation
from tests.documentation import FILES, ROOT, Command, anchors, code_of, filled, links, text_of
from tests.runner.driving import SMALLEST, by_program
from tests.runner.driving import command as typed

HYDRA = ("bench", "bench.prior", "bench.train")  # commands whose arguments are choices and keys
COMMANDS = documentation.commands()
COMPOSED = [command for command in COMMANDS if command.module in HYDRA]
SMALL = (*SMALLEST, "task.optimiser.iterations=3", "view.resolution=16", "task.points=20")
QUICK = (  # all sizes of scale=smoke on which the runtime depends
    "scale=smoke", "isolation=off", "threads=1", "scale.grid=24", "scale.sweep_grid=24", "scale.points=200",
    "scale.picture=16", "scale.iterations=3", "scale.priors.own.shapes=4", "scale.priors.own.steps=10",
    "scale.fit_iterations=3", "scale.fit_steps=20", "scale.rendering=16", "scale.multiview.iterations=2",
    "scale.reconstruction.iterations=4", "scale.single_view.steps=3", "scale.stability.search.levels=3",
    "scale.gradient_pixels=12",
)  # fmt: skip
SMALL_EVALUATION = (  # for networks that are shipped at scale=desk only
    "isolation=off", "threads=1", "evaluation.grid=24", "evaluation.points=200", "evaluation.picture=null",
)  # fmt: skip
SMALL_FITTED_NETWORK = (
    *QUICK, "prior.network.layers=2", "prior.network.width=16", "prior.network.code_length=4", "prior.network.skip=0",
    "prior.steps=20", "prior.samples=500", "view.resolution=16",
)  # fmt: skip
ENDED = ("ok", "not_reached", "empty", "diverged", "timeout", "oom", "unsupported")  # the command worked


@pytest.fixture(scope="session")
def placeholder_paths(tmp_path_factory) -> Iterator[dict[str, str]]:
    """The paths of placeholders in commands; the code of CONTRIBUTING can be imported."""
    folder = tmp_path_factory.mktemp("documentation")
    named = documentation.make_files(folder)
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(folder / "mine")
        yield named


def first_cell(arguments: list[str]) -> PlannedRun:
    """The first cell of a command."""
    options = options_of(arguments)
    with composing(*config_dirs(options)):
        composer = Composer(overrides_of(options))
        config = composer.shared_config()
        if config.hydra.mode != RunMode.MULTIRUN and not options.multirun:
            return composer.single_run(config)
        cell = composer.swept(config)[0]
        spaces, drawn = (any(word in text for text in cell) for word in ("method=space/", "draw="))
        return composer.cells([[*cell, "draw=0"] if spaces and not drawn else cell])[0]


def test_every_command_is_there():
    assert {command.file for command in COMMANDS} == set(FILES)
    assert len(COMMANDS) > 60 and len(COMPOSED) > 45 and all("#" not in str(command) for command in COMMANDS)
    named = {command.module.rstrip(",") for command in COMMANDS}
    specs = {name: importlib.util.find_spec(name) for name in named}
    assert [name for name, spec in specs.items() if spec is None] == []
    packages = [name for name in named if name.startswith("bench") and specs[name].submodule_search_locations]
    assert [name for name in packages if importlib.util.find_spec(f"{name}.__main__") is None] == []


def test_every_command_composes(placeholder_paths):
    for command in COMPOSED:
        arguments = filled(command, placeholder_paths)
        if all(word.startswith(("-m", "+experiment=")) for word in arguments):  # which the tests of conf compose
            continue
        config = first_cell(arguments).config
        check_names(config)
        for node in ("renderer", "task"):  # of others, the tests of conf build every choice
            build(config[node], node, config["packages"])


def test_every_link_leads_to_a_file_and_a_heading():
    for file, path, anchor in sorted(set(links())):
        target = (ROOT / file).parent / path if path else ROOT / file
        assert target.exists(), (file, path)
        assert not anchor or anchor[1:] in anchors(target.read_text(encoding="utf-8")), (file, path, anchor)


def test_every_extra_that_is_named_is_there():
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    named = {name for file in FILES for name in re.findall(r"'[.\w-]+\[(\w+)\]'", text_of(file))}
    assert named and named <= set(extras)


def test_every_target_of_make_is_there():
    targets = set(re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    named = {name for file in FILES for name in re.findall(r"(?:^ {4}|`)make ([\w-]+)", text_of(file), re.MULTILINE)}
    assert {"demo", "test", "benchmark"} <= named <= targets
    paths = re.findall(r"tests/[\w/.]+", (ROOT / ".ci" / "run").read_text())
    assert len(paths) > 5 and [path for path in paths if not (ROOT / path).exists()] == []


def test_the_code_of_the_readme_runs(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (code,) = code_of("README.md", "python")
    exec(compile(code, "README.md", "exec"), {})
    printed = capsys.readouterr().out
    assert "hits" in printed and "gradient" in printed


@pytest.fixture(scope="module")
def task_results(placeholder_paths, tmp_path_factory) -> Path:
    """The results of the sweep of CONTRIBUTING's experiment over its task."""
    results = tmp_path_factory.mktemp("task") / "results"
    (sweep,) = [command for command in COMMANDS if "+experiment=coverage" in command.words]
    result = typed(
        *filled(sweep, placeholder_paths),
        "dataset=sofa",
        "scale=smoke",
        "isolation=off",
        "threads=1",
        f"results_dir={results}",
    )
    assert result.code == 0, result.err
    return results


def test_the_task_of_contributing_counts_what_it_says(task_results):
    runs = bench.load(task_results)
    assert list(runs.status) == ["ok"] * 2 and (runs.hits > 100).all()


def test_the_dataset_of_contributing_is_completed(placeholder_paths, tmp_path):
    (command,) = [command for command in COMMANDS if "dataset=rings" in command.words]
    result = typed(*filled(command, placeholder_paths), *SMALL, "field=box", f"results_dir={tmp_path}")
    assert result.out, result.err
    record = bench.load(tmp_path).iloc[0]
    assert record.scene == "rings test 0" and record.status in ENDED


def test_the_study_of_contributing_is_a_table(task_results, tmp_path, monkeypatch):
    (tmp_path / "coverage.py").write_text(code_of("CONTRIBUTING.md", "python")[2])
    monkeypatch.setattr(paper, "STUDIES", tmp_path)
    monkeypatch.setattr(bench.studies, "__path__", [str(tmp_path)])
    paper.studies.cache_clear()
    tables = list((task_results / "sweeps").glob("*/table.*"))  # written when the sweep ended, before its study existed
    assert len(tables) == 4
    for path in tables:
        path.unlink()
    try:
        report([f"results_dir={task_results}"])
        (page,) = (candidate.shown for candidate in paper.find_paper(task_results) if not candidate.shipped)
    finally:
        paper.studies.cache_clear()
        sys.modules.pop("bench.studies.coverage", None)
    assert page.columns[0] == "Run" and len(page.rows) == 2 and page.question
    assert "pixels;" not in page.caption  # the size of the view, which the task does not use
    assert not list((task_results / "sweeps").glob("*/table.csv"))  # a page shows it


def first_arguments(command: Command, placeholder_paths: dict[str, str]) -> list[str]:
    """The arguments of the first cell of a command, on this machine."""
    options = options_of([text for text in filled(command, placeholder_paths) if not text.startswith("hydra")])
    typed = [text.partition("=")[0] for text in options.overrides]
    with composing(*config_dirs(options)):
        composer = Composer([*options.overrides, "scale=smoke"] if options.multirun else options.overrides)
        swept = composer.swept(composer.shared_config())[0] if options.multirun else options.overrides
    quick = [
        "renderer=dist" if text.startswith("renderer=") and "renderer" not in typed else text  # the first is slow
        for text in swept
        if not (text.startswith("renderer=") and "renderer" not in typed and "+method" in typed)
    ]
    return [*(word for folder in config_dirs(options) for word in ("--config-dir", str(folder))), *quick]


@pytest.mark.slow
@pytest.mark.parametrize(
    "command", [c for c in COMPOSED if c.module == "bench" and not re.search("NAME|plan=true", str(c))], ids=str
)
def test_every_command_runs(placeholder_paths, tmp_path, command):
    if {"+method=stereo", documentation.DENSE_DEPTHS} & set(command.words):
        pytest.importorskip("cv2", reason="stereo is an extra: pip install -e '.[stereo]'")
    fitted = {"+experiment=table1", "+experiment=gradients"} & set(command.words)
    small = SMALL_EVALUATION if "+method=single_view" in command.words else SMALL_FITTED_NETWORK if fitted else QUICK
    result = typed(*first_arguments(command, placeholder_paths), *small, f"results_dir={tmp_path}")
    assert result.out, result.err
    record = bench.load(tmp_path).iloc[0]
    assert record.status in ENDED, record.reason


@pytest.mark.slow
def test_the_other_commands_run(placeholder_paths, tmp_path):
    """All run in one folder, which has a run, results folders and a folder of photographs."""
    result = typed("renderer=newton", *QUICK, f"results_dir={tmp_path / 'A'}")
    named = placeholder_paths | dict.fromkeys(("RUN", "RUN..."), result.out.splitlines()[-1])
    for other in ("B", "C", "BEFORE", "AFTER"):
        shutil.copytree(tmp_path / "A", tmp_path / other)
    named["PATH"] = str(tmp_path / "A")
    (tmp_path / "results").mkdir()
    (tmp_path / "results" / "local").symlink_to(tmp_path / "A")
    elsewhere_tested = ("bench", "pytest", "bench.judge", "bench.suite")  # tested in files of their own
    tested = [c for c in COMMANDS if c.module not in elsewhere_tested]
    for command in tested:
        words = filled(command, named) + (list(QUICK) if command.module in HYDRA else [])
        ran = by_program("-m", command.module, *words, cwd=tmp_path, PYTHONPATH=str(ROOT))
        explained = "has no runs of the tuning" in ran.err or (ran.code == 2 and not command.arguments)
        assert ran.code == 0 or explained, (str(command), ran.err)


@pytest.mark.slow
def test_the_contract_of_contributing_holds(placeholder_paths, tmp_path):
    (contract,) = [command for command in COMMANDS if command.module == "pytest"]
    paths = os.pathsep.join([str(ROOT), str(Path(placeholder_paths["my_conf"]).parent)])
    ran = by_program("-m", "pytest", *contract.arguments, PYTHONPATH=paths)
    assert ran.code == 0, ran.out[-3000:]


# The README names these families of renderers with a star.
SETTINGS_OF_SPEED = re.compile(r"(dist_alpha|dist_epsilon|dist_steps|dvr_fixed)_")


@pytest.mark.parametrize("group", ["renderer", "experiment"])
def test_the_page_of_choices_names_every_file(group):
    names = {name for name in tables.names(group) if not name.startswith("_")}
    mentioned = set(re.findall(r"(?:`|\+experiment=)([a-z0-9_]+)[` ]", text_of("conf/README.md")))
    assert {name for name in names if not SETTINGS_OF_SPEED.match(name)} <= mentioned


def test_the_tables_of_stresses_are_those_of_the_file():
    stress_tables, text = documentation.stress_tables(), text_of("conf/README.md")
    for table in stress_tables:
        assert table in text, f"conf/README.md must have this table:\n{table}"
        assert "|  |" not in table, "conf/stresses.yaml: write a comment, the meaning, before each row"
    names = [name for name in tables.names("stress") if name != "none"]
    assert sorted(re.findall(r"^\| `(\w+)`", "\n".join(stress_tables), re.MULTILINE)) == names


def test_the_table_of_the_papers_has_the_numbers_of_shapes_that_are_shipped():
    row = re.compile(r"^\| \[[^|]*?results/paper/(\w+)\.md\)[^|]*\|[^|]*\|[^|]*\| (\d+) \|", re.MULTILINE)
    rows = row.findall(text_of("conf/README.md"))
    captions = {name: json.loads((ROOT / f"results/paper/{name}.json").read_text())["caption"] for name, _ in rows}
    shipped = {name: re.search(r"\((\d+) shape", caption) for name, caption in captions.items()}
    assert len(rows) > 12 and [(name, n) for name, n in rows if n != (shipped[name][1] if shipped[name] else "1")] == []
