"""Units that names end in."""

import pytest

from trilat_net.fields import UNITS, split_unit


@pytest.mark.parametrize("ending", UNITS)
def test_longest_ending_that_is_a_unit_counts(ending: str) -> None:
    assert split_unit(f"peak_value_{ending}") == ("peak value", UNITS[ending])


@pytest.mark.parametrize("name", ["sparc", "internal_share", "rad", "K", "Lambda_s_x"])
def test_name_without_unit_is_whole(name: str) -> None:
    assert split_unit(name) == (name.replace("_", " "), "")
