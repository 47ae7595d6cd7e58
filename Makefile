# Two commands do everything on a fresh machine: `make demo` and `make test`.
PYTHON ?=
BIN := .venv/bin
unexport PYTHONDONTWRITEBYTECODE  # with it, each of some hundred processes compiles all files again

.PHONY: demo results test test-slow test-types test-browser benchmark mutants lint setup clean

demo: .venv/ready ## set up once, then complete a sofa from 100 depth points
	$(BIN)/python -m bench task=completion renderer=dist

test: .venv/ready-dev ## set up once, then the tests (3 to 8 minutes on 2 quiet cores)
	$(BIN)/python -m pytest -n 2 --dist loadfile --durations=10

test-slow: .venv/ready-dev ## the minutes-long tests
	$(BIN)/python -m pytest -m slow --ignore tests/benchmarks

test-types: .venv/ready-dev ## the tests of `make test`, or TESTS, with types and shapes checked at every call
	CHECK_TYPES=1 $(BIN)/python -m pytest -n 2 --dist loadfile $(TESTS)

test-browser: .venv/ready-dev ## installs Chromium and Playwright where they are missing, then opens the page in it (minutes)
	@.ci/setup browser
	$(BIN)/python -m pytest -s -m browser tests/browser

benchmark: .venv/ready-dev ## renderers in turn, then speed and memory against the machine's own limits; on a quiet machine
	$(BIN)/python -m bench -m +experiment=benchmark
	$(BIN)/python -m bench.report
	$(BIN)/python -m pytest -o addopts="-q -s -p no:dash" tests/benchmarks

mutants: .venv/ready-dev ## installs mutmut, then changes the code in one place at a time (a night); ONLY='renderers.tracing.bracket*'
	@.ci/setup mutants
	$(BIN)/mutmut run $(if $(ONLY),'$(ONLY)')
	$(BIN)/mutmut results

results: .venv/ready ## for maintainers: writes what is shipped, results/paper and results/README.md, from results/local
	$(BIN)/python -m bench.report ship=results

lint: .venv/ready-dev ## ruff (lint and format), pyright, README's length, plain words
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright
	$(BIN)/python -m tests.readme
	$(BIN)/python -m tests.words

setup: .venv/ready-dev

.venv/ready: pyproject.toml .ci/setup .ci/constraints.txt  # what the command needs
	@PYTHON="$(PYTHON)" .ci/setup command

.venv/ready-dev: .venv/ready  # what tests and lint need on top
	@.ci/setup dev

clean:
	rm -rf .venv
