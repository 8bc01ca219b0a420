"""The run folder and its stages: prepare, train, evaluate, render; what is done, and what to resume."""

from flowsplat.pipeline.config import RunConfig, preset
from flowsplat.pipeline.fitting import train
from flowsplat.pipeline.preparing import prepare
from flowsplat.pipeline.shot_list import resolve_run
from flowsplat.pipeline.shots import export_shots, run_shots
from flowsplat.pipeline.stages import evaluate_run, load, one_color_of, render_run, run

__all__ = [
    "RunConfig", "evaluate_run", "export_shots", "load", "one_color_of", "prepare", "preset", "render_run", "resolve_run", "run",
    "run_shots", "train",
]  # fmt: skip
