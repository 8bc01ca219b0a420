"""Which clips a batch is of, and what they are called."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from flowsplat.batch.clips import find_clips, id_of, of_shard
from flowsplat.common.errors import InputError
from flowsplat.pipeline.config import RunConfig, preset

CONFIG = preset("fast")


def touched(*paths: Path) -> None:
    for path in paths:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"x")


def names(clips) -> list[str]:
    return [clip.path.name for clip in clips]


def test_files_folders_and_lists(tmp_path):
    root, out = tmp_path / "trip", tmp_path / "trip" / "out"
    touched(root / "b.mp4", root / "a.MOV", root / "notes.txt", root / "day 2" / "c.mkv", root / ".hidden.mp4", root / "poster.jpg")
    touched(root / "frames" / "0.png", root / "frames" / "1.png", out / "x" / "d.mp4")
    touched(root / "run" / "e.mp4", root / "run" / "run.json")
    assert names(find_clips([root], CONFIG, out)) == ["a.MOV", "b.mp4", "c.mkv", "frames"]
    assert names(find_clips([root / "b.mp4", root / "frames"], CONFIG, out)) == ["b.mp4", "frames"]
    (tmp_path / "list.txt").write_text("# mine\ntrip/b.mp4\n\n  trip/frames  \nmissing.mp4\n")
    listed = find_clips([tmp_path / "list.txt"], CONFIG, out)
    assert [clip.path for clip in listed] == [root / "b.mp4", root / "frames", tmp_path / "missing.mp4"], "its run says it"
    assert len(find_clips([root, root / "b.mp4"], CONFIG, out)) == 4, "named twice, it is one"


@pytest.mark.parametrize("kind", ["csv", "jsonl"])
def test_options_of_single_clips(tmp_path, kind):
    path = tmp_path / f"list.{kind}"
    if kind == "csv":
        path.write_text(
            "path,id,start,end,mask-click,given.masks,train.iterations,holdout,final-fit\n"
            'a.mp4,one,1.5,3,"0.5,0.4@0; 3,4@2",masks,50,none,false\nb.mp4,,,,,,,,\n'
        )
    else:
        row = {"path": "a.mp4", "id": "one", "start": 1.5, "end": 3, "mask_click": ["0.5,0.4@0", "3,4@2"], "given.masks": "masks",
               "--train.iterations": 50, "holdout": None, "final_fit": False}  # fmt: skip
        path.write_text(f"{json.dumps(row)}\n{json.dumps({'path': 'b.mp4'})}\n")
    one, two = find_clips([path], CONFIG, tmp_path / "out")
    assert one.id == "one"
    assert (one.config.input.start, one.config.input.end, one.config.input.holdout) == (1.5, 3.0, None)
    assert one.config.priors.mask_click == ("0.5,0.4@0", "3,4@2")
    assert one.config.priors.given.masks == tmp_path / "masks"
    assert (one.config.train.iterations, one.config.final_fit) == (50, False)
    assert one.config.input.resize == CONFIG.input.resize, "the rest is the preset's"
    assert two.config == CONFIG


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("path,start\na.mp4,soon\n", "line 2: start cannot be 'soon'"),
        ("path,start\na.mp4,-1\n", "line 2: --start"),
        ("path,begin\na.mp4,1\n", "'begin' is no option"),
        ("path,touch\na.mp4,1\n", "'touch' is called --contact now"),
        ("id\na\n", "there is no path"),
        ("path,id\na.mp4,../b\n", "leads to another folder"),
        ("path,id\na.mp4,index.html\n", "name of another file"),
        ("path,id\na.mp4,x\nb.mp4,X\n", "would both be called"),
        ("path,device\na.mp4,tpu\n", "device"),
        ("path\n", "There is no clip"),
    ],
)
def test_a_list_that_is_wrong_is_a_line(tmp_path, text, said):
    (tmp_path / "list.csv").write_text(text)
    with pytest.raises(InputError) as caught:
        find_clips([tmp_path / "list.csv"], CONFIG, tmp_path / "out")
    assert said in str(caught.value)


def test_inputs_that_are_not_there(tmp_path):
    with pytest.raises(InputError, match="does not exist"):
        find_clips([tmp_path / "no.mp4"], CONFIG, tmp_path / "out")
    with pytest.raises(InputError, match="There is no clip"):
        find_clips([tmp_path], CONFIG, tmp_path / "out")


def test_ids_are_readable_stay_and_differ(tmp_path):
    path = Path("/trip/day 1/IMG 0001.MOV")
    assert id_of(path, RunConfig()).startswith("IMG-0001-")
    assert id_of(path, preset("paper")) == id_of(path, RunConfig()), "how it is trained is not who it is"
    assert id_of(path, CONFIG) != id_of(path, RunConfig()), "what is taken of it is"
    assert id_of(Path("/trip/day 2/IMG 0001.MOV"), RunConfig()) != id_of(path, RunConfig())
    for odd in ("/a/../..", "/a/ü.mp4", "/a/.mp4", "/a/" + "é" * 300 + ".mp4", "/a/\udcff\n.mp4", "/a/<b>&.mp4", "/a/CON.mp4"):
        name = id_of(Path(odd), RunConfig())
        (tmp_path / name).mkdir()
        assert not set(name) & set("./\\<>&\n ")
        assert len(name.encode()) <= 100


def test_shards_are_all_of_it_and_share_nothing():
    ids = [f"clip-{k}" for k in range(200)]
    parts = [of_shard(ids, f"{k}/4", {}) for k in range(1, 5)]
    assert sorted(name for part in parts for name in part) == sorted(ids)
    assert min(len(part) for part in parts) > 30
    assert of_shard(ids[:100], "2/4", {}) == parts[1] & set(ids[:100]), "others move none"
    slurm = {"SLURM_ARRAY_TASK_ID": "7", "SLURM_ARRAY_TASK_MIN": "1", "SLURM_ARRAY_TASK_STEP": "2", "SLURM_ARRAY_TASK_COUNT": "4"}
    assert of_shard(ids, None, slurm) == parts[3]
    assert of_shard(ids, "1/4", slurm) == parts[0], "what is said goes first"
    assert of_shard(ids, None, {}) == set(ids)
    for wrong in ("0/4", "5/4", "x", "1/", "/2", "-1/2", "1/2/3"):
        with pytest.raises(InputError, match="--shard"):
            of_shard(ids, wrong, {})
    with pytest.raises(InputError, match="SLURM"):
        of_shard(ids, None, {**slurm, "SLURM_ARRAY_TASK_ID": "9"})
