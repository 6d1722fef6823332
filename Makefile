# Every target sets up .venv once and is quick the next time.
PYTHON ?= python3
BIN := .venv/bin
DONE := .venv/.installed

.PHONY: setup demo test lint bench clean
.DEFAULT_GOAL := setup

setup: $(DONE)

$(DONE): pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	touch $(DONE)

demo: $(DONE)
	$(BIN)/sliplab demo

# Tests in real time mostly wait: they run beside the others, which stand back for them.
test: $(DONE)
	told=$$(mktemp); $(BIN)/python -m pytest -m realtime >"$$told" 2>&1 & realtime=$$!; \
	nice -n 19 $(BIN)/python -m pytest -n 2 --dist worksteal -m 'not realtime'; others=$$?; \
	wait $$realtime; real=$$?; cat "$$told"; rm -f "$$told"; test $$others = 0 && test $$real = 0

lint: $(DONE)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

bench: $(DONE)
	$(BIN)/python -m benchmarks

clean:
	rm -rf .venv build *.egg-info
