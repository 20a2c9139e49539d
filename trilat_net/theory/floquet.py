"""Roots of the sampled loop by Floquet theory, over the period of tick rates and delays.

Each site is linearised over one tick of its own rate:

    X_i[k + 1] = P_i X_i[k] + sum_j P_ij X_j[m_ij(k)]

with m_ij(k) the sample of site j that site i uses at its tick k. The multipliers mu of the map
M over a period T, M v = mu v, give the roots s = ln(mu) / T. They are Ritz values of a block
Krylov space (block Arnoldi): Saad, "Numerical Methods for Large Eigenvalue Problems", second
edition (2011), chapter 6.

Scheme `second_order`: theta_k = theta_{k-1} + h/2 (f_{k-1} + f_k) with f the rate of the
estimate, and the torque on the arm is 1.5 tau_k - 0.5 tau_{k-1}. With the state
eta_k = theta_{k-1} + h/2 f_{k-1} that is theta_k = eta_k + h/2 f_k and
eta_{k+1} = eta_k + h f_k.

Scheme `digital`: theta_k = eta_k, eta_{k+1} = eta_k + h f_k, and the torque on the arm is
tau_k.

The memory of an imported law is eta too: with h f = m_k - m_{k-1} it is the law's own value.

Invariant:
    - No delay is averaged. Where delays and rates repeat after T, the roots are exact. Where
      delays are drawn or recorded, the roots are those of a span T as though it repeated, with
      their deviation between the span's parts.
    - Constant motions (shared poses, estimates without excitation), which exist for any delays,
      are divided out.
    - The arm is exact between ticks under a held torque (zero-order hold); the controller runs
      its stages in their order.
"""

import math
import re
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag, expm

from ..core.delay import DelayKind, TraceEnd
from ..core.site_setup import Law, Scheme, SiteSetup
from ..core.vectors import Array, IntArray
from ..scenario.delay_models import LinkBase
from ..scenario.sample_uses import draw_used_samples
from .characteristic_roots import (
    NAMED_SHARE,
    ZERO_SHARE,
    CharacteristicRoot,
    Complex,
    Pencil,
    Spectrum,
    extract_moving_part,
    limit_blas_threads,
)
from .characteristic_roots import STABILITY_EDGE_PER_S as _STILL_PER_S
from .linear_loop import SiteJacobian, compute_couplings, differentiate_rates
from .operating_point import Equilibrium, OperatingConditions


def discretise_zero_order_hold(A: Array, B: Array, h_s: float) -> tuple[Array, Array]:
    """Returns x' = A x + B u over a period with u held, as the matrices of x and u.

    They are exp(A h) and int_0^h exp(A s) ds B, computed as one matrix exponential: Van Loan,
    "Computing integrals involving the matrix exponential", IEEE Trans. Automatic Control 23
    (1978).

    Args:
        A: shape (n, n).
        B: shape (n, m).
        h_s: the period, s.
    """
    n, m = B.shape
    augmented = np.zeros((n + m, n + m))
    augmented[:n, :n] = A * h_s
    augmented[:n, n:] = B * h_s
    exponential = expm(augmented)
    return exponential[:n, :n], exponential[:n, n:]


class SiteTickMap(NamedTuple):
    """One site over a tick: X' = P X + Q w with the inputs w from its peers.

    Attributes:
        P: shape (n, n); X holds q, qd, the state eta of the estimate, and, for the scheme
            `second_order`, the torque of the previous tick.
        Q: shape (n, inputs).
        output: the samples for the peers by X, shape (3 m, n), see `SiteJacobian.output`.
        names: names of the states.
    """

    P: Array
    Q: Array
    output: Array
    names: tuple[str, ...]


