"""Stopping loses nothing: Ctrl-C, SIGTERM, a closed terminal."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time

import pytest

from flowsplat.cli import main
from flowsplat.pipeline import prepare, run
from flowsplat.training.trainer import Trainer
from tests.marks import slow
from tests.shared import small_config


@pytest.fixture(autouse=True)
def signals_as_usual():
    """Also where these tests run under ``nohup`` or in the background of a shell, where some are ignored."""
    usual = {signal.SIGINT: signal.default_int_handler, signal.SIGTERM: signal.SIG_DFL, signal.SIGHUP: signal.SIG_DFL}
    before = {number: signal.signal(number, handler) for number, handler in usual.items()}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.parametrize("name", ["SIGINT", slow("SIGTERM"), slow("SIGHUP")])
def test_a_signal_keeps_what_was_done(tiny_scene, finished, tmp_path, monkeypatch, capsys, name):
    out, number, iterate = tmp_path / "out", getattr(signal, name), Trainer.iterate
    before = signal.getsignal(number)
    prepare(tiny_scene, out, small_config())

    def asked(self):
        if self.step == 16:
            os.kill(os.getpid(), number)
        return iterate(self)

    monkeypatch.setattr(Trainer, "iterate", asked)
    with pytest.raises(SystemExit) as error:
        main(["train", str(out)])
    assert error.value.code == 128 + number
    said = capsys.readouterr().err
    assert "Stopped after step 17 of 30. They are kept." in said
    assert "The same command continues from here." in said
    assert json.loads((out / "training" / "latest.json").read_text())["step"] == 17
    assert signal.getsignal(number) == before
    monkeypatch.setattr(Trainer, "iterate", iterate)
    main(["train", str(out)])
    assert "Going on from step 17 of 30." in capsys.readouterr().err
    model = "model/gaussians.safetensors"
    assert (out / model).read_bytes() == (finished / model).read_bytes()


def test_a_second_signal_stops_at_once(tiny_scene, tmp_path, monkeypatch):
    def asked_twice(self):
        os.kill(os.getpid(), signal.SIGINT)
        os.kill(os.getpid(), signal.SIGINT)
        pytest.fail("went on")

    monkeypatch.setattr(Trainer, "iterate", asked_twice)
    with pytest.raises(KeyboardInterrupt):
        run(tiny_scene, tmp_path / "out", small_config())
    assert not (tmp_path / "out" / "training" / "latest.json").exists()


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM"])
def test_outside_of_a_training_the_line_and_the_code_are_the_same(tmp_path, monkeypatch, capsys, name):
    def asked(path):
        os.kill(os.getpid(), getattr(signal, name))
        time.sleep(5)

    monkeypatch.setattr("flowsplat.pipeline.describe.describe", asked)
    with pytest.raises(SystemExit) as error:
        main(["info"])
    assert error.value.code == 128 + getattr(signal, name)
    assert "Stopped." in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="has no terminals of this kind")
def test_a_closed_terminal_leaves_a_checkpoint(tiny_scene, tmp_path):
    import fcntl
    import pty
    import termios

    out, (ours, theirs) = tmp_path / "out", pty.openpty()
    config = small_config()
    prepare(tiny_scene, out, config)
    code = "from flowsplat.cli import main; main()"
    command = [sys.executable, "-c", code, "train", str(out), "--train.iterations", "200000"]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
    process = subprocess.Popen(
        command, stdin=theirs, stdout=theirs, stderr=theirs, env=environment, start_new_session=True,
        preexec_fn=lambda: fcntl.ioctl(0, termios.TIOCSCTTY, 0),
    )  # fmt: skip
    os.close(theirs)
    try:
        said = b""
        while b"Training" not in said:
            said += os.read(ours, 4096)
        time.sleep(1)
        os.close(ours)
        process.wait(timeout=60)
    finally:
        process.kill()
    assert json.loads((out / "training" / "latest.json").read_text())["step"] > 0
