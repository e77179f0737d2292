# A fresh machine needs two commands, `make demo` and `make test`. Both set up .venv first.
VENV := .venv
BIN := $(VENV)/bin
DEMO := build/demo
SHARED ?= ../shared
TAIL := $(SHARED)/reference/fishtail_fine_cells.npy
# BLAS threads would compete with the simulator's own.
export OPENBLAS_NUM_THREADS := 1

.PHONY: install demo test test-slow fuzz lint docs gallery wheel check-wheel real real-beam real-presets check-reference \
	bench-simulator bench-tracking bench-paper bench-capture bench-places bench-sim2real bench-labs bench-laws bench-mesh \
	bench-image bench-cluster bench-device laws clean

install: $(VENV)/installed $(VENV)/kernels

$(VENV)/installed: pyproject.toml constraints.txt
	python3 -m venv $(VENV) || (echo "the venv module is missing: apt-get install python3-venv" && false)
	$(BIN)/pip install --quiet --constraint constraints.txt --editable '.[dev]'
	touch $@

# numba does not notice that a kernel has changed in another file than its caller's, so all are compiled again.
$(VENV)/kernels: $(VENV)/installed $(shell find calibration capture rafl tracking -name "*.py")
	find capture calibration rafl tracking -name '*.nb[ci]' -delete
	touch $@

# From rendered videos of a simulated specimen to a fitted model, by the commands that a laboratory types.
demo: install
	rm -rf $(DEMO)
	$(BIN)/rafl-render datasets/specimens/canonical.yaml --out $(DEMO) --frames 80
	$(BIN)/rafl-calibrate $(DEMO)/calibration --out $(DEMO)/calib.yaml
	$(BIN)/rafl-track $(DEMO)/videos --calib $(DEMO)/calib.yaml --specimen datasets/specimens/canonical.yaml --out $(DEMO)/tracks
	$(BIN)/rafl-capture datasets/specimens/canonical.yaml $(DEMO)/tracks --recordings $(DEMO)/recordings.csv --out $(DEMO)/canonical.h5
	$(BIN)/rafl-fit $(DEMO)/canonical.h5 --out $(DEMO)/run
	$(BIN)/rafl-eval $(DEMO)/run $(DEMO)/canonical.h5

# Two workers of one thread each: kernels with several threads in each would compete for the cores.
test: install
	$(MAKE) --no-print-directory --jobs 2 --output-sync lint docs
	NUMBA_NUM_THREADS=1 OMP_NUM_THREADS=1 $(BIN)/pytest -n 2 --dist worksteal

# Long runs: 10,000 time steps, oscillations of 10 s, whole sweeps, fits of the real beam.
test-slow: install
	NUMBA_NUM_THREADS=1 OMP_NUM_THREADS=1 $(BIN)/pytest -m slow -n 2 --dist worksteal

