"""The GPU benchmark where there is no GPU. How fast anything is, is not tested."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch

from flowsplat_benchmarks import scripts

COMMAND = (sys.executable, "-m", "flowsplat_benchmarks.scripts.gpu")
RESULTS = Path(scripts.__file__).parent / "results"


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_without_a_gpu_it_says_so_in_one_line():
    done = subprocess.run([*COMMAND, "--everything"], capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 2
    assert done.stderr.startswith("There is no GPU to measure: ")
    assert len(done.stderr.strip().splitlines()) == 1
    assert done.stdout == ""


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "one of the arguments"),
        (["--only", "nothing"], "invalid choice: 'nothing'"),
        (["--page", "not-there.json"], "not-there.json"),
        (["--page", "other.json"], "other.json"),
        (["--everything", "--plan", "--minutes", "nan"], "--minutes nan must be more than 0"),
        (["--everything", "--rehearse", "--scene", "."], "is no prepared scene"),
        (["--only", "memory", "--rehearse", "-o", "other.json"], "other.json"),
    ],
)
def test_what_cannot_be_used_is_said(tmp_path, words, message, monkeypatch, capsys):
    from flowsplat_benchmarks.scripts import gpu

    monkeypatch.chdir(tmp_path)
    Path("other.json").write_text('{"parts": 3}', encoding="utf-8")
    monkeypatch.setattr(sys, "argv", ["gpu", *words])
    with pytest.raises(SystemExit) as end:
        gpu.main()
    assert end.value.code == 2
    said = capsys.readouterr()
    assert message in said.err
    assert "Traceback" not in said.err
    assert said.out == ""
    assert Path("other.json").read_text(encoding="utf-8") == '{"parts": 3}'


def test_its_parts_measure_what_they_say(monkeypatch):
    """On the CPU, where there is no GPU: times mean nothing, but every stage runs and every figure is there."""
    frames = pytest.importorskip("flowsplat_benchmarks.scripts.gpu_parts.frames")
    if not torch.cuda.is_available():
        monkeypatch.setattr(frames, "milliseconds", lambda job, repeat: (job(), {"min_ms": 1.0, "median_ms": 1.5})[1])
    model = frames.gaussians(300, 40, 24)
    for channels in frames.WAYS:
        image = frames.Frames(model, 40, 24, channels)
        row = image.measure({"copy_bytes_per_second": 1e12, "flops_per_second": 1e13}, 1)
        assert image.features.shape[1] in (channels, channels + 1)
        assert row["pairs"] > 1000
        assert 0 < row["active"] < row["total"] == len(model)
        assert set(row["stages"]) == {"cull", "slice", "project", "features", "blend"}
        peer = image.compare_with_gsplat(1)
        assert isinstance(peer, str) or peer["ratio"]["forward"] > 0
    monkeypatch.setattr(frames, "GAUSSIANS", 300)
    assert frames.growth((300,), 1)["300"]["active"] > 0


FAKE = """
import json, os, pathlib, signal, sys, time
given = dict(zip(sys.argv[1::2], sys.argv[2::2]))
name, out = given["--part"], pathlib.Path(given["--out"])
out.write_text(json.dumps({"machine": {"card": "a card"}, "found": name}))
if name == "fails":
    print("what went wrong"); sys.exit(3)
if name == "hangs":
    time.sleep(600)
if name == "dies":
    os.kill(os.getpid(), signal.SIGKILL)
