# Every target sets up .venv once and is quick the next time.
PYTHON ?= python3
BIN := .venv/bin
# several workers share the cores: threads of one would wait for those of the others
PYTEST := OMP_NUM_THREADS=1 $(BIN)/python -m pytest
DONE := .venv/.installed
DEMO := .venv/.demo
INSTALL := $(BIN)/python .ci/install.py

# what one worker or program has compiled, the others need not
unexport PYTHONDONTWRITEBYTECODE

.PHONY: setup demo test test-core test-programs test-virtual test-realtime test-long storm lint types imports docs bench clean
.DEFAULT_GOAL := setup

setup: $(DONE)

# what simulates first: while one processor installs the rest, the other compiles kernels
define install
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(INSTALL) video
	$(BIN)/python .ci/kernels.py $(2) & kernels=$$!; \
	$(INSTALL) $(1); installed=$$?; wait $$kernels; exit $$installed
endef

NEEDS := pyproject.toml setup.py constraints.txt .ci/install.py
$(DONE): $(NEEDS)
	$(call install,dev,rehearsal mock)
	touch $(DEMO) $(DONE)

# only what the demo needs: no drivers, linters and formats
$(DEMO): $(NEEDS)
	$(call install,learn,rehearsal)
	touch $(DEMO)

demo: $(DEMO)
	$(BIN)/sliplab demo

QUICK := -n 2 --dist loadgroup --no-loadscope-reorder -m 'not realtime and not programs and not long'
test: $(DONE)
	$(PYTEST) $(QUICK)

# what a change of the core can break by itself
test-core: $(DONE)
	$(PYTEST) $(QUICK) --ignore tests/plugins --ignore tests/examples --ignore tests/benchmarks

# whole programs, servers and clusters; they wait more than they compute
test-programs: $(DONE)
	$(PYTEST) -n 3 --dist loadgroup --no-loadscope-reorder -m 'programs and not realtime and not long'

# both, where what waits is beside what computes, and everything is loaded once
test-virtual: $(DONE)
	$(PYTEST) -n 3 --dist loadgroup --no-loadscope-reorder -m 'not realtime and not long'

# fakes in real time: whole scenes, which compute, one after another; beside them the rest, which waits. A shared
# machine may stop a process for longer than a device's silence: what failed must pass alone, in one of two tries.
REALTIME := -m 'realtime and not long'
ALONE := $(PYTEST) --last-failed --last-failed-no-failures none $(REALTIME)
test-realtime: $(DONE)
	$(PYTEST) -n 3 --dist loadgroup $(REALTIME) || $(ALONE) || $(ALONE)

# further cases of what has been tested, which take longer than they tell
test-long: $(DONE)
	$(PYTEST) -n 2 --dist loadgroup -m 'long and not realtime'
	$(PYTEST) -m 'long and realtime'

# whole campaigns under every fault, in virtual time: hours of the rig, by as many seeds as they need
HOURS ?= 10
SEED ?= 1
storm: $(DONE)
	OMP_NUM_THREADS=1 $(BIN)/python -m tests.storm --hours $(HOURS) --seed $(SEED) --jobs 2

lint: types imports
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(DONE)
	$(BIN)/mypy

imports: $(DONE)
	cd .links && $(CURDIR)/$(BIN)/lint-imports --config $(CURDIR)/pyproject.toml

# every link, anchor and page is looked at; nothing is fetched
docs: $(DONE)
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict --quiet

bench: $(DONE)
	$(BIN)/python -m benchmarks

clean:
	rm -rf .venv build *.egg-info
