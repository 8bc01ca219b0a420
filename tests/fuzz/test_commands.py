"""Commands with values that make no sense: each ends well or with one line and exit code 2."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_type_hints

import numpy as np
import pytest

from flowsplat import pipeline
from flowsplat.cli import main
from flowsplat.common.errors import MAX_MESSAGE_CHARACTERS
from flowsplat.output.export.options import ExportOptions
from flowsplat.output.videos import settle
from flowsplat.output.viewer.options import ViewOptions
from flowsplat.pipeline.config import RunConfig, check, format_option
from flowsplat.priors.objects.hints import parse_hints
from flowsplat.priors.prompts import parse_prompts
from flowsplat.scenes import Scene
from tests.marks import slow
from tests.output.small import small_model, small_run

FEW, MANY = 60, 260
HOSTILE = (
    "nan", "inf", "-inf", "1e308", "-1e308", "1e-320", "-1", "0", "2", "0.5", "9" * 30, "9" * 5000, "", " ", "x", "None", "true",
    "-", "--", "../../evil", "/dev/zero", "/etc/passwd", "a\nb", "\x1b[31m", "\ud800",
    "x" * 20_000, "1,2@0", "1e400,1@0", "-5,nan@0",
    "1,1@99999", "1,1,1,1@0", "objects:0", "objects:" + "1," * 500, "2=nan", "2=1e300", "2=", "=", "%s{}", "'", '"', "\u0663",
    "http://127.0.0.1:9/", "NUL",
)  # fmt: skip


def options(kind: Any, prefix: str = "") -> Iterator[str]:
    """Every setting by its dotted name."""
    for field in dataclasses.fields(kind):
        hint = get_type_hints(kind)[field.name]
        if dataclasses.is_dataclass(hint):
            yield from options(hint, f"{prefix}{field.name}.")
        else:
            yield prefix + field.name


def commands(run: Path) -> Iterator[list[str]]:
    """Without end, always the same ones."""
    rng = np.random.default_rng(25)

    def of(values: Any) -> str:
        return str(values[int(rng.integers(len(values)))])

    named = [format_option(name) for name in options(RunConfig)]
    others = {
        "export": [f"--{name.replace('_', '-')}" for name in options(ExportOptions)] + ["--to"],
        "view": [f"--{name.replace('_', '-')}" for name in options(ViewOptions) if name != "host"],
        "tracks": ["--at", "--queries"],
        "info": ["--help-all"],
        "compare": ["--out"],
        "demo": ["--size", "--frames", "--world"],
    }
    while True:
        which = of(["run", "run", "run", "prepare", *others])
        if which in others:
            command = [
                which,
                *([] if which == "demo" else [str(run)] * (1 + (which == "compare"))),
                *(["--to", "ply"] if which == "export" else []),
            ]
            chosen = others[which]
        else:
            command, chosen = [which, str(run / "scene"), "-o", str(run.parent / "new")], named
        for _ in range(int(rng.integers(1, 3))):
            command += [of(chosen), of(HOSTILE)]
        if rng.random() < 0.1:
            command.insert(int(rng.integers(len(command) + 1)), of(HOSTILE))
        yield command


@pytest.mark.parametrize(("first", "count"), [(0, FEW), slow(FEW, MANY - FEW)])
def test_senseless_commands(tmp_path, monkeypatch, capfd, first, count):
    run = small_run(tmp_path / "run", small_model(resting=60, moving=30))
    (run / "run.json").write_text("{}")

    def looked_at(source: Path, out: Path, config: RunConfig) -> Any:
        """What is asked before anything is computed."""
        check(config)
        config.input.check()
        scene = Scene(Path(source))
        settle(scene, config.render)
        parse_prompts(config.priors.mask_click, config.priors.mask_box, scene, config.priors.mask_negative)
        parse_hints(config.priors.contact, config.priors.same_depth, scene)
        raise SystemExit(0)

    monkeypatch.setattr(pipeline, "run", looked_at)
    monkeypatch.setattr(pipeline, "prepare", looked_at)
    monkeypatch.setattr("flowsplat.output.viewer.server.view", lambda folder, options: None)
    monkeypatch.setattr("flowsplat.pipeline.demo.write_synthetic", lambda *_, **__: (_ for _ in ()).throw(SystemExit(0)))
    monkeypatch.chdir(tmp_path)
    failed, refused = [], 0
    for _, command in zip(range(count), itertools.islice(commands(run), first, None), strict=False):
        capfd.readouterr()
        code: object = 0
        try:
            main(list(command))
        except SystemExit as end:
            code = end.code or 0
        except BaseException as error:
            code = repr(error)
        told = capfd.readouterr().err
        last = told.strip().splitlines()[-1:] or [""]
        if code == 2:
            refused += 1
        is_line = code != 2 or (last[0].startswith("Error: ") and len(last[0]) < MAX_MESSAGE_CHARACTERS + 100)
        if code not in (0, 2) or "Traceback" in told or not is_line:
            failed.append((command, code, told[-500:]))
    assert not failed, "\n".join(f"{command!r:.300}: {code} {told}" for command, code, told in failed[:15])
    assert refused > count / 3
    assert {path.name for path in tmp_path.iterdir()} <= {"run", "out"}
