"""The largest gains that an arm tolerates: the edge by roots, the margins, and runs that confirm both."""

import json
import math
import random
import re
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from trilat_studies.arm_gains import SHARES, ArmGains, tune_arm

import trilat_net as tn
from tests.cli.running import trilat
from tests.log.builders import edit_log_bytes
from tests.scenario.builders import find_robot_files
from tests.sites.visits import ping_sites
from trilat_net.app.running_session import RunningSession
from trilat_net.errors import TrilatError, UsageError
from tuning_tests.mode_count import count_growing
from tuning_tests.odd_arms import ELBOW, ODD_ARMS, SHOULDER, write_arm

GOLDEN = Path(__file__).parents[4] / "tests" / "golden"
MAKERS = {
    "UR5": ("ur_description/urdf/ur5_robot.urdf", "tool0"),
    "Panda": ("panda_description/urdf/panda.urdf", "panda_hand_tcp"),
    "Jaco": ("kinova_description/robots/kinova.urdf", "j2s6s200_end_effector"),
    "TwoDofs": ("asr_twodof_description/urdf/TwoDofs.urdf", "Tip"),
    "Z1": ("b1_description/urdf/b1-z1.urdf", "gripperMover"),
}
"""By name a file of `example-robot-data` and its end link."""
ARMS = ("arm6.urdf", "arm7.urdf", *MAKERS, *ODD_ARMS)
DELAYS = ("0", "20ms", "100ms", "jitter")


def write_jitter(
    path: Path, swing_ms: float = 15.0, jitter_ms: float = 3.0, every_s: float = 0.01
) -> Path:
    """Writes a trace of 2 s about 40 ms: a queue that fills and empties, and delays drawn anew
    in intervals.
    """
    chance = random.Random(3)
    rows = []
    for n in range(round(2.0 / every_s)):
        t_s = every_s * n
        queue_ms = swing_ms * math.sin(math.pi * n * every_s)
        drawn_ms = chance.uniform(-jitter_ms, jitter_ms)
        delay_ms = 40.0 + queue_ms + drawn_ms
        rows.append(f"{t_s:.2f},{delay_ms:.3f}")
    path.write_text("\n".join(["t_s,delay_ms", *rows]), encoding="utf-8")
    return path


def tune(name: str, delay: str, folder: Path, **more: object) -> ArmGains:
    """Returns the gains of a user's own arm, of a shipped arm, or of a maker's arm."""
    arm = Path(name)
    tip = ""
    if name in ODD_ARMS:
        arm = folder / "odd.urdf"
        arm.write_text(ODD_ARMS[name], encoding="utf-8")
    if name in MAKERS:
        pytest.importorskip("pinocchio", reason="robots are not installed: make test-long")
        file, tip = MAKERS[name]
        arm = find_robot_files()[file]

    delay_text = str(write_jitter(folder / "jitter.csv")) if delay == "jitter" else delay
    return tune_arm(arm, delay_text, tip=tip, **more)  # type: ignore[arg-type]


def assert_confirmed(arm_gains: ArmGains) -> None:
    """Asserts that runs decay below the edge, grow beyond the edge, and decay at the chosen gains."""
    stable = {run["share"]: run["stable"] for run in arm_gains.runs}
    assert stable == {None: True, SHARES[0]: True, SHARES[1]: False}, arm_gains.summary()
    assert arm_gains.agree


def assert_proven(arm_gains: ArmGains) -> None:
    """Asserts that, at a margin of 2, P+d meets d > K T, which suffices whatever the masses."""
    assert (gains(arm_gains, "d") > gains(arm_gains, "K") * 1e-3 * arm_gains.age_ms).all()


@pytest.mark.parametrize("delay", ["0", "20ms"])
@pytest.mark.parametrize("name", ["one joint", "slide"])
def test_runs_confirm_the_edge(name: str, delay: str, tmp_path: Path) -> None:
    tuning = tune(name, delay, tmp_path, poses=2)
    assert_confirmed(tuning)
    assert_proven(tuning)


