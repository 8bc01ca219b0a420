"""RAFT with random weights: the true loading code, images of any size, and what is said where it is absent."""

from __future__ import annotations

import os
import re
import sys
from pathlib import Path
from urllib.error import URLError

import cv2
import numpy as np
import pytest
import torch

from flowsplat.common.errors import InputError
from flowsplat.priors.flow import flow_stage
from flowsplat.priors.learned.raft import raft_estimator
from flowsplat.priors.learned.weights import ModelOptions
from flowsplat.priors.options import PriorsOptions
from flowsplat.priors.prepare import prepare_priors
from flowsplat.scenes import Scene

from ..planes import write_planes
from .conftest import import_torchvision

CPU = torch.device("cpu")
AUTHORS = (
    ("feature_encoder.", "fnet."), ("context_encoder.", "cnet."), (r"net\.conv\.", "net.conv2."),
    (r"net\.convnormrelu\.0", "net.conv1"), (r"net\.convnormrelu\.1", "net.norm1"),
    (r"\.convnormrelu(\d)\.0", r".conv\1"), (r"\.convnormrelu(\d)\.1", r".norm\1"),
    (r"motion_encoder\.convcorr(\d)\.0", r"encoder.convc\1"), (r"motion_encoder\.convflow(\d)\.0", r"encoder.convf\1"),
    (r"motion_encoder\.conv\.0", "encoder.conv"), (r"mask_predictor\.convrelu\.0", "update_block.mask.0"),
    (r"mask_predictor\.conv", "update_block.mask.2"),
)  # fmt: skip
"""From torchvision's names to those of https://github.com/princeton-vl/RAFT."""


def image(height: int, width: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 255, (height, width, 3)).astype(np.uint8)


@pytest.mark.parametrize("size", [(128, 136), (131, 150), (33, 60)])
def test_images_of_any_size_have_finite_flow(raft_file: Path, size):
    flow = raft_estimator(str(raft_file), CPU)(image(*size), image(*size, seed=1))
    assert flow.shape == (*size, 2)
    assert flow.dtype == np.float32
    assert np.isfinite(flow).all()
    assert np.abs(flow).max() > 0


def test_flow_is_in_pixels_of_the_image(raft_file: Path, monkeypatch):
    from torchvision.models.optical_flow import RAFT

    seen = []

    def forward(self, a, b):
        seen.append((tuple(a.shape), float(a.min()), float(a.max())))
        flow = torch.zeros(1, 2, *a.shape[2:])
        flow[:, 0], flow[:, 1] = 4, 2
        return [flow * 0, flow]

    monkeypatch.setattr(RAFT, "forward", forward)
    flow = raft_estimator(str(raft_file), CPU)(image(64, 100), image(64, 100))
    np.testing.assert_allclose(flow, np.broadcast_to([2.0, 1.0], flow.shape))
    shape, low, high = seen[0]
    assert shape == (1, 3, 128, 200)
    assert -1 <= low < -0.8
    assert 0.8 < high <= 1


def test_a_guess_changes_nothing(raft_file: Path):
    a, b, estimate = image(128, 136), image(128, 136, seed=1), raft_estimator(str(raft_file), CPU)
    np.testing.assert_array_equal(estimate(a, b, np.full((128, 136, 2), 9, np.float32)), estimate(a, b))


