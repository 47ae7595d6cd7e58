"""Copies the shipped results that commands read into the wheel and the sdist; pyproject.toml has all other settings."""

from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py

RESULTS = Path("results")
FOLDER_IN_WHEEL = Path("bench", "shipped_results")  # bench/records/shipped.py names it too
PATTERNS = ("suite/*/*.csv", "paper/*.json", "paper/*.md", "paper/*.runs.csv.gz")


class BuildWithResults(build_py):
    """Builds the packages with a copy of the results; an editable installation reads those of the checkout."""

    def run(self) -> None:
        super().run()
        for source in [] if self.editable_mode else result_files():
            target = self.build_lib / FOLDER_IN_WHEEL / source.relative_to(RESULTS)
            self.mkpath(str(target.parent))
            self.copy_file(str(source), str(target))

    def get_source_files(self) -> list[str]:
        """The files of the sdist, from which the wheel may be built."""
        return [*super().get_source_files(), *map(str, result_files())]


def result_files() -> list[Path]:
    return sorted(path for pattern in PATTERNS for path in RESULTS.glob(pattern))


setup(cmdclass={"build_py": BuildWithResults})
