"""The theorem's premises, checked one by one against a log.

Invariant: a premise holds, fails, or cannot be decided; each states its evidence. The theorem is the
paper's with the weights and the repaired proof of docs/errata.md: constant delays, constant dominance
factors under which every site reaches every other, one Kd up to a scalar per site, the adaptive law, and
no operator or operators that are passive with respect to r.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from ...core.vectors import Array
from ...log.log_reader import Log
from ...scenario import Scenario
from ..lyapunov_weights import LyapunovWeights, compute_lyapunov_weights
from ..timeline import find_mode_intervals
from .energy_balance import ZERO_ENERGY_J, EnergyBalance, SiteEnergy
from .energy_terms import derive_site_constants, explain_missing_functional

CONSTANT_DELAY_TOLERANCE_S = 1e-7
"""Ages that differ by no more are one: stamps are whole nanoseconds."""
MAX_LISTED_NAMES = 4
"""Links or sites that a sentence names."""


class Premise(NamedTuple):
    """One thing that the theorem asks for.

    Attributes:
        name: what.
        holds: whether it is so; None: the log does not tell.
        text: what was found.
    """

    name: str
    holds: bool | None
    text: str


def check_scenario_premises(scenario: Scenario) -> list[Premise]:
    """Returns what the scenario alone tells: law, truth, gains, shares at the start.

    Args:
        scenario: the experiment.
    """
    reasons = {site: explain_missing_functional(spec) for site, spec in scenario.sites.items()}
    sites: dict[str, list[str]] = {}
    for site, reason in reasons.items():
        sites.setdefault(reason, []).append(site)
    lacking = [f"{', '.join(names)}: {reason}" for reason, names in sites.items() if reason]
    if lacking:
        return [Premise("law", False, "; ".join(lacking))]
    found = compute_lyapunov_weights(scenario.alpha, _damping(scenario))
    law = Premise("law", True, "adaptive at every site, of arms whose theta is known")
    return [law, _truth(scenario), _gains(scenario, found)]


def check_run_premises(log: Log, books: Mapping[str, SiteEnergy], balance: EnergyBalance) -> list[Premise]:
    """Returns what only the run tells: shares, delays, stale peers, torque limits, who pushed, gaps.

    Args:
        log: the log.
        books: of every site.
        balance: of all sites.
    """
    return [
        _shares(log, books),
        _delays(books),
        _following(log),
        _limits(books),
        _hands(books, balance),
        _records(balance),
    ]


def _damping(scenario: Scenario) -> Array:
    return np.array([derive_site_constants(spec).Kd for spec in scenario.sites.values()])


def _truth(scenario: Scenario) -> Premise:
    """Whether what the law needs to learn it can: truth in the box, and right where nothing is learnt."""
    faults = []
    for site, spec in scenario.sites.items():
        eq = derive_site_constants(spec)
        if ((eq.theta < eq.low) | (eq.theta > eq.high)).any():
            faults.append(f"{site}: theta is outside of the box that its estimates are held in")
        first = np.clip(spec.control.gains(eq.theta).theta_hat0, eq.low, eq.high)
        if ((eq.Gamma == 0.0) & (first != eq.theta)).any():
            faults.append(f"{site}: a parameter is not learnt, and not known either")
    text = "every parameter is learnt or known, and no box shuts it out"
    return Premise("parameters", not faults, _list(faults) or text)


def _gains(scenario: Scenario, found: LyapunovWeights) -> Premise:
    Kd = _damping(scenario)
    if found.scales is None:
        shapes = ", ".join(f"{site} {_numbers(row)}" for site, row in zip(scenario.names, Kd, strict=True))
        return Premise("Kd", False, f"Kd differs in shape between sites, so that no beta exists: {shapes}")
    if not Kd.all():
        return Premise("Kd", False, "some Kd is zero: the theorem asks for positive ones")
    if np.ptp(found.scales) == 0.0:
        return Premise("Kd", True, "one Kd for all sites")
    return Premise("Kd", True, f"one Kd but for a scalar: {_per_site(scenario.names, found.scales)}")


def _shares(log: Log, books: Mapping[str, SiteEnergy]) -> Premise:
    names, alpha = log.scenario.names, log.scenario.alpha
    changing = [site for site, book in books.items() if not book.shares.constant]
    if changing:
        return Premise("shares", False, f"the shares of {_list(changing)} change")
    Kd = np.array([book.eq.Kd for book in books.values()])
    found = compute_lyapunov_weights(alpha, Kd)
    if not found.unique:
        groups = tuple(tuple(names[n] for n in group) for group in found.groups)
        return Premise("shares", False, describe_closed_groups(groups))
    outside = [site for n, site in enumerate(names) if n not in found.groups[0]]
    if outside:
        group = ", ".join(names[n] for n in found.groups[0])
        why = f"nobody of {group} follows {', '.join(outside)}, whose beta is 0: V tells nothing of it"
        return Premise("shares", False, f"alpha is reducible, {why}; it follows as in a cascade")
    beta = "" if found.scales is None else f"; beta: {_per_site(names, found.beta)}"
    return Premise("shares", True, f"constant, alpha irreducible{beta}")


def describe_closed_groups(groups: Sequence[Sequence[str]]) -> str:
    """Says which closed groups of sites there are, and that beta is not unique."""
    named = " and ".join("{" + ", ".join(group) + "}" for group in groups)
    return f"{named} follow nobody outside: beta is not unique, certify each group by itself"


def _delays(books: Mapping[str, SiteEnergy]) -> Premise:
    varying, constant = [], set()
    for site, book in books.items():
        for j, (peer, one) in enumerate(book.views.items()):
            if not book.shares.alpha[:, j].any():
                continue
            began = np.isfinite(one.stamp_s) & book.track.known
            age_s = (book.track.t_s - one.stamp_s)[began]
            if not len(age_s):
                continue
            late = (
                one.stamp_s[began][0] > book.track.h_s + CONSTANT_DELAY_TOLERANCE_S and book.track.first == 0
            )
            if np.ptp(age_s) > CONSTANT_DELAY_TOLERANCE_S or late:
                varying.append(f"{peer}->{site} ({1e3 * age_s.min():.4g} to {1e3 * age_s.max():.4g} ms)")
            else:
                constant.add(f"{1e3 * age_s[0]:.4g} ms")
    if varying:
        return Premise("delays", False, f"the age of the sample in use varies: {_list(varying)}")
    if not constant:
        return Premise("delays", None, "no sample came into use")
    return Premise("delays", True, f"constant on every link: {', '.join(sorted(constant))}")


def _following(log: Log) -> Premise:
    found = {site: find_mode_intervals(log[site]) for site in log.sites}
    away = [f"{site} {s[0].from_s:.4g} to {s[-1].to_s:.4g} s" for site, s in found.items() if s]
    text = "every site follows its peers all the time"
    return Premise("following", not away, f"hold, brake or return: {_list(away)}" if away else text)


def _limits(books: Mapping[str, SiteEnergy]) -> Premise:
    cut = {
        site: int(np.count_nonzero((np.abs(book.track.tau) >= book.eq.tau_limit).any(axis=1)))
        for site, book in books.items()
    }
    ticks = [f"{site} at {count} ticks" for site, count in cut.items() if count]
    return Premise("torque", not ticks, f"cut off: {_list(ticks)}" if ticks else "never cut off")


def _hands(books: Mapping[str, SiteEnergy], balance: EnergyBalance) -> Premise:
    """Passive with respect to r: no more was given than had been taken before, but for a constant."""
    pushing = {s: np.flatnonzero(book.track.tau_x.any(axis=1)) for s, book in books.items()}
    sites = [site for site, rows in pushing.items() if len(rows)]
    outside = [site for site, book in books.items() if book.eq.outside]
    if outside and not sites:
        return Premise("hands", None, f"no record says who pushes the arm of {_list(outside)}")
    if not sites:
        return Premise("hands", True, "nobody pushes")
    weightless = [s for n, s in enumerate(books) if s in sites and not balance.beta[:, n].any()]
    if weightless:
        return Premise("hands", False, f"{_list(weightless)}, of beta 0, is pushed: V tells nothing of that")
    gave = compute_largest_rise(balance.pushed)
    who = " and ".join(balance.pushers)
    if gave <= 1e-9 * balance.scale + ZERO_ENERGY_J:
        return Premise("hands", True, f"the {who} only took: passive with respect to r")
    let_go_s = max(books[site].track.t_s[pushing[site][-1]] for site in sites)
    text = f"the {who} gave up to {gave:.3g} J with respect to r = qd + Lambda e"
    if let_go_s < balance.t_s[-1] - 1e-9:
        return Premise("hands", True, f"{text}; nobody pushes after {let_go_s:.3f} s")
    return Premise("hands", False, f"{text}, and push to the end: not passive with respect to r")


def _records(balance: EnergyBalance) -> Premise:
    if balance.judged.all():
        return Premise("records", True, "every period of every site rests on records")
    lost = [f"{a:.4g} to {b:.4g} s" for a, b in find_unjudged_spans(balance)]
    return Premise("records", None, f"not judged: {_list(lost)}: records are missing there")


def find_unjudged_spans(balance: EnergyBalance) -> list[tuple[float, float]]:
    """Returns the times between which the books rest on no records, s."""
    edges = np.flatnonzero(np.diff(np.concatenate([[True], balance.judged, [True]]).astype(np.int8)))
    times = balance.t_s[edges]
    return list(zip(times[::2].tolist(), times[1::2].tolist(), strict=True))


def compute_largest_rise(values: Array) -> float:
    """Returns by how much a quantity rises at most above what it was before."""
    return float((values - np.minimum.accumulate(values)).max(initial=0.0))


def _list(words: list[str]) -> str:
    more = f" and {len(words) - MAX_LISTED_NAMES} more" if len(words) > MAX_LISTED_NAMES else ""
    return ", ".join(words[:MAX_LISTED_NAMES]) + more


def _per_site(names: tuple[str, ...], values: Array) -> str:
    return ", ".join(f"{name} {value:.4g}" for name, value in zip(names, values, strict=True))


def _numbers(values: Array) -> str:
    return "(" + ", ".join(f"{value:g}" for value in values) + ")"
