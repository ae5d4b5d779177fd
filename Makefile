# Two commands do everything on a machine that has Python 3.10 to 3.14 and make:
#   make run    install, map the built-in room, show the results
#   make test   install what the tests need, then lint, type-check and test on every backend there is
# While working, `make check` lints, type-checks and runs all tests that start neither Taichi nor a process and need no
# large recording, and one test with kernels for each mapping method.

VENV ?= .venv
BIN := $(VENV)/bin
OUT ?= runs/demo
SOURCE ?= synthetic:room

# The first interpreter that answers, is of a supported version and can make virtual environments. Python 3.14 comes
# after those that Taichi has wheels for.
USABLE := import ensurepip, sys, venv; sys.exit(not (3, 10) <= sys.version_info[:2] <= (3, 14))
CANDIDATES := python3.13 python3.12 python3.11 python3.10 python3.14 python3 python
PYTHON ?= $(shell for python in $(CANDIDATES); do \
	$$python -c "$(USABLE)" >/dev/null 2>&1 && { echo $$python; break; }; done)

# Python keeps the compiled modules of the package and of its tests, whatever the shell says: each start without
# them takes seconds more, and the tests start hundreds of processes.
export PYTHONDONTWRITEBYTECODE :=

.PHONY: run check test soak lint style wheel clean

run: $(VENV)/.installed
	@$(BIN)/taichi-mrf map "$(SOURCE)" --out "$(OUT)"

check: style
	@$(BIN)/python tests/backends.py --quick -r fE

test: style
	@$(BIN)/python tests/backends.py

soak: $(VENV)/.installed-dev
	@$(BIN)/python -m pytest -m soak

lint: style
	$(BIN)/mypy

style: $(VENV)/.installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

# For a release: wheel and source in dist/, checked and tried on each Python of the PATH, or on those of TRY.
wheel: $(VENV)/.created
	$(BIN)/python release/try_wheel.py $(TRY)

clean:
	rm -rf $(VENV) dist .mypy_cache .pytest_cache .ruff_cache .hypothesis *.egg-info

$(VENV)/.created:
	@test -n "$(PYTHON)" || { \
		echo "No Python 3.10 to 3.14 with the venv module was found (tried: $(CANDIDATES))." >&2; \
		echo "Install one (Debian and Ubuntu: apt install python3-venv), or: make PYTHON=/path/to/python" >&2; \
		exit 1; }
	$(PYTHON) -m venv $(VENV)
	@touch $@

# Modules are compiled when they are first imported, not when they are installed: most never are.
PIP = $(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile

$(VENV)/.installed: $(VENV)/.created pyproject.toml
	$(PIP) -e .
	@touch $@

# At once if this Python has wheels for all of it, else extra by extra.
$(VENV)/.installed-dev: $(VENV)/.created pyproject.toml
	$(PIP) -e ".[dev,octomap,quadrants]" 2>/dev/null || { \
		$(PIP) -e ".[dev]" || exit 1; \
		$(PIP) -e ".[octomap]" 2>/dev/null \
			|| echo "OctoMap (extra: octomap) has no wheel for this Python: its comparison is left out."; \
		$(PIP) -e ".[quadrants]" 2>/dev/null \
			|| echo "Quadrants (extra: quadrants) has no wheel for this Python: tests of the second compiler are left out."; \
	}
	@$(PIP) --no-deps "ouster-sdk>=1.0" 2>/dev/null \
		|| echo "ouster-sdk (extra: ouster) has no wheel for this Python: tests of real recordings are left out."
	@touch $(VENV)/.installed $@
