"""The files whose edit makes a finished run stale: the modules that the run imports, and no others."""

import subprocess
import sys

import pytest

from bench.records import folder
from bench.records.folder import code_hash
from bench.records.imports import ROOT, imported_files

COMPLETION = ("bench.tasks.completion.Completion", "renderers.DIST", "datasets.families.Family")
MAX_FILES = 90  # of the completion of a procedural shape
LOADED = """
import sys, bench.runner.execute, bench.tasks.completion, renderers.dist, datasets.families
print(*(module.__file__ for name, module in list(sys.modules.items()) if name.split(".")[0] in ("bench", "datasets")))
"""


def files_of(*targets: str) -> set[str]:
    return {path.relative_to(ROOT).as_posix() for path in imported_files(targets)}


def test_a_run_depends_on_its_renderer_and_dataset_and_on_no_other():
    files = files_of(*COMPLETION)
    used = {
        "renderers/dist.py",
        "renderers/tracing/march.py",
        "renderers/kernels/decoder.cpp",
        "datasets/families.py",
        "bench/solve/optimise.py",
    }
    assert used <= files and len(files) <= MAX_FILES
    others = {
        "renderers/dvr.py",
        "renderers/later/neus.py",
        "datasets/files/captures/lenses.py",
        "bench/runner/command.py",
    }
    assert not files & others and not any(file.startswith(("bench/report", "bench/studies")) for file in files)
    assert files_of("renderers.DVR") - files >= {"renderers/dvr.py"}
    assert files_of("datasets.files.own_photographs.OwnPhotographs") >= {
        "datasets/files/captures/lenses.py",
        "datasets/files/captures/formats/llff.py",
    }


def test_every_module_that_python_loads_is_among_the_files():
    loaded = subprocess.run([sys.executable, "-c", LOADED], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    modules = {path for path in loaded.split() if not path.endswith("__init__.py")}
    assert len(modules) > 20 and modules <= {str(path) for path in imported_files(COMPLETION)}


@pytest.mark.parametrize("target", ["mypkg.Mine", "torch.nn.Linear", "bench.no_such_module.Thing"])
def test_a_target_outside_of_this_project_adds_no_file(target):
    assert files_of(target) - files_of() <= {"bench/__init__.py"}


def test_a_run_that_loads_choices_by_name_depends_on_all_of_them():
    config = {"task": {"_target_": "bench.tasks.ablation.Ablation"}, "prior": {}}
    alone, beside_others = (code_hash(config | {"task": config["task"] | {"beside": names}}) for names in ([], ["dvr"]))
    assert alone != beside_others


def test_a_run_depends_on_the_settings_of_a_renderer_that_it_loads_by_name(tmp_path, monkeypatch):
    monkeypatch.setattr(folder, "CONF", tmp_path)
    (tmp_path / "renderer").mkdir()
    hashes = []
    for steps in (1, 2):
        (tmp_path / "renderer" / "dvr.yaml").write_text(f"steps: {steps}\n")
        task = {"_target_": "bench.tasks.ablation.Ablation", "beside": ["dvr"]}
        hashes.append([code_hash({"task": task | {"beside": names}, "prior": {}}) for names in ([], ["dvr"])])
    (alone, loaded), (alone_later, loaded_later) = hashes
    assert alone == alone_later and loaded != loaded_later


def test_a_run_of_a_class_of_the_user_depends_on_all_modules_and_kernels(monkeypatch):
    hashed = []
    monkeypatch.setattr(folder, "_file_hash", lambda path, **_: hashed.append(path.name) or "")
    folder._our_code_hash.__wrapped__(frozenset(), True)
    assert {"decoder.cpp", "dvr.py", "neus.py"} <= {*hashed}
