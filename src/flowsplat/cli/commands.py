"""The commands, one thin function each."""

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from flowsplat.cli.arguments import value_of
from flowsplat.common.progress import console, say
from flowsplat.common.run_paths import RunPaths

HOLDOUT_NOTE = "These figures are of frames that were kept back (--holdout); --holdout none trains on all of them."

Preset = Literal["fast", "default", "paper", "high"]


def all_commands(arguments: Sequence[str]) -> dict[str, Any]:
    """Every command, its defaults taken from the preset or the run that the arguments name."""
    from flowsplat.batch.options import BatchOptions
    from flowsplat.common.devices import DeviceName
    from flowsplat.output.export.options import ExportOptions, Format
    from flowsplat.output.videos import RenderOptions
    from flowsplat.output.viewer.options import ViewOptions
    from flowsplat.pipeline.config import Baselines, RunConfig, preset
    from flowsplat.training.config import TrainConfig

    named = value_of(arguments, "--preset")
    defaults = preset(named or "default")
    if arguments and arguments[0] in ("train", "evaluate", "render") and (stored := _stored_config(arguments)):
        defaults = replace(stored, train=defaults.train) if named else stored
    if arguments and arguments[0] == "batch" and not named and (begun := _stored_batch(arguments)):
        defaults = begun
    Settings = Annotated[RunConfig, tyro.conf.arg(name="")]
    Source = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="INPUT")]
    Sources = Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="INPUT [...]")]
    Batch = Annotated[BatchOptions, tyro.conf.arg(name="")]
    Run = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    Viewing = Annotated[ViewOptions, tyro.conf.arg(name="")]
    Exporting = Annotated[ExportOptions, tyro.conf.arg(name="")]
    # Everywhere, -o or --out is where to write, and RUN is the folder that --out of run or prepare named.
    Target = Annotated[Path | None, tyro.conf.arg(name="out", aliases=("-o", "--path"), metavar="OUT")]
    Out = Annotated[Path, tyro.conf.arg(aliases=("-o",), metavar="OUT")]

    def run(input: Source, out: Out, preset: Preset = "default", config: Settings = defaults) -> None:
        """A clip becomes a 4D scene: prepare, train, evaluate and render.

        The same command again continues where it was stopped.

        Args:
            input: A video file, a folder of pictures, a folder with images/ and masks/, a DAVIS root (with --sequence), a
                rig scene, an NVIDIA Dynamic Scene, or a prepared scene.
            out: Folder for everything that comes out.
            preset: fast (half size, about two minutes), default, paper (the paper's settings) or high (five times default).
            config: All settings.
        """
        from flowsplat import pipeline

        _print_figures(pipeline.run(input, out, config), out)

    def batch(
        inputs: Sources, out: Annotated[Path | None, tyro.conf.arg(aliases=("-o",), metavar="OUT")] = None,
        preset: Preset = "default", options: Batch = BatchOptions(), config: Settings = defaults,  # noqa: B008 (frozen)
    ) -> bool:  # fmt: skip
        """Many clips, each an ordinary run in OUT/<id>: as many at a time as cores and memory allow, on any number of machines.

        The same command again continues; flowsplat batch OUT does, too, with the inputs and settings of before. Any number of
        processes may work on one OUT. Exit code 0: all clips are done; 1: some are not; 2: the batch itself cannot be done.

        Args:
            inputs: Clips (all that run takes), folders of clips, and lists: a .txt with a path on every line; a .csv, .tsv or
                .jsonl with path, perhaps id, and options of run by their names (start, end, mask-click, ...). Or OUT alone.
            out: Folder for everything that comes out: OUT/<id>, OUT/batch.json and OUT/index.html.
            preset: As for run.
            options: How the batch is done.
            config: All settings of the runs.
        """
        from flowsplat.batch.command import run_batch

        return run_batch(inputs, out, config, options)

    def prepare(input: Source, out: Out, preset: Preset = "default", config: Settings = defaults) -> None:
        """Only prepare: frames, cameras, flow, masks, depth and tracks, in OUT/scene.

        Args:
            input: As for run.
            out: Folder of the run.
            preset: As for run.
            config: All settings.
        """
        from flowsplat import pipeline

        folder = pipeline.prepare(input, out, config)
        say(f"Prepared: {folder.scene_path}. Next: flowsplat train {out}")

    def train(
        out: Run, preset: Preset = "default", train: TrainConfig = defaults.train, device: DeviceName = defaults.device
    ) -> None:
        """Train a prepared run; continues from its last checkpoint.

        Args:
            out: Folder of the run.
            preset: Start from these settings instead of those stored in the run.
            train: Settings that differ from the stored ones; they are stored in their place.
            device: What to compute on.
        """
        from flowsplat import pipeline

        with _opened(out, train=train, device=device) as folder:
            pipeline.train(folder)
        say(f"Trained: {out}/model. Next: flowsplat evaluate {out}")

    def evaluate(
        out: Run, baselines: Baselines = defaults.baselines, refine_poses: bool = defaults.refine_poses,
        device: DeviceName = defaults.device,
    ) -> None:  # fmt: skip
        """Measure a trained run on what was held out; writes metrics.json and report.html.

        Args:
            out: Folder of the run.
            baselines: What the result is compared with; all also trains our own static scene (a quarter of the training time).
            refine_poses: Also measure held-out frames with their poses refined on their own pictures.
            device: What to compute on.
        """
        from flowsplat import pipeline

        with _opened(out, baselines=baselines, refine_poses=refine_poses, device=device) as folder:
            metrics = pipeline.evaluate_run(folder)
        _print_figures(metrics, out)

    def render(out: Run, render: RenderOptions = defaults.render, device: DeviceName = defaults.device) -> None:
        """Render videos of a trained run: the input path, an orbit, bullet time, or a camera file, beside those it has.

        Args:
            out: Folder of the run.
            render: Options that differ from those that the run was started with; for this time only.
            device: What to compute on.
        """
        from flowsplat import pipeline

        with _opened(out, device=device) as folder:
            pipeline.render_run(folder, render)
        say(f"Videos: {out}/renders")

    def view(out: Run, options: Viewing = ViewOptions()) -> None:  # noqa: B008 (frozen)
        """Look at a run in the browser, also while it trains: any place, any time, colour, flow and depth.

        Args:
            out: Folder of the run.
            options: How it is served.
        """
        from flowsplat.output.viewer.server import view as serve

        serve(out, options)

    def export(
        out: Run,
        to: Format,
        path: Target = None,
        options: Exporting = ExportOptions(),  # noqa: B008 (frozen)
    ) -> None:
        """A trained run in the format of other programs, or as a page that plays it: one .html, no network, no server.

        Args:
            out: Folder of the run.
            to: html (the player), ply (3DGS, at one time), ply-sequence (one ply a frame, as SuperSplat plays it), splat (32 bytes
                a Gaussian, at one time), spz (compressed, at one time), npz or safetensors (every parameter), colmap or
                nerfstudio (the cameras).
            path: File or folder to write; without it, in RUN/export.
            options: What and how.
        """
        from flowsplat import pipeline
        from flowsplat.output.export import export_scene
        from flowsplat.scenes import Scene

        say(f"Written: {export_scene(pipeline.load(out), Scene(out / 'scene'), to, path, options)}")

    # --at A B, --at A --at B and both together are all understood.
    Points = Annotated[tuple[tuple[str, ...], ...], tyro.conf.UseAppendAction, tyro.conf.arg(metavar="U,V,FRAME [...]")]

    def tracks(out: Run, at: Points = (), queries: Path | None = None, path: Target = None) -> None:
        """Follow points through a trained run: where what is seen at a pixel goes in 3D, and when it is visible.

        Writes queries, timestamps, points [Q, T, 3] in the coordinates of RUN/scene/cameras.json, visible [Q, T], and movers [Q],
        the number of the mover that each point is on.

        Args:
            out: Folder of the run.
            at: Points to follow, each u,v,frame: pixels of the prepared frames (the centre of the first is 0.5,0.5), and the
                number of the frame. Repeat it for more.
            queries: More of them: a .json with a list of [u, v, frame], or a text with u,v,frame on every line.
            path: File to write, .json or .npz; without it RUN/export/tracks.json.
        """
        from flowsplat import pipeline
        from flowsplat.output.tracks import read_queries, write_tracks
        from flowsplat.scenes import Scene

        model, scene = pipeline.load(out), Scene(RunPaths(out).scene_path)
        wanted = read_queries([point for some in at for point in some], queries, scene)
        written, found = write_tracks(model, scene, wanted, path or out / "export" / "tracks.json")
        say(f"Written: {written}. {found} of {len(wanted)} points lie on something and were followed.")

    def info(path: Annotated[Path | None, tyro.conf.Positional, tyro.conf.arg(metavar="PATH")] = None) -> None:
        """What is in a run or a scene; versions; which backends work here, and why the others do not.

        Args:
            path: Folder of a run or a scene; without it only versions and backends are shown.
        """
        from flowsplat.pipeline.describe import describe

        print(*describe(path), sep="\n")

    def demo(
        out: Out = Path("out/demo"), size: int = 320, frames: int = 40, world: Literal["street", "floating"] = "street"
    ) -> None:
        """The main job on a drawn clip, with our own priors and with the true ones, side by side.

        Args:
            out: Folder for both runs.
            size: Width of the clip in pixels.
            frames: Number of frames.
            world: What is filmed. street: someone walks, a cart rolls, a ball bounces. floating: three things float in a room,
                whose distance no camera can tell; figures of earlier versions are of it.
        """
        from flowsplat.pipeline.demo import run_demo

        run_demo(out, size, frames, world)

    def benchmark() -> None:
        """Whole benchmarks over many scenes, to tables: flowsplat benchmark --help lists them."""

    return {
        "run": run, "batch": batch, "prepare": prepare, "train": train, "evaluate": evaluate, "render": render, "info": info,
        "demo": demo, "benchmark": benchmark, "view": view, "export": export, "tracks": tracks,
    }  # fmt: skip