def linearise_site_tick(site: SiteSetup, jacobian: SiteJacobian) -> SiteTickMap:
    """Returns one site over a tick, from the derivatives of its rates.

    Args:
        site: setup of the site.
        jacobian: derivatives of its rates, see `differentiate_rates`.
    """
    layout = jacobian.layout
    rates = jacobian.rates
    joints = layout.joints
    h_s = 1.0 / site.rate_hz
    is_second_order = site.scheme is Scheme.SECOND_ORDER
    uses_trapezoid = is_second_order and site.gains.law is Law.ADAPTIVE
    motion = slice(0, layout.qd.stop)
    memory = layout.estimate  # the same slice of the arguments and of X
    state_count = layout.states + (joints if is_second_order else 0)
    input_count = layout.inputs.stop - layout.inputs.start
    arguments_by_inputs = np.eye(layout.arguments, input_count, -layout.inputs.start)
    arguments_by_X = np.eye(layout.arguments, state_count)
    arguments_by_X[layout.states :] = 0.0
    # an imported law may use the external torque, which then acts on the arm twice
    torque_by_external = np.eye(joints) + rates.tau[:, layout.external_torque]
    qdd_by_external = rates.qdd[:, layout.external_torque]
    inverse_inertia = np.linalg.solve(torque_by_external.T, qdd_by_external.T).T
    zero = np.zeros((joints, joints))
    free_motion = rates.qdd[:, motion] - inverse_inertia @ (rates.tau + rates.held)[:, motion]
    Phi, Gamma = discretise_zero_order_hold(
        np.block([[zero, np.eye(joints)], [free_motion]]),
        np.vstack([zero, inverse_inertia]),
        h_s,
    )

    def compute_control(arguments: Array) -> Array:
        """Returns the controller's part of X', for arguments as a matrix of a vector."""
        f = rates.estimate @ arguments
        correction = 0.5 * h_s * rates.tau[:, memory] @ f if uses_trapezoid else 0.0
        tau = rates.tau @ arguments + correction
        u = (1.5 if is_second_order else 1.0) * tau + rates.held @ arguments
        rows = [Gamma @ u, h_s * f]
        if is_second_order:
            rows.append(tau)
        return np.vstack(rows)

    P = compute_control(arguments_by_X)
    Q = compute_control(arguments_by_inputs)
    P[motion, motion] += Phi
    P[memory, memory] += np.eye(layout.parameters)
    states = list(jacobian.states)
    if is_second_order:
        P[motion, memory.stop :] -= 0.5 * Gamma
        states += [f"tau{joint + 1}" for joint in range(joints)]
    output = np.zeros((3 * layout.coordinates, state_count))
    output[:, : layout.states] = jacobian.output
    return SiteTickMap(P, Q, output, tuple(f"{site.name}.{state}" for state in states))


class CoupledTicks(NamedTuple):
    """The sites over one tick each, and the effects of their states on their peers.

    Attributes:
        S: block diagonal of the sites' own maps, shape (n, n).
        effects: effect of site j on site i, where there is one, shape (n, n) each, by (i, j).
        names: names of the states.
        owners: index of the site to which each state belongs, shape (n,).
        constant: number of omitted states that are constant or without effect.
    """

    S: Array
    effects: dict[tuple[int, int], Array]
    names: tuple[str, ...]
    owners: NDArray[np.int64]
    constant: int


def couple_ticks(conditions: OperatingConditions, rest: Equilibrium) -> CoupledTicks:
    """Returns the sites over a tick, and their effects, without constant states."""
    sites = differentiate_rates(conditions, rest)
    maps = [
        linearise_site_tick(site, jacobian)
        for site, jacobian in zip(conditions.sites, sites, strict=True)
    ]
    owners = np.repeat(np.arange(len(maps)), [len(tick_map.P) for tick_map in maps])
    couplings = compute_couplings(conditions, rest, sites)
    effects = np.zeros((len(couplings), len(owners), len(owners)))
    for effect, ((i, j), coupling) in zip(effects, couplings.items(), strict=True):
        block = np.ix_(owners == i, owners == j)
        effect[block] = maps[i].Q @ coupling @ maps[j].output
    changes = block_diag(*(tick_map.P for tick_map in maps)) - np.eye(len(owners))
    names = [name for tick_map in maps for name in tick_map.names]
    # the moving part is found as for rates; numbers of pairs stand in for their delays
    changes_pencil = Pencil(changes, np.arange(len(effects)), effects)
    moving, moving_names, constant = extract_moving_part(changes_pencil, names)
    pairs = list(couplings)
    moving_effects = {
        pairs[int(n)]: effect for n, effect in zip(moving.delays, moving.Ad, strict=True)
    }
    return CoupledTicks(
        S=moving.A + np.eye(len(moving_names)),
        effects=moving_effects,
        names=moving_names,
        owners=owners[[names.index(name) for name in moving_names]],
        constant=constant + sum(site.omitted_states for site in sites),
    )