@pytest.mark.long
@pytest.mark.parametrize("delay", DELAYS)
@pytest.mark.parametrize("name", ARMS)
def test_runs_confirm_the_edge_of_every_arm(name: str, delay: str, tmp_path: Path) -> None:
    tuning = tune(name, delay, tmp_path)
    assert_confirmed(tuning)
    assert_proven(tuning)


def gains(arm_gains: ArmGains, name: str) -> np.ndarray:
    """Returns the same gain for every joint."""
    return np.array([joint[name] for joint in arm_gains.joints])


@pytest.fixture
def one_joint(tmp_path: Path) -> Path:
    """Returns an arm of one joint."""
    path = tmp_path / "one.urdf"
    path.write_text(write_arm([SHOULDER]), encoding="utf-8")
    return path


def test_one_joint_has_the_edge_of_its_equation(one_joint: Path) -> None:
    """M w^2 = K (1 + cos w T) and d w = K sin w T, with d = 2 zeta sqrt(K M)."""
    tuned_arm = tune_arm(one_joint, "60ms", poses=1, margin=2.0, damping=0.7)
    zeta = 0.7 / math.sqrt(2.0)
    w = math.sqrt(2.0 - 4.0 * zeta**2)
    k = (math.acos(w * w - 1.0) / w / 0.06) ** 2
    assert tuned_arm.edge["continuous_per_s2"] == pytest.approx(k, rel=1e-3)
    assert tuned_arm.edge["k_per_s2"] == pytest.approx(k, rel=1e-2)

    M = 3.0 * 0.5**2 / 3.0
    assert gains(tuned_arm, "inertia") == pytest.approx([M], rel=1e-6)
    assert gains(tuned_arm, "K") == pytest.approx([k * M / 2.0], rel=1e-2)
    assert gains(tuned_arm, "d") == pytest.approx(
        2.0 * 0.7 * np.sqrt(gains(tuned_arm, "K") * M), rel=2e-3
    )


@pytest.mark.parametrize("name", ["slide", pytest.param("arm6.urdf", marks=pytest.mark.long)])
def test_modes_begin_to_grow_at_the_edge(name: str, tmp_path: Path) -> None:
    """An independent count of growing modes is zero just below the edge, and not just above."""
    tuning = tune(name, "20ms", tmp_path, poses=3, set={"arm.g_m_s2": 0})
    arm = str(tmp_path / "odd.urdf") if name in ODD_ARMS else name
    loop = {
        "name": "loop",
        "duration_s": 1.0,
        "arm": {"urdf": arm, "stops": False},
        "sites": {"m": {}, "s": {"role": "slave"}},
        "dominance": {"m": {"s": 1.0}, "s": {"m": 1.0}},
        "link": {"delay_ms": 20.0},
        "control": {"law": "p_d", "K": 1e-6, "d": 1e-6},
    }

    M = tn.load_scenario(loop).arms["m"].inertia(np.array(tuning.edge["pose"]))
    for share, grows in ((0.99, False), (1.01, True)):
        k = share * tuning.edge["k_per_s2"]
        m = gains(tuning, "inertia")
        zeta = 0.7 / math.sqrt(2.0)
        d = 2.0 * zeta * math.sqrt(k) * m
        assert (count_growing(M, k * m, d, 20, 1e-3) > 0) is grows


@cache
def tune_shoulder(share: float) -> ArmGains:
    """Returns the gains of an arm of one joint with the given mass."""
    text = write_arm([SHOULDER._replace(mass=share * SHOULDER.mass)])
    return tune_arm("arm", "30ms", poses=1, set={"urdf": {"arm": text}})


@settings(max_examples=3)
@given(st.floats(0.05, 20.0))
def test_gains_scale_with_all_masses(c: float) -> None:
    arms = [tune_shoulder(1.0), tune_shoulder(c)]
    for name in ("K", "d"):
        assert gains(arms[1], name) == pytest.approx(c * gains(arms[0], name), rel=5e-3)


