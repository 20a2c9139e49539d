"""Arms come to rest by the equations of `resting` in all modes that wait, hold, stop or fail."""

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import trilat_net
from tests.core.guarded_runs import (
    LIMITS,
    RATE_NM_S,
    TEXT,
    adaptive_text,
    find_largest_step,
    make_guarded_scenario,
    make_ordered_log,
    make_stopped_log,
)
from tests.core.hard_stops import CHAINS, RULE, THREE, TWO
from tests.core.rests import compute_reference, compute_rest_torque, gravity_of, read_integrals
from trilat_net.analysis.arm_rows import PlanarArmRows, build_arm_rows
from trilat_net.core.life.resting import limit_torque_rate
from trilat_net.core.plug.user_law import LawContext, LawInput
from trilat_net.core.step.site_arrays import SiteArrays
from trilat_net.core.step.site_setup import LEAST_STOP_S, RestGains
from trilat_net.core.step.site_step import Site
from trilat_net.core.step.ticks import CoreChange, LifeOrder, Mode, TickInput
from trilat_net.core.step.vectors import Array
from trilat_net.execution.verification import verify_log
from trilat_net.log.log_reader import Log
from trilat_net.scenario import Scenario, load_scenario
from trilat_net.scenario.laws import LAWS

AT_REST_RAD_S = 0.05
REST_WITHIN_S = 1.5


@pytest.mark.parametrize("law", ["adaptive", "pd_d"])
def test_references_rest_from_their_own_motion(law: str) -> None:
    """Eq.

    (1) of docs/theory/coming-to-rest.md; never faster than the joint, and in its direction.
    """
    log = make_stopped_log(adaptive_text() if law == "adaptive" else TEXT)
    part = log["s"]
    gains = log.scenario.setup("s").rest
    assert set(part.mode[2000:3500]) == {"stopped"}
    assert np.abs(part.qd[2000]).max() > 0.05
    wanted = compute_reference(gains, part, 2000, 1500)
    assert np.abs(part.q_des[2000:3500] - wanted[0]).max() <= 1e-12
    assert np.abs(part.qd_des[2000:3500] - wanted[1]).max() <= 1e-12
    ahead = part.qd[2000:3500] * part.qd_des[2000:3500] - part.qd_des[2000:3500] ** 2
    assert ahead.min() >= 0.0
    assert np.diff(np.abs(part.qd_des[2000:3500]), axis=0).max() <= 0.0


def test_stopping_torque_is_law_plus_rest() -> None:
    """tau = G - K e - d qd - Kd ed + w - B s, w' = -k B s: Eq.

    (2) to (4) of docs/theory/coming-to-rest.md.
    """
    log = make_stopped_log(TEXT)
    part = log["s"]
    rows = slice(2000, 3500)
    q = part.q[rows]
    qd = part.qd[rows]
    e = q - part.q_des[rows]
    ed = qd - part.qd_des[rows]
    law = gravity_of(log.scenario.arms["s"].theta, q) - 60.0 * e - 12.0 * qd - 4.0 * ed
    setup = log.scenario.setup("s")
    limit = np.broadcast_to(setup.tau_limit_nm, 2)
    wanted, w = compute_rest_torque(setup.rest, part, law, 2000, limit)
    assert np.abs(part.tau[rows] - wanted).max() <= 1e-9
    assert np.abs(read_integrals(part, rows)[:-1] - w[1:]).max() <= 1e-9
    assert find_largest_step(log, "s", 2000) <= RATE_NM_S / 1000.0 + 1e-9
    assert part.mode[3500] == "return"  # its peers are there
    assert part.mode[-1] == "run"


