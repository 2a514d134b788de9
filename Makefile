# Everything a user or contributor types. `make help` lists the targets.
#
# Variables: PYTHON=<interpreter> picks another Python; PIP_FLAGS=<flags> is passed to every pip install;
#            WORKERS=<n> sets how many processes run the tests.

VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
DOCS_STAMP := $(VENV)/.installed-docs
WORKERS ?= 2
TORCH := $(shell sed -n '/^torch==/p' constraints.txt)
PIP := -m pip --quiet --disable-pip-version-check
# The pins are those of Python 3.11; on 3.10 only torch is held, the rest follows the ranges in pyproject.toml.
CONSTRAINTS = $(shell "$(PYTHON)" -c 'import sys; sys.exit(sys.version_info < (3, 11))' && echo -c constraints.txt)
PIP_INSTALL = $(BIN)/python $(PIP) install $(PIP_FLAGS) $(CONSTRAINTS)

# The first interpreter that PyBullet has wheels for; an interpreter named on the command line is checked, not replaced.
SUPPORTED := import sys; sys.exit(sys.version_info[:2] not in ((3, 10), (3, 11)))
PYTHON ?= $(shell for python in python3.11 python3.10 python3 python; do \
	"$$python" -c '$(SUPPORTED)' >/dev/null 2>&1 && { echo "$$python"; exit; }; done; echo python3)

PYTEST := OMP_NUM_THREADS=1 $(BIN)/python -m pytest
SOURCES := cura_torchrl tests $(wildcard docs/conf.py benchmarks examples)

.DEFAULT_GOAL := help
.PHONY: help setup demo test check test-slow test-ray lint type contracts spelling wheel format coverage docs clean

help: ## List the targets
	@sed -n 's/^\([a-z-]*\):.*## \(.*\)/\1\t\2/p' Makefile | awk -F '\t' '{ printf "  make %-10s %s\n", $$1, $$2 }'

setup: $(STAMP) ## Make .venv with the pinned dependencies and this package

$(STAMP): pyproject.toml constraints.txt
	@"$(PYTHON)" -c '$(SUPPORTED)' 2>/dev/null || { echo "error: '$(PYTHON)' is $$("$(PYTHON)" --version 2>/dev/null || echo 'no Python'); \
	PyBullet has wheels for Python 3.10 and 3.11 only. Install one of them, or name it: make PYTHON=python3.11" >&2; exit 2; }
	"$(PYTHON)" -m venv $(VENV)
	$(PIP_INSTALL) $(TORCH)
	$(PIP_INSTALL) $(TORCH) -e ".[test]"
	@touch $@

demo: $(STAMP) ## Play the shipped policies on PyBullet, write runs/demo/index.html, train for a few iterations
	$(BIN)/cura-torchrl demo

test: lint type contracts spelling wheel ## Lint, types, import contracts, spelling, wheel, doctests and the fast tests
	$(PYTEST) -n $(WORKERS) -m "not slow and not gpu" --doctest-modules cura_torchrl tests

check: test test-ray ## What continuous integration runs

test-slow: $(STAMP) ## The tests that take more than half a minute each
	$(PYTEST) -n $(WORKERS) -m "slow and not gpu" tests

test-ray: $(STAMP) ## Those of them that start a Ray cluster of two nodes, one after the other
	$(PYTEST) -m "slow and not gpu" tests/unit/trainers/training/test_ray_backend.py

lint: $(STAMP)
	$(BIN)/ruff check $(SOURCES)
	$(BIN)/ruff format --check $(SOURCES)

type: $(STAMP)
	$(BIN)/mypy

contracts: $(STAMP)
	$(BIN)/lint-imports

spelling: $(STAMP)
	$(BIN)/codespell

# A wheel without its robot, policies or encoder would install and then fail: build it, unpack it, look for every file of the
# package, and play an episode from there.
wheel: $(STAMP)
	@rm -rf build/wheel && mkdir -p build/wheel
	$(BIN)/python $(PIP) wheel --no-deps --wheel-dir build/wheel .
	$(BIN)/python $(PIP) install --no-deps --target build/wheel/site build/wheel/*.whl
	@cd build/wheel/site && git -C ../../.. ls-files -z cura_torchrl | xargs -0 ls -d >/dev/null
	cd build/wheel/site && ../../../$(BIN)/python -m cura_torchrl.trainers.cli evaluate --policy scripted \
		--max-obstacles 0 --episodes 1 --chunk 1 --json >/dev/null

format: $(STAMP) ## Format the code and apply the safe fixes
	$(BIN)/ruff check --fix $(SOURCES)
	$(BIN)/ruff format $(SOURCES)

coverage: $(STAMP) ## Branch coverage of the fast tests
	$(PYTEST) -n $(WORKERS) -m "not slow and not gpu" --cov --cov-report=term-missing:skip-covered tests

$(DOCS_STAMP): $(STAMP)
	$(PIP_INSTALL) $(TORCH) -e ".[docs]"
	@touch $@

docs: $(DOCS_STAMP) ## Build the documentation into docs/_build/html
	$(BIN)/python -m sphinx -W --keep-going -b html docs docs/_build/html

clean: ## Remove .venv and everything built (runs/ stays)
	rm -rf $(VENV) build dist docs/_build .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache .coverage*
	find cura_torchrl tests -name __pycache__ -type d -prune -exec rm -rf {} +
