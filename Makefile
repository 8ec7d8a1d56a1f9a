# The two commands of a newcomer are `make demo` and `make test`; both make .venv first.
# PYTHON is left to the user: it names the interpreter that setup makes .venv with.
RUN := .venv/bin/python
DEMO_ARGS ?=
PYTEST_ARGS ?=
# Containers often forbid bytecode: every program would compile all that it imports at each start.
unexport PYTHONDONTWRITEBYTECODE
MYPY = $(RUN) -m mypy --num-workers $(shell nproc)
# Three processes for two cores: a third of the time tests wait for units, nodes and discovery.
WORKERS := -n $(shell expr \( 3 \* $$(nproc) + 1 \) / 2) --maxprocesses 6
BENCH_ARGS ?=

BENCHES := $(subst _,-,$(patsubst benchmarks/bench_%.py,%,$(wildcard benchmarks/bench_*.py)))

.DEFAULT_GOAL := help
.PHONY: help setup demo test test-noble docs docs-serve pages animation check lint format types imports pytest $(BENCHES:%=bench-%) faults soak fuzz fuzz-nodes mutants clean

help: ## show this list
	@awk -F ':.*## ' '/^[a-z%-]+:.*## / {printf "  make %-14s %s\n", $$1, $$2}' Makefile
	@printf '  make %s\n' $(BENCHES:%=bench-%)

setup: ## install everything into .venv; all other targets do this first
	@scripts/setup.sh

demo: setup ## stream a virtual L2 through the driver (DEMO_ARGS="--help" for more)
	@$(RUN) -m l2lidar_node.demo $(DEMO_ARGS)

# Tests that wait for units and nodes leave time enough for mypy, which takes only what is left over.
test: lint imports ## the whole gate: lint, format, types, imports, tests
	@$(MAKE) --no-print-directory --jobs 2 MYPY="nice $(RUN) -m mypy" types pytest

test-noble: ## the tests with the versions of Ubuntu 24.04, on Python 3.11 and 3.12 if found
	@scripts/test_noble.sh $(PYTEST_ARGS)

check: lint types imports ## the gate without the tests

lint: setup
	$(RUN) -m ruff check .
	$(RUN) -m ruff format --check .

types: setup
	$(MYPY)

imports: setup
	.venv/bin/lint-imports

pytest: setup
	$(RUN) -m pytest $(WORKERS) $(PYTEST_ARGS)

format: setup ## format all Python files
	$(RUN) -m ruff check --fix-only .
	$(RUN) -m ruff format .

docs: setup pages ## the documents as a site with search and API pages, in site/
	$(RUN) -m mkdocs build --quiet

docs-serve: docs ## the same at http://127.0.0.1:8000, rebuilt at every change
	$(RUN) -m mkdocs serve

pages: setup ## generate config/ and docs/parameters.md from the settings
	$(RUN) -m scripts.make_reference

animation: setup ## draw README's animation (docs/demo.gif)
	$(RUN) -m benchmarks.animation

$(BENCHES:%=bench-%): bench-%: setup
	$(RUN) -m benchmarks.bench_$(subst -,_,$*) $(BENCH_ARGS)

faults: setup ## every fault of the virtual L2, and the driver's reaction
	$(RUN) -m benchmarks.faults $(BENCH_ARGS)

soak: setup ## a long run, monitored for memory growth, loss and drift
	$(RUN) -m benchmarks.soak $(BENCH_ARGS)

fuzz: setup ## hostile input for everything that reads external input
	$(RUN) -m benchmarks.fuzz $(BENCH_ARGS)

mutants: setup ## small changes of the pure core: does a test notice each?
	$(RUN) -m benchmarks.mutants $(BENCH_ARGS)

fuzz-nodes: setup ## hostile messages, calls and parameters for the nodes, over DDS
	$(RUN) -m benchmarks.fuzz_nodes $(BENCH_ARGS)

clean: ## remove .venv and everything built, measured or cached
	rm -rf .venv .venv-noble-* build install log out site *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis \
		.import_linter_cache
