# A fresh machine needs Python 3.11 to 3.13 and make, nothing else. `make demo` and `make test` set everything up.
PYTHON ?= $(shell command -v python3.11 || command -v python3)
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
DOCS := .venv-docs
# An index of torch builds, if another than the default is wanted (see docs/getting-started.md)
TORCH_INDEX ?=

export OMP_WAIT_POLICY ?= PASSIVE
# The tests start some hundred processes: the first one writes the bytecode that the others read
export PYTHONDONTWRITEBYTECODE :=

# Writes requirements.lock with `make lock`; a program, not a part of the environment
UV ?= uv

# Tests are of one thread each; neighbours stay together, for they share what they prepare, until a process has no more
PYTEST := $(BIN)/python -m pytest -n logical --maxprocesses 4 --dist worksteal

.PHONY: setup lock demo fast test quick test-all lint docs benchmark dist publish clean

setup: $(READY)

$(READY): pyproject.toml constraints.txt requirements.lock
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and f"Python 3.11 or newer is wanted; $(PYTHON) is {sys.version.split()[0]}; set PYTHON=")'
	@echo 'set-up, once: the libraries of requirements.lock into $(VENV), then torch, then this project (minutes)'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --require-hashes --no-deps --requirement requirements.lock
	$(BIN)/python -m pip install --quiet --constraint constraints.txt $(if $(TORCH_INDEX),--extra-index-url $(TORCH_INDEX)) torch
	$(BIN)/python -m pip install --quiet --no-deps --no-build-isolation --editable .
	@touch $(READY)

# The versions of constraints.txt with the hashes of their files, for every platform and Python; torch, whose build the
# user chooses, and the libraries of its builds are left out
lock:
	echo "torch; sys_platform == 'never'" > .no-torch.txt
	$(UV) pip compile --quiet --universal --python-version 3.11 --generate-hashes --extra dev --constraint constraints.txt \
		--override .no-torch.txt --no-annotate --no-header --output-file requirements.lock pyproject.toml
	rm .no-torch.txt
	$(UV) pip compile --quiet --universal --python-version 3.11 --generate-hashes --group docs --constraint constraints.txt \
		--no-annotate --no-header --output-file requirements-docs.lock

demo: setup
	$(BIN)/erfsfm-slam run

# What differs from main, committed or not, and the test files that mirror it
MAIN ?= main
CHANGED = $(filter %.py,$(shell git diff --name-only --diff-filter=d $(MAIN); git ls-files --others --exclude-standard))
MIRRORS = $(wildcard $(filter tests/%,$(CHANGED)) \
	$(foreach file,$(filter-out tests/%,$(CHANGED)),tests/$(dir $(file))test_$(notdir $(file))))

# The inner loop: lint and the mirror tests of what differs from main
fast: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check --quiet .
	$(BIN)/python tools/house.py
	$(if $(CHANGED),$(BIN)/mypy)
	$(if $(MIRRORS),$(BIN)/python -m pytest -q -m 'not slow' $(filter tests/%,$(sort $(MIRRORS))))

# mypy keeps one core busy for most of a minute, so the tests begin beside it
test: setup
	$(MAKE) --jobs=2 lint quick

quick: setup
	$(PYTEST) -m 'not slow'

test-all: lint $(DOCS)/.ready
	$(PYTEST)

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check --quiet .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/python tools/house.py

# MkDocs stays out of .venv; it reads the code there
$(DOCS)/.ready: requirements-docs.lock $(READY)
	rm -rf $(DOCS)
	$(BIN)/python -m pip install --quiet --require-hashes --no-deps --target $(DOCS) --requirement requirements-docs.lock
	@touch $@

docs: $(DOCS)/.ready
	PYTHONPATH=$(DOCS) $(BIN)/python tools/docs_site.py

benchmark: setup
	$(BIN)/python -m pytest -q -s tests/benchmarks

dist: setup
	rm -rf dist
	$(BIN)/python -m hatchling build
	$(BIN)/python -m twine check --strict dist/*

# By a workflow that the package index trusts; elsewhere twine asks for a token
publish: dist
	$(BIN)/python -m twine upload dist/*

clean:
	rm -rf $(VENV) $(DOCS) dist build site
