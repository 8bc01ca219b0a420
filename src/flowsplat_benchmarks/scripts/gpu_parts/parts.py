"""The parts of ``everything``. Each is given a record, which is in its file whenever something was found."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch

from flowsplat.common.errors import first_line
from flowsplat.common.files import write_json
from flowsplat.gaussians.gaussians4d import Gaussians4D
from flowsplat.splatting.triton import blending
from flowsplat.training.config import PRESETS
from flowsplat.training.history import Figures
from flowsplat.training.state import TrainState
from flowsplat.training.step import StepOutput
from flowsplat.training.trainer import Trainer
from flowsplat_benchmarks.scripts.cpu_parts import scene as drawn
from flowsplat_benchmarks.scripts.cpu_parts.timing import replace_attribute, significant, tell
from flowsplat_benchmarks.scripts.gpu_parts import compilations, frames, interpreted, machine, reports

ROOT = Path(__file__).parents[4]
KERNEL_TESTS = (
    "tests/splatting/triton/test_functions.py", "tests/gaussians/test_triton.py", "tests/training/test_triton.py",
    "tests/training/test_trainer_on_triton.py", "tests/gaussians/test_cuda_graph.py", "tests/common/test_triton.py",
    "tests/gpu/test_full_size.py",
)  # fmt: skip
TESTS_AT_ONCE = 14
"""Processes that test, at most. Chosen by eye."""
WIDTH, HEIGHT = 854, 480
"""Pixels."""
REHEARSED_SIZE = (32, 16)
"""Pixels of images in a rehearsal: two tiles. Triton's interpreter takes seconds for a tile."""
STREET_SIZE = (32, 32)
"""Pixels of the clip of the street that a rehearsal trains on: it is drawn no smaller."""
REHEARSED_GAUSSIANS = 60
TRAINING_STEPS = 200
"""Training steps that are compared."""
COMPARED_STEPS = (1, 10, 50, 100, TRAINING_STEPS)
"""Steps after which the losses of both are compared."""
CHOSEN = {name: getattr(blending, name) for name in ("FORWARD_WARPS", "GAUSSIANS_PER_STEP", "CHECK_EVERY", "BACKWARD_WARPS")}
"""As the package has them."""
CPU_SECONDS = 100
"""What training the small scene takes on a processor of some cores, with compiling: begun only where there is time for it."""
RELATIVE_NUDGE = 1e-7
"""Relative: about the rounding of one float32."""


@dataclass
class Record:
    """What a part has found so far.

    Attributes:
        file: where it is written to, whenever something is set.
        work: a folder that all parts share; runs of ``training`` are in it.
        seconds: how long the part may take in all.
        rehearse: whether sizes are to be tiny.
        broken: whether blending is broken on purpose.
        scenes: prepared scenes that the user named.
    """

    file: Path
    work: Path
    seconds: float
    rehearse: bool = False
    broken: bool = False
    scenes: tuple[Path, ...] = ()
    _values: dict[str, Any] = field(default_factory=dict)
    _began: float = field(default_factory=time.monotonic)

    def __setitem__(self, name: str, value: Any) -> None:
        self._values[name] = value
        write_json(self.file, self._values)

    @property
    def left(self) -> float:
        """Seconds until the part is ended."""
        return self.seconds - (time.monotonic() - self._began)

    @property
    def repeat(self) -> int:
        """How often what is timed is done."""
        return 1 if self.rehearse else 60

    def size(self, width: int, height: int) -> tuple[int, int]:
        """Return the size of an image: a small one in a rehearsal."""
        return REHEARSED_SIZE if self.rehearse else (width, height)

    def count(self, count: int) -> int:
        """Return the number of Gaussians: few in a rehearsal."""
        return min(count, REHEARSED_GAUSSIANS) if self.rehearse else count

    def attempt(self, name: str, job: Callable[[], Any]) -> Any:
        """Do one thing of several; where it fails, the record says how, and the others still come."""
        try:
            value = job()
        except Exception as error:  # compilers and drivers fail with errors of their own
            self[name] = {"failed": f"{type(error).__name__}: {first_line(error)}"}
            tell(f"{name}: {traceback.format_exc()}")
            return None
        self[name] = value
        return value


