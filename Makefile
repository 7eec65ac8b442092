# Every target installs what it needs into .venv first; a second call finds it installed.

VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --quiet --disable-pip-version-check
# PyPI's torch for Linux brings gigabytes of CUDA; without an NVIDIA driver the CPU build will do.
TORCH_INDEX ?= https://download.pytorch.org/whl/cpu
# Tests also wait, for servers, browsers and processes; so one process more than there are cores.
TEST_PROCESSES ?= $(shell expr $$(nproc 2>/dev/null || sysctl -n hw.ncpu) + 1)
# Each process would otherwise rewrite the assertions of all tests anew, where a shell forbids bytecode.
PYTEST := PYTHONDONTWRITEBYTECODE= $(BIN)/python -m pytest -n $(TEST_PROCESSES) --no-loadscope-reorder
DIST := dist
SELECT ?= not slow and not gpu and not browser and not ci

.DEFAULT_GOAL := help
.PHONY: help install demo test test-all lint format types lowest docs site build clean

help:  ## List the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## /{printf "  make %-10s %s\n", $$1, $$2}' Makefile

install: $(VENV)/installed-all  ## Install acwm with all extras and the tools of development
	@echo "acwm is installed in $(VENV): source $(BIN)/activate, then acwm list"

demo: $(VENV)/installed-rigid  ## Simulate, train, evaluate and report, at small scale
	$(BIN)/acwm demo

test: $(VENV)/installed-all  ## Run the tests, but for slow ones and those that only .ci/run runs
	$(PYTEST) -m "$(SELECT)"

test-all: $(VENV)/installed-all  ## Run all tests
	$(PYTEST)

lint: $(VENV)/installed-all  ## Check style, formatting and who may import whom
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports --no-logo

format: $(VENV)/installed-all  ## Format the code and fix what ruff can fix
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

types: $(VENV)/installed-all  ## Check types
	$(BIN)/pyright --pythonpath $(BIN)/python

lowest:  ## Install the lowest versions that are declared, elsewhere, and use them
	TORCH_INDEX="$(TORCH_INDEX)" .ci/lowest

docs: $(VENV)/installed-all  ## Draw the pictures of docs/reference/environments.md anew
	$(BIN)/python docs/build_environments.py

site: $(VENV)/installed-all  ## Build the site of the documents in site/
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict --quiet

build: $(VENV)/installed-all  ## Build the wheel, that of the models and the source distribution in dist/
	$(BIN)/python -m build --outdir $(DIST)
	$(BIN)/python -m build --wheel --outdir $(DIST) plugins/acwm_zoo/models
	$(BIN)/twine check --strict $(DIST)/*

clean:  ## Remove what the other targets made, but neither data/ nor runs/
	rm -rf $(VENV) dist build site .pytest_cache .ruff_cache .import_linter_cache

# pip is written last, so an interrupted creation is begun anew.
$(BIN)/pip:
	@for python in "$(PYTHON)" python3.11 python3.12 python3.13 python3; do \
	  if "$$python" -c 'import sys; sys.exit(not (3, 11) <= sys.version_info < (3, 14))' 2>/dev/null; then \
	    echo "creating $(VENV) with $$("$$python" --version)"; \
	    exec "$$python" -m venv $(VENV); \
	  fi; \
	done; \
	echo "acwm needs Python 3.11, 3.12 or 3.13: install one, or name it: make PYTHON=/path/to/python3.11" >&2; exit 2

# Taichi, which renders, links to libX11 even where there is no screen.
$(VENV)/checked: $(BIN)/pip
	@$(BIN)/python -c 'import ctypes, sys; sys.platform != "linux" or ctypes.CDLL("libX11.so.6")' \
	  2>/dev/null || { echo "libX11 is missing: sudo apt-get install libx11-6" >&2; exit 2; }
	@touch $@

$(VENV)/torch: $(VENV)/checked constraints.txt
	@echo "installing torch, some hundred megabytes (a minute or more)"
	@if [ "$$(uname)" = Linux ] && ! command -v nvidia-smi >/dev/null; then \
	  $(PIP) --retries 0 --timeout 15 install -c constraints.txt torch --extra-index-url $(TORCH_INDEX) 2>/dev/null \
	    || $(PIP) install -c constraints.txt torch; \
	else \
	  $(PIP) install -c constraints.txt torch; \
	fi
	@touch $@

$(VENV)/installed-rigid: $(VENV)/torch pyproject.toml
	@echo "installing acwm with the simulators of rigid bodies: acwm[rigid] (a minute or more)"
	@$(PIP) install -c constraints.txt -e '.[rigid]'
	@touch $@

$(VENV)/installed-all: $(VENV)/torch pyproject.toml
	@echo "installing acwm with all extras and the tools of development: acwm[all,dev,docs] (minutes)"
	@$(PIP) install -c constraints.txt -e '.[all,dev,docs]'
	@touch $@ $(VENV)/installed-rigid
