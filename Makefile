SHELL := bash
.SHELLFLAGS := -euo pipefail -c
.DEFAULT_GOAL := help
.PHONY: help setup install vulkan demo test bare check docs format types bench pins release

BIN := .venv/bin
# The folders that pyproject.toml maps under robomme_interference_data.
AREAS := $(filter-out robomme_interference_data,$(patsubst %/__init__.py,%,$(wildcard */__init__.py)))
# Compiled modules are kept: to compile torch and lerobot again in every process takes half a minute.
unexport PYTHONDONTWRITEBYTECODE
# Extra arguments for pytest, e.g. make test ARGS="-k loader".
ARGS ?=

help:  ## Print this list.
	@awk -F ':.*## ' '/^[a-z]+:.*## / {printf "make %-8s %s\n", $$1, $$2}' Makefile

setup: install  ## Install what is missing: packages in .venv, a Vulkan driver, Chromium.
	@scripts/system_packages.sh chromium

install:  ## Install all but what only tests need.
	@scripts/setup.sh
	@scripts/system_packages.sh vulkan

vulkan:  ## Install only the software Vulkan driver: sudo make vulkan.
	@scripts/system_packages.sh vulkan

demo: install  ## Set up, then show a lesson used, buried and found again.
	@$(BIN)/python scripts/demo.py

test: setup  ## Set up, then run the tests; ARGS="-m ''" adds the slow ones.
	@$(BIN)/pytest -n 2 --dist loadfile --no-loadscope-reorder $(ARGS)

bare: setup  ## Install the package without pins, newest and lowest versions, and use it.
	@PYTHONPATH=tests $(BIN)/python scripts/bare_install.py

check: setup types  ## Lint; check the format, the types and who imports whom.
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@$(BIN)/python scripts/plain_code.py
	@$(BIN)/mypy build/typecheck/robomme_interference_data
	@cd build/typecheck && $(CURDIR)/$(BIN)/lint-imports --config $(CURDIR)/pyproject.toml --no-logo

docs: setup  ## Build the documentation site, without a network, into build/docs.
	@$(BIN)/python -m sphinx --builder html --fail-on-warning --keep-going --quiet docs build/docs
	@echo "Open build/docs/index.html"

format: setup  ## Mend what ruff can mend.
	@$(BIN)/ruff check --fix .
	@$(BIN)/ruff format .

# Type checkers and import-linter do not follow the mapping of pyproject.toml: this lays the package
# out as it is installed, with hard links, as import-linter follows no folder that is a link.
types:
	@rm -rf build/typecheck
	@mkdir -p build/typecheck
	@cp -al robomme_interference_data build/typecheck/
	@cp -al $(AREAS) build/typecheck/robomme_interference_data/

bench: setup  ## Run every benchmark.
	@for file in $(sort $(wildcard benchmarks/*.py)); do echo "== $$file"; $(BIN)/python "$$file"; done

pins: setup  ## Remake requirements.txt; ARGS=--upgrade for newer versions.
	@$(BIN)/uv pip compile --quiet --universal --python-version 3.12 --all-extras --group dev \
	  --no-annotate --no-emit-index-url --no-emit-package opencv-python \
	  --custom-compile-command "make pins" --output-file requirements.txt pyproject.toml $(ARGS)

release: setup  ## Check and rehearse all of a release but its last steps: VERSION=1.0.0.
	@PYTHONPATH=tests $(BIN)/python scripts/release.py "$${VERSION:-}"
