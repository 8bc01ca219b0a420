"""The comparison with gsplat measures what it says, in a small case."""

from __future__ import annotations

import pytest
import torch

from flowsplat import gsplat_ops
from flowsplat.common.errors import InputError
from flowsplat.splatting import rasterization
from flowsplat_benchmarks.scripts import gsplat_parity as parity
from flowsplat_benchmarks.scripts.gsplat_parts import behavior, trainings
from flowsplat_benchmarks.scripts.gsplat_parts.reference import rasterize_as_gsplat


@pytest.fixture(scope="module", autouse=True)
def gsplat():
    pytest.importorskip("gsplat", reason="gsplat is not installed")
    gsplat_ops.install()


@pytest.fixture(autouse=True)
def small(monkeypatch):
    for module in (behavior, trainings):
        monkeypatch.setattr(module, "WIDTH", 24)
        monkeypatch.setattr(module, "HEIGHT", 20)
    monkeypatch.setattr(behavior, "COUNT", 40)
    monkeypatch.setattr(trainings, "START", 40)


@pytest.mark.parametrize("options", [{}, {"camera_model": "fisheye"}, {"sh_degree": 2}, {"render_mode": "RGB+ED"}])
def test_its_reference_is_the_oracle(options):
    values = behavior.make_inputs(options.get("camera_model", "pinhole"), options.get("sh_degree"))
    expected = behavior.render(rasterization, values, torch.float64, **options)
    found = behavior.render(rasterize_as_gsplat, values, torch.float64, **options)
    assert float((found.values - expected.values).abs().max()) < 1e-5
    for name, gradient in found.gradients.items():
        torch.testing.assert_close(gradient, expected.gradients[name], rtol=1e-3, atol=1e-3)


def test_tiles_change_nothing(monkeypatch):
    values = behavior.make_inputs()
    tiled = behavior.render(rasterize_as_gsplat, values, torch.float64)
    monkeypatch.setattr("flowsplat_benchmarks.scripts.gsplat_parts.reference.TILE", 64)
    whole = behavior.render(rasterize_as_gsplat, values, torch.float64)
    torch.testing.assert_close(tiled.values, whole.values, rtol=0, atol=1e-13)
    for name, gradient in whole.gradients.items():
        torch.testing.assert_close(tiled.gradients[name], gradient, rtol=1e-9, atol=1e-11)


def test_whatever_is_documented_holds_but_the_lists_of_tiles():
    rows = {name: (int(holds.replace(",", "")), int(cases.replace(",", ""))) for name, holds, cases in parity.count_cases()}
    assert rows.pop("names in meta") == (15, 19)
    assert {name: holds for name, (holds, cases) in rows.items() if holds != cases} == {}
    assert len(rows) > 10


def test_a_rule_that_differs_is_counted(monkeypatch):
    def with_blur(*args, **kwargs):
        return rasterization(*args, **kwargs | {"eps2d": 0.31})

    monkeypatch.setattr(behavior, "rasterization", with_blur)
    monkeypatch.setattr(behavior, "_variants", lambda: [("pinhole", behavior.make_inputs(), {})])
    assert [holds for _, holds in behavior.check_drawing()] == [False] * 4


def test_the_tables_are_written_between_their_marks(monkeypatch):
    monkeypatch.setattr(parity, "PARTS", (behavior.check_absolute_gradients,))
    found = parity.format_results(steps=30, seeds=(0,))
    assert "| MCMCStrategy |" in found
    assert "| fisheye |" in found
    assert "| absgrad | 2 | 2 |" in found
    page = f"a\n{parity.MARKS[0]}\nold\n{parity.MARKS[1]}\nb\n"
    assert parity.put_between_marks(page, found) == f"a\n{parity.MARKS[0]}\n{found}\n{parity.MARKS[1]}\nb\n"
    for spoiled in ("a", f"{parity.MARKS[1]} {parity.MARKS[0]}"):
        with pytest.raises(InputError, match="no place for the tables"):
            parity.put_between_marks(spoiled, found)
