"""The command: it prepares, measures, writes its tables, and continues."""

from __future__ import annotations

import json

import pytest

from flowsplat.cli import main
from flowsplat.common.errors import InputError
from flowsplat.scenes import Scene
from flowsplat_benchmarks.priors import benchmark, preparation
from tests.marks import slow


def call(*arguments: object) -> None:
    main(["benchmark", "priors", *(str(argument) for argument in arguments)])


@pytest.mark.parametrize("in_processes", [False, slow(True)])
def test_a_pair_is_measured_once(data_root, tmp_path, capsys, request, monkeypatch, in_processes):
    if not in_processes:
        request.getfixturevalue("in_this_process")
        monkeypatch.setattr(preparation, "in_own_process", lambda work, *arguments: work(*arguments))
    out = tmp_path / "out"
    call(data_root, "-o", out, "--scenes", "pair")
    path = out / "pair.json"
    result = json.loads(path.read_text())
    assert result["scene"] == "pair"
    assert result["size"] == [120, 80]
    assert list(result["seconds"]) == ["flow"]
    assert 0 < result["figures"]["flow.epe"] < 0.2
    assert 0.05 < result["figures"]["time.memory"] < 4
    assert "| pair | 0." in (out / "priors.md").read_text()
    page = (out / "priors.html").read_text()
    assert "3 of 3 targets met" in page
    assert page.count("<img") == 1
    result["figures"]["flow.epe"] = 0.777
    path.write_text(json.dumps(result))
    capsys.readouterr()
    call(data_root, "-o", out, "--scenes", "pair")
    assert "measured already" in capsys.readouterr().err
    assert "| pair | 0.78 px | ≤ 0.25 px | not met |" in (out / "priors.md").read_text()
    call(data_root, "-o", out, "--scenes", "pair", "--again")
    assert json.loads(path.read_text())["figures"]["flow.epe"] < 0.2


def test_a_scene_that_cannot_be_measured_does_not_stop_the_others(data_root, tmp_path, monkeypatch, capsys, in_this_process):
    def measure(scene, folder):
        if scene.name == "clip":
            raise InputError("it is torn.")
        facts = {"scene": scene.name, "kind": scene.kind, "tuned": False, "frames": 2, "size": [4, 3], "flowsplat": "0"}
        return {**facts, "figures": {"flow.epe": 0.1}}

    monkeypatch.setattr(benchmark, "measure_scene", measure)
    with pytest.raises(SystemExit) as end:
        call(data_root, "-o", tmp_path)
    assert end.value.code == 2
    assert "1 of 3 scenes could not be run, first clip: it is torn." in " ".join(capsys.readouterr().err.split())
    text = (tmp_path / "priors.md").read_text()
    assert text.index("| tiny | 0.10 px |") < text.index("| pair | 0.10 px |"), "in the order of the data root"
    for name in ("priors.md", "priors.html"):
        assert "clip could not be measured: it is torn." in (tmp_path / name).read_text()


@pytest.mark.slow
def test_scenes_with_all_priors(data_root, tmp_path):
    out = tmp_path / "out"
    call(data_root, "-o", out, "--scenes", "tiny", "clip")
    tiny, clip = (json.loads((out / f"{name}.json").read_text()) for name in ("tiny", "clip"))
    for name in ("flow.epe", "cameras.path", "depth.static", "masks.iou", "tracks.life", "tracks.objects", "time.total"):
        assert name in tiny["figures"]
    assert tiny["seconds"].keys() >= {"ingest", "cameras", "flow", "masks", "depth", "tracks"}
    assert set(clip["figures"]) == {"masks.iou", "time.total", "time.cpu", "time.memory"}
    assert Scene(out / "clip" / "scene").prior("masks")["method"] == "motion"  # and not those in the clip's folder
    assert Scene(out / "tiny" / "scene").heldout_frames == []
    assert (out / "priors.html").read_text().count("<img") == 2
    assert (out / "tiny" / "priors.html").exists()


@pytest.mark.parametrize(("arguments", "words"), [(["missing"], "is no folder"), ([".", "--scenes", "none"], "no scenes")])
def test_what_cannot_be_used_is_one_line(tmp_path, monkeypatch, capsys, arguments, words):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as end:
        call(*arguments, "-o", tmp_path / "out")
    assert end.value.code == 2
    error = capsys.readouterr().err.strip()
    assert words in error
    assert "\n" not in error
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("arguments", "word"),
    [(["-h"], "benchmark"), (["benchmark"], "priors"), (["benchmark", "-h"], "priors"), (["benchmark", "priors", "-h"], "ROOT")],
)
def test_help_names_the_benchmarks(capsys, arguments, word):
    with pytest.raises(SystemExit) as end:
        main(arguments)
    assert end.value.code == 0
    assert word in capsys.readouterr().out
