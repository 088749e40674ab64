# make demo   set everything up and align two simulated scans
# make test   set everything up and run linters and tests
# make clean  remove what these made

VENV ?= .venv
# The first Python that is new enough.
PYTHON ?= $(shell for python in python3 python3.13 python3.12 python3.11 python3.10; do \
	if $$python -c 'import sys; sys.exit(sys.version_info < (3, 10))' 2>/dev/null; then \
	echo $$python; break; fi; done)
BIN := $(VENV)/bin
# Only Open3D needs these (the baselines of `utopic bench`); aligning works without.
LIBRARIES := libusb-1.0.so.0 libGL.so.1 libEGL.so.1 libX11.so.6 libgomp.so.1
PACKAGES := libusb-1.0-0 libgl1 libegl1 libx11-6 libgomp1

.PHONY: demo test lint setup setup-dev clean

demo: setup
	$(BIN)/utopic demo --out-dir demo --overwrite

test: setup-dev lint
	$(BIN)/python -m pytest

lint: setup-dev
	$(BIN)/ruff check utopic_cli tests
	$(BIN)/ruff format --check utopic_cli tests
	$(BIN)/mypy
	$(BIN)/lint-imports

setup: $(VENV)/.installed
setup-dev: $(VENV)/.installed-dev

$(VENV)/.installed: pyproject.toml constraints.txt | $(VENV)/.created
	$(BIN)/python -m pip install --disable-pip-version-check -c constraints.txt -e .
	touch $@

$(VENV)/.installed-dev: pyproject.toml constraints.txt | $(VENV)/.created
	$(BIN)/python -m pip install --disable-pip-version-check -c constraints.txt -e '.[dev]'
	touch $@ $(VENV)/.installed

$(VENV)/.created:
	@test -n "$(PYTHON)" || { echo 'make: Python 3.10 or newer is needed (Debian: apt-get install python3 python3-venv)' >&2; exit 1; }
	@sh .ci/system_libraries.sh '$(PYTHON)' '$(LIBRARIES)' '$(PACKAGES)'
	$(PYTHON) -m venv $(VENV)
	touch $@

clean:
	rm -rf demo build dist .pytest_cache .mypy_cache .ruff_cache .import_linter_cache
