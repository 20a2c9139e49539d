"""The memory of a user's law is recorded as numbers, and restored in its own form."""

from typing import Any

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from trilat_net.core.plug.user_law import SiteLaw

reals = st.floats(-1e6, 1e6)
shapes = st.sampled_from([(2,), (3, 2), (1, 2, 2)])
values = st.recursive(
    reals
    | st.booleans()
    | st.integers(-1000, 1000)
    | arrays(np.float64, shapes, elements=reals),
    lambda inner: st.lists(inner, max_size=3) | st.lists(inner, max_size=3).map(tuple),
    max_leaves=6,
)


class Holder:
    """A law with one attribute."""

    remembers = ("kept",)

    def __init__(self, kept: Any) -> None:
        self.kept = kept


def describe_value(value: Any) -> Any:
    """Returns the form of a value: its types, and the shapes of its arrays."""
    if isinstance(value, np.ndarray):
        return value.dtype, value.shape
    return (
        [type(value), *map(describe_value, value)]
        if isinstance(value, list | tuple)
        else type(value)
    )


@given(values)
def test_memory_is_restored_in_its_own_form(kept: Any) -> None:
    first = SiteLaw(Holder(kept), "s")
    again = Holder(kept)
    restored = SiteLaw(again, "s")
    restored.restore(first.memory)
    assert describe_value(again.kept) == describe_value(kept)
    assert restored.memory == first.memory


@given(arrays(np.float64, shapes, elements=reals), reals)
def test_arrays_of_memory_take_numbers_in_order(kept: Any, behind: float) -> None:
    law = Holder([np.zeros_like(kept), 0.0])
    SiteLaw(law, "s").restore([*kept.ravel().tolist(), behind])
    np.testing.assert_array_equal(law.kept[0], kept)
    assert law.kept[1] == behind
