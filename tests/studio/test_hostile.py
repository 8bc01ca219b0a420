"""Who must not come in does not, what must not be taken is not, and nothing of it is left."""

from __future__ import annotations

import json
import os
import shutil
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from flowsplat.common.errors import InputError
from flowsplat.common.process_control import read_start_time
from flowsplat.studio import handlers, server, tasks, uploads
from flowsplat.studio.options import StudioOptions
from flowsplat.studio.project import Project
from tests.output.viewer.browser import free_port
from tests.studio.serving import Page, script, serve


def files_of(page: Page, studio: Path) -> list[str]:
    """What lies in a studio, its token and lock left out. Folders may vanish meanwhile, which ``rglob`` takes ill."""
    found = [Path(folder, name) for folder, folders, files in os.walk(studio) for name in (*folders, *files)]
    return sorted(path.relative_to(studio).as_posix() for path in found if path.name not in (".token", ".lock"))


def is_empty(page: Page, studio: Path) -> bool:
    """Whether nothing is left, as soon as connections that broke were noticed."""
    end = time.monotonic() + 10
    while files_of(page, studio) and time.monotonic() < end:
        time.sleep(0.05)
    return not files_of(page, studio)


ADDRESSES = ("/", "/studio.js", "/state.js", "/api/projects", "/api/projects/x", "/files/x/poster.jpg", "/nothing")


@pytest.mark.parametrize(
    ("headers", "says"),
    [
        ({"Cookie": None}, "token"),
        ({"Cookie": "flowsplat_1=x"}, "token"),
        ({"Host": "evil.example"}, "not served under that name"),
        ({"Host": "127.0.0.1.evil.example"}, "not served under that name"),
        ({"Origin": "http://evil.example"}, "Another page"),
        ({"Origin": "null"}, "Another page"),
        ({"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Dest": "iframe"}, "Another page"),
    ],
)
def test_strangers_are_refused_everywhere(page, headers, says):
    for path in ADDRESSES:
        status, said, answered = page.ask("GET", path, headers=headers)
        assert status == 403, path
        assert says in said["error"]
        assert "Set-Cookie" not in answered
    status, said, _ = page.ask("PUT", "/api/clips?name=x.mp4", headers=headers, raw=b"x" * 1000)
    assert status == 403


def test_changes_need_the_page_s_own_origin(page, clip):
    """Which every browser sends with them; a form of another page that a cookie goes along with has another one."""
    name = page.send(clip)[1]["id"]
    for method, path in (
        ("PUT", "/api/clips?name=x.mp4"), ("DELETE", f"/api/projects/{name}"), ("POST", f"/api/projects/{name}/run"),
        ("PUT", f"/api/projects/{name}/choices"), ("POST", f"/api/projects/{name}/copy"),
    ):  # fmt: skip
        for origin in (None, "http://evil.example", f"http://127.0.0.1:{page.port + 1}"):
            assert page.ask(method, path, headers={"Origin": origin}, raw=b"{}")[0] == 403
    assert page.get(f"/api/projects/{name}")["state"] == "draft"


def test_the_address_with_its_token_opens_the_page(page):
    token = page.cookie.partition("=")[2]
    status, said, headers = page.ask("GET", f"/?token={token}", headers={"Cookie": None, "Origin": None})
    assert status == 200
    assert b"<!DOCTYPE html>" in said
    assert "HttpOnly" in headers["Set-Cookie"]
    policy = headers["Content-Security-Policy"]
    assert "frame-ancestors 'none'" in policy
    assert "unsafe" not in policy
    assert page.ask("GET", "/?token=x", headers={"Cookie": None})[0] == 403


@pytest.mark.parametrize(
    "name",
    [
        "../x.mp4",
        "..",
        "a/b.mp4",
        "/etc/passwd",
        "..\\x.mp4",
        ".hidden.mp4",
        "",
        "a\nb.mp4",
        "a\0.mp4",
        "x" * 300 + ".mp4",
        " x.mp4",
    ],
)
def test_names_that_lead_elsewhere_are_refused(tmp_path, clip, name):
    studio = tmp_path / "studio"
    before = sorted(tmp_path.rglob("*"))
    with serve(studio) as page:
        status, said = page.send(clip, name) if name else page.ask("PUT", "/api/clips", raw=clip.read_bytes())[:2]
        assert status == 400
        assert "cannot name a file" in said["error"]
        assert is_empty(page, studio)
    assert [path for path in sorted(tmp_path.rglob("*")) if path not in (studio, studio / ".token")] == before


