"""Computes the stability of coupled arms whose controllers act once per tick.

The controller of a site acts once per tick, while the arm moves continuously. At each tick the
site sends a sample to the other sites. Tick rates and delays may differ between sites, but the
whole pattern repeats after a period T. Such a periodic system is analysed by Floquet theory.
Each site is linearised over one tick:

    X_i[k + 1] = P_i X_i[k] + sum_j P_ij X_j[m_ij(k)]

X_i[k] is the state of site i at its tick k, P_i and P_ij are constant matrices, and m_ij(k) is
the number of the sample of site j that site i uses at tick k. Over a period, these equations
form a linear map. Its eigenvalues mu, the multipliers, give the characteristic roots s = ln(mu)
/ T. The loop is stable if all roots have a negative real part. The largest multipliers are
approximated in a block Krylov space (block Arnoldi; Saad, "Numerical Methods for Large
Eigenvalue Problems", second edition (2011), chapter 6).

The integration scheme of the scenario defines how a controller updates its parameter estimates
and which torque it applies. Let f_k be the rate of the estimates at tick k, tau_k the computed
torque, and h the tick period. Both schemes store a variable eta with eta_{k+1} = eta_k + h f_k:

- The scheme `digital` uses the estimate eta_k and applies tau_k.
- The scheme `second_order` uses the estimate eta_k + h/2 f_k and applies 1.5 tau_k - 0.5
  tau_{k-1}.

The law `sync` uses the estimate eta_k + h/2 f_k in either scheme.

A control law written by a user may have a memory, the values m_k that it stores at tick k. The
memory takes the place of eta, with the rate f_k = (m_k - m_{k-1}) / h.

Invariant:
    - Delays are never replaced by their mean. The roots are exact if delays and ticks repeat
      after T.
    - If delays are random or recorded, the roots are computed as though a span of length T
      repeated forever. The deviation of the roots between parts of the span is reported.
    - Motions that stay constant for any delays, such as a shift of all arms to another common
      pose, are removed before the roots are computed.
    - Between ticks the torque is held (zero-order hold), and the motion of the linearised arm
      is computed exactly.
"""

import math
import re
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from ...core import Array, IntArray, SiteSetup
from ...scenario import LinkBase
from ..blas_threads import limit_blas_threads
from ..delay_period import MAX_NEAR_PERIOD_S, DelayPeriod
from .characteristic_roots import (
    NAMED_SHARE,
    ZERO_SHARE,
    CharacteristicRoot,
    Complex,
    Pencil,
    Spectrum,
)
from .characteristic_roots import STABILITY_EDGE_PER_S as _STILL_PER_S
from .linear_loop import SiteJacobian, compute_couplings, join_diagonal_blocks
from .operating_point import Equilibrium, OperatingConditions
from .tick_recurrence import add_matrix_products


def discretise_zero_order_hold(A: Array, B: Array, h_s: float) -> tuple[Array, Array]:
    """Returns the matrices Phi and Gamma of x' = A x + B u over a period with constant u.

    The state after the period is Phi x + Gamma u, with Phi = exp(A h) and Gamma = int_0^h exp(A
    s) ds B. Both are computed from one matrix exponential: Van Loan, "Computing integrals
    involving the matrix exponential", IEEE Trans. Automatic Control 23 (1978).

    Args:
        A: Matrix of the states, shape (n, n).
        B: Matrix of the inputs, shape (n, m).
        h_s: The period h, in s.
    """
    n, m = B.shape
    augmented = np.zeros((n + m, n + m))
    augmented[:n, :n] = A * h_s
    augmented[:n, n:] = B * h_s
    exponential = expm(augmented)
    return exponential[:n, :n], exponential[:n, n:]


class _SiteTickMap(NamedTuple):
    """Linear model of one arm over one tick (control period): X' = P X + Q w.

    X contains the n states of the arm at a tick, and X' the states at the next tick. w contains
    the values that the arm receives from the other arms.

    Attributes:
        P: Effect of the states, shape (n, n). The states are the joint angles and velocities,
            the stored parameter estimates, and, for the scheme `second_order`, the torque of
            the previous tick.
        Q: Effect of the received values, shape (n, inputs).
        output: Matrix that computes the values for the other sites from X, shape (3 m, n).
            These values are the pose, its velocity and the reflected torque, with m entries
            each.
        names: Names of the states.
    """

    P: Array
    Q: Array
    output: Array
    names: tuple[str, ...]


