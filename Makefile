# Everything on a machine with Python 3.10 or newer and make. Both commands set up .venv first, when it is not up to date.
PYTHON ?= python3
BIN := .venv/bin

.PHONY: help demo test clean

help:
	@echo "make demo   a short rendered clip through all stages: pictures, video and report in out/demo"
	@echo "make test   lint, types, and all tests, the fast ones first"
	@echo "make clean  remove .venv and out"

demo: .venv/.installed
	$(BIN)/flowsplat demo -o out/demo

test: .venv/.installed
	$(BIN)/ruff check
	$(BIN)/mypy
	$(BIN)/pytest -m "not slow"
	$(BIN)/pytest -m slow

# torch comes first and alone: it is by far the largest, and everything else must fit it.
.venv/.installed: pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 10))' || \
		{ echo "flowsplat needs Python 3.10 or newer: make PYTHON=/path/to/python3"; exit 1; }
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install "$$(grep '^torch==' constraints.txt)"
	$(BIN)/python -m pip install -c constraints.txt -e '.[dev]'
	@touch $@

clean:
	rm -rf .venv out
