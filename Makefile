# Two commands matter: `make run` (an emulated head listens, and two pictures show it) and `make test`. Both make .venv first if it is missing.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PARALLEL := -n auto --dist loadfile  # a file of tests to a process, as many processes as cores

.PHONY: run test test-all lint bench install clean

run: install
	$(BIN)/sfms-robot demo

install: $(VENV)/.installed

$(VENV)/.installed: pyproject.toml constraints.txt
	test -d $(VENV) || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	touch $@

test: install
	$(BIN)/python -m pytest $(PARALLEL) -m "not slow and not hardware and not gpu"

test-all: install
	$(BIN)/python -m pytest $(PARALLEL) -m "not hardware and not gpu"

lint: install
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

bench: install
	$(BIN)/sfms-robot bench --write docs/performance.md

clean:
	rm -rf $(VENV) build dist
