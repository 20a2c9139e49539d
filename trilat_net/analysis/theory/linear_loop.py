"""Linearises the control loop of all arms about an equilibrium, with network delays.

For small deviations x from the equilibrium, the result is a differential equation with delays:

    x'(t) = A x(t) + sum_k A_k x(t - T_k) + B u(t) + sum_k B_k u(t - T_k),    y(t) = C x(t)

The state x contains, for each arm, its joint angles, its joint velocities, and the parameter
estimates of its control law. The inputs u are the torques that operators add at the joints, the
outputs y are the joint velocities, T_k are the network delays, and A, A_k, B, B_k and C are
constant matrices.

For a chain with n joints, the control law may estimate ten parameters theta_hat per link. Only
one combination of them per joint affects small motions: the estimated gravity torque z = Y_G
theta_hat, in N m, where Y_G is the regressor of the gravity torque (the matrix that multiplies
the parameters) at rest. The torque z therefore replaces the estimates in x. Its rate is z' =
-Y_G Gamma Y' r, with the regressor Y of the control law, its adaptation gain Gamma, and its
filtered error r = e' + Lambda e, where e is the error of the joint angles and Lambda a gain.
The remaining combinations are omitted, since they only add roots at zero.

In task space, where end effectors follow each other instead of joints, the arms are coupled
through the poses and velocities of their end effectors.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.linalg import qr

from ...core import POSITION, Array, SiteSetup
from ...errors import UsageError
from ...laws import BlockKey, LinearForm
from . import site_dynamics
from .numeric_law import NumericLaw
from .operating_point import Equilibrium, OperatingConditions
from .textbook_arm import evaluate_reference

_DEPENDENT = 1e-9
"""Largest pivot of a QR factorisation that counts as zero, relative to the largest pivot."""


class SiteJacobian(NamedTuple):
    """Linear model of one site about an equilibrium.

    It contains the derivatives of the site's rates of change with respect to its states and to
    the values that it receives from the other sites. States that are constant in small motions,
    or that have no effect on the motion, are left out.

    Attributes:
        layout: Assignment of the columns of the derivatives to quantities. There are no columns
            for parameter estimates if the control law estimates nothing.
        rates: The derivatives of accelerations, estimates, torques and sent values.
        states: Names of the states, such as "q1", "qd2" and "theta4" (parameter estimate).
            "gravity2" is the estimated gravity torque of joint 2.
        omitted_states: Number of parameter estimates that were left out.
    """

    layout: site_dynamics.ArgumentLayout
    rates: site_dynamics.SiteRates
    states: tuple[str, ...]
    omitted_states: int = 0

    @property
    def output(self) -> Array:
        """Matrix that maps the states of an arm to the values that it sends to the others.

        These values are its pose, the velocity of this pose, and the external torque, with m
        entries each. The matrix has the shape (3 m, states).
        """
        rates = self.rates
        samples = np.vstack([rates.x, rates.xd, rates.reflected])
        state_count = self.layout.states
        return samples[:, :state_count]

    @classmethod
    def list_of_sites(
        cls,
        conditions: OperatingConditions,
        rest: Equilibrium,
        *,
        all_estimates: bool = False,
    ) -> "list[SiteJacobian]":
        """Builds a separate linear model of each site about an equilibrium.

        Each model contains the derivatives of the site's rates of change with respect to its
        own states and its inputs.

        Args:
            conditions: The sites, gains and delays of the coupled arms.
            rest: The equilibrium, with the parameter estimates.
            all_estimates: True to keep every parameter estimate of a chain as a state. By
                default, only the combinations that affect small motions are states: the
                estimated gravity torques of the joints.

        Returns:
            The models, in the order of the sites.
        """
        arguments = conditions.gather_site_arguments(rest)
        references = _differentiate_references(conditions, rest)
        jacobians = []
        for i, (site, x) in enumerate(zip(conditions.sites, arguments, strict=True)):
            layout = site_dynamics.ArgumentLayout.of_site(site)
            rates = site_dynamics.SiteRates.differentiate(site, x)
            if conditions.has_forms:
                # the memory of such a law supplies the torque that holds the arm at rest
                torque_columns = layout.external_torque
                qdd = site_dynamics.SiteRates.evaluate(site, x).qdd
                inverse_inertia = rates.qdd[:, torque_columns]
                holding_torque = np.linalg.solve(inverse_inertia, qdd)
                x[torque_columns] -= holding_torque
                rates = site_dynamics.SiteRates.differentiate(site, x)
            if (i, i) in references:
                # chain rule: the reference depends on the site's own orientation
                state_count = layout.states
                pose_by_state = rates.x[:, :state_count]
                reference_by_state = references[i, i] @ pose_by_state
                for derivative in rates:
                    by_reference = derivative[:, layout.q_des]
                    indirect_effect = by_reference @ reference_by_state
                    derivative[:, :state_count] += indirect_effect

            jacobian = _select_states(site, layout, rates, all_estimates=all_estimates)
            jacobians.append(jacobian)
        return jacobians


class DelayedTerm(NamedTuple):
    """Effect of all states and torques on the coupled arms after one particular delay T.

    This is the term A x(t - T) + B u(t - T) in the differential equation of the loop. x
    contains the n states, and u the m operator torques at the joints.

    Attributes:
        delay_s: The delay T, in s.
        A: Effect of the delayed states, shape (n, n).
        B: Effect of the delayed torques, shape (n, m). It is zero unless a control law sends
            external torques to other arms.
    """

    delay_s: float
    A: Array
    B: Array


class LinearLoop(NamedTuple):
    """Linear model of the coupled arms near an equilibrium, with network delays.

    It shows whether small motions about the equilibrium grow. The docstring of the module
    states the equation and the notation.

    Attributes:
        names: Names of the states, such as "m1.q1", "s.qd2", "m1.theta4".
        inputs: Names of the joint torques, such as "m1.tau1".
        outputs: Names of the joint velocities, such as "m1.qd1".
        A: Matrix of the states, shape (n, n).
        B: Matrix of the inputs, shape (n, m).
        C: Matrix of the outputs, shape (p, n).
        delayed: One entry per distinct delay above zero, in ascending order of delay.
        omitted_states: Number of states that were left out because they are constant in small
            motions or do not affect them. Each has a root at zero.
        E: Diagonal of the matrix E in E x' = A x + ..., shape (n,): 1 for a differential state,
            0 for a state determined by an algebraic equation, such as a wave. `None` if every
            state is differential.
    """

    names: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    A: Array
    B: Array
    C: Array
    delayed: tuple[DelayedTerm, ...]
    omitted_states: int = 0
    E: Array | None = None

    @property
    def static_matrix(self) -> Array:
        """Sum of the matrices of present and delayed states, A + sum_k A_k, shape (n, n).

        While the n states are constant, delays have no effect, and this matrix gives the rates
        of change of the states.
        """
        delayed = [term.A for term in self.delayed]
        return sum(delayed, self.A)

    @property
    def longest_delay_s(self) -> float:
        """Longest delay of any network link or signal, in s. 0 if there are no delays."""
        delays_s = [term.delay_s for term in self.delayed]
        return max(delays_s, default=0.0)

    def set_common_delay(self, delay_s: float) -> "LinearLoop":
        """Returns the loop with the same delay on all links, for example to check a margin.

        Args:
            delay_s: The delay, in s. With 0, the loop has no delayed terms.
        """
        if not self.delayed:
            return self
        state_matrices = [term.A for term in self.delayed]
        input_matrices = [term.B for term in self.delayed]
        delayed_A = np.sum(state_matrices, axis=0)
        delayed_B = np.sum(input_matrices, axis=0)
        if delay_s == 0.0:
            A = self.A + delayed_A
            B = self.B + delayed_B
            return self._replace(A=A, B=B, delayed=())
        term = DelayedTerm(delay_s, delayed_A, delayed_B)
        return self._replace(delayed=(term,))

    @property
    def port_sites(self) -> tuple[str, ...]:
        """Site of each input, for example "m1" for the joint torque "m1.tau2"."""
        return tuple(name.partition(".")[0] for name in self.inputs)

    @property
    def sites(self) -> tuple[str, ...]:
        """Names of the sites whose joints have inputs, in the order of their first inputs."""
        # a dict keeps each site once, in order
        return tuple(dict.fromkeys(self.port_sites))

    @property
    def port_joints(self) -> tuple[int, ...]:
        """Joint number of each input, for example 2 for the joint torque "m1.tau2"."""
        return tuple(int(name.rpartition("tau")[2]) for name in self.inputs)

    @property
    def ports_by_joint(self) -> dict[int, list[int]]:
        """Indices of the inputs of each joint number, in the order of the sites.

        The first joints of all arms, for example, can then be analysed together, excluding the
        other joints.
        """
        ports: dict[int, list[int]] = {}
        for port, joint in enumerate(self.port_joints):
            ports.setdefault(joint, []).append(port)
        return dict(sorted(ports.items()))

    def find_site_ports(self, site: str) -> list[int]:
        """Finds the ports of an arm, the joints at which its operator pushes.

        Args:
            site: Name of the site.

        Returns:
            Indices of the ports among the inputs of the loop.

        Raises:
            UsageError: The loop has no such site.
        """
        ports = [n for n, port_site in enumerate(self.port_sites) if port_site == site]
        if not ports:
            sites = ", ".join(self.sites)
            raise UsageError(
                f"there is no site {site!r} among the ports; the sites are {sites}"
            )
        return ports

    def clamp_site(self, site: str) -> "LinearLoop":
        """Returns the linear model of the arms with one arm held still by a clamp.

        The torque u_c of the clamp makes the arm's accelerations zero: u_c = -B_cc^-1 (A_c x +
        B_c u + delayed terms), where x is the state, u the other torques, A_c and B_c the rows
        of the loop's matrices for these accelerations, and B_cc the part of B_c that belongs to
        the arm's own torques. This torque replaces the operator torque of the clamped arm in
        all terms of the model, including the delayed terms.

        Args:
            site: Name of the site.

        Returns:
            The loop excluding the ports, velocities and angles of the site.

        Raises:
            UsageError: There is no such site, or two clamped sites reflect force onto each
                other.
        """
        ports = self.find_site_ports(site)
        other_ports = [n for n in range(len(self.inputs)) if n not in ports]
        speeds = []
        angles = []
        for port in ports:
            speed_name = self.outputs[port]
            angle_name = self.inputs[port].replace(".tau", ".q")
            speeds.append(self.names.index(speed_name))
            angles.append(self.names.index(angle_name))
        removed = {*speeds, *angles}
        kept_states = [n for n in range(len(self.names)) if n not in removed]
        undelayed_term = DelayedTerm(0.0, self.A, self.B)
        terms = [undelayed_term, *self.delayed]
        acceleration_block = np.ix_(speeds, ports)
        for term in self.delayed:
            reflected_torque = term.B[acceleration_block]
            if reflected_torque.any():
                raise UsageError(
                    "clamped sites that reflect force onto each other do not have a finite "
                    f"response: {site}"
                )
        # the torque of the clamp as a sum of terms with delays
        inverse_inertia = self.B[acceleration_block]
        inertia = np.linalg.inv(inverse_inertia)
        sums: dict[float, DelayedTerm] = {}

        def add_term(delay_s: float, A: Array, B: Array) -> None:
            """Adds matrices to the part of the model that acts after a given delay.

            Delays that differ only by rounding errors are considered equal.

            Args:
                delay_s: The delay, in s.
                A: Effect of the delayed states.
                B: Effect of the delayed torques.
            """
            key = round(delay_s, 12)
            if key in sums:
                previous = sums[key]
                A = previous.A + A
                B = previous.B + B
            sums[key] = DelayedTerm(key, A, B)

        clamp_torques = []
        for term in terms:
            by_state = term.A[speeds]
            by_torque = term.B[speeds][:, other_ports]
            clamp_by_state = -inertia @ by_state
            clamp_by_torque = -inertia @ by_torque
            clamp = DelayedTerm(term.delay_s, clamp_by_state, clamp_by_torque)
            clamp_torques.append(clamp)
        for term in terms:
            other_effect = term.B[:, other_ports]
            add_term(term.delay_s, term.A, other_effect)
            effect = term.B[:, ports]
            if not effect.any():
                continue
            for clamp in clamp_torques:
                delay_s = term.delay_s + clamp.delay_s
                effect_of_state = effect @ clamp.A
                effect_of_torque = effect @ clamp.B
                add_term(delay_s, effect_of_state, effect_of_torque)
        kept_terms = []
        kept_block = np.ix_(kept_states, kept_states)
        for delay_s in sorted(sums):
            total = sums[delay_s]
            kept_A = total.A[kept_block]
            kept_B = total.B[kept_states]
            kept_term = DelayedTerm(delay_s, kept_A, kept_B)
            kept_terms.append(kept_term)
        undelayed, *delayed = kept_terms
        active_terms = [term for term in delayed if term.A.any() or term.B.any()]
        return LinearLoop(
            names=tuple(self.names[n] for n in kept_states),
            inputs=tuple(self.inputs[n] for n in other_ports),
            outputs=tuple(self.outputs[n] for n in other_ports),
            A=undelayed.A,
            B=undelayed.B,
            C=self.C[np.ix_(other_ports, kept_states)],
            delayed=tuple(active_terms),
            E=None if self.E is None else self.E[kept_states],
        )

    @classmethod
    def of_conditions(
        cls,
        conditions: OperatingConditions,
        rest: Equilibrium,
        *,
        all_estimates: bool = False,
    ) -> "LinearLoop":
        """Builds the linear model of the coupled arms for small motions about an equilibrium.

        The model contains all sites and the delayed links between them. Its inputs are the
        operator torques at the joints.

        Args:
            conditions: The sites, gains and delays of the coupled arms.
            rest: The equilibrium, with the parameter estimates.
            all_estimates: True to keep every parameter estimate of a chain as a state. By
                default, only the combinations that affect small motions are states: the
                estimated gravity torques of the joints.

        Returns:
            The model, a linear differential equation with delays.
        """
        sites = SiteJacobian.list_of_sites(conditions, rest, all_estimates=all_estimates)
        states = _list_blocks([site.layout.states for site in sites])
        ports = _list_blocks([site.layout.joints for site in sites])
        state_count = states[-1].stop
        port_count = ports[-1].stop
        A = np.zeros((state_count, state_count))
        B = np.zeros((state_count, port_count))
        C = np.zeros((port_count, state_count))

        input_effects = []
        for i, site in enumerate(sites):
            layout = site.layout
            rates = site.rates
            joints = layout.joints
            site_states = states[i]
            site_ports = ports[i]
            first_velocity = layout.qd.start
            position_rate = np.eye(joints, layout.arguments, first_velocity)
            derivative = np.vstack([position_rate, rates.qdd, rates.estimate])
            A[site_states, site_states] = derivative[:, : layout.states]
            B[site_states, site_ports] = derivative[:, layout.external_torque]
            C[site_ports, site_states] = np.eye(joints, layout.states, first_velocity)
            input_effect = derivative[:, layout.inputs]
            input_effects.append(input_effect)

        terms: dict[float, tuple[Array, Array]] = {}
        couplings = compute_couplings(conditions, rest, sites)
        for (i, j), coupling in couplings.items():
            delay_s = float(conditions.age_s[i, j])
            if delay_s not in terms:
                terms[delay_s] = (np.zeros_like(A), np.zeros_like(B))
            late_A, late_B = terms[delay_s]
            peer = sites[j]
            peer_layout = peer.layout
            effect = input_effects[i] @ coupling
            effect_of_states = effect @ peer.output
            late_A[states[i], states[j]] += effect_of_states
            # the torque on the peer's joints is reflected without a state in between
            first_torque = 2 * peer_layout.coordinates
            effect_of_torque = effect[:, first_torque:]
            reflected_by_port = peer.rates.reflected[:, peer_layout.external_torque]
            effect_of_ports = effect_of_torque @ reflected_by_port
            late_B[states[i], ports[j]] += effect_of_ports

        loop = LinearLoop(
            names=_name_states(conditions, sites),
            inputs=_name_ports(conditions, sites, "tau"),
            outputs=_name_ports(conditions, sites, "qd"),
            A=A,
            B=B,
            C=C,
            delayed=_sort_terms(terms),
            omitted_states=sum(site.omitted_states for site in sites),
        )
        if all_estimates or not conditions.has_forms:
            return loop
        return _add_law_forms(conditions, sites, loop)


def join_diagonal_blocks(blocks: Sequence[Array]) -> Array:
    """Returns a block-diagonal matrix.

    `scipy.linalg.block_diag` does the same, but takes twenty times as long for small blocks.

    Args:
        blocks: The blocks, starting from the upper left.
    """
    rows, columns = np.sum([block.shape for block in blocks], axis=0)
    matrix = np.zeros((rows, columns))
    row = 0
    column = 0
    for block in blocks:
        height, width = block.shape
        matrix[row : row + height, column : column + width] = block
        row += height
        column += width
    return matrix


def _differentiate_references(
    conditions: OperatingConditions, rest: Equilibrium
) -> dict[tuple[int, int], Array]:
    """Computes how the pose that a site follows depends on the poses of the other sites.

    A site is a process that runs one arm. For positions, the derivative is the unit matrix
    times the dominance factor, the weight with which site i follows site j. If end effectors
    follow each other in orientation too, the followed pose also depends on the site's own pose.

    Args:
        conditions: The sites, gains and delays of the coupled arms.
        rest: The pose of rest at which the derivatives are taken.

    Returns:
        For each pair (i, j), the derivative of the pose that site i follows with respect to the
        pose of site j, shape (m, m), for poses of m numbers. Pairs without an effect are
        missing.
    """
    derivatives = {}
    poses = conditions.compute_shared_poses(rest)
    for i, shares in enumerate(conditions.alpha):
        followed = np.flatnonzero(shares).tolist()
        m = len(poses[i])
        identity = np.eye(m)
        for j in followed:
            derivatives[i, j] = shares[j] * identity
        layout = conditions.sites[i].layout
        has_orientation = m > POSITION and layout.task
        if not has_orientation:
            continue

        for j in {i, *followed}:
            columns = []
            for pose in poses:
                zeros = np.zeros(len(pose))
                repeated_pose = pose[:, np.newaxis] + zeros
                columns.append(repeated_pose)
            unit_steps = np.eye(len(poses[j]))
            imaginary_steps = 1j * site_dynamics.COMPLEX_STEP * unit_steps
            columns[j] = columns[j] + imaginary_steps
            reference = evaluate_reference(shares, columns[i], columns)
            derivatives[i, j] = reference.imag / site_dynamics.COMPLEX_STEP
    return derivatives


def compute_couplings(
    conditions: OperatingConditions,
    rest: Equilibrium,
    sites: list[SiteJacobian],
) -> dict[tuple[int, int], Array]:
    """Computes how the values that each site sends act on the inputs of the other sites.

    A site sends its pose, its velocity and its reflected torque, with m entries each. A
    receiver weights them with its dominance factors. A control law written by a user also
    receives the unweighted values.

    Args:
        conditions: The sites, gains and delays of the coupled arms.
        rest: The equilibrium about which the arms are linearised.
        sites: Linear model of each site by itself, without the other sites.

    Returns:
        For each pair (i, j), the effect of the values sent by site j on the inputs of site i,
        shape (inputs, 3 m).
    """
    references = _differentiate_references(conditions, rest)
    couplings = {}
    for i, j in conditions.coupled_pairs:
        layout = sites[i].layout
        m = layout.coordinates
        zero = np.zeros((m, m))
        share = conditions.alpha[i, j] * np.eye(m)
        reference = references.get((i, j), zero)
        # pose, velocity and reflected torque of the sender
        coupling = join_diagonal_blocks([reference, share, share])

        if layout.peers:
            length = len(coupling)
            samples = np.zeros((layout.peers, length, length))
            # tau_x in a sample is the torque of the arm, and not the torque ON the arm
            signs = np.repeat([1.0, 1.0, -1.0], m)
            # a site is not among its own peers
            peer_index = j - 1 if j > i else j
            samples[peer_index] = np.diag(signs)
            coupling = np.vstack([coupling, *samples])
        couplings[i, j] = coupling
    return couplings


def _select_states(
    site: SiteSetup,
    layout: site_dynamics.ArgumentLayout,
    rates: site_dynamics.SiteRates,
    *,
    all_estimates: bool,
) -> SiteJacobian:
    """Returns the derivatives of an arm's motion with respect to the states of the model.

    Of the parameter estimates of a chain, only independent combinations that change the torque
    at rest are kept, see the module's docstring.
    """
    motion = _name_motion(layout.joints)
    if isinstance(site.law_factory, NumericLaw):
        memory = site.law_factory.names
        return SiteJacobian(layout, rates, (*motion, *memory))
    if not site_dynamics.has_estimate(site):
        no_combination = np.zeros((0, layout.parameters))
        return _replace_estimate(layout, rates, no_combination, ())
    if site.chain is None or all_estimates:
        estimates = tuple(f"theta{p + 1}" for p in range(layout.parameters))
        return SiteJacobian(layout, rates, (*motion, *estimates))

    effect = rates.tau[:, layout.estimate]
    # pivoted QR factorisation: the leading pivots are the independent rows of the effect
    _, R, pivots = qr(effect.T, mode="economic", pivoting=True)
    sizes = np.abs(np.diag(R))
    least_size = _DEPENDENT * max(1.0, sizes[0])
    rank = int(np.sum(sizes > least_size))

    joints = sorted(pivots[:rank].tolist())
    names = tuple(f"gravity{joint + 1}" for joint in joints)
    jacobian = _replace_estimate(layout, rates, effect[joints], names)
    omitted_states = layout.parameters - len(joints)
    return jacobian._replace(omitted_states=omitted_states)


def _name_motion(joints: int) -> tuple[str, ...]:
    """Returns the names of angles and velocities: "q1", "q2", ..., "qd1", "qd2", ..."""
    numbers = range(1, joints + 1)
    angles = [f"q{number}" for number in numbers]
    velocities = [f"qd{number}" for number in numbers]
    return (*angles, *velocities)


def _replace_estimate(
    layout: site_dynamics.ArgumentLayout,
    rates: site_dynamics.SiteRates,
    T: Array,
    names: tuple[str, ...],
) -> SiteJacobian:
    """Replaces the parameter estimates of a control law by fewer states z = T theta_hat.

    Estimates that influence the motion only through z would add roots that are always zero.

    Args:
        layout: Layout of the columns with theta_hat.
        rates: Derivatives with respect to theta_hat.
        T: The matrix T, shape (states, P). The estimates must act through z only.
        names: Names of the states z.
    """
    estimate_by_z = np.linalg.pinv(T)

    estimate = layout.estimate

    def convert(derivative: Array) -> Array:
        """Converts derivatives with respect to theta_hat to those with respect to z."""
        motion = derivative[:, : estimate.start]
        by_estimate = derivative[:, estimate]
        by_z = by_estimate @ estimate_by_z
        inputs = derivative[:, estimate.stop :]
        return np.hstack([motion, by_z, inputs])

    converted = site_dynamics.SiteRates(*map(convert, rates))
    z_rate = T @ converted.estimate
    new_layout = site_dynamics.ArgumentLayout(
        joints=layout.joints,
        parameters=len(T),
        shared=layout.shared,
        peers=layout.peers,
    )
    return SiteJacobian(
        layout=new_layout,
        rates=converted._replace(estimate=z_rate),
        states=(*_name_motion(layout.joints), *names),
    )


def _list_blocks(lengths: Sequence[int]) -> list[slice]:
    """Returns consecutive slices of the given lengths, for the blocks of a joint vector."""
    bounds = np.cumsum([0, *lengths]).tolist()
    return [slice(start, stop) for start, stop in pairwise(bounds)]


def _name_states(
    conditions: OperatingConditions, sites: Sequence[SiteJacobian]
) -> tuple[str, ...]:
    """Returns the names of all states, such as "m1.q1"."""
    names = []
    for name, site in zip(conditions.names, sites, strict=True):
        names += [f"{name}.{state}" for state in site.states]
    return tuple(names)


def _name_ports(
    conditions: OperatingConditions,
    sites: Sequence[SiteJacobian],
    kind: str,
) -> tuple[str, ...]:
    """Returns the names of a quantity of all joints, such as "m1.tau1" for the kind "tau"."""
    names = []
    for name, site in zip(conditions.names, sites, strict=True):
        numbers = range(1, site.layout.joints + 1)
        names += [f"{name}.{kind}{number}" for number in numbers]
    return tuple(names)


def _sort_terms(terms: dict[float, tuple[Array, Array]]) -> tuple[DelayedTerm, ...]:
    """Orders the terms of a delay-differential equation by their delay.

    Args:
        terms: Matrices of state and torque, by the delay in s.
    """
    delayed = []
    for delay_s in sorted(terms):
        A, B = terms[delay_s]
        term = DelayedTerm(delay_s, A, B)
        delayed.append(term)
    return tuple(delayed)


def _add_law_forms(
    conditions: OperatingConditions,
    sites: Sequence[SiteJacobian],
    loop: LinearLoop,
) -> LinearLoop:
    """Adds control laws that gains do not fully describe to a linear model of the arms.

    These laws may have additional states, or send additional signals, such as waves. Such laws
    state their linear equations as a `LinearForm`. A sent signal becomes a state without a rate
    of change: an algebraic equation determines it, and the receiver reacts to its delayed
    value.

    Args:
        conditions: The sites (processes that each run one arm), gains and delays.
        sites: Linear model of each site by itself, without the other sites.
        loop: Linear model of the coupled arms without the additional equations.

    Returns:
        The model with the additional equations and states.
    """
    inertias = []
    for site in sites:
        inverse_inertia = site.rates.qdd[:, site.layout.external_torque]
        inertia = np.linalg.inv(inverse_inertia)
        inertias.append(inertia)

    forms = conditions.find_forms(inertias)
    blocks, names = _index_form_states(conditions, forms, loop)
    state_count = len(names)
    port_count = len(loop.inputs)

    def make_zeros() -> tuple[Array, Array]:
        zero_A = np.zeros((state_count, state_count))
        zero_B = np.zeros((state_count, port_count))
        return zero_A, zero_B

    terms = {0.0: make_zeros()}
    undelayed = DelayedTerm(0.0, loop.A, loop.B)
    for delay_s, A, B in (undelayed, *loop.delayed):
        late_A, late_B = terms.setdefault(delay_s, make_zeros())
        old_count = len(A)
        late_A[:old_count, :old_count] = A
        late_B[:old_count] = B
    for i, form in enumerate(forms):
        if form is not None:
            _add_form(conditions, sites, blocks=blocks, i=i, form=form, terms=terms)

    # some laws send accelerations, which are complete only at this point
    E = np.ones(state_count)
    undelayed_A, _ = terms[0.0]
    for i, form in enumerate(forms):
        if form is None:
            continue
        acceleration = blocks[i, "qd"]
        identity = np.eye(len(sites[i].rates.qdd))
        for j in form.list_receivers():
            signal_rows = blocks[i, ("to", j)]
            E[signal_rows] = 0.0
            if form.sends_acceleration:
                for A, B in terms.values():
                    A[signal_rows] = A[acceleration]
                    B[signal_rows] = B[acceleration]
            undelayed_A[signal_rows, signal_rows] -= identity

    A, B = terms.pop(0.0)
    outputs, old_states = loop.C.shape
    added_states = state_count - old_states
    new_columns = np.zeros((outputs, added_states))
    return loop._replace(
        names=tuple(names),
        A=A,
        B=B,
        C=np.hstack([loop.C, new_columns]),
        delayed=_sort_terms(terms),
        E=E,
    )


_StateBlocks = dict[tuple[int, BlockKey], slice]
"""Positions of the states of each signal of a law, by index of the site and name of the signal.
"""


def _index_form_states(
    conditions: OperatingConditions,
    forms: Sequence[LinearForm | None],
    loop: LinearLoop,
) -> tuple[_StateBlocks, list[str]]:
    """Assigns a position in the loop's state to each state and sent signal of the laws.

    The joint angles and velocities of the arms have positions already. A law with a linear form
    adds its own states, and one state for each signal that it sends to a peer.

    Args:
        conditions: The gains, delays and weights of the loop.
        forms: Linear form of each site's law. `None` for a law without such a form.
        loop: The loop without these states.

    Returns:
        The positions of the states of all signals.
        The names of all states of the loop, the added states last.
    """
    blocks: _StateBlocks = {}
    names = list(loop.names)
    named_forms = zip(conditions.names, forms, strict=True)
    for i, (site_name, form) in enumerate(named_forms):
        joints = conditions.sites[i].layout.joints
        for kind in ("q", "qd"):
            first = names.index(f"{site_name}.{kind}1")
            blocks[i, kind] = slice(first, first + joints)

        if form is None:
            continue
        labels: dict[BlockKey, str] = {state: state for state in form.states}
        for j in form.list_receivers():
            labels["to", j] = f"to_{conditions.names[j]}_"

        numbers = range(1, joints + 1)
        for signal, label in labels.items():
            first = len(names)
            blocks[i, signal] = slice(first, first + joints)
            names += [f"{site_name}.{label}{number}" for number in numbers]
    return blocks, names


def _add_form(
    conditions: OperatingConditions,
    sites: Sequence[SiteJacobian],
    *,
    blocks: _StateBlocks,
    i: int,
    form: LinearForm,
    terms: dict[float, tuple[Array, Array]],
) -> None:
    """Adds the linear equations of one arm's control law to the matrices of the whole loop.

    Args:
        conditions: The gains, delays and weights of the loop.
        sites: Derivatives of each site's rates.
        blocks: Positions of the states of all signals.
        i: Index of the site.
        form: Linear form of its law.
        terms: Matrices of state and torque by delay, which are changed in place.
    """
    site = sites[i]
    layout = site.layout
    ports = _list_blocks([jacobian.layout.joints for jacobian in sites])
    A, B = terms[0.0]

    def find_delayed_matrix(j: int) -> Array:
        """Returns the matrix through which delayed states of all arms act on the loop.

        The delay is the age of the samples of site j when site i uses them. If no matrix for
        this delay exists, a zero matrix is added.

        Args:
            j: Index of the site that sends the samples.

        Returns:
            The matrix, shape (n, n) for the n states of the loop. The caller modifies it in
            place.
        """
        delay_s = float(conditions.age_s[i, j])
        if delay_s not in terms:
            terms[delay_s] = (np.zeros_like(A), np.zeros_like(B))
        late_A, _ = terms[delay_s]
        return late_A

    external = layout.external_torque
    for (row, column), gain in form.blocks.items():
        if row == "tau":
            rows = blocks[i, "qd"]
            inverse_inertia = site.rates.qdd[:, external]
            block = inverse_inertia @ gain
        else:
            rows = blocks[i, row]
            block = gain
        if column == "tau_h":
            q_columns = blocks[i, "q"]
            qd_columns = blocks[i, "qd"]
            motion = slice(q_columns.start, qd_columns.stop)
            torque_on_arm = site.rates.external + site.rates.held
            torque_by_motion = torque_on_arm[:, : layout.qd.stop]
            torque_by_input = torque_on_arm[:, external]
            A[rows, motion] += block @ torque_by_motion
            B[rows, ports[i]] += block @ torque_by_input
        elif column in ("q_des", "qd_des"):
            signal = str(column).removesuffix("_des")
            shares = conditions.alpha[i]
            for j in np.flatnonzero(shares).tolist():
                late_A = find_delayed_matrix(j)
                columns = blocks[j, signal]
                late_A[rows, columns] += shares[j] * block
        elif isinstance(column, tuple):
            sender = column[1]
            sent_signal = (sender, ("to", i))
            if sent_signal in blocks:
                late_A = find_delayed_matrix(sender)
                columns = blocks[sent_signal]
                late_A[rows, columns] += block
        else:
            columns = blocks[i, column]
            A[rows, columns] += block
