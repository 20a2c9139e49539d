"""The loop linearised where a recorded run ended, beside the certificate of its log.

Invariant: the roots are those at the log's own end pose and estimates, under the conditions at its end; they
speak of small motions there. Where a delay varies, or was measured, they are those of the mean age that the
records have. Only twins are executed.
"""

from collections.abc import Sequence
from dataclasses import replace

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
from ..scenario.delay_models import ConstantDelay
from .equilibrium import follow_equilibrium, pad_rows
from .linear_edge import find_deepest_contact
from .operating_point import Equilibrium, derive_operating_conditions, is_constant_link
from .tick_map import compute_decisive_spectrum

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
    scenario, mean_s = _fix_delays(log)
    try:
        conditions = derive_operating_conditions(scenario, own_laws=False)
        for at, age_s in mean_s.items():
            conditions.age_s[at] = age_s
        q, theta_hat = _choose_state(scenario, parts)
        rest = follow_equilibrium(scenario, Equilibrium(q, theta_hat, "the end of the log", 0.0))
    except ScenarioError as error:
        return _no_roots(error.problem)
    decisive = compute_decisive_spectrum(conditions, rest, _ROOTS, _ROOTS)
    root, verdict, exact = decisive.rightmost, decisive.verdict, not (conditions.varying or mean_s)
    if root is None:
        return EndPoseRoots(verdict, None, exact, f"this rest: {verdict}, without roots")
    omega = f" at {abs(root.s.imag):.4g} rad/s" if root.s.imag else ""
    mean = "" if exact else ", of the mean ages"
    return EndPoseRoots(
        verdict, root.s.real, exact, f"this rest: {verdict}, {root.s.real:+.3g} /s{omega}{mean}"
    )


def _fix_delays(log: Log) -> tuple[Scenario, dict[tuple[int, int], float]]:
    """Returns the scenario that a log ran, with constant delays in place of those that vary or were measured.

    And per (receiver, sender) of such a link the mean age of the sample in use over the last quarter, s.
    """
    names, mean_s, links = log.scenario.names, {}, dict(log.scenario.links)
    for name in (name for name, link in links.items() if not is_constant_link(link)):
        peer, site = name.split("->")
        used = log[site].used[peer]
        rows = (used >= 0) & (log[site].t_s >= 0.75 * log[site].t_s[-1])
        if rows.any():
            age_s = log[site].t_s[rows] - used[rows] / log[peer].rate_hz
            at = names.index(site), names.index(peer)
            mean_s[at] = float(age_s.mean())
            links[name] = ConstantDelay(delay_ms=1e3 * mean_s[at])
    return msgspec.structs.replace(log.scenario, duration_s=recorded_end_s(log), links=links), mean_s


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
