"""The commands behind ``flowsplat benchmark``, one thin function each."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from flowsplat.cli.arguments import value_of
from flowsplat.cli.commands import Preset


def benchmark_commands(arguments: Sequence[str] = ()) -> dict[str, Any]:
    """Every command behind ``flowsplat benchmark``, its defaults taken from the preset that the arguments name."""
    from flowsplat.common.devices import DeviceName, pick_device
    from flowsplat.pipeline.config import RunConfig, preset
    from flowsplat.protocols.ablations import benchmark as ablating
    from flowsplat.protocols.ablations import caps as capping
    from flowsplat.protocols.resume import BenchmarkOptions
    from flowsplat.training.config import TrainConfig

    defaults = preset(value_of(arguments, "--preset") or "default")
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
