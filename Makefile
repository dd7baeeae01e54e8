# From a bare clone: `make deploy` runs the robot, `make test` runs every check. Needs python3 >= 3.11 with venv.
# Everything goes into .venv. Both can be overridden: make PYTHON=python3.12 VENV=/tmp/venv deploy
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
PIP ?= $(BIN)/python -m pip
INSTALL = $(PIP) install --quiet --disable-pip-version-check --constraint constraints.txt
ARGS ?=

.DEFAULT_GOAL := help
.PHONY: help deploy test check format safety fuzz bench build clean

help: ## Show this
	@grep -E '^[a-z]+:.*## ' $(MAKEFILE_LIST) | sort | awk -F ':.*## ' '{printf "  make %-8s %s\n", $$1, $$2}'

deploy: $(VENV)/.base ## Install what a deploy needs (no torch) and run the G1 on simulated motors; ARGS="--operator keyboard"
	$(BIN)/sim2real deploy --robot g1 $(ARGS)

test: check ## Everything: check, the whole test suite, the safety gate
	$(BIN)/python -m pytest
	$(MAKE) --no-print-directory safety

check: $(VENV)/.all ## Format, lint and types
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/pyright --pythonpath $(BIN)/python

format: $(VENV)/.all ## Format, and fix what can be fixed
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

safety: $(VENV)/.all ## The safety gate: every branch of sim2real/safety covered, every mutant killed
	$(BIN)/coverage run --branch --source=sim2real/safety -m pytest -q --durations=0 --durations-min=5 tests/sim2real/safety
	$(BIN)/coverage report --show-missing --fail-under=100
	$(BIN)/python tools/mutate.py

fuzz: $(VENV)/.all ## Every property test with fifty times the examples, a million frames for each codec, and new ones each time
	$(BIN)/python -m pytest -m hypothesis --hypothesis-profile=fuzz -o faulthandler_timeout=0 $(ARGS)

bench: $(VENV)/.all ## One table: our figures beside the floor or the incumbent; fails on none
	$(BIN)/python tools/bench.py $(ARGS)

build: $(VENV)/.all ## Wheel and sdist into dist/, installed elsewhere and tried
	$(BIN)/python -m build --outdir dist
	$(BIN)/python -m pytest -q tests/test_packaging.py

clean: ## Remove the environment and every built thing; records under runs/ stay
	rm -rf $(VENV) build dist .coverage .pytest_cache .ruff_cache .hypothesis

# Stamps: an environment is made once, and again when what it is made from changes.
$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and f"python3: got {sys.version.split()[0]}, expected 3.11 or newer; make PYTHON=python3.12 ...")'
	$(PYTHON) -m venv $(VENV)

$(VENV)/.base: pyproject.toml constraints.txt | $(BIN)/python
	@echo "installing the base into $(VENV): once"
	$(INSTALL) --editable .
	@touch $@

$(VENV)/.all: pyproject.toml constraints.txt | $(BIN)/python
	@echo "installing training and development tools into $(VENV): once"
	$(INSTALL) --editable '.[train,dds,dev]'
	@touch $@ $(VENV)/.base
