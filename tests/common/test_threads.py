"""Several at once, in order."""

from __future__ import annotations

import threading

import numba
import pytest

from flowsplat.common.threads import computed_once, in_threads
from flowsplat.gaussians.model import SceneModel
from flowsplat.geometry import Similarity
from tests.training.handful import a_few, seen, tiny


@pytest.mark.parametrize("threads", [1, 2, 3])
def test_results_come_in_order(threads):
    assert list(in_threads(lambda x: x * x, range(20), threads)) == [x * x for x in range(20)]
    assert list(in_threads(lambda x: x, [], threads)) == []


def test_two_are_worked_on_at_once_each_with_its_share_of_the_processor():
    together, share = threading.Barrier(2, timeout=10), max(numba.get_num_threads() // 2, 1)

    def work(_: int) -> int:
        together.wait()
        return numba.get_num_threads()

    assert list(in_threads(work, range(4), 2)) == [share] * 4


@pytest.mark.parametrize("threads", [1, 2])
def test_an_error_arrives_where_the_result_is_asked_for_and_ends_the_rest(threads):
    begun = []

    def work(x: int) -> int:
        begun.append(x)
        if x == 2:
            raise RuntimeError("spoilt")
        return x

    results = in_threads(work, range(1000), threads)
    assert [next(results), next(results)] == [0, 1]
    with pytest.raises(RuntimeError, match="spoilt"):
        next(results)
    assert len(begun) < 20


def test_what_several_threads_ask_for_is_computed_once_and_kept_while_there_is_room():
    asked, together = [], threading.Barrier(2, timeout=10)

    def slow(k: int) -> int:
        asked.append(k)
        return k * k

    kept = computed_once(slow, 2)

    def work(_: int) -> list[int]:
        together.wait()
        return [kept(k) for k in (1, 2)]

    assert list(in_threads(work, range(2), 2)) == [[1, 4], [1, 4]]
    assert sorted(asked) == [1, 2]
    assert [kept(3), kept(2), kept(1)] == [9, 4, 1]
    assert sorted(asked) == [1, 1, 2, 3], "the one not asked for longest is forgotten"


def test_what_failed_is_computed_again():
    asked = []

    def work(k: int) -> int:
        asked.append(k)
        if len(asked) == 1:
            raise RuntimeError("spoilt")
        return k

    kept = computed_once(work, 2)
    with pytest.raises(RuntimeError, match="spoilt"):
        kept(5)
    assert kept(5) == 5
    assert asked == [5, 5]


def test_pictures_are_the_same_however_many_are_rendered_at_once():
    config = tiny("default")
    gaussians = a_few(config)
    model = SceneModel(gaussians, Similarity(), 0.0, 1.0)
    camera = seen(gaussians)[0].camera

    def picture(k: int) -> bytes:
        shown = model.render(camera, k / 8, (camera, (k + 1) / 8))
        assert shown.flow is not None
        return shown.colour.tobytes() + shown.flow.tobytes()

    alone, together = (list(in_threads(picture, range(8), threads)) for threads in (1, 3))
    assert alone == together
    assert len(set(alone)) == 8