MAX_PERIOD_S = 60.0
"""The longest period that is searched, and the longest analysed span of a trace."""
DRAWN_SPAN_S = 30.0
"""The analysed span of delays that are drawn."""
_LEAST_SPAN_S = 0.5
"""The shortest analysed span.

Periods that are shorter, or shorter than twice the ages, are repeated.
"""
_SLIP = 0.05
"""Delays that repeat within this share of a tick count as repeating.

If none do, the span with the smallest slip counts, up to half a tick.
"""
_PART_TICKS = 100
"""Ticks of the fastest site after which columns are scaled.

Columns may grow a thousandfold in each tick.
"""
_COLUMNS = 8
"""Columns of a block of the Krylov space."""
_MAX_COLUMNS = 240
"""Largest dimension of the Krylov space."""
_RESIDUAL = 1e-9
"""Largest residual of an exact multiplier, relative to its modulus."""
_LOOSE_RESIDUAL = 1e-4
"""The same limit once the Krylov space has its largest dimension."""
_SMALLEST = 1e-7
"""Multipliers below this share of the largest are not searched."""
_SAME_ROOT = 1e-6


class SamplesInUse(NamedTuple):
    """The samples that sites use over a span that begins with a tick of every site.

    Attributes:
        span_s: length of the span, s.
        used: by (i, j) the sample of site j at each tick of site i, counted from the sample of
            the span's beginning.
        period_s: period of delays and tick rates, which divides the span, s; None: they do not
            repeat.
    """

    span_s: float
    used: Mapping[tuple[int, int], IntArray]
    period_s: float | None = None


def _find_cycle_s(link: LinkBase) -> float:
    """Returns the period of a link's delay, s; 0 if it is constant or does not repeat."""
    model = link.to_core_model()
    points = link.points
    if points is not None and model.kind == DelayKind.TRACE and len(points) > 1:
        # the last point lasts as long as the one before
        return float(2 * points[-1, 0] - points[-2, 0]) * 1e-6
    if model.kind == DelayKind.SINE:
        return float(model.extra) * 1e-6
    return 0.0