def kernels(record: Record) -> None:
    """The tests of the kernels: on a card, on the card."""
    report = record.file.with_suffix(".tests")
    files = KERNEL_TESTS[:1] if record.rehearse else KERNEL_TESTS
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "--tb=short", "-p", reports.__name__, *files]
    if record.rehearse:
        command += ["-k", "equal_depths or alpha_is_clamped"]
    else:
        command += ["-k", "not compiles_for"]  # for cards that are not there
    if torch.cuda.is_available() and not record.rehearse and importlib.util.find_spec("xdist") is not None:
        command += ["-n", str(min(TESTS_AT_ONCE, os.cpu_count() or 1))]
    path = os.pathsep.join([str(ROOT), *sys.path[1:]])
    environment = {**os.environ, "PYTHONPATH": path, "FLOWSPLAT_TEST_REPORT": str(report)}
    if record.broken:
        command += ["-p", interpreted.__name__]
    process = subprocess.Popen(command, cwd=ROOT, env=environment)
    while process.poll() is None:
        time.sleep(0.2)
        if report.exists():
            record["tests"] = reports.summary(report)
    record["tests"] = reports.summary(report)
    if process.returncode != 0:
        raise SystemExit(process.returncode)


def _trainer(record: Record, name: str = "default", total: int = frames.GAUSSIANS) -> Trainer:
    """Return some steps into training on drawn Gaussians, with a preset's settings."""
    width, height = record.size(WIDTH, HEIGHT)
    config = replace(PRESETS[name], iterations=2 if record.rehearse else 2 * drawn.FRAMES, frames_per_iteration=1, preview_every=0)
    with replace_attribute(drawn, "BACKGROUND_SHARE", frames.REST_SHARE):
        start = drawn.gaussians(config.model, record.count(total), width, height)
    trainer = Trainer(drawn.observations(start, width, height), None, config, start=start, device=machine.device())
    trainer.run()
    return trainer


def step(record: Record) -> None:
    """A step of each preset; what the card spends it on; and other numbers of warps."""
    kept: dict[str, Trainer] = {}

    def of(name: str) -> dict[str, Any]:
        machine.forget_peak()
        trainer = kept[name] = _trainer(record, name)
        wall, repeat = time.perf_counter(), record.repeat
        step = machine.milliseconds(trainer.iterate, repeat, warm_up=1)
        wall = 1e3 * (time.perf_counter() - wall) / (repeat + 1)
        return {"step": step, "wall_ms": significant(wall), "peak_memory_gib": machine.peak_gib()}

    for name in ("default",) if record.rehearse else ("default", "paper"):
        record.attempt(name, lambda name=name: of(name))  # type: ignore[misc]
    trainer = kept.get("default")
    if trainer is None:
        return
    record.attempt("kernels", lambda: machine.profile(trainer.iterate, 1 if record.rehearse else 12))
    if record.rehearse:
        return
    sweeps = {
        "FORWARD_WARPS": ("blend_forward", (1, 2, 4, 8)), "GAUSSIANS_PER_STEP": ("blend_forward", (2, 4, 8)),
        "CHECK_EVERY": ("blend_forward", (16, 32, 64)), "BACKWARD_WARPS": ("blend_backward", (1, 2, 4)),
    }  # fmt: skip
    tried: dict[str, dict[str, float]] = {}
    for name, (kernel, values) in sweeps.items():
        before = getattr(blending, name)
        tried[name] = {}
        for value in values:
            setattr(blending, name, value)
            try:
                # What the card spends on it: by the clock a step is the host's.
                found = machine.profile(trainer.iterate, 6)["kernels"].get(kernel, {"ms": 0.0})
                tried[name][str(value)] = found["ms"]
            except Exception as error:  # more registers or shared memory than there are, say
                tell(f"{name} = {value}: {error}")
        best = min(tried[name], key=lambda value: tried[name][value], default=str(before))
        setattr(blending, name, int(best))
        record["warps"] = {"chosen": {name: str(value) for name, value in CHOSEN.items()}, "ms of its kernel": tried}


