"""Stops and faults of fast arms, drawn by a seed, against the bounds of docs/theory/coming-to-rest.md.

    python -m tests.core.hard_stops --stops 3000 --faults 500

A stop resumes one site from two records and runs it on its own: peers do not matter to an arm that comes to
rest. Half of the stops begin in a state of a run, half in any pose, with any speed up to the limit and any
last torque. A fault begins with a joint that is faster than its limit.
"""

import argparse
import sys
from collections.abc import Iterator
from functools import cache, lru_cache
from typing import Any, NamedTuple

import numpy as np

import trilat_net
from trilat_net.analysis.arm_rows import build_arm_rows
from trilat_net.core.step.site_setup import Law
from trilat_net.core.step.site_step import Site
from trilat_net.core.step.ticks import CoreChange, LifeOrder, TickInput, TickRecord
from trilat_net.log.log_reader import Log
from trilat_net.scenario import Scenario, load_scenario
from trilat_net.scenario.rest_bounds import AT_REST_RAD_S, find_rest_bounds

RULE = {
    "on_stale.action": "glide",
    "on_stale.align_limit_rad": 4.0,
    "on_stale.align_speed_rad_s": 2.0,
}
TWO: dict[str, dict[str, Any]] = {
    "p_f": {},
    "four_channel": {"control.acceleration": 0.5},
    "smith": {"sites.m.control.predicts": True},
    **{name: {"scheme": "digital"} for name in ("wave", "tdpa", "tanks")},
}
"""Laws of two sites, and settings."""
THREE: dict[str, dict[str, Any]] = {
    "six_channel": {"control.acceleration": 0.5, "control.force_own": 0.1},
    "authority": {"sites.s.control.leads": False},
    "impedance": {"sites.s.control.follows": True},
    "adaptive_kinematics": {"arm.g_m_s2": 0.0},
    **{
        name: {}
        for name in (
            "adaptive",
            "adaptive_box",
            "adaptive_robust",
            "p_d",
            "pd_d",
            "saturated_pd",
        )
    },
    **{name: {} for name in ("lee_spong", "sync")},
}
CHAINS = ("adaptive", "adaptive_box", "adaptive_robust", "p_d", "pd_d")
SWINGS: dict[str, Any] = {"control.K": 600.0, "control.d": 1.0, "link": {"delay_ms": 50.0}}
"""A law that swings up over its delay."""
CASES: list[tuple[str, str, dict[str, Any]]] = [
    *(("two_sites", law, settings) for law, settings in TWO.items()),
    *((name, law, settings) for law, settings in THREE.items() for name in ("free", "paper")),
    *((name, "pd_d", SWINGS) for name in ("free", "paper_rods", "asymmetric")),
    *((name, "p_d", SWINGS) for name in ("jitter", "free")),
    *(("six_joints", law, {}) for law in CHAINS),
    ("seven_joints", "pd_d", {}),
    ("wall_in_space", "", {}),
    ("unlike_arms", "", {}),
    ("play", "", {}),
]
"""Scenarios with a law and settings; an empty law stands for the scenario's law."""
RATES_NM_S = (100.0, 300.0, 1000.0)
MOST_ENERGY = 1.05
MOST_SPEED = 1.1
LEAST_ENERGY_J = 0.0125
"""The kinetic energy of the arms of `free` at joint speeds of 0.05 rad/s."""
FIRST_S = 0.5
LONGEST_S = 8.0
_DURATION_S = 1.2


class Stop(NamedTuple):
    """What came of a stop, or of a fault.

    Attributes:
        case: scenario, law, rate of the torque and site.
        begin_rad_s: the largest speed of a joint at its beginning.
        energy: the largest kinetic energy, less the work of gravity that the law does not know, of hands and
            of last torques, over that at the beginning (and what an arm at rest may have).
        speed: the largest speed of a joint, less the rise during the blend, over that at the beginning (and
            the speed at which an arm is at rest).
        rest_s: when the arm was at rest.
        stated_s: the time that `scenario check` states.
        gained_j: how much the kinetic energy rose.
        risen: the largest speed over that at the beginning.
    """

    case: str
    begin_rad_s: float
    energy: float
    speed: float
    rest_s: float
    stated_s: float
    gained_j: float
    risen: float

    @property
    def holds(self) -> bool:
        return (
            self.energy <= MOST_ENERGY
            and self.speed <= MOST_SPEED
            and self.rest_s <= self.stated_s
        )


