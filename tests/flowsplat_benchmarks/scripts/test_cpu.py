"""What the CPU benchmark counts, compares and writes. How fast anything is, is not tested."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch

from flowsplat.splatting import blend, project, rasterize
from flowsplat.splatting.cpu import tiles
from flowsplat.splatting.rules import ALPHA_MIN
from flowsplat.training.config import PRESETS
from flowsplat.training.losses import coverage, photometric, rigid
from flowsplat.training.trainer import Trainer
from flowsplat_benchmarks.scripts.cpu_parts import first, large, rasterizer, scaling, scene, startup, step, torch_tiles
from flowsplat_benchmarks.scripts.cpu_parts.clock import KernelClock, profile
from flowsplat_benchmarks.scripts.cpu_parts.floor import backward_flops, count_pairs, floor_seconds, forward_flops
from flowsplat_benchmarks.scripts.cpu_parts.machine import Limits, describe
from flowsplat_benchmarks.scripts.cpu_parts.report import comparison, format_page
from flowsplat_benchmarks.scripts.cpu_parts.timing import interleave
from flowsplat_benchmarks.scripts.cpu_parts.work_load import work_load

SIZE = 70, 50


def small(count: int = 200):
    """A work load, its leaves and its projection."""
    load = work_load(count, *SIZE, footprint=1.5)
    leaves = load.leaves()
    return load, leaves, project(*leaves.values(), *load.camera.tensors(), *SIZE)


# -- the work and its floor


def test_every_pair_is_counted():
    load, _, projected = small()
    counts = count_pairs(projected, load.opacities, *SIZE)
    x, y = np.meshgrid(np.arange(SIZE[0]) + 0.5, np.arange(SIZE[1]) + 0.5)
    pairs = instances = visible = 0
    means2d, conics = (tensor.detach().double().numpy() for tensor in (projected.means2d, projected.conics))
    for (u, v), (a, b, c), opacity in zip(means2d, conics, load.opacities.astype(np.float64), strict=True):
        alpha = opacity * np.exp(-0.5 * (a * (x - u) ** 2 + c * (y - v) ** 2) - b * (x - u) * (y - v))
        rows, columns = np.nonzero(alpha >= ALPHA_MIN)
        pairs += len(rows)
        visible += len(rows) > 0
        instances += len({(row // 16, column // 16) for row, column in zip(rows, columns, strict=True)})
    assert (counts.pairs, counts.visible, counts.instances) == (pairs, visible, instances)


def test_culled_gaussians_have_no_pairs():
    load, leaves, _ = small(50)
    behind = project(-leaves["means"].detach(), *list(leaves.values())[1:], *load.camera.tensors(), *SIZE)
    assert count_pairs(behind, load.opacities, *SIZE).pairs == 0


def test_the_work_load_is_as_dense_as_the_design_says():
    load = work_load()
    projected = project(*load.leaves().values(), *load.camera.tensors(), 854, 480)
    counts = count_pairs(projected, load.opacities, 854, 480)
    assert counts.visible > 99_500
    assert counts.instances == pytest.approx(305_000, rel=0.01)
    assert counts.pairs / counts.pixels == pytest.approx(43.6, rel=0.01)


def test_the_floor_is_the_designs():
    pairs = round(43.6 * 854 * 480)
    # At the 370 GFLOP/s of one machine (docs/benchmarks_cpu.md tells how the floor is counted).
    assert floor_seconds(pairs, forward_flops(3), 370e9) * 1e3 == pytest.approx(1.26, abs=0.01)
    assert floor_seconds(pairs, backward_flops(3), 370e9) * 1e3 == pytest.approx(2.2, abs=0.05)


# -- the rasterizer to compare with


@pytest.mark.parametrize("channels", [1, 5])
@pytest.mark.parametrize("differentiate", [torch_tiles.differentiate_simply, torch_tiles.differentiate_by_rows])
def test_torch_tiles_compute_what_the_oracle_computes(differentiate, channels):
    load = work_load(200, *SIZE, footprint=1.5)
    generator = torch.Generator().manual_seed(0)
    leaves = {name: leaf.detach().double().requires_grad_() for name, leaf in load.leaves().items()}
    features = torch.rand(200, channels, generator=generator, dtype=torch.float64, requires_grad=True)
    grad_image = torch.randn(SIZE[1], SIZE[0], channels, generator=generator, dtype=torch.float64)
    grad_alphas = torch.randn(SIZE[1], SIZE[0], generator=generator, dtype=torch.float64)
    view = load.camera.tensors(torch.float64)
    image, alphas, seconds = differentiate(leaves, features, *view, *SIZE, grad_image, grad_alphas)

    inputs = [*leaves.values(), features]
    expected, expected_alphas, _ = rasterize(*inputs, *view, *SIZE, backend="reference")
    gradients = torch.autograd.grad([expected, expected_alphas], inputs, [grad_image, grad_alphas])
    torch.testing.assert_close(image, expected)
    torch.testing.assert_close(alphas, expected_alphas)
    for leaf, gradient in zip(inputs, gradients, strict=True):
        torch.testing.assert_close(leaf.grad, gradient)
    assert set(seconds) == {"forward", "backward"}


def test_a_wrong_image_is_refused(monkeypatch):
    image = rasterizer.RenderCase(work_load(100, *SIZE), 3, 1)
    assert set(image.torch_job(careful=True)) == set(image.torch_job(careful=False)) == {"forward", "backward"}
    monkeypatch.setattr(torch_tiles, "ALPHA_MIN", 0.1)
    with pytest.raises(RuntimeError, match="differs"):
        image.torch_job(careful=True)


# -- measuring


def test_jobs_take_turns_and_warm_up():
    order = []

    def job(name: str) -> dict[str, float]:
        order.append(name)
        return {"seconds": 0.001 * len(order)}

    result = interleave({"a": lambda: job("a"), "b": lambda: job("b"), "silent": dict}, 3)
    assert order == ["a", "b"] * 4
    assert result == {
        "a": {"seconds": {"min_ms": 3.0, "median_ms": 5.0, "repeats": 3}},
        "b": {"seconds": {"min_ms": 4.0, "median_ms": 6.0, "repeats": 3}},
    }


def test_the_kernel_clock_sees_every_stage_and_leaves_no_trace():
    load, leaves, projected = small()
    before = vars(tiles).copy()
    features = torch.rand(len(load.means), 3)
    blend(projected, leaves["opacities"], features, *SIZE)
    clock = KernelClock("flowsplat.splatting.cpu", {"sort_by_depth": "sort"})
    with clock.run():
        blend(projected, leaves["opacities"], features, *SIZE)
    seconds = clock.take()
    assert {"sort", "blend_forward"} <= set(seconds)
    assert min(seconds.values()) > 0
    assert clock.take() == {}
    assert vars(tiles) == before


def test_a_profile_adds_up():
    load, leaves, _ = small()
    features = torch.rand(len(load.means), 3, requires_grad=True)

    def action() -> None:
        rasterize(*leaves.values(), features, *load.camera.tensors(), *SIZE)[0].sum().backward()
        time.sleep(0.05)

    parts = profile(action, ["splatting/api.py"])
    assert {"functions: project", "functions: blend", "gradient of blend", "gradient of project"} <= set(parts)
    assert parts["rest"] >= 0.05
    assert all(value >= 0 for value in parts.values())


def test_half_of_the_scene_is_active_in_every_frame():
    for preset in PRESETS.values():
        model = scene.gaussians(preset.model, 2000, *SIZE)
        clip = scene.observations(model, *SIZE)
        assert len(model) == 2000
        for frame in clip.frames:
            assert len(model.active(frame.time).rows) == 1000
        assert [frame.forward is None for frame in clip.frames] == [False] * 5 + [True]
        moved = clip[0].forward.flow[clip[0].depth_trusted]
        # Background goes one pixel to the left with the camera at median depth, objects two to the right of it.
        assert np.median(moved[:, 0]) == pytest.approx(-1, abs=0.7)


# -- the whole result


@pytest.fixture(scope="module")
def result():
    """Everything that runs in this process, on tiny images."""
    limits = Limits()
    return {
        "format": 1, "date": "2000-01-01", "quick": True, "machine": describe(), "commit": None, "changed": None,
        "load_before": [1.0, 1.0, 1.0], "load_after": None,
        "rasterizer": rasterizer.measure(limits, [SIZE], [3], [1], 2, 300),
        "torch": rasterizer.compare_with_torch(SIZE, 3, [1], 1, 300),
        "training": step.measure_training(1, 1, 2000, *SIZE),
        "viewing": step.measure_viewing(1, 2, 2000, *SIZE),
        "scaling": scaling.measure(limits, [300, 600], ["240p"], [3], 1, 1),
        "limits": limits.to_json(),
    }  # fmt: skip


def test_ratios_are_times_over_floors(result):
    (row,) = result["rasterizer"]["rows"].values()
    pairs = result["rasterizer"]["work_load"]["70x50"]["pairs"]
    peak = result["limits"]["1 thread"]["fma_gflops"]["best"] * 1e9
    for way, flops in (("forward", forward_flops(3)), ("backward", backward_flops(3))):
        # The peak may have been beaten once more after this row was written.
        assert row[f"{way}_ratio"] == pytest.approx(row[way]["min_ms"] / (pairs * flops / peak * 1e3), rel=0.5)
        stages = sum(stage["min_ms"] for stage in row[f"{way}_stages"].values())
        assert 0 < stages <= row[way]["median_ms"]
    assert {"project", "sort", "blend"} <= set(row["forward_stages"])


def test_a_step_has_its_parts(result):
    for preset in result["training"]["presets"].values():
        assert {"slicing: slice_gaussians", "splatting: blend", "gradient of blend", "adam: step"} <= set(preset["parts"])
        assert preset["active"] <= preset["gaussians"] / 2
        assert preset["neighbors_ms"] > 0


def test_the_page_shows_every_part(result):
    page = format_page(json.loads(json.dumps(result)))
    for title in ("What the machine can do", "The rasterizer", "Beside plain torch", "A training step", "How the cost grows"):
        assert f"\n## {title}\n" in page
    for table in page.split("\n\n"):
        rows = [line.count("|") for line in table.splitlines() if line.startswith("|")]
        assert len(set(rows)) <= 1, table
    assert "nan" not in page


def test_a_comparison_gives_ratios(result):
    faster = json.loads(json.dumps(result))
    (row,) = faster["rasterizer"]["rows"].values()
    row["forward"]["min_ms"] *= 0.5
    lines = [line for line in comparison(faster, result).splitlines() if line.startswith("| rasterizer") and "/ forward |" in line]
    assert [line.split(" | ")[-1] for line in lines] == ["0.50 |"]


def test_a_large_image_runs_in_a_process_of_its_own():
    measured = large.measure(1, 1, 2000, 320, 200)
    memory = measured["memory_mib"]
    assert 0 < memory["before"] <= memory["forward"] <= memory["forward_and_backward"]
    assert measured["forward"]["repeats"] == 1


def test_what_fresh_processes_do(monkeypatch):
    """One image that shows something, and one training step with every loss; and the benchmark's own kernels stay away."""
    images, trained, losses = [], [], {}
    render, run = first.SceneModel.render, Trainer.run

    def rendered(*arguments):
        images.append(render(*arguments))
        return images[-1]

    def train(self):
        start = {name: value.clone() for name, value in self._start.params.items()}
        trained.append((self, start, run(self)))

    def counted(module, name):
        function = getattr(module, name)
        monkeypatch.setattr(module, name, lambda *values: losses.setdefault(name, values) and function(*values))

    monkeypatch.setattr(first.SceneModel, "render", rendered)
    monkeypatch.setattr(Trainer, "run", train)
    for module, name in ((photometric, "photometric_loss"), (rigid, "rigid_loss"), (coverage, "coverage_loss")):
        counted(module, name)
    exec(startup.ACTIONS["import flowsplat, one image"])
    assert [image.color.shape for image in images] == [(480, 854, 3)]
    assert (images[0].alpha > 0.5).mean() > 0.05
    assert not trained
    exec(startup.ACTIONS["import flowsplat, one training step"])
    ((done, before, after),) = trained
    assert done.state.step == 1
    assert set(losses) == {"photometric_loss", "rigid_loss", "coverage_loss"}
    *_, flow_channels, targets, weights = losses["photometric_loss"]
    assert flow_channels > 0
    assert targets.flow is not None
    assert targets.depth is not None
    assert min(weights.flow, weights.depth, weights.ssim) > 0
    assert any(not torch.equal(value, before[name]) for name, value in after.params.items())
    assert "cpu_parts" not in "".join(line for line in Path(first.__file__).read_text().splitlines() if "import " in line)


