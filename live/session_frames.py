"""Frames of a session for pages: its constants, its present state, and new points of the plots.

Invariant:
    - A frame is a function of the records since the previous frame. If a page misses some
      frames, the next one is still complete.
    - Extremes between two frames are kept.
    - Forces are those ON the arm, N. The forces of people and of the law follow by the
      transpose of the Jacobian; near a singular pose that gives the least force which explains
      the torque.
    - A frame for the user of one site shows of each peer only its pose at one tick: that of the
      sample in use, or of the delayed picture (`SessionView.find_shown`).
"""

import math
from collections import defaultdict
from typing import Any

import numpy as np

from trilat_net.analysis.aligned import AlignedRecords
from trilat_net.analysis.arm_rows import (
    EndEffectorRows,
    build_arm_rows,
    joint_positions_m,
    upright_axes,
)
from trilat_net.analysis.body_turns import BodyTurns
from trilat_net.analysis.torque_sources import TorqueSplit, list_walls, split_torque, wall_force
from trilat_net.core.live_hand import HandInForce
from trilat_net.core.ticks import NS_PER_S, LifeAlarm
from trilat_net.core.vectors import Array
from trilat_net.net.messages import Event
from trilat_net.scenario import Scenario
from trilat_net.scenario.event_text import describe_event
from trilat_net.scenario.laws import identify_law

from .session_view import SessionView, SiteView, Tail

POINTS_KEPT = 1200
"""Points of a plot that a new page receives: 40 s."""
ENERGY_PERIOD_S = 0.025
COLOURS = 6
"""Number of colours for sites in `page.css`."""
MAX_FRAME_S = 0.5
"""Longest time whose records one frame evaluates, s."""
_MIN_SINGULAR_VALUE = 0.05
"""Smallest singular value of the Jacobian that is inverted, m/rad.

Along directions in which the end effector moves less, the force counts as zero.
"""

Json = dict[str, Any]


def _round(values: Array, digits: int = 5) -> list[Any]:
    """Returns an array as nested lists of rounded numbers."""
    rounded: list[Any] = np.round(values, digits).tolist()
    return rounded


