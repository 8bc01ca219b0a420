"""A clip with cuts: each shot a run of its own, in one folder with one report.

shots.json   the input, its fingerprint, which shots there are, and what was said of them
shots/01     the run of the first shot, as ``flowsplat run INPUT -o shots/01 --start ... --end ...`` makes it
report.html  all of them to look at
"""

from __future__ import annotations

import math
import shlex
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Any, Literal

import numpy as np

from flowsplat.common.errors import InputError
from flowsplat.common.files import lease, read_json, write_json
from flowsplat.common.progress import report, track
from flowsplat.common.run_paths import RunPaths
from flowsplat.output.export.formats import EXPORTERS
from flowsplat.output.export.options import ExportOptions
from flowsplat.output.export.shots import export_sequence
from flowsplat.output.shots_report import ShotOnPage, write_shots_report
from flowsplat.output.videos import list_rendered, read_posters
from flowsplat.output.videos.shown import choose_video
from flowsplat.pipeline.config import RunConfig, check
from flowsplat.pipeline.folder import RunFolder
from flowsplat.pipeline.preparing import identify
from flowsplat.pipeline.shot_list import VERSION, Place, Shot, ShotList, ShotsFile, read_shots, write_places
from flowsplat.pipeline.shot_places import check_places_of_shot, check_shots, names_frames, take_places
from flowsplat.pipeline.speed import STAGES, Speed, estimate_seconds_of_clip
from flowsplat.pipeline.stages import find_metrics, load, run
from flowsplat.priors.cameras.same_place import find_same_place
from flowsplat.priors.cameras.shots import MIN_SHOT_FRAMES, Piece, Transition, find_pieces, find_transitions
from flowsplat.scenes import Scene
from flowsplat.scenes.clip import MAX_FRAMES, Clip, InputOptions
from flowsplat.scenes.ingest import kind_of_input, open_clip

MAX_LOOKED_FRAMES = 4000
"""Frames of a clip that are looked at for cuts, at most: they are held, small and gray. Of longer ones one in so many. A round
number."""

Shots = Literal["split", "off"]


def run_shots(source: Path, out: Path, config: RunConfig, shots: Shots = "split") -> dict[str, dict[str, Any]] | None:
    """Run every shot of a clip with cuts, as ``run`` does a clip. Called again, it continues.

    Cuts are looked for in videos and folders of images, unless ``out`` holds a run already or the settings name frames of the whole
    clip (held-out frames, places without a shot, given files, a camera file, a bullet time). Places that name a shot are given to
    its run.

    Returns:
        the content of ``metrics.json`` by the name of each shot; None where the clip is to be one scene: then nothing was done.

    Raises:
        InputError: as ``run``; or the folder holds the shots of another input; or a place is of none of them.
    """
    held = read_shots(out)
    if shots == "off" and held is not None:
        raise InputError(f"{out} holds the shots of a clip: choose another folder with -o to make one scene of all.")
    if shots == "off" or (held is None and (RunPaths(out).record_path.exists() or names_frames(config))):
        return None
    check(config)
    config.input.check()
    kind = kind_of_input(source)
    if held is None and kind not in ("video", "images"):
        return None
    if kind == "scene":
        raise InputError(f"{out} holds the shots of a clip, not of a prepared scene: choose another folder with -o.")
    identity = identify(source, config)
    new: FoundShots | None = None
    if held is None:
        if out.exists() and any(out.iterdir()):
            return None  # which run refuses
        found = find_shots(source, config.input)
        if not isinstance(found, FoundShots):
            if found is not None:
                report(found)
            return None
        new = found
    spans = [(shot.start, shot.end) for shot in held.shots] if held is not None else []
    _check_places(source, config, spans if new is None else new.spans)
    if new is not None:
        _report_estimate(source, new, config)
    with lease(out):
        if new is not None:
            record = {
                "version": VERSION, "input": str(source), "fingerprint": identity,
                "shots": [{"start": start, "end": end} for start, end in new.spans], "notes": new.notes,
            }  # fmt: skip
            write_json(RunPaths(out).shots_record_path, record)
        elif (before := read_json(RunPaths(out).shots_record_path, ShotsFile))["fingerprint"] != identity:
            raise InputError(
                f"{out} belongs to a different input ({before['input']}) or to other input options. Choose another folder with -o."
            )
        try:
            return _run_all(source, out, config)
        except InputError:
            if new is not None and not any(RunPaths(out).shots_path.glob("*/run.json")):
                _forget(out)
            raise


