"""Computes how coupled arms respond to an operator's torque at each frequency.

An operator touches an arm at a haptic port, for example a joint. The admittance of the port is
the joint velocity per unit torque of the operator, as a function of frequency. The impedance is
its inverse. Both are computed from the linear model of all arms.

Transparency is how well an operator feels what happens at another arm. It is judged from the
impedance at one joint of the operator's arm, in N m s/rad, computed with the other arm free and
with the other arm clamped. The operator applies no torque to the other joints. A large
difference means that the operator can distinguish free space from a rigid object. Means over a
frequency band are taken on a logarithmic axis, which weights each decade equally.

Sources:
    - Impedance and admittance: Hogan, "Impedance control: an approach to manipulation", ASME J.
      Dynamic Systems, Measurement, and Control 107 (1985).
    - Teleoperators as networks of ports: Hannaford, "A design framework for teleoperators with
      kinesthetic feedback", IEEE Trans. Robotics and Automation 5 (1989).
    - Transmitted impedance: Lawrence, "Stability and transparency in bilateral teleoperation",
      IEEE Trans. Robotics and Automation 9 (1993).
    - The difference between the free and the clamped impedance (Z-width): Hashtrudi-Zaad and
      Salcudean, "Analysis and evaluation of stability and performance robustness for
      teleoperation control architectures", ICRA (2000). The ratio of the two impedances is our
      own measure (docs/studies/ports.md).

Invariant:
    - Torques are those that act ON the joint. Torque times velocity is then the power that the
      operator supplies.
    - A control law that reflects external torques to the other arms also reflects the torque of
      a clamp.
    - Frequencies are in rad/s. Frequencies that users see are in Hz, and their names end in
      _hz.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ...core import Array
from ...errors import RuntimeFault, UsageError
from .characteristic_roots import Complex
from .linear_loop import LinearLoop

PortResponse = Callable[[Array], Complex]
"""Matrices, shape (F, p, m), for frequencies of shape (F,), rad/s."""

ZERO_ROOT_RADIUS_PER_S = 1e-3
"""Largest absolute value of a root of the loop that counts as zero, in 1/s."""

_BATCH = 512
"""Number of frequencies that are solved together, which limits the memory."""
_CIRCLE_POINTS = 64
"""Number of points of the circle around zero on which the response is evaluated."""
_HIGHEST_POWER = 6
"""Highest order of a pole at zero that is considered."""
_NEGLIGIBLE = 1e-3
"""Largest part of the response that counts as zero, as a share of its size."""


class LoopOutput(NamedTuple):
    """Output of a linear loop as a function of its present and its delayed states x.

    The output is y(t) = C x(t) + sum_k C_k x(t - T_k).

    Attributes:
        C: Matrix of the present state, shape (p, n).
        delayed: Pairs of a delay T_k, in s, and its matrix C_k, shape (p, n).
    """

    C: Array
    delayed: tuple[tuple[float, Array], ...] = ()

    def evaluate(self, s: Complex) -> Complex:
        """Returns the matrix that maps the state of the arms to an output, at frequencies s.

        The matrix is C + sum_k C_k e^{-s T_k}, with the network delays T_k.

        Args:
            s: Complex frequencies, shape (F,), in 1/s.

        Returns:
            Matrices, shape (F, p, n).
        """
        total = _repeat_matrix(self.C, len(s))
        for delay_s, C in self.delayed:
            shift = _evaluate_shift(s, delay_s)
            total += shift * C
        return total


def _repeat_matrix(matrix: Array, count: int) -> Complex:
    """Returns `count` complex copies of a matrix of shape (p, m), as an array (count, p, m)."""
    shape = (count, *matrix.shape)
    complex_matrix = matrix.astype(np.complex128)
    copies: Complex = np.broadcast_to(complex_matrix, shape).copy()
    return copies


def _evaluate_shift(s: Complex, delay_s: float) -> Complex:
    """Returns the factor e^{-s T} of a delay T at each complex frequency s, shape (F, 1, 1)."""
    shift: Complex = np.exp(-s * delay_s)
    return shift[:, np.newaxis, np.newaxis]


class PoleAtZero(NamedTuple):
    """Response of coupled arms to constant torques, which may make velocities grow.

    The response Y(s) gives p velocities per unit torque, for m torques. A pole at s = 0 means
    that a constant torque makes a velocity grow, as for a mass without friction. Near s = 0 the
    response is then approximately residue / s, possibly with additional higher powers of 1 / s.

    Attributes:
        order: Highest power of 1 / s. If the order is 0, there is no pole, and velocities under
            a constant torque stay bounded.
        residue: Coefficient of 1 / s, shape (p, m), in rad/s^2 per N m.
    """

    order: int
    residue: Array

    @property
    def passive(self) -> bool:
        """True if the response at zero frequency is compatible with a passive system.

        A passive system never supplies more energy than it received. If its response has a pole
        at zero, the pole is simple, and its residue is a symmetric matrix without negative
        eigenvalues.
        """
        residue = self.residue
        differences = np.abs(residue - residue.T)
        asymmetry = differences.max(initial=0.0)
        largest_entry = np.abs(residue).max(initial=0.0)
        tolerance = _NEGLIGIBLE * largest_entry
        if self.order > 1 or asymmetry > tolerance:
            return False
        eigenvalues = np.linalg.eigvalsh(residue)
        least = eigenvalues.min(initial=0.0)
        return bool(least >= -tolerance)

    @classmethod
    def of_loop(cls, loop: LinearLoop) -> "PoleAtZero":
        """Finds whether constant torques make the velocities of coupled arms grow.

        The velocities grow if the response Y(s), velocity per unit torque, has a pole at zero.
        For example, a free mass m has Y(s) = 1 / (m s). A characteristic root at zero alone is
        not sufficient: the arms have many of these roots, because they can rest in several
        poses, and an arm at rest has no velocity. The pole is found with Cauchy's integral
        along a small circle around zero, with the radius `ZERO_ROOT_RADIUS_PER_S`.

        Args:
            loop: Linear model of the coupled arms.

        Returns:
            Order and residue of the pole. The order is 0 if there is no pole.
        """
        angles = 2j * math.pi * np.arange(_CIRCLE_POINTS) / _CIRCLE_POINTS
        unit_circle = np.exp(angles)
        small_circle = ZERO_ROOT_RADIUS_PER_S * unit_circle
        responses = evaluate_transfer(loop, small_circle)
        circle = unit_circle[:, np.newaxis, np.newaxis]
        # the coefficient of 1 / s^k is the mean of Y(s) s^k over the circle
        coefficients = {}
        for power in range(1, _HIGHEST_POWER + 1):
            products = responses * circle**power
            mean = products.mean(axis=0)
            coefficients[power] = mean.real

        largest = np.abs(responses).max(initial=0.0)
        least_size = _NEGLIGIBLE * largest
        powers = []
        for power, coefficient in coefficients.items():
            size = np.abs(coefficient).max(initial=0.0)
            if size > least_size:
                powers.append(power)

        residue = np.zeros_like(coefficients[1])
        if 1 in powers:
            residue = coefficients[1] * ZERO_ROOT_RADIUS_PER_S
        return cls(max(powers, default=0), residue)


def evaluate_transfer(
    loop: LinearLoop,
    s: Complex,
    output: LoopOutput | None = None,
) -> Complex:
    """Computes the response of coupled arms to torques at complex frequencies s.

    The arms obey E x' = A x + sum_k A_k x(t - T_k) + B u + sum_k B_k u(t - T_k), with the state
    x, the torques u, the delays T_k, and the matrices of `LinearLoop`. The transfer function
    from u to an output C(s) x is

        C(s) (s E - A - sum_k A_k exp(-s T_k))^-1 (B + sum_k B_k exp(-s T_k)).

    Args:
        loop: Linear model of the coupled arms.
        s: Complex frequencies, shape (F,), in 1/s.
        output: The output matrix C(s). If `None`, the output consists of the joint velocities,
            and the result is the admittance, in rad/s per N m.

    Returns:
        The response, shape (F, p, m), with one row per output and one column per torque.
    """
    output = LoopOutput(loop.C) if output is None else output
    count = len(s)
    outputs = len(output.C)
    inputs = loop.B.shape[1]
    response = np.zeros((count, outputs, inputs), np.complex128)
    E = np.eye(len(loop.A))
    if loop.E is not None:
        E = np.diag(loop.E)

    for first in range(0, count, _BATCH):
        end = first + _BATCH
        batch = s[first:end]
        rate_term = batch[:, np.newaxis, np.newaxis] * E
        left = rate_term - loop.A
        right = _repeat_matrix(loop.B, len(batch))
        for term in loop.delayed:
            shift = _evaluate_shift(batch, term.delay_s)
            left -= shift * term.A
            right += shift * term.B
        state = np.linalg.solve(left, right)
        output_matrix = output.evaluate(batch)
        response[first:end] = output_matrix @ state
    return response


def build_admittance(loop: LinearLoop) -> PortResponse:
    """Returns the admittance Y(j w) of a loop as a function of the frequency w in rad/s.

    The admittance is the velocity of each joint per unit torque of an operator at each joint,
    in rad/s per N m.

    Args:
        loop: The loop. Its outputs must be the velocities of the joints of its inputs, in the
            same order.
    """
    velocities = loop.C.shape[0]
    torques = loop.B.shape[1]
    if velocities != torques:
        raise RuntimeFault(
            "a loop with ports must have as many velocities as torques, but their numbers are "
            f"{velocities} and {torques}"
        )

    def evaluate_admittance(w_rad_s: Array) -> Complex:
        s = np.asarray(1j * w_rad_s, np.complex128)
        return evaluate_transfer(loop, s)

    return evaluate_admittance


def select_ports(response: PortResponse, ports: list[int]) -> PortResponse:
    """Restricts a frequency response to the joints at which operators act.

    No operator acts at the other joints. Their torque is zero, and their rows and columns are
    removed.

    Args:
        response: The response at all ports, as a function of frequency.
        ports: Indices of the ports to keep.
    """

    def evaluate_selected(w_rad_s: Array) -> Complex:
        rows = response(w_rad_s)[:, ports]
        return rows[:, :, ports]

    return evaluate_selected


TRANSPARENCY_BAND_HZ = (0.1, 10.0)
"""Frequency band over which means are taken. Operators drift below it, and do not move
deliberately above it.
"""
QUOTED_AT_HZ = 1.0
"""Frequency at which impedances are reported, in Hz."""
_SHOWN_HZ = (0.01, 100.0)
"""Frequency band of the figures, in Hz."""
_PER_DECADE = 100
"""Number of frequencies per decade of this band."""


class Transparency(NamedTuple):
    """How much of another arm an operator feels: the impedance with that arm free or clamped.

    A transparent system feels light while the other arm is free, and stiff while the other arm
    is clamped.

    Attributes:
        operator_site: Site of the operator.
        other_site: Site that is free or clamped.
        joint: Number of the joint of the operator's site, counted from 1.
        w_rad_s: Frequencies, shape (F,), in rad/s.
        free: Impedance with the other site free, shape (F,), in N m s/rad.
        clamped: Impedance with the other site clamped, shape (F,), in N m s/rad.
        band_hz: The band over which means are taken, in Hz.
    """

    operator_site: str
    other_site: str
    joint: int
    w_rad_s: Array
    free: Complex
    clamped: Complex
    band_hz: tuple[float, float] = TRANSPARENCY_BAND_HZ

    @property
    def softest_nm_s_rad(self) -> float:
        """Mean impedance that the operator feels while the other arm is free, in N m s/rad.

        The smaller this mean is, the less the operator feels of the arms themselves. It is the
        geometric mean of the impedance's magnitude over the frequencies of `band_hz`, weighted
        as on a logarithmic axis.
        """
        return self._average_magnitude(self.free)

    @property
    def stiffest_nm_s_rad(self) -> float:
        """Mean impedance that the operator feels while the other arm is clamped, in N m s/rad.

        The larger this mean is, the harder a rigid obstacle feels. It is the geometric mean of
        the impedance's magnitude over the frequencies of `band_hz`, weighted as on a
        logarithmic axis.
        """
        return self._average_magnitude(self.clamped)

    @property
    def ratio_db(self) -> float:
        """Mean ratio of the impedance with the other arm clamped to that with it free, in dB.

        The result is the mean of 20 log10(abs(Z_clamped) / abs(Z_free)) over the frequencies of
        `band_hz`, on a logarithmic axis. Z_clamped and Z_free are the impedances that the
        operator feels while the other arm is clamped or free.
        """
        ratio = self.stiffest_nm_s_rad / self.softest_nm_s_rad
        return 20.0 * float(np.log10(ratio))

    @property
    def difference_nm_s_rad(self) -> float:
        """Mean difference of the impedances with the other arm clamped and free, in N m s/rad.

        The result is the geometric mean of abs(Z_clamped - Z_free) over the frequencies of
        `band_hz`, weighted as on a logarithmic axis. Z_clamped and Z_free are the impedances
        that the operator feels. The mean is zero if they are equal at any frequency.
        """
        difference = self.clamped - self.free
        if not difference.all():
            return 0.0
        return self._average_magnitude(difference)

    def interpolate_magnitudes(self, frequency_hz: float) -> tuple[float, float]:
        """Returns the magnitudes of the impedances that an operator feels at one frequency.

        The magnitudes are interpolated between the computed frequencies on logarithmic axes.

        Args:
            frequency_hz: The frequency, in Hz.

        Returns:
            The magnitudes while the other arm is free and while it is clamped, both in N m
            s/rad.
        """
        log_w = np.log(self.w_rad_s)
        target = np.log(2.0 * np.pi * frequency_hz)
        log_free = np.log(np.abs(self.free))
        log_clamped = np.log(np.abs(self.clamped))
        log_free_at_target = np.interp(target, log_w, log_free)
        log_clamped_at_target = np.interp(target, log_w, log_clamped)
        free = float(np.exp(log_free_at_target))
        clamped = float(np.exp(log_clamped_at_target))
        return free, clamped

    def _average_magnitude(self, Z: Complex) -> float:
        """Returns the mean magnitude of an impedance over a frequency band, on log axes.

        On these axes each decade of frequency and each decade of magnitude has the same weight.

        Args:
            Z: Impedance at the frequencies `w_rad_s`.
        """
        low, high = (2.0 * np.pi * edge for edge in self.band_hz)
        # the edges of the band belong to it, up to rounding
        w_rad_s = self.w_rad_s
        is_above = w_rad_s >= low * (1.0 - 1e-9)
        is_below = w_rad_s <= high * (1.0 + 1e-9)
        in_band = is_above & is_below
        magnitudes = np.abs(Z[in_band])
        log_magnitudes = np.log(magnitudes)
        log_w = np.log(w_rad_s[in_band])
        width = log_w[-1] - log_w[0]
        integral = np.trapezoid(log_magnitudes, log_w)
        mean = integral / width
        return float(np.exp(mean))

    @classmethod
    def measure(cls, loop: LinearLoop, at: str, of: str) -> "tuple[Transparency, ...]":
        """Computes what an operator feels while another arm is free and while it is clamped.

        With ideal transparency, the operator would feel nothing while the other arm is free,
        and a rigid arm while it is clamped. The impedance along each joint i is Z(j w) = 1 /
        Y_ii(j w), where Y is the admittance of the loop. All other ports are free.

        Args:
            loop: The loop.
            at: Site of the operator.
            of: Site that is free or clamped.

        Returns:
            The transparency along each joint of the operator's site.

        Raises:
            UsageError: There is no such site, or the two sites are the same.
        """
        low, high = _SHOWN_HZ
        decades = np.log10(high / low)
        steps = round(_PER_DECADE * decades)
        points = np.geomspace(low, high, 1 + steps)
        frequencies_hz = np.union1d(points, TRANSPARENCY_BAND_HZ)
        w_rad_s = 2.0 * np.pi * frequencies_hz

        ports = loop.find_site_ports(at)
        if at == of:
            raise UsageError(
                f"a load cannot be placed at {at}, because this is the operator's own site"
            )
        clamped_loop = loop.clamp_site(of)
        clamped_ports = clamped_loop.find_site_ports(at)
        free_admittance = build_admittance(loop)
        clamped_admittance = build_admittance(clamped_loop)
        evaluate_free = select_ports(free_admittance, ports)
        evaluate_clamped = select_ports(clamped_admittance, clamped_ports)
        free = evaluate_free(w_rad_s)
        clamped = evaluate_clamped(w_rad_s)

        port_joints = loop.port_joints
        transparencies = []
        for n, port in enumerate(ports):
            transparency = Transparency(
                operator_site=at,
                other_site=of,
                joint=port_joints[port],
                w_rad_s=w_rad_s,
                free=1.0 / free[:, n, n],
                clamped=1.0 / clamped[:, n, n],
            )
            transparencies.append(transparency)
        return tuple(transparencies)
