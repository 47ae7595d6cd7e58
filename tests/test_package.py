"""The wheel and the sdist have all files that runs need, and one version."""

import ast
import json
import os
import re
import shutil
import site
import subprocess
import sys
import tomllib
import zipfile
from fnmatch import fnmatch
from pathlib import Path

import pytest
import yaml

from bench.clusters import Ray, Slurm
from bench.records.results import RESULTS
from bench.records.shipped import FITS, SURFACE_METRICS, shipped_rows
from datasets.extras import install_command, version
from tests.runner.driving import by_program

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("bench", "conf", "datasets", "renderers")
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
VERSION = PROJECT["project"]["version"]
SHIPPED_FILES = (
    r"results/suite/[^/]+/[^/]+\.csv",
    r"results/paper/[^/]+\.(json|md|runs\.csv\.gz)",
)  # which commands read
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


def shipped_files(names: list[str]) -> set[str]:
    """The shipped results that the wheel and the sdist have."""
    return {name for name in names if re.fullmatch("|".join(SHIPPED_FILES), name)}


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
    assert {*named, Slurm.extra, Ray.extra} <= set(PROJECT["project"]["optional-dependencies"])


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


@pytest.mark.parametrize("act", ["raise KeyboardInterrupt", "try: raise KeyboardInterrupt\nfinally: print(unknown)"])
def test_ctrl_c_while_a_command_is_imported_is_one_line(tmp_path, act):
    (tmp_path / "numpy.py").write_text(act)
    (tmp_path / "hydra.py").write_text("raise KeyboardInterrupt")
    assert started(tmp_path, "-m", "bench.judge", "--help")[1] == "error: stopped by Ctrl-C\n"
    assert started(tmp_path, "-m", "bench") == (130, "error: stopped by Ctrl-C; nothing was run\n")
    _, err = started(tmp_path, "-c", "import bench; raise KeyboardInterrupt")
    assert "Traceback" in err  # a user's program keeps its own


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


def build(source: Path, kinds: str, into: Path) -> None:
    """Builds the sdist or the wheel, or both, of a folder of sources."""
    calls = "; ".join(f"build_meta.build_{kind}({str(into)!r})" for kind in kinds.split())
    code = f"from setuptools import build_meta; {calls}"
    subprocess.run([sys.executable, "-c", code], cwd=source, capture_output=True, check=True)


@pytest.fixture(scope="module")
def built(tmp_path_factory) -> Path:
    """A folder with the sdist and the wheel of the project's files."""
    folder = tmp_path_factory.mktemp("package")
    for name in tracked():
        (folder / "source" / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, folder / "source" / name)
    (folder / "dist").mkdir()
    build(folder / "source", "sdist wheel", folder / "dist")
    return folder / "dist"


def files_of_wheel(folder: Path) -> set[str]:
    (wheel,) = folder.glob(f"implicit_bench-{VERSION}-py3-none-any.whl")
    return {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}


@pytest.mark.slow
def test_the_wheel_has_every_file_of_the_packages_and_the_results_that_commands_read(built):
    results = shipped_files(tracked())
    assert len(results) > 100
    copies = {name.replace("results", "bench/shipped_results", 1) for name in results}
    assert files_of_wheel(built) == of_packages(tracked()) | copies


@pytest.mark.slow
def test_the_sdist_has_every_file_but_results_that_no_command_reads_and_makes_the_same_wheel(built, tmp_path):
    (sdist,) = built.glob(f"implicit_bench-{VERSION}.tar.gz")
    subprocess.run(["tar", "-xzf", sdist, "-C", tmp_path], check=True)
    source = tmp_path / sdist.name.removesuffix(".tar.gz")
    names = {path.relative_to(source).as_posix() for path in source.rglob("*") if path.is_file()}
    wanted = {name for name in tracked() if not name.startswith("results/") and name != ".gitignore"}
    assert wanted - names == set()
    assert {name for name in names if name.startswith("results/")} == shipped_files(tracked())
    build(source, "wheel", tmp_path)
    assert files_of_wheel(tmp_path) == files_of_wheel(built)


