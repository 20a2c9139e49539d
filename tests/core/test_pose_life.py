"""The rule `glide` of a pose, against SciPy's rotations, and joints that a task leaves free in a hold."""

import functools

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

import trilat_net
from tests.core.builders import POSE, make_task_arrays
from tests.core.guarded_runs import find_largest_step, make_ordered_log
from tests.scenario.builders import posed_task_text
from trilat_net.analysis.certificate.energy_balance import EnergyBalance, SiteEnergy
from trilat_net.core.life.resting import rests
from trilat_net.core.life.session_life import update_session_life
from trilat_net.core.step.site_setup import StaleAction
from trilat_net.core.step.ticks import Mode, tick_ns
from trilat_net.core.step.vectors import Array, Row
from trilat_net.execution.verification import verify_log
from trilat_net.log.log_reader import Log
from trilat_net.scenario import parse_scenario

SPEED = 0.8
OWN = Rotation.from_rotvec([0.4, -0.9, 0.3])
PEERS = Rotation.from_rotvec([-0.2, 0.5, 1.4])


def drive_life(
    spin: tuple[float, float, float], heard: list[tuple[int, int]], ticks: int
) -> dict[str, Array]:
    """Returns the reference of a site whose peers turn with this angular velocity, and are
    heard in some ticks.

    In other ticks their reference stays constant, as a sample in use does. The arm stands at
    its reference, and comes to rest within 0.1 s.
    """
    arrays = make_task_arrays(POSE)
    s: Row = arrays.site[0]
    link: Row = arrays.links[0]
    s.on_stale = StaleAction.GLIDE
    s.stale_ns = 20_000_000
    s.align_speed = SPEED
    s.align_limit = 3.0
    s.x[3:] = OWN.as_rotvec()
    rows = []
    last = 0
    for k in range(ticks):
        t_ns = tick_ns(k, 1000)
        if any(first <= k < end for first, end in heard):
            link.used = k
            link.used_ns = t_ns
            last = k
        s.q_followed = np.array(s.q_des)
        s.qd_followed = np.array(s.qd_des)
        last_pose = Rotation.from_rotvec(np.array(spin) * last * 1e-3) * PEERS
        s.q_des[:3] = 0.05
        s.qd_des[:3] = 0.0
        s.q_des[3:] = last_pose.as_rotvec()
        s.qd_des[3:] = spin
        update_session_life(t_ns, s, arrays.links)
        if rests(s):
            rate = np.array(s.xd[3:]) * max(
                0.0, 1.0 - 1.0 / max(1.0, 100.0 - (t_ns - s.return_from_ns) / 1e6)
            )
            moved = Rotation.from_rotvec(0.5e-3 * (rate + s.xd[3:])) * Rotation.from_rotvec(
                np.array(s.x[3:])
            )
            s.x[3:] = moved.as_rotvec()
            s.xd[3:] = rate
        else:
            s.x[3:] = s.q_des[3:]
            s.xd[3:] = s.qd_des[3:]
        rows.append((s.mode, *s.q_des[3:], *s.qd_des[3:], *last_pose.as_rotvec()))
    table = np.array(rows)
    return {
        "mode": table[:, 0],
        "turn": table[:, 1:4],
        "rate": table[:, 4:7],
        "peers": table[:, 7:],
    }


def measure_steps(turns: Array) -> Array:
    """Returns the turn from each orientation to the next."""
    rotations = Rotation.from_rotvec(turns.copy())
    return np.asarray((rotations[1:] * rotations[:-1].inv()).as_rotvec())


@pytest.mark.long
def test_arms_take_the_shortest_allowed_turn() -> None:
    run = drive_life((0.0, 0.0, 0.0), [(50, 5000)], 4000)
    aligning = np.flatnonzero(run["mode"] == Mode.RETURN)
    way = (OWN * PEERS.inv()).magnitude()
    takes = 1.5 * way / SPEED * 1e3
    assert len(aligning) == int(np.ceil(takes))
    x = (aligning - aligning[0]) / takes
    wanted = Slerp([0.0, 1.0], Rotation.concatenate([OWN, PEERS]))(x * x * (3.0 - 2.0 * x))
    rotations = Rotation.from_rotvec(run["turn"][aligning])
    assert (rotations * wanted.inv()).magnitude().max() <= 1e-12
    assert np.linalg.norm(run["rate"], axis=1).max() == pytest.approx(SPEED, rel=1e-6)


