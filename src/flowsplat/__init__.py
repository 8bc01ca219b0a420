"""flowsplat: one ordinary video becomes a 4D scene of moving 3D Gaussians.

``flowsplat.run("clip.mp4", "out")`` does the whole way, ``flowsplat.load("out").render(camera, t)`` shows the result, and
``flowsplat.rasterize(...)`` splats Gaussians on the CPU. Its packages can be used alone: importing one pulls in
nothing that it does not need.
"""

from typing import Any

__version__ = "0.1.0"

_PUBLIC = {
    "run": "flowsplat.pipeline",
    "load": "flowsplat.pipeline",
    "preset": "flowsplat.pipeline",
    "RunConfig": "flowsplat.pipeline",
    "rasterize": "flowsplat.splatting",
    "rasterization": "flowsplat.splatting",
    "Camera": "flowsplat.geometry",
    "Scene": "flowsplat.scenes",
}

__all__ = ["Camera", "RunConfig", "Scene", "__version__", "load", "preset", "rasterization", "rasterize", "run"]


def __getattr__(name: str) -> Any:
    if name not in _PUBLIC:
        raise AttributeError(f"module 'flowsplat' has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(_PUBLIC[name]), name)
