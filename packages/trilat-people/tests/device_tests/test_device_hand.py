"""A device at an arm, in whole sessions on one clock: the motion of the target, the rendered
force, and the release.
"""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from trilat_people.devices.haply_inverse3 import SILENCE_S

from tests.documentation import find_blocks
from tests.sites.devices import ZERO, ScriptedDevice
from tests.sites.relay import RelayClock
from tests.sites.sessions import Session, reach_session
from trilat_net.app.input_device import DeviceState
from trilat_net.core.life.live_hand import SILENCE_NS
from trilat_net.errors import UsageError
from trilat_net.execution.verification import verify_log
from trilat_net.log.log_reader import Log
from trilat_net.net.bus import Bus
from trilat_net.scenario import load_scenario

Script = Callable[[float], DeviceState]
HELD = {"a": True, "b": False}
FREE = {"a": False, "b": False}
SETTLED = 20
"""Ticks from taking hold of an arm, which moves, until its target rests where the arm was seen."""


class DeviceSession:
    """A session in which a device leads m1.

    Attributes:
        log: The log of the session.
        device: The device.
        said: The printed texts.
    """

    def __init__(
        self,
        folder: Path,
        script: Script,
        device: dict[str, Any] | None = None,
        mode: str = "tip",
        hangs_s: tuple[float, float] = (1e9, 0.0),
    ) -> None:
        hands = [{"kind": "live", "mode": mode, **({"device": device} if device else {})}]
        scenario = load_scenario(
            "play",
            {"duration_s": 3.0, "rate_hz": 200, "sites.m1.hands": hands, "link.delay_ms": 10},
        )
        session = Session.whole(scenario, folder)
        self.said: list[str] = []

        def act(bus: Bus, clock: RelayClock) -> None:
            self.device = ScriptedDevice(clock, script, hangs_s)
            reach_session(bus, clock).lead("m1", self.device, say=self.said.append)

        session.stranger(act)
        self.log: Log = session.run()

    @property
    def target(self) -> "np.ndarray[Any, np.dtype[np.float64]]":
        """The target while the arm is held, after the ticks in which the target settles."""
        hand = self.log["m1"].hand
        return hand[hand[:, 2] > 0.0, 3:5][SETTLED:]

    @property
    def changes(self) -> list[str]:
        """The texts of the events in which the hand takes or leaves the arm."""
        texts = [event.text for event in self.log.events if event.kind == "hand"]
        return [text.partition(" at t")[0] for text in texts]


def is_clutched(t_s: float) -> bool:
    """Returns True from 0.2 s on."""
    return t_s >= 0.2


def make_script(
    place_m: Callable[[float], tuple[float, float, float]], is_pressed: Callable[[float], bool]
) -> Script:
    """Returns the states of a device by its places, in m, and by its clutch."""
    return lambda t_s: DeviceState(place_m(t_s), ZERO, HELD if is_pressed(t_s) else FREE)


def place_upwards_m(t_s: float) -> tuple[float, float, float]:
    """Returns the place of a device that moves up by 50 mm from 0.5 s to 1 s."""
    return 0.3, -0.12, 0.15 + 0.1 * min(max(t_s - 0.5, 0.0), 0.5)


def test_devices_lead_arms_as_logs_repeat(tmp_path: Path) -> None:
    """Up in the frame of the device is y of a planar arm, from whatever place the device starts."""
    session = DeviceSession(tmp_path, make_script(place_upwards_m, is_clutched))
    moved = session.target[-1] - session.target[0]
    assert moved == pytest.approx([0.0, 0.05], abs=1e-9)
    assert session.changes[0] == "m1: ScriptedDevice takes hold"
    assert verify_log(session.log).passed


@pytest.mark.parametrize(
    ("frame", "scale", "moved"),
    [
        (["up", "left"], 1.0, [0.05, 0.0]),
        (["ahead", "down"], 2.0, [0.0, -0.1]),
        (["left", "ahead"], 1.0, [0.0, 0.0]),
    ],
)
def test_frame_and_scale_transform_its_motion(
    frame: list[str], scale: float, moved: list[float], tmp_path: Path
) -> None:
    session = DeviceSession(
        tmp_path, make_script(place_upwards_m, is_clutched), {"frame": frame, "scale": scale}
    )
    assert session.target[-1] - session.target[0] == pytest.approx(moved, abs=1e-9)


