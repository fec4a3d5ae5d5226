# Two commands: `make fit` turns a photo into an avatar, `make test` runs all tests.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
OUT ?= avatar
QUALITY ?= standard
PHOTO ?=

.PHONY: install fit test lint

install: $(VENV)/.installed

$(VENV)/.installed: pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --upgrade pip
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[dev]'
	touch $@

fit: install
	$(BIN)/python -m sira_mi.fit $(if $(PHOTO),"$(PHOTO)",--example) --out "$(OUT)" --quality $(QUALITY)

lint: install
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

test: install lint
	$(BIN)/python -m pytest
