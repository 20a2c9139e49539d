"""Frames of a session for pages: what never changes, what is now, and the newest points of the
plots.

Invariant: a frame is a function of the records since the frame before; whatever a page misses,
the next is whole. Extremes between two frames are kept. Forces are those ON the arm, N; of
people and of the law by the transpose of the Jacobian, which near a singular pose gives the
least force that explains the torque. A frame as one site knows the session shows of a peer
nothing but its pose at one tick: that of the sample that the site has in use, or to which the
picture of the site's user has come (`SessionView.find_shown`).
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
"""Points of a plot that a new page gets: 40 s."""
ENERGY_EVERY_S = 0.025
COLOURS = 6
"""Of sites, in `page.css`."""
LONGEST_FRAME_S = 0.5
"""A frame looks at no more records than this, s."""
_LEAST_SINGULAR_VALUE = 0.05
"""Forces along directions in which the end effector moves less are not told apart from none,
m/rad.
"""

Json = dict[str, Any]


def _rounded(values: Array, digits: int = 5) -> list[Any]:
    found: list[Any] = np.round(values, digits).tolist()
    return found


class ArmFrames:
    """One arm in frames: its fixed shape, and its pose, ghost and forces in some records."""

    def __init__(self, scenario: Scenario, site: str) -> None:
        self._scenario = scenario
        self._site = site
        self._model = scenario.arms[site]
        self._spec = scenario.sites[site]
        self._walls = list_walls(self._spec)
        self._hand = self._spec.find_live_hand()
        counts = self._model.counts.joints
        limits = np.broadcast_to(
            np.asarray(self._spec.limits.tau_limit_nm, dtype=np.float64), (counts,)
        )
        self._tau_limit = limits
        self._rows = build_arm_rows(scenario, site)

    def describe(self) -> Json:
        """Returns what never changes."""
        chain = self._model.chain
        places = self._scenario.assign_colours(COLOURS)
        start = joint_positions_m(self._model, np.array([self._spec.q0_rad], dtype=np.float64))[
            0
        ]
        reach = float(np.linalg.norm(np.diff(start, axis=0), axis=1).sum())
        return {
            "role": self._spec.role,
            "colour": places[self._scenario.names.index(self._site) % len(places)],
            "rate_hz": self._spec.rate_hz,
            "planar": chain is None,
            "up": None if chain is None else _rounded(upright_axes(chain)),
            "joints": len(self._spec.q0_rad),
            "start": _rounded(start),
            "reach": reach,
            "tau_limit": _rounded(self._tau_limit),
            "bodies": [list(size) for size in self._scenario.bodies_m(self._site).values()],
            "walls": [{"at": list(wall.a), "normal": list(wall.b)} for wall in self._walls],
            "task": self._model.shares_pose,
            "unit": "m" if self._model.shares_pose else "rad",
            "hand": self._describe_hand(),
            "stops": self._spec.on_stale.action == "glide",
            "law": identify_law(self._spec.control),
        }

    def _describe_hand(self) -> Json | None:
        if (hand := self._hand) is None:
            return None
        how = hand.device
        rows = hand.device.rows(self._model.counts.axes)
        device = {"rows": rows, "scale": how.scale, "jump_m_s": how.jump_m_s}
        centre, _, outer_m, *_ = self._model.reach
        reach = {"centre": list(centre), "most": outer_m if outer_m < math.inf else None}
        return {"mode": hand.mode, "limit": hand.actor.limit, "device": device, "reach": reach}

    def pose(self, q: Array) -> Json:
        """Returns the arm at its joints' coordinates q, shape (n,), rad."""
        return {
            "points": _rounded(joint_positions_m(self._model, q[np.newaxis])[0]),
            "q": _rounded(q),
        }

    def at_start(self) -> Json:
        """Returns the arm as a scenario places it: before tick 0."""
        return {
            **self.pose(np.array(self._spec.q0_rad, dtype=np.float64)),
            "tick": -1,
            "bodies": [],
        }

    def now(self, own: AlignedRecords) -> tuple[Json, list[float]]:
        """Returns the arm in the last of some records, and extremes over all: |e|, torque,
        hand, wall.
        """
        split = split_torque(own, self._scenario)
        last = slice(len(own.known) - 1, None)
        hand = self._hand_force(own, split)
        wall = self._wall_force(own, split)
        e = np.linalg.norm(own.e, axis=1)
        tau = np.abs(own.tau)
        if self._model.shares_pose:
            ghost = own.q_des[-1, :3][np.newaxis] / self._spec.task.scale
        else:
            ghost = joint_positions_m(self._model, own.q_des[last])[0]
        now = {
            **self.pose(own.q[-1]),
            "ghost": _rounded(ghost),
            "e": float(e[-1]),
            "tau": _rounded(own.tau[-1], 3),
            "clamped": bool((tau >= self._tau_limit * (1.0 - 1e-12)).any()),
            "hand": _rounded(hand[-1], 3),
            "pull": self._find_pull(own, split),
            "wall": _rounded(wall[-1], 3),
            **self._describe_grip(own, hand[-1]),
        }
        sizes = (np.linalg.norm(force, axis=1).max() for force in (hand, wall))
        return now, [float(e.max()), float(tau.max()), *map(float, sizes)]

    def _describe_grip(self, own: AlignedRecords, force: Array) -> Json:
        if not own.hand.size:
            return {}
        held = HandInForce.read(own.hand[-1].tolist())
        hand = self._hand
        limited = False
        if hand is not None and hand.mode != "joint" and held.source:
            limited = float(np.linalg.norm(force)) >= held.grip * hand.force_limit_n * (
                1.0 - 1e-6
            )
        shown = (
            held.target if hand is not None and hand.mode == "tip" and held.grip > 0.0 else None
        )
        return {
            "grip": held.grip,
            "source": held.source,
            "target": shown,
            "hand_limited": limited,
        }

    def _hand_force(self, own: AlignedRecords, split: TorqueSplit) -> Array:
        """Returns the force of people at the end effector, shape (K, 2) or (K, 3), N."""
        torque = split.operator
        if not self._spec.hands and np.abs(torque).max() < 1e-9 * (
            1.0 + np.abs(own.tau_x).max()
        ):
            return np.zeros_like(split.end_effector.position)
        return split.end_effector.find_force(torque, _LEAST_SINGULAR_VALUE)

    def _find_pull(self, own: AlignedRecords, split: TorqueSplit) -> list[float]:
        """Returns the force with which the law pulls the end effector, which a user feels, at
        the end.

        It is that of the torque beyond what carries the arm; [] if nobody knows the masses.
        """
        if not self._spec.arm.known:
            return []
        last = EndEffectorRows(*(rows[-1:] for rows in split.end_effector))
        torque = own.tau[-1:] - self._rows.gravity_torque(own.q[-1:])
        return _rounded(last.find_force(torque, _LEAST_SINGULAR_VALUE)[0], 3)

    def _wall_force(self, own: AlignedRecords, split: TorqueSplit) -> Array:
        total = np.zeros_like(split.end_effector.position)
        for wall in self._walls:
            force = wall_force(wall, own.nominal_s, split.end_effector)
            total = total + force[:, np.newaxis] * np.array(wall.b)
        return total


