"""The wheel and the sdist have all files that runs need, and one version."""

import os
import re
import shutil
import site
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from fnmatch import fnmatch
from pathlib import Path

import pytest
import yaml

from bench.records.results import RESULTS
from bench.runner.executors import EXTRA_BY_EXECUTOR
from datasets.extras import install_command, version
from tests.runner.driving import by_program

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("bench", "conf", "datasets", "renderers")
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
VERSION = PROJECT["project"]["version"]
NOT_IN_SDIST = ("results/",)
DEMO = ("task=completion", "renderer=dist", "scale=smoke", "threads=1", "evaluation.picture=null")


def tracked() -> list[str]:
    """The files of the project that git tracks, and new files that are not ignored."""
    command = ["git", "ls-files", "--cached", "--others", "--exclude-standard"]
    if not (ROOT / ".git").exists():
        pytest.skip("git says which files a package must have, and this is no clone")
    listed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    return [name for name in listed.splitlines() if (ROOT / name).is_file()]


def of_packages(names: list[str]) -> set[str]:
    return {name for name in names if name.split("/")[0] in PACKAGES}


def test_patterns_of_the_package_cover_every_file():
    patterns = PROJECT["tool"]["setuptools"]["package-data"]["*"]
    others = [name for name in of_packages(tracked()) if not name.endswith(".py")]
    assert len(others) > 80
    assert [n for n in others if not any(fnmatch(n.partition("/")[2], p.replace("**/", "*")) for p in patterns)] == []


def test_there_is_one_version_everywhere():
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert cited["version"] == VERSION and cited["cff-version"] == "1.2.0"
    assert f"version = {{{VERSION}}}" in (ROOT / "README.md").read_text(encoding="utf-8")
    headings = re.findall(r"^## (\S+)", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert VERSION in headings[:2]  # unreleased changes may come before it


def test_an_extra_is_installed_into_the_checkout_or_with_the_installed_package(tmp_path, monkeypatch):
    monkeypatch.chdir(ROOT)
    assert install_command("ray") == "pip install -e '.[ray]'"
    monkeypatch.chdir(tmp_path)
    assert install_command("ray") == f"pip install -e '{ROOT}[ray]'"
    assert install_command("ray", tmp_path) == "pip install 'implicit-bench[ray]'"


def test_a_library_that_is_not_installed_has_no_version():
    assert version("no-such-library") is None and version("torch")


def test_every_extra_that_a_message_names_exists():
    sources = [(ROOT / path).read_text(encoding="utf-8") for path in of_packages(tracked()) if path.endswith(".py")]
    named = [extra for source in sources for extra in re.findall(r"""\binstall_command\(["'](\w+)["']\)""", source)]
    assert len(named) >= 4
    assert {*named, *EXTRA_BY_EXECUTOR.values()} <= set(PROJECT["project"]["optional-dependencies"])


def started(folder: Path, *arguments: str) -> tuple[int, str]:
    """The exit status and standard error of Python in a folder, whose modules come before all others."""
    result = by_program(*arguments, cwd=folder, PYTHONPATH=os.pathsep.join([str(folder), str(ROOT)]))
    return result.code, result.err


@pytest.mark.parametrize("file", ["datasets/__init__.py", "renderers.py"])
def test_another_package_in_the_place_of_ours_is_an_error_in_one_line(tmp_path, file):
    path = tmp_path / file
    path.parent.mkdir(exist_ok=True)
    path.write_text('"""Of another project."""\nraise RuntimeError("it was imported")')
    message = f"{path} is not the package {file.split('/')[0].removesuffix('.py')} of implicit-bench"
    code, err = started(tmp_path, "-m", "bench.report", "--help")
    assert code == 1 and err.startswith(f"error: {message}") and len(err.splitlines()) == 1
    assert "an environment of its own (python -m venv)" in err


def test_a_package_that_was_installed_over_ours_is_an_error(tmp_path):
    for package in PACKAGES:
        (tmp_path / package).mkdir()
        shutil.copy(ROOT / package / "__init__.py", tmp_path / package)
    assert started(tmp_path, "-S", "-c", "import bench") == (0, "")
    (tmp_path / "conf" / "__init__.py").write_text("# of another project")
    code, err = started(tmp_path, "-S", "-c", "import bench")
    assert code == 1 and "ImportError" in err and "not the package conf of implicit-bench" in err


def test_a_users_conf_module_does_no_harm(tmp_path):
    (tmp_path / "conf.py").write_text("project = 'documentation'")
    assert started(tmp_path, "-c", "import bench") == (0, "")


def test_results_are_not_in_the_checkout():
    assert yaml.safe_load((ROOT / "conf" / "config.yaml").read_text(encoding="utf-8"))["results_dir"] == RESULTS
    ignored = subprocess.run(["git", "check-ignore", "-q", f"{RESULTS}/runs"], cwd=ROOT, check=False)
    assert ignored.returncode == 0 or not (ROOT / ".git").exists()


@pytest.mark.slow
def test_a_run_and_its_report_leave_the_checkout_as_it_is(tmp_path):
    for name in tracked():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, tmp_path / name)
    git = ["git", "-C", str(tmp_path), "-c", "user.name=a", "-c", "user.email=a@b.c"]
    for words in (["init", "-q"], ["add", "-A"], ["commit", "-qm", "all"]):
        subprocess.run([*git, *words], check=True)
    small = ("isolation=off", "evaluation.grid=16", "evaluation.points=100", "task.optimiser.iterations=2")
    for words in (("-m", "bench", *DEMO, *small), ("-m", "bench.report")):
        code, err = started(tmp_path, *words)
        assert code == 0, err
    assert subprocess.check_output([*git, "status", "--porcelain"], text=True) == ""


