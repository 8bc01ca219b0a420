"""Copies of runs: whole where there is a manifest."""

from __future__ import annotations

import hashlib
import json

import pytest

from flowsplat.batch.upload import open_url, upload
from flowsplat.common.errors import InputError

fsspec = pytest.importorskip("fsspec", reason="fsspec is not installed: nothing was copied (pip install 'flowsplat[upload]')")


@pytest.fixture(params=["file", "memory"])
def url(request, tmp_path) -> str:
    return f"file://{tmp_path}/bucket/x" if request.param == "file" else f"memory://bucket/{tmp_path.name}"


@pytest.fixture
def run(tmp_path):
    folder = tmp_path / "out" / "clip-1"
    (folder / "model").mkdir(parents=True)
    (folder / "run.json").write_text("{}")
    (folder / "model" / "a.safetensors").write_bytes(b"x" * 3_000_000)
    (folder / ".lock").write_text("")
    (folder / ".a.1.partial").write_text("half")
    return folder


def held(url: str) -> dict[str, bytes]:
    system, place = open_url(url)
    return {path[len(place) :].lstrip("/"): system.cat_file(path) for path in system.find(place)}


def test_parts_first_and_the_manifest_last(run, url, monkeypatch):
    assert upload(run, url) == f"{url}/clip-1"
    found = held(url)
    assert set(found) == {"clip-1/run.json", "clip-1/model/a.safetensors", "clip-1/manifest.json"}
    manifest = json.loads(found["clip-1/manifest.json"])["files"]
    assert manifest["model/a.safetensors"] == {"size": 3_000_000, "sha256": hashlib.sha256(b"x" * 3_000_000).hexdigest()}
    # What is there is not copied again; what changed or went is brought up to date.
    system, _ = open_url(url)
    copied: list[str] = []
    put = type(system).put_file
    monkeypatch.setattr(type(system), "put_file", lambda self, a, b, **rest: (copied.append(b), put(self, a, b, **rest))[1])
    upload(run, url)
    assert copied == []
    (run / "run.json").unlink()
    (run / "new.json").write_text("[]")
    upload(run, url)
    assert [name.rpartition("/")[2] for name in copied] == ["new.json"]
    assert set(held(url)) == {"clip-1/new.json", "clip-1/model/a.safetensors", "clip-1/manifest.json"}


def test_what_breaks_off_leaves_no_manifest(run, url, monkeypatch):
    upload(run, url)
    (run / "run.json").write_text("{ }")
    system, _ = open_url(url)

    def fails(self, a, b, **rest):
        raise OSError("the line is down")

    with monkeypatch.context() as patched:
        patched.setattr(type(system), "put_file", fails)
        with pytest.raises(OSError, match="the line is down"):
            upload(run, url)
    assert "clip-1/manifest.json" not in held(url)
    upload(run, url)
    assert held(url)["clip-1/run.json"] == b"{ }"


def test_addresses_that_are_none():
    for url in ("nonsense://x", "s3n+x://y"):
        with pytest.raises(InputError, match="--upload"):
            open_url(url)


def test_a_manifest_that_leads_elsewhere_deletes_nothing(run, tmp_path):
    (tmp_path / "mine.txt").write_text("mine")
    target = tmp_path / "bucket" / "clip-1"
    target.mkdir(parents=True)
    (target / "manifest.json").write_text(json.dumps({"files": {"../../mine.txt": {}, str(tmp_path / "mine.txt"): {}}}))
    upload(run, f"file://{tmp_path}/bucket")
    assert (tmp_path / "mine.txt").read_text() == "mine"