def by_authors_names(size: str, state: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Weights as the authors' files have them, made by parallel training, the norms of shortcuts twice."""
    found = {}
    for name, value in state.items():
        for pattern, replacement in AUTHORS:
            name = re.sub(pattern, replacement, name)
        # The small network has one recurrent unit, without a number.
        name = re.sub(r"recurrent_block\.convgru(\d)\.conv(.)", r"gru.conv\2\1" if size == "large" else r"gru.conv\2", name)
        found["module." + name] = value
        if ".downsample.1." in name:
            found["module." + name.replace("downsample.1", "norm3")] = value
    return found


@pytest.mark.parametrize("size", ["small", "large"])
def test_the_names_of_its_authors_give_the_same_flow(tmp_path: Path, size: str):
    import_torchvision()
    from torchvision.models import optical_flow

    torch.manual_seed(0)
    state = getattr(optical_flow, f"raft_{size}")(weights=None).state_dict()
    for name, value in state.items():
        if name.endswith("running_mean"):  # so that batch norms count, too
            value.normal_()
    theirs = by_authors_names(size, state)
    known = {
        "module.fnet.conv1.weight", "module.cnet.layer2.0.conv1.bias", "module.cnet.layer3.0.downsample.0.weight",
        "module.fnet.conv2.bias", "module.update_block.encoder.convc1.weight", "module.update_block.encoder.conv.bias",
        "module.update_block.flow_head.conv2.weight",
    }  # fmt: skip
    if size == "small":
        known |= {"module.fnet.layer1.0.conv3.weight", "module.update_block.gru.convq.bias"}
    else:
        known |= {
            "module.cnet.norm1.running_var", "module.cnet.layer1.1.norm2.num_batches_tracked", "module.cnet.layer2.0.norm3.weight",
            "module.cnet.layer2.0.downsample.1.weight", "module.update_block.gru.convz2.weight", "module.update_block.mask.2.bias",
        }  # fmt: skip
    assert known <= set(theirs)
    torch.save(state, tmp_path / "torchvision.pth")
    torch.save(theirs, tmp_path / "authors.pth")
    torch.save({name.removeprefix("module."): value for name, value in theirs.items()}, tmp_path / "bare.pth")
    a, b = image(128, 128), image(128, 128, seed=1)
    flows = [raft_estimator(str(tmp_path / f"{name}.pth"), CPU)(a, b) for name in ("torchvision", "authors", "bare")]
    assert np.abs(flows[0]).max() > 0
    np.testing.assert_array_equal(flows[1], flows[0])
    np.testing.assert_array_equal(flows[2], flows[0])


def test_a_file_of_its_authors_that_lacks_weights_is_refused(tmp_path: Path):
    import_torchvision()
    from torchvision.models.optical_flow import raft_small

    theirs = by_authors_names("small", raft_small(weights=None).state_dict())
    del theirs["module.update_block.gru.convq.bias"]
    torch.save(theirs, tmp_path / "raft.pth")
    with pytest.raises(InputError, match=r"--flow raft: .*raft.pth holds no RAFT .*--models.raft FILE.*--flow dis") as caught:
        raft_estimator(str(tmp_path / "raft.pth"), CPU)
    assert "\n" not in str(caught.value)


def test_its_real_weights_find_real_motion():
    """The small network of its authors (https://github.com/princeton-vl/RAFT) on a pair of Middlebury's with measured flow."""
    data = Path(os.environ.get("FLOWSPLAT_DATA", ""))
    file, pair = data / "models" / "raft-small.pth", data / "flow" / "rubberwhale"
    if "FLOWSPLAT_DATA" not in os.environ or not file.exists() or not pair.exists():
        pytest.skip("FLOWSPLAT_DATA with models/raft-small.pth and flow/rubberwhale is not there")
    import_torchvision()
    a, b = (cv2.imread(str(pair / f"frame{k}.png"))[..., ::-1].copy() for k in (10, 11))
    true = cv2.readOpticalFlow(str(pair / "flow10.flo"))
    known = (np.abs(true) < 1e9).all(-1)
    error = np.linalg.norm(raft_estimator(str(file), CPU)(a, b) - true, axis=-1)[known]
    assert error.mean() < 0.35
    assert np.linalg.norm(true, axis=-1)[known].mean() > 3 * error.mean()


def test_the_stage_names_it(raft_file: Path, tmp_path: Path):
    scene = Scene.create(tmp_path, name="s", source="", width=40, height=32, timestamps=range(3), holdout=None, source_fps=1)
    for i in range(3):
        scene.write_frame(i, image(32, 40, seed=i))
    flow_stage(scene, "raft", raft_estimator(str(raft_file), CPU))
    assert scene.prior("flow")["method"] == "raft"
    assert scene.flow_pairs == [(0, 1), (1, 0), (1, 2), (2, 1)]


@pytest.mark.slow
def test_all_flow_is_its_own(raft_file: Path, tmp_path: Path, monkeypatch):
    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("flow of another method")

    monkeypatch.setattr("flowsplat.priors.flow.dis_flow", refuse)
    scene = write_planes(tmp_path, step=2, square=True, holdout=5)
    prepare_priors(scene, PriorsOptions(flow="raft", models=ModelOptions(raft=str(raft_file))))
    assert scene.prior("flow")["method"] == "raft"
    assert all(np.isfinite(scene.depth(i).depth).all() for i in scene.train_frames)


def test_absent_weights_say_where_to_get_them(monkeypatch, tmp_path: Path):
    import_torchvision()

    def offline(*_: object, **__: object) -> None:
        raise URLError("no network")

    monkeypatch.setattr(torch.hub, "download_url_to_file", offline)
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    with pytest.raises(InputError, match=r"raft_large.*https://download.pytorch.org.*--models.raft FILE.*--flow dis") as caught:
        raft_estimator("large", CPU)
    assert str(tmp_path / "checkpoints") in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("content", [None, b"no weights", {"some": torch.zeros(2)}, [1, 2]])
def test_files_without_its_weights_are_refused(tmp_path: Path, content):
    import_torchvision()
    path = tmp_path / "raft.pth"
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif content is not None:
        torch.save(content, path)
    with pytest.raises(InputError, match=r"--flow raft: .*raft.pth.*--models.raft FILE.*--flow dis") as caught:
        raft_estimator(str(path), CPU)
    assert "\n" not in str(caught.value)


def test_without_torchvision_there_is_a_reason(monkeypatch):
    for name in [name for name in sys.modules if name.split(".")[0] == "torchvision"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "torchvision", None)
    with pytest.raises(InputError, match=r"--flow raft needs torchvision.*\.\[learned\].*--flow dis"):
        raft_estimator("large", CPU)
