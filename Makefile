# For users: `make demo`, `make test` and `make docs`.  The other targets are for developers.

PYTHON ?= python3
BIN := .venv/bin

.PHONY: demo test docs check bench format clean constraints tables dist

demo: .venv/installed           ## learn the swing-up; writes pictures and policy to runs/demo
	rm -rf runs/demo
	$(BIN)/kreps train kreps/SwingUp-v0 --iterations 20 --seed 0 --out runs/demo

test: .venv/installed           ## all tests
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest -n 2

docs: .venv/installed           ## the documentation site in site/; a broken link is an error
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build

check: .venv/installed          ## formatter, linter, types, import contracts, stale results
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/python docs/stale_results.py

bench: .venv/installed          ## benchmarks of speed; writes results/benchmarks.md
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest benchmarks --record=results

format: .venv/installed
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

# Installs the exact versions of constraints.txt, checked by hash.
.venv/installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r constraints.txt
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation -e .
	touch $@

constraints:                    ## update constraints.txt (needs uv)
	uv pip compile pyproject.toml --extra dev --extra bench --extra docs --universal --generate-hashes \
	  --no-annotate --no-header --upgrade --quiet -o constraints.txt

tables:                         ## write the tables of results/ into the documentation pages
	$(PYTHON) docs/fill_tables.py

dist: .venv/installed           ## wheel and sdist in dist/, checked for the package index
	rm -rf dist build/twine
	$(BIN)/python -m hatchling build
	$(PYTHON) -m venv build/twine
	build/twine/bin/python -m pip install --quiet --disable-pip-version-check "twine>=6.1"
	build/twine/bin/python -m twine check --strict dist/*

clean:
	rm -rf .venv runs build dist site .mypy_cache .ruff_cache .pytest_cache .hypothesis
