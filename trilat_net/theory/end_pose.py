"""The loop linearised where a recorded run ended, beside the certificate of its log.

Invariant: the roots are those at the log's own end pose and estimates, under the conditions at its end; they
speak of small motions there. Where delays are drawn or measured they are those over the very samples that the
last quarter of the records has in use; mean ages serve for laws that are linearised in continuous time alone.
Only twins are executed.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import permutations

import msgspec
import numpy as np

from ..analysis.certificate.stability_certificate import Certificate, EndPoseRoots, certify
from ..analysis.run_end import SETTLED_SPEED_RAD_S
from ..analysis.timeline import recorded_end_s
from ..analysis.twin_growth import TWINS, measure_twins
from ..core.vectors import Array
from ..errors import ScenarioError
from ..log.accounting import MIN_COVERAGE
from ..log.log_reader import Log
from ..log.site_log import SiteLog
from ..scenario import Scenario
from ..scenario.delay_models.kernel_delays import ConstantDelay
from .characteristic_roots import compute_delay_spectrum
from .equilibrium import follow_equilibrium, pad_rows
from .floquet import DRAWN_SPAN_S, SamplesInUse, compute_sampled_spectrum
from .linear_edge import find_deepest_contact
from .linear_loop import linearise_loop
from .operating_point import Equilibrium, derive_operating_conditions

_ROOTS = 2
"""Roots that are looked for: the rightmost ones."""


def certify_run(
    log: Log, *, min_coverage: float = MIN_COVERAGE, own_laws: bool = False, twins: int = TWINS
) -> Certificate:
    """Returns the certificate of a log, with the roots of the loop where the run ended, and so many twins.

    See `certify`.

    Raises:
        LogError: a record cannot be read, or names a change that is none.
    """
    found = certify(log, min_coverage=min_coverage, own_laws=own_laws)
    growth = measure_twins(log, found.end, twins, own_laws=own_laws) if twins else None
    return replace(found, roots=find_end_pose_roots(log), twins=growth)


def find_end_pose_roots(log: Log) -> EndPoseRoots:
    """Returns the roots of the loop where a run ended, or why there are none."""
    parts = [log[site] for site in log.sites]
    if not all(map(len, parts)):
        return _no_roots("a site has no records")
    if any(part.mode[-1] == "diverged" for part in parts):
        return _no_roots("the run diverged")
    if any(log.changes(site) for site in log.sites):
        return _no_roots("commands changed the loop while it ran")
    scenario, uses, mean_s = _fix_delays(log)
    try:
        conditions = derive_operating_conditions(scenario, own_laws=False)
        for at, age_s in mean_s.items():
            conditions.age_s[at] = age_s
        q, theta_hat = _choose_state(scenario, parts)
        rest = follow_equilibrium(scenario, Equilibrium(q, theta_hat, "the end of the log", 0.0))
    except ScenarioError as error:
        return _no_roots(error.problem)
    sampled = compute_sampled_spectrum(conditions, rest, _ROOTS, uses)
    decisive = sampled or compute_delay_spectrum(linearise_loop(conditions, rest), _ROOTS)
    root, verdict, about = decisive.rightmost, decisive.verdict, decisive.basis
    if sampled is None:  # a law in continuous time, whose ticks are left out
        about = ", in continuous time" + ", of the mean ages" * bool(conditions.varying or mean_s)
    exact = sampled is not None and sampled.deviation_per_s is None
    if root is None:
        return EndPoseRoots(verdict, None, exact, f"this rest: {verdict}, without roots")
    omega = f" at {abs(root.s.imag):.4g} rad/s" if root.s.imag else ""
    drift = f"{decisive.drifting} of its motions keep their speed, the others " * bool(decisive.drifting)
    text = f"this rest: {verdict}, {drift}{root.s.real:+.3g} /s{omega}{about}"
    return EndPoseRoots(verdict, root.s.real, exact, text)


def _fix_delays(log: Log) -> tuple[Scenario, SamplesInUse | None, dict[tuple[int, int], float]]:
    """Returns the scenario that a log ran, with constant delays where its records alone know them.

    And if there are such links the samples in use in its last quarter, a missing tick's being those before,
    and per (receiver, sender) of such a link their mean age, s.
    """
    known = msgspec.structs.replace(log.scenario, duration_s=recorded_end_s(log))
    unknown = [one.random or one.measured or one.points is not None for one in known.links.values()]
    if not any(unknown):
        return known, None, {}
    sites, links = [log[name] for name in known.names], dict(known.links)
    common_hz = math.gcd(*(site.rate_hz for site in sites))
    end = max(1, min(int(site.tick[-1]) * common_hz // site.rate_hz for site in sites))
    start = max(3 * end // 4, end - round(DRAWN_SPAN_S * common_hz))
    used, mean_s = {}, {}
    for (i, own), (j, peer) in permutations(enumerate(sites), 2):
        ticks = np.arange(start * own.rate_hz // common_hz, end * own.rate_hz // common_hz)
        rows = np.maximum(np.searchsorted(own.tick, ticks, side="right") - 1, 0)
        samples, name = own.used[peer.name][rows], f"{peer.name}->{own.name}"
        if samples.min() < 0:  # of a peer that never sent, or not yet
            return known, None, {}
        used[i, j] = samples - start * peer.rate_hz // common_hz
        if unknown[[*links].index(name)]:
            mean_s[i, j] = float((ticks / own.rate_hz - samples / peer.rate_hz).mean())
            links[name] = ConstantDelay(delay_ms=1e3 * mean_s[i, j])
    fixed = msgspec.structs.replace(known, links=links)
    return fixed, SamplesInUse((end - start) / common_hz, used), mean_s


def _no_roots(why: str) -> EndPoseRoots:
    return EndPoseRoots("", None, False, f"this rest: no roots: {why}")


def _choose_state(scenario: Scenario, parts: Sequence[SiteLog]) -> tuple[Array, Array]:
    """Returns angles and estimates of all sites: at the end of those at rest, else the last quarter's mean.

    Of arms that chatter at a sampled wall, it is the state of the last quarter that is deepest in it.
    """
    count = min(map(len, parts))
    rows = slice(3 * count // 4, count)
    together = all(np.array_equal(part.t_s[rows], parts[0].t_s[rows]) for part in parts)
    if together and not all(map(_rests, parts)):
        joints = max(part.q.shape[1] for part in parts)
        q = np.stack(
            [np.pad(part.q[rows], ((0, 0), (0, joints - part.q.shape[1]))) for part in parts], axis=1
        )
        deepest = find_deepest_contact(scenario, q)
        if deepest is not None:
            return q[deepest], pad_rows([part.theta_hat[rows][deepest] for part in parts])
    ends = [(_end_of(part, part.q), _end_of(part, part.theta_hat)) for part in parts]
    return pad_rows([q for q, _ in ends]), pad_rows([theta_hat for _, theta_hat in ends])


def _rests(part: SiteLog) -> bool:
    t_s = part.t_s
    return float(np.abs(part.qd[t_s > t_s[-1] - 1.0]).max()) <= SETTLED_SPEED_RAD_S


def _end_of(part: SiteLog, values: Array) -> Array:
    """Returns a signal at the last record of an arm at rest, else its mean over the last quarter."""
    return np.asarray(values[-1] if _rests(part) else values[part.t_s >= 0.75 * part.t_s[-1]].mean(axis=0))
