# make fit: photo to avatar.  make check: a minute of checks.  make test: all of them.
# make check-fit BENCH=FOLDER: ten minutes of fits to eight portraits of a benchmark, relit and scored.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
OUT ?= avatar
QUALITY ?= standard
PHOTO ?=
BENCH ?= bench

.PHONY: install fit lint check test check-fit

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

# Anew each time, as rows do not know the code that made them.
check-fit: install
	rm -rf .check-fit
	$(BIN)/python -m studies.portraits fit --benchmark "$(BENCH)" --runs .check-fit --half choice --portraits 8 \
		--rows draft page-of-code photo --workers 2
	$(BIN)/python -m studies.portraits score --benchmark "$(BENCH)" --runs .check-fit --half choice --portraits 8
