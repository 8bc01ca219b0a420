"""Other machines than this one: threads of our own where torch has no OpenMP, and a processor without AVX-512."""

from __future__ import annotations

import os
import platform
import subprocess
import sys

import pytest

pytestmark = pytest.mark.all_cores

SCRIPT = """
import os, sys, threading
import torch
from flowsplat.common import threads as kernel_threads
from flowsplat.splatting import rasterize
from flowsplat.common.simd import LANES

if os.environ.get("KIND_OF_THREADS") == "Python":
    kernel_threads._team = lambda: None
g = torch.Generator().manual_seed(0)
count = 400
values = [
    torch.randn(count, 3, generator=g) * 0.7 + torch.tensor([0.0, 0, 3]), torch.randn(count, 4, generator=g),
    torch.exp(0.5 * torch.randn(count, 3, generator=g) - 2.5), torch.rand(count, generator=g),
    torch.rand(count, 6, generator=g),
]
camera = torch.eye(4), torch.tensor([[60.0, 0, 40], [0, 60, 30], [0, 0, 1]])
threads, turns = int(sys.argv[1]), int(sys.argv[2])


def draw(backend, dtype):
    leaves = [v.detach().clone().to(dtype).requires_grad_() for v in values]
    image, alphas, _ = rasterize(*leaves, *(c.to(dtype) for c in camera), 80, 60, backend=backend)
    (image.square().sum() + alphas.sum()).backward()
    return [image.detach(), *(leaf.grad for leaf in leaves)]


alone = draw("cpu", torch.float32)
for ours, exact in zip(alone, draw("reference", torch.float64), strict=True):
    # Not less, because of pixels where an alpha lies at the cut.
    assert float((ours.double() - exact).norm()) < 1e-3 * float(exact.norm())
failures, barrier = [], threading.Barrier(threads)


def work():
    barrier.wait()
    for _ in range(turns):
        if not all(map(torch.equal, draw("cpu", torch.float32), alone)):
            failures.append("two at once give another result than one")


workers = [threading.Thread(target=work) for _ in range(threads)]
for worker in workers:
    worker.start()
for worker in workers:
    worker.join()
assert not failures, failures
print(kernel_threads.kind_of_threads(), LANES)
"""


def run(environment: dict[str, str], threads: int, turns: int) -> list[str]:
    """Render and differentiate from several Python threads at once; the kind of threads and the number of lanes."""
    command = [sys.executable, "-c", SCRIPT, str(threads), str(turns)]
    done = subprocess.run(command, env={**os.environ, **environment}, capture_output=True, text=True, timeout=900, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout.split()


@pytest.mark.parametrize("kind", ["OpenMP", "Python"])
def test_two_python_threads_may_render_at_once(kind):
    used, _ = run({"KIND_OF_THREADS": kind}, threads=2, turns=15)
    assert used == kind


@pytest.mark.slow
@pytest.mark.skipif(platform.machine().lower() not in ("x86_64", "amd64"), reason="names an x86 processor")
def test_a_processor_without_avx512():
    """Its kernels lie beside those of this one, and belong to its name."""
    assert run({"NUMBA_CPU_NAME": "haswell", "NUMBA_CPU_FEATURES": "+avx2,+fma"}, threads=1, turns=1)[1] == "8"
