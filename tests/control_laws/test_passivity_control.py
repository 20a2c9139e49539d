"""Time-domain passivity control on the unit arm: numbers of independent simulations, and its purpose."""

from typing import Any

import numpy as np
import pytest

from tests.energy_runs import (
    CONSTANT,
    FOLLOWER,
    JITTER,
    find_least_energy,
    sample_contact_run,
    sample_every_tick,
)
from tests.energy_runs import make_energy_pair as pair_of
from tests.unit_arm import CLAMP, H50, make_spring_hand, make_unit_scenario
from trilat_net.errors import ScenarioError

PUBLISHED = {
    "energy": "velocity",
    "reserve_J": 0.0,
    "drift_rad_s": 0.0,
    "acceleration_rad_s2": 0.0,
}
"""Energy as it is published: torque times velocity times period."""


def sample_pair(
    delay_ms: float, *, clamped: bool, duration_s: float = 30.0, every: int = 10, **more: Any
) -> Any:
    control = {"law": "tdpa", **PUBLISHED, **more}
    link = {**CONSTANT, "delay_ms": delay_ms}
    return sample_every_tick(
        pair_of(control, clamped=clamped, duration_s=duration_s, link=link), every
    )


def sample_uncontrolled_pair(
    delay_ms: float, *, clamped: bool, duration_s: float = 30.0
) -> Any:
    """Returns a run without controllers, which no scenario can choose; hands are sampled."""
    law = {
        "law": "trilat_net.laws.tdpa:Tdpa",
        **PUBLISHED,
        "gravity": 1.0,
        "controlled": False,
        "K": [0.0, 0.0],
        "B": [0.0, 0.0],
    }
    env = [{**CLAMP, "sampled": True}] if clamped else []
    sites = {
        "m": {"hands": [{**H50, "sampled": True}]},
        "s": {"hands": env, "control": {**law, "K": [100.0, 100.0], "B": [10.0, 10.0]}},
    }
    return sample_every_tick(
        make_unit_scenario(
            sites, law, duration_s=duration_s, link={**CONSTANT, "delay_ms": delay_ms}
        ),
        10,
    )


def find_felt_stiffness(result: Any) -> float:
    return float(abs(result["m"].tau_x[-1, 0] / result["m"].q[-1, 0]))


@pytest.mark.long
def test_without_controllers_the_channel_is_active() -> None:
    free = sample_uncontrolled_pair(50.0, clamped=False)
    assert free["s"].q[-1, 0] == pytest.approx(0.3, abs=5e-5)
    assert find_least_energy(free) == pytest.approx(-3.3e-3, abs=5e-5)
    assert find_felt_stiffness(sample_uncontrolled_pair(50.0, clamped=True)) == pytest.approx(
        90.91, abs=5e-3
    )
    fast = sample_uncontrolled_pair(200.0, clamped=False)["m"].qd[:, 0]
    assert np.abs(fast).max() > 50.0


def test_without_controllers_contact_at_200_ms_diverges() -> None:
    speed = np.abs(sample_uncontrolled_pair(200.0, clamped=True, duration_s=11.8)["m"].qd[:, 0])
    assert 0.01 * (1 + np.argmax(speed > 999.0)) == pytest.approx(11.69, abs=0.02)


@pytest.mark.parametrize(
    ("delay_ms", "drift_rad_s", "slave"),
    [(50.0, 0.0, 0.2864), (200.0, 0.0, 0.2143), (200.0, 0.5, 0.3)],
)
def test_free_motion_drifts_unless_drift_is_paid_for(
    delay_ms: float, drift_rad_s: float, slave: float
) -> None:
    result = sample_pair(delay_ms, clamped=False, drift_rad_s=drift_rad_s)
    assert result["m"].q[-1, 0] == pytest.approx(0.3, abs=5e-5)
    assert result["s"].q[-1, 0] == pytest.approx(slave, abs=5e-5)
    assert find_least_energy(result) >= -1e-15


def test_contact_stays_bounded() -> None:
    near = sample_pair(50.0, clamped=True)
    far = sample_pair(200.0, clamped=True)
    assert find_felt_stiffness(near) == pytest.approx(68.88, rel=1e-3)
    # it chatters: the last digits are the integrator's
    assert find_felt_stiffness(far) == pytest.approx(26.7, rel=0.04)
    assert np.abs(far["m"].qd[-100:, 0]).max() < 0.03
    assert find_least_energy(near) >= -1e-15
    assert find_least_energy(far) >= -1e-15


def mean_felt(result: Any) -> float:
    """Returns the mean over the last half of a run, N m/rad, because the published law chatters."""
    half = len(result["m"].q) // 2
    return float(abs(result["m"].tau_x[half:, 0]).mean() / result["m"].q[half:, 0].mean())


@pytest.mark.long
def test_books_of_steps_keep_their_stiffness() -> None:
    """34.9 N m/rad as published, 71.8 by spring and clamp alone; the acceleration margin costs
    two thirds.
    """
    assert mean_felt(sample_contact_run(120.0, **PUBLISHED)) == pytest.approx(34.9, rel=1e-2)
    by_step = sample_contact_run(120.0)
    assert mean_felt(by_step) == pytest.approx(43.9, rel=1e-2)
    assert find_least_energy(by_step) >= 0.0
    assert mean_felt(sample_contact_run(120.0, acceleration_rad_s2=100.0)) < 0.4 * 34.9