@pytest.mark.long
def test_silent_peers_never_make_orientations_jump() -> None:
    """Waits, aligns, follows, holds, and returns over a long way: to the third order of the tick."""
    spin = (0.7, -1.1, 0.6)
    run = drive_life(spin, [(50, 3500), (4600, 9000), (9100, 12000)], 12000)
    modes = run["mode"].astype(int)
    edges = [modes[0], *modes[1:][np.diff(modes) != 0]]
    cycle = [Mode.RETURN, Mode.RUN, Mode.HOLD]
    assert edges == [Mode.WAITING, *cycle, *cycle, *cycle[:2]]
    frozen = np.zeros(len(modes) - 1, dtype=bool)
    for end in (3500, 9000):  # samples in use stay for 20 ms, and so do their velocities
        frozen[end - 1 : end + 20] = True
    off = measure_steps(run["turn"]) - 0.5e-3 * (run["rate"][1:] + run["rate"][:-1])
    assert np.abs(off)[~frozen].max() <= 3e-7
    jumps = np.linalg.norm(np.diff(run["rate"], axis=0), axis=1)
    assert jumps.max() <= np.linalg.norm(spin) / 20.0 + 1e-9
    holding = modes == Mode.HOLD
    assert np.abs(run["rate"][3630:4600]).max() == 0.0
    assert np.ptp(run["turn"][3630:4600], axis=0).max() <= 1e-12
    assert holding[3521:4600].all()
    following = modes == Mode.RUN
    distances = (
        Rotation.from_rotvec(run["turn"][following])
        * Rotation.from_rotvec(run["peers"][following]).inv()
    )
    assert distances.magnitude().max() <= 1e-12


@pytest.mark.long
def test_limits_on_turns_are_never_bypassed() -> None:
    """1.8 rad about an axis askew, of which no coordinate is above 1.1 rad."""
    arrays = make_task_arrays(POSE)
    s: Row = arrays.site[0]
    link: Row = arrays.links[0]
    s.on_stale = StaleAction.GLIDE
    s.stale_ns = 20_000_000
    s.align_speed = SPEED
    s.align_limit = 1.1
    link.used = 0
    link.used_ns = 0
    s.q_des[3:] = 1.8 / np.sqrt(3.0)
    update_session_life(0, s, arrays.links)
    assert s.mode == Mode.WAITING
    s.q_des[3:] = 1.0 / np.sqrt(3.0)
    update_session_life(tick_ns(1, 1000), s, arrays.links)
    assert s.mode == Mode.RETURN


GLIDES = """[on_stale]
action = "glide"
align_speed_rad_s = 1.0
align_limit_rad = 2.5
[link]
outages_s = [[2.0, 4.0]]"""


@functools.cache
def make_pose_log() -> Log:
    """Returns three arms that agree on a pose; no site hears another from 2.04 to 4.04 s."""
    text = posed_task_text(5.0).replace("[link]", GLIDES)
    far = "posture_rad = [1.2, -0.3, -0.9, -1.6, -0.3, 1.4, 0.25] }"
    text = text.replace(
        "posture_rate_1_s = 0.6, scale = 1.1 }", f"posture_rate_1_s = 0.6, {far}"
    )
    return trilat_net.simulate(parse_scenario(text))


@pytest.mark.long
def test_arms_hold_joints_and_follow_again() -> None:
    """The elbow of the slave is on its way to a posture on the other side when the links are
    cut.

    The remaining motion comes from gravity that is not learnt yet.
    """
    log = make_pose_log()
    for site in log.sites:
        part = log[site]
        held = np.flatnonzero(part.mode == "hold")
        assert held[0] == 2060
        assert set(part.mode[-200:]) == {"run"}
        at_entry = part.q[held[0]]
        kept = part.q[3500:4040]
        assert np.abs(kept - at_entry).max() <= 0.03, site
        assert np.abs(part.qd[4000:4040]).max() <= 0.01, site
    before = np.abs(log["s"].qd[1900:2000]).max()
    assert before > 0.05
    assert verify_log(log).identical == 15_000


