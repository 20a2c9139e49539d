"""Composes the JSON messages from which the web pages of a running session are drawn.

A page first receives the constants of the session, such as the shapes of the arms, and then
about 30 frames per second. A frame is a message with the current state of each arm and network
link, and with new points for the plots.

Invariant:
    - A frame is computed from the records since the previous frame, but describes the complete
      state, so a page may miss frames.
    - The plots show the extremes of the records between two frames, so that short peaks are
      visible.
    - Forces act on the arm and are in N. The forces of people and of the control law are
      computed from their torques: torque = J^T force, where J is the Jacobian of the end
      effector. Near a singular pose, the smallest force that explains the torque is used.
    - The frame for the user of one site shows every other arm as that user sees it: with the
      delay of the network, and with the additional delay of the picture if the scenario has one
      (`SessionView.find_peer_ticks`). It contains no newer pose of these arms.
"""

import math
from collections import defaultdict
from typing import Any

import numpy as np

from trilat_net.analysis import AlignedRecords, TorqueSplit, VirtualWall, build_arm_rows
from trilat_net.core import Array, HandInForce, LifeAlarm
from trilat_net.net import Event
from trilat_net.presentation import describe_energy_obstacle
from trilat_net.records import NS_PER_S
from trilat_net.scenario import Change, Scenario

from .body_turns import BodyTurns
from .session_view import SessionView, SiteView, Tail

POINTS_KEPT = 1200
"""Number of points of a plot sent to a new page, equivalent to 40 s."""
ENERGY_PERIOD_S = 0.025
"""Minimum time between two points of the energy plot, in s."""
COLOURS = 6
"""Number of colours for sites in `theme.css`."""
MAX_FRAME_S = 0.5
"""Longest interval whose records are evaluated for a frame, in s."""
_MIN_SINGULAR_SHARE = 0.05
"""Smallest singular value of the Jacobian that is inverted, relative to the largest.

Along directions in which the end effector moves less, the force is taken as zero.
"""

Json = dict[str, Any]
"""A JSON object."""


def _round(values: Array, digits: int = 5) -> list[Any]:
    """Converts an array to nested lists of rounded numbers, to keep the JSON short."""
    rounded: list[Any] = np.round(values, digits).tolist()
    return rounded


