# Everything a newcomer needs: `make demo` and `make test` set up a virtual environment by themselves.
PYTHON ?= python3.11
VENV ?= .venv
BIN = $(VENV)/bin
OUT ?= runs/demo
# Worker processes of the tests: one more than two cores, as some tests wait for processes that they start.
WORKERS ?= 3

.PHONY: demo test test-all lint check docs bench clean help

help:  ## what there is to make
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/'

# Python compiles what it imports; all that is installed would take longer than the installation.
$(VENV)/.installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile -c constraints.txt -e '.[test,dev,whip,policy]'
	@touch $@

demo: $(VENV)/.installed  ## the main job: supports and heuristics compared on Lotka-Volterra
	$(BIN)/jaxlfi compare lotka_volterra --preset quick --seeds 6 --out $(OUT)

# What the tests of a file share is made once, as one process runs them all; files in the order of tests/conftest.py.
PYTEST = $(BIN)/python -m pytest -n $(WORKERS) --dist loadfile --no-loadscope-reorder

test: $(VENV)/.installed  ## all tests but slow ones
	$(PYTEST) -m "not slow"

test-all: $(VENV)/.installed  ## all tests
	$(PYTEST)

lint: $(VENV)/.installed  ## style and types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check --quiet .
	$(BIN)/mypy

check: lint  ## before a commit, a minute and a half: style, types, and the tests nearest to what differs from main
	$(BIN)/python -m tests.affected

docs: $(VENV)/.installed  ## the documentation site, in site/
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[docs]'
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

bench: $(VENV)/.installed  ## benchmarks against NumPy, numba and PyTorch
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[bench]'
	$(BIN)/python -m experiments.benchmarks

clean:  ## remove the environment and caches
	rm -rf $(VENV) site build .pytest_cache .ruff_cache .mypy_cache *.egg-info
