"""What CONTRIBUTING.md shows of camera paths and formats, as a package of somebody else that is installed beside flowsplat."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from flowsplat.output.export.formats import EXPORTERS
from tests.output.tiny import tiny_run

TOP = Path(__file__).parents[2]
USE = """
import contextlib, io, json, sys
from pathlib import Path
from flowsplat import Scene, load
from flowsplat.cli import main
from flowsplat.output.videos import RenderOptions, render_videos

said = []
for words in (["render", "--help"], ["export", "--help"], ["export", sys.argv[1], "--to", "xyz", "--flip-axes"]):
    text = io.StringIO()
    with contextlib.redirect_stdout(text), contextlib.redirect_stderr(text), contextlib.suppress(SystemExit):
        main(words)
    said.append(" ".join(text.getvalue().split()))
main(["export", sys.argv[1], "--to", "xyz", "--time", "0"])
main(["export", sys.argv[1], "--to", "html"])
options = RenderOptions(paths=("rise",), width=32, max_frames=8)
render_videos(load(sys.argv[1]), Scene(sys.argv[1] + "/scene"), Path(sys.argv[1]) / "renders", options)
print(json.dumps(said))
"""


def recipe(title: str) -> str:
    """The Python of a section."""
    section = (TOP / "CONTRIBUTING.md").read_text().split(f"## {title}\n")[1].split("\n## ")[0]
    return re.search(r"```python\n(.*?)```", section, re.S)[1]


@pytest.fixture(scope="module")
def installed(tmp_path_factory) -> Path:
    """A folder with the package, and its metadata as pip writes it."""
    folder = tmp_path_factory.mktemp("site")
    package, info = folder / "my_package", folder / "my_package-1.0.dist-info"
    package.mkdir()
    info.mkdir()
    (package / "__init__.py").touch()
    (package / "rise.py").write_text(recipe("Add a camera path"))
    (package / "xyz.py").write_text(recipe("Add an export format"))
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: my-package\nVersion: 1.0\n")
    points = re.findall(r'\[project\.entry-points\."(.*?)"\]\n(.*?)\n', (TOP / "CONTRIBUTING.md").read_text())
    points = [(group, line) for group, line in points if group in ("flowsplat.camera_paths", "flowsplat.exporters")]
    assert len(points) == 2
    (info / "entry_points.txt").write_text("".join(f"[{group}]\n{line.replace(chr(34), '')}\n" for group, line in points))
    return folder


def test_the_recipes_work_to_the_letter(installed, tmp_path):
    run = tiny_run(tmp_path / "run")
    paths = os.pathsep.join([str(installed), os.environ.get("PYTHONPATH", "")])
    environment = {**os.environ, "COLUMNS": "200", "PYTHONPATH": paths}
    done = subprocess.run([sys.executable, "-c", USE, str(run)], env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    render, export, refusal = json.loads(done.stdout.splitlines()[-1])
    assert "rise: Up and down again while time plays." in render
    assert "xyz: Centers and colors as text, at one time (--time)." in export
    assert refusal == "Error: --flip-axes is for ply, ply-sequence, splat, not for xyz."
    assert {"rise.mp4", "rise_color.mp4"} <= {path.name for path in (run / "renders").iterdir()}
    points = np.loadtxt(run / "export" / "scene.xyz")
    assert points.shape[1] == 6
    np.testing.assert_allclose(points[-1, :3], [-0.5, 0, 2.5], atol=1e-5)
    assert points[-1, 3] > 200 > 100 > points[-1, 4], "the red object"
    page = (run / "export" / "player.html").read_text()
    assert '<option value="path:rise">rise</option>' in page
    paths = json.loads(re.search(r'type="application/json">(.*?)</script>', page)[1])["paths"]
    heights = np.array(next(path for path in paths if path["name"] == "rise")["offsets"])[:, :, 5]
    np.testing.assert_allclose(heights.min(), -0.1, atol=1e-4)  # y points down; of a median depth


def test_the_table_of_formats_is_that_of_the_registry():
    rows = re.findall(r"^\| `([a-z0-9-]+)` \| `([^`]+)` \|", (TOP / "docs" / "formats.md").read_text(), re.M)
    there = [(entry.name, entry.value.default_name + "/" * entry.value.is_folder) for entry in EXPORTERS.entries()]
    assert rows == there
    line = (TOP / "README.md").read_text().split("**Take it elsewhere**")[1].split("are for other programs")[0]
    named = re.findall(r"`([a-z0-9-]+)`", line)
    assert len(named) > 5
    assert set(named) <= set(EXPORTERS.names())


@pytest.mark.parametrize("name", EXPORTERS.names())
def test_readers_that_are_named_are_there(name):
    reader = EXPORTERS[name].reader
    if reader is not None:
        module, function = reader.rsplit(".", 1)
        __import__(module)
        assert callable(getattr(sys.modules[module], function))


def test_the_example_package_holds_the_recipes():
    for title, name in (("Add a camera path", "rise"), ("Add an export format", "xyz")):
        assert (TOP / "examples" / "plugin" / "flowsplat_example" / f"{name}.py").read_text() == recipe(title)
