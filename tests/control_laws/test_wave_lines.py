"""Wave variables on the unit arm: numbers of independent simulations, closed forms, and
non-passive variants.
"""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.energy_runs import CONSTANT, JITTER, make_energy_pair, sample_every_tick
from tests.execution.builders import make_trajectories
from tests.unit_arm import CLAMP, make_spring_hand, make_unit_scenario
from trilat_net.errors import ScenarioError
from trilat_net.laws.wave import Wave
from trilat_net.scenario import Scenario

b = 10.0
h = 1e-3
c = math.sqrt(2.0 * b)
T = 0.2 + 0.5 * h
"""Of a line with one end that answers a tick later, by what its arm did: half of its round trip, s."""
CUT = {**CONSTANT, "outages_s": [[1.8, 2.8]]}
WAVE = {"law": "wave"}


def make_line_law(reception: str) -> dict[str, Any]:
    """Runs the class itself, as no scenario can choose `hold`."""
    none = [0.0, 0.0]
    gains = {
        "b": [b, b],
        "K": none,
        "B": none,
        "lines": {},
        "beta": 1.0,
        "gravity": 1.0,
        "reserve_J": 1e-2,
    }
    return {"law": "trilat_net.laws.wave:Wave", **gains, "reception": reception}


def make_line_scenario(
    reception: str,
    link: dict[str, Any],
    duration_s: float = 20.0,
    env: Any = (),
    push: Any = None,
) -> Scenario:
    law = make_line_law(reception)
    slave = {**law, "K": [100.0, 100.0], "B": [b, b]}
    sites = {
        "m": {"hands": [push or make_spring_hand(0.3)]},
        "s": {"hands": list(env), "control": slave},
    }
    return make_unit_scenario(sites, law, duration_s=duration_s, link=link)


def measure_stored_energy(run: dict[str, Any]) -> tuple[Any, Any]:
    """Returns the energy in the line of joint 1, tick by tick: by its waves, and by the work at
    its ports.

    Energy on hand at the master's end counts as input; its arm gave -tau times its steps.
    """
    m = run["m"]
    s = run["s"]
    u_m = m.sent[0].u[:, 0]
    u_s = s.sent[0].u[:, 0]
    force_s = s.tau[:, 0]
    v_m = (m.tau[:, 0] + b * m.qd[:, 0]) / c
    v_s = u_s + c / b * force_s
    waves = np.cumsum(0.5 * h * (u_m**2 - v_s**2 + u_s**2 - v_m**2))
    work = np.append(0.0, np.cumsum(-m.tau[:-1, 0] * np.diff(m.q[:, 0])))
    reserve = Wave.reserve_J
    taken = np.cumsum(h * force_s * (c * v_s - force_s) / b)
    return waves, work + reserve - m.to_all.H[:, 0] - taken


def test_a_free_slave_reaches_its_master() -> None:
    run = sample_every_tick(make_energy_pair(WAVE, clamped=False, duration_s=20.0), every=4)
    m = run["m"]
    s = run["s"]
    assert m.q[-1, 0] == pytest.approx(0.3, abs=5e-7)
    assert s.q[-1, 0] == pytest.approx(0.3, abs=5e-7)
    distance = np.abs(m.q - s.q)[:, 0].max()  # of qd h at 1 kHz .0476, of continuous time .0477
    assert distance == pytest.approx(0.0477, rel=4e-3)
    assert -m.tau[:, 0].min() == pytest.approx(1.763, rel=2e-3)


def test_a_line_stores_the_energy_of_its_ports() -> None:
    waves, ports = measure_stored_energy(
        sample_every_tick(make_energy_pair(WAVE, clamped=False, duration_s=5.0))
    )
    assert np.abs(waves - ports).max() < 1e-12 * waves.max()
    assert waves.min() >= 0.0
    assert waves.max() == pytest.approx(0.149, rel=5e-3)


def test_a_clamped_line_is_a_spring() -> None:
    """The spring has the stiffness b / T, in series with the follower's K and the clamp."""
    run = sample_every_tick(make_energy_pair(WAVE, clamped=True, duration_s=30.0), every=30000)
    m = run["m"]
    s = run["s"]
    felt = 1.0 / (T / b + 0.01 + 0.001)
    master = 15.0 / (50.0 + felt)
    assert m.q[-1, 0] == pytest.approx(master, abs=5e-7)
    assert s.q[-1, 0] == pytest.approx(felt * master / 1000.0, abs=5e-7)
    assert abs(m.tau_x[-1, 0]) == pytest.approx(felt * master, abs=1e-4)
    at_200_ms = (0.182353, 0.005882, 5.8824, 32.258)
    assert (master, felt * master / 1000.0, felt * master, felt) == pytest.approx(
        at_200_ms, rel=2e-3
    )


