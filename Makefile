# pipeprog. `make help` lists what there is; everything lives in .venv, nothing is installed outside this folder.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
DEMO := out/demo
SECONDS ?= 600
SEED ?= 1

.DEFAULT_GOAL := help
.SHELLFLAGS := -eu -c
.DELETE_ON_ERROR:

# An environment holds absolute paths: one that was copied or moved here is made anew.
ifneq ($(shell cat $(VENV)/.home 2>/dev/null),$(CURDIR))
.PHONY: $(VENV)/.home
endif

INTERFACES := $(wildcard src/pipeprog_msgs/msg/*.msg src/pipeprog_msgs/srv/*.srv src/pipeprog_msgs/action/*.action)
PACKAGES := $(wildcard src/*/package.xml src/*/setup.py src/*/setup.cfg src/*/CMakeLists.txt src/*/launch/* src/*/config/*)

help: ## this list
	@sed -n 's/^\([a-z]*\):.*## /\1\t/p' $(firstword $(MAKEFILE_LIST)) | while IFS="$$(printf '\t')" read -r name what; do printf '  make %-12s %s\n' "$$name" "$$what"; done

setup: $(VENV)/.kernels $(if $(VIEW),$(VENV)/.view) $(if $(FLEET),$(VENV)/.fleet) $(if $(EXCHANGE),$(VENV)/.exchange) $(if $(VIDEO),$(VENV)/.video) ## environment with ROS 2 and the workspace, in .venv (PYTHON=python3.12 chooses the interpreter; VIEW=1 adds Open3D for pipeprog view, FLEET=1 Dask for pipeprog fleet, EXCHANGE=1 IFC and DXF, VIDEO=1 video in recordings)

$(VENV)/.home:
	@$(SHELL) setup/check.sh "$(PYTHON)"
	@echo "Making the environment in $(VENV) ..."
	@$(PYTHON) -m venv --clear $(VENV)
	@printf '%s' "$(CURDIR)" > $@

$(VENV)/.packages: $(VENV)/.home requirements.txt requirements-ros.txt requirements-dev.txt
	@echo "Installing the Python packages (a few hundred MB the first time) ..."
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check -r requirements.txt -r requirements-ros.txt -r requirements-dev.txt
	@touch $@

$(VENV)/.view: $(VENV)/.packages requirements-view.txt
	@$(SHELL) setup/check.sh "$(BIN)/python" view
	@echo "Installing Open3D (another 550 MB) ..."
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check -r requirements.txt -r requirements-view.txt
	@touch $@

$(VENV)/.fleet: $(VENV)/.packages requirements-fleet.txt requirements-fleet-dev.txt
	@echo "Installing Dask and the clients of object stores (another 150 MB) ..."
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check -r requirements.txt -r requirements-dev.txt -r requirements-fleet.txt -r requirements-fleet-dev.txt
	@touch $@

$(VENV)/.exchange: $(VENV)/.packages requirements-exchange.txt
	@echo "Installing IfcOpenShell and ezdxf (another 250 MB) ..."
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check -r requirements.txt -r requirements-exchange.txt
	@touch $@

$(VENV)/.video: $(VENV)/.packages requirements-video.txt
	@echo "Installing PyAV (another 100 MB) ..."
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check -r requirements.txt -r requirements-video.txt
	@touch $@

$(VENV)/.workspace: $(VENV)/.packages setup/build.sh setup/pipeprog_start.py $(wildcard setup/*_msgs/* setup/*_msgs/msg/* setup/*_msgs/action/*) $(INTERFACES) $(PACKAGES)
	@$(SHELL) setup/build.sh $(VENV)
	@touch $@

# What is changed later is compiled when it is first called.
$(VENV)/.kernels: $(VENV)/.workspace setup/compile.py
	@echo "Compiling what the surveys compute with (a minute and a half) ..."
	@$(BIN)/python setup/compile.py
	@touch $@

demo: setup ## the recording in bags/ through the node graph, and its report
	@$(BIN)/pipeprog replay bags/demo.mcap --boq bags/demo.boq.yaml --board bags/demo.board.yaml --out $(DEMO) --force
	@$(BIN)/pipeprog report $(DEMO) --out $(DEMO)/report.html --force

test: setup $(VENV)/.fleet ## unit and integration tests
	@$(BIN)/python -m pytest --numprocesses $$(nproc) --maxprocesses 4 --dist worksteal tests/unit tests/integration

lint: setup ## ruff and mypy
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@$(BIN)/mypy

fuzz: setup ## spoiled input for every reader, SECONDS=600 on SEED=1
	@$(BIN)/python -m tests.fuzz --seconds $(SECONDS) --seed $(SEED)

accuracy: setup ## accuracy against ground truth (slower than the tests)
	@$(BIN)/python -m pytest -s tests/accuracy

experiments: setup ## the paper's four experiments
	@$(BIN)/python -m benchmarks.experiments

docs: setup ## pages of all modules, from their docstrings, in out/docs
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check -r requirements-docs.txt
	@$(BIN)/python -m pdoc --docformat google --no-show-source --output-directory out/docs $(filter pipeprog pipeprog_%,$(filter-out %_msgs,$(notdir $(wildcard src/*))))

clean: ## remove what was built, the environment included
	@rm -rf $(VENV) build install log out

.PHONY: help setup demo test lint fuzz accuracy experiments docs clean