@pytest.fixture(scope="module")
def built(tmp_path_factory) -> Path:
    """A folder with the wheel and the sdist of the project's files."""
    folder = tmp_path_factory.mktemp("package")
    for name in tracked():
        if not name.startswith(NOT_IN_SDIST):
            (folder / "source" / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, folder / "source" / name)
    code = "from setuptools import build_meta as b; b.build_sdist('../dist'); b.build_wheel('../dist')"
    (folder / "dist").mkdir()
    subprocess.run([sys.executable, "-c", code], cwd=folder / "source", capture_output=True, check=True)
    return folder / "dist"


@pytest.mark.slow
def test_the_wheel_has_every_file_of_the_packages(built):
    (wheel,) = built.glob(f"implicit_bench-{VERSION}-py3-none-any.whl")
    names = [name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name]
    assert set(names) == of_packages(tracked())


@pytest.mark.slow
def test_the_sdist_has_every_file_but_results(built):
    (sdist,) = built.glob(f"implicit_bench-{VERSION}.tar.gz")
    with tarfile.open(sdist) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    wanted = {name for name in tracked() if not name.startswith(NOT_IN_SDIST) and name != ".gitignore"}
    assert wanted - names == set()


@pytest.mark.slow
def test_the_wheel_runs_from_an_empty_folder(built, tmp_path):
    """The new environment has the libraries of this one, but not this project."""
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", tmp_path / "venv"], check=True)
    python = tmp_path / "venv" / "bin" / "python"
    install = [sys.executable, "-m", "pip", "--python", python, "install", "--no-deps", "--no-index", "-q"]
    subprocess.run([*install, *built.glob("*.whl")], check=True)
    (libraries,) = (tmp_path / "venv").glob("lib/*/site-packages")
    (libraries / "libraries.pth").write_text("\n".join(site.getsitepackages()))
    empty = tmp_path / "empty"
    empty.mkdir()
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}

    def run(*arguments: str) -> str:
        process = subprocess.run(
            [python, *arguments], cwd=empty, env=environment, capture_output=True, text=True, check=False
        )
        assert process.returncode == 0, process.stderr
        return process.stdout

    assert run("-c", "import bench; print(bench.__file__)").startswith(str(libraries))
    folder = empty / run("-m", "bench", *DEMO).splitlines()[-1]
    assert {"record.json", "mesh.ply"} <= {path.name for path in folder.iterdir()}
    assert [path.name for path in empty.iterdir()] == ["results"]
    assert run("-m", "bench.report").splitlines()[-1] == "results/local/index.html"
    assert run(python.with_name("implicit-bench"), "report").splitlines()[-1] == "results/local/index.html"
    printed = run(
        "-c", "import bench; r = bench.load(); print(r.status[0], r['commit'].isna()[0] or r['commit'][0] == '')"
    )
    assert printed.split() == ["ok", "True"]