def _linearise_site_tick(site: SiteSetup, jacobian: SiteJacobian) -> _SiteTickMap:
    """Builds the linear model of one site over one tick, from a model in continuous time.

    A site is a process that runs one arm, and a tick is one period of its control loop.

    Args:
        site: Setup of the site.
        jacobian: Linear model of the site in continuous time.

    Returns:
        The matrices that map the states and inputs at one tick to the states at the next tick.
    """
    layout = jacobian.layout
    rates = jacobian.rates
    joints = layout.joints
    h_s = 1.0 / site.rate_hz
    is_second_order = not site.digital
    # The law `sync` integrates its estimates by the trapezoid rule in either scheme.
    has_estimates = site.gains.is_adaptive
    uses_trapezoid = has_estimates and (is_second_order or site.gains.absolute)
    motion = slice(0, layout.qd.stop)
    # the same slice of the arguments and of X
    memory = layout.estimate
    states = list(jacobian.states)
    if is_second_order:
        states += [f"tau{joint + 1}" for joint in range(joints)]
    first_input = layout.inputs.start
    input_count = layout.inputs.stop - first_input
    arguments_by_inputs = np.eye(layout.arguments, input_count, -first_input)
    arguments_by_X = np.eye(layout.arguments, len(states))
    arguments_by_X[layout.states :] = 0.0
    Phi, Gamma = _discretise_arm(jacobian, h_s)

    def compute_control(arguments: Array) -> Array:
        """Returns the contribution of the controller to a site's state at the next tick.

        The controller torque moves the arm, and the parameter estimates change. The torque of
        this tick is kept for the next tick if the integration scheme needs it. The contribution
        is linear in the arguments.

        Args:
            arguments: States and inputs of the site, in the order of `ArgumentLayout`, shape
                (arguments, columns).

        Returns:
            The contribution to the state at the next tick, shape (n, columns) for n site
            states.
        """
        f = rates.estimate @ arguments
        correction: Array | float = 0.0
        if uses_trapezoid:
            correction = 0.5 * h_s * rates.tau[:, memory] @ f
        tau = rates.tau @ arguments + correction
        factor = 1.5 if is_second_order else 1.0
        u = factor * tau + rates.held @ arguments
        rows = [Gamma @ u, h_s * f]
        if is_second_order:
            rows.append(tau)
        return np.vstack(rows)

    P = compute_control(arguments_by_X)
    Q = compute_control(arguments_by_inputs)
    P[motion, motion] += Phi
    P[memory, memory] += np.eye(layout.parameters)
    if is_second_order:
        P[motion, memory.stop :] -= 0.5 * Gamma
    output = np.zeros((3 * layout.coordinates, len(states)))
    output[:, : layout.states] = jacobian.output
    names = tuple(f"{site.name}.{state}" for state in states)
    return _SiteTickMap(P, Q, output, names)


def _discretise_arm(jacobian: SiteJacobian, h_s: float) -> tuple[Array, Array]:
    """Returns the matrices of an arm over a tick in which the torque is held.

    The controller computes its torque once per tick, but the arm moves continuously. The free
    arm moves by its own dynamics, and by environments that act continuously.

    Args:
        jacobian: Derivatives of the site's rates.
        h_s: Length of a tick, in s.
    """
    layout = jacobian.layout
    rates = jacobian.rates
    joints = layout.joints
    motion = slice(0, layout.qd.stop)
    external = layout.external_torque
    # an imported law may use the external torque, which then acts on the arm twice
    torque_by_external = np.eye(joints) + rates.tau[:, external]
    qdd_by_external = rates.qdd[:, external]
    inverse_inertia = np.linalg.solve(torque_by_external.T, qdd_by_external.T).T

    # the torque that is held over the tick does not act on the free arm
    torque = rates.tau + rates.held
    qdd_by_torque = inverse_inertia @ torque[:, motion]
    free_qdd = rates.qdd[:, motion] - qdd_by_torque

    zero = np.zeros((joints, joints))
    A = np.block([[zero, np.eye(joints)], [free_qdd]])
    B = np.vstack([zero, inverse_inertia])
    return discretise_zero_order_hold(A, B, h_s)


class CoupledTicks(NamedTuple):
    """Linear model of all arms and their control loops over one tick.

    The eigenvalues of the model show whether small motions grow. Each of the n states belongs
    to one of the sites.

    Attributes:
        S: Matrix that maps the states of all sites to their values at the next tick, excluding
            the effects of sites on each other, shape (n, n). It is block diagonal.
        effects: For each pair (i, j), the effect of the states of site j on the states of site
            i, shape (n, n). Pairs without an effect are missing.
        names: Names of the states.
        owners: Index of the site to which each state belongs, shape (n,).
        constant: Number of omitted states that are constant or have no effect.
    """

    S: Array
    effects: dict[tuple[int, int], Array]
    names: tuple[str, ...]
    owners: NDArray[np.int64]
    constant: int

    @classmethod
    def of_conditions(
        cls, conditions: OperatingConditions, rest: Equilibrium
    ) -> "CoupledTicks":
        """Builds the linear model of all coupled arms over one tick.

        States that are constant or have no effect are left out.

        Args:
            conditions: The sites, gains and delays.
            rest: The equilibrium about which the sites are linearised.
        """
        jacobians = SiteJacobian.list_of_sites(conditions, rest)
        maps = []
        for site, jacobian in zip(conditions.sites, jacobians, strict=True):
            maps.append(_linearise_site_tick(site, jacobian))
        sizes = [len(tick_map.P) for tick_map in maps]
        owners = np.repeat(np.arange(len(maps)), sizes)
        names = [name for tick_map in maps for name in tick_map.names]

        couplings = compute_couplings(conditions, rest, jacobians)
        effects = np.zeros((len(couplings), len(owners), len(owners)))
        for effect, ((i, j), coupling) in zip(effects, couplings.items(), strict=True):
            block = np.ix_(owners == i, owners == j)
            effect[block] = maps[i].Q @ coupling @ maps[j].output

        # the moving part is found as for rates; numbers of pairs stand in for their delays
        S = join_diagonal_blocks([tick_map.P for tick_map in maps])
        changes = S - np.eye(len(owners))
        pair_numbers = np.arange(len(effects))
        changes_pencil = Pencil(changes, pair_numbers, effects)
        moving, moving_names, constant = changes_pencil.extract_moving_part(names)
        pairs = list(couplings)
        moving_effects = {}
        for n, effect in zip(moving.delays, moving.Ad, strict=True):
            moving_effects[pairs[int(n)]] = effect
        moving_states = [names.index(name) for name in moving_names]
        omitted = sum(jacobian.omitted_states for jacobian in jacobians)
        return cls(
            S=moving.A + np.eye(len(moving_names)),
            effects=moving_effects,
            names=moving_names,
            owners=owners[moving_states],
            constant=constant + omitted,
        )


