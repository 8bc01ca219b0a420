"""The examples in docstrings of public names: each is run as a reader would, in a folder with a finished run in ``out/clip``."""

from __future__ import annotations

import doctest
import importlib
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

import flowsplat
from tests.shared import OUT, SCENE, made_before, make_finished, make_scene

OTHERS = (
    "flowsplat.batch.clips", "flowsplat.batch.page", "flowsplat.common.errors", "flowsplat.evaluation.metrics",
    "flowsplat.evaluation.scores",
    "flowsplat.geometry.cameras", "flowsplat_benchmarks.ablations.variants", "flowsplat_benchmarks.ablations.verdicts",
    "flowsplat_benchmarks.reports", "flowsplat_benchmarks.tables",
)  # fmt: skip
"""Modules with examples that hold no public name."""
WITHOUT = {"Gaussians4D", "Rendering", "RunConfig", "Trainer"}
"""Public names whose use the examples of others and the scripts in ``examples`` show."""


def modules() -> list[str]:
    public = {getattr(flowsplat, name).__module__ for name in flowsplat.__all__ if name != "__version__"}
    return sorted(public | set(OTHERS))


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    work = tmp_path_factory.mktemp("doctests")
    scene = made_before(SCENE) or make_scene(work / "made")
    finished = made_before(OUT) or make_finished(work / "made", scene)
    shutil.copytree(finished, work / "out" / "clip")
    return work


def examples(name: str) -> Iterator[doctest.DocTest]:
    module = importlib.import_module(name)
    names = {**vars(module), "flowsplat": flowsplat, "np": np, "torch": torch}
    yield from (test for test in doctest.DocTestFinder().find(module, globs=names) if test.examples)


@pytest.mark.parametrize("name", modules())
def test_examples_in_docstrings(name, folder, monkeypatch):
    monkeypatch.chdir(folder)
    told: list[str] = []
    runner = doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS, verbose=False)
    for test in examples(name):
        runner.run(test, out=told.append)
    assert runner.failures == 0, "".join(told)
    if name in OTHERS:
        assert runner.tries > 0, "a module without examples is not to be listed"


def test_public_functions_have_examples():
    documented = {test.name.rsplit(".", 1)[0] for name in modules() for test in examples(name)}
    documented |= {test.name for name in modules() for test in examples(name)}
    names = {name: getattr(flowsplat, name) for name in flowsplat.__all__ if name != "__version__"}
    lacking = {name for name, value in names.items() if f"{value.__module__}.{value.__qualname__}" not in documented}
    assert lacking == WITHOUT