def test_closing_a_clutch_makes_no_jump(tmp_path: Path) -> None:
    """The device goes up by 50 mm with the clutch open; the arm stays held at its place."""
    session = DeviceSession(
        tmp_path, make_script(place_upwards_m, lambda t_s: 0.2 <= t_s < 0.4 or t_s > 1.5)
    )
    assert np.abs(session.target - session.target[0]).max() < 1e-12
    assert session.changes == ["m1: ScriptedDevice takes hold"]  # held to the end
    open_s = [
        t_s for t_s, force in session.device.rendered if force != ZERO and 0.41 < t_s < 1.5
    ]
    assert open_s == []


def test_the_button_lets_go(tmp_path: Path) -> None:
    """The second button releases the arm, and the clutch takes hold no second time."""

    def script(t_s: float) -> DeviceState:
        buttons = {"a": t_s < 2.0, "b": 1.0 < t_s < 1.1} if t_s > 0.2 else FREE
        return DeviceState(place_upwards_m(t_s), ZERO, buttons)

    session = DeviceSession(tmp_path, script)
    assert session.changes == [
        "m1: ScriptedDevice takes hold",
        "m1: ScriptedDevice lets go",
    ]
    held = session.log["m1"].t_s[session.log["m1"].hand[:, 2] > 0.0]
    assert held[-1] - held[0] == pytest.approx(0.8, abs=0.02)


def make_wrong_script(wrong: DeviceState) -> Script:
    """Returns the states of a device that moves up, of which three are replaced."""

    def script(t_s: float) -> DeviceState:
        if 0.7 <= t_s < 0.715:
            return wrong
        return DeviceState(place_upwards_m(t_s), ZERO, HELD if t_s > 0.2 else FREE)

    return script


@pytest.mark.parametrize(
    ("wrong", "counted"),
    [
        (DeviceState((9.0, 9.0, 9.0), ZERO, HELD), "dropped: 2 jumps, 0 unreadable"),
        (DeviceState((1e300, -1e308, 0.0), ZERO, HELD), "dropped: 2 jumps, 0 unreadable"),
        (DeviceState((math.nan, 0.0, 0.0), ZERO, HELD), "dropped: 0 jumps, 3 unreadable"),
        (DeviceState((0.3, -0.12, math.inf), ZERO, HELD), "dropped: 0 jumps, 3 unreadable"),
        (
            DeviceState((0.3, -0.12, 0.15), (math.nan, 0.0, 0.0), HELD),
            "dropped: 0 jumps, 3 unreadable",
        ),
    ],
)
def test_jumps_and_invalid_numbers_move_nothing(
    wrong: DeviceState, counted: str, tmp_path: Path
) -> None:
    """The target misses at most the motion of the device meanwhile, 2 mm, and stands still at the end."""
    session = DeviceSession(tmp_path, make_wrong_script(wrong))
    moved = session.target[-1] - session.target[0]
    assert moved == pytest.approx([0.0, 0.05], abs=2.1e-3)
    assert np.abs(np.diff(session.target, axis=0)).max() < 2.1e-3
    assert counted in session.said[-1]


def list_forces_n(session: DeviceSession) -> "np.ndarray[Any, np.dtype[np.float64]]":
    """Returns the forces that the device rendered, in N."""
    return np.array([force for _, force in session.device.rendered])


def test_devices_render_the_arms_reaction(tmp_path: Path) -> None:
    """Where the hand pulls the arm up, the device pulls down, by the record's force, and not ahead."""
    session = DeviceSession(
        tmp_path, make_script(place_upwards_m, is_clutched), {"force_limit_n": 1000.0}
    )
    rendered = list_forces_n(session)
    assert rendered[:, 2].min() < -1.0
    assert np.abs(rendered[:, 1]).max() == 0.0
    part = session.log["m1"]
    arm = session.log.scenario.arms["m1"]
    pulls_n = []
    for hand, q in zip(part.hand, part.q, strict=True):
        if hand[0] == 1.0:
            pulls_n.append(300.0 * (hand[4] - arm.end_effector(q)[1]))
    assert rendered[:, 2].min() == pytest.approx(-max(pulls_n), rel=0.3)


