# For users: `make demo`, `make test` and `make docs`.  The other targets are for developers.

PYTHON ?= python3
BIN := .venv/bin

SERIES := $(shell sed -n 's/^version = "\([0-9]*\.[0-9]*\)\..*/\1/p' pyproject.toml)

.PHONY: demo test test-integrations test-lerobot docs tutorials site docs-version check bench format clean constraints tables dist

demo: .venv/installed           ## learn the swing-up; writes pictures and policy to runs/demo
	rm -rf runs/demo
	$(BIN)/kreps train kreps/SwingUp-v0 --iterations 20 --seed 0 --out runs/demo

test: .venv/installed           ## all tests
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest -n 2

# These libraries are large and change often, so they are in no other environment.
test-integrations: test-lerobot ## tests beside Optuna, Stable-Baselines3, TensorBoard, W&B, MLflow and others
	$(PYTHON) -m venv build/integrations
	build/integrations/bin/python -m pip install --quiet --disable-pip-version-check pytest \
	  -e ".[interop,mlflow,tensorboard,tune,wandb]"
	build/integrations/bin/python -c "import huggingface_hub, mlflow, optuna, rliable, \
	  sqlalchemy, stable_baselines3, tensorboard, wandb"
	OPENBLAS_NUM_THREADS=1 build/integrations/bin/python -m pytest -rs \
	  tests/test_callbacks.py tests/test_interop.py tests/test_tuning.py

test-lerobot:                   ## LeRobot needs earlier versions of what the others are tested with
	$(PYTHON) -m venv build/lerobot
	build/lerobot/bin/python -m pip install --quiet --disable-pip-version-check pytest lerobot \
	  -e ".[lerobot]"
	build/lerobot/bin/python -c "import lerobot.datasets.lerobot_dataset"
	build/lerobot/bin/python -m pytest -rs tests/test_recording_formats.py -k lerobot

docs: tutorials site            ## run the tutorials, then build the documentation site in site/

tutorials: .venv/installed      ## run each tutorial; what it prints has to be what it shows
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest -q -n 2 tests/test_snippets.py -k test_a_tutorial

site: .venv/installed           ## the site alone; a broken link is an error
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build

docs-version: .venv/installed   ## commits the site of this version to the branch gh-pages; pushes nothing
	export PATH="$(CURDIR)/$(BIN):$$PATH" DOCS_VERSIONS=mike NO_MKDOCS_2_WARNING=1 && \
	  mike deploy --update-aliases $(SERIES) latest && mike set-default latest

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
