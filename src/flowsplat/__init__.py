"""flowsplat: one ordinary video becomes a 4D scene of moving 3D Gaussians.

``flowsplat.run("clip.mp4", "out")`` does the whole way, ``flowsplat.load("out").render(camera, t)`` shows the result, and
``flowsplat.rasterize(...)`` splats Gaussians on the CPU. Its packages can be used alone: importing one pulls in
nothing that it does not need.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from flowsplat.gaussians.gaussians4d import Gaussians4D as Gaussians4D
    from flowsplat.gaussians.model import SceneModel as SceneModel
    from flowsplat.gaussians.render import render as render
    from flowsplat.gaussians.renderer import Rendering as Rendering
    from flowsplat.geometry import Camera as Camera
    from flowsplat.pipeline import RunConfig as RunConfig
    from flowsplat.pipeline import load as load
    from flowsplat.pipeline import preset as preset
    from flowsplat.pipeline.compare import compare as compare
    from flowsplat.pipeline.python_run import Run as Run
    from flowsplat.pipeline.python_run import export as export
    from flowsplat.pipeline.python_run import run as run
    from flowsplat.scenes import Scene as Scene
    from flowsplat.splatting import rasterization as rasterization
    from flowsplat.splatting import rasterize as rasterize
    from flowsplat.training.trainer import Trainer as Trainer

__version__ = "0.2.0"

# Where each public name is: importing flowsplat is quick, and what is used is loaded when it is used.
_PUBLIC = {
    "Camera": "flowsplat.geometry",
    "Gaussians4D": "flowsplat.gaussians.gaussians4d",
    "Rendering": "flowsplat.gaussians.renderer",
    "Run": "flowsplat.pipeline.python_run",
    "RunConfig": "flowsplat.pipeline",
    "Scene": "flowsplat.scenes",
    "SceneModel": "flowsplat.gaussians.model",
    "Trainer": "flowsplat.training.trainer",
    "compare": "flowsplat.pipeline.compare",
    "export": "flowsplat.pipeline.python_run",
    "load": "flowsplat.pipeline",
    "preset": "flowsplat.pipeline",
    "rasterization": "flowsplat.splatting",
    "rasterize": "flowsplat.splatting",
    "render": "flowsplat.gaussians.render",
    "run": "flowsplat.pipeline.python_run",
}

__all__ = [
    "Camera", "Gaussians4D", "Rendering", "Run", "RunConfig", "Scene", "SceneModel", "Trainer", "__version__", "compare",
    "export", "load", "preset", "rasterization", "rasterize", "render", "run",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    if name not in _PUBLIC:
        raise AttributeError(f"module 'flowsplat' has no attribute {name!r}")
    return getattr(import_module(_PUBLIC[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *_PUBLIC})
