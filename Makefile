# A fresh clone needs Python >= 3.11 and make. Every target installs what it needs into .venv first.
PYTHON ?= python3
BIN := .venv/bin

DEMO := sympflow,sympflow:flow=henon_heiles-sympflow,verlet,srkn11b,rk45,dop853:rtol=1e-10:atol=1e-12

.DEFAULT_GOAL := help
.PHONY: help demo test pytest slow lint dist bench docs clean

help:  ## Show the targets
	@grep -E '^[a-z]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/'

.venv/installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --constraint constraints.txt --editable '.[plot,cli]'
	@touch $@

.venv/installed-test: .venv/installed
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[test]'
	@touch $@

# One thread: on arrays as small as these the others of BLAS and torch only wait, spinning.
demo: export OMP_NUM_THREADS = 1
demo: .venv/installed  ## Compare six methods on Hénon–Heiles, two of them flows that ship; figures in out/
	$(BIN)/sympflow compare henon-heiles --methods $(DEMO) --t-end 1000 --out out/

test: .venv/installed-test  ## Lint, types and tests, side by side
	$(MAKE) --no-print-directory --jobs=2 lint pytest

# One thread for each of the two workers: on arrays as small as the tests' those of BLAS and torch only wait, spinning.
pytest: export OMP_NUM_THREADS = 1
pytest: .venv/installed-test  ## The tests alone, without the long ones
	$(BIN)/python -m pytest -n 2 --dist worksteal -m "not slow"

slow: export OMP_NUM_THREADS = 1
slow: .venv/installed-test  ## The long tests: documentation, benchmarks, properties, trainings, shipped figures
	$(BIN)/python -m pytest -n 2 --dist worksteal -m slow

lint: .venv/installed-test  ## Lint, types and the direction of imports
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports --no-cache

docs: .venv/installed-test  ## The documentation, into site/
	$(BIN)/python docs/diagrams.py
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet

dist: .venv/installed-test  ## Wheel and sdist in dist/, checked, and installed for each Python that is found
	rm -rf dist
	$(BIN)/python -m build
	$(BIN)/twine check --strict dist/*
	$(BIN)/python tests/installed.py dist

bench: .venv/installed  ## The figures that the docs quote, again, into docs/measured (hours on a quiet machine)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[bench]'
	$(BIN)/python benchmarks/again.py

clean:  ## Remove the environment and everything generated
	rm -rf .venv out site build dist .pytest_cache .mypy_cache .ruff_cache .hypothesis