def memory(record: Record) -> None:
    """Ever more Gaussians."""
    for count in (100,) if record.rehearse else (196_000, 500_000, 1_000_000, 2_000_000, 5_000_000):
        size = record.size(WIDTH, HEIGHT)
        record.attempt(f"{count:,}", lambda count=count, size=size: frames.growth((count,), record.repeat, size)[f"{count:,}"])  # type: ignore[misc]
        machine.forget_peak()


def frames_a_second(record: Record) -> None:
    """Drawn Gaussians, stage by stage."""
    limits = record.attempt("limits", lambda: machine.limits(record.repeat, small=record.rehearse))
    for name, (width, height) in frames.SIZES.items():
        size = record.size(width, height)
        model = frames.gaussians(record.count(frames.GAUSSIANS), *size)
        for channels in list(frames.WAYS)[-1 if record.rehearse else 0 :]:
            if limits is not None:
                image = frames.Frames(model, *size, channels)
                record.attempt(f"{name}, C = {channels}", lambda image=image: image.measure(limits, record.repeat))  # type: ignore[misc]
        if record.rehearse:
            break


def viewing(record: Record) -> None:
    """What ``training`` left, seen as a viewer sees it."""
    for run in sorted(path.parent for path in record.work.glob("*/run.json")):
        record.attempt(f"trained: {run.name}", lambda run=run: _measure_viewing(record, run))  # type: ignore[misc]


def _measure_viewing(record: Record, run: Path) -> dict[str, Any]:
    """Return frames a second of a trained scene along its path, by graphs as in the viewer; the images stay on the card."""
    from flowsplat import pipeline
    from flowsplat.pipeline.folder import RunFolder
    from flowsplat.scenes import Scene

    scene = Scene(RunFolder(run).scene_path)
    model = replace(pipeline.load(run, device=machine.device()), graphs=True, fill=False)
    found: dict[str, Any] = {"gaussians": len(model.gaussians)}
    for name, height in (("480p", 480), ("1080p", 1080)):
        cameras = [_resize(camera, 0.2 if record.rehearse else height / camera.height) for camera in scene.cameras]
        for flow in (False, True):
            path = _Path(model, cameras, scene.timestamps, flow)
            frames_a_second = _frames_a_second(path, record.rehearse)
            found[f"{name}{' with flow' if flow else ''}, {cameras[0].width}x{cameras[0].height}"] = frames_a_second
    return found


@dataclass(frozen=True)
class _Path:
    """A scene along the clip's cameras, each frame with the flow to the next, or without."""

    model: Any
    cameras: list[Any]
    times: Any
    flow: bool

    def draw(self, k: int) -> None:
        """Frame k."""
        model, following = self.model, None
        if self.flow:
            following = model.similarity.camera(self.cameras[k + 1]), model.clip_time(float(self.times[k + 1]))
        model._draw(model.similarity.camera(self.cameras[k]), float(self.times[k]), following)


def _frames_a_second(path: _Path, once: bool) -> float:
    """By the clock, after a round in which buffers grow."""
    numbers = range(0, len(path.cameras) - 1, len(path.cameras) - 1 if once else 1)
    for k in numbers:
        path.draw(k)
    machine.synchronize()
    began, count = time.perf_counter(), 0
    while count == 0 or (time.perf_counter() - began < 1.0 and not once):
        for k in numbers:
            path.draw(k)
        machine.synchronize()
        count += len(numbers)
    return significant(count / (time.perf_counter() - began))


def _resize(camera: Any, factor: float) -> Any:
    width, height = max(round(camera.width * factor), 8), max(round(camera.height * factor), 8)
    K = camera.K.copy()
    K[0] *= width / camera.width
    K[1] *= height / camera.height
    return type(camera)(camera.viewmat, K, width, height)