class Installed:
    """The wheel in an environment of its own, which has the libraries of this one but not this project."""

    def __init__(self, wheel: Path, folder: Path) -> None:
        self.python = folder / "venv" / "bin" / "python"
        subprocess.run([sys.executable, "-m", "venv", "--without-pip", folder / "venv"], check=True)
        install = [sys.executable, "-m", "pip", "--python", self.python, "install", "--no-deps", "--no-index", "-q"]
        subprocess.run([*install, wheel], check=True)
        (self.libraries,) = (folder / "venv").glob("lib/*/site-packages")
        (self.libraries / "libraries.pth").write_text("\n".join(site.getsitepackages()))
        (self.libraries / "results").mkdir()  # as a package of another project

    def run(self, folder: Path, *arguments: str | Path, program: str = "python") -> str:
        """The standard output of a program of the environment in a folder."""
        environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
        command = [self.python.with_name(program), *arguments]
        process = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
        assert process.returncode == 0, process.stderr
        return process.stdout


@pytest.fixture(scope="module")
def installed(built, tmp_path_factory) -> Installed:
    """The installed wheel, whose packages all come from its own environment."""
    environment = Installed(*built.glob("*.whl"), tmp_path_factory.mktemp("installed"))
    code = f"from importlib import import_module; print([import_module(name).__file__ for name in {PACKAGES}])"
    files = ast.literal_eval(environment.run(environment.libraries.parents[3], "-c", code))
    assert files == [str(environment.libraries / name / "__init__.py") for name in PACKAGES]
    return environment


@pytest.mark.slow
def test_the_wheel_runs_from_an_empty_folder(installed, tmp_path):
    folder = tmp_path / installed.run(tmp_path, "-m", "bench", *DEMO).splitlines()[-1]
    assert {"record.json", "mesh.ply"} <= {path.name for path in folder.iterdir()}
    assert [path.name for path in tmp_path.iterdir()] == ["results"]
    assert installed.run(tmp_path, "-m", "bench.report").splitlines()[-1] == "results/local/index.html"
    printed = installed.run(
        tmp_path,
        "-c",
        "import bench; r = bench.load(); print(r.status[0], r['commit'].isna()[0] or r['commit'][0] == '')",
    )
    assert printed.split() == ["ok", "True"]


@pytest.mark.slow
def test_a_run_of_the_wheel_has_the_best_possible_errors(installed, tmp_path):
    words = ("task=completion", "renderer=dist", "threads=1", "evaluation.picture=null", "task.optimiser.iterations=2")
    folder = tmp_path / installed.run(tmp_path, *words, program="implicit-bench").splitlines()[-1]
    best = json.loads((folder / "record.json").read_text(encoding="utf-8"))["metrics_best"]
    (fit,) = [row for row in shipped_rows(FITS) if row["scene"] == "sofa test 0"]
    assert best == {name: float(fit[f"metrics.{name}"]) for name in SURFACE_METRICS}


@pytest.mark.slow
def test_a_plan_of_the_wheel_has_the_times_of_shipped_runs(installed, tmp_path):
    *cells, summary = installed.run(tmp_path, "-m", "bench", "-m", "+experiment=table1", "plan=true").splitlines()
    assert len(cells) > 20 and all("shipped run" in cell for cell in cells)
    assert f"{len(cells)} to run; about" in summary


@pytest.mark.slow
def test_comparisons_and_pages_of_the_wheel_are_those_of_the_checkout(installed, tmp_path):
    comparison = "import bench; print(bench.compare(['newton', 'dist']).to_csv())"
    pages = "from pathlib import Path; from bench.report.write.paper import papers; print(papers(Path('none')))"
    code = f"{comparison}; {pages}"
    output = installed.run(tmp_path, "-c", code)
    assert "DIST, our default" in output and "What does one rendering with its gradient cost" in output
    assert output == by_program("-c", code, cwd=tmp_path, PYTHONPATH=str(ROOT)).out


@pytest.mark.slow
def test_the_suite_of_the_wheel_compares_a_run_with_the_shipped_results(installed, tmp_path):
    output = installed.run(tmp_path, "-m", "bench.suite", "suite=smoke", "set=complete", "renderer=newton")
    assert "the shipped ones need about" in output and "1 planned: 1 ok" in output
    assert "1 run of results/local, in rows with a star; the others are shipped." in output
    rows = [line for line in output.splitlines() if re.match(r"(Newton \*|DIST, our default) .* % \(", line)]
    assert len(rows) == 2
