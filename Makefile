# `make demo` and `make test` need nothing but Python 3.11 or newer: each sets up .venv and LLVM on its first call.
# PYTHON=... names the Python to use.
BIN := .venv/bin
READY := .venv/.ready

.PHONY: help setup demo lint test coverage test-gpu test-slow docs docs-quick package-test bench bench-quick clean

help:
	@echo "make demo       a scanned room and 40 measurements: hybrid, ray tracing and interpolation compared"
	@echo "make test       lint, types, import order, tests, notebooks"
	@echo "make coverage   the share of lines that make test runs; minutes"
	@echo "make test-gpu   the tests that need a CUDA device"
	@echo "make test-slow  the tests and notebooks that take minutes"
	@echo "make docs       the documentation site with executed notebooks; minutes, then seconds for what has changed"
	@echo "make docs-quick the same without executing notebooks"
	@echo "make package-test  wheel and source distribution, tested in empty environments; minutes"
	@echo "make bench      every stored figure, run time against error among them; hours"
	@echo "make bench-quick  ratios of run times against the stored ones; a minute"
	@echo "make setup      only the set-up that the others begin with"
	@echo "make clean      remove .venv, caches and packages; runs stay"

setup: $(READY)
	@echo "ready; next: make demo, or . .venv/bin/activate and your own data (docs/howto/own-data.md)"

# Only what is declared in pyproject.toml can change what is installed.
$(READY): pyproject.toml .ci/setup.sh .ci/system.sh
	@PYTHON="$(PYTHON)" .ci/setup.sh
	@touch $@

demo: $(READY)
	$(BIN)/wrf-mi demo

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

# A worker for each core; four at most, of one to two gigabytes each. Notebooks take longest and begin first, so that no
# worker is left alone with one in the end; a file stays with one worker, whose tests share what its fixtures fitted.
TESTS := $(BIN)/pytest -n logical --maxprocesses 4 --dist loadfile --no-loadscope-reorder --nbmake notebooks tests

# The laboratory is traced first where it is not kept yet, so that no two workers do. A browser is installed for tests of
# pages: as root or with a sudo that asks nothing.
test: lint
	@.ci/test_programs.sh
	@$(BIN)/python -c 'import wrf_mi; wrf_mi.load("laboratory")'
	$(TESTS)

# Lines that other processes run, such as kernels of notebooks, are not counted.
coverage: $(READY)
	@.ci/test_programs.sh
	$(TESTS) --cov=wrf_mi --cov-report=term-missing:skip-covered

test-slow: $(READY)
	$(BIN)/pytest -m "slow and not gpu" --nbmake notebooks tests

test-gpu: $(READY)
	$(BIN)/pytest -m gpu

# Warnings are errors: missing pages, headings and files that a page refers to are warnings.
docs: $(READY)
	$(BIN)/sphinx-build -b html -W --keep-going docs docs/_build/html
	@echo "site: docs/_build/html/index.html"

docs-quick: $(READY)
	$(BIN)/sphinx-build -q -b html -W --keep-going -D execute_notebooks=0 docs docs/_build/html
	@echo "site: docs/_build/html/index.html"

package-test: $(READY)
	$(BIN)/python .ci/package_test.py

bench: $(READY)
	$(BIN)/wrf-mi bench

bench-quick: $(READY)
	$(BIN)/wrf-mi bench --quick

clean:
	rm -rf .venv build dist *.egg-info .coverage .pytest_cache .mypy_cache .ruff_cache .hypothesis .import_linter_cache docs/_build docs/notebooks docs/api
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
