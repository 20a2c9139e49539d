"""Roots of the sampled loop by Floquet's theory, over the period of tick rates and delays, or a
span of them.

    X_i[k + 1] = P_i X_i[k] + sum_j P_ij X_j[m_ij(k)],    M v = mu v over the span T,    s =
    ln(mu) / T

with m_ij(k) the sample of j that site i uses at its tick k, every site at its own rate.

Invariant: no delay is averaged. Where delays and rates repeat after T the roots are exact;
where delays are drawn or recorded they are those of T as though it repeated, with the deviation
between its parts. Constant motions (shared poses, estimates without excitation), which are
there for any delays, are divided out.

mu are Ritz values of a block Krylov space: Saad, "Numerical Methods for Large Eigenvalue
Problems", second edition (2011), chapter 6.

The sampled loop, linearised tick by tick: each site over a period of its own rate.

    X_i[k + 1] = P_i X_i[k] + sum_j P_ij X_j[m],    m the sample of j that is in use

Invariant: the arm is exact between ticks under a held torque (zero-order hold); the controller
runs its stages in their order.

`second_order`: theta_k = theta_{k-1} + h/2 (f_{k-1} + f_k) with f the rate of the estimate, and
the torque on the arm is 1.5 tau_k - 0.5 tau_{k-1}. With eta_k = theta_{k-1} + h/2 f_{k-1} that
is theta_k = eta_k + h/2 f_k and eta_{k+1} = eta_k + h f_k. `digital`: theta_k = eta_k,
eta_{k+1} = eta_k + h f_k, and the torque on the arm is tau_k. The memory of a law of one's own
is eta: with h f = m_k - m_{k-1} it is what the law makes of it.
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
    """Returns exp(A h) and int_0^h exp(A s) ds B: x' = A x + B u over a period h, s, with u
    held.

    Van Loan, "Computing integrals involving the matrix exponential", IEEE Trans. Automatic
    Control 23 (1978).
    """
    n, m = B.shape
    whole = np.zeros((n + m, n + m))
    whole[:n, :n] = A * h_s
    whole[:n, n:] = B * h_s
    exponential = expm(whole)
    return exponential[:n, :n], exponential[:n, n:]


class SiteTickMap(NamedTuple):
    """One site over a period: X' = P X + Q w with the input w from its peers.

    Attributes:
        P: shape (n, n); X is q, qd, eta of its estimate, and, with `second_order`, the torque
            before.
        Q: shape (n, inputs).
        sent: its output to peers, shape (3 m, n), see `SiteJacobian.sent`.
        names: of its states.
    """

    P: Array
    Q: Array
    sent: Array
    names: tuple[str, ...]


def linearise_site_tick(site: SiteSetup, jacobian: SiteJacobian) -> SiteTickMap:
    """Returns one site over a period, from the derivatives of its rates
    (`differentiate_rates`).
    """
    at = jacobian.layout
    rates = jacobian.rates
    h_s = 1.0 / site.rate_hz
    second = site.scheme is Scheme.SECOND_ORDER
    arm = slice(0, at.qd.stop)
    memory = at.estimate  # places in arguments and in X alike
    n = at.states + (at.joints if second else 0)
    peers = np.eye(at.arguments, at.inputs.stop - at.inputs.start, -at.inputs.start)
    own = np.eye(at.arguments, n)
    own[at.states :] = 0.0
    # one of one's own may use what it feels
    by_law = np.eye(at.joints) + rates.tau[:, at.external_torque]
    inverse_inertia = np.linalg.solve(by_law.T, rates.qdd[:, at.external_torque].T).T
    trapezoid = second and site.gains.law is Law.ADAPTIVE
    zero = np.zeros((at.joints, at.joints))
    free = rates.qdd[:, arm] - inverse_inertia @ (rates.tau + rates.held)[:, arm]
    Phi, Gamma = discretise_zero_order_hold(
        np.block([[zero, np.eye(at.joints)], [free]]), np.vstack([zero, inverse_inertia]), h_s
    )

    def control(by: Array) -> Array:
        """Returns the change of X by the controller, whose arguments are `by` times a vector."""
        f = rates.estimate @ by
        tau = rates.tau @ by + (0.5 * h_s * rates.tau[:, memory] @ f if trapezoid else 0.0)
        u = (1.5 if second else 1.0) * tau + rates.held @ by
        return np.vstack([Gamma @ u, h_s * f, *([tau] if second else [])])

    P = control(own)
    Q = control(peers)
    P[arm, arm] += Phi
    P[memory, memory] += np.eye(at.parameters)
    if second:
        P[arm, memory.stop :] -= 0.5 * Gamma
    sent = np.zeros((3 * at.coordinates, n))
    sent[:, : at.states] = jacobian.output
    states = (*jacobian.states, *(f"tau{joint + 1}" for joint in range(at.joints) if second))
    return SiteTickMap(P, Q, sent, tuple(f"{site.name}.{state}" for state in states))


class CoupledTicks(NamedTuple):
    """The sites over a period each, and the effect of what one was on what another is a tick
    later.

    Attributes:
        S: of each site by itself, on the diagonal, shape (n, n).
        effects: of site j on site i, where there is one, shape (n, n) each, by (i, j).
        names: of the states.
        owners: the site that each state is of, shape (n,).
        constant: number of states left out since nothing changes them, or they change nothing.
    """

    S: Array
    effects: dict[tuple[int, int], Array]
    names: tuple[str, ...]
    owners: NDArray[np.int64]
    constant: int


def couple_ticks(conditions: OperatingConditions, rest: Equilibrium) -> CoupledTicks:
    """Returns what moves of the sites over a period of their own rates, and their effects on
    each other.
    """
    sites = differentiate_rates(conditions, rest)
    maps = [
        linearise_site_tick(site, own)
        for site, own in zip(conditions.sites, sites, strict=True)
    ]
    owners = np.repeat(np.arange(len(maps)), [len(one.P) for one in maps])
    couplings = compute_couplings(conditions, rest, sites)
    effects = np.zeros((len(couplings), len(owners), len(owners)))
    for effect, ((i, j), coupling) in zip(effects, couplings.items(), strict=True):
        effect[np.ix_(owners == i, owners == j)] = maps[i].Q @ coupling @ maps[j].sent
    # what moves is told by the changes; the numbers of the pairs stand for their delays
    changes = block_diag(*(one.P for one in maps)) - np.eye(len(owners))
    names = [name for one in maps for name in one.names]
    moving, kept, constant = extract_moving_part(
        Pencil(changes, np.arange(len(effects)), effects), names
    )
    pairs = list(couplings)
    return CoupledTicks(
        S=moving.A + np.eye(len(kept)),
        effects={
            pairs[int(n)]: effect for n, effect in zip(moving.delays, moving.Ad, strict=True)
        },
        names=kept,
        owners=owners[[names.index(name) for name in kept]],
        constant=constant + sum(one.omitted_states for one in sites),
    )


MAX_PERIOD_S = 60.0
"""The longest period that is looked for, and the longest span of a trace."""
DRAWN_SPAN_S = 30.0
"""The span of delays that are drawn."""
_LEAST_SPAN_S = 0.5
"""A shorter period, or one shorter than twice the ages, is gone through several times."""
_SLIP = 0.05
"""Delays that repeat to this share of a tick repeat; else the nearest span does, to half a
tick.
"""
_PART_TICKS = 100
"""Columns are scaled after so many ticks of the fastest site: they may grow a thousandfold in
each.
"""
_COLUMNS = 8
_MAX_COLUMNS = 240
_RESIDUAL = 1e-9
_LOOSE_RESIDUAL = 1e-4
"""The largest residual of a multiplier, relative to it; the other when the columns are at an
end.
"""
_SMALLEST = 1e-7
"""Multipliers below this share of the largest are not looked for."""
_SAME_ROOT = 1e-6


class SamplesInUse(NamedTuple):
    """The samples that sites use over a span, which begins with a tick of every site.

    Attributes:
        span_s: its length, s.
        used: by (i, j) the sample of j at each tick of i, counted from that with which the span
            begins.
        period_s: delays and tick rates repeat after it, and after the span; None: they do not
            repeat.
    """

    span_s: float
    used: Mapping[tuple[int, int], IntArray]
    period_s: float | None = None


def find_samples_in_use(conditions: OperatingConditions) -> SamplesInUse:
    """Returns the samples in use over the period of delays and rates, or over a span of what is
    drawn.
    """
    rates_hz = [site.rate_hz for site in conditions.sites]
    common_hz = math.gcd(*rates_hz)
    links = [link for link, _ in conditions.links.values()] if conditions.varying else []
    spans_s = np.arange(1, round(MAX_PERIOD_S * common_hz) + 1) / common_hz
    slips = np.zeros(len(spans_s))  # by which share of a tick the delays have not repeated
    for link in links:
        model = link.to_core_model()
        points = link.points
        cycle_s = 0.0
        if points is not None and model.kind == DelayKind.TRACE and len(points) > 1:
            cycle_s = float(2 * points[-1, 0] - points[-2, 0]) * 1e-6
        elif model.kind == DelayKind.SINE:
            cycle_s = model.extra * 1e-6
        if cycle_s:
            off_s = np.abs(spans_s - cycle_s * np.maximum(1.0, np.round(spans_s / cycle_s)))
            slips = np.maximum(slips, off_s * max(rates_hz))
    place = int(np.argmax(slips <= max(_SLIP, float(slips.min()))))
    drawn = any(link.random for link in links)
    kinds = [(model.kind, model.at_end) for model in (link.to_core_model() for link in links)]
    ends = (DelayKind.TRACE, TraceEnd.HOLD) in kinds
    period_s = None if drawn or ends or slips[place] > 0.5 else float(spans_s[place])
    span_s = math.ceil((DRAWN_SPAN_S if drawn else MAX_PERIOD_S) * common_hz) / common_hz
    reach_ms = max((sum(link.moments()) + link.playout_ms for link in links), default=0.0)
    if period_s is not None:
        least_s = max(_LEAST_SPAN_S, 2.0 * float(conditions.age_s.max()), 2e-3 * reach_ms)
        span_s = period_s * math.ceil(least_s / period_s)
    # past what the beginning is like
    start_s = math.ceil((4e-3 * reach_ms + 0.1) * common_hz) / common_hz
    used = {}
    for i, j in conditions.coupled_pairs:
        ticks = np.arange(round(span_s * rates_hz[i]))
        first = round(start_s * rates_hz[i])
        used[i, j] = np.rint(
            (ticks / rates_hz[i] - conditions.age_s[i, j]) * rates_hz[j]
        ).astype(np.int64)
        if conditions.varying:
            whole = draw_used_samples(
                *conditions.links[i, j], rates_hz[i], rates_hz[j], start_s + span_s
            )
            used[i, j] = np.maximum(whole[first + ticks], 0) - round(start_s * rates_hz[j])
    return SamplesInUse(span_s, used, period_s)


_Parts = list[tuple[list[tuple[int, int, int]], list[int]]]


def _plan_parts(
    ticks: Sequence[int], used: Mapping[tuple[int, int], IntArray], count: int
) -> _Parts:
    """Returns the parts of a span in which every site makes so many ticks, with each site's
    tick after it.

    A part is runs of ticks, a site, the first and how many, whose samples are known when their
    turn comes.
    """
    known = {
        (i, j): np.searchsorted(
            np.maximum.accumulate(m), np.arange(ticks[j] + 1), side="right"
        ).tolist()
        for (i, j), m in used.items()
    }
    peers = [[j for i, j in used if i == site] for site in range(len(ticks))]
    done = [0] * len(ticks)
    parts = []
    for n in range(1, count + 1):
        runs = []
        stops = [-(-total * n // count) for total in ticks]
        while done != stops:
            for i, stop in enumerate(stops):
                until = min([stop, *(known[i, j][done[j]] for j in peers[i])])
                if until > done[i]:
                    runs.append((i, done[i], until - done[i]))
                    done[i] = until
        parts.append((runs, stops))
    return parts


class _SpanMap:
    """The linear loop over a span: an operator on columns, of each site the states at its last
    ticks.

    Attributes:
        neutral: constant motions, orthonormal, shape (size, zeros).
        scales: by which columns are multiplied after each part, as their size at first asks.
    """

    def __init__(self, loop: CoupledTicks, rates_hz: Sequence[int], uses: SamplesInUse) -> None:
        n = len(loop.names)
        self._own = [np.flatnonzero(loop.owners == i) for i in range(len(rates_hz))]
        self._P = [loop.S[np.ix_(own, own)] for own in self._own]
        self._rows = [2] * len(rates_hz)
        used = {}
        for i, j in loop.effects:
            now = -(-np.arange(len(uses.used[i, j])) * rates_hz[j] // rates_hz[i])
            used[i, j] = np.minimum(uses.used[i, j], now - 1)
            self._rows[j] = max(self._rows[j], 1 + int((now - used[i, j]).max()))
        self._peers: list[list[tuple[int, IntArray, Array]]] = [[] for _ in rates_hz]
        for (i, j), m in used.items():
            effect = loop.effects[i, j][np.ix_(self._own[i], self._own[j])]
            self._peers[i].append((j, m + self._rows[j] - 1, effect))
        self._ticks = [round(uses.span_s * hz) for hz in rates_hz]
        self._parts = _plan_parts(self._ticks, used, -(-max(self._ticks) // _PART_TICKS))
        self.scales: list[float] = []
        _, values, right = np.linalg.svd(np.eye(n) - loop.S - sum(loop.effects.values()))
        self.neutral = np.linalg.qr(self.hold(right[values <= ZERO_SHARE * values[0]].T))[0]

    def hold(self, X: Array) -> Array:
        """Returns columns whose states X, shape (n, columns), have always been so."""
        return np.vstack(
            [np.tile(X[own], (n, 1)) for own, n in zip(self._own, self._rows, strict=True)]
        )

    def advance(
        self, V: Array, *, divided: bool = True, sizes: list[Array] | None = None
    ) -> tuple[Array, list[Array]]:
        """Returns columns after the span, and the states of each site by ticks; `sizes` get
        those by parts.

        The columns are scaled, and without constant motions, unless they shall not be
        `divided`.
        """
        shapes = [
            (rows, len(own), V.shape[1])
            for rows, own in zip(self._rows, self._own, strict=True)
        ]
        ends = np.cumsum([rows * n for rows, n, _ in shapes])[:-1]
        tracks = [
            np.concatenate([last.reshape(shape), np.empty((ticks, *shape[1:]))])
            for last, shape, ticks in zip(np.split(V, ends), shapes, self._ticks, strict=True)
        ]
        for n, (runs, stops) in enumerate(self._parts):
            for run in runs:
                self._run_ticks(tracks, *run)
            last = [
                track[at : at + shape[0]]
                for track, at, shape in zip(tracks, stops, shapes, strict=True)
            ]
            V = np.concatenate([one.reshape(-1, V.shape[1]) for one in last])
            if divided:
                V -= self.neutral @ (self.neutral.T @ V)
                if n == len(self.scales):
                    self.scales.append(1.0 / max(1e-300, float(np.abs(V).max())))
                V *= self.scales[n]
                for one, part in zip(last, np.split(V, ends), strict=True):
                    one[:] = part.reshape(one.shape)
            if sizes is not None:
                sizes.append(np.linalg.norm(V, axis=0))
        return V, [track[rows - 1 :] for track, rows in zip(tracks, self._rows, strict=True)]

    def _run_ticks(self, tracks: Sequence[Array], i: int, first: int, count: int) -> None:
        at = first + self._rows[i] - 1
        P = self._P[i]
        x = tracks[i][at]
        after = tracks[i][at + 1 : at + 1 + count]
        after[:] = 0.0
        for j, rows, effect in self._peers[i]:
            after += effect @ tracks[j][rows[first : first + count]]
        for one in after:
            one += P @ x
            x = one


def _find_multipliers(
    span: _SpanMap, n: int, wanted: int
) -> tuple[Complex, Complex, NDArray[np.bool_]]:
    """Returns the multipliers of `wanted` moduli, falling, their vectors as columns, and which
    are exact.

    Of a loop of n states; fewer if the others are too small to be told from zero.
    """
    first = np.random.default_rng(0).standard_normal((n, min(n, _COLUMNS)))
    block = span.hold(first)
    block = np.linalg.qr(block - span.neutral @ (span.neutral.T @ block))[0]
    basis = block
    H = np.zeros((block.shape[1], 0))
    while True:
        W = span.advance(block)[0]
        H = np.hstack([H, np.zeros((basis.shape[1], block.shape[1]))])
        for _ in range(2):
            onto = basis.T @ W
            W -= basis @ onto
            H[:, -block.shape[1] :] += onto
        left, lengths, right = np.linalg.svd(W, full_matrices=False)
        new = lengths > ZERO_SHARE * np.abs(H).max()
        left = left[:, new]
        beyond = (lengths[:, np.newaxis] * right)[new]
        mu, y = np.linalg.eig(H)
        order = np.argsort(-np.abs(mu), kind="stable")
        sizes = np.abs(mu[order])
        # conjugates have one
        number = np.cumsum(np.append(0, sizes[1:] < (1.0 - _SAME_ROOT) * sizes[:-1]))
        order = order[(number < wanted) & (sizes > _SMALLEST * sizes[0])]
        residual = np.linalg.norm(beyond @ y[-block.shape[1] :, order], axis=0) / np.abs(
            mu[order]
        )
        exact = residual <= (_RESIDUAL if len(H) < _MAX_COLUMNS else _LOOSE_RESIDUAL)
        if exact.all() or not new.any() or len(H) >= _MAX_COLUMNS:
            return (
                mu[order].astype(np.complex128),
                (basis @ y[:, order]).astype(np.complex128),
                exact,
            )
        before = np.zeros((len(beyond), len(H) - block.shape[1]))
        block, turned = np.linalg.qr(left - basis @ (basis.T @ left))
        H = np.vstack([H, np.hstack([before, turned @ beyond])])
        basis = np.hstack([basis, block])


def compute_sampled_spectrum(
    conditions: OperatingConditions,
    rest: Equilibrium,
    wanted: int = 6,
    uses: SamplesInUse | None = None,
) -> Spectrum | None:
    """Returns the rightmost roots of the sampled loop; fewer than `wanted` where the others
    cannot be told.

    None if a law has states or waves of its own, which is linearised in continuous time alone.
    `uses`: the samples in use, by default those of the scenario's links.
    """
    if conditions.has_forms:
        return None
    rates_hz = [site.rate_hz for site in conditions.sites]
    uses = uses or find_samples_in_use(conditions)
    span_s: float | None = uses.period_s or uses.span_s
    if uses.period_s is not None and uses.period_s * max(rates_hz) < 1.5:
        span_s = None
    loop = couple_ticks(conditions, rest)
    deviation = None
    if not loop.names:
        return Spectrum(
            roots=(), zeros=loop.constant, drifting=0, dropped=0, order=0, span_s=span_s
        )
    with limit_blas_threads():
        span = _SpanMap(loop, rates_hz, uses)
        mu, vectors, exact = _find_multipliers(span, len(loop.names), wanted + 1)
        s = (np.log(mu) - np.log(span.scales).sum()) / uses.span_s
        still = exact & (np.abs(s) <= _STILL_PER_S)
        upper = exact & ~still & (s.imag >= -_SAME_ROOT)
        s = s[upper]
        both = np.hstack([vectors[:, upper].real, vectors[:, upper].imag])
        if uses.period_s is None and len(s):
            sizes: list[Array] = []
            span.advance(both[:, :: len(s)], sizes=sizes)
            grown = np.log(np.hypot(*np.transpose(sizes))) - np.cumsum(np.log(span.scales))
            bridge = grown - np.linspace(grown[0], grown[-1], len(grown))
            # of a random walk
            deviation = math.sqrt(12.0) * float(np.std(bridge)) / uses.span_s
        with np.errstate(all="ignore"):  # what grows this fast is not looked at to the end
            roots = (
                _describe_modes(s, span.advance(both, divided=False)[1], loop, rates_hz)
                if len(s)
                else []
            )
    zeros = loop.constant + span.neutral.shape[1] + int(still.sum())
    return Spectrum(
        roots=tuple(roots[:wanted]),
        zeros=zeros,
        drifting=int(still.sum()),
        dropped=int((~exact).sum()),
        order=0,
        span_s=span_s,
        deviation_per_s=deviation,
    )


def _describe_modes(
    s: Complex, tracks: Sequence[Array], loop: CoupledTicks, rates_hz: Sequence[int]
) -> list[CharacteristicRoot]:
    """Returns the roots of modes, with their fastest joints and the strongest frequency of the
    fastest.

    A multiplier tells a frequency but for multiples of 2 pi / T. The tracks have real parts,
    then imaginary.
    """
    roots: list[CharacteristicRoot] = []
    turn = 2.0 * np.pi * rates_hz[0] / (len(tracks[0]) - 1)
    sizes = np.abs(
        np.concatenate([track[0, :, : len(s)] + 1j * track[0, :, len(s) :] for track in tracks])
    )
    speeds = [
        n
        for n, name in enumerate(loop.names)
        if re.fullmatch(r"qd\d+", name.rpartition(".")[2])
    ]
    for n, one in enumerate(s):
        order = sorted(speeds, key=lambda state: -sizes[state, n])
        i = int(loop.owners[order[0]])
        state = order[0] - int(np.argmax(loop.owners == i))
        hz = rates_hz[i]
        # then rounding shows
        seen = min(len(tracks[i]) - 1, 2 + int(15.0 * hz / max(1e-9, abs(one.real))))
        speed = tracks[i][:seen, state, n] + 1j * tracks[i][:seen, state, n + len(s)]
        lines = np.abs(np.fft.fft(speed * np.exp(-one * np.arange(seen) / hz)))
        offset = 2.0 * np.pi * np.fft.fftfreq(seen, 1.0 / hz)[lines.argmax()]
        omega = abs(one.imag + turn * round(offset / turn))
        root = complex(one.real, omega if omega > _SAME_ROOT else 0.0)
        same = [
            k
            for k, known in enumerate(roots)
            if abs(known.s - root) <= _SAME_ROOT * (1.0 + abs(root))
        ]
        if same:
            roots[same[0]] = roots[same[0]]._replace(
                multiplicity=roots[same[0]].multiplicity + 1
            )
            continue
        named = [
            loop.names[m] for m in order if sizes[m, n] >= NAMED_SHARE * sizes[order[0], n]
        ]
        roots.append(CharacteristicRoot(root, 1, tuple(named)))
    return sorted(roots, key=lambda root: -root.s.real)
