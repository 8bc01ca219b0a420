# Everything on a machine with Python 3.10 or newer and make. Both commands set up .venv first, when it is not up to date.
PYTHON ?= python3
BIN := .venv/bin

.PHONY: help demo test lock clean

help:
	@echo "make demo   a short rendered clip through all stages: pictures, video and report in out/demo"
	@echo "make test   lint, types, and all tests, the fast ones first"
	@echo "make lock   requirements.lock and requirements.view.lock anew, from pyproject.toml and constraints.txt (needs uv)"
	@echo "make clean  remove .venv and out"

demo: .venv/.installed
	$(BIN)/flowsplat demo -o out/demo

test: .venv/.installed
	$(BIN)/ruff check
	$(BIN)/mypy
	$(BIN)/pytest -m "not slow"
	$(BIN)/pytest -m slow

# Everything has the hash that requirements.lock names for it, except for torch and the CUDA libraries that it brings: which build of
# it is wanted differs from machine to machine.
.venv/.installed: pyproject.toml constraints.txt requirements.lock
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 10))' || \
		{ echo "flowsplat needs Python 3.10 or newer: make PYTHON=/path/to/python3"; exit 1; }
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --no-deps --require-hashes -r requirements.lock
	$(BIN)/python -m pip install "$$(grep '^torch==' constraints.txt)"
	$(BIN)/python -m pip install --no-deps --no-build-isolation -e .
	@touch $@

NOT_LOCKED := torch cuda-bindings cuda-pathfinder cuda-toolkit nvidia-cublas nvidia-cuda-cupti nvidia-cuda-nvrtc nvidia-cuda-runtime \
	nvidia-cudnn-cu13 nvidia-cufft nvidia-cufile nvidia-curand nvidia-cusolver nvidia-cusparse nvidia-cusparselt-cu13 \
	nvidia-nccl-cu13 nvidia-nvjitlink nvidia-nvshmem-cu13 nvidia-nvtx

COMPILE := uv pip compile --quiet --universal --generate-hashes --no-header --no-annotate --python-version 3.10 \
	$(NOT_LOCKED:%=--no-emit-package %)

lock:
	printf 'hatchling\neditables\n' | $(COMPILE) --extra dev -c constraints.txt pyproject.toml - -o requirements.lock
	echo hatchling | $(COMPILE) --extra view --no-emit-package triton -c requirements.lock pyproject.toml - -o requirements.view.lock

clean:
	rm -rf .venv out
