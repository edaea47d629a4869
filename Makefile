# Two commands for a newcomer: `make demo` and `make test`. Python 3.11 or newer and make are all they need.
PYTHON ?= python3
VENV ?= .venv
PIP_ARGS ?=
BIN := $(VENV)/bin
# Three for two cores: a process often waits for the disk, or for programs that it has started.
JOBS ?= 3
# What Python and pytest make of the sources is kept, or each process of the tests makes it anew.
export PYTHONDONTWRITEBYTECODE :=
# One thread each, too. A file's tests share what they have made: one process runs them, in the
# order of tests/conftest.py.
PYTEST := OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n $(JOBS) --dist loadfile --no-loadscope-reorder

.PHONY: demo test test-all lint check format docs benchmark install clean
.DEFAULT_GOAL := demo

## Reconstruct the built-in scene: prints a table against the truth, leaves a picture in demo/.
demo: $(VENV)/installed
	$(BIN)/shapepose-fg demo --output demo

## Run the linter and the fast tests (of some folders only: `make test TESTS=tests/io`).
test: lint
	$(PYTEST) -m "not slow" $(TESTS)

## Run what CI runs: linter, type checker and all tests, with all extras installed (torch among them).
test-all: check
	$(PYTEST)

lint: $(VENV)/installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

check: lint $(VENV)/installed-all
	$(BIN)/basedpyright --pythonpath $(BIN)/python --level error

format: $(VENV)/installed
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

## Build the site into build/site, without a warning; no network once the extra is installed.
docs: $(VENV)/installed-docs
	$(BIN)/python -m sphinx -q -W --keep-going -b html -c docs . build/site
	@echo "open build/site/index.html"

## Seconds of whole commands and their stages (see scripts/benchmark.py --help).
benchmark: $(VENV)/installed
	$(BIN)/python scripts/benchmark.py

# Of what is installed, what is imported is compiled then, a quarter of it.
PIP := install -q --disable-pip-version-check --no-compile $(PIP_ARGS)
UV := $(BIN)/uv pip install -q --python $(BIN)/python $(PIP_ARGS)

# uv needs a quarter of pip's time. It does not know pip's settings: where they are needed, pip installs.
# What is compiled here would be compiled at the first start, or at every one where nothing can be written.
$(VENV)/installed: pyproject.toml constraints.txt
	@echo "installing into $(VENV), then compiling: some minutes, once"
	@test -x $(BIN)/python || $(PYTHON) -m venv --without-pip $(VENV)
	@$(PYTHON) -m pip --python $(BIN)/python $(PIP) uv && $(UV) -c constraints.txt -e ".[dev]" || \
		$(MAKE) --no-print-directory EXTRA=dev install
	@$(BIN)/python -m compileall -q -j $(JOBS) shapepose_fg factors
	-@$(BIN)/shapepose-fg compile
	@touch $@

$(VENV)/installed-docs: $(VENV)/installed
	$(MAKE) --no-print-directory EXTRA=docs install
	touch $@

# By pip: PyTorch comes from where its settings say, as a small build for processors.
$(VENV)/installed-all: $(VENV)/installed
	$(MAKE) --no-print-directory EXTRA=ci install
# Its OpenCV would replace the headless one.
	$(BIN)/python -m pip $(PIP) --no-deps trackeval==1.3.0
	touch $@

# The newest pip: older ones take twice as long to find out what to install.
install:
	$(PYTHON) -m pip --python $(BIN)/python $(PIP) pip || $(BIN)/python -m ensurepip
	$(BIN)/python -m pip $(PIP) -c constraints.txt -e ".[$(EXTRA)]"

clean:
	rm -rf $(VENV) demo build *.egg-info .pytest_cache .ruff_cache
