"""The commands, one thin function each."""

import contextlib
import io
import os
import re
import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from flowsplat import __version__
from flowsplat.common.errors import InputError, one_line
from flowsplat.common.progress import console, say
from flowsplat.common.stopping import Stopped, ignore_signals, signals_stop

HOLDOUT_NOTE = "These figures are of frames that were kept back (--holdout); --holdout none trains on all of them."

Preset = Literal["fast", "default", "paper", "high"]

USUAL = (
    "-h", "-o", "--preset", "--workers", "--memory", "--shard", "--engine", "--status", "--retry", "--only", "--device", "--start",
    "--end", "--every", "--max-frames", "--resize", "--holdout", "--mask-click", "--touch", "--cameras.focal", "--given.masks",
    "--train.iterations", "--render.paths",
)  # fmt: skip
"""The options that --help shows of a command with more than ``MANY`` of them; --help-all shows all."""
MANY = 40


def _commands(arguments: Sequence[str]) -> dict[str, Any]:
    """Every command, its defaults taken from the preset or the run that the arguments name."""
    from flowsplat.batch.options import BatchOptions
    from flowsplat.common.devices import DeviceName
    from flowsplat.output.export.options import ExportOptions, Format
    from flowsplat.output.videos import RenderOptions
    from flowsplat.output.viewer.options import ViewOptions
    from flowsplat.pipeline.config import Baselines, RunConfig, preset
    from flowsplat.training.config import TrainConfig

    named = _value_of(arguments, "--preset")
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
        out: Run, to: Format, path: Target = None, options: Exporting = ExportOptions()  # noqa: B008 (frozen)
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

        model, scene = pipeline.load(out), Scene(out / "scene")
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

    def demo(out: Out = Path("out/demo"), size: int = 320, frames: int = 40) -> None:
        """The main job on the built-in clip, with our own priors and with the true ones, side by side.

        Args:
            out: Folder for both runs.
            size: Width of the clip in pixels.
            frames: Number of frames.
        """
        from flowsplat.pipeline.demo import run_demo

        run_demo(out, size, frames)

    def benchmark() -> None:
        """Whole benchmarks over many scenes, to tables: flowsplat benchmark --help lists them."""

    return {
        "run": run, "batch": batch, "prepare": prepare, "train": train, "evaluate": evaluate, "render": render, "info": info,
        "demo": demo, "benchmark": benchmark, "view": view, "export": export, "tracks": tracks,
    }  # fmt: skip