class _ArmFrames:
    """Composes the parts of page messages that describe one arm: shape, pose, forces.

    Args:
        scenario: Scenario of the session.
        site: Name of the site of the arm.
    """

    def __init__(self, scenario: Scenario, site: str) -> None:
        self._scenario = scenario
        self._site = site
        self._model = scenario.arms[site]
        self._spec = scenario.sites[site]
        self._walls = VirtualWall.list_of_site(scenario, site)
        self._hand = self._spec.find_live_hand()
        limits_nm = np.asarray(self._spec.limits.tau_limit_nm, dtype=np.float64)
        joint_count = self._model.counts.joints
        self._tau_limit = np.broadcast_to(limits_nm, (joint_count,))
        self._rows = build_arm_rows(scenario, site)

    def describe(self) -> Json:
        """Describes the constant properties of an arm for the web pages that draw it.

        Returns:
            Role, colour, joints, walls, limits and further constants of the arm, as
            JSON-compatible values.
        """
        model = self._model
        settings = self._spec
        colours = self._scenario.assign_colours(COLOURS)
        site_number = self._scenario.names.index(self._site)
        colour = colours[site_number % len(colours)]
        up_axes = self._rows.upright_axes
        up = None if up_axes is None else _round(up_axes)

        q0 = np.array([settings.q0_rad], dtype=np.float64)
        start_m = self._rows.joint_positions_m(q0)[0]
        link_vectors_m = np.diff(start_m, axis=0)
        link_lengths_m = np.linalg.norm(link_vectors_m, axis=1)
        reach_m = float(link_lengths_m.sum())  # of the stretched arm

        body_sizes_m = self._scenario.bodies_m(self._site).values()
        walls: list[Json] = []
        for wall in self._walls:
            point_m = list(wall.source.a)
            normal = list(wall.source.b)
            walls.append({"at": point_m, "normal": normal})

        return {
            "role": settings.role,
            "colour": colour,
            "rate_hz": settings.rate_hz,
            "planar": model.chain is None,
            "up": up,
            "joints": len(settings.q0_rad),
            "start": _round(start_m),
            "reach": reach_m,
            "tau_limit": _round(self._tau_limit),
            "bodies": [list(size) for size in body_sizes_m],
            "walls": walls,
            "task": model.shares_pose,
            "unit": "m" if model.shares_pose else "rad",
            "hand": self._describe_hand(),
            "stops": settings.on_stale.action == "glide",
            "law": settings.law_name,
        }

    def _describe_hand(self) -> Json | None:
        """Describes how people can hold the arm: by force or position, and within which limits.

        `None` if the scenario does not let people hold this arm.
        """
        hand = self._hand
        if hand is None:
            return None

        device = hand.device
        axis_count = self._model.counts.axes
        centre, _, outer_m, *_ = self._model.reach
        # JSON has no infinity.
        longest_m = outer_m if outer_m < math.inf else None
        return {
            "mode": hand.mode,
            "limit": hand.actor.limit,
            "device": {
                "rows": device.rows(axis_count),
                "scale": device.scale,
                "jump_m_s": device.jump_m_s,
            },
            "reach": {
                "centre": list(centre),
                "most": longest_m,
            },
        }

    def describe_pose(self, q: Array) -> Json:
        """Computes the end points of the arm's links for the web pages that draw the arm.

        Args:
            q: Joint positions, in rad or m, shape (n,).

        Returns:
            The end points of the links in m and the joint positions, as JSON-compatible values.
        """
        rows = q[np.newaxis]
        points_m = self._rows.joint_positions_m(rows)[0]
        return {
            "points": _round(points_m),
            "q": _round(q),
        }

    def describe_start(self) -> Json:
        """Computes the end points of the arm's links before the first control period.

        Returns:
            The pose in the format of `describe_pose`, with tick -1 and an empty list for the
            bodies that the arm can touch.
        """
        q0 = np.array(self._spec.q0_rad, dtype=np.float64)
        pose = self.describe_pose(q0)
        return {
            **pose,
            "tick": -1,
            "bodies": [],
        }

    def describe_now(self, records: AlignedRecords) -> tuple[Json, list[float]]:
        """Describes the current state of the arm and the peaks since the previous frame.

        The largest values are plotted, so that peaks between two frames are visible.

        Args:
            records: Records since the previous frame, the last of which is the current one.

        Returns:
            The current state as JSON-compatible values, and the largest values of four
            quantities: the norm of the synchronisation error, the torque of a joint in N m, the
            force of people in N, and the force of the walls in N.
        """
        split = TorqueSplit.of_records(records, self._scenario)
        hand_force = self._compute_hand_force(records, split)
        wall_force_n = self._compute_wall_force(records, split)

        error_norm = np.linalg.norm(records.e, axis=1)
        torque_size = np.abs(records.tau)
        full_torque = self._tau_limit * (1.0 - 1e-12)
        is_at_limit = torque_size >= full_torque

        present_pose = self.describe_pose(records.q[-1])
        reference_m = self._place_reference(records)
        present_torque = records.tau[-1]
        present_hand_force = hand_force[-1]
        present_grip = self._describe_grip(records, present_hand_force)
        state = {
            **present_pose,
            "ghost": _round(reference_m),
            "e": float(error_norm[-1]),
            "tau": _round(present_torque, 3),
            "clamped": bool(is_at_limit.any()),
            "hand": _round(present_hand_force, 3),
            "pull": self._compute_pull(records, split),
            "wall": _round(wall_force_n[-1], 3),
            **present_grip,
        }

        hand_force_size = np.linalg.norm(hand_force, axis=1)
        wall_force_size = np.linalg.norm(wall_force_n, axis=1)
        extremes = [
            float(error_norm.max()),
            float(torque_size.max()),
            float(hand_force_size.max()),
            float(wall_force_size.max()),
        ]
        return state, extremes

    def _place_reference(self, records: AlignedRecords) -> Array:
        """Returns the position of the arm's reference, so that a page can draw it.

        The reference `q_des`, which the control law makes the arm follow, consists of joint
        positions, or of an end effector pose if the sites exchange poses. A pose begins with
        the position x, y, z, multiplied by the scale of the site's task.

        Args:
            records: Records since the previous frame. The reference in the last record is used.

        Returns:
            Points in m: for joint positions, the end points of the links of an arm in the
            reference pose; for an end effector pose, a single point, shape (1, 3).
        """
        points_m: Array
        if self._model.shares_pose:
            scaled_position = records.q_des[-1, :3]
            points_m = scaled_position[np.newaxis] / self._spec.task.scale
        else:
            last_row = len(records.known) - 1  # `known` has one entry per record
            last_reference = records.q_des[last_row:]  # shape (1, n), in rad or m
            points_m = self._rows.joint_positions_m(last_reference)[0]
        return points_m

    def _describe_grip(self, records: AlignedRecords, force: Array) -> Json:
        """Describes who currently holds the arm, how firmly, and the target of the arm.

        Empty if nobody can hold the arm.

        Args:
            records: Records since the previous frame.
            force: Force of people in the last record, in N.
        """
        if not records.hand.size:
            return {}

        last_values = records.hand[-1].tolist()
        grip = HandInForce.read(last_values)
        hand = self._hand

        is_limited = False
        if hand is not None and hand.mode != "joint" and grip.source:
            force_size_n = float(np.linalg.norm(force))
            limit_n = grip.grip * hand.force_limit_n
            is_limited = force_size_n >= limit_n * (1.0 - 1e-6)  # up to rounding

        pulls_tip = hand is not None and hand.mode == "tip"
        has_target = pulls_tip and grip.grip > 0.0
        target = grip.target if has_target else None
        return {
            "grip": grip.grip,
            "source": grip.source,
            "target": target,
            "hand_limited": is_limited,
        }

    def _compute_hand_force(self, records: AlignedRecords, split: TorqueSplit) -> Array:
        """Computes the force of people at the end effector, in N, shape (K, 2) or (K, 3).

        Zero for an arm that nobody can hold, where a tiny torque is only a rounding error.

        Args:
            records: K records of the site.
            split: Components of the external torque in these records.
        """
        torque = split.operator
        if not self._spec.hands:
            # Without a hand in the scenario, a tiny torque is a rounding error of the split.
            largest_external_nm = np.abs(records.tau_x).max()
            rounding_nm = 1e-9 * (1.0 + largest_external_nm)
            largest_torque_nm = np.abs(torque).max()
            if largest_torque_nm < rounding_nm:
                return np.zeros_like(split.end_effector.position)
        return split.end_effector.find_force(torque, _MIN_SINGULAR_SHARE)

    def _compute_pull(self, records: AlignedRecords, split: TorqueSplit) -> list[float]:
        """Computes the force of the remote arms that a user currently feels, in N.

        Derived from the torque of the control law, excluding gravity compensation.

        Returns:
            The components of the force. Empty if the masses of the arm are unknown.
        """
        if not self._spec.arm.known:
            return []

        last_q = records.q[-1:]

        gravity_torque = self._rows.gravity_torque(last_q)
        law_torque = records.tau[-1:] - gravity_torque
        forces = split.end_effector.last.find_force(law_torque, _MIN_SINGULAR_SHARE)
        last_force = forces[0]
        return _round(last_force, 3)

    def _compute_wall_force(self, records: AlignedRecords, split: TorqueSplit) -> Array:
        """Computes the force of all walls on the end effector, in N, shape (K, 2) or (K, 3).

        Args:
            records: K records of the site.
            split: Components of the external torque in these records, with the end effector.
        """
        total = np.zeros_like(split.end_effector.position)
        for wall in self._walls:
            size_n = wall.find_force(records.nominal_s, split.end_effector)
            total = total + size_n[:, np.newaxis] * wall.normal
        return total