def find_samples_in_use(conditions: OperatingConditions) -> SamplesInUse:
    """Returns the samples in use over the period of delays and rates, or over a drawn span."""
    rates_hz = [site.rate_hz for site in conditions.sites]
    common_hz = math.gcd(*rates_hz)
    links = [link for link, _ in conditions.links.values()] if conditions.varying else []
    spans_s = np.arange(1, round(MAX_PERIOD_S * common_hz) + 1) / common_hz
    # share of a tick by which the delays fail to repeat after each span
    slips = np.zeros(len(spans_s))
    for link in links:
        cycle_s = _find_cycle_s(link)
        if cycle_s:
            cycles = np.maximum(1.0, np.round(spans_s / cycle_s))
            slips = np.maximum(slips, np.abs(spans_s - cycle_s * cycles) * max(rates_hz))
    first_match = int(np.argmax(slips <= max(_SLIP, float(slips.min()))))
    is_drawn = any(link.random for link in links)
    models = [link.to_core_model() for link in links]
    has_ending_trace = any(
        model.kind == DelayKind.TRACE and model.at_end == TraceEnd.HOLD for model in models
    )
    repeats = not is_drawn and not has_ending_trace and slips[first_match] <= 0.5
    period_s = float(spans_s[first_match]) if repeats else None
    reach_ms = max((sum(link.moments()) + link.playout_ms for link in links), default=0.0)
    if period_s is not None:
        age_s = float(conditions.age_s.max())
        least_s = max(_LEAST_SPAN_S, 2.0 * age_s, 2e-3 * reach_ms)
        span_s = period_s * math.ceil(least_s / period_s)
    else:
        longest_s = DRAWN_SPAN_S if is_drawn else MAX_PERIOD_S
        span_s = math.ceil(longest_s * common_hz) / common_hz
    # the span starts when samples no longer depend on the start of the run
    start_s = math.ceil((4e-3 * reach_ms + 0.1) * common_hz) / common_hz
    used = {}
    for i, j in conditions.coupled_pairs:
        ticks = np.arange(round(span_s * rates_hz[i]))
        if conditions.varying:
            first_tick = round(start_s * rates_hz[i])
            link, key = conditions.links[i, j]
            drawn = draw_used_samples(link, key, rates_hz[i], rates_hz[j], start_s + span_s)
            first_sample = round(start_s * rates_hz[j])
            used[i, j] = np.maximum(drawn[first_tick + ticks], 0) - first_sample
        else:
            sample_times_s = ticks / rates_hz[i] - conditions.age_s[i, j]
            used[i, j] = np.rint(sample_times_s * rates_hz[j]).astype(np.int64)
    return SamplesInUse(span_s, used, period_s)


class _TickRun(NamedTuple):
    """Consecutive ticks of one site that depend on known samples only."""

    site: int
    first: int
    ticks: int


class _SpanPart(NamedTuple):
    """A part of a span, after which columns are scaled.

    Attributes:
        runs: ticks in an order in which every sample is known before its use.
        stops: the tick of each site after the part.
    """

    runs: list[_TickRun]
    stops: list[int]


