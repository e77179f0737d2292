# `make demo` and `make test` are all a fresh machine needs; both set up .venv first.
VENV := .venv
BIN := $(VENV)/bin
DEMO := build/demo
SHARED ?= ../shared
TAIL := $(SHARED)/reference/fishtail_fine_cells.npy
# BLAS threads fight the simulator's own.
export OPENBLAS_NUM_THREADS := 1

.PHONY: install demo test lint real real-beam real-presets check-reference bench-simulator bench-tracking bench-paper bench-capture bench-sim2real clean

install: $(VENV)/installed $(VENV)/kernels

$(VENV)/installed: pyproject.toml constraints.txt
	python3 -m venv $(VENV) || (echo "the venv module is missing: apt-get install python3-venv" && false)
	$(BIN)/pip install --quiet --constraint constraints.txt --editable '.[dev]'
	touch $@

# A compiled kernel that is kept does not know that one which it calls has changed in another file.
$(VENV)/kernels: $(VENV)/installed $(shell find calibration capture rafl tracking -name "*.py")
	find capture calibration rafl tracking -name '*.nb[ci]' -delete
	touch $@

# From a simulated specimen on film to a fitted model, by the commands a lab types.
demo: install
	rm -rf $(DEMO)
	$(BIN)/rafl-render datasets/specimens/canonical.yaml --out $(DEMO) --frames 80
	$(BIN)/rafl-calibrate $(DEMO)/calibration --out $(DEMO)/calib.yaml
	$(BIN)/rafl-track $(DEMO)/videos --calib $(DEMO)/calib.yaml --specimen datasets/specimens/canonical.yaml --out $(DEMO)/tracks
	$(BIN)/rafl-capture datasets/specimens/canonical.yaml $(DEMO)/tracks --recordings $(DEMO)/recordings.csv --out $(DEMO)/canonical.h5
	$(BIN)/rafl-fit $(DEMO)/canonical.h5 --out $(DEMO)/run --epochs 16
	$(BIN)/rafl-eval $(DEMO)/run $(DEMO)/canonical.h5

# Two workers of one thread each: kernels of several threads in each would fight over the cores.
test: install lint
	NUMBA_NUM_THREADS=1 OMP_NUM_THREADS=1 $(BIN)/pytest -n 2 --dist worksteal

lint: install
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# What needs the recordings and trajectories beside the checkout; skipped where they are absent.
real: install
	SHARED=$(SHARED) $(BIN)/pytest -m "real or reference" -rs

# The real beam, each recording held out in turn: original, SysID, RAFL.
real-beam: install
	$(BIN)/python tests/bench/clamped_beam.py $(SHARED)/real/clamped_beam --out build/clamped_beam

# Presets of the untouched simulator beside the real beam, before and after identifying its material.
real-presets: install
	$(BIN)/python tests/bench/presets.py $(SHARED)/real/clamped_beam --out build/presets

# Trajectories and gradients of the paper's own simulator, every file in a folder: make check-reference DIR=...
check-reference: install
	$(BIN)/python tests/reference/check.py $(or $(DIR),$(SHARED)/reference)

# Speed of forward and backward steps beside the authors', and how it grows with mesh, batch and threads.
bench-simulator: install
	$(BIN)/python tests/bench/simulator.py $(SHARED)/reference

# Tracking and calibration on footage made fresh (SEED=number for the same again), beside trackpy and OpenCV.
bench-tracking: install
	$(BIN)/python tests/bench/tracker.py $(if $(SEED),--seed $(SEED)) $(if $(wildcard $(SHARED)/real/clamped_beam),--real $(SHARED)/real/clamped_beam)

# The paper's sim-to-sim studies, hours: make bench-paper; QUICK=1 for a short form. Resumable.
bench-paper: install
	$(BIN)/python tests/bench/paper.py $(if $(QUICK),--quick,--results datasets/results) $(if $(wildcard $(TAIL)),--tail-cells $(TAIL))

# The sim-to-real study with a stricter simulator as the lab, hours: make bench-sim2real; QUICK=1 for a short form.
bench-sim2real: install
	$(BIN)/python tests/bench/sim2real.py $(if $(QUICK),--quick,--results datasets/results)

# The first frame: the direct fit beside the sequence of forces of earlier work.
bench-capture: install
	$(BIN)/python tests/bench/first_frame.py

clean:
	rm -rf build $(VENV)
