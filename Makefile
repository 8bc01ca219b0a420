# Everything on a machine with Python 3.10 or newer and make. Both commands set up .venv first, when it is not up to date.
PYTHON ?= python3
BIN := .venv/bin

.PHONY: help demo test test-all lock clean

help:
	@echo "make demo      a short rendered clip through all stages: images, video and report in out/demo"
	@echo "make test      lint, format, types, and every guarantee once"
	@echo "make test-all  the same and all that takes longer"
	@echo "make lock      requirements.lock and requirements.view.lock anew, from pyproject.toml and constraints.txt (needs uv)"
	@echo "make clean     remove .venv and out"

demo: .venv/.run
	$(BIN)/flowsplat demo -o out/demo

test: .venv/.dev
	$(BIN)/python tests/run.py

test-all: .venv/.dev
	$(BIN)/python tests/run.py --all

# uv installs in a quarter of the time. Where it cannot be had, or does not get to where packages come from, pip does the same.
# Folders with wheels that pip is told of are told to uv, too.
define install
	if [ -x $(BIN)/uv ] && $(BIN)/uv pip install --python $(BIN)/python --compile-bytecode $(addprefix --find-links ,$(PIP_FIND_LINKS)) $(1); \
	then :; else $(BIN)/python -m pip install $(1); fi
endef

.venv/.created:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 10))' || \
		{ echo "flowsplat needs Python 3.10 or newer: make PYTHON=/path/to/python3"; exit 1; }
	$(PYTHON) -m venv .venv
	[ -n "$(WITHOUT_UV)" ] || $(BIN)/python -m pip install --quiet --require-hashes -r requirements.uv.lock || \
		echo "uv cannot be installed; pip will do."
	@touch $@

# What running and viewing need. Everything has the hash that the file names for it, except for torch and the CUDA libraries that it
# brings: which build of it is wanted differs from machine to machine.
.venv/.run: .venv/.created pyproject.toml constraints.txt requirements.view.lock
	$(call install,--no-deps --require-hashes -r requirements.view.lock)
	$(call install,"$$(grep '^torch==' constraints.txt)")
	$(call install,--no-deps --no-build-isolation -e .)
	@touch $@

# What tests and documentation need beside that.
.venv/.dev: .venv/.run requirements.lock
	$(call install,--no-deps --require-hashes -r requirements.lock)
	@touch $@

NOT_LOCKED := torch cuda-bindings cuda-pathfinder cuda-toolkit nvidia-cublas nvidia-cuda-cupti nvidia-cuda-nvrtc nvidia-cuda-runtime \
	nvidia-cudnn-cu13 nvidia-cufft nvidia-cufile nvidia-curand nvidia-cusolver nvidia-cusparse nvidia-cusparselt-cu13 \
	nvidia-nccl-cu13 nvidia-nvjitlink nvidia-nvshmem-cu13 nvidia-nvtx

COMPILE := uv pip compile --quiet --universal --generate-hashes --no-header --no-annotate --python-version 3.10 \
	$(NOT_LOCKED:%=--no-emit-package %)

lock:
	printf 'hatchling\neditables\nuv\n' | $(COMPILE) --extra dev -c constraints.txt pyproject.toml - -o requirements.lock
	printf 'hatchling\neditables\n' | $(COMPILE) --extra view --extra studio --no-emit-package triton -c requirements.lock pyproject.toml - -o requirements.view.lock
	echo uv | $(COMPILE) -c requirements.lock - -o requirements.uv.lock

clean:
	rm -rf .venv out
