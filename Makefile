# make run   press the embedded patient's kidney, in a window or, without a display, into out/
# make test  everything that must hold before a change lands
# Each makes what it needs: an environment in .venv and, as root on Debian or Ubuntu, the system packages.

PYTHON ?= python3 python3.13 python3.12 python3.11
BIN := .venv/bin
ARGS ?=

.PHONY: run test clean
.DELETE_ON_ERROR:

run: .venv/.run
	@sh .ci/system-packages vulkan
	$(BIN)/python app.py rehearse $(ARGS)

test: .venv/.dev
	@sh .ci/system-packages vulkan window
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/python -m pytest -n 2 --dist worksteal

# The first of PYTHON that is there and of a version that Taichi has wheels for.
.venv/bin/python:
	@for python in $(PYTHON); do \
	    $$python -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))' 2>/dev/null || continue; \
	    $$python -c 'import ensurepip, venv' 2>/dev/null || sh .ci/system-packages venv; \
	    exec $$python -m venv .venv; \
	done; \
	echo "Nephron needs Python 3.11, 3.12 or 3.13, found none; install one or name it: make PYTHON=/path/to/python3.12"; exit 1

.venv/.run: requirements.txt .venv/bin/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -r requirements.txt
	@touch $@

.venv/.dev: requirements-dev.txt .venv/.run
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -r requirements-dev.txt
	@touch $@

clean:
	rm -rf .venv .cache out
