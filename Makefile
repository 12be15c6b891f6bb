# Every target that needs the environment makes it first; that returns at once when nothing
# changed. Options: PYTHON=/path/to/python3, EXTRAS=..., ARGS='more arguments for the tool'.

SHELL := /bin/sh
TOOL := .venv/bin/beetle_omni
RUN := $(shell date +%Y%m%d_%H%M%S)
ARGS ?=
GAP := runs_out/gap

# Marks of another virtual environment with ROS wheels (see .ci/setup).
ifdef _ROS_WHEELS_BOOTSTRAP_COMPLETE
unexport LD_LIBRARY_PATH
endif
unexport _ROS_WHEELS_BOOTSTRAP_COMPLETE PYTHONHOME VIRTUAL_ENV

.PHONY: help setup setup-train fly test oldest lint docs evaluate compare faults gap report clean

help:  ## this list
	@sed -n 's/^\([a-z]*\):.*## /\1|/p' Makefile | awk -F'|' '{printf "  make %-10s %s\n", $$1, $$2}'

setup:  ## make .venv with all but training (also: PYTHON=..., EXTRAS=...)
	@PYTHON='$(PYTHON)' .ci/setup

setup-train:  # the same with what training needs
	@PYTHON='$(PYTHON)' .ci/setup train

fly: setup  ## fly the waypoints through ROS nodes, seen in the browser; bag and film in runs_out/
	$(TOOL) fly --controller nmpc --task waypoints --alone --view $(ARGS)

test: setup-train  ## the whole test suite
	@.ci/test $(ARGS)

oldest: setup  ## the commands with the oldest versions that setup.py admits
	@.ci/oldest

lint: setup  ## style of every Python file, types of the core
	@.venv/bin/ruff check .
	@.venv/bin/python -m mypy

docs: setup  ## the site with reference pages from the code, all links checked; to build/site/
	.venv/bin/python -m mkdocs build --strict
	@echo 'files: build/site/index.html'
	@echo 'next:  .venv/bin/python -m http.server --directory build/site'

evaluate: setup  ## 100 random poses, in one process and faster than real time
	@mkdir -p runs_out
	$(TOOL) evaluate --controllers nmpc --task random100 --json runs_out/evaluate_$(RUN).json $(ARGS)

compare: setup  ## every experiment for RL and NMPC, to docs/comparison/; continues an interrupted run
	@mkdir -p docs/comparison runs_out
	$(TOOL) compare --output docs/comparison --cache runs_out/comparison $(ARGS)

faults: setup  ## every listed fault from hover, on the move, upside down; to runs_out/faults/ (ARGS='--seeds 10')
	@mkdir -p runs_out
	$(TOOL) faults --output runs_out/faults $(ARGS)

gap: setup  ## hide a drag and slow rotors, fly, identify them, fly both controllers corrected; to runs_out/gap/
	@rm -rf $(GAP) && mkdir -p $(GAP)
	@printf 'extends: $(CURDIR)/params/robot.yaml\neffects: {rotor_drag: {coefficient: 1.2}, rotor_lag: {time_constant: 0.13}}\n' \
	    >$(GAP)/plant.yaml
	for seed in 1 2 3; do $(TOOL) evaluate --controllers nmpc --task random8 --seed $$seed \
	    --plant $(GAP)/plant.yaml --bag $(GAP)/flight$$seed || exit; done
	$(TOOL) improve $(GAP)/flight1 $(GAP)/flight2 $(GAP)/flight3 --plant $(GAP)/plant.yaml \
	    --output $(GAP) $(ARGS)

report: setup  ## one HTML page about the runs in runs_out/ (or RUNS='DIR...')
	@runs='$(RUNS)'; for bag in runs_out/*/metadata.yaml; do \
	    [ -n '$(RUNS)' ] || [ ! -f "$$bag" ] || runs="$$runs $${bag%/*}"; done; \
	if [ -z "$$runs" ]; then echo 'no runs in runs_out/: make fly first, or RUNS=DIR' >&2; exit 2; fi; \
	mkdir -p runs_out; $(TOOL) report $$runs --output runs_out/report.html $(ARGS)

clean:  ## remove the environment and files of builds and tools; keep runs_out/
	rm -rf .venv build install log dist *.egg-info .mypy_cache .pytest_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
