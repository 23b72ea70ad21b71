# make demo   sets up .venv, turns the embedded clip into a robot's motion, ends with pictures and numbers
# make test   unit tests and an end-to-end smoke test     make check  ruff and pyright
# make train-prior   pictures, then the networks of src/slomo/prior/weights, from nothing: about an hour on two cores
# make bench  the solvers of `slomo optimize` side by side, and with longer motions          (BENCH="--cap 60 --json")
# make bench-mpc     one tick of the controller beside QP solvers and Fatrop             (BENCH="--minutes 10": memory, drift)
# make bench-random  spoiled key points through retarget and optimize: verified, refused, or neither  (BENCH="--count 20")
# make bench-prior   those networks, alone and over a clip, against truth      (WEIGHTS=folder: others; BENCH="--truth ... --projects ...")
# make bench-parts   reconstruction without each of its parts
# make bench-terms   reconstruction with and without each term of the prior   (BENCH="--seeds 5 --terms some")
# make bench-clips   reconstruction over rendered clips of many kinds, a table     (BENCH="--only gallop --jobs 2")
# make bench-robust  reconstruction from spoiled masks, cameras, frames and bones
# make conformance   the robot's wire format against its vendor's own SDK, on loopback; skipped where pip has no such SDK
PYTHON ?= python3
ROBOT  ?= go1
DEMO   := demo
CLIP   := src/slomo/assets/walk
KINDS  := quadruped human
STEPS_quadruped := 8500
STEPS_human     := 7000
PRIOR  := prior-training
SHIPPED := src/slomo/prior/weights

.PHONY: demo test slow check conformance clean train-prior bench bench-mpc bench-random bench-prior bench-terms bench-parts bench-clips bench-robust \
  $(KINDS:%=train-%)
.DELETE_ON_ERROR:

demo: .venv/run.stamp
	.venv/bin/slomo --project $(DEMO) run $(CLIP)/clip.mp4 --truth $(CLIP)/truth.npz --robot $(ROBOT)

test: .venv/dev.stamp
	.venv/bin/python -m pytest

slow: .venv/dev.stamp
	.venv/bin/python -m pytest -m slow

check: .venv/dev.stamp
	.venv/bin/ruff check .
	.venv/bin/ruff format --check .
	.venv/bin/pyright

conformance: .venv/dev.stamp
	-.venv/bin/pip install --quiet --disable-pip-version-check --no-deps unitree-legged-sdk
	.venv/bin/python -m pytest tests/conformance_go1.py || test $$? -eq 5  # 5: skipped

# One kind a core; stopped at any time, the same command goes on.
train-prior: .venv/dev.stamp
	$(MAKE) --jobs=2 $(KINDS:%=train-%)
	mkdir -p $(SHIPPED)
	cp $(foreach kind,$(KINDS),$(PRIOR)/$(kind).onnx $(PRIOR)/$(kind).json $(PRIOR)/$(kind).csv) $(SHIPPED)
	$(foreach kind,$(KINDS),cp $(PRIOR)/$(kind).png docs/training-$(kind).png;)

$(KINDS:%=train-%): train-%: .venv/dev.stamp
	.venv/bin/slomo dataset $(PRIOR)/data --kind $* --samples 9600
	OMP_NUM_THREADS=1 .venv/bin/python -m slomo.prior.train $(PRIOR)/data $(PRIOR) --kind $* --steps $(STEPS_$*)

bench: .venv/dev.stamp
	OMP_NUM_THREADS=1 .venv/bin/python tests/bench_optimize.py $(BENCH)

bench-mpc: .venv/dev.stamp
	OMP_NUM_THREADS=1 .venv/bin/python tests/bench_mpc.py $(BENCH)

bench-random: .venv/dev.stamp
	OMP_NUM_THREADS=1 .venv/bin/python tests/bench_random.py $(BENCH)

bench-prior: .venv/dev.stamp
	OMP_NUM_THREADS=1 .venv/bin/python tests/bench_prior.py $(if $(WEIGHTS),--weights $(WEIGHTS)) $(BENCH)

bench-terms: .venv/dev.stamp
	.venv/bin/python tests/bench_terms.py bench $(BENCH)

bench-parts: .venv/dev.stamp
	.venv/bin/python tests/bench_terms.py bench --terms parts $(BENCH)

bench-clips: .venv/dev.stamp
	.venv/bin/python tests/bench_clips.py bench $(BENCH)

bench-robust: .venv/dev.stamp
	OMP_NUM_THREADS=1 .venv/bin/python tests/bench_robust.py bench $(BENCH)

.venv/run.stamp: pyproject.toml
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "slomo needs Python 3.11 or newer: make PYTHON=python3.11")'
	$(PYTHON) -m venv .venv
	.venv/bin/pip install --quiet --disable-pip-version-check -e .
	touch $@

.venv/dev.stamp: .venv/run.stamp
	.venv/bin/pip install --quiet --disable-pip-version-check -e '.[dev]'
	touch $@

clean:
	rm -rf .venv $(DEMO)