def _benchmarks(arguments: Sequence[str] = ()) -> dict[str, Any]:
    """Every command behind ``flowsplat benchmark``, its defaults taken from the preset that the arguments name."""
    from flowsplat.common.devices import DeviceName, pick_device
    from flowsplat.pipeline.config import RunConfig, preset
    from flowsplat.protocols.ablations import benchmark as ablating
    from flowsplat.protocols.ablations import caps as capping
    from flowsplat.protocols.resume import BenchmarkOptions
    from flowsplat.training.config import TrainConfig

    defaults = preset(_value_of(arguments, "--preset") or "default")
    Numbers = tuple[int, ...]
    Names = tuple[str, ...]

    def changed(train: TrainConfig, device: DeviceName) -> RunConfig:
        pick_device(device)
        return replace(defaults, train=train, device=device)

    Root = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DATA_ROOT")]
    Options = Annotated[BenchmarkOptions, tyro.conf.arg(name="")]
    options = BenchmarkOptions()
    Out = Annotated[Path, tyro.conf.arg(aliases=("-o",), metavar="OUT")]

    def priors(root: Root, out: Out, scenes: tuple[str, ...] = (), again: bool = False, work: Options = options) -> None:
        """Cameras, flow, masks, depth and tracks of many scenes against the truth.

        Prepares every scene as flowsplat prepare does, in OUT/<scene>, and measures it: figures in OUT/<scene>.json, the table
        with targets in OUT/priors.md, with pictures in OUT/priors.html. The same command again continues where it was stopped;
        remove an OUT/<scene>.json to measure what is prepared once more.

        Args:
            root: Folder with rig/<scene> (rendered scenes), davis/<clip>/images and masks, and flow/<pair> (frame10.png,
                frame11.png and flow10.flo).
            out: Folder for everything that comes out.
            scenes: Names of the scenes to run; the default is all of them.
            again: Prepare and measure again what is there already; leave it out to go on from where that was stopped.
            work: How the benchmark is done.
        """
        from flowsplat.protocols.priors import run_priors_benchmark

        run_priors_benchmark(root, out, scenes, again, work)

    def davis(
        root: Root, out: Out, scenes: Names = (), masks: Literal["given", "own"] = "given", preset: Preset = "default",
        train: TrainConfig = defaults.train, device: DeviceName = "auto", again: bool = False, work: Options = options,
    ) -> None:  # fmt: skip
        """Whole runs on clips of DAVIS: every tenth frame is predicted; beside the paper's figures.

        Every clip is an ordinary run in OUT/<clip>_...; its figures are in the .json beside it, the tables in OUT/davis.md, with
        pictures in OUT/davis.html. The same command again continues where it was stopped.

        Args:
            root: Folder with davis/<clip>/images and masks, or with DAVIS itself (JPEGImages/480p, Annotations/480p).
            out: Folder for everything that comes out.
            scenes: Names of the clips to run; the default is all of them.
            masks: given (those of the data set, for training frames) or own (found by us; the given ones only measure).
            preset: How it is trained: fast, default, paper or high. Frames, their size and the split are the protocol's.
            train: Settings of training that differ from the preset's; the tables name them.
            device: What to compute on.
            again: Forget what is in OUT of these clips; leave it out to go on from where that was stopped.
            work: How the benchmark is done.
        """
        from flowsplat.protocols.datasets import davis_cases, run_benchmark

        run_benchmark("davis", davis_cases(root, scenes, masks, preset, changed(train, device)), out, again, work)

    def rig(
        root: Root, out: Out, scenes: Names = (), priors: Literal["true", "own"] = "own", preset: Preset = "default",
        train: TrainConfig = defaults.train, device: DeviceName = "auto", again: bool = False, work: Options = options,
    ) -> None:  # fmt: skip
        """Whole runs on rendered scenes: held-out cameras, and the errors of flow, depth and tracks in 3D.

        Results as of benchmark davis, in OUT/rig.md and OUT/rig.html.

        Args:
            root: Folder with rig/<scene>.
            out: Folder for everything that comes out.
            scenes: Names of the scenes to run; the default is all of them.
            priors: own (from the pictures alone) or true (cameras, depth, masks, flow and tracks of the renderer).
            preset: How it is trained: fast, default, paper or high. Frames and their size are the protocol's.
            train: Settings of training that differ from the preset's; the tables name them.
            device: What to compute on.
            again: Forget what is in OUT of these scenes; leave it out to go on from where that was stopped.
            work: How the benchmark is done.
        """
        from flowsplat.protocols.datasets import rig_cases, run_benchmark

        run_benchmark("rig", rig_cases(root, scenes, priors, preset, changed(train, device)), out, again, work)

    def nvidia(
        root: Root, out: Out, scenes: Names = (), preset: Preset = "default", train: TrainConfig = defaults.train,
        device: DeviceName = "auto", again: bool = False, work: Options = options,
    ) -> None:  # fmt: skip
        """Whole runs on the NVIDIA Dynamic Scenes: the other cameras of the rig; beside published figures.

        Results as of benchmark davis, in OUT/nvidia.md and OUT/nvidia.html.

        Args:
            root: Folder with nvidia/<scene>, each raw (mv_images and poses_bounds.npy), of twelve pictures (images,
                poses_bounds.npy and v000_t000.png ...), or as Dynamic Gaussian Marbles has them (camera, rgb and splits).
            out: Folder for everything that comes out.
            scenes: Names of the scenes to run; the default is all of them.
            preset: How it is trained: fast, default, paper or high. Frames and their size are the protocol's.
            train: Settings of training that differ from the preset's; the tables name them.
            device: What to compute on.
            again: Forget what is in OUT of these scenes; leave it out to go on from where that was stopped.
            work: How the benchmark is done.
        """
        from flowsplat.protocols.datasets import nvidia_cases, run_benchmark

        run_benchmark("nvidia", nvidia_cases(root, scenes, preset, changed(train, device)), out, again, work)

    def ablations(
        root: Root, out: Out, rows: Names = (), scenes: Names = ablating.SCENES, seeds: Numbers = ablating.SEEDS,
        iterations: int = ablating.ITERATIONS, again: bool = False, work: Options = options,
    ) -> None:  # fmt: skip
        """What every part of the method is worth: short trainings without it, beside the paper's three ablation tables.

        Scenes are prepared once, in OUT/scenes, and shared by all runs; each run is one process and one .json. The tables, with a
        verdict on every row (confirmed, contradicted, not separable, no difference or one run), are in OUT/ablations.md and
        OUT/ablations.html. The same command again continues where it was stopped.

        Args:
            root: Folder with davis/<clip>/images and masks, and rig/<scene>.
            out: Folder for everything that comes out.
            rows: Names of rows, or of whole tables (representation, training, orders, ours, baselines); the default is all of them.
            scenes: Names of the scenes. Clips are brought to 427 pixels of width and have given masks; rendered scenes keep their
                size and have true priors.
            seeds: Every row is trained once with each.
            iterations: Frame-steps of every run.
            again: Train and measure again what is in OUT already; prepared scenes stay. Leave it out to go on from where that was
                stopped.
            work: How the benchmark is done.
        """
        ablating.run_ablations(root, out, rows, scenes, seeds, iterations, again, work)

    def caps(
        root: Root, out: Out, scenes: Names = capping.SCENES, caps: Numbers = capping.CAPS, steps: Numbers = capping.STEPS,
        seeds: Numbers = capping.SEEDS, size: int = capping.SIZE, again: bool = False, work: Options = options,
    ) -> None:  # fmt: skip
        """What more Gaussians and more frame-steps bring: PSNR against both, as pictures.

        Results as of benchmark ablations, in OUT/caps.md and OUT/caps.html; each drawing is an .svg, too.

        Args:
            root: Folder with davis/<clip>/images and masks, and rig/<scene>.
            out: Folder for everything that comes out.
            scenes: Names of the scenes.
            caps: Numbers of Gaussians, each trained for 1,500 frame-steps.
            steps: Numbers of frame-steps, each with 200,000 Gaussians.
            seeds: Every point is trained once with each.
            size: Long side in pixels to which clips are brought, 0 = as they are; rendered scenes keep their size.
            again: Train and measure again what is in OUT already; prepared scenes stay. Leave it out to go on from where that was
                stopped.
            work: How the benchmark is done.
        """
        capping.run_caps(root, out, scenes, caps, steps, seeds, size, again, work)

    def oracles(
        root: Root, out: Out, scenes: Names = (), oracles: Names = (), preset: Preset = "default",
        train: TrainConfig = defaults.train, device: DeviceName = "auto", again: bool = False, work: Options = options,
    ) -> None:  # fmt: skip
        """What every prior costs: rendered scenes trained with one prior after the other replaced by the truth.

        A scene is prepared once with own priors, in OUT/scenes/<scene>. Each oracle is a copy with true layers in place of its own,
        in OUT/scenes/<scene>_<oracle>, and an ordinary run on it, in OUT/<scene>_<oracle>_...; its figures are in a .json in OUT,
        the tables in OUT/oracles.md and OUT/oracles.html. The same command again continues where it was stopped.

        Args:
            root: Folder with rig/<scene>.
            out: Folder for everything that comes out.
            scenes: Names of the scenes to run; the default is all of them.
            oracles: Which: own (nothing is true), constant, course, relief (of the depth of movers), outline (true masks, too),
                background (its depth, too), flow (too), cameras (all is true). Each holds what is true in those before it; the
                default is all of them.
            preset: How they are trained: fast, default, paper or high. Frames and their size are the protocol's.
            train: Settings of training that differ from the preset's; the tables name them.
            device: What to compute on.
            again: Forget oracle scenes, runs and figures that are in OUT of these; prepared scenes stay. Leave it out to go on from
                where that was stopped.
            work: How the benchmark is done.
        """
        from flowsplat.protocols.oracles import run_oracles

        run_oracles(root, out, scenes, oracles, preset, changed(train, device), again, work)

    def movers(out: Out, worlds: int = 40, seed: int = 0, again: bool = False, work: Options = options) -> None:
        """How far away moving objects are estimated to be, in random worlds with exact truth.

        Every world is rendered and prepared once, in OUT/<seed>, with our own cameras, flow and masks and with true ones. The
        tables are in OUT/movers.md and OUT/movers.html, the figures in OUT/results.json. The same command again continues where
        it was stopped. Seeds below 900 are for tuning, 900 to 999 decide between versions and are never looked at one by one,
        1000 to 1199 are only reported.

        Args:
            out: Folder for everything that comes out.
            worlds: How many worlds.
            seed: That of the first one; the others follow.
            again: Place the movers anew in worlds that are prepared already: what to call after that step was changed.
            work: How the benchmark is done.
        """
        from flowsplat.protocols.movers import run_movers_benchmark

        run_movers_benchmark(out, worlds, seed, again, options=work)

    return {
        "priors": priors, "davis": davis, "rig": rig, "nvidia": nvidia, "ablations": ablations, "caps": caps, "oracles": oracles,
        "movers": movers,
    }  # fmt: skip