@pytest.mark.parametrize(
    ("frequency_hz", "clamp_nm_rad", "ratio"),
    [
        (0.1, 0.0, 2.538),
        (0.1, 1e6, 51.88),
        pytest.param(0.01, 0.0, 4.0004 * 2.0 * math.pi * 0.01, marks=pytest.mark.long),
    ],
)
def test_a_line_has_its_published_impedance(
    frequency_hz: float, clamp_nm_rad: float, ratio: float
) -> None:
    """|torque / velocity| at the master, N m s/rad: of a free slave the masses and b T."""
    periods = 3 if frequency_hz < 0.1 else 6
    push = {"kind": "multisine", "amplitude_nm": [0.2, 0.1], "frequencies_hz": [frequency_hz]}
    env = [{**CLAMP, "stiffness_nm_rad": clamp_nm_rad}] if clamp_nm_rad else []
    run = sample_every_tick(
        make_line_scenario("replay", CONSTANT, periods / frequency_hz, env, push), every=20
    )["m"]
    last = round(50.0 / frequency_hz)  # rows of the last period
    turn = np.exp(-2j * np.pi * np.arange(last) / last)
    felt = abs(run.tau_x[-last:, 0] @ turn) / abs(run.qd[-last:, 0] @ turn)
    assert felt == pytest.approx(ratio, rel=2e-3)


@pytest.mark.parametrize(
    ("reception", "end"), [("hold", 0.4214), ("zero", 0.1496), ("replay", 0.3)]
)
def test_outages_leave_offsets_only_with_held_waves(reception: str, end: float) -> None:
    slave = sample_every_tick(make_line_scenario(reception, CUT), every=20000)["s"]
    assert slave.q[-1, 0] == pytest.approx(end, rel=2e-3)


def make_varying_link(period_s: float = 2.0) -> dict[str, Any]:
    """Returns T(t) = 0.2 + 0.15 sin(pi t) at the time t of receipt, as a trace by stamps."""
    t = np.arange(0.0, 12.0, 1e-3)
    sent = t - 0.2 - 0.15 * np.sin(2.0 * np.pi * t / period_s)
    stamps = np.arange(0.0, 10.0, 1e-3)
    delays = np.interp(stamps, sent, t) - stamps
    points = ", ".join(f"{n * 1000} {round(1e6 * delay)}" for n, delay in enumerate(delays))
    return {"model": "trace", "trace": points}


@pytest.mark.parametrize(
    ("reception", "least"), [("hold", -0.3345), ("scaled", 0.0), ("replay", 0.0)]
)
def test_varying_delay_makes_energy_from_held_waves(reception: str, least: float) -> None:
    push = {**make_spring_hand(0.3, damping=0.0), "move_end_s": 1.5}
    env = [{**CLAMP, "stiffness_nm_rad": 200.0}]
    waves, _ = measure_stored_energy(
        sample_every_tick(make_line_scenario(reception, make_varying_link(), 4.0, env, push))
    )
    assert waves.min() == pytest.approx(least, rel=4e-3, abs=1e-12)


LOSSY = [
    pytest.param(
        {"model": "constant", "delay_ms": 100.0, "loss": 0.5}, 20.0, marks=pytest.mark.long
    ),
    ({"model": "constant", "delay_ms": 68.0, "loss": 0.02}, 20.0),
    pytest.param({"preset": "4g"}, 240.0, marks=pytest.mark.long),
]


def held_torque(link: dict[str, Any], push: dict[str, Any], duration_s: float) -> Any:
    """Returns the master's torque, a row a tick, in contact with 700 N m/rad and 3 N m s/rad."""
    clamp = {**CLAMP, "stiffness_nm_rad": 700.0, "damping_nm_s_rad": 3.0}
    return sample_every_tick(make_line_scenario("replay", link, duration_s, [clamp], push))[
        "m"
    ].tau[:, 0]


@pytest.mark.parametrize(("link", "duration_s"), LOSSY)
def test_constant_force_plays_at_ticks_without_wave(
    link: dict[str, Any], duration_s: float
) -> None:
    push = {"kind": "recorded", "points": [[0.0, 2.2, 1.1], [1e4, 2.2, 1.1]]}
    tau = held_torque(link, push, min(duration_s, 60.0))[10000:]
    assert np.abs(tau) == pytest.approx(2.2, abs=0.01)
    assert np.abs(np.diff(tau)).max() < 0.01


@pytest.mark.parametrize(("link", "duration_s"), LOSSY)
def test_contact_under_loss_keeps_its_force(link: dict[str, Any], duration_s: float) -> None:
    tau = np.abs(held_torque(link, make_spring_hand(0.0682, 40.0, 6.0), duration_s))
    assert tau[-1000:].mean() == pytest.approx(tau[9000:10000].mean(), rel=1e-3)
    assert np.abs(np.diff(tau[10000:])).max() < 0.03


