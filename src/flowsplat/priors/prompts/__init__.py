"""Masks of what clicks and boxes show."""

from flowsplat.priors.prompts.at_once import cut_prompts, show_at_once
from flowsplat.priors.prompts.parsing import ClipFrames, FrameNumbers, Prompt, parse_place, parse_prompts, split_shot
from flowsplat.priors.prompts.stage import plain, prompt_stage, shows

__all__ = [
    "ClipFrames", "FrameNumbers", "Prompt", "cut_prompts", "parse_place", "parse_prompts", "plain", "prompt_stage", "show_at_once",
    "shows", "split_shot",
]  # fmt: skip
