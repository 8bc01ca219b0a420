"""The comparison with gsplat measures what it says, in a small case."""

from __future__ import annotations

import pytest
import torch

from flowsplat import gsplat_ops
from flowsplat.common.errors import InputError
from flowsplat.splatting import rasterization
from flowsplat_benchmarks.scripts import gsplat_parity as parity


@pytest.fixture(scope="module", autouse=True)
def gsplat():
    pytest.importorskip("gsplat", reason="gsplat is not installed")
    gsplat_ops.install()


@pytest.fixture(autouse=True)
def small(monkeypatch):
    monkeypatch.setattr(parity, "WIDTH", 24)
    monkeypatch.setattr(parity, "HEIGHT", 16)
    monkeypatch.setattr(parity, "COUNT", 40)
    monkeypatch.setattr(parity, "START", 40)


@pytest.mark.parametrize("options", [{}, {"camera_model": "fisheye"}, {"sh_degree": 2}])
def test_its_reference_is_the_oracle(options):
    values = parity.make_inputs(options.get("camera_model", "pinhole"), options.get("sh_degree"))
    expected = parity.render(rasterization, values, torch.float64, **options)
    found = parity.render(parity.rasterize_as_gsplat, values, torch.float64, **options)
    assert float((found.values - expected.values).abs().max()) < 1e-5
    for name in parity.INPUTS:
        torch.testing.assert_close(found.gradients[name], expected.gradients[name], rtol=1e-3, atol=1e-3)


def test_the_tables_are_written_between_their_marks():
    found = parity.format_results(steps=12)
    assert "| MCMCStrategy |" in found
    assert "| fisheye |" in found
    page = f"a\n{parity.MARKS[0]}\nold\n{parity.MARKS[1]}\nb\n"
    assert parity.put_between_marks(page, found) == f"a\n{parity.MARKS[0]}\n{found}\n{parity.MARKS[1]}\nb\n"
    for spoiled in ("a", f"{parity.MARKS[1]} {parity.MARKS[0]}"):
        with pytest.raises(InputError, match="no place for the tables"):
            parity.put_between_marks(spoiled, found)
