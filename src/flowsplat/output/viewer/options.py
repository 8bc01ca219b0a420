"""Define the options of the viewer."""

from __future__ import annotations

from dataclasses import dataclass

from flowsplat.common.devices import DeviceName


@dataclass(frozen=True)
class ViewOptions:
    """How the viewer is served."""

    host: str = "127.0.0.1"
    """Address to listen on. The default is seen from this machine only; 0.0.0.0 lets every machine on the network
    connect that has the address which is printed, with its token."""
    port: int = 8080
    """Port to listen on."""
    device: DeviceName = "auto"
    """What to render on."""
    largest: int = 1600
    """Pixels of the longer side of still images at most; while something moves they are as large as stays fluent."""
