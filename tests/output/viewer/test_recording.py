"""Names of what a client takes away."""

from __future__ import annotations

from flowsplat.output.viewer.recording import next_file


def test_no_two_recordings_get_one_name(tmp_path):
    (tmp_path / "recording_001.mp4").touch()
    names = [next_file(tmp_path, "recording", suffix).name for suffix in (".mp4", ".mp4", ".gif")]
    assert names == ["recording_002.mp4", "recording_003.mp4", "recording_001.gif"]