def _plan_parts(
    ticks: Sequence[int], used: Mapping[tuple[int, int], IntArray], count: int
) -> list[_SpanPart]:
    """Returns the order of all ticks of a span, in parts.

    Args:
        ticks: number of ticks of each site.
        used: by (i, j) the sample of site j at each tick of site i.
        count: number of parts.
    """
    # entry n: number of ticks of site i that depend on samples of site j up to n only
    computable = {}
    for (i, j), samples in used.items():
        newest = np.maximum.accumulate(samples)
        limits = np.searchsorted(newest, np.arange(ticks[j] + 1), side="right")
        computable[i, j] = limits.tolist()
    peers = [[j for i, j in used if i == site] for site in range(len(ticks))]
    done = [0] * len(ticks)
    parts = []
    for n in range(1, count + 1):
        runs = []
        stops = [-(-total * n // count) for total in ticks]
        while done != stops:
            for i, stop in enumerate(stops):
                until = min([stop, *(computable[i, j][done[j]] for j in peers[i])])
                if until > done[i]:
                    runs.append(_TickRun(i, done[i], until - done[i]))
                    done[i] = until
        parts.append(_SpanPart(runs, stops))
    return parts


class _PeerEffect(NamedTuple):
    """The effect of one peer on a site.

    Attributes:
        peer: index of the peer.
        rows: row of the peer's track that each tick of the site uses.
        effect: effect of the peer's state on the site's next state, shape (n_i, n_j).
    """

    peer: int
    rows: IntArray
    effect: Array


class _SpanMap:
    """The linear loop over a span, as an operator on columns.

    A column holds the states of each site at its last ticks, as far back as a peer uses them.

    Attributes:
        neutral: constant motions, orthonormal, shape (size, zeros).
        scales: factors by which columns are multiplied after each part. The first application
            chooses them so that its columns have size 1.
    """

    def __init__(self, loop: CoupledTicks, rates_hz: Sequence[int], uses: SamplesInUse) -> None:
        n = len(loop.names)
        self._states = [np.flatnonzero(loop.owners == i) for i in range(len(rates_hz))]
        self._P = [loop.S[np.ix_(states, states)] for states in self._states]
        self._rows = [2] * len(rates_hz)
        used = {}
        for i, j in loop.effects:
            samples = uses.used[i, j]
            # at tick k the newest sample is the last one before it
            now = -(-np.arange(len(samples)) * rates_hz[j] // rates_hz[i])
            used[i, j] = np.minimum(samples, now - 1)
            self._rows[j] = max(self._rows[j], 1 + int((now - used[i, j]).max()))
        self._peer_effects: list[list[_PeerEffect]] = [[] for _ in rates_hz]
        for (i, j), samples in used.items():
            effect = loop.effects[i, j][np.ix_(self._states[i], self._states[j])]
            rows = samples + self._rows[j] - 1
            self._peer_effects[i].append(_PeerEffect(j, rows, effect))
        self._ticks = [round(uses.span_s * hz) for hz in rates_hz]
        self._parts = _plan_parts(self._ticks, used, -(-max(self._ticks) // _PART_TICKS))
        self.scales: list[float] = []
        static_map = np.eye(n) - loop.S - sum(loop.effects.values())
        _, values, right = np.linalg.svd(static_map)
        constant_states = right[values <= ZERO_SHARE * values[0]].T
        self.neutral = np.linalg.qr(self.build_constant_columns(constant_states))[0]

    def build_constant_columns(self, X: Array) -> Array:
        """Returns columns of which the past states all equal X, shape (n, columns)."""
        blocks = [
            np.tile(X[states], (rows, 1))
            for states, rows in zip(self._states, self._rows, strict=True)
        ]
        return np.vstack(blocks)

    def apply(
        self, V: Array, *, divided: bool = True, sizes: list[Array] | None = None
    ) -> tuple[Array, list[Array]]:
        """Returns columns after the span, and the track of each site.

        Args:
            V: columns, shape (size, columns).
            divided: divide out constant motions and scale the columns after each part.
            sizes: list to which the norm of each column after each part is appended.

        Returns:
            The columns after the span, and the states of each site from the start of the span
            on, shape (ticks + 1, n_i, columns) each.
        """
        shapes = [
            (rows, len(states), V.shape[1])
            for rows, states in zip(self._rows, self._states, strict=True)
        ]
        bounds = np.cumsum([rows * n for rows, n, _ in shapes])[:-1]
        tracks = []
        for block, shape, ticks in zip(np.split(V, bounds), shapes, self._ticks, strict=True):
            future = np.empty((ticks, *shape[1:]))
            tracks.append(np.concatenate([block.reshape(shape), future]))
        for n, part in enumerate(self._parts):
            for run in part.runs:
                self._run_ticks(tracks, run)
            last_states = [
                track[stop : stop + shape[0]]
                for track, stop, shape in zip(tracks, part.stops, shapes, strict=True)
            ]
            V = np.concatenate([states.reshape(-1, V.shape[1]) for states in last_states])
            if divided:
                V -= self.neutral @ (self.neutral.T @ V)
                if n == len(self.scales):
                    self.scales.append(1.0 / max(1e-300, float(np.abs(V).max())))
                V *= self.scales[n]
                for states, block in zip(last_states, np.split(V, bounds), strict=True):
                    states[:] = block.reshape(states.shape)
            if sizes is not None:
                sizes.append(np.linalg.norm(V, axis=0))
        from_start = [track[rows - 1 :] for track, rows in zip(tracks, self._rows, strict=True)]
        return V, from_start

    def _run_ticks(self, tracks: Sequence[Array], run: _TickRun) -> None:
        """Computes the states of one site over consecutive ticks, in its track."""
        i = run.site
        now = run.first + self._rows[i] - 1
        P = self._P[i]
        state = tracks[i][now]
        next_states = tracks[i][now + 1 : now + 1 + run.ticks]
        next_states[:] = 0.0
        for peer, rows, effect in self._peer_effects[i]:
            samples = tracks[peer][rows[run.first : run.first + run.ticks]]
            next_states += effect @ samples
        for next_state in next_states:
            next_state += P @ state
            state = next_state


def _find_multipliers(
    span: _SpanMap, n: int, wanted: int
) -> tuple[Complex, Complex, NDArray[np.bool_]]:
    """Returns the largest multipliers of a span map, by the block Arnoldi method.

    Args:
        span: the map.
        n: number of states of the loop.
        wanted: number of distinct moduli; fewer result if the others are too close to zero.

    Returns:
        The multipliers by falling modulus, their vectors as columns, and which multipliers are
        exact to `_RESIDUAL`.
    """
    start_states = np.random.default_rng(0).standard_normal((n, min(n, _COLUMNS)))
    block = span.build_constant_columns(start_states)
    block = np.linalg.qr(block - span.neutral @ (span.neutral.T @ block))[0]
    basis = block
    H = np.zeros((block.shape[1], 0))
    while True:
        W = span.apply(block)[0]
        H = np.hstack([H, np.zeros((basis.shape[1], block.shape[1]))])
        # Gram-Schmidt twice: once loses orthogonality to rounding
        for _ in range(2):
            projection = basis.T @ W
            W -= basis @ projection
            H[:, -block.shape[1] :] += projection
        left, lengths, right = np.linalg.svd(W, full_matrices=False)
        is_new = lengths > ZERO_SHARE * np.abs(H).max()
        left = left[:, is_new]
        remainder = (lengths[:, np.newaxis] * right)[is_new]
        mu, y = np.linalg.eig(H)
        order = np.argsort(-np.abs(mu), kind="stable")
        moduli = np.abs(mu[order])
        # conjugate multipliers have the same modulus and count once
        is_smaller = moduli[1:] < (1.0 - _SAME_ROOT) * moduli[:-1]
        rank = np.cumsum(np.append(0, is_smaller))
        order = order[(rank < wanted) & (moduli > _SMALLEST * moduli[0])]
        errors = np.linalg.norm(remainder @ y[-block.shape[1] :, order], axis=0)
        residual = errors / np.abs(mu[order])
        is_full = len(H) >= _MAX_COLUMNS
        exact = residual <= (_LOOSE_RESIDUAL if is_full else _RESIDUAL)
        if exact.all() or not is_new.any() or is_full:
            vectors = basis @ y[:, order]
            return mu[order].astype(np.complex128), vectors.astype(np.complex128), exact
        zeros = np.zeros((len(remainder), len(H) - block.shape[1]))
        block, R = np.linalg.qr(left - basis @ (basis.T @ left))
        H = np.vstack([H, np.hstack([zeros, R @ remainder])])
        basis = np.hstack([basis, block])


def compute_sampled_spectrum(
    conditions: OperatingConditions,
    rest: Equilibrium,
    wanted: int = 6,
    uses: SamplesInUse | None = None,
) -> Spectrum | None:
    """Returns the rightmost roots of the sampled loop.

    Args:
        conditions: the numbers of the loop.
        rest: the equilibrium.
        wanted: number of roots; fewer result if the others are too close to -infinity.
        uses: the samples in use; None: those of the scenario's links.

    Returns:
        The roots; None if a law has states or waves of its own, because such a law is
        linearised in continuous time only.
    """
    if conditions.has_forms:
        return None
    rates_hz = [site.rate_hz for site in conditions.sites]
    uses = uses or find_samples_in_use(conditions)
    span_s: float | None = uses.period_s or uses.span_s
    if uses.period_s is not None and uses.period_s * max(rates_hz) < 1.5:
        span_s = None  # every tick is like the one before
    loop = couple_ticks(conditions, rest)
    deviation_per_s = None
    if not loop.names:
        return Spectrum(
            roots=(), zeros=loop.constant, drifting=0, dropped=0, order=0, span_s=span_s
        )
    with limit_blas_threads():
        span = _SpanMap(loop, rates_hz, uses)
        mu, vectors, exact = _find_multipliers(span, len(loop.names), wanted + 1)
        s = (np.log(mu) - np.log(span.scales).sum()) / uses.span_s
        is_still = exact & (np.abs(s) <= _STILL_PER_S)
        is_upper = exact & ~is_still & (s.imag >= -_SAME_ROOT)
        s = s[is_upper]
        modes = np.hstack([vectors[:, is_upper].real, vectors[:, is_upper].imag])
        roots: list[CharacteristicRoot] = []
        if len(s):
            if uses.period_s is None:
                rightmost = modes[:, :: len(s)]
                deviation_per_s = _estimate_deviation(span, rightmost, uses.span_s)
            with np.errstate(all="ignore"):  # fast modes overflow; their late ticks are unused
                tracks = span.apply(modes, divided=False)[1]
                roots = _describe_modes(s, tracks, loop, rates_hz)
    drifting = int(is_still.sum())
    return Spectrum(
        roots=tuple(roots[:wanted]),
        zeros=loop.constant + span.neutral.shape[1] + drifting,
        drifting=drifting,
        dropped=int((~exact).sum()),
        order=0,
        span_s=span_s,
        deviation_per_s=deviation_per_s,
    )


def _estimate_deviation(span: _SpanMap, mode: Array, span_s: float) -> float:
    """Returns the standard deviation of a root over the parts of a span, 1/s.

    The logarithm of the mode's size over the parts is taken as a random walk. The variance of
    its Brownian bridge is a twelfth of the walk's.

    Args:
        span: the map.
        mode: real and imaginary part of the mode as columns, shape (size, 2).
        span_s: length of the span, s.
    """
    sizes: list[Array] = []
    span.apply(mode, sizes=sizes)
    growth = np.log(np.hypot(*np.transpose(sizes))) - np.cumsum(np.log(span.scales))
    bridge = growth - np.linspace(growth[0], growth[-1], len(growth))
    return math.sqrt(12.0) * float(np.std(bridge)) / span_s


def _describe_modes(
    s: Complex, tracks: Sequence[Array], loop: CoupledTicks, rates_hz: Sequence[int]
) -> list[CharacteristicRoot]:
    """Returns the roots of modes, with their frequencies and their fastest joints.

    A multiplier determines a frequency up to multiples of 2 pi / T only. The multiple is that
    of the strongest line in the spectrum of the mode's fastest joint.

    Args:
        s: principal values of the roots, shape (K,), 1/s.
        tracks: states of each site from the start of the span on, with K columns of real parts
            and then K of imaginary parts.
        loop: the loop.
        rates_hz: tick rate of each site.
    """
    count = len(s)
    roots: list[CharacteristicRoot] = []
    turn = 2.0 * np.pi * rates_hz[0] / (len(tracks[0]) - 1)
    first_states = [track[0, :, :count] + 1j * track[0, :, count:] for track in tracks]
    amplitudes = np.abs(np.concatenate(first_states))
    velocities = [
        state
        for state, name in enumerate(loop.names)
        if re.fullmatch(r"qd\d+", name.rpartition(".")[2])
    ]
    for n, principal in enumerate(s):
        falling = sorted(velocities, key=lambda state: -amplitudes[state, n])
        fastest = falling[0]
        i = int(loop.owners[fastest])
        site_state = fastest - int(np.argmax(loop.owners == i))
        hz = rates_hz[i]
        # beyond fifteen time constants the track consists of rounding errors
        usable = 2 + int(15.0 * hz / max(1e-9, abs(principal.real)))
        ticks = min(len(tracks[i]) - 1, usable)
        track = tracks[i][:ticks, site_state]
        velocity = track[:, n] + 1j * track[:, n + count]
        spectrum = np.abs(np.fft.fft(velocity * np.exp(-principal * np.arange(ticks) / hz)))
        offset = 2.0 * np.pi * np.fft.fftfreq(ticks, 1.0 / hz)[spectrum.argmax()]
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


def _find_root(roots: Sequence[CharacteristicRoot], s: complex) -> int | None:
    """Returns the index of the first root equal to s within `_SAME_ROOT`, or None."""
    for index, known in enumerate(roots):
        if abs(known.s - s) <= _SAME_ROOT * (1.0 + abs(s)):
            return index
    return None
