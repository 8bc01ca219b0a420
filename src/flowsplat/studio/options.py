"""Define the options of the studio."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class StudioOptions:
    """How the studio is served."""

    host: str = "127.0.0.1"
    """Address to listen on. The default is seen from this machine only; 0.0.0.0 lets every machine on the network
    connect that has the address which is printed, with its token."""
    port: int = 8090
    """Port to listen on."""
    max_upload_gb: float = 4.0
    """Gigabytes (thousands of millions of bytes) that a clip may have."""
    run_options: str = ""
    """Options that every run gets besides those that are chosen on the page, as they are typed behind flowsplat run:
    --run-options="--masks sam2 --holdout none"."""
    open_browser: bool = True
    """Show the page in the browser of this machine, where it has a screen."""
