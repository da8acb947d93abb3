# `make demo` and `make test` each set everything up first; a second call does nothing twice.
PYTHON ?= python3
BIN := .venv/bin
STAMP := .venv/set-up

.PHONY: help setup demo docs test lint format bench golden fuzz crash licences screenshots clean

help:  ## this list
	@awk -F ':.*## ' '/^[a-z]+:.*## / {printf "make %-11s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

setup: $(STAMP)  ## system libraries, .venv, pinned packages, depthba itself

$(STAMP): pyproject.toml constraints.txt setup/install.sh
	@PYTHON="$(PYTHON)" bash setup/install.sh
	@touch $@

demo: $(STAMP)  ## one scene from end to end: generate, register, evaluate, record
	@$(BIN)/depthba demo

docs: $(STAMP)  ## the site of the documentation, in build/site
	@NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict --quiet
	@echo 'build/site/index.html'

test: $(STAMP)  ## the fast tests
	@$(BIN)/pytest -n auto --maxprocesses 8

lint: $(STAMP)  ## ruff and mypy
	@$(BIN)/ruff check
	@$(BIN)/ruff format --check
	@$(BIN)/mypy
	@! grep -rnE '^ *import eval\.[a-z_.]+ *$$' --include='*.py' depthba sim rig eval tests \
		|| { echo 'that hides the builtin eval: write "from eval import …"'; exit 1; }

format: $(STAMP)  ## let ruff put the code into its form
	@$(BIN)/ruff check --fix
	@$(BIN)/ruff format

bench: $(STAMP)  ## the benchmarks
	@$(BIN)/pytest tests/benchmarks --benchmark-enable --benchmark-only

golden: $(STAMP)  ## solve the small problems anew whose answers are kept for every version
	@$(BIN)/python -m tests.golden.problems

fuzz: $(STAMP)  ## fuzz all that parses, MINUTES=10 for each target
	@OPENBLAS_NUM_THREADS=1 $(BIN)/python -m tests.fuzz --minutes $(or $(MINUTES),10)

crash: $(STAMP)  ## kill, fill and take away in mid-run, RUNS=10 each; table in docs/trust.md
	@OPENBLAS_NUM_THREADS=1 PYTHONPATH=. $(BIN)/python -m tests.crash --runs $(or $(RUNS),10)

licences: $(STAMP)  ## the licences of all packages, and whether they fit ours
	@$(BIN)/python setup/licences.py

screenshots: $(STAMP)  ## the pictures in docs/; needs chromium, xvfb, mesa-vulkan-drivers
	@$(BIN)/python docs/plot_pictures.py
	@$(BIN)/python docs/screenshots.py

clean:  ## remove .venv and what tools left; runs in logs/ stay
	@rm -rf .venv .mypy_cache .pytest_cache .ruff_cache .hypothesis .benchmarks build dist
	@find depthba sim rig eval tests -name __pycache__ -type d -prune -exec rm -rf {} +