@cache
def make_fast_scenario(number: int, rate_nm_s: float) -> Scenario:
    name, law, settings = CASES[number]
    keys = {
        "duration_s": _DURATION_S,
        **RULE,
        "limits.tau_rate_limit_nm_s": rate_nm_s,
        **settings,
    }
    if law:
        keys["control.law"] = law
    return load_scenario(name, keys)


@lru_cache(maxsize=len(CASES))
def simulate_fast_arms(number: int) -> Log:
    """Returns a run of a case, from which stops of any rate of the torque begin."""
    return trilat_net.simulate(make_fast_scenario(number, RATES_NM_S[1]))


@cache
def state_bound(number: int, rate_nm_s: float, site: str) -> float:
    return find_rest_bounds(make_fast_scenario(number, rate_nm_s), site).rest_s


def draw_records(
    log: Log, site: str, rng: np.random.Generator, *, synthetic: bool, too_fast: bool
) -> tuple[TickRecord, TickRecord]:
    """Draws two successive records of a site that follows its peers; a stop starts from these."""
    part = log[site]
    scenario = log.scenario
    follows = np.isin(part.mode, ("return", "run"))
    rows = np.flatnonzero(follows[1:] & follows[:-1]) + 1
    at = int(rng.choice(rows))
    before, last = (part.states[row].to_tick_record(part.peers) for row in (at - 1, at))
    if not synthetic:
        return before, last
    spec = scenario.sites[site]
    setup = scenario.setup(site)
    joints = len(spec.q0_rad)
    q = rng.uniform(-np.pi, np.pi, joints)
    if spec.arm.urdf:
        q = np.array(spec.q0_rad) + rng.uniform(-0.5, 0.5, joints)
    most = np.broadcast_to(setup.qd_limit_rad_s, joints)
    qd = rng.uniform(-1.0, 1.0, joints) * most * rng.uniform(0.05, 1.0)
    if too_fast:
        fastest = rng.integers(joints)
        qd[fastest] = np.copysign(most[fastest] * rng.uniform(1.0001, 1.02), qd[fastest])
    tau = np.clip(rng.uniform(-1.5, 1.5, joints), -1.0, 1.0) * setup.tau_limit_nm
    return (
        before._replace(tau=tau.tolist()),
        last._replace(q=q.tolist(), qd=qd.tolist(), tau=tau.tolist()),
    )


def run_stop(
    scenario: Scenario, site: str, before: TickRecord, last: TickRecord
) -> list[TickRecord]:
    """Returns the records of a stop until the arm has been at rest for 0.3 s."""
    moving = Site(scenario.setup(site))
    moving.restore_state(before, last)
    rate_hz = scenario.sites[site].rate_hz
    first = last.tick + 1
    order = [CoreChange("stop", order=LifeOrder.STOP)]
    records: list[TickRecord] = []
    slow = 0
    for tick in range(first, first + round(LONGEST_S * rate_hz)):
        records.append(moving.step(TickInput(tick, commands=order if tick == first else ())))
        slow = slow + 1 if max(map(abs, records[-1].qd)) <= AT_REST_RAD_S else 0
        if slow > 0.3 * rate_hz and len(records) > FIRST_S * rate_hz:
            break
    return records


