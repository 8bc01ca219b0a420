"""Time the way from a command to the first image, in fresh processes: warm (kernels in the cache on disk) and cold (an empty
cache)."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from typing import Any

from flowsplat_benchmarks.scripts.cpu_parts.timing import Job, interleave, significant

ACTIONS = {
    "import torch": "import torch",
    "import flowsplat, one image": "from flowsplat_benchmarks.scripts.cpu_parts.first import image; image()",
    "import flowsplat, one training step": "from flowsplat_benchmarks.scripts.cpu_parts.first import step; step()",
}


def _run(code: str, environment: dict[str, str]) -> dict[str, float]:
    began = time.perf_counter()
    subprocess.run([sys.executable, "-c", code], env={**os.environ, **environment}, check=True, stdout=subprocess.DEVNULL)
    return {"seconds": time.perf_counter() - began}


def measure(warm: int, cold: int) -> dict[str, Any]:
    """Whole processes, ``warm`` and ``cold`` times each; ours minus ``import torch`` is what flowsplat adds."""

    def cold_job(code: str) -> dict[str, float]:
        with tempfile.TemporaryDirectory() as cache:
            return _run(code, {"NUMBA_CACHE_DIR": cache})

    jobs: dict[str, Job] = {name: lambda code=code: _run(code, {}) for name, code in ACTIONS.items()}  # type: ignore[misc]
    warm_parts = interleave(jobs, warm)
    cold_jobs: dict[str, Job] = {name: lambda code=code: cold_job(code) for name, code in ACTIONS.items() if "flowsplat" in name}  # type: ignore[misc]
    cold_parts = interleave(cold_jobs, cold, warm_up=0)
    torch_ms = warm_parts["import torch"]["seconds"]["min_ms"]
    result: dict[str, Any] = {"import torch": warm_parts["import torch"]["seconds"]}
    for name in cold_jobs:
        result[name] = {"warm": warm_parts[name]["seconds"], "cold": cold_parts[name]["seconds"]}
        for way in ("warm", "cold"):
            result[name][f"{way}_beyond_torch_ms"] = significant(result[name][way]["min_ms"] - torch_ms)
    return result