class SessionFrames:
    """Composes the messages from which web pages draw a running session.

    About 30 times per second, a page receives a frame: a message with the current state of all
    arms and network links.

    Args:
        view: Current state of the session.

    Attributes:
        points: Points of the plots over time. Each point is a list of values, whose names are
            given by `describe`.
        energies: Points of the energy plot: time in s, energy function V of the stability proof
            in J, and energy supplied by people and walls in J. V must not increase by more than
            the supplied energy.
    """

    def __init__(self, view: SessionView) -> None:
        self._view = view
        self._arms: dict[str, _ArmFrames] = {}
        self._arm_constants: Json = {}
        # The newest tick of each site in the previous frame.
        self._last_ticks: dict[str, int] = {}
        self.points: Tail[list[float | None]] = Tail(POINTS_KEPT)
        self.energies: Tail[list[float]] = Tail(POINTS_KEPT)
        self._energy_s = -1.0
        # Poses in which users see other arms, and signs of the quaternions of touched bodies.
        # The keys are the user's site and the arm's site. For a page that shows all arms, the
        # user is "".
        self._peer_poses: dict[tuple[str, str], Json] = {}
        self._turns: defaultdict[tuple[str, str], BodyTurns] = defaultdict(BodyTurns)

    def describe(self) -> Json:
        """Describes the constants of a session for the web pages that draw it.

        Returns:
            The sites, the links and the names of the plotted values, as JSON-compatible values.
            Before the session runs, the members that are present and those that are missing.
        """
        view = self._view
        scenario = view.scenario
        # Prepared before the session runs, because loading the compiled arms takes seconds.
        if scenario is not None and not self._arms:
            arms: dict[str, _ArmFrames] = {}
            for site in scenario.names:
                arms[site] = _ArmFrames(scenario, site)
            self._arms = arms
            for site, arm in self._arms.items():
                self._arm_constants[site] = arm.describe()

        if scenario is None or not view.running:
            return self._describe_waiting(scenario)

        columns: list[str] = []
        for site in scenario.names:
            columns += [f"{site}.{kind}" for kind in ("e", "tau", "hand", "wall")]
        columns += [f"{link}.age" for link in scenario.links]

        link_ends: dict[str, list[str]] = {}
        for link in scenario.links:
            link_ends[link] = link.split("->")
        shares: Json = {}
        for site in scenario.names:
            shares[site] = scenario.dominance[site]

        return {
            "running": True,
            "session": view.session,
            "name": scenario.name,
            "title": scenario.title or scenario.name,
            "about": scenario.about,
            "duration_s": scenario.duration_s,
            "sites": self._arm_constants,
            "links": link_ends,
            "shares": shares,
            "columns": columns,
        }

    def list_events(self, first: int, most: int) -> list[Json]:
        """Returns events of the session, such as a lost connection, for the list on a page.

        Args:
            first: Number of the first event to return.
            most: Maximum number of events to return.
        """
        return [_render_event(event) for event in self._view.events.since(first, most)]

    def _describe_waiting(self, scenario: Scenario | None) -> Json:
        """Describes for a page which members a session that has not started is waiting for.

        Args:
            scenario: Scenario of the session, or `None` until a member has sent it.
        """
        members = self._view.members
        names = [] if scenario is None else scenario.names
        missing_names = [name for name in names if name not in members]
        return {
            "session": self._view.session,
            "running": False,
            "title": "",
            "here": sorted(members),
            "missing": missing_names,
        }

    def make_frame(self) -> Json | None:
        """Composes the frame that shows the current state of all arms.

        Covers all records since the previous frame. New points are also added to the plots
        `points` and `energies`.

        Returns:
            The current state of all arms and links as JSON-compatible values, or `None` until
            every site has published a record.
        """
        view = self._view
        has_all_records = all(site.record is not None for site in view.sites.values())
        if not view.running or not has_all_records:
            return None

        if not self._arms:
            self.describe()

        sites: Json = {}
        point: list[float | None] = []
        t_s = 0.0
        for name, site in view.sites.items():
            sites[name], extremes = self._describe_site(name, site)
            t_s = max(t_s, sites[name]["t"])
            point += extremes

        links = {name: self._describe_link(name) for name in view.links}
        point += [link["age_ms"] for link in links.values()]
        has_new_records = any(site["new"] for site in sites.values())
        if has_new_records:
            self._add_point(t_s, point)
        self._add_energies()

        energy_problem = ""
        if view.energy is not None:
            energy_problem = describe_energy_obstacle(view.energy)
        silence_s = 0.0
        if not view.ended:
            silence_s = round(view.session_silence_s, 1)

        return {
            "t": t_s,
            "sites": sites,
            "links": links,
            "shares": view.dominance,
            "energy": energy_problem,
            "ended": view.ended,
            "silent_s": silence_s,
            "dropped": sum(view.dropped.values()),
        }

    def _add_point(self, t_s: float, values: list[float | None]) -> None:
        """Adds a point to the plots, with five digits per value.

        Args:
            t_s: Time of the point, in s.
            values: Value of each curve: the extremes of each site, followed by the age of each
                link's samples in ms. `None` leaves a gap.
        """
        point: list[float | None] = [round(t_s, 4)]
        for value in values:
            rounded = None if value is None else float(f"{value:.5g}")
            point.append(rounded)
        self.points.add(point)

    def _add_energies(self) -> None:
        """Adds new values of the stored and supplied energy to the plot.

        There is one value per complete control period, of which at most one per
        `ENERGY_PERIOD_S` becomes a point.
        """
        energy = self._view.energy
        if energy is None:
            return
        new_energies = energy.compute_next(self._view.complete_ticks)
        if new_energies is None:
            return

        columns = [column.tolist() for column in new_energies]
        for t_s, V, supplied in zip(*columns, strict=True):
            next_point_s = self._energy_s + ENERGY_PERIOD_S
            is_due = t_s >= next_point_s - 1e-9  # up to rounding
            if is_due:
                self._energy_s = t_s
                self.energies.add([t_s, V, supplied])

    def describe_session_as_user(self) -> Json:
        """Describes the constants of the session for the page of a participant.

        Same as `describe`, but excludes the settings of links and the dominance factors, which
        could reveal the condition of an experiment.
        """
        constants = self.describe()
        if not constants["running"]:
            return constants

        hidden: Json = {
            "about": "",
            "links": {},
            "shares": {},
            "columns": [],
        }
        return {**constants, **hidden}

    def describe_as(self, frame: Json, site: str, *, ages: bool) -> Json:
        """Derives the frame for the user of one arm from the frame that shows all arms.

        The user sees the other arms with their delay, in the poses last known to the user's
        site.

        Args:
            frame: Newest frame returned by `make_frame`. Not modified.
            site: Name of the user's site.
            ages: True to include the age of the pose of each other arm, in ms.

        Returns:
            The frame for this user.
        """
        user_site_state = frame["sites"][site]
        ticks = self._view.find_peer_ticks(
            site, user_site_state["tick"], user_site_state["used"]
        )

        sites: Json = {}
        for name in frame["sites"]:
            if name not in ticks:
                sites[name] = user_site_state
                continue
            peer = self._describe_peer(site, name, ticks[name])
            if ages:
                age_ms = self._compute_age_ms(name, peer["tick"], user_site_state["t"])
                peer = {**peer, "age_ms": age_ms}
            sites[name] = peer

        return {
            "t": user_site_state["t"],
            "sites": sites,
            "links": {},
            "shares": {},
            "energy": "",
            "ended": frame["ended"],
            "silent_s": user_site_state["silent_s"],
        }

    def _compute_age_ms(self, site: str, tick: int, t_s: float) -> float | None:
        """Returns the age of the displayed pose of an arm at a given time, in ms.

        The age shows users the delay of a remote arm.

        Args:
            site: Name of the site.
            tick: Tick of the record, or -1 before the first record.
            t_s: The time, in s.

        Returns:
            The age, or `None` before the first record.
        """
        if tick < 0:
            return None
        rate_hz = self._view.sites[site].window.rate_hz
        record_ms = tick * 1e3 / rate_hz
        age_ms: float = t_s * 1e3 - record_ms
        return age_ms

    def _describe_peer(self, site: str, peer: str, tick: int) -> Json:
        """Returns the pose in which the user of a site sees the arm of a peer.

        If the record of a tick is missing, the user sees the pose of the previous frame again,
        so each pose is stored for the next frame. Since delays differ between users, a pose is
        stored per site and peer.

        Args:
            site: Name of the user's site.
            peer: Name of the site whose arm is described.
            tick: Tick of the peer that the user sees.

        Returns:
            The pose in the format of `_ArmFrames.describe_pose`, its tick, and the poses of the
            bodies that the arm can touch. Before the first record, the start pose.
        """
        arm = self._arms[peer]
        pose = self._peer_poses.get((site, peer)) or arm.describe_start()
        peer_view = self._view.sites[peer]
        if tick != pose["tick"] and peer_view.window.has_record(tick):
            records_of_tick = peer_view.window.rows(tick, tick)  # exactly one record
            joint_pose = arm.describe_pose(records_of_tick.q[0])
            body_poses = peer_view.bodies.get(tick, [])
            # Chooses the signs of the bodies' quaternions, so that the picture does not jump.
            aligned_bodies = self._turns[site, peer].align(body_poses)
            pose = {
                **joint_pose,
                "tick": tick,
                "bodies": _round(aligned_bodies),
            }
        self._peer_poses[site, peer] = pose
        return pose

    def _describe_site(self, name: str, site: SiteView) -> tuple[Json, list[float]]:
        """Describes the current state of one site for web pages.

        Args:
            name: Name of the site.
            site: View of the site, which must have published a record.

        Returns:
            The state as JSON-compatible values, with the fields of `_ArmFrames.describe_now`
            and those that are explained below; and the four largest values since the previous
            frame, as returned by `_ArmFrames.describe_now`.
        """
        record = site.record
        stats = site.stats
        assert record is not None
        state, extremes, has_new_records = self._describe_new_records(name, site)

        has_ended = self._view.ended
        alarm = None
        silence_s = 0.0
        if not has_ended:
            alarm = site.find_alarm(self._view.session, name)
            silence_s = round(self._view.silence_s(site), 1)

        # Chooses the signs of the bodies' quaternions, so that the picture does not jump. The
        # empty name stands for a page that sees all arms.
        bodies = self._turns["", name].align(record.bodies)

        # A view that joined late does not know how many earlier records are missing.
        missing_count = 0
        has_seen_all = site.first_tick == 0
        if has_seen_all:
            state_account = site.repair.reception.accounts["state"]
            missing_count = state_account.missing
        # The source is the number of the program that holds the arm at present, or 0.
        is_held = bool(state.get("source"))
        fields = {
            **state,
            # Whether records have arrived since the previous frame.
            "new": has_new_records,
            # Time in s and tick of the newest record.
            "t": record.t_ns / NS_PER_S,
            "tick": record.tick,
            # For each peer, the tick of the sample that the control law used.
            "used": record.used,
            # The mode of the site, for example "fault".
            "mode": record.mode,
            # Poses of the bodies that the arm can touch: seven numbers per body.
            "bodies": _round(bodies),
            "alarm": None if alarm is None else _describe_alarm(alarm),
            "ended": site.ended or has_ended,
            # Time without a message of the site, in s.
            "silent_s": silence_s,
            # Person or program that holds the arm. Empty if nobody does.
            "holder": site.holder if is_held else "",
            # Largest lateness of a tick in us, and number of ticks that were a period late.
            "late_us": stats.late_max_us if stats else 0,
            "overruns": stats.overruns if stats else 0,
            # Number of records that have not arrived.
            "missing": missing_count,
        }
        return fields, extremes

    def _describe_new_records(
        self, name: str, site: SiteView
    ) -> tuple[Json, list[float], bool]:
        """Describes the newest state of an arm, with the extremes since the last description.

        If there are no new records, the newest one is evaluated again.

        Returns:
            The state of the arm, the extremes, and True if there are new records.
        """
        window = site.window
        newest_tick = max(window.newest, 0)
        previous_tick = self._last_ticks.get(name, -1)
        self._last_ticks[name] = newest_tick
        # After a pause, only the last `MAX_FRAME_S` are evaluated, because a frame must be
        # computed fast.
        most_ticks = round(MAX_FRAME_S * window.rate_hz)
        earliest_tick = newest_tick - most_ticks
        next_tick = min(previous_tick + 1, newest_tick)
        first_tick = max(next_tick, earliest_tick, window.first)

        records = window.rows(first_tick, newest_tick)
        state, extremes = self._arms[name].describe_now(records)
        has_new_records = newest_tick > previous_tick
        return state, extremes, has_new_records

    def _describe_link(self, name: str) -> Json:
        """Returns the current state of a link: age of samples in use, settings and counts.

        Args:
            name: Name of the link, for example "m1->s".

        Returns:
            Plain values. The age is `None` until the first sample is used.
        """
        view = self._view
        peer, _, receiver = name.partition("->")
        receiving = view.sites[receiver]
        sending = view.sites[peer]
        record = receiving.record
        used_tick = -1
        age_ms = None
        if record is not None:
            used_tick = record.used.get(peer, -1)
            if used_tick >= 0:
                used_ms = used_tick * 1e3 / sending.window.rate_hz
                age_ms = record.t_ns / 1e6 - used_ms

        newest_tick = used_tick
        if sending.record:
            newest_tick = sending.record.tick
        samples_under_way = 0
        if used_tick >= 0:
            newer_samples = min(newest_tick - used_tick, 100_000)
            samples_under_way = max(0, newer_samples)

        stated_settings: Json = {}
        for key, value in view.links[name].items():
            if isinstance(value, str | int | float):
                stated_settings[key] = value

        shares = view.dominance.get(receiver, {})
        sample_counts = _count_samples(receiving, peer)
        return {
            "age_ms": age_ms,
            "under_way": samples_under_way,
            "stated": stated_settings,
            "share": shares.get(peer, 0.0),
            **sample_counts,
        }


