"""Only a recorder may join a running session."""

from contextlib import suppress

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from trilat_net.errors import SessionError
from trilat_net.net import topics
from trilat_net.net.membership import Epoch
from trilat_net.net.session import LATE_GATHER_NS

from .parties import STEP_NS, Party

SITES = ("m1", "m2", "s")
RECORDER = topics.RECORDER


def make_running_party(*others: str) -> tuple[Party, Epoch]:
    """Returns a running session of all sites and of others, and its epoch."""
    session = Party(SITES)
    session.start(*SITES, *others)
    epoch = session.agreed()
    session.rounds(60)
    return session, epoch


def wait_for_recorder(session: Party, within_ns: int) -> Epoch | None:
    for _ in range(within_ns // STEP_NS):
        if session.members[RECORDER].epoch is not None:
            break
        session.round()
    return session.members[RECORDER].epoch


def test_recorders_learn_epoch_and_boots() -> None:
    session, epoch = make_running_party()
    session.start(RECORDER)
    late = wait_for_recorder(session, LATE_GATHER_NS)
    assert late == epoch._replace(epochs={})
    assert session.kinds().count("start") == 1


@given(ahead_ns=st.integers(-(10**9) + 1, 10**15), unix_ns=st.integers(0, 2**60))
@settings(max_examples=30, deadline=None)
def test_skewed_recorders_find_the_same_instant(ahead_ns: int, unix_ns: int) -> None:
    session, epoch = make_running_party()
    session.start(RECORDER, on_clock=session.elsewhere(ahead_ns, unix_ns))
    late = wait_for_recorder(session, 4 * LATE_GATHER_NS)
    assert late is not None
    assert late.mono_ns == epoch.mono_ns + ahead_ns
    assert late.unix_ns == epoch.unix_ns


def test_missing_sites_are_awaited_briefly() -> None:
    session, epoch = make_running_party()
    session.kill("s")
    session.start(RECORDER)
    assert wait_for_recorder(session, LATE_GATHER_NS - 5 * STEP_NS) is None
    assert wait_for_recorder(session, 30 * STEP_NS) == epoch._replace(epochs={})
    assert set(session.members[RECORDER].joining.membership.others) == {"m1", "m2"}


def test_one_of_two_recorders_is_late() -> None:
    session = Party(SITES)
    session.start(*SITES, RECORDER)
    first = session.members["first"] = session.members.pop(RECORDER)
    session.start(RECORDER)
    session.rounds(100)
    sites = [session.members[name] for name in SITES]
    epoch = sites[0].epoch
    assert epoch is not None
    assert all(site.epoch == epoch for site in sites)
    both = (first, session.members[RECORDER])
    assert [member.epoch for member in both if member.info.boot == epoch.boots[RECORDER]] == [
        epoch
    ]
    session.rounds(100)
    assert [member.epoch.mono_ns for member in both if member.epoch] == [epoch.mono_ns] * 2


def test_recorders_may_join_after_the_start() -> None:
    session = Party(SITES)
    session.start(*SITES, RECORDER)
    while session.kinds().count("ready") < len(SITES):
        session.round()
    deaf = session.members.pop(RECORDER)  # it has said ready, and misses what comes then
    session.rounds(3)
    deaf.joining._events = session.network.join().inbox("nothing")
    epoch = session.members["m1"].epoch
    assert epoch is not None
    session.members[RECORDER] = deaf
    while session.clock.monotonic_ns() + STEP_NS < epoch.mono_ns:
        session.round()
        assert deaf.epoch is None
    late = wait_for_recorder(session, 2 * LATE_GATHER_NS)
    assert late == epoch._replace(epochs={})


@pytest.mark.parametrize(
    "forged", [{"boots": {"m1": 5}}, {"boots": {}}, {"scenario": ""}, {"running": False}]
)
def test_contradicting_members_are_not_believed(forged: dict[str, object]) -> None:
    session, _ = make_running_party()
    for name in SITES:
        publisher = session.members[name].publisher
        publisher.info = msgspec.structs.replace(publisher.info, **forged)
    session.start(RECORDER)
    # a session that runs and does not say since when takes nobody in
    with suppress(SessionError):
        wait_for_recorder(session, 3 * LATE_GATHER_NS)
    assert session.members[RECORDER].epoch is None


def test_recorders_do_not_learn_from_recorders() -> None:
    session, epoch = make_running_party(RECORDER)
    session.members["other"] = session.members.pop(RECORDER)
    session.start(RECORDER)
    assert wait_for_recorder(session, 2 * LATE_GATHER_NS) == epoch._replace(epochs={})
    assert RECORDER not in session.members[RECORDER].joining.membership.others


def test_restarted_sites_are_not_awaited() -> None:
    """A member met under another boot, while the old boot's token is absent, left before the
    newcomer arrived.
    """
    session, epoch = make_running_party()
    session.kill("s")
    session.start(RECORDER)
    anew = {"member": "s", "boot": 99, "running": False, "boots": {}}
    session.members[RECORDER].joining.membership.receive_identity(
        msgspec.structs.replace(session.members["m1"].publisher.info, **anew),
        may_have_started=False,
    )
    assert wait_for_recorder(session, 30 * STEP_NS) == epoch._replace(epochs={})