# Type checkers look for rafl.tracking in the folder rafl; these links put it there.
build/types: $(VENV)/installed $(wildcard rafl/*)
	rm -rf $@ && mkdir -p $@/rafl
	ln -s $(addprefix $(CURDIR)/,$(wildcard rafl/*) calibration capture datasets tracking) $@/rafl/

lint: install build/types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy --num-workers 2

# The documentation site, in build/site; a broken link or reference is an error.
docs: install build/types
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build

# The pictures of the site's gallery, from the demonstration's output.
gallery: demo
	$(BIN)/rafl-render datasets/specimens/canonical.yaml --out $(DEMO)/rest --loads-g 0 --frames 12
	$(BIN)/rafl-calibrate $(DEMO)/rest/calibration --out $(DEMO)/rest/calib.yaml
	$(BIN)/rafl-track $(DEMO)/rest/videos --calib $(DEMO)/rest/calib.yaml --out $(DEMO)/rest/tracks
	$(BIN)/python docs/gallery.py $(DEMO)
	$(BIN)/python docs/gallery_review.py $(DEMO)
	$(BIN)/python docs/gallery_results.py $(DEMO)

# The package for other people's environments, in dist/.
wheel: install
	rm -rf dist build/lib build/bdist.*
	$(BIN)/pip wheel --quiet --no-deps --wheel-dir dist .

# The wheel beside Hugging Face's package `datasets`, in an environment of its own.
check-wheel: wheel
	rm -rf build/wheel && python3 -m venv build/wheel
	build/wheel/bin/pip install --quiet --constraint constraints.txt dist/rafl-*.whl
	build/wheel/bin/pip install --quiet datasets
	cd build && wheel/bin/python ../tests/check_wheel.py

# Tests that need the recordings and reference trajectories beside the checkout; skipped if they are absent.
real: install
	SHARED=$(SHARED) $(BIN)/pytest -m "real or reference" -rs

# Files of every format changed as damage and malice change them, and faults of the system (SEED=number for others).
fuzz: install
	OMP_NUM_THREADS=1 NUMBA_NUM_THREADS=1 PYTHONPATH=tests/helpers \
		$(BIN)/python tests/fuzz/fuzz.py --trials $(or $(TRIALS),1000) --seed $(or $(SEED),0)

# Elastic laws compared with tensile tests of silicone rubbers.
bench-laws: install
	$(BIN)/python tests/bench/laws.py $(SHARED)/real/rubber_tensile

# The derivatives of the package's elastic laws, from their energies.
laws: install
	$(BIN)/python -m rafl.fem.laws.generated

# The real beam with each recording held out in turn: baseline, system identification, RAFL.
real-beam: install
	$(BIN)/python tests/bench/clamped_beam.py $(SHARED)/real/clamped_beam --out build/clamped_beam

# The presets of the baseline simulator compared with the real beam, before and after identifying its material.
real-presets: install
	$(BIN)/python tests/bench/presets.py $(SHARED)/real/clamped_beam --out build/presets

# Our trajectories and gradients compared with those of the paper's simulator, all files of a folder (DIR=folder).
check-reference: install
	$(BIN)/python tests/reference/check.py $(or $(DIR),$(SHARED)/reference)

# Time of forward and backward steps compared with the authors', and its growth with mesh, batch and threads.
bench-simulator: install
	$(BIN)/python tests/bench/simulator.py $(SHARED)/reference

# Compiled kernels beside tensors on a graphics card (DEVICE=cuda:1, cpu), for growing batches and meshes.
bench-device: install
	$(BIN)/python tests/bench/device.py $(if $(DEVICE),--device $(DEVICE))

# Tracking and calibration on freshly rendered videos (SEED=number repeats one), compared with trackpy and OpenCV.
bench-tracking: install
	$(BIN)/python tests/bench/tracker.py $(if $(SEED),--seed $(SEED)) $(if $(wildcard $(SHARED)/real/clamped_beam),--real $(SHARED)/real/clamped_beam)

# The paper's sim-to-sim studies. They take hours and can be resumed; QUICK=1 runs a short form.
bench-paper: install
	$(BIN)/python tests/bench/paper.py $(if $(QUICK),--quick,--results datasets/results) $(if $(wildcard $(TAIL)),--tail-cells $(TAIL))

# The sim-to-real study with a stricter simulator as the laboratory. As long; QUICK=1 runs a short form.
bench-sim2real: install
	$(BIN)/python tests/bench/sim2real.py $(if $(QUICK),--size quick,--results datasets/results)

# Materials identified in two stand-in laboratories and carried to other shapes. Hours, resumable; QUICK=1 as well.
bench-labs: install
	$(BIN)/python tests/bench/labs.py $(if $(QUICK),--quick,--results datasets/results)

# The specimens' meshes compared with converged solutions.
bench-mesh: install
	$(BIN)/python tests/bench/mesh.py --results datasets/results

# The direct fit of the first frame compared with the sequence of forces of earlier work.
bench-capture: install
	$(BIN)/python tests/bench/first_frame.py

# A specimen whose dots are off their described places: are the places found, and E?
bench-places: install
	$(BIN)/python tests/bench/places.py

# One camera or two, compared in the image plane and in space; 95 % intervals from pixels; cameras that were touched.
bench-image: install
	$(BIN)/python tests/bench/image_objective.py
	$(BIN)/python tests/bench/unlike_material.py
	$(BIN)/python tests/bench/image_intervals.py
	$(BIN)/python tests/bench/moved_cameras.py

# Sixty small recordings by --on local and by SLURM with failures on the way (slurm-wlm and munge; root).
bench-cluster: install
	$(BIN)/python tests/bench/cluster.py

clean:
	rm -rf build $(VENV)