def _count_samples(receiving: SiteView, peer: str) -> Json:
    """Returns the number of a peer's samples that have arrived at a site, and their delay.

    Args:
        receiving: View of the receiving site, whose statistics contain the counts.
        peer: Name of the peer.

    Returns:
        Delay in us, and number of accepted, late and lost samples. Empty before the first
        statistics.
    """
    stats = receiving.stats
    if stats is None:
        return {}
    return {
        "delay_us": stats.delay_us.get(peer, -1),
        "accepted": stats.accepted.get(peer, 0),
        "late": stats.late.get(peer, 0),
        "lost": stats.lost.get(peer, 0),
    }


def _describe_alarm(alarm: LifeAlarm) -> Json:
    """Returns an alarm, for example about a stopped arm, in the format of a web page.

    The page has a button for the command that clears the alarm, so the advice does not mention
    a shell command.
    """
    advice = alarm.before if alarm.order else alarm.advice
    return {
        "word": alarm.word,
        "reason": alarm.reason,
        "advice": advice,
        "order": alarm.order,
    }


def _render_event(event: Event) -> Json:
    """Formats an event of the session, such as a lost connection, for the list on a page.

    Args:
        event: The event.

    Returns:
        The parts of its line, as JSON-compatible values.
    """
    t_s = None if event.t_ns < 0 else event.t_ns / NS_PER_S
    text = Change.describe_event(event.kind, event.text, event.command)
    return {
        "t": t_s,
        "member": event.member,
        "kind": event.kind,
        "text": text,
    }