def test_what_is_no_video_is_refused_and_gone(tmp_path):
    files = {
        "text.mp4": b"no video at all\n" * 100, "page.html": b"<script>alert(1)</script>",
        "image.png": b"\x89PNG\r\n\x1a\n" + bytes(100),
        "list.m3u8": b"#EXTM3U\n#EXTINF:1,\nhttp://evil.example/x.ts\n", "none.mp4": b"",
    }  # fmt: skip
    with serve(tmp_path / "studio") as page:
        for name, data in files.items():
            status, said, _ = page.ask("PUT", f"/api/clips?name={name}", raw=data)
            assert status == 400, said
            assert str(tmp_path) not in said["error"]
            assert "\n" not in said["error"]
        assert is_empty(page, tmp_path / "studio")
        assert page.get("/api/projects")["projects"] == []


def test_half_a_video_is_refused_and_gone(tmp_path, clip):
    with serve(tmp_path / "studio") as page:
        status, _, _ = page.ask("PUT", "/api/clips?name=half.mp4", raw=clip.read_bytes()[: clip.stat().st_size // 2])
        assert status == 400
        assert is_empty(page, tmp_path / "studio")


def test_more_than_is_allowed_is_refused_before_it_comes(tmp_path):
    """Ten gigabytes that are announced cost nothing: the answer is there before the first of them."""
    with serve(tmp_path / "studio") as page, page.begin_sending("big.mp4", 10_000_000_000) as connection:
        said = connection.recv(65536)
        assert b" 413 " in said.split(b"\r\n", 1)[0]
        assert b"larger than 4 GB" in said
        assert is_empty(page, tmp_path / "studio")


def test_more_than_is_allowed_is_refused_where_its_size_is_not_said(tmp_path):
    with serve(tmp_path / "studio", max_upload_gb=0.000_5) as page:
        with socket.create_connection(("127.0.0.1", page.port), timeout=30) as connection:
            connection.sendall((
                f"PUT /api/clips?name=x.mp4 HTTP/1.1\r\nHost: 127.0.0.1:{page.port}\r\nOrigin: http://127.0.0.1:{page.port}\r\n"
                f"Cookie: {page.cookie}\r\nTransfer-Encoding: chunked\r\n\r\n"
            ).encode())  # fmt: skip
            piece = b"%x\r\n" % 100_000 + bytes(100_000) + b"\r\n"
            try:
                for _ in range(20):
                    connection.sendall(piece)
                said = connection.recv(65536)
            except OSError:  # it was closed before all was sent
                said = b""
        assert said == b"" or b" 413 " in said.split(b"\r\n", 1)[0] or b" 400 " in said.split(b"\r\n", 1)[0]
        assert is_empty(page, tmp_path / "studio")


def test_fifty_clips_at_a_time_are_refused_but_for_a_few(tmp_path):
    studio = tmp_path / "studio"
    with serve(studio) as page:
        connections = [page.begin_sending(f"{k}.mp4", 1_000_000, bytes(1000)) for k in range(50)]
        try:
            said: list[bytes] = []

            def listen(connection: socket.socket) -> None:
                connection.settimeout(3)
                try:
                    said.append(connection.recv(65536).split(b"\r\n", 1)[0])
                except OSError:
                    said.append(b"")

            threads = [threading.Thread(target=listen, args=(each,)) for each in connections]
            for thread in threads:
                thread.start()
            for thread in threads:
                thread.join()
            assert sum(b" 429 " in each for each in said) == 50 - uploads.MAX_PARALLEL
            assert len([path for path in studio.iterdir() if path.is_dir()]) == uploads.MAX_PARALLEL
        finally:
            for connection in connections:
                connection.close()
        assert is_empty(page, studio)
        assert page.get("/api/projects")["projects"] == []


def test_a_clip_that_stops_coming_is_given_up(tmp_path, monkeypatch, clip):
    monkeypatch.setattr(uploads, "SILENCE_SECONDS", 0.2)
    with serve(tmp_path / "studio") as page, page.begin_sending("slow.mp4", 1_000_000, bytes(1000)):
        time.sleep(0.3)
        assert is_empty(page, tmp_path / "studio")
        assert page.send(clip)[0] == 201


def test_what_a_killed_server_has_left_goes(tmp_path):
    left = tmp_path / "studio" / ".receiving-1-abc" / "x.mp4"
    left.parent.mkdir(parents=True)
    left.write_bytes(b"x")
    with serve(tmp_path / "studio") as page:
        assert is_empty(page, tmp_path / "studio")


def test_a_full_disk_is_a_sentence(tmp_path, clip, monkeypatch):
    monkeypatch.setattr(uploads, "DISK_RESERVE", 10**18)
    with serve(tmp_path / "studio") as page:
        status, said = page.send(clip)
        assert status == 507
        assert "no room" in said["error"]
        assert is_empty(page, tmp_path / "studio")


@pytest.mark.parametrize(
    "path",
    ["studio.json", "run.log", "../.token", "../../secret", "%2e%2e/.token", "..%2f.token", "clip/../studio.json", "run/run.json",
     "run/scene/scene.json", "clip/..%2f..%2f.token", "/etc/passwd", "run/export/../../../.token", "poster.jpg/", "clip/", "clip"],
)  # fmt: skip
def test_files_that_the_page_does_not_show_are_not_there(tmp_path, clip, path):
    (tmp_path / "secret").write_text("secret")
    with serve(tmp_path / "studio") as page:
        name = page.send(clip)[1]["id"]
        status, said, _ = page.ask("GET", f"/files/{name}/{path}")
        assert status in (400, 403, 404), said
        for other in ("..", ".", "x", "%2e%2e", "-", "A"):
            assert page.ask("GET", f"/files/{other}/poster.jpg")[0] in (400, 404)
            assert page.ask("DELETE", f"/api/projects/{other}")[0] in (400, 404)
    assert (tmp_path / "secret").exists()


def test_links_lead_nowhere(tmp_path, clip):
    (tmp_path / "secret.mp4").write_text("secret")
    with serve(tmp_path / "studio") as page:
        name = page.send(clip)[1]["id"]
        renders = tmp_path / "studio" / name / "run" / "renders"
        renders.mkdir(parents=True)
        (renders / "x.mp4").symlink_to(tmp_path / "secret.mp4")
        assert page.ask("GET", f"/files/{name}/run/renders/x.mp4")[0] in (403, 404)
        (tmp_path / "studio" / "linked").symlink_to(tmp_path / "studio" / name)
    with serve(tmp_path / "studio") as page:
        assert [each["id"] for each in page.get("/api/projects")["projects"]] == [name]


def test_a_clip_is_never_a_page(tmp_path, clip):
    with serve(tmp_path / "studio") as page:
        found = page.send(clip, "walk.html")[1]
        _, _, headers = page.ask("GET", found["clip"])
        assert headers["Content-Type"] == "application/octet-stream"
        assert "sandbox" in headers["Content-Security-Policy"]
        assert headers["X-Content-Type-Options"] == "nosniff"


@pytest.mark.parametrize("body", [b"", b"{", b"[" * 100_000, b"\xff", b"null", b"[1]", b'{"preset": NaN}', b'{"start": 1e999}'])
def test_what_no_page_sends_is_a_sentence(tmp_path, clip, body):
    with serve(tmp_path / "studio") as page:
        name = page.send(clip)[1]["id"]
        before = page.get(f"/api/projects/{name}")["choices"]
        for method, path in (("PUT", "choices"), ("POST", "export")):
            status, said, _ = page.ask(method, f"/api/projects/{name}/{path}", raw=body)
            assert status == 400
            assert "Error" not in said["error"]
        assert page.get(f"/api/projects/{name}")["choices"] == before


def test_more_than_a_page_says_is_not_read(page, clip):
    name = page.send(clip)[1]["id"]
    try:
        status = page.ask("PUT", f"/api/projects/{name}/choices", raw=b" " * 2_000_000)[0]
    except OSError:  # it was closed before all was sent
        status = 400
    assert status == 400
    assert page.get(f"/api/projects/{name}")["state"] == "draft"


def test_what_is_too_long_to_say_is_shortened(page, clip):
    name = page.send(clip)[1]["id"]
    status, said, _ = page.ask("POST", f"/api/projects/{name}/export", {"to": "x" * 100_000})
    assert status == 400
    assert len(said["error"]) < 600


def test_a_folder_that_is_deleted_under_a_run_ends_it_and_is_not_made_again(tmp_path, clip, monkeypatch):
    monkeypatch.setattr(tasks, "PROGRAM", script("time.sleep(100)"))
    studio = tmp_path / "studio"
    with serve(studio) as page:
        name = page.send(clip)[1]["id"]
        choices = page.get(f"/api/projects/{name}")["choices"]
        page.do("POST", f"/api/projects/{name}/run")
        task = json.loads((studio / name / "studio.json").read_text())["task"]
        shutil.rmtree(studio / name)
        for method, what, body in (("PUT", "choices", choices), ("POST", "copy", {})):
            status, said, _ = page.ask(method, f"/api/projects/{name}/{what}", body)
            assert status in (400, 507)
            assert str(tmp_path) not in said["error"]
        end = time.monotonic() + 20
        while read_start_time(task["process"]) == task["begun"] and time.monotonic() < end:
            time.sleep(0.05)
        assert read_start_time(task["process"]) != task["begun"]
        assert page.get("/api/projects")["projects"] == []
        assert is_empty(page, studio)


def test_a_full_disk_loses_no_choice_and_ends_no_server(tmp_path, clip, monkeypatch):
    """What is refused is not half done: a process whose record cannot be written is ended."""

    def refuse(*_: object) -> None:
        raise InputError("The disk is full.")

    kill, killed = tasks.Tasks.kill, []

    def note_kill(self: tasks.Tasks, project: Project) -> object:
        killed.append(project.id)
        return kill(self, project)

    monkeypatch.setattr(tasks, "PROGRAM", script("time.sleep(100)"))
    monkeypatch.setattr(tasks.Tasks, "kill", note_kill)
    with serve(tmp_path / "studio") as page:
        name = page.send(clip)[1]["id"]
        choices = page.get(f"/api/projects/{name}")["choices"]
        with monkeypatch.context() as full:
            full.setattr(Project, "save", refuse)
            assert page.ask("PUT", f"/api/projects/{name}/choices", {**choices, "preset": "high"})[0] == 400
            assert page.get(f"/api/projects/{name}")["choices"] == choices
            assert page.ask("POST", f"/api/projects/{name}/run")[1] == {"error": "The disk is full."}
            end = time.monotonic() + 20
            while not killed and time.monotonic() < end:
                time.sleep(0.05)
            assert killed == [name]
            assert page.get(f"/api/projects/{name}")["state"] == "failed"
        assert page.do("PUT", f"/api/projects/{name}/choices", choices)["id"] == name


def test_a_process_that_does_not_end_keeps_nobody_waiting(tmp_path, clip, monkeypatch):
    """Its scene is shown again after a while; all other questions are answered meanwhile."""
    monkeypatch.setattr(handlers, "KILL_SECONDS", 1.0)
    with serve(tmp_path / "studio") as page:
        name = page.send(clip)[1]["id"]
        monkeypatch.setattr(tasks.Tasks, "kill", lambda *_: lambda: False)
        answers: list[tuple[int, object]] = []
        asked = threading.Thread(target=lambda: answers.append(page.ask("DELETE", f"/api/projects/{name}")[:2]))
        asked.start()
        while page.get("/api/projects")["projects"]:
            time.sleep(0.01)
        assert not answers
        asked.join()
        assert answers == [(400, {"error": "Its process does not end: try again."})]
        assert [each["id"] for each in page.get("/api/projects")["projects"]] == [name]


@pytest.mark.parametrize("kind", ["file", "run", "shots", "below a file"])
def test_what_is_no_folder_of_a_studio_is_a_sentence(tmp_path, kind):
    place = tmp_path / "walk"
    if kind in ("file", "below a file"):
        place.write_bytes(b"x")
    else:
        place.mkdir()
        (place / f"{kind}.json").write_text("{}")
    named = place / "studio" if kind == "below a file" else place
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(InputError) as refused:
        server.serve(named, StudioOptions(port=free_port(), open_browser=False))
    assert str(named) in str(refused.value)
    assert "-o" not in str(refused.value).split()
    assert sorted(tmp_path.rglob("*")) == before


def test_two_servers_do_not_share_a_folder(tmp_path):
    with serve(tmp_path / "studio"):
        command = [sys.executable, "-m", "flowsplat.cli", "studio", str(tmp_path / "studio"), "--port", "8399", "--no-open-browser"]
        done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 2
    assert "is being written by" in done.stderr
    assert "Traceback" not in done.stderr
