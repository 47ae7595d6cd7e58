# Two commands do everything on a fresh machine: `make demo` and `make test`.
PYTHON ?= python3
BIN := .venv/bin

.PHONY: demo test test-slow benchmark lint setup clean

demo: .venv/ready ## set up once, then complete a sofa from 100 depth points
	$(BIN)/python -m bench task=completion renderer=dist

test: .venv/ready ## set up once, then the tests (under 6 minutes on 2 cores)
	$(BIN)/python -m pytest -n 2 --dist loadfile

test-slow: .venv/ready ## the minutes-long tests
	$(BIN)/python -m pytest -m slow --ignore tests/benchmarks

benchmark: .venv/ready ## speed and memory against the machine's own limits; on a quiet machine
	$(BIN)/python -m pytest -o addopts="-q -s -p no:dash" tests/benchmarks

lint: .venv/ready ## ruff (lint and format) and pyright
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright

setup: .venv/ready

.venv/ready: pyproject.toml .ci/setup
	PYTHON=$(PYTHON) .ci/setup

clean:
	rm -rf .venv
