# `make run`: an emulated head listens, shown on a page. `make test`: the tests. Both make .venv first if it is missing.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
INSTALL = test -d $(VENV) || $(PYTHON) -m venv $(VENV); $(BIN)/python -m pip install --quiet --disable-pip-version-check
PYTEST := $(BIN)/python -m pytest
PARALLEL := -n auto --dist loadfile  # a file of tests to a process, as many processes as cores
TESTS := not hardware and not gpu

.PHONY: run test test-all lint bench install clean

run: $(VENV)/.run
	$(BIN)/sfms-robot demo

install: $(VENV)/.installed

# What a run and its plots need: no torch. `make install` adds the tools of developers to the same environment.
$(VENV)/.run: pyproject.toml
	$(INSTALL) -e '.[plots]'
	touch $@

$(VENV)/.installed: pyproject.toml constraints.txt
	$(INSTALL) -c constraints.txt -e '.[dev]'
	touch $@ $(VENV)/.run

test: install
	$(PYTEST) $(PARALLEL) -m "not realtime and not slow and $(TESTS)"
	$(PYTEST) -m "realtime and not slow and $(TESTS)"

test-all: install
	$(PYTEST) $(PARALLEL) --all-tools --hypothesis-profile thorough --durations 40 -m "not realtime and $(TESTS)"
	$(PYTEST) --all-tools --hypothesis-profile thorough --durations 20 -m "realtime and $(TESTS)"

lint: install
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

bench: install
	$(BIN)/sfms-robot bench --write docs/science/performance.md

clean:
	rm -rf $(VENV) build dist
