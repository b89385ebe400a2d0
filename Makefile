# One verb each. PYTHON is any Python 3.11 or newer; everything lands in .venv.
PYTHON ?= python3
BIN := .venv/bin
SOURCES := pyproject.toml constraints.txt
PIP := $(BIN)/pip install --quiet --constraint constraints.txt
export PIP_DISABLE_PIP_VERSION_CHECK = 1

.PHONY: setup demo test lint types bench docs clean

demo: .venv/core.stamp
	$(BIN)/poet-loc demo --out runs/demo --overwrite

test: .venv/test.stamp
	$(BIN)/python -m pytest -n 2 --dist loadfile

lint: .venv/test.stamp
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: .venv/test.stamp
	$(BIN)/mypy

bench: .venv/test.stamp
	for file in benchmarks/bench_*.py; do $(BIN)/python $$file || exit 1; done

docs: .venv/docs.stamp
	$(BIN)/sphinx-build -W -b html docs docs/_build/html

setup: .venv/test.stamp

.venv/bin/python:
	$(PYTHON) -m venv .venv

.venv/core.stamp: .venv/bin/python $(SOURCES)
	$(PIP) --editable .
	$(BIN)/poet-loc compile
	touch $@

.venv/test.stamp: .venv/bin/python $(SOURCES)
	$(PIP) --editable ".[test]"
	$(BIN)/poet-loc compile
	touch $@ .venv/core.stamp

.venv/docs.stamp: .venv/test.stamp
	$(PIP) --editable ".[test,docs]"
	touch $@

clean:
	rm -rf .venv docs/_build
