"""``--priors learned`` and ``auto``: which networks they take, what they say of others, and what goes before them."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from urllib.error import URLError

import numpy as np
import pytest
import torch

from flowsplat.common.errors import InputError
from flowsplat.common.threads import thread_count
from flowsplat.priors.kinds.flow import flow_estimator
from flowsplat.priors.learned import networks
from flowsplat.priors.learned.networks import describe_choice, describe_time, fill_methods, has_weights
from flowsplat.priors.learned.raft import raft_estimator
from flowsplat.priors.learned.weights import ModelOptions
from flowsplat.priors.options import PriorsOptions
from flowsplat.priors.prepare import prepare_priors
from flowsplat.priors.prior import PriorRequest
from flowsplat.scenes import Scene

from .conftest import import_torchvision, import_transformers


def methods(options: PriorsOptions, device: str = "cpu") -> tuple[str | None, str | None, str | None]:
    filled = fill_methods(options, device)
    return filled.flow, filled.masks, filled.depth


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    scene = Scene.create(
        tmp_path / "scene", name="s", source="", width=40, height=32, timestamps=range(3), holdout=None, source_fps=1
    )
    for i in range(3):
        scene.write_frame(i, np.random.default_rng(i).integers(0, 255, (32, 40, 3)).astype(np.uint8))
    return scene


@pytest.fixture
def empty_caches(tmp_path: Path, monkeypatch) -> Path:
    """Neither torch nor Hugging Face has anything, and nothing can be fetched."""
    import_transformers()

    def offline(*_: object, **__: object) -> None:
        raise URLError("no network")

    monkeypatch.setattr(torch.hub, "download_url_to_file", offline)
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path / "torch"))
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path / "hub"))
    return tmp_path


@pytest.mark.parametrize("priors", ["own", "true"])
def test_without_being_asked_no_network_is_looked_for(priors, monkeypatch):
    def refuse(*_: object) -> None:
        raise AssertionError("looked for a network")

    monkeypatch.setattr(networks, "is_installed", refuse)
    monkeypatch.setattr(networks, "has_weights", refuse)
    assert methods(PriorsOptions(priors=priors)) == ("dis", "motion", "multiview")


def test_single_options_go_before_the_preset(monkeypatch):
    monkeypatch.setattr(networks, "is_installed", lambda *_: True)
    monkeypatch.setattr(networks, "has_weights", lambda *_: True)
    assert methods(PriorsOptions(priors="learned")) == ("raft", "edgetam", "multiview")
    assert methods(PriorsOptions(priors="learned", flow="dis")) == ("dis", "edgetam", "multiview")
    chosen = PriorsOptions(priors="auto", masks="motion", depth="depth-pro")
    assert methods(chosen) == ("raft", "motion", "depth-pro")


def test_on_a_gpu_masks_are_those_of_sam(monkeypatch):
    monkeypatch.setattr(networks, "is_installed", lambda *_: True)
    monkeypatch.setattr(networks, "has_weights", lambda *_: True)
    assert methods(PriorsOptions(priors="learned"), "cuda") == ("raft", "sam2", "multiview")


def test_what_is_there_goes_before_what_is_preferred(monkeypatch):
    monkeypatch.setattr(networks, "is_installed", lambda *_: True)
    monkeypatch.setattr(networks, "has_weights", lambda method, _: method == "sam2")
    assert methods(PriorsOptions(priors="learned")) == ("raft", "sam2", "multiview")
    assert methods(PriorsOptions(priors="auto")) == ("dis", "sam2", "multiview")


def test_auto_takes_the_files_that_are_named(raft_file: Path, sam2: Path, empty_caches: Path):
    models = ModelOptions(raft=str(raft_file), sam2=str(sam2))
    options = PriorsOptions(priors="auto", models=models)
    assert methods(options) == ("raft", "sam2", "multiview")
    assert methods(PriorsOptions(priors="auto", models=ModelOptions(raft="/nowhere.pth"))) == ("dis", "motion", "multiview")
    a, b = np.random.default_rng(0).integers(0, 255, (2, 128, 128, 3)).astype(np.uint8)
    expected = raft_estimator(str(raft_file), torch.device("cpu"))(a, b)
    np.testing.assert_array_equal(flow_estimator(options, "cpu")(a, b), expected)


def test_weights_in_the_caches_are_found(empty_caches: Path):
    assert not has_weights("raft", ModelOptions())
    checkpoints = empty_caches / "torch" / "checkpoints"
    checkpoints.mkdir(parents=True)
    (checkpoints / "raft_large_C_T_SKHT_V2-ff5fadd5.pth").write_bytes(b"")
    assert has_weights("raft", ModelOptions())
    assert not has_weights("raft", ModelOptions(raft="small"))
    # As huggingface_hub lays them out.
    assert not has_weights("sam2", ModelOptions())
    model = empty_caches / "hub" / "models--facebook--sam2.1-hiera-tiny"
    snapshot = model / "snapshots" / ("0" * 40)
    snapshot.mkdir(parents=True)
    (model / "refs").mkdir()
    (model / "refs" / "main").write_text("0" * 40)
    (snapshot / "config.json").write_text("{}")
    assert not has_weights("sam2", ModelOptions())
    (snapshot / "model.safetensors").write_bytes(b"")
    assert has_weights("sam2", ModelOptions())


def test_auto_says_in_a_line_what_it_took_and_what_is_not_there(empty_caches: Path):
    asked = PriorsOptions(priors="auto")
    line = describe_choice(asked, fill_methods(asked, "cuda"), "cuda")
    assert "flow by dis, masks by motion" in line
    assert "raft (20 MB, BSD-3-Clause) and sam2 (156 MB, Apache-2.0)" in line
    assert "\n" not in line
    asked = PriorsOptions(priors="auto", flow="dis")  # which lacks nothing
    assert "raft" not in describe_choice(asked, fill_methods(asked, "cuda"), "cuda")


def test_auto_without_the_packages_says_how_to_get_them(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    asked = PriorsOptions(priors="auto")
    filled = fill_methods(asked, "cuda")
    assert (filled.flow, filled.masks) == ("dis", "motion")
    assert ".[learned]" in describe_choice(asked, filled, "cuda")
    assert fill_methods(PriorsOptions(priors="learned"), "cuda").flow == "raft"  # which then says what it lacks


def test_learned_says_what_it_lacks_before_anything_is_computed(scene: Scene, empty_caches: Path):
    with pytest.raises(InputError, match=r"^--flow raft: the weights .*raft_large.*--models.raft FILE.*--flow dis") as caught:
        prepare_priors(scene, PriorsOptions(priors="learned"), "cpu")
    assert "\n" not in str(caught.value)
    assert not scene.info.priors
    with pytest.raises(InputError, match=r"^--masks (edgetam|sam2): .*--masks motion"):
        prepare_priors(scene, PriorsOptions(priors="learned", flow="dis"), "cpu")
    assert not scene.info.priors


def test_a_prior_that_is_there_is_made_anew_by_a_network_that_is_asked_for(scene: Scene, raft_file: Path, empty_caches: Path):
    scene.finish_prior("flow", method="dis")
    models = ModelOptions(raft=str(raft_file))
    asked = [
        PriorRequest(scene, PriorsOptions(priors=priors, models=models), device="cpu").choice("flow")
        for priors in ("own", "auto", "learned")
    ]
    assert asked == ["dis", "raft", "raft"]


def test_time_on_the_cpu_is_told_beforehand(tmp_path: Path):
    import_torchvision()
    filled = PriorsOptions(flow="raft", masks="edgetam")
    line = describe_time(filled, ["cameras", "flow", "masks"], 100, (854, 480), "cpu")
    seconds = 50.0 / thread_count()
    assert line is not None
    assert f"flow by raft {seconds:.1f} s a frame" in line
    assert "for 100 frames" in line
    (tmp_path / "small.pth").write_bytes(bytes(1000))
    small = PriorsOptions(flow="raft", models=ModelOptions(raft=str(tmp_path / "small.pth")))
    assert f"flow by raft {0.27 * seconds:.1f} s a frame" in (describe_time(small, ["flow"], 1, (854, 480), "cpu") or "")
    assert describe_time(PriorsOptions(flow="dis", masks="motion"), ["flow", "masks"], 100, (40, 25), "cpu") is None
    assert describe_time(filled, ["cameras", "depth"], 100, (40, 25), "cpu") is None
    assert describe_time(filled, ["flow"], 100, (40, 25), "cuda") is None