def _with_present_names(arguments: Sequence[str]) -> list[str]:
    """The arguments with the names that options have now; a line says which had another one."""
    from flowsplat.common.settings import renamed_settings
    from flowsplat.pipeline.config import RunConfig, option_of

    renamed = {option_of(before): option_of(now) for before, now in renamed_settings(RunConfig).items()}
    found = []
    for argument in arguments:
        option, equals, value = argument.partition("=")
        now = renamed.get(option.replace("_", "-"))
        if now is not None:
            say(f"{option} is called {now} now.")
        found.append(argument if now is None else now + equals + value)
    return found


def _value_of(arguments: Sequence[str], option: str) -> str | None:
    for k, argument in enumerate(arguments):
        if argument == option and k + 1 < len(arguments):
            return arguments[k + 1]
        if argument.startswith(option + "="):
            return argument[len(option) + 1 :]
    return None


def _stored_config(arguments: Sequence[str]) -> Any:
    """The settings of the run that a command works on, if there is one."""
    from flowsplat.pipeline.folder import RunFolder

    for argument in arguments[1:]:
        if not argument.startswith("-") and (Path(argument) / "run.json").exists():
            return RunFolder(Path(argument)).config
    return None


def _stored_batch(arguments: Sequence[str]) -> Any:
    """The settings of the batch that a command continues, where it names nothing but that."""
    from flowsplat.batch.command import stored_plan

    if _value_of(arguments, "-o") is not None or _value_of(arguments, "--out") is not None:
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


