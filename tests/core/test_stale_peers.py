"""Modes of a site with a stale peer, and a reference without steps on the way back."""

from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from tests.core.builders import make_site_setup, step_site
from tests.execution.builders import make_trajectories
from trilat_net.core.links.delay import LinkModel
from trilat_net.core.step.site_setup import LinkSetup, StaleAction, StaleRule
from trilat_net.core.step.site_step import Site
from trilat_net.core.step.ticks import Arrival, Mode, TickInput, TickRecord
from trilat_net.scenario import load_scenario

MS = 1_000_000
RULE = StaleRule(StaleAction.HOLD, 20 * MS, 30 * MS)


def make_stale_site(
    rule: StaleRule, shares: tuple[float, float] = (0.5, 0.5), qd_limit_rad_s: float = 100.0
) -> Site:
    """Returns a site with two peers behind 5 ms; the samples of its peers come from `moving`."""
    links = tuple(
        LinkSetup(name, share, 1000, (0.4 * n, -0.3), models=(LinkModel(location=5_000.0),))
        for n, (name, share) in enumerate(zip("ab", shares, strict=True))
    )
    return Site(
        make_site_setup()._replace(links=links, on_stale=rule, qd_limit_rad_s=qd_limit_rad_s)
    )


def peer_state(peer: int, tick: int) -> tuple[tuple[float, float], tuple[float, float]]:
    """Returns position and velocity of a peer on its own straight way."""
    speed = (0.6, -0.2) if peer else (-0.3, 0.5)
    return (0.4 * peer + speed[0] * tick / 1000, -0.3 + speed[1] * tick / 1000), speed


def make_moving_arrival(peer: int, tick: int) -> Arrival:
    return Arrival(peer, tick, *peer_state(peer, tick))


def cut_ticks(count: int = 200) -> list[TickInput]:
    """Yields both peers at every tick, except peer 1 in samples from 50 to 90."""
    return [
        TickInput(
            k,
            [
                make_moving_arrival(j, k - 1)
                for j in (0, 1)
                if k and not (j and 50 <= k - 1 < 90)
            ],
        )
        for k in range(count)
    ]


def run_cut_site(rule: StaleRule, count: int = 200) -> list[TickRecord]:
    """Returns the records of a site during that cut."""
    return step_site(make_stale_site(rule), cut_ticks(count))


def runs_of(outputs: Sequence[TickRecord]) -> list[tuple[Mode, int]]:
    """Returns (mode, first tick) of every stretch."""
    edges = [
        0,
        *(k for k in range(1, len(outputs)) if outputs[k].mode is not outputs[k - 1].mode),
    ]
    return [(outputs[k].mode, k) for k in edges]


def compute_followed(
    output: TickRecord, shares: Sequence[float] = (0.5, 0.5)
) -> tuple[np.ndarray, np.ndarray]:
    """Returns the reference of the peers, from the samples in use."""
    poses = [
        ((0.4 * j, -0.3), (0.0, 0.0)) if m < 0 else peer_state(j, m)
        for j, m in enumerate(output.used)
    ]
    q, qd = (np.array([pose[n] for pose in poses]) for n in (0, 1))
    return np.array(shares) @ q, np.array(shares) @ qd


# The modes.


@pytest.mark.parametrize("action", [StaleAction.HOLD, StaleAction.BRAKE])
def test_divergence_is_final_in_every_mode(action: StaleAction) -> None:
    """A diverged record holds no reference."""
    stale_site = make_stale_site(RULE._replace(action=action), qd_limit_rad_s=1e-3)
    outputs = step_site(
        stale_site,
        [
            TickInput(k, [make_moving_arrival(j, k - 1) for j in (0, 1)] if k > 60 else [])
            for k in range(120)
        ],
    )
    diverged = next(o.tick for o in outputs if o.mode is Mode.DIVERGED)
    assert all(o.mode is Mode.DIVERGED and o.mem == [] for o in outputs[diverged:])
    q, _ = compute_followed(outputs[-1])
    assert outputs[-1].q_des == pytest.approx(q, abs=1e-12)


arrivals = st.lists(
    st.tuples(st.booleans(), st.booleans(), st.integers(1, 30)), min_size=1, max_size=12
).map(lambda parts: [heard for a, b, n in parts for heard in [(a, b)] * n])


BOTH = (True, True)
ONE = (True, False)
NONE = (False, False)
CUT = [*[BOTH] * 51, *[ONE] * 40, *[BOTH] * 109]
"""The second peer's samples from 50 to 90 are lost: the last one in use comes at tick 54."""
CUT_AGAIN = [*[BOTH] * 51, *[ONE] * 40, BOTH, *[ONE] * 108]


