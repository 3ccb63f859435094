# `make demo` and `make test` set everything up by themselves; `make help` lists the rest.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/installed
DEMO := demo
MINUTES ?= 20

# The networks are tiny: more threads than one only cost time, and one makes runs repeatable.
export OMP_NUM_THREADS ?= 1
export PIP_DISABLE_PIP_VERSION_CHECK := 1

.DEFAULT_GOAL := help
.PHONY: help demo test fuzz check docs format bench golden lock clean

help: ## list the targets
	@sed -n 's/^\([a-z]*\):.*## /\1\t/p' $(MAKEFILE_LIST) | expand -t 10

demo: $(STAMP) ## the whole way on robots/rpr.urdf: inspect, build, simulate, train, evaluate, report
	@rm -rf $(DEMO)
	@mkdir -p $(DEMO)
	$(BIN)/spelgen inspect robots/rpr.urdf
	$(BIN)/spelgen build robots/rpr.urdf -o $(DEMO)/rpr_spel.py
	$(BIN)/spelgen simulate robots/rpr.urdf -o $(DEMO)/logs
	$(BIN)/spelgen train $(DEMO)/rpr_spel.py --robot robots/rpr.urdf --data $(DEMO)/logs -o $(DEMO)/run --max-minutes 3
	$(BIN)/spelgen evaluate $(DEMO)/run --data $(DEMO)/logs
	$(BIN)/spelgen report $(DEMO)/run

test: check ## run the checks, then the tests
	$(BIN)/python -m pytest

fuzz: $(STAMP) ## URDFs, logs, settings and run folders drawn at random, new ones for MINUTES=20
	FUZZ_MINUTES=$(MINUTES) $(BIN)/python -m pytest -q tests/test_fuzz.py tests/test_fuzz_files.py

check: $(STAMP) ## format, lint, types, import direction
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/python -m pytest -q tests/test_imports.py

docs: $(STAMP) ## write the docs as a site into site/
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet

format: $(STAMP) ## format the code and sort the imports
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

bench: $(STAMP) ## run every script of benchmarks/
	@for script in benchmarks/*.py; do echo "== $$script"; $(BIN)/python $$script || exit 1; done

golden: $(STAMP) ## rewrite the golden files after an intended change; read the diff before committing
	$(BIN)/python -m pytest -q tests/test_emit.py::test_golden_text --update

lock: ## write requirements.txt anew: the newest versions that the ranges of pyproject.toml admit
	rm -rf .lock-venv
	$(PYTHON) -m venv .lock-venv
	.lock-venv/bin/pip install -qq torch==2.13.0
	.lock-venv/bin/pip install -qq --editable '.[simulate,ros,deploy,xacro,fleet,dev]'
	sed -n '/^#/p' requirements.txt > .lock-venv/header
	.lock-venv/bin/pip freeze --exclude-editable | sed 's/+cpu$$//' | cat .lock-venv/header - > .lock-venv/lock
	mv .lock-venv/lock requirements.txt
	rm -rf .lock-venv

clean: ## remove the environment, caches and demo output
	rm -rf $(VENV) .lock-venv $(DEMO) site build dist .pytest_cache .mypy_cache .ruff_cache .hypothesis

# Everything pinned; made once, and again when the pins or the package's metadata change.
$(STAMP): requirements.txt pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	    echo "spelgen needs Python 3.11 or newer; $(PYTHON) is $$($(PYTHON) --version 2>&1)." >&2; \
	    echo "Name another one: make $(MAKECMDGOALS) PYTHON=python3.11" >&2; exit 1; }
	@echo "Installing the pinned packages into $(VENV): once, then never again." >&2
	@$(PYTHON) -m venv $(VENV)
	@$(BIN)/python -m pip install -qq --requirement requirements.txt
	@$(BIN)/python -m pip install -qq --no-deps --no-build-isolation --editable .
	@touch $@
