# make fit: photo to avatar.  make check: a minute of checks.  make test: all of them.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
OUT ?= avatar
QUALITY ?= standard
PHOTO ?=

.PHONY: install fit lint check test

# .installed: what a fit needs; .tools: also what tests and checks need.
install: $(VENV)/.tools

$(VENV)/.installed: pyproject.toml setup.py
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --upgrade pip
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable .
	touch $@

$(VENV)/.tools: $(VENV)/.installed
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[dev]'
	touch $@

fit: $(VENV)/.installed
	$(BIN)/python -m sira_mi.fit $(if $(PHOTO),"$(PHOTO)",--example) --out "$(OUT)" --quality $(QUALITY)

lint: install
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/vulture

check: lint
	$(BIN)/python -m pytest -m "not slow"

test: lint
	$(BIN)/python -m pytest
