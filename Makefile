# `make demo` and `make test` set everything up by themselves; `make help` lists the rest.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/installed
TOOLS := $(VENV)/installed-tools
DEMO := demo
MINUTES ?= 20

# One thread: the networks are too small to gain from more, and the results are then reproducible.
export OMP_NUM_THREADS ?= 1
export PIP_DISABLE_PIP_VERSION_CHECK := 1
export PIP_ROOT_USER_ACTION := ignore

.DEFAULT_GOAL := help
.PHONY: help demo test fuzz check lint docs format bench golden lock clean

help: ## list the targets
	@sed -n 's/^\([a-z]*\):.*## /\1\t/p' $(MAKEFILE_LIST) | expand -t 10

demo: $(STAMP) ## robots/rpr.urdf from URDF to C: train on a simulated arm that differs from it; a minute
	@rm -rf $(DEMO)
	@mkdir -p $(DEMO)
	$(BIN)/spelgen inspect robots/rpr.urdf
	$(BIN)/spelgen build robots/rpr.urdf -o $(DEMO)/rpr_spel.py
	$(BIN)/spelgen excite robots/rpr.urdf -o $(DEMO)/train.csv \
	    --duration 15 --sample-rate 200
	$(BIN)/spelgen excite robots/rpr.urdf -o $(DEMO)/test.csv \
	    --duration 15 --sample-rate 200 --seed 1
	$(BIN)/spelgen simulate robots/rpr.urdf -o $(DEMO)/logs --as-built 3 \
	    --motion $(DEMO)/train.csv --motion $(DEMO)/test.csv
	$(BIN)/spelgen logs $(DEMO)/logs --robot robots/rpr.urdf
	$(BIN)/spelgen train $(DEMO)/rpr_spel.py --robot robots/rpr.urdf \
	    --data $(DEMO)/logs -o $(DEMO)/run
	$(BIN)/spelgen evaluate $(DEMO)/run --quick --data $(DEMO)/logs \
	    --truth $(DEMO)/logs/as_built.urdf
	$(BIN)/spelgen report $(DEMO)/run > $(DEMO)/summary.txt
	$(BIN)/spelgen export $(DEMO)/run --to c -o $(DEMO)/rpr_c
	@echo && cat $(DEMO)/summary.txt

test: lint ## format and lint, then all tests on all cores, among them types and import direction
	$(BIN)/python -m pytest --numprocesses auto --dist loadfile --no-loadscope-reorder

fuzz: $(TOOLS) ## test random URDFs, logs, settings, meshes and run folders for MINUTES=20
	FUZZ_MINUTES=$(MINUTES) $(BIN)/python -m pytest -q -s tests/test_fuzz_urdf.py tests/test_fuzz_files.py \
	    tests/test_emitted_module.py::test_mass_matrix_is_positive_definite_for_any_weights

check: lint ## format, lint, types, import direction
	$(BIN)/python -m pytest -q tests/test_types.py tests/test_imports.py

lint: $(TOOLS) ## format and lint
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .

docs: $(TOOLS) ## write the docs as a site into site/
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet

format: $(TOOLS) ## format the code and sort the imports
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

bench: $(TOOLS) ## run every script of benchmarks/
	@for script in benchmarks/*.py; do echo "== $$script"; $(BIN)/python $$script || exit 1; done

golden: $(TOOLS) ## rewrite the golden files after an intended change; read the diff before committing
	$(BIN)/python -m pytest -q tests/test_emit.py::test_golden_text --update
	$(BIN)/python tests/settings_page.py --write

# If pip finds no CPU build of torch (UV_FIND_LINKS), the packages of NVIDIA are locked, too.
LOCK = .lock-venv/bin/uv pip compile --quiet --upgrade --generate-hashes --no-annotate --no-header \
    --constraints requirements-torch.txt --no-emit-package torch
# yourdfpy requires these packages for parts of trimesh that spelgen does not use.
UNUSED := anyio certifi charset-normalizer colorlog embreex h11 httpcore httpx idna jsonschema jsonschema-specifications \
    attrs referencing rpds-py manifold3d mapbox-earcut rtree setuptools shapely svg-path vhacdx xxhash

lock: ## update the pinned versions and hashes to the newest that the ranges of pyproject.toml allow
	$(PYTHON) -m venv .lock-venv
	.lock-venv/bin/pip install -qq uv
	printf 'hatchling\neditables\ncasadi\n' | $(LOCK) $(UNUSED:%=--no-emit-package %) --extra simulate pyproject.toml - > .lock-venv/demo
	$(LOCK) --constraints .lock-venv/demo --all-extras pyproject.toml > .lock-venv/tools
	sed -n '/^#/p' requirements.txt | cat - .lock-venv/demo > .lock-venv/lock && mv .lock-venv/lock requirements.txt
	sed -n '/^#/p' requirements-tools.txt | cat - .lock-venv/tools > .lock-venv/lock && mv .lock-venv/lock requirements-tools.txt
	rm -rf .lock-venv

clean: ## remove the environment, caches and demo output
	rm -rf $(VENV) .lock-venv $(DEMO) site build dist .pytest_cache .mypy_cache .ruff_cache .hypothesis

# Each package file is compared with its hash in requirements.txt. The list is complete, so pip installs no dependency
# that is not listed (--no-deps). The C++ headers (Boost, Pinocchio) and the tests of torch are removed: they take a
# sixth of the disk space and are not used.
$(STAMP): requirements.txt requirements-torch.txt pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	    echo "spelgen needs Python 3.11 or newer; $(PYTHON) is $$($(PYTHON) --version 2>&1)." >&2; \
	    echo "Name another one: make $(MAKECMDGOALS) PYTHON=python3.11" >&2; exit 1; }
	@echo "Installing the pinned packages into $(VENV): only once." >&2
	@$(PYTHON) -m venv $(VENV)
	@$(BIN)/python -m pip install -qq --no-compile --no-deps --require-hashes --requirement requirements.txt
	@$(BIN)/python -m pip install -qq --no-compile --requirement requirements-torch.txt
	@$(BIN)/python -m pip install -qq --no-deps --no-build-isolation --editable .
	@rm -rf $(VENV)/lib/python*/site-packages/cmeel.prefix/include $(VENV)/lib/python*/site-packages/torch/test
	@touch $@

# Additional packages for tests, checks and docs, in the same environment.
$(TOOLS): $(STAMP) requirements-tools.txt
	@echo "Installing the packages of the tests into $(VENV): only once." >&2
	@$(BIN)/python -m pip install -qq --no-compile --no-deps --require-hashes --requirement requirements-tools.txt
	@touch $@