@pytest.mark.long
def test_held_arms_return_from_free_motion() -> None:
    """A push that no torque limit cuts moves the arm only where its end effector stays; the arm
    returns at about 3/s to where it rested.
    """
    text = posed_task_text(6.5).replace("[link]", GLIDES.replace("4.0", "6.0"))
    text = text.replace('"adaptive"\nLambda = 1.5\nKp = 10.0', '"pd_d"\nd = 10.0\nK = 60.0')
    text = text.replace("Gamma = 1.0\n", "").replace(
        "posture_rate_1_s = 0.6", "posture_rate_1_s = 0.0"
    )
    push = '{ kind = "pulse", start_s = 2.5, end_s = 3.5, peak_nm = [43.1, 0.0, -32.5, 0.0, -10.6, 0.0, 9.5] }'
    text = text.replace("q0_rad = [0.0, -0.3", f"hands = [{push}]\nq0_rad = [0.0, -0.3")
    scenario = parse_scenario(text)
    part = trilat_net.simulate(scenario)["s"]
    assert (np.abs(part.tau) < scenario.sites["s"].limits.tau_limit_nm).all()

    resting = 2499
    pushed = 3700
    returned = 5000
    assert set(part.mode[resting:6000]) == {"hold"}
    distance = np.abs(part.q - part.q[resting]).max(axis=1)
    assert distance[pushed] >= 0.05
    # four time constants of 1/3 s
    assert distance[returned:6000].max() <= 0.04 * distance[pushed]
    assert np.abs(part.x[resting:6000, :3] - part.x[resting, :3]).max() <= 0.01


@pytest.mark.long
def test_references_integrate_their_velocities() -> None:
    """If the reference follows peers alone, it does so only once these agree; see `task_space`."""
    log = make_pose_log()
    for site in log.sites:
        part = log[site]
        rest = np.isin(part.mode, ["waiting", "hold"])
        rest = rest[1:] & rest[:-1]
        off = measure_steps(part.q_des[:, 3:]) - 0.5e-3 * (
            part.qd_des[1:, 3:] + part.qd_des[:-1, 3:]
        )
        assert np.abs(off)[rest].max() <= 1e-9
        # leaves the peers'
        begins = np.isin(part.mode[1:], ["hold"]) & ~np.isin(part.mode[:-1], ["hold"])
        assert np.linalg.norm(measure_steps(part.q_des[:, 3:]), axis=1)[~begins].max() <= 3e-3
        assert np.abs(np.diff(part.qd_des[:, 3:], axis=0)).max() <= 0.1


@pytest.mark.long
def test_energies_close_over_a_task_space_hold() -> None:
    """Seven joints, four of them redundant, on their way to a posture 0.4 rad off: r contains
    their pose.
    """
    rule = {"action": "glide", "align_speed_rad_s": 1.0, "align_limit_rad": 2.0}
    log = trilat_net.simulate(
        "unlike_arms",
        {
            **{f"on_stale.{key}": value for key, value in rule.items()},
            "duration_s": 4.0,
            "link.outages_s": [[1.5, 3.0]],
            "sites.s.task.posture_rad": [0.4, -0.5, 0.3, -1.4, 0.3, 1.1, 0.4],
        },
    )
    energies = SiteEnergy.by_site(log)
    balance = EnergyBalance.of_energies(energies)
    assert np.abs(balance.residual).max() <= 1e-4 * np.abs(balance.V).max()
    energy = energies["s"]
    modes = log["s"].mode
    first = int(np.flatnonzero(modes == "hold")[0])
    assert set(modes[first : first + 1400]) == {"hold"}
    assert energy.motion.measure_torque_error().max() <= 1e-9
    assert verify_log(log).differing == 0


@pytest.mark.long
def test_equal_arms_stop_and_return_smoothly() -> None:
    text = posed_task_text(6.0).replace("[link]", GLIDES.replace("4.0", "2.5"))
    scenario = parse_scenario(text, "", {"limits.tau_rate_limit_nm_s": 500.0})
    orders = {"m2": {1200: "stop", 1500: "enable"}, "s": {3200: "arm_lost", 3600: "reset"}}
    log = make_ordered_log(scenario, orders)
    assert {"stopped", "fault", "hold"} <= {
        str(mode) for site in log.sites for mode in log[site].mode
    }
    for site in log.sites:
        assert find_largest_step(log, site) <= 0.5 * (1.0 + 1e-9)
        assert set(log[site].mode[-200:]) == {"run"}
    assert verify_log(log).identical == 18_000
