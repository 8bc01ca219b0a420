"""Every kernel of the GPU backend passes the real compilers, also on a machine without a GPU."""

from __future__ import annotations

import pytest

from tests.common.compiling import compiled

pytest.importorskip("triton", reason="Triton is not installed")

SCRIPT = """
from flowsplat.splatting.triton import functions
from flowsplat.splatting.triton.tiles import PairCapacity

g = torch.Generator().manual_seed(0)
viewmat, K = torch.eye(4).requires_grad_(), torch.tensor([[40.0, 0, 20], [0, 40, 14], [0, 0, 1]])


def draw(channels, covars, absgrad, size=(40, 28)):
    means, opacities = torch.randn(8, 3, generator=g).requires_grad_(), torch.rand(8, generator=g)
    shape = [None, None, torch.eye(3).expand(8, 3, 3)] if covars else [torch.ones(8, 4), torch.ones(8, 3), None]
    drawn = functions.project(means, *shape, opacities, viewmat, K, *size, 0.01, 1e10, 0.3)
    means2d, conics, depths, radii, extents = drawn
    absolute = torch.zeros(8, 2) if absgrad else None
    rest = conics, opacities, torch.ones(8, channels), depths, extents
    with PairCapacity("cpu", 64).fix():
        image, alphas = functions.blend(means2d, *rest, *size, absolute)
        (image.sum() + alphas.sum()).backward()
        with torch.no_grad():
            functions.blend(means2d, *rest, *size)


draw(3, covars=False, absgrad=True)
TARGETS[:] = [target for target in TARGETS if target.arch == 90]  # the rest for one, to save time
draw(10, covars=True, absgrad=False, size=(4096, 4096))
"""


@pytest.mark.slow
def test_every_kernel_compiles_for_nvidia_and_amd():
    kernels = compiled(SCRIPT)
    assert set(kernels) == {
        "project_forward", "project_backward", "cut_tiles", "blend_forward", "blend_backward", "gather_gradients"
    }  # fmt: skip
    targets = set().union(*kernels.values())
    assert targets >= {"80", "90"}
    assert all(found == targets for found in kernels.values())