DRAWN_SPAN_S = 30.0
"""Analysed span of delays that are drawn at random, in s."""
_LEAST_SPAN_S = 0.5
"""Shortest analysed span, in s.

If the period is shorter than this, or shorter than twice the ages, it is repeated.
"""
_PART_TICKS = 100
"""Ticks of the fastest site after which columns are scaled.

Columns may grow a thousandfold in each tick.
"""
_COLUMNS = 8
"""Number of columns of a block of the Krylov space."""
_MAX_COLUMNS = 240
"""Largest dimension of the Krylov space."""
_RESIDUAL = 1e-9
"""Largest residual of an exact multiplier, relative to its modulus."""
_LOOSE_RESIDUAL = 1e-4
"""Largest residual once the Krylov space has its largest dimension."""
_SMALLEST = 1e-7
"""Smallest multiplier that is considered, as a share of the largest."""
_SAME_ROOT = 1e-6
"""Largest absolute or relative difference of roots that count as equal."""


class SamplesInUse(NamedTuple):
    """The samples that every arm uses from each other arm, at every tick of a time span.

    At the beginning of the span, the ticks of all arms coincide.

    Attributes:
        span_s: Length of the span, in s.
        used: For each pair (i, j), the numbers of the samples of site j that site i uses, one
            per tick of site i. The sample that site j sends at the beginning of the span has
            the number 0.
        period_s: Time after which the pattern of ticks and delays repeats, in s, or `None` if
            it does not repeat. The span is an integer multiple of this period.
        is_exact: True if the pattern repeats exactly, False if it repeats only to within half a
            tick or not at all.
    """

    span_s: float
    used: Mapping[tuple[int, int], IntArray]
    period_s: float | None = None
    is_exact: bool = False

    @classmethod
    def predict(cls, conditions: OperatingConditions) -> "SamplesInUse":
        """Finds which samples of the other sites each site uses, at every tick of a time span.

        The pattern of used samples repeats after some time, and the span consists of complete
        repetitions. For random delays, which never repeat, the span has a fixed length, and its
        delays are drawn at random.

        Args:
            conditions: The sites, their tick rates, and the links between them.

        Returns:
            The used samples, and the length of the span.
        """
        rates_hz = [site.rate_hz for site in conditions.sites]
        common_hz = math.gcd(*rates_hz)
        links: list[LinkBase] = []
        if conditions.varying:
            links = [link for link, _ in conditions.links.values()]
        period = DelayPeriod.of_links(links, rates_hz)
        period_s = period.span_s
        delays_ms = [sum(link.moments()) + link.playout_ms for link in links]
        reach_ms = max(delays_ms, default=0.0)
        if period_s is not None:
            age_s = float(conditions.age_s.max())
            least_s = max(_LEAST_SPAN_S, 2.0 * age_s, 2e-3 * reach_ms)
            periods = math.ceil(least_s / period_s)
            span_s = period_s * periods
        else:
            is_drawn = any(link.random for link in links)
            longest_s = DRAWN_SPAN_S if is_drawn else MAX_NEAR_PERIOD_S
            span_s = math.ceil(longest_s * common_hz) / common_hz
        # the span starts when samples no longer depend on the start of the run
        settled_s = 4e-3 * reach_ms + 0.1
        start_s = math.ceil(settled_s * common_hz) / common_hz

        used = {}
        for i, j in conditions.coupled_pairs:
            hz = rates_hz[i]
            peer_hz = rates_hz[j]
            ticks = np.arange(round(span_s * hz))
            if conditions.varying:
                link, key = conditions.links[i, j]
                drawn = link.draw_used_samples(key, hz, peer_hz, start_s + span_s)
                first_tick = round(start_s * hz)
                first_sample = round(start_s * peer_hz)
                samples = drawn[first_tick + ticks]
                used[i, j] = np.maximum(samples, 0) - first_sample
            else:
                sample_times_s = ticks / hz - conditions.age_s[i, j]
                used[i, j] = np.rint(sample_times_s * peer_hz).astype(np.int64)
        return cls(span_s, used, period_s, is_exact=period.is_exact)


class _TickRun(NamedTuple):
    """Consecutive ticks (control periods) of one arm that can be computed together.

    All messages that the arm uses in these ticks have been sent before the first of them. Their
    effects are computed in one array operation, instead of tick by tick.

    Attributes:
        site: Index of the site.
        first: Number of the first tick, counted from the start of the span.
        ticks: Number of ticks.
    """

    site: int
    first: int
    ticks: int


