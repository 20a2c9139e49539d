"""Bugs that are planted in the program: each breaks one invariant, and the seeds must find it."""

import math
import random
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from typing import Any
from unittest import mock

from sites.peer_monitor import PeerMonitor
from sites.running_site import RunningSite
from sites.site_loop import PeerInbox
from trilat_net.core.step.site_setup import RestGains, SiteSetup, StaleAction
from trilat_net.core.step.site_step import Site
from trilat_net.core.step.ticks import Arrival, TickRecord
from trilat_net.log.log_writer import LogParts
from trilat_net.net.membership import Epoch

from .judged_seed import AGAIN, TORQUE


def _with_setups(change: Callable[[SiteSetup], SiteSetup]) -> AbstractContextManager[Any]:
    """Sites are built from other set-ups than their scenario states."""
    begin = Site.__init__
    return mock.patch.object(Site, "__init__", lambda site, setup: begin(site, change(setup)))


def _with_records(change: Callable[[TickRecord], TickRecord]) -> AbstractContextManager[Any]:
    """Sites publish other records than their step has made."""
    step = Site.step
    return mock.patch.object(Site, "step", lambda site, inputs: change(step(site, inputs)))


def waits_too_long() -> AbstractContextManager[Any]:
    """A silence of 60 ms does not yet count as silence."""

    def slower(setup: SiteSetup) -> SiteSetup:
        rule = setup.on_stale
        return setup._replace(on_stale=rule._replace(age_ns=3 * rule.age_ns))

    return _with_setups(slower)


def follows_at_once() -> AbstractContextManager[Any]:
    """Sites begin to follow without waiting or aligning."""

    def at_once(setup: SiteSetup) -> SiteSetup:
        return setup._replace(on_stale=setup.on_stale._replace(action=StaleAction.USE))

    return _with_setups(at_once)


@contextmanager
def jumps_back() -> Iterator[None]:
    """After a hold, the reference jumps to the peers at once, and the torque follows."""

    def faster(setup: SiteSetup) -> SiteSetup:
        unlimited = setup.limits._replace(tau_rate=(math.inf,))
        return setup._replace(
            limits=unlimited, on_stale=setup.on_stale._replace(align_speed=1e9)
        )

    with _with_setups(faster), mock.patch("trilat_net.core.life.session_life.MIN_ALIGN_NS", 1):
        yield


def learns_the_wrong_way() -> AbstractContextManager[Any]:
    """The estimate goes up the gradient."""

    def wrong(setup: SiteSetup) -> SiteSetup:
        gains = setup.gains
        return setup._replace(gains=gains._replace(Gamma=tuple(-gain for gain in gains.Gamma)))

    return _with_setups(wrong)


def _with_rest(change: Callable[[RestGains], RestGains]) -> AbstractContextManager[Any]:
    """Arms come to rest otherwise than their stated settings imply."""
    return _with_setups(lambda setup: setup._replace(rest=change(setup.rest)))


def feeds_what_moves() -> AbstractContextManager[Any]:
    """The brake of an arm that comes to rest pushes along the motion."""
    return _with_rest(lambda rest: rest._replace(damping=tuple(-0.1 * B for B in rest.damping)))


def _with_slower_rest(share: float) -> AbstractContextManager[Any]:
    return _with_rest(
        lambda rest: rest._replace(deceleration=tuple(share * a for a in rest.deceleration))
    )


def goes_too_far() -> AbstractContextManager[Any]:
    """An arm comes to rest over ten times its stated distance."""
    return _with_slower_rest(0.1)


def exceeds_its_limit() -> AbstractContextManager[Any]:
    """A torque exceeds its limit now and then."""

    def beyond(record: TickRecord) -> TickRecord:
        return record._replace(tau=[1e4, 0.0]) if record.tick % 1500 == 1200 else record

    return _with_records(beyond)


def says_an_older_sample() -> AbstractContextManager[Any]:
    """A record now and then names an older sample than the record before."""

    def older(record: TickRecord) -> TickRecord:
        used = [max(-1, tick - 100) for tick in record.used]
        return record._replace(used=used) if record.tick % 1500 == 1200 else record

    return _with_records(older)


def never_admits_again() -> AbstractContextManager[Any]:
    """A site that comes back is never admitted by the others."""
    return mock.patch.object(PeerMonitor, "_decide_on_join", return_value=None)


def begins_at_zero() -> AbstractContextManager[Any]:
    """A site that comes back counts its ticks from 0."""
    begin = RunningSite.__init__

    def at_zero(
        site: RunningSite, parts: Any, publisher: Any, pinger: Any, epoch: Epoch
    ) -> None:
        begin(site, parts, publisher, pinger, epoch._replace(first=0))

    return mock.patch.object(RunningSite, "__init__", at_zero)


def loses_records() -> AbstractContextManager[Any]:
    """The recorder loses a message in a thousand."""
    add = LogParts.add
    count = 0

    def forgetful(log: LogParts, *message: Any) -> Any:
        nonlocal count
        count += 1
        return None if count % 1000 == 999 else add(log, *message)

    return mock.patch.object(LogParts, "add", forgetful)


def depends_on_chance() -> AbstractContextManager[Any]:
    """The order of arrivals differs between equal runs."""
    drain = PeerInbox.drain

    def shuffled(inbox: PeerInbox, since_epoch_ns: int) -> list[Arrival]:
        arrivals = drain(inbox, since_epoch_ns)
        random.shuffle(arrivals)
        return arrivals

    return mock.patch.object(PeerInbox, "drain", shuffled)


PLANTED: Sequence[tuple[Callable[[], AbstractContextManager[Any]], str]] = (
    (follows_at_once, "I1 edges"),
    (exceeds_its_limit, "I2 limits"),
    (waits_too_long, "I3, I7 silence"),
    (says_an_older_sample, "I4 order"),
    (learns_the_wrong_way, "I5 storage"),
    (jumps_back, TORQUE),
    (never_admits_again, "I8 liveness"),
    (begins_at_zero, "I9 starts"),
    (loses_records, "I10 log"),
    (depends_on_chance, AGAIN),
    (feeds_what_moves, "I12 energy"),
    (goes_too_far, "I14 travel"),
)
"""Bugs, and the invariant that each must break.

I13 has none: most rests of a session end before the stated time. `tests/core/test_hard_stops.py` judges it.
"""
