"""Optical flow: of whole images, and once more inside what moves."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from flowsplat.priors.flow import FlowEstimator, dis_estimator, flow_stage
from flowsplat.priors.given import consecutive_pairs, true_flow, true_layers
from flowsplat.priors.given.fitting import verdict_of
from flowsplat.priors.given.flow import read_flow
from flowsplat.priors.learned.networks import OWN_METHODS, fill_methods
from flowsplat.priors.learned.weights import network_device
from flowsplat.priors.object_flow import object_flow_stage
from flowsplat.priors.options import PriorsOptions
from flowsplat.priors.prior import GIVEN, TRUTH, Kind, PriorRequest, Stage
from flowsplat.scenes import Scene
from flowsplat.scenes.layers import Layers

OWN = OWN_METHODS["flow"]


def flow_estimator(options: PriorsOptions, device: str) -> FlowEstimator:
    """Return what finds flow under these options.

    Raises:
        InputError: a network is not there.
    """
    options = fill_methods(options, device)
    if options.flow == OWN:
        return dis_estimator
    from flowsplat.priors.learned.raft import raft_estimator

    return raft_estimator(options.models.raft, network_device(device))


def _get_requested(request: PriorRequest) -> str | None:
    """Return a network, unless the flow is true and is to be: the truth may lack flow, so nothing else asks for it."""
    is_true = request.wants_truth and request.method("flow") == TRUTH
    return None if request.choice("flow") == OWN or is_true else request.choice("flow")


def _read_true(scene: Scene, truth: Layers) -> bool:
    """Pairs that the truth does not have are left to the flow stage."""
    found = [true_flow(truth, *pair) for pair in consecutive_pairs(scene)]
    for flow in found:
        if flow is not None:
            scene.write_flow(flow)
    return None not in found


def _read_given(request: PriorRequest, path: Path) -> None:
    """Pairs that the files do not have are left to the flow stage."""
    flows, maker = read_flow(path, request.scene)
    for flow in flows:
        request.scene.write_flow(flow)
    if len(flows) == len(consecutive_pairs(request.scene)):
        request.scene.finish_prior("flow", method=GIVEN, verdict=verdict_of(path, maker))


FLOW = Kind(
    compute=lambda request: partial(flow_stage, request.scene, request.choice("flow"), request.estimate),
    options=("flow", "models"),
    files=("flow",),
    own=(OWN,),
    asked=_get_requested,
    finds_flow=True,
    read_true=_read_true,
    read_given=_read_given,
)


def _lacks_objects(request: PriorRequest) -> bool:
    flow = request.scene.prior("flow") or {}
    return flow.get("method") == OWN and not flow.get("objects")


def _search_objects(request: PriorRequest) -> Stage:
    """What is true stays as it is."""
    true = [] if not request.wants_truth else [
        pair for pair in consecutive_pairs(request.scene) if true_flow(true_layers(request.scene), *pair) is not None
    ]  # fmt: skip
    return partial(object_flow_stage, request.scene, true)


OBJECT_FLOW = Kind(compute=_search_objects, is_due=_lacks_objects)