def test_the_edge_falls_with_the_delay(one_joint: Path) -> None:
    k = [tune_arm(one_joint, ms, poses=1).edge["k_per_s2"] for ms in (5, 20, 80)]
    assert k[0] > 3.0 * k[1] > 9.0 * k[2]


def test_at_high_rates_only_delay_limits_gains(one_joint: Path) -> None:
    """From 500 Hz on the rate does not bound the gains of a loop with 50 ms; at 20 Hz it does."""
    slow = tune_arm(one_joint, "50ms", poses=1, rate_hz=20)
    fast = tune_arm(one_joint, "50ms", poses=1, rate_hz=500)
    faster = tune_arm(one_joint, "50ms", poses=1, rate_hz=2000)
    assert fast.edge["bound"] == faster.edge["bound"] == "delay"
    assert gains(faster, "K") == pytest.approx(gains(fast, "K"), rel=1e-2)
    assert slow.edge["bound"] == "tick rate"


@pytest.mark.long
def test_with_enough_damping_no_delay_bounds_the_stiffness(one_joint: Path) -> None:
    """No root of one joint crosses at any delay where d^2 >= 2 K M."""
    bounded = tune_arm(one_joint, "50ms", poses=1, damping=0.95)
    free = tune_arm(one_joint, "50ms", poses=1, damping=1.05)
    assert bounded.edge["bound"] == "delay"
    assert free.edge["continuous_per_s2"] is None
    assert free.edge["bound"] == "tick rate"
    assert_confirmed(free)


@pytest.mark.parametrize("margin", [1.5, pytest.param(4.0, marks=pytest.mark.long)])
def test_damping_keeps_the_margin_to_its_limit(margin: float, tmp_path: Path) -> None:
    tuning = tune("slide", "1ms", tmp_path, poses=1, margin=margin)
    assert tuning.edge["used_per_s2"] <= tuning.edge["limit_per_s2"] / margin**2 * (1.0 + 1e-9)
    assert tuning.edge["used_per_s2"] <= tuning.edge["k_per_s2"]
    m = gains(tuning, "inertia")
    assert gains(tuning, "K") == pytest.approx(
        tuning.edge["used_per_s2"] * m / margin, rel=1e-3
    )
    assert tuning.runs[0]["stable"]


@pytest.mark.long
def test_the_longest_delays_lower_the_gains(one_joint: Path, tmp_path: Path) -> None:
    jitter = write_jitter(tmp_path / "jitter.csv")
    largest = tune_arm(one_joint, jitter, poses=1, quantile=1.0)
    median = tune_arm(one_joint, jitter, poses=1, quantile=0.5)
    assert largest.age_ms > median.age_ms
    assert largest.edge["k_per_s2"] == pytest.approx(median.edge["k_per_s2"], rel=1e-2)
    assert (gains(largest, "K") < gains(median, "K")).all()


@pytest.mark.long
def test_over_slow_jitter_growth_begins_more_than_once(one_joint: Path, tmp_path: Path) -> None:
    """Delays that change every 50 ms pump the loop parametrically: the loop grows below the
    edge too.

    The gains are those of the constant delay, which is the tighter bound, and they are stable.
    """
    tuned_arm = tune_arm(
        one_joint, write_jitter(tmp_path / "jitter.csv", 0.0, 20.0, 0.05), poses=1
    )
    assert tuned_arm.agree
    assert [run["stable"] for run in tuned_arm.runs] == [True, False, False]
    assert (
        tuned_arm.edge["used_per_s2"]
        == tuned_arm.edge["constant_per_s2"]
        < 0.5 * tuned_arm.edge["k_per_s2"]
    )


def test_delays_are_taken_from_a_log(one_joint: Path) -> None:
    tuned_arm = tune_arm(one_joint, f"measured:{GOLDEN / 'live-4g.mcap'}", poses=1)
    assert re.fullmatch(r"the delays of \w+->\w+ in live-4g.mcap", tuned_arm.delay)
    assert tuned_arm.runs[0]["stable"]