@example(CUT, StaleAction.HOLD, 20, 30, (0.5, 0.5))
@example(CUT, StaleAction.BRAKE, 20, 30, (0.5, 0.5))
@example(CUT, StaleAction.USE, 20, 30, (0.5, 0.5))
@example(CUT_AGAIN, StaleAction.HOLD, 20, 50, (0.5, 0.5))
@example([NONE] * 40, StaleAction.HOLD, 20, 30, (0.5, 0.5))
@example([ONE] * 100, StaleAction.HOLD, 20, 30, (1.0, 0.0))
@example([ONE] * 100, StaleAction.HOLD, 20, 30, (0.9, 0.1))
@settings(max_examples=60)
@given(
    heard=arrivals,
    action=st.sampled_from(
        [action for action in StaleAction if action is not StaleAction.GLIDE]
    ),
    age_ms=st.integers(1, 40),
    return_ms=st.integers(1, 60),
    shares=st.sampled_from([(0.5, 0.5), (0.25, 0.75), (1.0, 0.0)]),
)
def test_modes_and_references_follow_the_law(
    heard: list[tuple[bool, bool]],
    action: StaleAction,
    age_ms: int,
    return_ms: int,
    shares: tuple[float, float],
) -> None:
    """For any pattern of arrivals: the edges of `Mode`, and the reference of each mode."""
    stale_site = make_stale_site(StaleRule(action, age_ms * MS, return_ms * MS), shares)
    mode = Mode.RUN
    since = 0
    held = np.zeros(2)
    before = np.zeros(2)
    for k, flags in enumerate(heard):
        output = stale_site.step(
            TickInput(k, [make_moving_arrival(j, k - 1) for j in (0, 1) if flags[j] and k])
        )
        ages = [k - max(used, 0) for used in output.used]
        stale = any(share > 0 and age > age_ms for share, age in zip(shares, ages, strict=True))
        if action is not StaleAction.USE:
            if stale and mode in (Mode.RUN, Mode.RETURN):
                mode = Mode.HOLD if action is StaleAction.HOLD else Mode.BRAKE
                held = before if action is StaleAction.HOLD else np.array(output.q)
            elif not stale and mode in (Mode.HOLD, Mode.BRAKE):
                mode = Mode.RETURN
                since = k
            if mode is Mode.RETURN and k - since >= return_ms:
                mode = Mode.RUN
        q, qd = compute_followed(output, shares)
        if mode is Mode.RETURN:
            x = (k - since) / return_ms
            q, qd = (
                held + (3 * x**2 - 2 * x**3) * (q - held),
                (3 * x**2 - 2 * x**3) * qd
                + (6 * x * (1 - x) / (return_ms / 1000)) * (q - held),
            )
        elif mode is not Mode.RUN:
            q = held
            qd = np.zeros(2)
        assert output.mode is mode
        assert output.q_des == pytest.approx(q, abs=1e-12)
        assert output.qd_des == pytest.approx(qd, abs=1e-9)
        remembered = (
            [] if mode is Mode.RUN else [*held, since * MS if mode is Mode.RETURN else 0.0]
        )
        assert output.mem == pytest.approx(remembered, abs=1e-12)
        before = np.array(output.q_des)


# The way back.


@pytest.mark.parametrize("action", [StaleAction.HOLD, StaleAction.BRAKE])
def test_returning_references_have_no_step(action: StaleAction) -> None:
    """Central differences of the reference from the last tick of holding to well within RUN."""
    outputs = run_cut_site(StaleRule(action, 20 * MS, 400 * MS), 700)
    q, qd = (np.array([getattr(o, field) for o in outputs]) for field in ("q_des", "qd_des"))
    assert runs_of(outputs)[2:] == [(Mode.RETURN, 95), (Mode.RUN, 495)]
    assert (q[95] == q[94]).all()
    assert (qd[94:96] == 0.0).all()
    central = (q[2:] - q[:-2]) / 2e-3
    assert np.abs(central[95:598] - qd[96:599]).max() < 5e-3
    assert np.abs(np.diff(q[90:600], axis=0)).max() < 2e-3


@pytest.mark.parametrize("k", [72, 90, 96, 110, 126])
@pytest.mark.parametrize("action", [StaleAction.HOLD, StaleAction.BRAKE])
def test_stale_sites_resume_the_same_bits(action: StaleAction, k: int) -> None:
    """In any mode, because the records hold the site's memory."""
    rule = RULE._replace(action=action)
    whole = run_cut_site(rule)
    stale_site = make_stale_site(rule)
    last = whole[k - 1]
    in_use = [make_moving_arrival(j, m) for j, m in enumerate(last.used)]
    heard = [
        (j, m)
        for j in (0, 1)
        for m in range(last.used[j] + 1, k - 1)
        if not (j and 50 <= m < 90)
    ]
    stale_site.restore_links(k, in_use, [make_moving_arrival(j, m) for j, m in heard])
    stale_site.restore_state(whole[k - 2], last)
    assert step_site(stale_site, cut_ticks()[k:]) == whole[k:]


# What it is good for.


@pytest.mark.long
def test_ramped_returns_remove_kicks_after_outages() -> None:
    """Scenario `outage`: the slave is cut off while its master moves, and all samples arrive at once."""

    def kick(action: str) -> float:
        runs_made = make_trajectories(load_scenario("outage", {"on_stale.action": action}))
        healed = runs_made.sites["s"].t_s >= runs_made.scenario.links["m1->s"].outages_s[0][1]
        return float(np.abs(runs_made.sites["s"].qd[healed]).max())

    assert kick("hold") < 0.6 * kick("use")