def _forget(out: Path) -> None:
    """Take out of a folder what nothing was computed for."""
    paths = RunPaths(out)
    paths.shots_record_path.unlink(missing_ok=True)
    paths.report_path.unlink(missing_ok=True)
    with suppress(OSError):
        paths.shots_path.rmdir()


def _run_all(source: Path, out: Path, config: RunConfig) -> dict[str, dict[str, Any]]:
    listed = _read_shots(out)
    metrics: dict[str, dict[str, Any]] = {}
    for shot in listed.shots:
        report(f"Shot {shot.number} of {len(listed.shots)}: {shot.start:.2f} to {shot.end:.2f} s, in {shot.path}")
        metrics[shot.path.name] = run(source, shot.path, config_of(shot, config))
        _write_report(out, source, _read_shots(out))
    if _read_shots(out).places is None and len(listed.shots) > 1:
        write_places(out, _find_places(listed.shots))
        _write_report(out, source, _read_shots(out))
    return metrics


def _read_shots(out: Path) -> ShotList:
    """Return the shots of a folder that holds some."""
    listed = read_shots(out)
    assert listed is not None
    return listed


def _find_places(shots: Sequence[Shot]) -> list[Place]:
    """Compare each shot with each."""
    scenes = [Scene(RunPaths(shot.path).scene_path) for shot in shots]
    pairs = list(combinations(range(len(shots)), 2))
    compared = ((k, j, find_same_place(scenes[k], scenes[j])) for k, j in track(pairs, "Looking for shots of one place"))
    return [Place(k + 1, j + 1, found) for k, j, found in compared if found is not None]


def _write_report(out: Path, source: Path, listed: ShotList) -> None:
    pages = []
    for shot in listed.shots:
        paths = RunPaths(shot.path)
        measured = find_metrics(RunFolder(shot.path)) if paths.record_path.exists() else None
        videos = list_rendered(paths.renders_path)
        video = choose_video(videos)
        posters = {} if video is None else read_posters(paths.renders_path, {video.shown: videos[video.shown]})
        folder = shot.path.relative_to(out).as_posix()
        pages.append(ShotOnPage(folder, str(shot), measured, videos, next(iter(posters.values()), None)))
    write_shots_report(RunPaths(out).report_path, source.stem if source.is_file() else source.name, pages, listed.remarks)


def config_of(shot: Shot, config: RunConfig) -> RunConfig:
    """Return the settings of the run of a shot: what it takes of the input, and the places on its frames."""
    own = input_of((shot.start, shot.end), config.input)
    return replace(config, input=own, priors=take_places(config.priors, shot.number))


def input_of(span: tuple[float, float], options: InputOptions) -> InputOptions:
    """Return what to take of the input for a shot from one second to another."""
    return replace(options, start=span[0], end=span[1])


def _check_places(source: Path, config: RunConfig, spans: Sequence[tuple[float, float]]) -> None:
    check_shots(config.priors, len(spans))
    for number, span in enumerate(spans, 1):
        check_places_of_shot(source, input_of(span, config.input), config.priors, number)


def word_next_steps(out: Path) -> Iterator[str]:
    """Yield what to do with the shots of a clip that are finished.

    Raises:
        InputError: the record of the shots is damaged.
    """
    listed = _read_shots(out)
    yield from listed.remarks
    folder, first = shlex.quote(str(out)), shlex.quote(str(listed.shots[0].path))
    yield f"  their report:    {RunPaths(out).report_path}"
    yield f"  look around:     flowsplat view {first}"
    yield f"  a page to share: flowsplat export {folder} --to html"


def export_shots(out: Path, path: Path | None, options: ExportOptions) -> Path:
    """Write one page that plays the shots of a clip one after the other, and return its path.

    Args:
        out: folder that holds their runs.
        path: the file; None = ``export/player.html`` in that folder.
        options: as ``flowsplat export`` takes them.

    Raises:
        InputError: a shot is not trained yet, an option does not fit, or the file cannot be written.
    """
    listed = read_shots(out)
    if listed is None:
        raise InputError(f"{out} holds no shots of a clip.")
    shots = [(str(shot), load(shot.path), Scene(RunPaths(shot.path).scene_path)) for shot in listed.shots]
    return export_sequence(shots, path or out / "export" / EXPORTERS["html"].default_name, shots[0][2].name, options)