def training(record: Record) -> None:
    """The demo's clip with true priors, on both; then the scenes that were named, on the card."""
    from flowsplat import pipeline
    from flowsplat.scenes.synthetic import StreetScene, write_synthetic

    start = pipeline.preset("default")
    given = record.work / "street"
    small = record.rehearse
    write_synthetic(
        given,
        StreetScene(*(STREET_SIZE if small else (320, 180)), frames=4 if small else 40),
        holdout=3 if small else 10,
    )
    config = replace(
        start, priors=replace(start.priors, priors="true"), coarse_scene=False, final_fit=False, refine_poses=not small,
        train=replace(start.train, iterations=2 if small else start.train.iterations),
    )  # fmt: skip
    if small:
        # The interpreter takes an empty tensor that was read from a file for the one that lies behind it there.
        train = config.train
        model, density = (
            replace(train.model, mean_fourier=1, quat_fourier=1),
            replace(train.density, max_gaussians=record.count(10**6)),
        )
        config = replace(config, train=replace(train, model=model, density=density))
    # Videos are encoded on the processor; how fast images are drawn is another part's.
    plain = replace(config, render=replace(config.render, paths=()))
    record.attempt("street, card", lambda: _whole(given, record.work / "street-card", plain, machine.device()))
    own = replace(plain, priors=start.priors)
    for scene in record.scenes:
        name = f"{scene.name}-card"
        record.attempt(f"{scene.name}, card", partial(_whole, scene, record.work / name, own, machine.device()))
    if not small and record.left > CPU_SECONDS:
        record.attempt("street, CPU", lambda: _whole(given, record.work / "street-cpu", plain, "cpu"))


def _whole(scene: Path, out: Path, config: Any, device: str) -> dict[str, Any]:
    """Return a run from a prepared scene to its figures: seconds by the clock."""
    from flowsplat import pipeline

    began = time.perf_counter()
    run = pipeline.prepare(scene, out, replace(config, device=device))
    prepared = time.perf_counter()
    machine.forget_peak()
    pipeline.train(run)
    trained = time.perf_counter()
    peak = machine.peak_gib()
    metrics = pipeline.evaluate_run(run)
    ended = time.perf_counter()
    names = ("heldout_frames", "training_frames", "heldout_views")
    return {
        "preparing_seconds": significant(prepared - began), "training_seconds": significant(trained - prepared),
        "rest_seconds": significant(ended - trained), "peak_memory_gib": peak, "steps": config.train.iterations,
        "psnr": {name: significant(metrics[name]["psnr"]) for name in names if metrics.get(name)},
        "moving_psnr": {
            name: significant(metrics[name]["moving"]["psnr"])
            for name in names if metrics.get(name) and metrics[name].get("moving")
        },
    }  # fmt: skip


def agreement(record: Record) -> None:
    """Parameters and images apart after so many steps, and how far a CPU's own are when it starts one rounding beside."""
    # What the CPU's trainers compute in Numba they compute on a card's host as everywhere; no kernels of Triton there.
    width, height = record.size(320, 180)
    steps = 3 if record.rehearse else TRAINING_STEPS
    config = replace(PRESETS["default"], iterations=steps, frames_per_iteration=1, preview_every=0)
    config = replace(config, average=0.0, density=replace(config.density, every=0, reset_every=0))
    truth = drawn.gaussians(config.model, record.count(20_000), width, height)
    seen = drawn.observations(truth, width, height)
    start = _perturb(truth, 0.0)
    generator = torch.Generator().manual_seed(1)
    start.params["sh"] += 0.2 * torch.randn(start.params["sh"].shape, generator=generator)
    start.params["means"] *= 1 + 0.002 * torch.randn(start.params["means"].shape, generator=generator)
    states = {"CPU": list(_states(start, seen, config, "cpu"))}
    states["CPU, one rounding beside"] = list(_states(_perturb(start, RELATIVE_NUDGE), seen, config, "cpu"))
    if record.rehearse:
        interpreted.compute_with_triton()
    states["card"] = list(_states(start, seen, config, machine.device()))
    first = {name: value.clone() for name, value in start.params.items()}
    for name, theirs in states.items():
        if name == "CPU":
            continue
        record[name] = {
            str(at): {parameter: _apart(ours[parameter], state[parameter], first[parameter]) for parameter in first}
            for (at, ours), (_, state) in zip(states["CPU"], theirs, strict=True)
        }
    record["images"] = _images(states, truth, width, height)