def test_unreadable_records_name_the_option(one_joint: Path, tmp_path: Path) -> None:
    """A log with a record that cannot be decoded is an error of the option --delay."""
    data = (GOLDEN / "live-4g.mcap").read_bytes()
    path = tmp_path / "run.mcap"
    path.write_bytes(edit_log_bytes(data, record=lambda record: {**record, "rx": "none"}))
    with pytest.raises(UsageError) as error:
        tune_arm(one_joint, f"measured:{path}", poses=1)
    message = str(error.value)
    assert message.startswith(f"delay measured:{path}: a record of ")
    assert "cannot be read" in message


def test_sessions_have_the_delay_of_their_slowest_link(
    one_joint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    report = ping_sites()  # of a party on the party's clock
    monkeypatch.setattr(RunningSession, "ping", lambda _: report)
    arguments = ("tune", "--arm", one_joint.name, "--delay", "measured:paper", "--json")
    facts = json.loads(trilat(*arguments, cwd=tmp_path).succeeds())
    assert facts["delay"] == f"{1e-3 * report.links[0]['delay_us']:g} ms each way"


@pytest.mark.long
@pytest.mark.parametrize("law", ["pd_d", "saturated_pd"])
def test_laws_with_stiffness_are_tuned_at_three_sites(law: str, tmp_path: Path) -> None:
    assert_confirmed(tune("slide and elbow", "20ms", tmp_path, law=law, sites=3, poses=2))


@pytest.mark.long
def test_gains_of_several_joints_scale_with_all_masses() -> None:
    heavy = [piece._replace(mass=7.0 * piece.mass) for piece in (SHOULDER, ELBOW)]
    texts = [write_arm(arm) for arm in ([SHOULDER, ELBOW], heavy)]
    arms = [tune_arm("arm", "30ms", set={"urdf": {"arm": text}}) for text in texts]
    for name in ("K", "d"):
        assert gains(arms[1], name) == pytest.approx(7.0 * gains(arms[0], name), rel=5e-3)


def test_a_digital_controller_tolerates_less_gain(one_joint: Path) -> None:
    tuned_arm = tune_arm(one_joint, "5ms", poses=1, set={"scheme": "digital"})
    assert_confirmed(tuned_arm)
    assert tuned_arm.edge["k_per_s2"] < tune_arm(one_joint, "5ms", poses=1).edge["k_per_s2"]


SCENARIO = """name = "mine"
duration_s = 0.1
{line}
arm = {{ urdf = "one.urdf" }}
link = {{ delay_ms = 40 }}
sites = {{ m = {{}}, s = {{ role = "slave" }} }}
dominance = {{ m = {{ s = 1.0 }}, s = {{ m = 1.0 }} }}
"""


def test_the_printed_line_fits_a_scenario(one_joint: Path, tmp_path: Path) -> None:
    arguments = ("tune", "--arm", one_joint.name, "--delay", "40ms", "--json")
    facts = json.loads(trilat(*arguments, cwd=tmp_path).succeeds())
    (tmp_path / "mine.toml").write_text(SCENARIO.format(line=facts["line"]), encoding="utf-8")
    control = tn.load_scenario(tmp_path / "mine.toml").sites["m"].control
    assert list(control.K) == [joint["K"] for joint in facts["joints"]]
    assert facts["agree"] is True


def test_the_command_draws_and_prints(one_joint: Path, tmp_path: Path) -> None:
    arguments = ("tune", "--arm", one_joint.name, "--delay", "40ms", "--figure", "gains.png")
    output = trilat(*arguments, cwd=tmp_path).succeeds()
    assert "effort limit" in output
    assert re.search(r"ok +run of .* at 0.95 of the edge: decays", output)
    assert re.search(r"ok +run of .* at 1.1 of the edge: grows", output)
    assert (tmp_path / "gains.png").read_bytes().startswith(b"\x89PNG")


def test_python_names_its_arguments(one_joint: Path) -> None:
    with pytest.raises(TrilatError, match=r"^margin must be from 1 to 100"):
        tune_arm(one_joint, 40, margin=0.5)