def _stored_config(arguments: Sequence[str]) -> Any:
    """The settings of the run that a command works on, if there is one."""
    from flowsplat.pipeline.folder import RunFolder

    for argument in arguments[1:]:
        if not argument.startswith("-") and RunPaths(Path(argument)).record_path.exists():
            return RunFolder(Path(argument)).config
    return None


def _stored_batch(arguments: Sequence[str]) -> Any:
    """The settings of the batch that a command continues, where it names nothing but that."""
    from flowsplat.batch.command import stored_plan

    if value_of(arguments, "-o") is not None or value_of(arguments, "--out") is not None:
        return None
    for argument in arguments[1:]:
        if not argument.startswith("-") and (plan := stored_plan(Path(argument))) is not None:
            return plan[1]
    return None


@contextlib.contextmanager
def _opened(out: Path, **changes: Any) -> Iterator[Any]:
    """The run in a folder, with some of its settings changed from now on, and nobody else's meanwhile."""
    from flowsplat.common.files import lease
    from flowsplat.pipeline.config import check
    from flowsplat.pipeline.folder import RunFolder

    check(replace(RunFolder(out).config, **changes))  # before anything is written there
    with lease(out):
        folder = RunFolder(out)  # another process may just have ended there
        folder.config = replace(folder.config, **changes)
        folder.save()
        yield folder


def _print_figures(metrics: dict[str, Any], out: Path) -> None:
    from flowsplat.output.report import verdict
    from flowsplat.pipeline.summary import figures_table, next_steps

    console.print(figures_table({"": metrics}))
    if metrics["heldout_frames"] is not None:
        say(HOLDOUT_NOTE)
    for line in (verdict(metrics), *next_steps(out)):
        say(line)
