# Two commands do everything on a fresh machine with Python and make:
#   make run     the environment, then on the built-in ring: one orbit to the tunes, and a fault
#                that is measured, found, named and reported
#   make test    the environment, then the tests
PYTHON ?= python3
VENV ?= .venv
BIN = $(VENV)/bin
# A process for each processor. The tests of a file share its fixtures and stay in one process;
# files in their order: the long ones are not the last.
PARALLEL = --numprocesses logical --maxprocesses 8 --dist loadfile --no-loadscope-reorder
# What is imported is compiled once, not by each of the many processes that the tests start.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: run test test-all coverage check bench fuzz docs notebooks clean

run: $(VENV)/installed
	$(BIN)/tmlattice tune-fit
	$(BIN)/tmlattice simulate petra3 --effect "quadrupole_gradient qd::12 -0.05" --out first-run/day --force
	$(BIN)/tmlattice diagnose petra3 first-run/day --out first-run/report

test: $(VENV)/installed
	$(BIN)/python -m pytest -m "not slow" $(PARALLEL)

test-all: $(VENV)/installed
	$(BIN)/python -m pytest $(PARALLEL)

coverage: $(VENV)/installed
	$(BIN)/python -m pytest -m "not slow" $(PARALLEL) --cov --cov-report=term-missing:skip-covered

check: $(VENV)/installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# damaged inputs of every format, kills and full disks, pairs of outputs: half an hour
fuzz: $(VENV)/installed
	$(BIN)/python tests/fuzz/run.py 10000
	$(BIN)/python tests/fuzz/kills.py 200
	$(BIN)/python tests/fuzz/pairs.py 500

bench: $(VENV)/installed
	$(BIN)/python benchmarks/speed.py
	$(BIN)/python benchmarks/diagnosis.py
	$(BIN)/python benchmarks/rings.py

docs: $(VENV)/installed
	$(BIN)/mkdocs build --strict

notebooks: $(VENV)/installed
	$(BIN)/python notebooks/run.py

$(VENV)/installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --no-compile --constraint constraints.txt --editable '.[test]'
	touch $@

clean:
	rm -rf $(VENV) build dist site .pytest_cache .mypy_cache .ruff_cache .hypothesis
