import pytest

from flowsplat.common.spread import spread


@pytest.mark.parametrize(("count", "wanted", "chosen"), [(9, 3, [0, 4, 8]), (2, 3, [0, 1]), (1, 5, [0]), (4, 4, [0, 1, 2, 3])])
def test_a_few_evenly_from_the_first_to_the_last(count, wanted, chosen):
    assert spread(count, wanted) == chosen