@pytest.mark.parametrize(
    ("link", "reserve_J"),
    [
        (JITTER, 0.01),
        *(
            pytest.param(*case, marks=pytest.mark.long)
            for case in ((JITTER, 0.0), (CONSTANT, 0.01))
        ),
    ],
)
def test_a_push_grows_by_the_reserves_alone(link: dict[str, Any], reserve_J: float) -> None:
    """Under varying delays without damping, the energy grows by the reserves of two ends and two joints only."""
    control = {"law": "wave", "K": 0.0, "B": 0.0, "reserve_J": reserve_J}
    sites = {"m": {"qd0_rad_s": [1e-6, 5e-7]}, "s": {}}
    run = sample_every_tick(make_unit_scenario(sites, control, duration_s=20.0, link=link))
    M = np.array([[5.0 / 6.0, 1.0 / 3.0], [1.0 / 3.0, 1.0 / 3.0]])
    kinetic_J = sum(
        0.5 * np.einsum("ki,ij,kj->k", site.qd, M, site.qd) for site in run.values()
    )
    grows = link is JITTER and reserve_J > 0.0
    assert kinetic_J.max() <= kinetic_J[0] + (8.0 * reserve_J if grows else 0.0)
    assert (kinetic_J[-1] > 1e6 * kinetic_J[0]) == grows


def test_play_out_makes_jitter_a_constant_delay() -> None:
    jitter = {**JITTER, "loss": 0.0, "playout_ms": 400.0}
    a, other = (
        sample_every_tick(
            make_energy_pair(WAVE, clamped=False, duration_s=5.0, link=link), every=5000
        )
        for link in (jitter, {**CONSTANT, "delay_ms": 400.0})
    )
    assert np.array_equal(a["s"].q, other["s"].q)


MESH = {"m1-m2": 2.0, "m1-s": 18.0, "m2-s": 4.0}
SHARES = {"m1": {"m2": 0.1, "s": 0.9}, "m2": {"m1": 0.4, "s": 0.6}, "s": {"m1": 0.8, "m2": 0.2}}


@pytest.mark.long
def test_three_sites_are_springs_b_over_t() -> None:
    law = {"law": "wave", "lines": MESH}
    sites = {
        "m1": {"hands": [make_spring_hand(0.3)]},
        "m2": {"hands": [make_spring_hand(-0.3)]},
        "s": {},
    }
    scenario = make_unit_scenario(sites, law, duration_s=40.0, dominance=SHARES)
    run = sample_every_tick(scenario, every=40000)
    lines = np.array([[20.0, -2.0, -18.0], [-2.0, 6.0, -4.0], [-18.0, -4.0, 22.0]])
    rest = np.linalg.solve(lines / (0.2 + h) + np.diag([50.0, 50.0, 0.0]), [15.0, -15.0, 0.0])
    for name, q, known in zip(run, rest, (0.14602, -0.14602, 0.09292), strict=True):
        assert q == pytest.approx(known, rel=3e-3)
        assert run[name].q[-1, 0] == pytest.approx(q, abs=1e-5)
    assert "m2 0.1, s 0.9" in scenario.describe_law_conditions()[0]


@pytest.mark.long
def test_weights_share_the_felt_torques() -> None:
    """Torques of lines add to zero; beta divides the torque of each site.

    Nothing but the hand damps: with waves of qd h this loop diverges from 60 s on.
    """
    sites = {
        "m1": {"hands": [make_spring_hand(0.0)], "control": {"law": "wave", "beta": 1.0}},
        "m2": {"control": {"law": "wave", "beta": 0.5}},
        "s": {
            "hands": [{"kind": "recorded", "points": [[0.0, 5.0, 2.5], [1e4, 5.0, 2.5]]}],
            "control": {"law": "wave", "beta": 1.5},
        },
    }
    law = {"law": "wave", "lines": MESH}
    run = sample_every_tick(
        make_unit_scenario(sites, law, duration_s=400.0, dominance=SHARES), every=1000
    )
    for t_s in (60, 400):
        assert abs(run["m1"].tau_x[t_s - 1, 0]) == pytest.approx(7.5, rel=3e-3)
    assert min(float(site.to_all.H.min()) for site in run.values()) >= -1e-9


def test_own_law_gives_the_same_last_digits(monkeypatch: pytest.MonkeyPatch) -> None:
    """examples/wave_law.py."""
    monkeypatch.chdir(Path(__file__).parents[2] / "examples")
    ours, theirs = (
        make_trajectories(
            make_energy_pair(
                {"law": law}, clamped=False, duration_s=1.3, link={**CONSTANT, "delay_ms": 50.0}
            )
        )
        for law in ("wave", "wave_law:Wave")
    )
    assert np.abs(ours.stack("q")).max() > 1e-3
    for field in ("q", "qd", "tau"):
        assert np.abs(ours.stack(field) - theirs.stack(field)).max() < 1e-12


def test_line_ends_share_one_rate() -> None:
    with pytest.raises(ScenarioError, match="all sites"):
        make_unit_scenario({"m": {"control": WAVE}, "s": {"control": {"law": "p_d"}}}, WAVE)
    with pytest.raises(ScenarioError, match="the same at all sites"):
        make_unit_scenario({"m": {}, "s": {"rate_hz": 500}}, WAVE)
    with pytest.raises(ScenarioError, match="m-x"):
        make_unit_scenario({"m": {}, "s": {}}, {**WAVE, "lines": {"m-x": 1.0}})