# -- looking for them


@dataclass(frozen=True)
class FoundShots:
    """Shots of a clip: first and last second of each, and sentences on all."""

    spans: list[tuple[float, float]]
    notes: list[str]


def find_shots(source: Path, options: InputOptions) -> FoundShots | str | None:
    """Look for the shots of a video or a folder of images.

    Returns:
        the shots; or, where the clip stays one scene, why, or None where there is nothing to say.

    Raises:
        InputError: it cannot be read.
    """
    whole = replace(options, keep_all=True, every=1, max_frames=MAX_FRAMES, holdout=None)
    clip = open_clip(source, whole)
    if (every := math.ceil(clip.num_frames / MAX_LOOKED_FRAMES)) > 1:
        clip = open_clip(source, replace(whole, every=every))
    images = _read_small(clip)
    seconds = clip.timestamps[: len(images)]
    if len(images) < 2 * MIN_SHOT_FRAMES:
        return None
    transitions = find_transitions(images, seconds)
    if not transitions:
        return None
    pieces = find_pieces(images, seconds, transitions)
    at = clip.begin + seconds
    unclear = [_word_unclear(each, at) for each in transitions if each.kind == "unclear"]
    if len(pieces) < 2:
        return " ".join(unclear)
    kept = [(piece, span) for piece in pieces if piece.left_out is None and _has_frames(source, options, span := _span(piece, at))]
    if not kept:
        return (
            f"The clip has {len(pieces)} shots, and none of them {MIN_SHOT_FRAMES} frames that move: it stays one scene, in which "
            "they will be mixed."
        )
    return FoundShots([span for _, span in kept], _word_all(pieces, [piece for piece, _ in kept], transitions, at) + unclear)


def _read_small(clip: Clip) -> list[np.ndarray]:
    """Return the gray frames up to one that cannot be read, of which the run will tell."""
    images = []
    for image in clip.look():
        if image is None:
            break
        images.append(image)
    return images


def _span(piece: Piece, at: np.ndarray) -> tuple[float, float]:
    # To a tenth of a millisecond: --start and --end allow for half of one.
    return round(float(at[piece.first]), 4), round(float(at[piece.last]), 4)


def _has_frames(source: Path, options: InputOptions, span: tuple[float, float]) -> bool:
    """Return whether enough frames of a shot are used: repeats of a change of the frame rate are not."""
    try:
        return open_clip(source, input_of(span, options)).num_frames >= MIN_SHOT_FRAMES
    except InputError:
        return False


def _word_unclear(transition: Transition, at: np.ndarray) -> str:
    return (
        f"From second {at[transition.last]:.2f} to {at[transition.first]:.2f} hardly anything can be followed: a fast pan or a "
        "transition, nothing tells which, so both sides stay one shot; choose one of them with --start and --end."
    )


def _word_all(pieces: Sequence[Piece], kept: Sequence[Piece], transitions: Sequence[Transition], at: np.ndarray) -> list[str]:
    clear = [each for each in transitions if each.kind != "unclear"]
    where = ", ".join(f"{each.kind} at {at[each.first]:.2f} s" for each in clear)
    names = f"{len(kept)} shots, each" if len(kept) > 1 else "one shot, which"
    notes = [f"The clip has {names} a scene of its own ({where}): --shots off makes one scene of all."]
    notes += [
        f"Left out: {at[piece.first]:.2f} to {at[piece.last]:.2f} s, because {piece.left_out or 'too few of its frames are used'}."
        for piece in pieces
        if piece not in kept
    ]
    gaps = [(each.last, each.first) for each in clear if each.first - each.last > 1]
    if gaps:
        seconds = ", ".join(f"{at[a]:.2f} to {at[b]:.2f}" for a, b in gaps)
        notes.append(f"Left out between shots: what fades, flashes or is blank, from second {seconds}.")
    return notes


def _report_estimate(source: Path, found: FoundShots, config: RunConfig) -> None:
    for note in found.notes:
        report(note)
    total = dict.fromkeys(STAGES, 0.0)
    for span in found.spans:
        options = input_of(span, config.input)
        clip = open_clip(source, replace(options, keep_all=True))
        for stage, seconds in estimate_seconds_of_clip(clip, replace(config, input=options)).items():
            total[stage] += seconds
    report(f"All shots together take {Speed(config.device).estimate(total)}.")