def measure_stop(
    scenario: Scenario,
    site: str,
    stated_s: float,
    case: str,
    last: TickRecord,
    records: list[TickRecord],
) -> Stop:
    """Returns the measured stop, from its records and the record before them."""
    setup = scenario.setup(site)
    rows = build_arm_rows(scenario, site)
    arm = scenario.arms[site]
    h_s = 1.0 / setup.rate_hz
    q = np.array([record.q for record in records])
    qd = np.array([record.qd for record in records])
    still = np.zeros_like(q)
    theta = np.broadcast_to(arm.theta, (len(q), len(arm.theta)))
    learns = setup.gains.law is Law.ADAPTIVE
    known = np.array([record.theta_hat for record in records]) if learns else theta
    G = rows.law_torque(theta, q, still, still, still)
    unknown = (
        rows.law_torque(known, q, still, still, still) - G if learns else still
    ) - np.array([record.tau_x for record in records])
    kinetic_j = 0.5 * (qd * rows.multiply_inertia(q, qd)).sum(axis=1)
    power = (unknown * qd).sum(axis=1)
    work_j = np.concatenate([[0.0], np.cumsum(0.5 * h_s * (power[1:] + power[:-1]))])
    damping = np.array(setup.rest.damping)
    last_nm = np.abs(np.array(last.tau) - G[0] - np.where(learns, unknown[0], 0.0))
    blend_j = float((last_nm**2 / damping).sum()) * h_s / 2.0
    speed = np.abs(qd).max(axis=1)
    blend = round(0.15 * setup.rate_hz)
    acceleration = np.diff(qd[: blend + 1], axis=0) * setup.rate_hz
    unbalanced_nm = np.abs(rows.multiply_inertia(q[:blend], acceleration)).max(axis=0)
    rise = float((unbalanced_nm / damping).max())
    moving = np.flatnonzero(speed > AT_REST_RAD_S)
    return Stop(
        case=case,
        begin_rad_s=float(speed[0]),
        energy=float(((kinetic_j - work_j - blend_j) / (kinetic_j[0] + LEAST_ENERGY_J)).max()),
        speed=float((speed.max() - rise) / max(speed[0], AT_REST_RAD_S)),
        rest_s=float(moving[-1] + 1) * h_s if len(moving) else 0.0,
        stated_s=stated_s,
        gained_j=float(kinetic_j.max() - kinetic_j[0]),
        risen=float(speed.max() / max(speed[0], AT_REST_RAD_S)),
    )


def draw_stops(seed: int, count: int, *, faults: bool = False) -> Iterator[Stop]:
    """Yields stops, or faults, of all cases in turn."""
    for n in range(count):
        rng = np.random.default_rng((seed, n, int(faults)))
        number = n % len(CASES)
        rate_nm_s = float(rng.choice(RATES_NM_S))
        scenario = make_fast_scenario(number, rate_nm_s)
        log = simulate_fast_arms(number)
        site = str(rng.choice(scenario.names))
        synthetic = faults or bool(rng.random() < 0.5)
        before, last = draw_records(log, site, rng, synthetic=synthetic, too_fast=faults)
        records = run_stop(scenario, site, before, last)
        name, law, _ = CASES[number]
        case = f"{name} {law} {rate_nm_s:g} N m/s {site} {'drawn' if synthetic else 'run'} {n}"
        stated_s = state_bound(number, rate_nm_s, site)
        yield measure_stop(scenario, site, stated_s, case, last, records)


def print_worst_stops(title: str, stops: list[Stop]) -> None:
    print(f"{title}: {len(stops)}, {sum(not stop.holds for stop in stops)} beyond a bound")
    for key in ("energy", "speed", "gained_j", "risen", "rest_s"):
        worst = max(stops, key=lambda stop: float(getattr(stop, key)))
        print(f"  largest {key} {getattr(worst, key):.4g}: {worst}")
    share = max(stops, key=lambda stop: stop.rest_s / stop.stated_s)
    print(f"  largest share of the stated time {share.rest_s / share.stated_s:.3g}: {share}")
    for stop in [stop for stop in stops if not stop.holds][:20]:
        print(f"  beyond: {stop}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--stops", type=int, default=3000)
    parser.add_argument("--faults", type=int, default=500)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    for title, count in (("stops", arguments.stops), ("faults", arguments.faults)):
        judged: list[Stop] = []
        for stop in draw_stops(arguments.seed, count, faults=title == "faults"):
            judged.append(stop)
            if len(judged) % 100 == 0:
                print(f"{title}: {len(judged)} of {count}", file=sys.stderr, flush=True)
        print_worst_stops(title, judged)