@pytest.mark.parametrize(("scale", "limit"), [(1.0, 2.0), (1.0, 0.5), (50.0, 1.5)])
def test_force_stays_within_its_limit(scale: float, limit: float, tmp_path: Path) -> None:
    session = DeviceSession(
        tmp_path,
        make_script(place_upwards_m, is_clutched),
        {"force_scale": scale, "force_limit_n": limit},
    )
    assert np.linalg.norm(list_forces_n(session), axis=1).max() == pytest.approx(limit)


def test_closing_clutches_let_the_force_grow(tmp_path: Path) -> None:
    """A target 50 mm off pulls the arm all the time: no force is felt at once."""
    session = DeviceSession(
        tmp_path,
        make_script(place_upwards_m, lambda t_s: 0.2 <= t_s < 1.0 or t_s > 1.2),
        {"force_limit_n": 1000.0},
    )
    after = [math.hypot(*force) for t_s, force in session.device.rendered if 1.2 < t_s < 1.4]
    assert after[0] < 0.2 * max(after)
    assert max(np.diff(after)) < 0.2 * max(after)


@pytest.mark.parametrize("fault", ["raises", "hangs"])
def test_silent_devices_need_their_button_anew(fault: str, tmp_path: Path) -> None:
    """A device that was away with its clutch pressed takes hold when the clutch is pressed again.

    The device is away from 1 s to 1.5 s. The clutch is open from 2 s to 2.2 s.
    """

    def script(t_s: float) -> DeviceState:
        if 1.0 <= t_s < 1.5 and fault == "raises":
            raise TimeoutError("the device is silent")
        return DeviceState(
            place_upwards_m(t_s), ZERO, FREE if t_s < 0.2 or 2.0 < t_s < 2.2 else HELD
        )

    session = DeviceSession(
        tmp_path, script, hangs_s=(1.0, 0.5) if fault == "hangs" else (1e9, 0.0)
    )
    release = "lets go" if fault == "raises" else "is silent: let go"
    assert session.changes[:3] == [
        "m1: ScriptedDevice takes hold",
        f"m1: ScriptedDevice {release}",
        "m1: ScriptedDevice takes hold",
    ]
    part = session.log["m1"]
    held = part.t_s[part.hand[:, 2] > 0.0]
    (rest,) = np.flatnonzero(np.diff(held) > 0.1)
    assert 0.9 < held[rest + 1] - held[rest] < 1.3
    assert verify_log(session.log).passed
    if fault == "raises":
        assert (
            sum("the device is silent; the arm is released" in line for line in session.said)
            == 1
        )
        assert session.device.entered == 2


def test_lost_devices_are_reported_and_tried_again(tmp_path: Path) -> None:
    def script(_: float) -> DeviceState:
        raise ConnectionError("no service")

    session = DeviceSession(tmp_path, script)
    assert [line for line in session.said if "no service" in line] == [
        "m1: no service; the arm is released, and the device is tried again"
    ]
    assert session.device.entered > 2
    assert session.changes == []


def test_old_records_are_not_felt(tmp_path: Path) -> None:
    """A site that stalls sends nothing: after 0.1 s the device is free."""
    scenario = load_scenario("play", {"duration_s": 3.0, "rate_hz": 200, "link.delay_ms": 10})
    session = Session.whole(scenario, tmp_path)
    devices: list[ScriptedDevice] = []

    def act(bus: Bus, clock: RelayClock) -> None:
        devices.append(ScriptedDevice(clock, make_script(place_upwards_m, is_clutched)))
        reach_session(bus, clock).lead("m1", devices[0], say=lambda _: None)

    session.stranger(act)
    session.clocks["m1"].stall(session.relay.now_ns + 2_300_000_000, 400_000_000)
    session.run()
    times = np.array([t_s for t_s, _ in devices[0].rendered])
    forces = np.array([math.hypot(*force) for _, force in devices[0].rendered])
    stale = np.flatnonzero((forces == 0.0) & (times > 0.6) & (times < 2.4))
    assert 20 < stale.size < 80


