# `make run`: an emulated head listens and is shown on a page. `make test`: the tests. Both create .venv if it is missing.
VENV := .venv
BIN := $(VENV)/bin
# The first of these that is Python 3.11 to 3.14; `make PYTHON=...` sets another.
FITS := import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 14))
PYTHON ?= $(shell for python in python3 python3.14 python3.13 python3.12 python3.11; do \
	$$python -c '$(FITS)' 2>/dev/null && echo $$python && break; done)
CHECKED = if [ -z '$(PYTHON)' ] || ! $(PYTHON) -c '$(FITS)'; then \
	echo "sfms-robot needs Python 3.11 to 3.14, found: $$($(or $(PYTHON),python3) --version 2>&1)" >&2; exit 2; fi
INSTALL = test -d $(VENV) || $(PYTHON) -m venv $(VENV); \
	$(BIN)/python -m pip install --quiet --disable-pip-version-check
PIPECAT := .venv-pipecat
PYTEST := $(BIN)/python -m pytest
# Each test file runs in one process. There is one process more than cores: many tests wait for servos and child processes.
WORKERS = $(shell $(PYTHON) -c 'import os; print(os.cpu_count() + 1)')
PARALLEL = -n $(WORKERS) --dist loadfile
TESTS := not hardware and not gpu
REALTIME = $(shell grep -lr --include='test_*.py' mark.realtime tests)  # no need to load the other files

.PHONY: run test test-all lint bench install clean

run: $(VENV)/.run
	$(BIN)/sfms-robot demo

install: $(VENV)/.installed

# Packages for a run and its plots, without torch. `make install` adds the development tools to the same environment.
$(VENV)/.run: pyproject.toml
	@$(CHECKED)
	@echo 'Installing sfms-robot with its plots into $(VENV): about 520 MB, one to two minutes, once.'
	@$(INSTALL) -e '.[plots]'
	@touch $@

$(VENV)/.installed: pyproject.toml constraints.txt
	@echo 'Installing sfms-robot with the tools of developers into $(VENV): about 3 GB, some minutes, once.'
	@$(INSTALL) -c constraints.txt -e '.[dev]'
	@touch $@ $(VENV)/.run

# pipecat pins soxr 1.0, but the tests need 1.1.
$(PIPECAT)/.installed: pyproject.toml constraints.txt
	test -d $(PIPECAT) || $(PYTHON) -m venv $(PIPECAT)
	$(PIPECAT)/bin/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[pipecat]' \
		'pytest>=8,<10' 'hypothesis>=6.100,<7'
	@touch $@

test: install
	$(PYTEST) $(PARALLEL) -m "not realtime and not slow and $(TESTS)"
	$(PYTEST) -m "realtime and not slow and $(TESTS)" $(REALTIME)

test-all: install $(PIPECAT)/.installed
	$(PYTEST) $(PARALLEL) --all-tools --hypothesis-profile thorough --durations 40 -m "not realtime and $(TESTS)"
	$(PYTEST) --all-tools --hypothesis-profile thorough --durations 20 -m "realtime and $(TESTS)" $(REALTIME)
	$(PIPECAT)/bin/python -m pytest tests/agents/test_pipecat.py

lint: install
	$(BIN)/ruff check --no-cache .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

bench: install
	$(BIN)/sfms-robot bench --write docs/science/performance.md

clean:
	rm -rf $(VENV) $(PIPECAT) build dist