def _short(text: str, command: str) -> str:
    """The help of a command as tyro prints it into a file, with the usual options only where there are many."""
    head, *sections = re.split(r"^ (?=\S.*\n -{9})", text, flags=re.M)
    options, usual, kept = 0, 0, [head]
    for section in sections:
        title, *entries = re.split(r"^  (?=-\w|--\w)", section, flags=re.M)
        chosen = [entry for entry in entries if re.split(r"[ ,\n]", entry, maxsplit=1)[0] in USUAL]
        options, usual = options + len(entries), usual + len(chosen)
        if chosen or not entries:
            kept.append(" " + "  ".join([title, *chosen]).rstrip() + "\n\n")
    short = f"{''.join(kept)}These are {usual} of {options} options. All of them: {command} --help-all\n"
    return short if options > MANY else text


def _one_line(box: str) -> str:
    """The message in one of tyro's boxes, as one line: of what one may have meant the names only."""
    text: list[str] = []
    meant: list[str] | None = None
    for line in (line.strip("│╭╮╰╯─ \n") for line in box.splitlines()):
        if line.startswith("For full helptext") or line == "Argument helptext:":
            break
        if not line.strip("-"):  # a rule
            continue
        if line == "Perhaps you meant:":
            meant = []
        elif meant is None:
            text.append(line)
        elif line.startswith("-"):
            meant += [name for name in re.findall(r"--[\w.-]+", line)[:1] if name not in meant]
    told = " ".join(text[1:] if len(text) > 1 else text)
    return f"{told}. Perhaps you meant {' or '.join(meant)}." if meant else told


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point of the console script. Bad input ends with one line on stderr and exit code 2."""
    whole_process = arguments is None
    if whole_process:  # Our matrices are small: two threads of BLAS take twice as long for the cameras, and give other last digits.
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    # tyro spells it None.
    for k, argument in enumerate(arguments):
        if argument == "--holdout=none" or (argument == "none" and k and arguments[k - 1] == "--holdout"):
            arguments[k] = argument[:-4] + "None"
    if not arguments:
        arguments = ["--help"]
    if arguments[0] in ("--version", "-V"):
        print(f"flowsplat {__version__}")
        return
    whole = "--help-all" in arguments
    arguments = ["--help" if argument == "--help-all" else argument for argument in arguments]
    arguments = _with_present_names(arguments)
    box, told = io.StringIO(), io.StringIO()
    prog, commands = "flowsplat", {}
    try:
        if arguments[0] == "benchmark":
            prog, commands, arguments = "flowsplat benchmark", _benchmarks(arguments), arguments[1:] or ["--help"]
        else:
            commands = _commands(arguments)
        call = _Deferred()
        with contextlib.redirect_stderr(box), contextlib.nullcontext() if whole else contextlib.redirect_stdout(told):
            tyro.extras.subcommand_cli_from_dict(
                {name: call.wrap(function) for name, function in commands.items()},
                prog=prog,
                description="One ordinary video becomes a 4D scene of moving Gaussians.",
                args=arguments,
            )
        with signals_stop():
            ended_well = call.run()
    except InputError as error:
        _fail(str(error))
    except SystemExit as error:
        if error.code == 2:
            _fail(_one_line(box.getvalue()) or "The command line cannot be understood: see flowsplat --help.")
        text = told.getvalue()
        print(_short(text, f"{prog} {arguments[0]}") if prog == "flowsplat" else text, end="")
        raise
    except KeyboardInterrupt as error:
        if whole_process:  # a second Ctrl-C would be a traceback of whatever the interpreter is closing
            ignore_signals()
        with contextlib.suppress(OSError):  # of a terminal that is closed
            say("Stopped. The same command continues from here.")
        sys.exit(128 + (error.signal if isinstance(error, Stopped) else 2))
    except BrokenPipeError:
        os._exit(0)
    except OSError as error:
        if error.filename is None:
            raise
        _fail(f"{os.fsdecode(error.filename) if isinstance(error.filename, bytes) else error.filename}: {error.strerror}.")
    else:
        if ended_well is False:
            sys.exit(1)


class _Deferred:
    """Runs the chosen command only after parsing, so that parsing errors can be told from its own output."""

    def __init__(self) -> None:
        self._chosen: Any = None

    def wrap(self, function: Any) -> Any:
        """The function with the same signature, which only remembers its arguments."""
        import functools

        @functools.wraps(function)
        def remember(*args: Any, **kwargs: Any) -> None:
            self._chosen = functools.partial(function, *args, **kwargs)

        return remember

    def run(self) -> Any:
        """Run what was chosen, and return what it does."""
        return None if self._chosen is None else self._chosen()


def _fail(message: str) -> None:
    say(f"Error: {one_line(message)}")
    sys.exit(2)


if __name__ == "__main__":
    main()