@pytest.mark.parametrize("how", ["stop", "cut"])
def test_storage_falls_by_its_dissipation(how: str) -> None:
    """V = S + 1/2 w'(k B)^-1 w, V' = -r'(Kp + B) r - qd'Kd qd at a reference at rest, learning.

    S is that of the adaptive law. w advances by Euler's rule, whose own storage is less by 1/2
    h w's.
    """
    keys: dict[str, Any] = (
        {"duration_s": 6.0, "outages_s": "[[1.0, 20.0]]"} if how == "cut" else {}
    )
    text = adaptive_text().replace("[[sites.m.hands]]", "[[sites.s.hands]]")
    limits = {**LIMITS, "tau_rate_limit_nm_s": 1e6}  # no limit acts
    log = make_ordered_log(
        make_guarded_scenario(limits, text, **keys),
        {} if how == "cut" else {"m": {1500: "stop"}},
    )
    part = log["m"]
    theta = log.scenario.arms["m"].theta
    first = int(np.argmax(part.mode == ("hold" if how == "cut" else "stopped")))
    gains = log.scenario.setup("m").rest
    brakes = np.arange(len(part)) < first + round(1e3 * LEAST_STOP_S)  # w loses B |qd| as well
    still = int(np.argmax((part.qd_des == 0.0).all(axis=1) & ~brakes))
    rows = slice(still, 5900)
    q = part.q[rows]
    qd = part.qd[rows]
    e = q - part.q_des[rows]
    off = part.theta_hat[rows] - theta
    r = qd + 2.0 * e
    B = np.array(gains.damping)
    w = read_integrals(part, slice(still - 1, 5899))
    V = 0.5 * (
        (r * PlanarArmRows(theta, 0.0, (1.0, 1.0)).multiply_inertia(q, r)).sum(axis=1)
        + 2.0 * 5.0 * (e**2).sum(axis=1)
        + (off**2).sum(axis=1) / 3.0
        + (w**2 / (B / (4.0 * gains.time_s))).sum(axis=1)
        - 1e-3 * (w * r).sum(axis=1)
    )
    power = -(r * (4.0 + B) * r).sum(axis=1) - 5.0 * (qd**2).sum(axis=1)
    gave = np.concatenate([[0.0], np.cumsum(0.5e-3 * (power[1:] + power[:-1]))])
    assert np.abs(V - V[0] - gave).max() <= 0.02 * (V[0] - V[-1])
    assert np.diff(V).max() <= 1e-9 * V[0]
    assert np.ptp(part.theta_hat[first:5900], axis=0).max() > 1e-3


class Broken:
    """A law that gives no number from a tick on."""

    remembers = ()

    def __init__(self, _facts: LawContext, at: int = 2000) -> None:
        self.at = at

    def torque(self, now: LawInput) -> None:
        for i in range(now.joints):
            now.tau[i] = now.gravity[i] - 12.0 * now.qd[i] if now.k < self.at else np.nan


def test_arms_with_failed_laws_are_held() -> None:
    text = TEXT.replace(
        'law = "pd_d"\nK = 60.0\nKd = 4.0\nd = 12.0', f'law = "{__name__}:Broken"'
    )
    log = trilat_net.simulate(make_guarded_scenario({}, text, duration_s=4.0))
    part = log["s"]
    assert set(part.mode[2000:]) == {"fault"}
    assert np.abs(part.q[2000:] - part.q[2000]).max() <= 0.02
    assert (
        np.abs(part.tau[-1] - gravity_of(log.scenario.arms["s"].theta, part.q[-1:])).max()
        <= 1e-3
    )
    assert verify_log(log).identical == 8000


@given(
    rate=st.floats(50.0, 5000.0),
    before=st.floats(-60.0, 60.0),
    wanted=st.floats(-80.0, 80.0),
    speed=st.floats(-10.0, 10.0),
)
def test_rate_limits_never_hold_back_braking(
    rate: float, before: float, wanted: float, speed: float
) -> None:
    """Against its motion a torque reaches B |qd| farther; along it, and in RUN, as far as the rate."""
    arrays = SiteArrays.build(make_guarded_scenario().setup("s"))
    s = arrays.site[0]
    for mode in (Mode.RUN, Mode.STOPPED, Mode.HOLD):
        s.mode = mode
        s.tau_rate = rate
        s.tau_before = before
        s.tau = wanted
        s.qd = speed
        limit_torque_rate(s)
        most = rate / 1000.0
        brake = s.damping[0] * abs(speed) if mode is not Mode.RUN else 0.0
        low = before - most - (brake if speed > 0.0 else 0.0)
        high = before + most + (brake if speed < 0.0 else 0.0)
        assert s.tau[0] == pytest.approx(np.clip(wanted, low, high), abs=1e-12)


