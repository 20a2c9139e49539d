"""Accounts and ranges, against the set of numbers that came."""

from collections.abc import Sequence
from itertools import pairwise, permutations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from trilat_net.log import accounting
from trilat_net.log.accounting import Account, RangeSet, StartGap, describe_unknown_ends

streams = st.lists(st.integers(0, 60), max_size=80)


def gaps_of(received: set[int], end: int) -> list[list[int]]:
    missing = [tick for tick in range(end) if tick not in received]
    starts = [t for t in missing if t - 1 not in missing]
    ends = [t for t in missing if t + 1 not in missing]
    return [list(pair) for pair in zip(starts, ends, strict=True)]


@given(stream=streams, ticks=st.integers(0, 70))
def test_accounts_equal_the_set_of_ticks(stream: list[int], ticks: int) -> None:
    account = Account()
    received = set[int]()
    duplicate = 0
    reordered = 0
    newest = -1
    for tick in stream:
        is_new = tick not in received
        assert account.receive(tick) == is_new
        duplicate += not is_new
        reordered += is_new and tick < newest
        received.add(tick)
        newest = max(newest, tick)
    account.add_expected(ticks)
    gaps = gaps_of(received, max(ticks, newest + 1))
    assert account.gaps == gaps
    assert (account.received, account.duplicate, account.reordered) == (
        len(received),
        duplicate,
        reordered,
    )
    assert account.missing == max(ticks, newest + 1) - len(received)
    assert account.largest_gap == max((last - first + 1 for first, last in gaps), default=0)
    assert account.last == max(ticks - 1, newest)


@given(stream=streams, ticks=st.integers(0, 70), most=st.integers(1, 4))
def test_gaps_are_bounded_and_missing_is_exact(
    stream: list[int], ticks: int, most: int
) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(accounting, "MAX_GAPS", most)
        account = Account()
        taken = set[int]()
        for tick in stream:
            if account.receive(tick):
                assert tick not in taken
                taken.add(tick)
        account.add_expected(ticks)
        assert len(account.gaps) <= most
        assert account.received == len(taken)
        assert account.missing == max([ticks - 1, *stream], default=-1) + 1 - len(taken)
        assert account.received + account.duplicate == len(stream)


@given(
    stream=st.lists(
        st.tuples(st.sampled_from(["came", "from memory"]), st.integers(0, 40)), max_size=80
    ),
    hopeless=st.integers(0, 50),
)
def test_remembered_records_are_stored_once_in_order(
    stream: list[tuple[str, int]], hopeless: int
) -> None:
    account = Account()
    stored_numbers = set[int]()
    newest = -1
    reordered = 0
    refilled = 0
    duplicate = 0
    for how, number in stream:
        new = number not in stored_numbers
        if how == "came":
            reordered += new and number < newest
            duplicate += not new
            newest = max(newest, number)
        else:
            refilled += new
        assert (account.receive if how == "came" else account.refill)(number) == new
        stored_numbers.add(number)
    account.abandon_below(hopeless)
    assert (account.received, account.refilled) == (len(stored_numbers), refilled)
    assert (account.reordered, account.duplicate) == (reordered, duplicate)
    missing = sorted(set(range(account.expected)) - stored_numbers)
    for start in range(0, 52, 3):
        wanted = [number for number in missing if number >= max(start, hopeless)]
        gap = account.find_requestable_gap(start)
        assert (gap[0] if gap else None) == (wanted[0] if wanted else None)
    assert account.missing == len(missing)


@given(st.lists(st.integers(0, 10**12), min_size=1, max_size=30).map(sorted), st.booleans())
def test_longest_silence_is_between_two_arrivals(arrivals_ns: list[int], again: bool) -> None:
    account = Account()
    for number, at_ns in enumerate(arrivals_ns):
        account.receive(0 if again else number, at_ns)
        account.refill(number + 5)
    assert account.silence_ns == max((b - a for a, b in pairwise(arrivals_ns)), default=0)


def test_an_account_reads_as_one_line() -> None:
    account = Account()
    for tick in (0, 1, 5, 3, 3):
        account.receive(tick, tick * 1_000_000)
    account.refill(4)
    account.add_expected(10)
    assert account.describe() == (
        "expected 10, received 5, missing 5, duplicate 1, reordered 1, refilled 1, "
        "largest gap 4 (2-2 6-9), longest silence 4.0 ms"
    )


