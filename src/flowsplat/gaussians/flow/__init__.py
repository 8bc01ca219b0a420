"""Flow splatting: from moving Gaussians to the features that blend into an optical flow image (docs/method/flow.md)."""

from flowsplat.gaussians.flow.api import FlowView, blend_features
from flowsplat.gaussians.flow.reference import FlowModel, affine_gradient, flow_channels, flow_features, flow_image

__all__ = ["FlowModel", "FlowView", "affine_gradient", "blend_features", "flow_channels", "flow_features", "flow_image"]
