"""The account of a channel, against the set of ticks that came."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from trilat_net.log import accounting
from trilat_net.log.accounting import Account

streams = st.lists(st.integers(0, 60), max_size=80)


def gaps_of(came: set[int], end: int) -> list[list[int]]:
    missing = [tick for tick in range(end) if tick not in came]
    starts = [t for t in missing if t - 1 not in missing]
    ends = [t for t in missing if t + 1 not in missing]
    return [list(pair) for pair in zip(starts, ends, strict=True)]


@given(stream=streams, ticks=st.integers(0, 70))
def test_an_account_is_what_the_set_of_ticks_says(stream: list[int], ticks: int) -> None:
    account, came, duplicate, reordered, newest = Account(), set[int](), 0, 0, -1
    for tick in stream:
        is_new = tick not in came
        assert account.take(tick) == is_new
        duplicate += not is_new
        reordered += is_new and tick < newest
        came.add(tick)
        newest = max(newest, tick)
    account.expect(ticks)
    gaps = gaps_of(came, max(ticks, newest + 1))
    assert account.gaps == gaps
    assert (account.received, account.duplicate, account.reordered) == (len(came), duplicate, reordered)
    assert account.missing == max(ticks, newest + 1) - len(came)
    assert account.largest_gap == max((last - first + 1 for first, last in gaps), default=0)
    assert account.last == max(ticks - 1, newest)


@given(stream=streams, most=st.integers(1, 4))
def test_gaps_are_bounded_and_missing_is_never_too_small(stream: list[int], most: int) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(accounting, "MAX_GAPS", most)
        account, came = Account(), set[int]()
        newest = -1
        for tick in stream:
            if tick > newest:  # in order: a tick that comes late may split a gap
                account.take(tick)
                came.add(tick)
                newest = tick
        assert len(account.gaps) <= most
        assert account.missing >= newest + 1 - len(came)


def test_an_account_reads_as_one_line() -> None:
    account = Account()
    for tick in (0, 1, 5, 3, 3):
        account.take(tick)
    account.expect(10)
    assert account.as_text() == (
        "received 4, missing 6, duplicate 1, reordered 1, largest gap 4 (2-2 4-4 6-9)"
    )