def test_motors_can_hold_every_credible_estimate() -> None:
    """T = 200 N m, g = 9.81 m/s^2, links of 1 m: first moments to T/g, second ones to l T/g."""
    gains = load_scenario("free", {"on_stale.action": "glide"}).setup("m1").gains
    moment = 200.0 / 9.81
    assert gains.low == (0.0,) * 5
    assert gains.high == pytest.approx((2.0 * moment, moment, moment, moment, moment))
    own_estimate = {
        "control.law": "adaptive_box",
        "control.theta_low": [-1.0] * 5,
        "control.theta_high": [9.0] * 5,
    }
    assert (
        load_scenario("free", {"on_stale.action": "glide", **own_estimate})
        .setup("m1")
        .gains.high
        == (9.0,) * 5
    )
    assert np.isinf(load_scenario("free").setup("m1").gains.high).all()


HARNESS = {
    "duration_s": 4.0,
    "link": {"delay_ms": 30.0},
    **RULE,
    "limits": {"tau_limit_nm": 80.0, "tau_rate_limit_nm_s": 300.0, "qd_limit_rad_s": 10.0},
}


@pytest.mark.parametrize("at", [530, 1200])
def test_one_stop_stops_a_learning_arm(at: int) -> None:
    """Damping and a frozen estimate took it from 0.61 rad/s to 5.12, over 1.92 rad."""
    log = make_ordered_log(load_scenario("free", HARNESS), {"m1": {at: "stop"}})
    part = log["m1"]
    before, *speed = np.abs(part.qd[at - 1 :]).max(axis=1)
    assert speed[0] > 0.5
    # The limit of the torque's rate leaves the acceleration of the order for some milliseconds.
    acceleration = max((speed[0] - before) / 1e-3, 0.0)
    assert max(speed) <= speed[0] + 8e-3 * acceleration
    assert max(speed[700:]) <= AT_REST_RAD_S
    assert np.abs(part.q[at:] - part.q[at]).max() <= 0.07


class Stop(NamedTuple):
    """A stop of a site: the speed at the order, the largest speed afterwards, the time to rest, and the distance."""

    at: int
    site: str
    begin_rad_s: float
    most_rad_s: float
    rest_s: float
    travel_rad: float


def stop_at_instants(log: Log, count: int, ticks: int = 1700) -> Iterator[Stop]:
    """Stops one site in turn at instants of a run, each from the two records before; no other
    site matters.
    """
    names = log.scenario.names
    for n, at in enumerate(np.linspace(5, len(log[names[0]]) - 5, count).astype(int).tolist()):
        part = log[names[n % len(names)]]
        site = Site(log.scenario.setup(part.name))
        site.restore_state(
            *(part.states[row].to_tick_record(part.peers) for row in (at - 2, at - 1))
        )
        order = [CoreChange("stop", order=LifeOrder.STOP)]
        stops = [
            site.step(TickInput(k, commands=order if k == at else ()))
            for k in range(at, at + ticks)
        ]
        qd = np.array([record.qd for record in stops])
        q = np.array([record.q for record in stops])
        speed = np.abs(qd).max(axis=1)
        pushed = np.array([record.tau_x for record in stops])
        yielded = compute_yielding(log.scenario.setup(part.name).rest, pushed, part.rate_hz)
        moving = np.flatnonzero((np.abs(qd) > AT_REST_RAD_S + np.abs(yielded)).any(axis=1))
        rest_s = float(moving[-1] + 1) / part.rate_hz if len(moving) else 0.0
        yield Stop(at, part.name, speed[0], speed.max(), rest_s, float(np.abs(q - q[0]).max()))


def compute_yielding(gains: RestGains, tau_x: Array, rate_hz: int) -> Array:
    """Returns the speed at which joints yield to a hand whose torque changes, rad/s, rows of
    ticks.

    M s' = w + tau_x - B s, w' = -k B s, M = B T, k = 1 / 4T: to a step of tau_x it is t exp(-t
    / 2T) / M.
    """
    t = np.arange(len(tau_x))[:, None] / rate_hz
    answer = t * np.exp(-t / (2.0 * gains.time_s)) / (np.array(gains.damping) * gains.time_s)
    steps = np.diff(tau_x, axis=0, prepend=tau_x[:1])
    return np.stack(
        [np.convolve(a, b)[: len(t)] for a, b in zip(steps.T, answer.T, strict=True)], axis=-1
    )


