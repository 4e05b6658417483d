# One command per verb. `make demo` and `make test` set up all they need by themselves.
PYTHON ?= $(shell command -v python3.11 || command -v python3)
VENV := .venv
BIN := $(VENV)/bin
RUNS ?= 4
ROUNDS ?= 20

# Empty means not set. The tests start about a thousand processes: without cached bytecode each of
# them compiles the sources again, which takes as long as all the rest of its start.
export PYTHONDONTWRITEBYTECODE :=

.PHONY: help demo test load proof lint bench clean

help:
	@echo "make demo   set up, start the cell's nodes, catch $(RUNS) balls in real time, leave a report"
	@echo "make test   set up, check style and types, run the tests (goal: 6 minutes on two idle cores)"
	@echo "make load   repeat the tests that start processes $(ROUNDS) times while every core is busy (hours)"
	@echo "make proof  check every promised figure in full (hours; resumes where it stopped)"
	@echo "make bench  measure speed beside others, as ratios"
	@echo "make clean  remove the environment and all that was made"

$(VENV)/.ready: pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info[:2] != (3, 11))' || \
	  { echo "petrobot needs CPython 3.11: set PYTHON=/path/to/python3.11"; exit 2; }
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e ".[test]"
	@touch $@

demo: $(VENV)/.ready
	$(BIN)/petrobot run catch_ball --up --runs $(RUNS) --report reports/demo

lint: $(VENV)/.ready
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy -p petrobot -p tests -p tools

test: lint
	$(BIN)/pytest -n 4 --dist worksteal -rs -m "not proof"

load: $(VENV)/.ready
	$(BIN)/python -m tools.bench.under_load $(ROUNDS)

proof: $(VENV)/.ready
	$(BIN)/python -m tools.proof

bench: $(VENV)/.ready
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e ".[test,bench,fast,oracle]"
	$(BIN)/python tools/bench/wire.py
	$(BIN)/python tools/bench/faults.py
	$(BIN)/python tools/bench/estop.py
	$(BIN)/python tools/bench/doors.py
	$(BIN)/python tools/bench/journal.py
	$(BIN)/python tools/bench/durability.py
	$(BIN)/python -m tools.bench.analysis --write docs/figures-analysis.md
	$(BIN)/python -m tools.bench.learning

clean:
	rm -rf $(VENV) build *.egg-info reports runs .mypy_cache .ruff_cache .pytest_cache .hypothesis
