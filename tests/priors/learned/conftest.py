"""The networks themselves, tiny and with random weights, saved to folders that the real loading code reads."""

from __future__ import annotations

import importlib
import importlib.util
import os
import sys
from pathlib import Path
from types import ModuleType

import pytest
import torch

# The hub is never asked: what is not in a folder of a test is not there.
os.environ["HF_HUB_OFFLINE"] = "1"

SIDE, HIDDEN = 64, 128

_libraries: list[torch.library.Library] = []


def import_torchvision() -> ModuleType:
    """torchvision; the test is skipped where it is not installed.

    Its build for CUDA lacks its compiled operators beside a CPU build of PyTorch. It then refuses to be imported, because
    it describes two operators that are not declared. RAFT and the preparation of images need neither.
    """
    if importlib.util.find_spec("torchvision") is None:
        pytest.skip("torchvision (of the extra 'learned') is not installed")
    try:
        return importlib.import_module("torchvision")
    except RuntimeError as error:
        if "torchvision::nms" not in str(error):
            raise
    for name in [name for name in sys.modules if name.split(".")[0] == "torchvision"]:
        del sys.modules[name]
    library = torch.library.Library("torchvision", "DEF")
    for operator in ("nms", "qnms"):
        library.define(f"{operator}(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")
    _libraries.append(library)  # Its operators live as long as it does.
    return importlib.import_module("torchvision")


def import_transformers() -> ModuleType:
    """transformers; the test is skipped where it is not installed."""
    if importlib.util.find_spec("transformers") is None:
        pytest.skip("transformers (of the extra 'learned') is not installed")
    import_torchvision()
    transformers = importlib.import_module("transformers")
    transformers.utils.logging.disable_progress_bar()
    return transformers


@pytest.fixture(autouse=True)
def small_images(monkeypatch):
    """RAFT enlarges images no more than it must, so that it takes less time."""
    monkeypatch.setattr("flowsplat.priors.learned.raft.MIN_SIDE", 128)


@pytest.fixture(scope="session")
def raft_file(tmp_path_factory) -> Path:
    import_torchvision()
    from torchvision.models.optical_flow import raft_small

    torch.manual_seed(0)
    path = tmp_path_factory.mktemp("raft") / "raft.pth"
    torch.save(raft_small(weights=None).state_dict(), path)
    return path


@pytest.fixture(scope="session")
def depth_anything(tmp_path_factory) -> Path:
    hf = import_transformers()
    torch.manual_seed(0)
    folder = tmp_path_factory.mktemp("depth_network") / "anything"
    backbone = hf.Dinov2Config(
        image_size=28, patch_size=14, hidden_size=16, num_hidden_layers=2, num_attention_heads=2, intermediate_size=16,
        out_features=["stage1", "stage2"], reshape_hidden_states=False,
    )  # fmt: skip
    config = hf.DepthAnythingConfig(
        backbone_config=backbone, reassemble_hidden_size=16, reassemble_factors=[2, 1], neck_hidden_sizes=[8, 8],
        fusion_hidden_size=8, head_hidden_size=8, patch_size=14,
    )  # fmt: skip
    network = hf.DepthAnythingForDepthEstimation(config)
    for parameter in network.head.parameters():
        torch.nn.init.normal_(parameter, std=0.5)
    network.save_pretrained(folder)
    size = {"height": 56, "width": 56}
    hf.DPTImageProcessor(size=size, ensure_multiple_of=14, keep_aspect_ratio=True).save_pretrained(folder)
    return folder


@pytest.fixture(scope="session")
def depth_pro(tmp_path_factory) -> Path:
    hf = import_transformers()
    torch.manual_seed(0)
    folder = tmp_path_factory.mktemp("depth_network") / "pro"
    encoder = {
        "model_type": "dinov2", "num_hidden_layers": 4, "hidden_size": 16, "intermediate_size": 16,
        "num_attention_heads": 2, "patch_size": 4, "image_size": 16,
    }  # fmt: skip
    config = hf.DepthProConfig(
        patch_size=16, fusion_hidden_size=16, intermediate_hook_ids=[1, 0], intermediate_feature_dims=[10, 8],
        scaled_images_ratios=[0.5, 1.0], scaled_images_overlap_ratios=[0.0, 0.25], scaled_images_feature_dims=[12, 14],
        use_fov_model=True, image_model_config=encoder, patch_model_config=encoder, fov_model_config=encoder,
    )  # fmt: skip
    hf.DepthProForDepthEstimation(config).save_pretrained(folder)
    hf.DepthProImageProcessor(size={"height": 32, "width": 32}).save_pretrained(folder)
    return folder