@pytest.mark.parametrize(
    ("loss", "published"), [(0.0, 0.032), pytest.param(0.5, 0.040, marks=pytest.mark.long)]
)
def test_contact_chatters_less_by_books_of_steps(loss: float, published: float) -> None:
    """Mean step of the master's torque; N m."""
    chatter = {}
    for name, more in (("published", PUBLISHED), ("step", {})):
        tau = sample_contact_run(136.0, loss=loss, **more)["m"].tau[10000:, 0]
        chatter[name] = float(np.abs(np.diff(tau)).mean())
    assert chatter["published"] == pytest.approx(published, rel=0.1)
    assert chatter["step"] < 0.0015


TURNED = {
    "m1": {"m2": 0.5, "s": 0.5},
    "m2": {"m1": 0.5, "s": 0.5},
    "s": {"m1": 0.9, "m2": 0.1},
}


@pytest.mark.long
def test_later_motion_pays_for_dominance_changes() -> None:
    """The weighted pose jumps, the goal does not; while masters rest, nothing pays for the
    remaining distance.
    """
    sites = {
        "m1": {"hands": [make_spring_hand(0.3, 100.0, 15.0)]},
        "m2": {"hands": [make_spring_hand(-0.3, 100.0, 15.0)]},
        "s": {},
    }
    for ramp_s in (0.0, 0.5):
        change = {"at_s": 6.0, "dominance": "s", "to": {"m1": 0.1, "m2": 0.9}, "ramp_s": ramp_s}
        scenario = make_unit_scenario(
            sites,
            {"law": "tdpa"},
            duration_s=9.0,
            dominance=TURNED,
            link={**CONSTANT, "delay_ms": 100.0},
            timeline=[change],
        )
        run = sample_every_tick(scenario)
        m1, m2 = (run[name].q[5900, 0] for name in ("m1", "m2"))
        assert 100.0 * 0.8 * (m1 - m2) == pytest.approx(15.7, abs=0.2)
        assert np.abs(np.diff(run["s"].tau[5900:6600, 0])).max() < 1.5
        assert find_least_energy(run) >= 0.0
        assert run["s"].q[-1, 0] > 0.1 * m1 + 0.9 * m2 + 0.05


def test_every_site_follows_by_default() -> None:
    """An arm that nobody holds comes to rest with the others; with a leader alone it would coast."""
    sites = {
        "m": {
            "hands": [{"kind": "pulse", "start_s": 0.1, "end_s": 0.4, "peak_nm": [2.0, 1.0]}]
        },
        "s": {},
    }
    for follows in (True, False):
        control = {} if follows else {"control": {"law": "tdpa", "K": 0.0, "B": 0.0}}
        both = {**sites, "m": {**sites["m"], **control}}
        run = sample_every_tick(
            make_unit_scenario(
                both, {"law": "tdpa"}, duration_s=10.0, link={**CONSTANT, "delay_ms": 50.0}
            )
        )
        assert find_least_energy(run) >= 0.0
        speeds = np.abs(run["m"].qd[-1000:, 0])
        assert speeds.max() < 1e-6 if follows else speeds.min() > 0.05


@pytest.mark.parametrize("clamped", [False, True])
def test_booked_energy_is_the_arms(clamped: bool) -> None:
    """The leader's account, recomputed from torque and step; books of velocity are off by tau
    qdd h^2 / 2.
    """
    known = {"energy": "step", "reserve_J": 1e-3}
    result = sample_pair(50.0, clamped=clamped, duration_s=6.0, every=1, **known)
    m = result["m"]
    s = result["s"]
    step = -m.tau[:-1, 0] * np.diff(m.q[:, 0])
    assert m.sent[0].E_led[-1, 0] == pytest.approx(np.maximum(step, 0.0).sum(), rel=1e-9)
    out = np.cumsum(np.minimum(step, 0.0))
    earlier_energy = s.sent[0].E_followed[1:-50, 0]  # 50 ms ago
    assert np.abs(m.sent[0].W_led[51:, 0] - (1e-3 + earlier_energy + out[50:])).max() < 1e-12
    assert find_least_energy(result) >= -1e-15


@pytest.mark.long
def test_a_mesh_observes_no_energy_of_its_own() -> None:
    shares = {
        "m1": {"m2": 0.1, "s": 0.9},
        "m2": {"m1": 0.4, "s": 0.6},
        "s": {"m1": 0.8, "m2": 0.2},
    }
    sites = {
        "m1": {"hands": [make_spring_hand(0.3)]},
        "m2": {"hands": [make_spring_hand(-0.3)]},
        "s": {},
    }
    law = {"law": "tdpa", **FOLLOWER}
    for link in ({"preset": "4g"}, JITTER):
        scenario = make_unit_scenario(sites, law, duration_s=10.0, dominance=shares, link=link)
        assert find_least_energy(sample_every_tick(scenario, every=7)) >= -1e-12


def test_held_torque_books_need_the_digital_scheme() -> None:
    with pytest.raises(ScenarioError, match="choose 'digital'"):
        pair_of({"law": "tdpa"}, clamped=False, duration_s=1.0, scheme="second_order")
