"""The rasterizer in processes with other settings of the compiler: narrower vectors."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from flowsplat_benchmarks.scripts.cpu_parts.timing import significant

COMMAND = "flowsplat_benchmarks.scripts.cpu"
VARIANTS = {
    "avx2": {"NUMBA_CPU_NAME": "haswell", "NUMBA_CPU_FEATURES": "+avx2,+fma", "ATEN_CPU_CAPABILITY": "avx2"},
}
"""Environment variables by name."""


def measure(names: Sequence[str], threads: Sequence[int], turns: int, quick: bool) -> dict[str, Any]:
    """Return the rasterizer's rows as they are normally and with each variant, in turns; the best of every row over the turns."""
    results: dict[str, list[dict[str, Any]]] = {name: [] for name in ("normal", *names)}
    arguments = ["--threads", *map(str, threads), *(["--quick"] if quick else [])]
    for _ in range(turns):
        for name, rows in results.items():
            rows.append(_run(VARIANTS.get(name, {}), arguments))
    best = {name: _best(found) for name, found in results.items()}
    return {name: {**best[name], "times_normal": _ratios(best[name]["rows"], best["normal"]["rows"])} for name in names}


def _run(environment: dict[str, str], arguments: list[str]) -> dict[str, Any]:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "result.json"
        command = [sys.executable, "-m", COMMAND, "--only", "rasterizer", "-o", str(path), *arguments]
        subprocess.run(command, env={**os.environ, **environment}, check=True, stdout=subprocess.DEVNULL)
        result: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        return result


def _best(results: list[dict[str, Any]]) -> dict[str, Any]:
    """Choose of each row the run with the fastest forward and backward pass together."""

    def total(row: dict[str, Any]) -> float:
        return float(row["forward"]["min_ms"] + row["backward"]["min_ms"])

    rows = {
        name: min((result["rasterizer"]["rows"][name] for result in results), key=total)
        for name in results[0]["rasterizer"]["rows"]
    }
    return {"machine": results[0]["machine"], "limits": results[0]["limits"], "rows": rows}


def _ratios(rows: dict[str, Any], normal: dict[str, Any]) -> dict[str, Any]:
    return {
        name: {way: significant(row[way]["min_ms"] / normal[name][way]["min_ms"]) for way in ("forward", "backward")}
        for name, row in rows.items()
    }