def largest_fall(scenario: Scenario, site: str) -> tuple[float, float]:
    """Returns the largest |M^-1 G| of an arm over two hundred poses, rad/s^2, and the largest |G|, N m."""
    arm = scenario.arms[site]
    rows = build_arm_rows(scenario, site)
    q = np.random.default_rng(0).uniform(-np.pi, np.pi, (200, arm.counts.joints))
    still = np.zeros_like(q)
    G = rows.law_torque(
        np.broadcast_to(arm.theta, (200, len(arm.theta))), q, still, still, still
    )
    unit = np.eye(arm.counts.joints)
    M = np.stack(
        [rows.multiply_inertia(q, np.broadcast_to(row, q.shape)) for row in unit], axis=-1
    )
    return float(np.abs(np.linalg.solve(M, G[..., None])).max()), float(np.abs(G).max())


def gravity_gives(scenario: Scenario, site: str) -> tuple[float, float]:
    """Returns the speed that gravity may give an arm until w balances gravity, rad/s, and the
    speed in its start.

    The first is that of a free fall for the time in which B brakes. The first 0.1 s of a start
    add the time that the limit of rate takes from no torque to G.
    """
    fall, most = largest_fall(scenario, site)
    setup = scenario.setup(site)
    ramp_s = most / float(np.min(setup.limits.tau_rate))
    return fall * setup.rest.time_s, fall * (setup.rest.time_s + ramp_s)


def assert_stops(log: Log, count: int) -> None:
    """Asserts the bound of a stop: beyond gravity, an arm has only the speed that its torque at
    the order gives while B brakes.

    An arm that a hand pushes ever harder yields to that push, and to nothing else.
    """
    gives = {site: gravity_gives(log.scenario, site) for site in log.scenario.names}
    for stop in stop_at_instants(log, count):
        part = log[stop.site]
        still = log.scenario.setup(stop.site).rest
        torque = (
            np.abs(part.qd[stop.at] - part.qd[stop.at - 1]).max() * part.rate_hz * still.time_s
        )
        allowance = max(gives[stop.site][stop.at < 100], torque)
        assert stop.most_rad_s <= max(1.1 * stop.begin_rad_s + allowance, AT_REST_RAD_S), stop
        assert stop.rest_s <= REST_WITHIN_S, stop


def simulate_law(name: str, law: str, settings: dict[str, Any], duration_s: float = 6.0) -> Log:
    keys = {"duration_s": duration_s, "control.law": law, **RULE, **settings}
    return trilat_net.simulate(load_scenario(name, keys))


def test_ten_stops_end_in_rest() -> None:
    assert_stops(simulate_law("free", "adaptive", {}, 2.0), 10)


RUNS = [
    *(("two_sites", law, settings) for law, settings in TWO.items()),
    *(
        (name, law, settings)
        for law, settings in THREE.items()
        for name in ("free", "paper", "handover")
    ),
    *(("six_joints", law, {}) for law in CHAINS),
]


def test_every_law_is_stopped_in_some_run() -> None:
    assert {law for _, law, _ in RUNS} == {law for law in LAWS if law != "own"}


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "law", "settings"), RUNS, ids=lambda value: value if isinstance(value, str) else ""
)
def test_two_hundred_stops_end_in_rest(name: str, law: str, settings: dict[str, Any]) -> None:
    assert_stops(simulate_law(name, law, settings), 200)


@pytest.mark.parametrize("space", ["joints", "position"])
def test_forces_on_a_peer_move_no_resting_arm(space: str) -> None:
    """The law of the stopped arm reflects forces, but only while the arm follows its peer."""
    axes = {} if space == "joints" else {"axes": ["x", "y"]}
    push = {"kind": "pulse", "start_s": 3.0, "end_s": 5.0, "peak_nm": [6.0, 3.0]}
    laws = {
        "sites.m.control": {"law": "p_f", "K": 0.0, "k_f": 1.0},
        "sites.s.control": {"law": "p_f", "K": 12.0, "d": 4.0, "k_f": 0.0},
    }
    scenario = load_scenario(
        "two_sites",
        {
            "on_stale.action": "glide",
            "task": {"space": space, **axes},
            "duration_s": 6.0,
            "scheme": "digital",
            "sites.m.hands": [],
            "sites.m.q0_rad": [0.2, 1.4],
            "sites.s.q0_rad": [0.2, 1.4],
            "sites.s.hands": [push],
            **laws,
        },
    )
    stopped = make_ordered_log(scenario, {"m": {2000: "stop"}})["m"]
    assert set(stopped.mode[2500:]) == {"stopped"}
    assert np.abs(stopped.qd[3000:]).max() < 1e-6