class ArmFrames:
    """One arm in frames: its fixed shape; its pose, reference pose and forces in some records.

    Args:
        scenario: the scenario of the session.
        site: the site of the arm.
    """

    def __init__(self, scenario: Scenario, site: str) -> None:
        self._scenario = scenario
        self._site = site
        self._model = scenario.arms[site]
        self._spec = scenario.sites[site]
        self._walls = list_walls(self._spec)
        self._hand = self._spec.find_live_hand()
        limits_nm = np.asarray(self._spec.limits.tau_limit_nm, dtype=np.float64)
        self._tau_limit = np.broadcast_to(limits_nm, (self._model.counts.joints,))
        self._rows = build_arm_rows(scenario, site)

    def describe(self) -> Json:
        """Returns the constants of the arm."""
        chain = self._model.chain
        colours = self._scenario.assign_colours(COLOURS)
        index = self._scenario.names.index(self._site)
        q0 = np.array([self._spec.q0_rad], dtype=np.float64)
        start = joint_positions_m(self._model, q0)[0]
        link_lengths_m = np.linalg.norm(np.diff(start, axis=0), axis=1)
        shares_pose = self._model.shares_pose
        return {
            "role": self._spec.role,
            "colour": colours[index % len(colours)],
            "rate_hz": self._spec.rate_hz,
            "planar": chain is None,
            "up": None if chain is None else _round(upright_axes(chain)),
            "joints": len(self._spec.q0_rad),
            "start": _round(start),
            "reach": float(link_lengths_m.sum()),
            "tau_limit": _round(self._tau_limit),
            "bodies": [list(size) for size in self._scenario.bodies_m(self._site).values()],
            "walls": [{"at": list(wall.a), "normal": list(wall.b)} for wall in self._walls],
            "task": shares_pose,
            "unit": "m" if shares_pose else "rad",
            "hand": self._describe_hand(),
            "stops": self._spec.on_stale.action == "glide",
            "law": identify_law(self._spec.control),
        }

    def _describe_hand(self) -> Json | None:
        hand = self._hand
        if hand is None:
            return None
        settings = hand.device
        axes = settings.rows(self._model.counts.axes)
        centre, _, outer_m, *_ = self._model.reach
        is_bounded = outer_m < math.inf
        return {
            "mode": hand.mode,
            "limit": hand.actor.limit,
            "device": {"rows": axes, "scale": settings.scale, "jump_m_s": settings.jump_m_s},
            "reach": {"centre": list(centre), "most": outer_m if is_bounded else None},
        }

    def describe_pose(self, q: Array) -> Json:
        """Returns the pose of the arm at joint coordinates `q`, shape (n,), rad."""
        return {
            "points": _round(joint_positions_m(self._model, q[np.newaxis])[0]),
            "q": _round(q),
        }

    def describe_start(self) -> Json:
        """Returns the pose of the arm before tick 0, as the scenario places it."""
        return {
            **self.describe_pose(np.array(self._spec.q0_rad, dtype=np.float64)),
            "tick": -1,
            "bodies": [],
        }

    def describe_now(self, records: AlignedRecords) -> tuple[Json, list[float]]:
        """Returns the present state of the arm, and extremes since the previous frame.

        Args:
            records: the records since the previous frame; the last one is the present.

        Returns:
            The state, and the largest |e|, torque, hand force and wall force.
        """
        split = split_torque(records, self._scenario)
        last = slice(len(records.known) - 1, None)
        hand_force = self._compute_hand_force(records, split)
        wall_force_n = self._compute_wall_force(records, split)
        error = np.linalg.norm(records.e, axis=1)
        tau = np.abs(records.tau)
        if self._model.shares_pose:
            ghost = records.q_des[-1, :3][np.newaxis] / self._spec.task.scale
        else:
            ghost = joint_positions_m(self._model, records.q_des[last])[0]
        state = {
            **self.describe_pose(records.q[-1]),
            "ghost": _round(ghost),
            "e": float(error[-1]),
            "tau": _round(records.tau[-1], 3),
            "clamped": bool((tau >= self._tau_limit * (1.0 - 1e-12)).any()),
            "hand": _round(hand_force[-1], 3),
            "pull": self._compute_pull(records, split),
            "wall": _round(wall_force_n[-1], 3),
            **self._describe_grip(records, hand_force[-1]),
        }
        largest_hand_n = float(np.linalg.norm(hand_force, axis=1).max())
        largest_wall_n = float(np.linalg.norm(wall_force_n, axis=1).max())
        return state, [float(error.max()), float(tau.max()), largest_hand_n, largest_wall_n]

    def _describe_grip(self, records: AlignedRecords, force: Array) -> Json:
        """Returns the state of the live hand in the last record; {} without a live hand."""
        if not records.hand.size:
            return {}
        grip = HandInForce.read(records.hand[-1].tolist())
        hand = self._hand
        is_limited = False
        if hand is not None and hand.mode != "joint" and grip.source:
            limit_n = grip.grip * hand.force_limit_n * (1.0 - 1e-6)
            is_limited = float(np.linalg.norm(force)) >= limit_n
        has_target = hand is not None and hand.mode == "tip" and grip.grip > 0.0
        return {
            "grip": grip.grip,
            "source": grip.source,
            "target": grip.target if has_target else None,
            "hand_limited": is_limited,
        }

    def _compute_hand_force(self, records: AlignedRecords, split: TorqueSplit) -> Array:
        """Returns the force of people at the end effector, shape (K, 2) or (K, 3), N."""
        torque = split.operator
        # Without a hand in the scenario, a tiny torque is a rounding error of the split.
        rounding = 1e-9 * (1.0 + np.abs(records.tau_x).max())
        if not self._spec.hands and np.abs(torque).max() < rounding:
            return np.zeros_like(split.end_effector.position)
        return split.end_effector.find_force(torque, _MIN_SINGULAR_VALUE)

    def _compute_pull(self, records: AlignedRecords, split: TorqueSplit) -> list[float]:
        """Returns the law's force on the end effector in the last record, N; a user feels it.

        It is the force of the torque beyond gravity; [] if the masses are not known.
        """
        if not self._spec.arm.known:
            return []
        last = EndEffectorRows(*(rows[-1:] for rows in split.end_effector))
        torque = records.tau[-1:] - self._rows.gravity_torque(records.q[-1:])
        return _round(last.find_force(torque, _MIN_SINGULAR_VALUE)[0], 3)

    def _compute_wall_force(self, records: AlignedRecords, split: TorqueSplit) -> Array:
        """Returns the force of all walls at the end effector, shape (K, 2) or (K, 3), N."""
        total = np.zeros_like(split.end_effector.position)
        for wall in self._walls:
            force = wall_force(wall, records.nominal_s, split.end_effector)
            total = total + force[:, np.newaxis] * np.array(wall.b)
        return total


