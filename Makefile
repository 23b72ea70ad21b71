# make demo   sets up .venv, turns the embedded clip into a robot's motion, ends with pictures and numbers
# make test   unit tests and an end-to-end smoke test     make check  ruff and pyright
PYTHON ?= python3
ROBOT  ?= go1
DEMO   := demo
CLIP   := src/slomo/assets/walk

.PHONY: demo test slow check clean
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
