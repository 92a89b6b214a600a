# make run       press the embedded patient's kidney, in a window or, without a display, into out/
# make gpu       measure on each graphics card, in at most eight minutes, into out/gpu
# make test      everything that must hold before a change lands
# make lint      the part of it that reads the code and runs nothing
# make audit     whether anything pinned here is known to be vulnerable, as PyPI knows it
# make licences  the table of THIRD_PARTY.md anew
# Each makes what it needs: an environment in .venv and, as root on Debian or Ubuntu, the system packages.
# On Windows they are for Git's bash.

PYTHON ?= python3 python3.13 python3.12 python3.11 python
SCRIPTS := $(if $(filter Windows_NT,$(OS)),Scripts,bin)
BIN := .venv/$(SCRIPTS)
RELEASE := .cache/release/$(SCRIPTS)
SHIPPED := .cache/shipped/$(SCRIPTS)
# Python compiles what it imports, and stores it; to compile all that is installed takes as long as to install it.
INSTALL := -m pip install --quiet --disable-pip-version-check --no-compile
# The pip that comes with Python may take twice as long; where there is no newer one, it will do.
PIP := pip==26.3
# What the tests need is more than what a rehearsal needs.
PACKAGES := $(if $(filter test lint,$(MAKECMDGOALS)),requirements-dev,requirements)
unexport PYTHONDONTWRITEBYTECODE
ARGS ?=

# Packages of both kinds are installed at the same time; and the embedded patient is made while the code is checked.
MAKEFLAGS += --jobs=2

.PHONY: run gpu test lint driver screen audit licences clean
.DELETE_ON_ERROR:

run: driver .venv/.patient
	$(BIN)/python app.py rehearse $(ARGS)

gpu: driver .venv/.patient
	$(BIN)/python app.py study gpu --out out/gpu $(ARGS)

test: screen .venv/.patient lint
	$(BIN)/python -m pytest -n 2 --dist worksteal

lint: .venv/.$(PACKAGES)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# After the environment, for which a system package may be needed too: two installations would wait for one another.
driver: .venv/pyvenv.cfg
	@sh .ci/system-packages vulkan

screen: .venv/pyvenv.cfg
	@sh .ci/system-packages vulkan window

# Strict: a package that the service does not know is a failure, not a package without a fault.
audit: .cache/release/.tools
	$(RELEASE)/pip-audit --strict -r requirements-dev.txt -r requirements-release.txt

# In an environment of nothing else, so that the table has what requirements.txt brings and no more.
licences: .cache/release/.tools
	$(BIN)/python -m venv --clear .cache/shipped
	$(SHIPPED)/python $(INSTALL) -r requirements.txt
	sed '/^| Name/,$$d' THIRD_PARTY.md > .cache/shipped/THIRD_PARTY.md
	$(RELEASE)/pip-licenses --python $(SHIPPED)/python --from=mixed --format=markdown --with-urls >> .cache/shipped/THIRD_PARTY.md
	mv .cache/shipped/THIRD_PARTY.md THIRD_PARTY.md

# The first of PYTHON that is there and of a version that Taichi has wheels for.
.venv/pyvenv.cfg:
	@for python in $(PYTHON); do \
	    $$python -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))' 2>/dev/null || continue; \
	    $$python -c 'import ensurepip, venv' 2>/dev/null || sh .ci/system-packages venv; \
	    exec $$python -m venv .venv; \
	done; \
	echo "Nephron needs Python 3.11, 3.12 or 3.13, found none; install one or name it: make PYTHON=/path/to/python3.12"; exit 1

.venv/.$(PACKAGES): $(PACKAGES).txt requirements.txt .venv/pyvenv.cfg
	-@$(BIN)/python $(INSTALL) $(PIP)
	@echo "Installing what $(PACKAGES).txt names into .venv: 1.1 GB, one to six minutes, once."
	@$(BIN)/python $(INSTALL) -r $(PACKAGES).txt
	@touch .venv/.requirements $@

.venv/.patient: .venv/.$(PACKAGES)
	@echo "Making the embedded patient: fifteen seconds, once."
	-@$(BIN)/python -c "from scenes.phantom.embedded_patient import phantom_folder; phantom_folder()"
	@touch $@

.cache/release/.tools: requirements-release.txt .venv/pyvenv.cfg
	$(BIN)/python -m venv --clear .cache/release
	$(RELEASE)/python $(INSTALL) -r requirements-release.txt
	@touch $@

clean:
	rm -rf .venv .cache