class SessionFrames:
    """The frames of one session; `make` is called at the rate of the pages.

    Attributes:
        points: rows of the plots, in the order of `columns`.
        energies: rows of t, s, V and what operator and environment have supplied, J.
    """

    def __init__(self, view: SessionView) -> None:
        self._view = view
        self._arms: dict[str, ArmFrames] = {}
        self._shapes: Json = {}
        self._seen: dict[str, int] = {}
        self.points: Tail[list[float | None]] = Tail(POINTS_KEPT)
        self.energies: Tail[list[float]] = Tail(POINTS_KEPT)
        self._energy_s = -1.0
        self._known: dict[tuple[str, str], Json] = {}
        self._turns: defaultdict[tuple[str, str], BodyTurns] = defaultdict(BodyTurns)

    def describe(self) -> Json:
        """Returns the session as a page needs it once: sites, links, columns of the plots."""
        view = self._view
        scenario = self._view.scenario
        # before it runs: the compiled arms take seconds to load
        if scenario is not None and not self._arms:
            self._arms = {site: ArmFrames(scenario, site) for site in scenario.names}
            self._shapes = {site: arm.describe() for site, arm in self._arms.items()}
        if scenario is None or not view.running:
            here = sorted(view.met)
            sites = (
                []
                if scenario is None
                else [name for name in scenario.names if name not in view.met]
            )
            waiting = {"running": False, "title": "", "here": here, "missing": sites}
            return {"session": view.session, **waiting}
        links = {name: list(name.split("->")) for name in scenario.links}
        return {
            "running": True,
            "session": view.session,
            "name": scenario.name,
            "title": scenario.title or scenario.name,
            "about": scenario.about,
            "duration_s": scenario.duration_s,
            "sites": self._shapes,
            "links": links,
            "shares": {site: scenario.dominance[site] for site in scenario.names},
            "columns": [
                f"{site}.{kind}"
                for site in scenario.names
                for kind in ("e", "tau", "hand", "wall")
            ]
            + [f"{link}.age" for link in scenario.links],
        }

    def make(self) -> Json | None:
        """Returns what is now; None until every site has a record."""
        view = self._view
        if not view.running or any(site.record is None for site in view.sites.values()):
            return None
        if not self._arms:
            self.describe()
        sites = {}
        row = []
        t_s = 0.0
        for name, site in view.sites.items():
            sites[name], extremes = self._site_now(name, site)
            t_s = max(t_s, sites[name]["t"])
            row += extremes
        links = {name: self._link_now(name) for name in view.links}
        row += [link["age_ms"] for link in links.values()]
        if any(site["new"] for site in sites.values()):
            self.points.add(
                [round(t_s, 4), *(None if x is None else float(f"{x:.5g}") for x in row)]
            )
        course = view.advance_energy()
        for t_energy_s, V, supplied in zip(
            *(column.tolist() for column in course or ()), strict=True
        ):
            if t_energy_s >= self._energy_s + ENERGY_EVERY_S - 1e-9:
                self._energy_s = t_energy_s
                self.energies.add([t_energy_s, V, supplied])
        energy = view.energy
        return {
            "t": t_s,
            "sites": sites,
            "links": links,
            "shares": view.dominance,
            "energy": "" if energy is None else energy.reason,
            "ended": view.ended,
            "silent_s": 0.0 if view.ended else round(view.session_silence_s, 1),
            "dropped": sum(view.dropped.values()),
        }

    def describe_narrowed(self) -> Json:
        """Returns the session as a page needs it that shows it as one site knows it."""
        about = self.describe()
        hidden: Json = {"about": "", "links": {}, "shares": {}, "columns": []}
        return {**about, **hidden} if about["running"] else about

    def narrow(self, frame: Json, site: str, *, ages: bool) -> Json:
        """Returns a frame as one site knows the session: its own arm now, its peers as shown to
        its user.

        Args:
            frame: the newest that `make` has returned.
            site: whose knowledge it is.
            ages: true: each peer has the age of what is shown, ms.
        """
        own = frame["sites"][site]
        shown = self._view.find_shown(site, own["tick"], own["used"])
        known = {name: self._find_known(site, name, tick) for name, tick in shown.items()}
        if ages:
            rates = {name: self._view.sites[name].window.rate_hz for name in known}
            for name, peer in known.items():
                age_ms = own["t"] * 1e3 - peer["tick"] * 1e3 / rates[name]
                known[name] = {**peer, "age_ms": age_ms if peer["tick"] >= 0 else None}
        sites = {name: known.get(name, own) for name in frame["sites"]}
        return {
            "t": own["t"],
            "sites": sites,
            "links": {},
            "shares": {},
            "energy": "",
            "ended": frame["ended"],
            "silent_s": own["silent_s"],
        }

    def _find_known(self, site: str, peer: str, tick: int) -> Json:
        """Returns a peer at a tick; while its record is not there, as it was found last."""
        known = self._known.get((site, peer)) or self._arms[peer].at_start()
        other = self._view.sites[peer]
        if tick != known["tick"] and other.window.has_record(tick):
            q = other.window.rows(tick, tick).q[0]
            bodies = _rounded(self._turns[site, peer].align(other.bodies.get(tick, [])))
            known = {**self._arms[peer].pose(q), "tick": tick, "bodies": bodies}
        self._known[site, peer] = known
        return known

    def _site_now(self, name: str, site: SiteView) -> tuple[Json, list[float]]:
        window = site.window
        record = site.record
        stats = site.stats
        assert record is not None
        newest = max(window.newest, 0)
        longest = round(LONGEST_FRAME_S * window.rate_hz)
        seen = self._seen.get(name, -1)
        first = max(min(seen + 1, newest), newest - longest, window.first)
        now, extremes = self._arms[name].now(window.rows(first, newest))
        self._seen[name] = newest
        account = site.reception.accounts["state"]
        alarm = None if self._view.ended else site.find_alarm(self._view.session, name)
        return {
            **now,
            "new": newest > seen,
            "t": record.t_ns / NS_PER_S,
            "tick": record.tick,
            "used": record.used,
            "mode": record.mode,
            "bodies": _rounded(self._turns["", name].align(record.bodies)),
            "alarm": None if alarm is None else _show_alarm(alarm),
            "ended": site.ended or self._view.ended,
            "silent_s": 0.0 if self._view.ended else round(self._view.silence_s(site), 1),
            "holder": site.holder if now.get("source") else "",
            "late_us": stats.late_max_us if stats else 0,
            "overruns": stats.overruns if stats else 0,
            "missing": account.missing if site.holds_from == 0 else 0,
        }, extremes

    def _link_now(self, name: str) -> Json:
        view = self._view
        peer, _, receiver = name.partition("->")
        own = view.sites[receiver]
        other = view.sites[peer]
        record = own.record
        stats = own.stats
        table = view.links[name]
        used = -1 if record is None else record.used.get(peer, -1)
        rate_hz = other.window.rate_hz
        age_ms = None
        if record is not None and used >= 0:
            age_ms = record.t_ns / 1e6 - used * 1e3 / rate_hz
        newest = other.record.tick if other.record else used
        shown = ("delay_us", -1), ("accepted", 0), ("late", 0), ("lost", 0)
        counts = (
            {}
            if stats is None
            else {key: getattr(stats, key).get(peer, none) for key, none in shown}
        )
        return {
            "age_ms": age_ms,
            "under_way": max(0, min(newest - used, 100_000)) if used >= 0 else 0,
            "stated": {
                key: value
                for key, value in table.items()
                if isinstance(value, str | int | float)
            },
            "share": view.dominance.get(receiver, {}).get(peer, 0.0),
            **counts,
        }


def _show_alarm(alarm: LifeAlarm) -> Json:
    """Returns an alarm for a page, whose button gives the order: no page shows a command of a
    shell.
    """
    advice = alarm.before if alarm.order else alarm.advice
    return {"word": alarm.word, "reason": alarm.reason, "advice": advice, "order": alarm.order}


def show_event(event: Event) -> Json:
    """Returns an event as a page lists it."""
    t_s = None if event.t_ns < 0 else event.t_ns / NS_PER_S
    text = describe_event(event.kind, event.text, event.command)
    return {"t": t_s, "member": event.member, "kind": event.kind, "text": text}