def _states(start: Gaussians4D, seen: Any, config: Any, device: str) -> Iterator[tuple[int, dict[str, torch.Tensor]]]:
    """Yield the parameters at some steps."""
    found: list[tuple[int, dict[str, torch.Tensor]]] = []
    trainer = Trainer(seen, None, config, start=_perturb(start, 0.0), device=device)

    def look(state: TrainState, _step: StepOutput, _figures: Figures) -> None:
        if state.step in COMPARED_STEPS or state.step == config.iterations:
            found.append((state.step, {name: value.cpu().clone() for name, value in state.gaussians.params.items()}))

    trainer.callbacks.append(look)
    trainer.run()
    yield from found


def _perturb(gaussians: Gaussians4D, relative: float) -> Gaussians4D:
    """Return a copy, which training changes; every number by about so much of itself."""
    g, generator = gaussians, torch.Generator().manual_seed(2)
    params = {name: value * (1 + relative * torch.randn(value.shape, generator=generator)) for name, value in g.params.items()}
    return Gaussians4D(params, g.dynamic.clone(), g.config, g.sh_degree, g.object_ids)


def _apart(ours: torch.Tensor, theirs: torch.Tensor, first: torch.Tensor) -> float | None:
    """Return how far two are apart, relative to how far training has moved them; None where it has moved nothing."""
    moved = float((ours.double() - first.double()).norm())
    return significant(float((ours.double() - theirs.double()).norm()) / moved) if moved > 0 else None


def _images(states: Any, truth: Gaussians4D, width: int, height: int) -> dict[str, Any]:
    """PSNR in dB of the last state's images against those of the CPU, and of each against what was to be learned."""
    from flowsplat.gaussians.render import render

    camera = drawn.cameras(drawn.work_load(1, width, height))[1]

    def image(params: dict[str, torch.Tensor]) -> torch.Tensor:
        g = Gaussians4D(params, truth.dynamic, truth.config, truth.sh_degree, truth.object_ids)
        return render(g, camera, 0.2).color

    def psnr(one: torch.Tensor, other: torch.Tensor) -> float:
        return significant(float(-10 * torch.log10((one - other).square().mean().clamp(min=1e-12))))

    with torch.no_grad():
        shown = {name: image(found[-1][1]) for name, found in states.items()}
        aim = image(truth.params)
    return {name: {"to the aim": psnr(value, aim), "to the CPU's": psnr(value, shown["CPU"])} for name, value in shown.items()}


def gsplat(record: Record) -> None:
    """gsplat on the same Gaussians, when its kernels are compiled."""
    limit = record.left
    if record.rehearse:
        record["gsplat"] = "not rehearsed: it has no interpreter"
        return
    began = time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-c", "import gsplat.cuda._backend"], timeout=limit, check=False, capture_output=True, text=True
    )
    record["waited for its compiler"] = {"seconds": significant(time.perf_counter() - began), "said": done.stderr[-600:]}
    for name, (width, height) in frames.SIZES.items():
        model = frames.gaussians(frames.GAUSSIANS, width, height)
        for channels in frames.WAYS:
            image = frames.Frames(model, width, height, channels)
            record.attempt(f"{name}, C = {channels}", lambda image=image: image.compare_with_gsplat(record.repeat))  # type: ignore[misc]


BY_NAME: dict[str, Callable[[Record], None]] = {
    "kernels": kernels, "step": step, "frames": frames_a_second, "agreement": agreement, "memory": memory, "gsplat": gsplat,
    "training": training, "viewing": viewing,
}  # fmt: skip


def run(name: str, record: Record) -> None:
    """One part, in this process."""
    record["machine"] = machine.describe()
    if record.rehearse and name not in ("kernels", "agreement"):
        interpreted.compute_with_triton()
    if record.broken:
        interpreted.break_blending()
    with compilations.count_compilations() as counted:
        try:
            BY_NAME[name](record)
        finally:
            record["compilations"] = counted.summary()