def test_of_very_many_gaps_the_first_are_named() -> None:
    account = Account()
    for tick in range(0, 1000, 2):
        account.receive(tick)
    assert account.describe().endswith(
        "largest gap 1 (" + " ".join(f"{n}-{n}" for n in range(1, 40, 2)) + " ...)"
    )


@pytest.mark.parametrize(
    ("first_start", "tick_count", "missing", "unmade"),
    [
        (range(5), 0, 0, 5),  # it was killed: what it made besides is not known
        (range(5), 7, 2, 3),  # it stated seven at its end
        ((0, 1, 4), 0, 2, 5),  # a gap of its own stays one
        ((), 0, 0, 10),  # it was never there
    ],
)
def test_ticks_between_starts_are_not_missing(
    first_start: Sequence[int], tick_count: int, missing: int, unmade: int
) -> None:
    for told_first in (True, False):
        account = Account()
        for number in first_start:
            account.receive(number)
        account.add_expected(tick_count)
        if told_first:
            account.mark_unpublished(10, tick_count)
        for number in range(10, 13):
            account.receive(number)
        if not told_first:
            account.mark_unpublished(10, tick_count)
        assert (account.missing, account.unpublished) == (missing, unmade)
        assert account.expected == account.received + account.missing == 13 - unmade
        account.mark_unpublished(10, tick_count)  # said twice, it counts once
        assert account.unpublished == unmade


def test_records_lost_in_a_kill_are_not_made() -> None:
    account = Account()
    gap = StartGap(account, 2)
    account.receive(4)
    gap.begin_next_start(10, 0)
    gap.note_published(7)
    assert (account.gaps, account.unpublished) == ([[0, 3]], 5)
    gap.note_published(8)  # that is more than can have been under way
    assert (account.gaps, account.unpublished) == ([[0, 3], [5, 7]], 2)


@pytest.mark.parametrize(
    "order", [*permutations(("join", "heard 7", "heard 6", "records"))], ids=" ".join
)
def test_heard_records_of_killed_starts_are_missing(
    order: Sequence[str],
) -> None:
    """0 to 4 came; others heard of 5 and 6; the next start begins with 10."""
    account = Account()
    for number in range(5):
        account.receive(number)
    gap = StartGap(account, 1)
    for news in order:
        if news == "join":
            gap.begin_next_start(10, 0)
        elif news == "records":
            for number in range(10, 13):
                account.receive(number)
        else:
            gap.note_published(int(news[-1]))
    gap.begin_next_start(10, 0)  # said twice, it counts once
    assert (account.gaps, account.missing, account.unpublished) == ([[5, 6]], 2, 3)
    assert account.expected == account.received + account.missing == 10


@given(
    received=st.integers(0, 5),
    under_way=st.integers(0, 4),
    reports=st.lists(st.integers(0, 14), max_size=4),
    position=st.integers(0, 4),
)
def test_reported_losses_beyond_transit_are_missing(
    received: int, under_way: int, reports: list[int], position: int
) -> None:
    """The order of the reports and the next start, and a start without any message, change nothing."""
    account = Account()
    for number in range(received):
        account.receive(number)
    gap = StartGap(account, under_way)
    for report in reports[:position]:
        gap.note_published(report)
    gap.begin_next_start(10, 0)
    for report in reports[position:]:
        gap.note_published(report)
    lost = min(max([received, *reports]), 10) - received
    missing = lost if lost > under_way else 0
    assert (account.missing, account.unpublished) == (missing, 10 - received - missing)


@pytest.mark.parametrize(
    ("sites", "names"), [(["m"], "m"), (["m", "s"], "m and s"), (["a", "b", "c"], "a, b and c")]
)
def test_unknown_ends_name_each_site_once(sites: Sequence[str], names: str) -> None:
    assert describe_unknown_ends(sites).startswith(f"the end of {names} is unknown")


@given(first=st.integers(-5, 5), length=st.integers(1, 10), data=st.data())
def test_removed_numbers_leave_the_rest_of_their_range(
    first: int, length: int, data: st.DataObject
) -> None:
    numbers = range(first, first + length)
    low = data.draw(st.sampled_from(numbers))
    high = data.draw(st.sampled_from(range(low, numbers.stop)))
    ranges = RangeSet(10)
    ranges.insert(numbers[0], numbers[-1])
    assert ranges.remove(low, high)
    kept = [n for low_kept, high_kept in ranges for n in range(low_kept, high_kept + 1)]
    assert kept == [n for n in numbers if not low <= n <= high]