def _sam_parts() -> dict[str, object]:
    """What SAM 2 and SAM 3 have in common."""
    return {
        "prompt_encoder_config": {"hidden_size": HIDDEN, "image_size": SIDE, "patch_size": 16},
        "mask_decoder_config": {"hidden_size": HIDDEN, "mlp_dim": 32, "num_attention_heads": 2, "iou_head_hidden_dim": 16},
        "image_size": SIDE, "memory_attention_hidden_size": HIDDEN, "memory_attention_num_layers": 1,
        "memory_attention_feed_forward_hidden_size": 32, "memory_attention_rope_feat_sizes": [4, 4],
        "memory_encoder_hidden_size": HIDDEN, "mask_downsampler_embed_dim": HIDDEN, "memory_fuser_embed_dim": HIDDEN,
        "memory_fuser_intermediate_dim": 32, "memory_fuser_num_layers": 1, "num_maskmem": 3,
    }  # fmt: skip


def _save_segmenter(network: torch.nn.Module, folder: Path) -> None:
    """Save a network that follows objects, made to see them: whether it does is else a matter of random weights."""
    torch.nn.init.ones_(network.mask_decoder.pred_obj_score_head.proj_out.bias)
    network.save_pretrained(folder)


@pytest.fixture(scope="session")
def sam2(tmp_path_factory) -> Path:
    hf = import_transformers()
    torch.manual_seed(0)
    folder = tmp_path_factory.mktemp("sam") / "two"
    backbone = hf.Sam2HieraDetConfig(
        hidden_size=8, num_attention_heads=1, image_size=[SIDE, SIDE], blocks_per_stage=[1, 1, 2, 1],
        embed_dim_per_stage=[8, 16, 32, 64], num_attention_heads_per_stage=[1, 1, 1, 1],
        window_size_per_stage=[8, 4, 4, 2], global_attention_blocks=[3],
    )  # fmt: skip
    vision = hf.Sam2VisionConfig(
        backbone_config=backbone, backbone_channel_list=[64, 32, 16, 8], fpn_hidden_size=HIDDEN,
        backbone_feature_sizes=[[16, 16], [8, 8], [4, 4]],
    )  # fmt: skip
    _save_segmenter(hf.Sam2VideoModel(hf.Sam2VideoConfig(vision_config=vision, **_sam_parts())), folder)
    size = {"height": SIDE, "width": SIDE}
    images = hf.Sam2ImageProcessor(size=size, mask_size={"height": 16, "width": 16})
    hf.Sam2VideoProcessor(images, hf.Sam2VideoVideoProcessor(size=size)).save_pretrained(folder)
    return folder


@pytest.fixture(scope="session")
def edgetam(tmp_path_factory) -> Path:
    hf = import_transformers()
    if importlib.util.find_spec("timm") is None:
        pytest.skip("timm, which EdgeTAM needs, is not installed")
    torch.manual_seed(0)
    folder = tmp_path_factory.mktemp("sam") / "edge"
    backbone = hf.TimmWrapperConfig(
        architecture="repvit_m1", model_args={"in_chans": 3, "features_only": True, "out_indices": [0, 1, 2, 3]}
    )
    vision = hf.EdgeTamVisionConfig(
        backbone_config=backbone, backbone_feature_sizes=[[16, 16], [8, 8], [4, 4]], fpn_hidden_size=HIDDEN
    )
    parts = _sam_parts()
    parts["memory_attention_mlp_hidden_size"] = parts.pop("memory_attention_feed_forward_hidden_size")
    config = hf.EdgeTamVideoConfig(
        vision_config=vision, **parts, memory_attention_rope_k_sizes=[4, 4], perceiver_resampler_num_latents=16,
        perceiver_resampler_num_latents_2d=16,
    )  # fmt: skip
    _save_segmenter(hf.EdgeTamVideoModel(config), folder)
    size = {"height": SIDE, "width": SIDE}
    images = hf.Sam2ImageProcessor(size=size, mask_size={"height": 16, "width": 16})
    hf.Sam2VideoProcessor(images, hf.Sam2VideoVideoProcessor(size=size)).save_pretrained(folder)
    return folder


@pytest.fixture(scope="session")
def sam3(tmp_path_factory) -> Path:
    hf = import_transformers()
    torch.manual_seed(0)
    folder = tmp_path_factory.mktemp("sam") / "three"
    backbone = hf.Sam3ViTConfig(
        hidden_size=16, intermediate_size=16, num_hidden_layers=2, num_attention_heads=2, image_size=SIDE, patch_size=16,
        window_size=2, global_attn_indexes=[1], pretrain_image_size=32,
    )  # fmt: skip
    vision = hf.Sam3VisionConfig(
        backbone_config=backbone, fpn_hidden_size=HIDDEN, backbone_feature_sizes=[[16, 16], [8, 8], [4, 4]]
    )
    _save_segmenter(hf.Sam3TrackerVideoModel(hf.Sam3TrackerVideoConfig(vision_config=vision, **_sam_parts())), folder)
    size = {"height": SIDE, "width": SIDE}
    images = hf.Sam3ImageProcessor(size=size, mask_size={"height": 16, "width": 16})
    hf.Sam3TrackerVideoProcessor(images, hf.Sam2VideoVideoProcessor(size=size)).save_pretrained(folder)
    return folder