class SessionFrames:
    """The frames of one session; `make_frame` is called at the rate of the pages.

    Args:
        view: the session.

    Attributes:
        points: rows of the plots, in the order of `columns`.
        energies: rows of time, s, V, J, and the energy supplied by operator and environment, J.
    """

    def __init__(self, view: SessionView) -> None:
        self._view = view
        self._arms: dict[str, ArmFrames] = {}
        self._shapes: Json = {}
        self._last_ticks: dict[str, int] = {}
        self.points: Tail[list[float | None]] = Tail(POINTS_KEPT)
        self.energies: Tail[list[float]] = Tail(POINTS_KEPT)
        self._energy_s = -1.0
        self._shown_peers: dict[tuple[str, str], Json] = {}
        self._turns: defaultdict[tuple[str, str], BodyTurns] = defaultdict(BodyTurns)

    def describe(self) -> Json:
        """Returns the constants of the session: its sites, links and columns of plots."""
        view = self._view
        scenario = view.scenario
        # Prepared before the session runs, because loading the compiled arms takes seconds.
        if scenario is not None and not self._arms:
            self._arms = {site: ArmFrames(scenario, site) for site in scenario.names}
            self._shapes = {site: arm.describe() for site, arm in self._arms.items()}
        if scenario is None or not view.running:
            names = [] if scenario is None else scenario.names
            return {
                "session": view.session,
                "running": False,
                "title": "",
                "here": sorted(view.met),
                "missing": [name for name in names if name not in view.met],
            }
        kinds = ("e", "tau", "hand", "wall")
        columns = [f"{site}.{kind}" for site in scenario.names for kind in kinds]
        columns += [f"{link}.age" for link in scenario.links]
        return {
            "running": True,
            "session": view.session,
            "name": scenario.name,
            "title": scenario.title or scenario.name,
            "about": scenario.about,
            "duration_s": scenario.duration_s,
            "sites": self._shapes,
            "links": {name: list(name.split("->")) for name in scenario.links},
            "shares": {site: scenario.dominance[site] for site in scenario.names},
            "columns": columns,
        }

    def make_frame(self) -> Json | None:
        """Returns the present state; None until every site has a record."""
        view = self._view
        if not view.running or any(site.record is None for site in view.sites.values()):
            return None
        if not self._arms:
            self.describe()
        sites = {}
        row: list[float | None] = []
        t_s = 0.0
        for name, site in view.sites.items():
            sites[name], extremes = self._describe_site(name, site)
            t_s = max(t_s, sites[name]["t"])
            row += extremes
        links = {name: self._describe_link(name) for name in view.links}
        row += [link["age_ms"] for link in links.values()]
        if any(site["new"] for site in sites.values()):
            rounded = [None if value is None else float(f"{value:.5g}") for value in row]
            self.points.add([round(t_s, 4), *rounded])
        self._add_energies()
        return {
            "t": t_s,
            "sites": sites,
            "links": links,
            "shares": view.dominance,
            "energy": "" if view.energy is None else view.energy.reason,
            "ended": view.ended,
            "silent_s": 0.0 if view.ended else round(view.session_silence_s, 1),
            "dropped": sum(view.dropped.values()),
        }

    def _add_energies(self) -> None:
        """Adds points of V and the supplied energy, at most one per `ENERGY_PERIOD_S`."""
        course = self._view.advance_energy()
        if course is None:
            return
        columns = [column.tolist() for column in course]
        for t_s, V, supplied in zip(*columns, strict=True):
            if t_s >= self._energy_s + ENERGY_PERIOD_S - 1e-9:
                self._energy_s = t_s
                self.energies.add([t_s, V, supplied])

    def describe_session_as_user(self) -> Json:
        """Returns the constants of the session for the page of a site's user."""
        constants = self.describe()
        if not constants["running"]:
            return constants
        hidden: Json = {"about": "", "links": {}, "shares": {}, "columns": []}
        return {**constants, **hidden}

    def describe_as(self, frame: Json, site: str, *, ages: bool) -> Json:
        """Returns a frame for the user of a site: the site's arm now, its peers as shown there.

        Args:
            frame: the newest frame of `make_frame`.
            site: the site of the user.
            ages: whether each peer has the age of the shown sample, ms.
        """
        local = frame["sites"][site]
        ticks = self._view.find_shown(site, local["tick"], local["used"])
        peers = {
            name: self._describe_shown_peer(site, name, tick) for name, tick in ticks.items()
        }
        if ages:
            for name, peer in peers.items():
                rate_hz = self._view.sites[name].window.rate_hz
                age_ms = local["t"] * 1e3 - peer["tick"] * 1e3 / rate_hz
                peers[name] = {**peer, "age_ms": age_ms if peer["tick"] >= 0 else None}
        return {
            "t": local["t"],
            "sites": {name: peers.get(name, local) for name in frame["sites"]},
            "links": {},
            "shares": {},
            "energy": "",
            "ended": frame["ended"],
            "silent_s": local["silent_s"],
        }

    def _describe_shown_peer(self, site: str, peer: str, tick: int) -> Json:
        """Returns the pose of a peer at a tick; without that record, the pose shown before."""
        shown = self._shown_peers.get((site, peer)) or self._arms[peer].describe_start()
        view = self._view.sites[peer]
        if tick != shown["tick"] and view.window.has_record(tick):
            q = view.window.rows(tick, tick).q[0]
            bodies = _round(self._turns[site, peer].align(view.bodies.get(tick, [])))
            shown = {**self._arms[peer].describe_pose(q), "tick": tick, "bodies": bodies}
        self._shown_peers[site, peer] = shown
        return shown

    def _describe_site(self, name: str, site: SiteView) -> tuple[Json, list[float]]:
        """Returns the present state of a site, and extremes since the previous frame."""
        window = site.window
        record = site.record
        stats = site.stats
        assert record is not None
        newest = max(window.newest, 0)
        max_ticks = round(MAX_FRAME_S * window.rate_hz)
        last_tick = self._last_ticks.get(name, -1)
        first = max(min(last_tick + 1, newest), newest - max_ticks, window.first)
        state, extremes = self._arms[name].describe_now(window.rows(first, newest))
        self._last_ticks[name] = newest
        account = site.reception.accounts["state"]
        has_ended = self._view.ended
        alarm = None if has_ended else site.find_alarm(self._view.session, name)
        fields = {
            **state,
            "new": newest > last_tick,
            "t": record.t_ns / NS_PER_S,
            "tick": record.tick,
            "used": record.used,
            "mode": record.mode,
            "bodies": _round(self._turns["", name].align(record.bodies)),
            "alarm": None if alarm is None else _describe_alarm(alarm),
            "ended": site.ended or has_ended,
            "silent_s": 0.0 if has_ended else round(self._view.silence_s(site), 1),
            "holder": site.holder if state.get("source") else "",
            "late_us": stats.late_max_us if stats else 0,
            "overruns": stats.overruns if stats else 0,
            "missing": account.missing if site.holds_from == 0 else 0,
        }
        return fields, extremes

    def _describe_link(self, name: str) -> Json:
        """Returns the present state of a link."""
        view = self._view
        peer, _, receiver = name.partition("->")
        receiving = view.sites[receiver]
        sending = view.sites[peer]
        record = receiving.record
        used = -1 if record is None else record.used.get(peer, -1)
        age_ms = None
        if record is not None and used >= 0:
            age_ms = record.t_ns / 1e6 - used * 1e3 / sending.window.rate_hz
        newest = sending.record.tick if sending.record else used
        counts = {}
        if receiving.stats is not None:
            defaults = {"delay_us": -1, "accepted": 0, "late": 0, "lost": 0}
            counts = {
                key: getattr(receiving.stats, key).get(peer, default)
                for key, default in defaults.items()
            }
        settings = {
            key: value
            for key, value in view.links[name].items()
            if isinstance(value, str | int | float)
        }
        return {
            "age_ms": age_ms,
            "under_way": max(0, min(newest - used, 100_000)) if used >= 0 else 0,
            "stated": settings,
            "share": view.dominance.get(receiver, {}).get(peer, 0.0),
            **counts,
        }


def _describe_alarm(alarm: LifeAlarm) -> Json:
    """Returns an alarm for a page.

    The page has a button for the order, so the advice does not name a shell command.
    """
    advice = alarm.before if alarm.order else alarm.advice
    return {"word": alarm.word, "reason": alarm.reason, "advice": advice, "order": alarm.order}


def show_event(event: Event) -> Json:
    """Returns an event as a page lists it."""
    t_s = None if event.t_ns < 0 else event.t_ns / NS_PER_S
    text = describe_event(event.kind, event.text, event.command)
    return {"t": t_s, "member": event.member, "kind": event.kind, "text": text}