def test_the_documented_device_leads_an_arm(tmp_path: Path) -> None:
    """The class of docs/sessions/devices.md moves to the right at 5 cm/s, clutched after 1 cm."""
    names: dict[str, Any] = {}
    (code,) = [
        block.text
        for block in find_blocks("docs/sessions/devices.md")
        if block.language == "python"
    ]
    exec(code, names)
    pushed = names["Pushed"]()
    felt_n: list[float] = []
    pushed.render = lambda force_n: felt_n.append(force_n[0])
    session = Session.whole(
        load_scenario("play", {"duration_s": 3.0, "rate_hz": 200}), tmp_path
    )
    session.stranger(
        lambda bus, clock: reach_session(bus, clock).lead("m1", pushed, say=lambda _: None)
    )
    log = session.run()
    target = log["m1"].hand[log["m1"].hand[:, 2] > 0.0, 3:5]
    assert target[-1, 0] - target[SETTLED, 0] == pytest.approx(
        0.05 * (len(target) - SETTLED) / 200, rel=0.1
    )
    assert min(felt_n) < -0.1


def test_hands_not_led_by_tips_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="mode 'tip'"):
        DeviceSession(tmp_path, make_script(place_upwards_m, is_clutched), mode="joint")


def test_services_are_given_up_before_hand_silence() -> None:
    assert SILENCE_S * 1e9 < SILENCE_NS


def pumped(t_s: float) -> DeviceState:
    """Moves right by 0.3 m with the clutch pressed, back with it open, five times in 2 s; then leaves."""
    phase = min(t_s, 2.2) % 0.4
    back = max(t_s - 2.2, 0.0)
    if t_s < 0.2:
        return DeviceState(ZERO, ZERO, FREE)
    if t_s < 2.2:
        right = 0.3 * min(phase, 0.4 - phase) / 0.2
        return DeviceState((right, 0.0, 0.0), ZERO, HELD if phase < 0.2 else FREE)
    return DeviceState((-0.5 * back, 0.0, 0.0), ZERO, HELD)


def test_repeated_clutching_keeps_the_target_within_reach(tmp_path: Path) -> None:
    """Five strokes of 0.3 m, twice as large at the arm; the first motion back moves the target at once."""
    session = DeviceSession(tmp_path, pumped, {"scale": 2.0})
    reach_m = sum(session.log.scenario.arms["m1"].lengths_m)
    hand = session.log["m1"].hand
    held = hand[hand[:, 2] > 0.0]
    radius_m = np.hypot(held[:, 3], held[:, 4])
    assert radius_m.max() == pytest.approx(reach_m, abs=1e-6)
    t_s = session.log["m1"].t_s[hand[:, 2] > 0.0]
    begun = int(np.argmax(radius_m > reach_m - 1e-3))
    back = held[-1, 3] - held[begun:, 3].max()
    # of 2 x 0.5 m/s for the rest of the session: no stroke has to be taken back
    assert back < -0.3
    assert t_s[begun] < 2.2
    assert verify_log(session.log).passed


LATER = [pytest.param(gaps, marks=pytest.mark.long) for gaps in ((150, 10), (30, 90))]


@pytest.mark.parametrize("gaps_ms", [(60, 10), *LATER], ids=str)
def test_uneven_states_never_jerk_the_target(gaps_ms: tuple[int, int], tmp_path: Path) -> None:
    """A hand at 0.3 m/s whose machine delivers its places in bursts: 37 N m within 1 ms before."""

    def place(t_s: float) -> tuple[float, float, float]:
        late, even = (1e-3 * gap for gap in gaps_ms)
        seen_s = t_s - t_s % (late if int(t_s / 0.3) % 2 else even)
        return 0.1 * math.sin(3.0 * seen_s), 0.0, 0.0

    session = DeviceSession(tmp_path, make_script(place, is_clutched))
    m1 = session.log["m1"]
    live = session.log.scenario.sites["m1"].find_live_hand()
    held = m1.hand[m1.hand[:, 2] > 0.0]
    rates = held[:, 5:7]
    change = np.linalg.norm(np.diff(rates, axis=0), axis=1)
    assert change.max() <= live.acceleration_limit_m_s2 / 200 + 1e-12
    assert np.linalg.norm(rates, axis=1).max() <= live.speed_limit_m_s + 1e-12
    assert np.ptp(held[SETTLED:, 3]) > 0.1
