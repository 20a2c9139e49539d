"""Linear loops whose growth is computed tick by tick with NumPy alone.

`SampledLoop` describes sites under P+d. It writes the scenario of the loop, and it computes the
rates at which the motions of the loop grow, without any code of the program: the ticks of one
period of the delays are executed for every initial state, and the eigenvalues of the resulting
matrix are the factors by which the motions grow in one period.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from trilat_net.core.step.vectors import Array
from trilat_net.scenario import Scenario, parse_scenario

from ..unit_arm import ARM as UNIT_ARM

_US_PER_S = 1_000_000
UNIT_INERTIA = ((5 / 6, 1 / 3), (1 / 3, 1 / 3))
"""Inertia of the unit arm of two links, which is the same in all poses, in kg m^2."""


class Delay(NamedTuple):
    """Delay of a link as a function of the time at which a sample is sent.

    Attributes:
        points: Times from which a delay applies, and the delay, in us. The delays of a sinusoid
            are computed instead, so that it has no points.
        period_us: Time after which the delay repeats, in us. None if the delay is constant.
        sine_us: Mean and amplitude of a sinusoid, in us. None for other delays.
        phase_rad: Phase of the sinusoid, in rad.
    """

    points: tuple[tuple[int, int], ...] = ()
    period_us: int | None = None
    sine_us: tuple[int, int] | None = None
    phase_rad: float = 0.0

    def table(self) -> dict[str, Any]:
        """Returns the link as a scenario states it."""
        if self.sine_us is not None:
            assert self.period_us is not None
            mean_us, amplitude_us = self.sine_us
            return {
                "model": "sine",
                "delay_ms": 1e-3 * mean_us,
                "amplitude_ms": 1e-3 * amplitude_us,
                "period_s": self.period_us / _US_PER_S,
                "phase_rad": self.phase_rad,
            }
        if self.period_us is None:
            return {"model": "constant", "delay_ms": 1e-3 * self.points[0][1]}
        # The last point of a trace lasts as long as the point before it.
        last = self.points[-1]
        rest_us = self.period_us - last[0]
        middle = (last[0] + rest_us // 2, last[1])
        points = [*self.points, middle]
        text = ", ".join(f"{t_us} {delay_us}" for t_us, delay_us in points)
        return {"model": "trace", "trace": text, "at_end": "loop"}

    def find_us(self, sent_us: Array) -> Array:
        """Computes the delays of samples, in us.

        Args:
            sent_us: Times at which the samples are sent, in us.
        """
        if self.sine_us is not None:
            assert self.period_us is not None
            mean_us, amplitude_us = self.sine_us
            angle = 2.0 * np.pi * sent_us / self.period_us + self.phase_rad
            return np.floor(mean_us + amplitude_us * np.sin(angle) + 0.5).astype(int)
        starts_us, delays_us = np.array(self.points).T
        phase_us = sent_us if self.period_us is None else sent_us % self.period_us
        rows = np.searchsorted(starts_us, phase_us, side="right") - 1
        return delays_us[np.maximum(rows, 0)]


def make_constant_delay(delay_ms: float) -> Delay:
    """Returns a constant delay."""
    return Delay(points=((0, round(1e3 * delay_ms)),))


def make_sine_delay(
    mean_ms: float, amplitude_ms: float, period_s: float, phase_rad: float = 0.0
) -> Delay:
    """Returns a delay that follows a sinusoid."""
    return Delay(
        period_us=round(_US_PER_S * period_s),
        sine_us=(round(1e3 * mean_ms), round(1e3 * amplitude_ms)),
        phase_rad=phase_rad,
    )


def make_burst_delay(usual_ms: float, late_ms: float, from_s: float, period_s: float) -> Delay:
    """Returns a looped trace with one delay, and a longer delay at the end of each period.

    Args:
        usual_ms: Delay at the start of a period, in ms.
        late_ms: Delay in the rest of the period, in ms.
        from_s: Time in a period from which the longer delay applies, in s.
        period_s: Period of the trace, in s.
    """
    points = ((0, round(1e3 * usual_ms)), (round(_US_PER_S * from_s), round(1e3 * late_ms)))
    return Delay(points=points, period_us=round(_US_PER_S * period_s))


class SampledLoop(NamedTuple):
    """Sites that follow each other under P+d, with the same ticks.

    The sites are called a, b, c and so on; the last one is the slave.

    Attributes:
        shares: Dominance factors of each site, shape (N, N); rows sum to 1.
        delays: Delay of each link, or one delay of all. A key is (receiver, sender).
        K: Stiffness of each site, or of each joint of all sites, in N m/rad.
        d: Damping in the same form, in N m s/rad.
        masses: Masses of the joints of each site, which slide along x, y and z, in kg. The unit
            arm of two links if empty.
        rate_hz: Ticks per second. It divides one million.
        scheme: "second_order" or "digital".
    """

    shares: Sequence[Sequence[float]]
    delays: Delay | Mapping[tuple[int, int], Delay]
    K: Any
    d: Any
    masses: Sequence[float] = ()
    rate_hz: int = 200
    scheme: str = "second_order"

    @property
    def names(self) -> str:
        """Names of the sites, one letter each."""
        return "abcdef"[: len(self.shares)]

    @property
    def inertia(self) -> Array:
        """Inertia of the arm of every site, shape (n, n), in kg m^2 or kg."""
        if not self.masses:
            return np.array(UNIT_INERTIA)
        # A joint moves its own link and all links after it.
        return np.diag(np.cumsum(self.masses[::-1])[::-1])

    def find_delay(self, receiver: int, sender: int) -> Delay:
        """Returns the delay of a link between two sites."""
        if isinstance(self.delays, Delay):
            return self.delays
        return self.delays[receiver, sender]

    def list_links(self) -> list[tuple[int, int]]:
        """Returns the links that are in use, as (receiver, sender)."""
        count = len(self.shares)
        return [(i, j) for i in range(count) for j in range(count) if self.shares[i][j]]

    def write_scenario(
        self,
        duration_s: float,
        apart_rad: float = 0.02,
        law: Mapping[str, Any] | None = None,
        **more: Any,
    ) -> Scenario:
        """Returns the scenario of a run of the loop.

        Args:
            duration_s: Duration of the run, in s.
            apart_rad: Distance of the start poses of two successive sites, in rad.
            law: Keys of the control law beside the gains. P+d by default.
            more: Further keys of the scenario, by dotted name.
        """
        joints = len(self.inertia)
        gains = {"K": _spread(self.K, len(self.shares)), "d": _spread(self.d, len(self.shares))}
        changes: dict[str, Any] = {
            "rate_hz": self.rate_hz,
            "scheme": self.scheme,
            "duration_s": duration_s,
            "arm": UNIT_ARM,
            "limits": {"tau_limit_nm": 1e6, "qd_limit_rad_s": 1e3},
        }
        if self.masses:
            changes["arm"] = {"urdf": "sliders.urdf", "stops": False}
            changes["urdf"] = {"sliders.urdf": write_sliders(self.masses)}
        lines = []
        for i, name in enumerate(self.names):
            role = "slave" if i == len(self.shares) - 1 else "master"
            lines += [f"[sites.{name}]", f'role = "{role}"']
            changes[f"sites.{name}.q0_rad"] = [round(0.1 + apart_rad * i, 9)] * joints
            control = {"law": "p_d", **(law or {})}
            control |= {key: value[i] for key, value in gains.items()}
            changes[f"sites.{name}.control"] = control
        lines.append("[dominance]")
        for i, name in enumerate(self.names):
            row = {self.names[j]: self.shares[i][j] for k, j in self.list_links() if k == i}
            cells = ", ".join(f"{peer} = {share!r}" for peer, share in row.items())
            lines.append(f"{name} = {{ {cells} }}")
        lines += ["[link]", "delay_ms = 0.0"]
        for i, j in self.list_links():
            link = f"links.{self.names[j]}->{self.names[i]}"
            changes[link] = self.find_delay(i, j).table()
        text = "\n".join(['name = "sampled"', *lines])
        return parse_scenario(text, "sampled", {**changes, **more})

    def compute_rates(self, count: int = 3) -> list[float]:
        """Computes the rates of the motions that grow fastest, without common translations.

        Args:
            count: Number of rates.

        Returns:
            Rates in 1/s, the largest first.
        """
        ticks = self._count_period()
        ages = {link: self._find_ages(link, ticks) for link in self.list_links()}
        factors = np.linalg.eigvals(self._build_period_matrix(ticks, ages))
        # A translation of all arms of a group that follow each other stays as it is.
        groups = int(np.isclose(np.linalg.eigvals(np.array(self.shares)), 1.0).sum())
        for _ in range(groups * len(self.inertia)):
            nearest = np.abs(factors - 1.0).argmin()
            assert abs(factors[nearest] - 1.0) < 1e-6
            factors = np.delete(factors, nearest)
        largest = np.sort(np.abs(factors))[::-1][:count]
        return [float(rate) for rate in np.log(largest) * self.rate_hz / ticks]

    def compute_angles(self, first: Array, periods: int) -> Array:
        """Computes the joint angles after whole periods of a run that starts at rest.

        Args:
            first: Angles at the first tick and before it, shape (N, n), in rad.
            periods: Number of periods of the delays.

        Returns:
            Angles, shape (N, n), in rad.
        """
        state = self._follow(first, first, periods)
        return state[-3]

    def compute_velocities(self, first: Array, before: Array, ticks: int) -> Array:
        """Computes the joint velocities after some ticks, with constant delays.

        Args:
            first: Angles at the first tick, at rest, shape (N, n), in rad.
            before: Angles that the peers see until the first sample arrives, in the same form.
            ticks: Number of ticks.

        Returns:
            Velocities, shape (N, n), in rad/s.
        """
        return self._follow(first, before, ticks)[-2]

    def _follow(self, first: Array, before: Array, periods: int) -> Array:
        """Returns the state after whole periods of the delays.

        Args:
            first: Angles at the first tick, at rest, shape (N, n), in rad.
            before: Angles at earlier ticks.
            periods: Number of periods.

        Returns:
            Angles of the last ticks, velocities, and torques of the last tick, shape
            (rows, N, n).
        """
        ticks = self._count_period()
        ages = {link: self._find_ages(link, ticks) for link in self.list_links()}
        matrix = self._build_period_matrix(ticks, ages)
        kept = len(matrix) // first.size - 2
        sites = len(self.shares)
        K = np.array(_spread(self.K, sites), dtype=float).reshape(sites, -1)
        # The first tick uses its own torque as that of the tick before it.
        first_torque = K * (np.array(self.shares) @ before - first)
        earlier = [before] * (kept - 1)
        state = np.stack([*earlier, first, 0.0 * first, first_torque])
        flat = np.linalg.matrix_power(matrix, periods) @ state.ravel()
        return flat.reshape(state.shape)

    def _count_period(self) -> int:
        """Returns the number of ticks after which all delays repeat."""
        tick_us = _US_PER_S // self.rate_hz
        period_us = tick_us
        for i, j in self.list_links():
            period_us = math.lcm(period_us, self.find_delay(i, j).period_us or tick_us)
        return period_us // tick_us

    def _find_ages(self, link: tuple[int, int], ticks: int) -> Array:
        """Returns the ages of the samples in use at each tick of a period, in ticks.

        Args:
            link: Receiver and sender.
            ticks: Ticks of the period.
        """
        tick_us = _US_PER_S // self.rate_hz
        # Ten seconds exceed the longest delay, so that no earlier sample is in use after them.
        earlier = ticks * math.ceil(10.0 * self.rate_hz / ticks)
        stamps = np.arange(earlier + ticks)
        due_us = stamps * tick_us + self.find_delay(*link).find_us(stamps * tick_us)
        due = -(-due_us // tick_us)
        newest = np.full(len(stamps), -1)
        in_time = due < len(stamps)
        np.maximum.at(newest, due[in_time], stamps[in_time])
        newest = np.maximum.accumulate(newest)
        return (stamps - newest)[earlier:]

    def _build_period_matrix(self, ticks: int, ages: Mapping[tuple[int, int], Array]) -> Array:
        """Returns the matrix that maps the state at one tick to the state one period later.

        The state consists of the angles of the last ticks, the velocities, and the torques of
        the last tick.

        Args:
            ticks: Ticks of the period.
            ages: Ages of the samples in use at each tick, in ticks, by (receiver, sender).
        """
        sites = len(self.shares)
        joints = len(self.inertia)
        kept = 1 + max(int(age.max()) for age in ages.values())
        cells = sites * joints
        size = cells * (kept + 2)
        initial = np.eye(size).reshape(kept + 2, sites, joints, size)
        past = initial[:kept].copy()  # row k % kept holds the angles of tick k
        qd = initial[kept].copy()
        earlier_torque = initial[kept + 1].copy()

        K = np.array(_spread(self.K, sites), dtype=float).reshape(sites, -1, 1)
        d = np.array(_spread(self.d, sites), dtype=float).reshape(sites, -1, 1)
        inverse = np.linalg.inv(self.inertia)
        h = 1.0 / self.rate_hz
        # Row k of the initial state holds the angles of tick k - kept + 1.
        for tick in range(ticks):
            now = (kept - 1 + tick) % kept
            q = past[now].copy()
            goal = np.zeros_like(q)
            for (i, j), age in ages.items():
                goal[i] += self.shares[i][j] * past[(now - age[tick]) % kept, j]
            torque = K * (goal - q) - d * qd
            held = torque
            if self.scheme == "second_order":
                held = 1.5 * torque - 0.5 * earlier_torque
            acceleration = inverse @ held
            past[(now + 1) % kept] = q + h * qd + 0.5 * h**2 * acceleration
            qd = qd + h * acceleration
            earlier_torque = torque
        oldest_first = [(ticks + k) % kept for k in range(kept)]
        final = np.concatenate([past[oldest_first], qd[None], earlier_torque[None]])
        return final.reshape(size, size)


def write_sliders(masses: Sequence[float]) -> str:
    """Returns the URDF of an arm whose joints slide along x, y and z.

    Args:
        masses: Mass of each link, in kg.
    """
    lines = ['<robot name="sliders"><link name="base"/>']
    parent = "base"
    for n, mass in enumerate(masses):
        axis = " ".join("1" if k == n else "0" for k in range(3))
        lines += [
            f'<link name="l{n}"><inertial><mass value="{mass}"/>',
            '<inertia ixx="0.1" ixy="0" ixz="0" iyy="0.1" iyz="0" izz="0.1"/></inertial></link>',
            f'<joint name="j{n}" type="prismatic"><parent link="{parent}"/>',
            f'<child link="l{n}"/><axis xyz="{axis}"/>',
            '<limit lower="-50" upper="50" effort="5000" velocity="1000"/></joint>',
        ]
        parent = f"l{n}"
    return "\n".join([*lines, "</robot>"])


def _spread(gain: Any, sites: int) -> list[Any]:
    """Returns the gain of each site. A single number is the gain of all sites."""
    return list(gain) if isinstance(gain, Sequence) else [gain] * sites
