from __future__ import annotations

import pytest

from flowsplat.common.errors import InputError
from flowsplat_benchmarks.priors.scenes import choose_scenes, find_scenes


def test_every_kind_is_found(data_root):
    found = {scene.name: scene for scene in find_scenes(data_root)}
    assert {name: scene.kind for name, scene in found.items()} == {"tiny": "rig", "clip": "davis", "pair": "pair"}
    assert found["clip"].source == data_root / "davis" / "clip" / "images"
    assert not any(scene.is_tuned for scene in found.values())


def test_scenes_are_chosen_by_name(data_root):
    assert [scene.name for scene in choose_scenes(data_root, ["pair", "tiny"])] == ["tiny", "pair"]
    with pytest.raises(InputError, match="no scene 'tny': choose from tiny, clip, pair"):
        choose_scenes(data_root, ["tny"])


def test_roots_that_cannot_be_used(tmp_path):
    with pytest.raises(InputError, match="is no folder"):
        find_scenes(tmp_path / "missing")
    with pytest.raises(InputError, match="holds no scenes"):
        find_scenes(tmp_path)
    (tmp_path / "davis" / "a" / "images").mkdir(parents=True)
    with pytest.raises(InputError, match="holds no scenes"):  # nothing to compare with
        find_scenes(tmp_path)
    (tmp_path / "davis" / "a" / "masks").mkdir()
    (tmp_path / "flow" / "a").mkdir(parents=True)
    (tmp_path / "flow" / "a" / "flow10.flo").touch()
    with pytest.raises(InputError, match="two scenes called a"):
        find_scenes(tmp_path)
