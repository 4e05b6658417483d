# One command per verb. `make demo` and `make test` set up all they need by themselves.
FITS := import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 14))
PYTHON ?= $(shell for one in python3.11 python3.12 python3.13 python3.14 python3; do \
  $$one -c '$(FITS)' 2>/dev/null && { command -v $$one; break; }; done)
VENV := .venv
BIN := $(VENV)/bin
RUNS ?= 4
MARKS ?= not proof and not browser
WORKERS ?= 4
TYPES := $(BIN)/mypy -p petrobot -p tests -p tools -p experiments
ROUNDS ?= 20
EXTRAS := test,oracle,opcua,ros2-dds,cluster,experiment,mcap,parquet,fast

# Empty means not set. The tests start about a thousand processes: without cached bytecode each of
# them compiles the sources again, which takes as long as all the rest of its start.
export PYTHONDONTWRITEBYTECODE :=

.PHONY: help demo test suite peers load proof lint style bench clean

help:
	@echo "make demo   set up, start the cell's nodes, catch $(RUNS) balls in real time, leave a report"
	@echo "make test   set up, check style and types, run the tests (goal: 6 minutes on two idle cores)"
	@echo "make suite  run the tests that need no browser (PYTHON, VENV: on another interpreter; MARKS: which)"
	@echo "make peers  run the tests beside other packages: oracles, ROS 2, OPC UA, Dask (1 GB of packages)"
	@echo "make load   repeat the tests that start processes $(ROUNDS) times while every core is busy (hours)"
	@echo "make proof  check every promised figure in full (hours; resumes where it stopped)"
	@echo "make bench  measure speed beside others, as ratios"
	@echo "make clean  remove the environment and all that was made"

$(VENV)/.ready: pyproject.toml constraints.txt
	@'$(PYTHON)' -c '$(FITS)' 2>/dev/null || { \
	  echo "petrobot needs CPython 3.11 to 3.14: set PYTHON=/path/to/python3.12"; exit 2; }
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e ".[test]"
	@touch $@

demo: $(VENV)/.ready
	$(BIN)/petrobot run catch_ball --up --runs $(RUNS) --report reports/demo

lint: style
	$(TYPES)

style: $(VENV)/.ready
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

# Types are checked beside the tests: one core would have nothing to do meanwhile.
test: style
	@$(TYPES) & types=$$!; $(BIN)/pytest -n 4 --dist worksteal -rs -m "not proof"; tests=$$?; \
	  wait $$types && exit $$tests

# What another interpreter has to pass, too: make suite PYTHON=python3.13 VENV=.venv-3.13
suite: $(VENV)/.ready
	$(BIN)/pytest -n $(WORKERS) --dist worksteal -rs -m "$(MARKS)"

# What `make test` skips, because it needs packages that petrobot does not.
peers: $(VENV)/.ready
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e ".[$(EXTRAS)]"
	$(BIN)/pytest -n 4 --dist worksteal -rs -m "not proof" \
	  $$(grep -rlE "importorskip|COMPILED|is not installed" tests --include="test_*.py")

load: $(VENV)/.ready
	$(BIN)/python -m tools.bench.under_load $(ROUNDS)

proof: $(VENV)/.ready
	$(BIN)/python -m tools.proof
	$(BIN)/pytest -n 2 -m proof

bench: $(VENV)/.ready
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e ".[test,bench,fast,oracle]"
	$(BIN)/python tools/bench/wire.py
	$(BIN)/python tools/bench/faults.py
	$(BIN)/python tools/bench/estop.py
	$(BIN)/python tools/bench/attacks.py
	$(BIN)/python tools/bench/journal.py
	$(BIN)/python tools/bench/durability.py
	$(BIN)/python -m tools.bench.analysis --write docs/figures-analysis.md
	$(BIN)/python -m tools.bench.learning

clean:
	rm -rf $(VENV) build *.egg-info reports runs .mypy_cache .ruff_cache .pytest_cache .hypothesis
