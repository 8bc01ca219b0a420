"""What is said where Triton is missing or has nothing to run on; flowsplat works without it."""

from __future__ import annotations

import subprocess
import sys

import pytest
import torch

from flowsplat.common import triton as common
from flowsplat.splatting import rasterize
from tests.splatting.test_rasterize import random_gaussians

WITHOUT = """
import sys
sys.modules["triton"] = None  # importing it fails
import torch
import flowsplat
from flowsplat.common.triton import interpreted, require_triton, triton_works
from flowsplat.splatting import rasterize

assert not interpreted()
assert triton_works() is not None
arguments = [torch.tensor([[0.0, 0, 2]]), torch.tensor([[1.0, 0, 0, 0]]), torch.full((1, 3), 0.2), torch.tensor([0.8]),
             torch.ones(1, 3), torch.eye(4), torch.tensor([[20.0, 0, 10], [0, 20, 10], [0, 0, 1]]), 20, 20]
assert float(rasterize(*arguments)[0].sum()) > 0
try:
    rasterize(*arguments, backend="triton")
except ValueError as error:
    print(error)
"""


def test_flowsplat_works_without_triton_and_names_it_where_it_is_needed():
    done = subprocess.run([sys.executable, "-c", WITHOUT], capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    assert "Triton is not installed" in done.stdout


def test_flowsplat_does_not_import_triton_before_it_is_needed():
    code = "import sys, flowsplat, flowsplat.splatting, flowsplat.common.devices; assert 'triton' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], timeout=300, check=True)


def test_tensors_on_the_cpu_need_the_interpreter(monkeypatch):
    pytest.importorskip("triton", reason="Triton is not installed")
    monkeypatch.setattr(common, "is_interpreted", lambda: False)
    arguments = [value.float() for value in random_gaussians(3, 2).values()]
    with pytest.raises(ValueError, match="TRITON_INTERPRET"):
        rasterize(*arguments, 8, 8, backend="triton")
    with pytest.raises(ValueError, match="float32"):
        rasterize(*(value.double() for value in arguments), 8, 8, backend="triton")


@pytest.mark.parametrize(("number", "power"), [(0, 1), (1, 1), (2, 2), (3, 4), (16, 16), (17, 32)])
def test_power_of_two(number, power):
    assert common.power_of_two(number) == power


def test_the_probe_squares_numbers():
    pytest.importorskip("triton", reason="Triton is not installed")
    from flowsplat.common.triton_probe import probe

    assert probe("cuda" if torch.cuda.is_available() else "cpu")


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_without_a_gpu_the_reason_is_one_line():
    reason = common.triton_works()
    assert reason
    assert "\n" not in reason