"""


def test_a_part_that_fails_hangs_or_dies_costs_its_own_figures_and_no_others(tmp_path, monkeypatch, capsys):
    everything = pytest.importorskip("flowsplat_benchmarks.scripts.gpu_parts.everything")
    fake = tmp_path / "gpu.py"
    fake.write_text(FAKE, encoding="utf-8")
    monkeypatch.setattr(everything, "COMMAND", (str(fake),))
    monkeypatch.setattr(everything, "GRACE_SECONDS", 0.2)
    parts = tuple(everything.GpuPart(name, weight, "") for name, weight in (("fails", 9), ("hangs", 1), ("dies", 9), ("works", 9)))
    monkeypatch.setattr(everything, "PARTS", parts)
    out = tmp_path / "out.json"
    result = everything.measure(out, 0.5, parts, rehearse=True)
    assert result == json.loads(out.read_text(encoding="utf-8"))
    outcomes = {name: part["outcome"].split(":")[0] for name, part in result["parts"].items()}
    assert outcomes == {"fails": "failed with code 3", "hangs": "stopped", "dies": "failed with code -9", "works": "done"}
    assert all(part["figures"] == {"found": name} for name, part in result["parts"].items())
    assert result["parts"]["fails"]["output"] == ["what went wrong"]
    assert result["machine"] == {"card": "a card"}
    # One alone, later: the others' figures stay.
    fake.write_text(FAKE.replace("sys.exit(3)", "sys.exit(0)"), encoding="utf-8")
    again = everything.measure(out, 0.5, parts[:1], rehearse=True)
    assert {name: part["outcome"] == "done" for name, part in again["parts"].items()}["fails"]
    assert again["parts"]["dies"] == result["parts"]["dies"]
    capsys.readouterr()


def test_limits_never_exceed_the_time_that_there_is():
    everything = pytest.importorskip("flowsplat_benchmarks.scripts.gpu_parts.everything")
    left = seconds = 60 * 8.0
    for index in range(len(everything.PARTS)):
        limit = everything.limit_of(index, left)
        assert 0 < limit <= left
        left -= limit + everything.GRACE_SECONDS / len(everything.PARTS)
    assert left > 0
    assert sum(limit for _, limit in everything.plan(8.0)) == pytest.approx(seconds)


def test_the_page_of_what_was_measured_has_every_part():
    page = pytest.importorskip("flowsplat_benchmarks.scripts.gpu_parts.page")
    files = list(RESULTS.glob("gpu-*.json"))
    assert files
    for file in files:
        result = json.loads(file.read_text(encoding="utf-8"))
        text = "\n".join(page.page(result))
        assert result["machine"]["card"] in text
        assert all(title in text for name, title in page.TITLES.items() if name in result["parts"])
        # What is in the documentation is what was measured.
        documented = (Path(__file__).parents[3] / "docs" / "gpu.md").read_text(encoding="utf-8")
        tables = [line for line in text.splitlines() if line.startswith("|") and "---" not in line]
        assert all(line in documented for line in tables)


def test_a_part_of_another_commit_says_so():
    page = pytest.importorskip("flowsplat_benchmarks.scripts.gpu_parts.page")
    now, before = ({"commit": letter * 40, "changed": False, "date": "2026-11-27T00:00"} for letter in "ab")
    part = {"outcome": "done", "figures": {}}
    lines = list(page.page({**now, "parts": {"kernels": {**part, **now}, "memory": {**part, **before}}}))
    assert [line for line in lines if line.startswith("Commit bbbbbbb")] == ["Commit bbbbbbb, 2026-11-27."]
    assert lines.index("Commit bbbbbbb, 2026-11-27.") > lines.index(f"### {page.TITLES['memory']}")


def rehearsed(out, *words: str) -> dict[str, Any]:
    """All parts, or some, in the interpreter."""
    command = [*COMMAND, *(words or ["--everything"]), "--rehearse", "--minutes", "25", "-o", out]
    done = subprocess.run(command, capture_output=True, text=True, timeout=1600, check=False)
    assert done.returncode in (0, 1), done.stderr[-2000:]
    return json.loads(out.read_text(encoding="utf-8"))["parts"]


@pytest.mark.slow
def test_everything_can_be_rehearsed_without_a_card(tmp_path):
    parts = rehearsed(tmp_path / "rehearsal.json")
    assert {name: part["outcome"] for name, part in parts.items()} == dict.fromkeys(parts, "done"), parts
    assert parts["kernels"]["figures"]["tests"]["passed"] >= 2
    assert parts["step"]["figures"]["default"]["step"]["repeats"] == 1
    assert parts["training"]["figures"]["street, card"]["psnr"]["heldout_frames"] > 5
    assert parts["viewing"]["figures"]["trained: street-card"]["gaussians"] > 0
    # Three steps in the interpreter lead where those in Numba lead.
    last = parts["agreement"]["figures"]["card"]["3"]
    assert all(value is None or value < 1e-2 for value in last.values())


@pytest.mark.slow
def test_where_kernels_fail_the_rest_still_comes(tmp_path):
    parts = rehearsed(tmp_path / "broken.json", "--only", "kernels", "step", "memory", "gsplat", "--broken")
    assert parts["kernels"]["outcome"].startswith("failed")
    assert all("broken on purpose" in said for said in parts["kernels"]["figures"]["tests"]["failures"].values())
    assert "broken on purpose" in parts["step"]["figures"]["default"]["failed"]
    assert "broken on purpose" in parts["memory"]["figures"]["100"]["failed"]
    assert parts["gsplat"]["outcome"] == "done"