def test_starting_warm_and_cold(monkeypatch):
    code = "import os; assert os.path.isdir(os.environ.get('NUMBA_CACHE_DIR', '.'))"
    monkeypatch.setattr(startup, "ACTIONS", {"import torch": "pass", "flowsplat": code})
    measured = startup.measure(2, 1)
    assert (measured["flowsplat"]["warm"]["repeats"], measured["flowsplat"]["cold"]["repeats"]) == (2, 1)
    assert {"warm_beyond_torch_ms", "cold_beyond_torch_ms"} < set(measured["flowsplat"])
    monkeypatch.setattr(startup, "ACTIONS", {"import torch": "pass", "flowsplat": "1 / 0"})
    with pytest.raises(subprocess.CalledProcessError):
        startup.measure(1, 1)


@pytest.mark.slow
def test_the_command(tmp_path):
    def run(*arguments: str) -> str:
        command = [sys.executable, "-m", "flowsplat_benchmarks.scripts.cpu", *arguments]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=600)
        assert done.returncode == 0, done.stderr
        return done.stdout

    printed = run("--quick", "--only", "viewing", "-o", "result.json", "--docs", "page.md")
    assert (tmp_path / "page.md").read_text(encoding="utf-8") in printed
    assert "ratio" in run("--read", "result.json", "--compare", "result.json")
