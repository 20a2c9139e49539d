"""The rule `glide`: a site before its peers have joined, during the silence of a peer, and on
its way back.
"""

from itertools import product

import numpy as np
import pytest

import trilat_net
from tests.core.guarded_runs import TEXT
from tests.execution.builders import make_trajectories, sample_records
from trilat_net.core.life.session_life import MIN_ALIGN_NS
from trilat_net.core.step.site_step import Site
from trilat_net.core.step.ticks import (
    RELEASE_REASONS,
    CoreChange,
    LifeOrder,
    LifeReason,
    Mode,
    TickInput,
)
from trilat_net.errors import ScenarioError
from trilat_net.execution.verification import verify_log
from trilat_net.log.log_reader import Log
from trilat_net.scenario import Scenario, parse_scenario

OUTAGE = "[[2.0, 2.6]]"


def make_glide_scenario(
    duration_s: float = 5.0, rate_hz: int = 1000, outages_s: str = OUTAGE, **keys: float
) -> Scenario:
    keys = {"speed": 1.0, "limit": 1.5, **keys}
    return parse_scenario(
        TEXT.format(duration_s=duration_s, rate_hz=rate_hz, outages_s=outages_s, **keys)
    )


@pytest.fixture(scope="module")
def log() -> Log:
    return trilat_net.simulate(make_glide_scenario())


def test_sites_wait_then_align_then_follow(log: Log) -> None:
    for site, other in (("m", "s"), ("s", "m")):
        part = log[site]
        modes = part.mode
        assert set(modes[:100]) == {"waiting"}
        assert (part.q_des[:100] == part.q[0]).all()
        assert (part.qd_des[:100] == 0.0).all()
        assert modes[100] == "return"
        engaged = int(np.argmax(modes == "run"))
        way = np.abs(part.q[0] - log[other].q[0]).max()
        assert (engaged - 100) * 1e-3 == pytest.approx(
            max(1.5 * way / 1.0, 1e-9 * MIN_ALIGN_NS), abs=0.15
        )
        late = log[other].q[engaged - 100 : 1900]
        assert np.abs(part.q_des[engaged:2000] - late).max() == 0.0


def test_a_silent_peer_is_held_after_20_ms(log: Log) -> None:
    """Samples of the outage would come into use from 2.1 s on; the last sample did at 2.099 s."""
    modes = log["s"].mode
    assert modes[2119] == "run"
    assert modes[2120] == "hold"
    assert (log["s"].q_des[2120] == log["s"].q[2120]).all()  # it rests where it is
    assert (log["s"].qd_des[2120] == log["s"].qd[2120]).all()
    assert (log["s"].qd_des[2220:2700] == 0.0).all()
    assert np.ptp(log["s"].q_des[2220:2700], axis=0).max() == 0.0
    assert modes[2700] == "return"


@pytest.mark.parametrize("site", ["m", "s"])
def test_the_reference_never_jumps(site: str, log: Log) -> None:
    """In all modes a step of q_des is the integral of qd_des, to the third order of the tick.

    Where the arm begins to rest, the reference changes from the peers' to its own pose.
    """
    part = log[site]
    h_s = 1e-3
    steps = np.diff(part.q_des, axis=0)
    means = 0.5 * h_s * (part.qd_des[1:] + part.qd_des[:-1])
    # at the first tick without a new sample, what is in use stays, and so does qd_des
    stale = np.zeros(len(steps), dtype=bool)
    stale[2099:2120] = True
    # h^3/12 of a torque's rate through its peer's inertia
    assert np.abs(steps - means)[~stale].max() <= 2e-6
    assert np.abs(np.diff(part.qd_des, axis=0))[~stale].max() <= 0.06


@pytest.mark.parametrize("speed", [0.2, 1.0])
def test_approaches_to_peers_keep_their_speed_limit(speed: float) -> None:
    log = trilat_net.simulate(make_glide_scenario(12.0, outages_s="[]", speed=speed))
    part = log["s"]
    other = log["m"]
    aligning = np.flatnonzero(part.mode == "return")
    way_rate = part.qd_des[aligning] - other.qd[aligning - 100]
    start = np.abs(way_rate[0]).max()
    assert np.abs(way_rate).max() <= speed + start + 1e-12
    assert np.abs(way_rate[-1]).max() <= 0.02


def test_sites_beyond_their_limit_wait_and_say_so() -> None:
    log = trilat_net.simulate(make_glide_scenario(1.0, outages_s="[]", limit=0.1))
    assert set(log["s"].mode) == {"waiting"}
    shared = 2
    assert log["s"].states[-1].mem[2 * shared + 1] == LifeReason.ALIGN_LIMIT


def test_every_driver_gives_the_same_bits() -> None:
    scenario = make_glide_scenario(3.0)
    ticks = make_trajectories(scenario)
    fused = sample_records(scenario, (3.0,))[:, 0]
    columns = scenario.layout("m").columns()
    for site, row in zip(ticks.sites.values(), fused, strict=True):
        assert all(
            (getattr(site, name)[-1] == row[columns[name]]).all()
            for name in ("q", "qd", "tau", "q_des")
        )
    log = trilat_net.simulate(scenario)
    assert verify_log(log).identical == 6000


@pytest.mark.parametrize(
    ("rate_hz", "silence", "phrase"),
    [(100, 5.0, "two periods of 100 Hz"), (1000, 1.0, "two periods")],
)
def test_a_silence_shorter_than_two_periods_is_refused(
    rate_hz: int, silence: float, phrase: str
) -> None:
    text = TEXT.replace('action = "glide"', f'action = "glide"\nsilence_ms = {silence}')
    with pytest.raises(ScenarioError, match=phrase):
        parse_scenario(
            text.format(duration_s=1.0, rate_hz=rate_hz, outages_s="[]", speed=0.5, limit=1.0)
        )


ORDERS = (LifeOrder.STOP, LifeOrder.RELEASED, LifeOrder.HELD, LifeOrder.ENABLE)
"""Orders that concern a stopped arm."""


@pytest.mark.parametrize("orders", list(product(ORDERS, repeat=3)))
def test_released_arms_stay_braked_until_allowed(orders: tuple[LifeOrder, ...]) -> None:
    """After a release no further stop opens the brakes, and only `enable` ends a stop."""
    site = Site(make_glide_scenario().setup("s"))
    is_stopped = False
    is_released = False
    for tick, order in enumerate(orders):
        change = CoreChange(order.name.lower(), order=order)
        site.step(TickInput(tick, commands=[change]))
        if order is LifeOrder.STOP:
            is_stopped = True
        elif order is LifeOrder.RELEASED:
            is_released = True
        elif order is LifeOrder.ENABLE or not is_stopped:
            is_stopped = False
            is_released = False
        is_braked = site.life_reason in RELEASE_REASONS
        assert (site.mode is Mode.STOPPED) == (is_stopped or is_released)
        assert is_braked == is_released