class _SpanPart(NamedTuple):
    """A part of a span of time, after which the columns of states are scaled.

    Scaling keeps fast growing motions within the range of floating-point numbers.

    Attributes:
        runs: Ticks in an order in which every sample is known before its use.
        stops: Tick of each site after the part.
    """

    runs: list[_TickRun]
    stops: list[int]


def _plan_parts(
    ticks: Sequence[int],
    used: Mapping[tuple[int, int], IntArray],
    count: int,
) -> list[_SpanPart]:
    """Plans the order in which the ticks of all sites are computed, and divides the span.

    A tick can be computed only after all samples that it uses. The plan collects as many
    consecutive ticks of a site as possible, because their effects are then computed together.
    After each part of the span the columns are scaled, before they become too large.

    Args:
        ticks: Number of ticks of each site.
        used: By (i, j) the sample of site j at each tick of site i.
        count: Number of parts.
    """
    # entry n: number of ticks of site i that depend on samples of site j up to n only
    computable = {}
    for (i, j), samples in used.items():
        newest = np.maximum.accumulate(samples)
        known = np.arange(ticks[j] + 1)
        limits = np.searchsorted(newest, known, side="right")
        computable[i, j] = limits.tolist()
    peers: list[list[int]] = [[] for _ in ticks]
    for i, j in used:
        peers[i].append(j)

    done = [0] * len(ticks)
    parts = []
    for n in range(1, count + 1):
        runs = []
        # last tick of each site in this part, rounded up
        stops = [-(-total * n // count) for total in ticks]
        while done != stops:
            for i, stop in enumerate(stops):
                # as far as the samples of the peers that have been computed so far suffice
                known_until = [computable[i, j][done[j]] for j in peers[i]]
                until = min([stop, *known_until])
                first = done[i]
                if until > first:
                    runs.append(_TickRun(i, first, until - first))
                    done[i] = until
        parts.append(_SpanPart(runs, stops))
    return parts


class _PeerEffect(NamedTuple):
    """Effect of one arm on another, and the messages that the other arm uses at its ticks.

    A tick is a period of the control loop.

    Attributes:
        peer: Index of the peer.
        rows: Row of the peer's sent values that each tick of the site uses.
        effect: Effect of the peer's sent values on the site's next state, shape (n_i, r_j).
    """

    peer: int
    rows: IntArray
    effect: Array


class _Tracks(NamedTuple):
    """Simulated motion of one arm over a span of time, for several start states at once.

    Each start state has its own column.

    Attributes:
        states: States after the start of the span, including the start, shape (1 + ticks, n_i,
            columns).
        sent: Sent values of all ticks that are used, shape (past + 1 + ticks, r_i, columns).
            The first `past` rows are ticks before the start of the span.
    """

    states: Array
    sent: Array


class _SpanMap:
    """The linear map of small motions from the start of a span of time to its end.

    The sites act on each other through few quantities only. The sent values of a site are r_i
    combinations of its n_i states, from which the effects on all other sites follow. A column
    contains one motion: for each site, its sent values of the last ticks, as far back as a peer
    uses them, and then its present states. The matrix of the map would be very large, because
    it covers the past of all sites. It is therefore never built: the map is applied to columns
    by computing every tick.

    Attributes:
        neutral: Constant motions, orthonormal, shape (size, zeros).
        scales: Factors by which columns are multiplied after each part. The first application
            chooses them so that its columns have size 1.
    """

    def __init__(self, loop: CoupledTicks, rates_hz: Sequence[int], uses: SamplesInUse) -> None:

        sites = range(len(rates_hz))
        self._states = [np.flatnonzero(loop.owners == i) for i in sites]
        self._P = []
        for states in self._states:
            P = loop.S[np.ix_(states, states)]
            self._P.append(np.ascontiguousarray(P))
        # ticks of each site before the start of the span whose samples are used
        self._past = [1] * len(rates_hz)
        used = {}
        for i, j in loop.effects:
            samples = uses.used[i, j]
            ticks = np.arange(len(samples))
            # the newest sample at a tick is the last sample before it; rounded up
            now = -(-ticks * rates_hz[j] // rates_hz[i])
            used[i, j] = np.minimum(samples, now - 1)
            oldest = int((now - used[i, j]).max())
            self._past[j] = max(self._past[j], oldest)

        self._sent = [self._find_sent_values(loop, j) for j in sites]
        self._peer_effects: list[list[_PeerEffect]] = [[] for _ in rates_hz]
        for (i, j), samples in used.items():
            block = np.ix_(self._states[i], self._states[j])
            effect = loop.effects[i, j][block] @ self._sent[j].T
            rows = samples + self._past[j]
            self._peer_effects[i].append(_PeerEffect(j, rows, np.ascontiguousarray(effect)))

        self._ticks = [round(uses.span_s * hz) for hz in rates_hz]
        part_count = -(-max(self._ticks) // _PART_TICKS)
        self._parts = _plan_parts(self._ticks, used, part_count)
        self.scales: list[float] = []
        self.neutral = self._find_constant_motions(loop)

    def _find_sent_values(self, loop: CoupledTicks, j: int) -> Array:
        """Returns the combinations of an arm's states that act on the other arms.

        Only these must be stored for past ticks. They are an orthonormal basis of the row space
        of all effects of the arm.

        Args:
            loop: The loop.
            j: Index of the site.

        Returns:
            Matrix of shape (r_j, n_j).
        """
        states = self._states[j]
        effects = [
            effect[:, states] for (_, sender), effect in loop.effects.items() if sender == j
        ]
        if not effects or not len(states):
            return np.zeros((0, len(states)))
        _, values, right = np.linalg.svd(np.vstack(effects), full_matrices=False)
        acts = values > ZERO_SHARE * values[0]
        return np.ascontiguousarray(right[acts])

    def _find_constant_motions(self, loop: CoupledTicks) -> Array:
        """Returns an orthonormal basis of the motions that stay constant for any delays.

        A shift of all arms to another common pose is an example. States X stay constant if X =
        S X + sum_ij E_ij X, where E_ij are the effects of the sites on each other.

        Args:
            loop: Linear model of all sites over one tick.
        """
        identity = np.eye(len(loop.names))
        static_map = identity - loop.S - sum(loop.effects.values())
        _, values, right = np.linalg.svd(static_map)
        is_zero = values <= ZERO_SHARE * values[0]
        constant_states = right[is_zero].T
        columns = self.build_constant_columns(constant_states)
        return np.linalg.qr(columns)[0]

    def build_constant_columns(self, X: Array) -> Array:
        """Returns columns of states for motions that have been constant in the past.

        Each column contains the values that all arms sent at their last ticks, as far back as
        they are used, and the states of all arms.

        Args:
            X: The constant states, shape (n, columns) for n states of all sites.

        Returns:
            The columns, shape (size, columns).
        """
        blocks = []
        for states, sent, past in zip(self._states, self._sent, self._past, strict=True):
            sent_values = sent @ X[states]
            blocks.append(np.tile(sent_values, (past, 1)))
            blocks.append(X[states])
        return np.vstack(blocks)

    def divide_out_constant(self, V: Array) -> Array:
        """Removes motions that never change, such as a constant offset, from columns of states.

        Their multipliers are exactly 1. Removing them lets the search find the other roots.

        Args:
            V: Columns, shape (size, columns).
        """
        constant_part = self.neutral @ (self.neutral.T @ V)
        return V - constant_part

    def _build_tracks(self, V: Array) -> list[_Tracks]:
        """Allocates the motion of each arm over the span, and copies the past into it.

        Args:
            V: Columns with the past, shape (size, columns).
        """
        columns = V.shape[1]
        tracks = []
        for sent, past, ticks in zip(self._sent, self._past, self._ticks, strict=True):
            r, n = sent.shape
            states = np.empty((1 + ticks, n, columns))
            sent_values = np.empty((past + 1 + ticks, r, columns))
            tracks.append(_Tracks(states, sent_values))
        start = [0] * len(tracks)
        self._write_columns(V, tracks, start)
        self._send_present(tracks, start)
        return tracks

    def _list_blocks(self, tracks: Sequence[_Tracks], stops: Sequence[int]) -> list[Array]:
        """Returns the recorded motion of all arms at given ticks, as blocks of one column.

        A tick is a period of an arm's control loop. The blocks are stacked to the state vector
        of the map from one span of time to the next.

        Args:
            tracks: Tracks of all sites.
            stops: Tick of each site, from the start of the span.
        """
        blocks = []
        for site_tracks, past, stop in zip(tracks, self._past, stops, strict=True):
            blocks.append(site_tracks.sent[stop : stop + past])
            blocks.append(site_tracks.states[stop : stop + 1])
        return blocks

    def _read_columns(self, tracks: Sequence[_Tracks], stops: Sequence[int]) -> Array:
        """Returns the columns at given ticks, shape (size, columns)."""
        blocks = self._list_blocks(tracks, stops)
        return np.concatenate([block.reshape(-1, block.shape[2]) for block in blocks])

    def _write_columns(self, V: Array, tracks: Sequence[_Tracks], stops: Sequence[int]) -> None:
        """Writes columns into the tracks at given ticks."""
        first = 0
        for block in self._list_blocks(tracks, stops):
            size = block.shape[0] * block.shape[1]
            block[:] = V[first : first + size].reshape(block.shape)
            first += size

    def apply(
        self,
        V: Array,
        *,
        divided: bool = True,
        sizes: list[Array] | None = None,
    ) -> tuple[Array, list[Array]]:
        """Computes how small motions of the arms develop over the analysed time span.

        Motions that grow over one span grow without limit, because the spans repeat.

        Args:
            V: Motions at the start of the span, shape (size, columns).
            divided: True to remove motions that stay constant, and to scale the columns after
                each part of the span.
            sizes: List to which the norm of each column after each part of the span is
                appended.

        Returns:
            The motions at the end of the span, shape (size, columns).
            For each site i, its n_i states at the start of the span and at every subsequent
            tick, shape (ticks + 1, n_i, columns).
        """
        tracks = self._build_tracks(V)
        for n, part in enumerate(self._parts):
            for run in part.runs:
                self._run_ticks(tracks, run)
            V = self._read_columns(tracks, part.stops)

            if divided:
                V = self.divide_out_constant(V)
                if n == len(self.scales):
                    size = float(np.abs(V).max())
                    self.scales.append(1.0 / max(1e-300, size))
                V *= self.scales[n]
                self._write_columns(V, tracks, part.stops)
                self._send_present(tracks, part.stops)
            if sizes is not None:
                sizes.append(np.linalg.norm(V, axis=0))
        return V, [site_tracks.states for site_tracks in tracks]

    def _send_present(self, tracks: Sequence[_Tracks], stops: Sequence[int]) -> None:
        """Recomputes the values that the arms send, after their present states were changed."""
        for site_tracks, sent, past, stop in zip(
            tracks, self._sent, self._past, stops, strict=True
        ):
            site_tracks.sent[past + stop] = sent @ site_tracks.states[stop]

    def _run_ticks(self, tracks: Sequence[_Tracks], run: _TickRun) -> None:
        """Computes the states of one site over consecutive ticks, and the values that it sends.

        The effects of the peers are known before the first of these ticks, so they are added
        for all ticks at once. The site's own states are computed tick by tick, since each
        depends on the previous state.

        Args:
            tracks: Motion of each site over the span, filled in up to the first tick.
            run: The ticks.
        """
        i = run.site
        end = run.first + run.ticks
        states, sent_values = tracks[i]
        next_states = states[run.first + 1 : end + 1]
        next_states[:] = 0.0
        for peer, rows, effect in self._peer_effects[i]:
            used_rows = rows[run.first : end]
            add_matrix_products(next_states, effect, tracks[peer].sent, used_rows)
        # last, because each state needs the complete state of the tick before
        previous_rows = np.arange(run.first, end)
        add_matrix_products(next_states, self._P[i], states, previous_rows)

        next_sent = sent_values[self._past[i] + run.first + 1 : self._past[i] + end + 1]
        next_sent[:] = 0.0
        add_matrix_products(next_sent, self._sent[i], states, previous_rows + 1)


def _find_multipliers(
    span: _SpanMap,
    start: Array,
    wanted: int,
    largest_residual: float,
) -> tuple[Complex, Complex, NDArray[np.bool_]]:
    """Returns the largest multipliers of a span map, by the block Arnoldi method.

    The method applies the map repeatedly, each time to the block of columns that the last
    application added, and keeps an orthonormal basis of all columns so far. The eigenvalues of
    the small matrix H, which is the map in this basis, approach the largest multipliers. The
    method ends when all wanted multipliers are exact, when no new direction is found, or when
    the basis is full.

    Args:
        span: The map.
        start: Columns from which the Krylov space starts, shape (size, columns).
        wanted: Number of distinct moduli. Fewer result if the others are too close to zero.
        largest_residual: Largest residual of a multiplier, relative to its modulus.

    Returns:
        The multipliers, by falling modulus.
        Their vectors, as columns.
        True for each multiplier that is exact to `largest_residual`.
    """
    block = np.linalg.qr(span.divide_out_constant(start))[0]
    basis = block
    # the map in the basis
    H = np.zeros((block.shape[1], 0))
    while True:
        width = block.shape[1]
        W, _ = span.apply(block)
        new_columns = np.zeros((basis.shape[1], width))
        H = np.hstack([H, new_columns])
        # Gram-Schmidt twice: once loses orthogonality to rounding
        for _ in range(2):
            projection = basis.T @ W
            W -= basis @ projection
            H[:, -width:] += projection
        # what is left of W are the directions that the basis does not contain yet; the
        # singular values of W are those of its small factor
        directions, factor = np.linalg.qr(W)
        left, lengths, right = np.linalg.svd(factor)
        is_new = lengths > ZERO_SHARE * np.abs(H).max()
        left = directions @ left[:, is_new]
        remainder = (lengths[:, np.newaxis] * right)[is_new]

        mu, y = np.linalg.eig(H)
        order = _order_multipliers(mu, wanted)
        mu = mu[order]
        y = y[:, order]
        errors = np.linalg.norm(remainder @ y[-width:], axis=0)
        residual = errors / np.abs(mu)
        is_full = len(H) >= _MAX_COLUMNS
        limit = _LOOSE_RESIDUAL if is_full else largest_residual
        exact = residual <= limit
        if exact.all() or not is_new.any() or is_full:
            vectors = basis @ y
            return mu.astype(np.complex128), vectors.astype(np.complex128), exact

        block, R = np.linalg.qr(left - basis @ (basis.T @ left))
        zeros = np.zeros((len(remainder), len(H) - width))
        new_rows = np.hstack([zeros, R @ remainder])
        H = np.vstack([H, new_rows])
        basis = np.hstack([basis, block])


def _order_multipliers(mu: Complex, wanted: int) -> NDArray[np.int64]:
    """Returns the indices of the largest multipliers, by falling modulus.

    A multiplier is the factor by which a small motion grows over the span.

    Args:
        mu: The multipliers.
        wanted: Number of distinct moduli.
    """
    order = np.argsort(-np.abs(mu), kind="stable")
    moduli = np.abs(mu[order])
    # conjugate multipliers have the same modulus and count once
    is_smaller = moduli[1:] < (1.0 - _SAME_ROOT) * moduli[:-1]
    rank = np.cumsum(np.append(0, is_smaller))
    is_large = moduli > _SMALLEST * moduli[0]
    selected: NDArray[np.int64] = order[(rank < wanted) & is_large]
    return selected


class SampledLoop:
    """Linear model of coupled arms whose controllers act once per tick.

    The model can be evaluated at several equilibria. The modes about one equilibrium are a good
    starting point for finding the modes about a nearby equilibrium, which then takes half the
    time.

    Args:
        conditions: The sites, gains and delays. All control laws must permit linearisation tick
            by tick.
        uses: The samples of the other sites that each site uses. If `None`, they are derived
            from the links.
    """

    def __init__(
        self, conditions: OperatingConditions, uses: SamplesInUse | None = None
    ) -> None:
        assert not conditions.has_forms  # a law with a linear form has none in ticks
        self._conditions = conditions
        self._uses = uses or SamplesInUse.predict(conditions)
        self._rates_hz = [site.rate_hz for site in conditions.sites]
        # modes of the last spectrum as columns of a span map
        self._modes: Array | None = None

    @limit_blas_threads()
    def compute_spectrum(self, rest: Equilibrium, wanted: int = 6) -> Spectrum:
        """Computes the fastest growing (rightmost) roots of small motions about an equilibrium.

        A small motion is followed over a span of T seconds, after which the pattern of delays
        and ticks repeats. This gives a linear map of the states. Each eigenvalue z of the map
        corresponds to a root s with z = exp(s T).

        Args:
            rest: The equilibrium about which the loop is linearised.
            wanted: Number of roots. Fewer are returned if all other motions decay far faster.
        """
        uses = self._uses
        span_s: float | None = uses.period_s or uses.span_s
        if uses.period_s is not None and uses.period_s * max(self._rates_hz) < 1.5:
            # every tick is like the previous tick
            span_s = None

        loop = CoupledTicks.of_conditions(self._conditions, rest)
        deviation_per_s = None
        if not loop.names:
            return Spectrum(
                roots=(),
                zeros=loop.constant,
                drifting=0,
                dropped=0,
                order=0,
                span_s=span_s,
                is_exact=uses.is_exact,
            )
        span = _SpanMap(loop, self._rates_hz, uses)
        start = _draw_start(span, len(loop.names))
        s, vectors, exact = _find_roots(span, start, uses.span_s, wanted, _RESIDUAL)
        self._modes = np.hstack([vectors.real, vectors.imag[:, vectors.imag.any(axis=0)]])

        is_still = exact & (np.abs(s) <= _STILL_PER_S)
        # of two conjugate roots the upper one is described
        is_upper = exact & ~is_still & (s.imag >= -_SAME_ROOT)
        s = s[is_upper]
        upper_vectors = vectors[:, is_upper]
        modes = np.hstack([upper_vectors.real, upper_vectors.imag])
        roots: list[CharacteristicRoot] = []
        if len(s):
            if uses.period_s is None:
                rightmost = modes[:, :: len(s)]
                deviation_per_s = _estimate_deviation(span, rightmost, uses.span_s)
            # fast modes overflow; their late ticks are unused
            with np.errstate(all="ignore"):
                _, tracks = span.apply(modes, divided=False)
                roots = _describe_modes(s, tracks, loop, self._rates_hz)

        drifting = int(is_still.sum())
        return Spectrum(
            roots=tuple(roots[:wanted]),
            zeros=loop.constant + span.neutral.shape[1] + drifting,
            drifting=drifting,
            dropped=int((~exact).sum()),
            order=0,
            span_s=span_s,
            deviation_per_s=deviation_per_s,
            is_exact=uses.is_exact,
        )

    @limit_blas_threads()
    def measure_rightmost_rate(self, pose: Equilibrium, scale_per_s: float) -> float | None:
        """Computes the largest growth rate of small motions about a pose, to limited accuracy.

        Args:
            pose: The pose about which the loop is linearised.
            scale_per_s: Rate, in 1/s, that sets the accuracy: the error is at most about a
                thousandth of this rate.

        Returns:
            The real part of the rightmost root, in 1/s, or `None` if all roots are zero because
            of the structure of the loop.
        """
        loop = CoupledTicks.of_conditions(self._conditions, pose)
        if not loop.names:
            return None
        span_s = self._uses.span_s
        span = _SpanMap(loop, self._rates_hz, self._uses)
        start = _draw_start(span, len(loop.names))
        modes = self._modes
        if modes is not None and len(modes) == len(start):
            # a few random columns show modes that the first pose does not have
            start = np.hstack([modes, start])[:, :_COLUMNS]
        residual = min(max(1e-3 * abs(scale_per_s) * span_s, _RESIDUAL), _LOOSE_RESIDUAL)
        s, _, exact = _find_roots(span, start, span_s, 1, residual)
        moves = exact & (np.abs(s) > _STILL_PER_S)
        rates_per_s: list[float] = s[moves].real.tolist()
        return max(rates_per_s, default=None)


def _draw_start(span: _SpanMap, n: int) -> Array:
    """Returns random start columns for the search for eigenvectors, equal in every run.

    A fixed seed makes results repeatable.

    Args:
        span: The map whose modes are searched.
        n: Number of states of the loop.
    """
    random = np.random.default_rng(0)
    states = random.standard_normal((n, min(n, _COLUMNS)))
    return span.build_constant_columns(states)


def _find_roots(
    span: _SpanMap,
    start: Array,
    span_s: float,
    wanted: int,
    largest_residual: float,
) -> tuple[Complex, Complex, NDArray[np.bool_]]:
    """Returns the fastest growing (rightmost) roots of the loop over a span of time.

    A root is the complex growth rate of a small motion, which follows from an eigenvalue of the
    map over the span.

    Args:
        span: The map.
        start: Columns from which the search of modes starts, shape (size, columns).
        span_s: Length of the span, in s.
        wanted: Number of roots that are not zero by structure. Roots at zero are found in
            addition.
        largest_residual: Largest residual of a multiplier, relative to its modulus.

    Returns:
        Principal values of the roots, by falling real part, in 1/s.
        Their vectors, as columns.
        True for each root that is exact to the residual.
    """
    mu, vectors, exact = _find_multipliers(span, start, wanted + 1, largest_residual)
    log_scale = np.log(span.scales).sum()
    s = (np.log(mu) - log_scale) / span_s
    return s, vectors, exact


def _estimate_deviation(span: _SpanMap, mode: Array, span_s: float) -> float:
    """Estimates the standard deviation of a root over the parts of a span, in 1/s.

    The logarithm of the mode's size over the parts is treated as a random walk. The mean
    variance of the walk's Brownian bridge is a twelfth of the variance of the walk's end.

    Args:
        span: The map.
        mode: Real and imaginary part of the mode as columns, shape (size, 2).
        span_s: Length of the span, in s.
    """
    sizes: list[Array] = []
    span.apply(mode, sizes=sizes)
    real_sizes, imaginary_sizes = np.transpose(sizes)
    mode_sizes = np.hypot(real_sizes, imaginary_sizes)
    log_scales = np.cumsum(np.log(span.scales))
    growth = np.log(mode_sizes) - log_scales
    steady_growth = np.linspace(growth[0], growth[-1], len(growth))
    bridge = growth - steady_growth
    return math.sqrt(12.0) * float(np.std(bridge)) / span_s


def _describe_modes(
    s: Complex,
    tracks: Sequence[Array],
    loop: CoupledTicks,
    rates_hz: Sequence[int],
) -> list[CharacteristicRoot]:
    """Returns the roots of modes, with their frequencies and their fastest joints.

    A multiplier determines a frequency only up to multiples of 2 pi / T. The multiple is that
    of the strongest line in the spectrum of the mode's fastest joint.

    Args:
        s: Principal values of the roots, shape (K,), in 1/s.
        tracks: States of each site over the span, with K columns of real parts and then K
            columns of imaginary parts.
        loop: The loop.
        rates_hz: Tick rate of each site.
    """
    count = len(s)
    roots: list[CharacteristicRoot] = []
    # 2 pi / T
    ticks = len(tracks[0]) - 1
    turn = 2.0 * np.pi * rates_hz[0] / ticks
    first_states = []
    for track in tracks:
        first = track[0]
        first_states.append(first[:, :count] + 1j * first[:, count:])
    amplitudes = np.abs(np.concatenate(first_states))
    velocities = []
    for state, name in enumerate(loop.names):
        quantity = name.rpartition(".")[2]
        if re.fullmatch(r"qd\d+", quantity):
            velocities.append(state)
    for n, principal in enumerate(s):
        falling = sorted(velocities, key=lambda state: -amplitudes[state, n])
        fastest = falling[0]
        i = int(loop.owners[fastest])
        first_state = int(np.argmax(loop.owners == i))
        joint_track = tracks[i][:, fastest - first_state]
        velocity = joint_track[:, n] + 1j * joint_track[:, n + count]
        offset = _find_strongest_offset(velocity, principal, rates_hz[i])
        omega = abs(principal.imag + turn * round(offset / turn))
        root = complex(principal.real, omega if omega > _SAME_ROOT else 0.0)
        match = _find_root(roots, root)
        if match is not None:
            multiplicity = roots[match].multiplicity + 1
            roots[match] = roots[match]._replace(multiplicity=multiplicity)
            continue
        least = NAMED_SHARE * amplitudes[fastest, n]
        names = [loop.names[state] for state in falling if amplitudes[state, n] >= least]
        roots.append(CharacteristicRoot(root, 1, tuple(names)))
    return sorted(roots, key=lambda root: -root.s.real)


def _find_strongest_offset(velocity: Complex, principal: complex, hz: int) -> float:
    """Returns the distance from the principal root of a motion to its strongest frequency.

    The multiplier of a period determines a frequency only up to multiples of 2 pi / period. The
    strongest frequency selects one of them.

    Args:
        velocity: Velocity of a joint in the mode, with one value per tick.
        principal: Principal value of the root, in 1/s.
        hz: Tick rate of the joint's site.
    """
    # beyond fifteen time constants the track consists of rounding errors
    usable = 2 + int(15.0 * hz / max(1e-9, abs(principal.real)))
    ticks = min(len(velocity) - 1, usable)
    decay = np.exp(-principal * np.arange(ticks) / hz)
    spectrum = np.abs(np.fft.fft(velocity[:ticks] * decay))
    frequencies_hz = np.fft.fftfreq(ticks, 1.0 / hz)
    offset: float = 2.0 * np.pi * frequencies_hz[spectrum.argmax()]
    return offset


def _find_root(roots: Sequence[CharacteristicRoot], s: complex) -> int | None:
    """Returns the index of the first known root that is equal to a new one, or `None`.

    A root is a complex growth rate of small motions. Equal roots must not be counted twice.

    Args:
        roots: The known roots.
        s: The new root, in 1/s. Roots that differ by at most `_SAME_ROOT` count as equal.
    """
    for index, known in enumerate(roots):
        if abs(known.s - s) <= _SAME_ROOT * (1.0 + abs(s)):
            return index
    return None
