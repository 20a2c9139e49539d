"""Stability certificate of a log: premises, energy balance, end of the run and the verdict, also as JSON.

Invariant: V falls except for supplied energy. A rise beyond operator and environment is reported with its
time, amount and sources; energy without a source means that the log's equations did not produce it. What
a log cannot decide is stated: without a functional the end of the run alone decides. JSON keys end in
their unit, and unknown values are null.
"""

import math
from collections.abc import Mapping
from enum import StrEnum
from typing import Any, NamedTuple

import numpy as np

from ...core.vectors import Array
from ...log.log_reader import Log
from ..lyapunov_weights import find_closed_groups
from ..run_end import RunEnd, classify_log_end
from .energy_balance import (
    ZERO_ENERGY_J,
    EnergyBalance,
    SiteEnergy,
    compute_energy_balance,
    compute_site_energies,
    interpolate_dominance,
)
from .premises import (
    Premise,
    check_run_premises,
    check_scenario_premises,
    describe_closed_groups,
    find_unjudged_spans,
)

BROKEN_BALANCE_SHARE = 2e-4
"""What may be unexplained at most, as a share of the scale, beyond what the trapezoid rule may be off."""
CLEAR_BREAK_SHARE = 1e-3
"""With more than this, and no doubt of that size, the period is not to blame."""
SAMPLING_RISE_SHARE = 1e-4
"""Rises up to this share of the scale are put down to sampling where the residual is as large."""


COARSE_TOLERANCE_SHARE = 1e-2
"""A tolerance of more than this share of the scale says nothing of a rise."""


class StabilityFinding(StrEnum):
    """How a certificate came out; the text is the word for people."""

    COVERED = "covered by the theorem"
    DID_NOT_RISE = "outside the theorem, yet V did not rise"
    ROSE = "V rose"
    BROKEN = "the energy balance is broken"
    NOT_JUDGED = "V cannot be judged"


class FunctionalRise(NamedTuple):
    """The largest rise of V that neither hands nor walls gave.

    Attributes:
        from_s: when V was lowest before it, s.
        at_s: when it was highest, s.
        amount: by how much, J.
        causes: who gave how much in between, J, largest first.
    """

    from_s: float
    at_s: float
    amount: float
    causes: dict[str, float]


class StabilityVerdict(NamedTuple):
    """What V did.

    Attributes:
        finding: the word.
        text: the sentence.
        rise: the largest rise beyond the tolerance; None where V did not rise.
        tolerance: what a rise must exceed, J.
    """

    finding: StabilityFinding
    text: str
    rise: FunctionalRise | None = None
    tolerance: float = 0.0


def judge_stability(
    premises: list[Premise], books: Mapping[str, SiteEnergy], balance: EnergyBalance
) -> StabilityVerdict:
    """Returns the verdict on a log whose sites have functionals.

    Args:
        premises: the theorem's, as they were found.
        books: of every site.
        balance: of all sites.
    """
    tolerance = _tolerance(balance)
    unsound = judge_balance(books, balance)
    if unsound is not None:
        return unsound._replace(tolerance=tolerance)
    if tolerance > COARSE_TOLERANCE_SHARE * balance.scale + 2.0 * ZERO_ENERGY_J:
        return make_undecided_verdict(f"{_TOO_COARSE} {tolerance:.3g} J of {balance.scale:.4g} J")._replace(
            tolerance=tolerance
        )
    rise = find_largest_rise(balance, tolerance)
    failed = [premise.name for premise in premises if premise.holds is False]
    where = f"outside the theorem ({', '.join(failed)})"
    if rise is not None:
        held = "though the premises of the theorem hold, which is one of continuous time"
        text = f"{where if failed else held}: {_rise_text(rise, balance)}"
        return StabilityVerdict(StabilityFinding.ROSE, text, rise, tolerance)
    untold = [premise.text for premise in premises if premise.holds is None]
    text = "; ".join([_fall_text(balance), *untold])
    if failed:
        return StabilityVerdict(StabilityFinding.DID_NOT_RISE, f"{where}, yet {text}", None, tolerance)
    covered = f"{StabilityFinding.COVERED}, as far as the log tells" if untold else StabilityFinding.COVERED
    return StabilityVerdict(StabilityFinding.COVERED, f"{covered}: {text}", None, tolerance)


_TOO_COARSE = "the period is too long for these gains, so that its energies are known only to"


def make_undecided_verdict(why: str) -> StabilityVerdict:
    """Returns the verdict on a log that has no V."""
    return StabilityVerdict(StabilityFinding.NOT_JUDGED, f"{StabilityFinding.NOT_JUDGED}: {why}")


def judge_balance(books: Mapping[str, SiteEnergy], balance: EnergyBalance) -> StabilityVerdict | None:
    """Returns the verdict where a balance does not close; None where all do. Each site counts by itself.

    An arm outside of the program need not be what its theta says, nor are its angles and velocities measured
    at once; any other's records are not what they claim, unless the period may be to blame.
    """
    off = {site: np.abs(book.unexplained) for site, book in books.items()}
    wrong = [
        site
        for site, book in books.items()
        if float(off[site].max()) > compute_allowed_residual(book, balance)
    ]
    outside = [site for site, book in books.items() if book.eq.outside]
    ours = [site for site in wrong if site not in outside and not books[site].followed.intersection(outside)]
    site = max(ours or wrong, key=lambda name: float(off[name].max()), default=None)
    if site is None:
        return None
    book, worst = books[site], float(off[site].max())
    at_s = book.track.t_s[int(np.argmax(off[site] > compute_allowed_residual(book, balance)))]
    amount = f"{worst:.3g} J of {balance.scale:.4g} J"
    text = f"the energy of {site} does not add up from {at_s:.4g} s on, by {amount}"
    if not ours:
        arms = ", ".join(outside)
        return make_undecided_verdict(f"{text}: the arm of {arms}, outside of the program, {_OUTSIDE}")
    why = (
        FALSE_RECORDS_TEXT
        if worst > compute_allowed_residual(book, balance, CLEAR_BREAK_SHARE)
        and book.doubt < CLEAR_BREAK_SHARE * balance.scale
        else _OPEN
    )
    return StabilityVerdict(StabilityFinding.BROKEN, f"{StabilityFinding.BROKEN}: {text}: {why}")


_OUTSIDE = "does not move as its theta says, or somebody pushes it"
FALSE_RECORDS_TEXT = "these records were not made by the equations that the log claims"
_OPEN = f"the period is too long for these gains, or {FALSE_RECORDS_TEXT}; `trilat verify` tells which"


def find_largest_rise(balance: EnergyBalance, tolerance: float) -> FunctionalRise | None:
    """Returns the largest rise of V that neither hands nor walls gave, where it exceeds a tolerance."""
    V = balance.own
    above = V - np.minimum.accumulate(V)
    last = int(above.argmax())
    if above[last] <= tolerance:
        return None
    first = int(V[: last + 1].argmin())
    sources = {
        **{("" if "->" in name else "the ") + name: x for name, x in balance.given.items()},
        "sampling": balance.sampling,
        "what beta does not cancel": -balance.passed,
    }
    for name in ("the hands", "the walls"):
        del sources[name]
    causes = {name: float(x[last] - x[first]) for name, x in sources.items()}
    ordered = sorted(causes.items(), key=lambda cause: -cause[1])
    notable = {name: amount for name, amount in ordered if amount > 0.05 * above[last]}
    return FunctionalRise(float(balance.t_s[first]), float(balance.t_s[last]), float(above[last]), notable)


def compute_allowed_residual(
    book: SiteEnergy, balance: EnergyBalance, share: float = BROKEN_BALANCE_SHARE
) -> float:
    """Returns how much of a site's energy may be unexplained before its balance counts as broken, J."""
    return share * balance.scale + 2.0 * book.doubt + ZERO_ENERGY_J


def _tolerance(balance: EnergyBalance) -> float:
    sampled = min(_spread(balance.residual), SAMPLING_RISE_SHARE * balance.scale)
    return _spread(balance.unexplained) + sampled + ZERO_ENERGY_J


def _rise_text(rise: FunctionalRise, balance: EnergyBalance) -> str:
    causes = ", ".join(f"{name} {amount:.3g} J" for name, amount in list(rise.causes.items())[:4])
    who = f"; given by {causes}" if causes else "; nobody gave it"
    share = f"{100.0 * rise.amount / balance.V.max():.2g} % of its largest value"
    return f"V rose by {rise.amount:.3g} J ({share}) from {rise.from_s:.4g} to {rise.at_s:.4g} s{who}"


def _fall_text(balance: EnergyBalance) -> str:
    first, last = (x if x > ZERO_ENERGY_J else 0.0 for x in (balance.V[0], balance.V[-1]))
    from_s, to_s = balance.t_s[0], balance.t_s[-1]
    went = f"{first:.4g} J at {from_s:.4g} s, {last:.4g} J at {to_s:.4g} s"
    if balance.pushers:
        return f"V rose by no more than the {' and '.join(balance.pushers)} gave: {went}"
    return f"V did not rise: {went}"


def _spread(values: Array) -> float:
    return float(np.ptp(values)) if len(values) else 0.0


NO_COMMON_TIME = "there is no time of which every site has records"
NO_PERIOD = "there is no period of which all records are there"


class Certificate(NamedTuple):
    """All that is certified of a log.

    Attributes:
        premises: the theorem's, as they were found.
        verdict: what V did.
        growth: what e and qd do at the end.
        books: of every site; {} where there is no functional.
        balance: of all sites; None where there is no functional.
        ones: the same with the paper's weights; None where those are right, or nothing is weighed.
        groups: two or more groups of sites that follow nobody outside, so that nothing is weighed; or none.
    """

    premises: list[Premise]
    verdict: StabilityVerdict
    growth: RunEnd
    books: dict[str, SiteEnergy]
    balance: EnergyBalance | None
    ones: EnergyBalance | None = None
    groups: tuple[tuple[str, ...], ...] = ()

    @property
    def ones_rise(self) -> FunctionalRise | None:
        """The largest rise of V with the paper's weights; None where it did not rise, or is the right one."""
        return None if self.ones is None else find_largest_rise(self.ones, self.verdict.tolerance)

    @property
    def bounded_by_v(self) -> bool:
        """True where V bounds every site: it did not rise, and no site's weight in it is zero.

        A site of no weight is bounded as well where the shares are all that fails: it converges after those
        that it follows (docs/errata.md, 11).
        """
        if self.balance is None or self.verdict.finding not in (
            StabilityFinding.COVERED,
            StabilityFinding.DID_NOT_RISE,
        ):
            return False
        failed = [premise.name for premise in self.premises if premise.holds is not True]
        return bool((self.balance.beta > 0.0).all()) or (failed == ["shares"] and self._constant)

    @property
    def _constant(self) -> bool:
        return all(book.shares.constant for book in self.books.values())

    @property
    def passed(self) -> bool:
        """What decides the exit code: the balance holds, and V or the growth says that the run is bounded.

        Undecided growth is no pass, as for `stable` of `trilat test`.
        """
        if self.verdict.finding is StabilityFinding.BROKEN or self.growth.behaviour.grows:
            return False
        return self.bounded_by_v or self.growth.behaviour.grows is False


def certify(log: Log) -> Certificate:
    """Returns the certificate of a log; torn, short and empty ones too.

    Raises:
        LogError: a record cannot be read, or names a change that is none.
    """
    premises, grown = check_scenario_premises(log.scenario), classify_log_end(log)
    if not premises[0].holds:
        return _without(premises, grown, premises[0].text)
    found = compute_site_energies(log)
    if not found:
        return _without(premises, grown, NO_COMMON_TIME)
    refused = _groups(log, found)
    booked = compute_energy_balance(found)
    if not booked.judged.any():
        return _without(premises, grown, NO_PERIOD)
    premises += check_run_premises(log, found, booked)
    if refused:
        said = judge_balance(found, booked) or make_undecided_verdict(describe_closed_groups(refused))
        return Certificate(premises, said, grown, found, None, groups=refused)
    ones = None if np.allclose(booked.beta, 1.0) else compute_energy_balance(found, ones=True)
    return Certificate(premises, judge_stability(premises, found, booked), grown, found, booked, ones)


def _without(premises: list[Premise], grown: RunEnd, why: str) -> Certificate:
    return Certificate(premises, make_undecided_verdict(why), grown, {}, None)


def _groups(log: Log, found: dict[str, SiteEnergy]) -> tuple[tuple[str, ...], ...]:
    """Returns the closed groups for which there is no unique beta; () where there is one all the time."""
    for alpha in _matrices(found):
        groups = find_closed_groups(alpha)
        if len(groups) > 1:
            return tuple(tuple(log.scenario.names[n] for n in group) for group in groups)
    return ()


def _matrices(found: dict[str, SiteEnergy]) -> Array:
    """Returns every dominance matrix that was in force, of a ramp its ends, shape (M, N, N)."""
    tracks = [book.track for book in found.values()]
    times = [tracks[0].t_s[:1]]
    for book in found.values():
        moving = np.flatnonzero(np.diff(book.shares.rate, axis=0, prepend=0.0).any(axis=1))
        stepping = np.flatnonzero((book.shares.alpha[1:] != book.shares.before).any(axis=1)) + 1
        times += [book.track.t_s[moving], book.track.t_s[stepping]]
    return interpolate_dominance(found, np.concatenate(times))


CertificateJson = dict[str, Any]


def certificate_to_json(certificate: Certificate) -> CertificateJson:
    """Returns a certificate, ready for JSON."""
    verdict, grown = certificate.verdict, certificate.growth
    return {
        "passed": certificate.passed,
        "verdict": verdict.finding.name.lower(),
        "text": verdict.text,
        "rise": None if verdict.rise is None else _rise(verdict.rise),
        "tolerance_j": verdict.tolerance,
        "closed_groups": [list(group) for group in certificate.groups],
        "premises": [premise._asdict() for premise in certificate.premises],
        "growth": {
            "motion": grown.behaviour.name.lower(),
            "text": grown.text,
            "error_rate_per_s": _known(grown.error.rate_per_s),
            "speed_rate_per_s": _known(grown.speed.rate_per_s),
            "end_error_rad": grown.end_error_rad,
            "end_speed_rad_s": grown.end_speed_rad_s,
        },
        "functional": None if certificate.balance is None else _functional(certificate, certificate.balance),
    }


def _rise(rise: FunctionalRise) -> CertificateJson:
    return {"from_s": rise.from_s, "at_s": rise.at_s, "amount_j": rise.amount, "causes_j": rise.causes}


def _ones(certificate: Certificate) -> CertificateJson | None:
    if certificate.ones is None:
        return None
    rise, V = certificate.ones_rise, certificate.ones.V
    return {
        "v_first_j": float(V[0]),
        "v_max_j": float(V.max()),
        "rise": None if rise is None else _rise(rise),
    }


def _functional(certificate: Certificate, balance: EnergyBalance) -> CertificateJson:
    V, sites = balance.V, certificate.books
    return {
        "beta_first": dict(zip(sites, balance.beta[0].tolist(), strict=True)),
        "beta_last": dict(zip(sites, balance.beta[-1].tolist(), strict=True)),
        "v_first_j": float(V[0]),
        "v_last_j": float(V[-1]),
        "v_max_j": float(V.max()),
        "parts_last_j": _last(balance.parts),
        "taken_j": _last(balance.taken),
        "given_j": _last(balance.given),
        "sampling_j": float(balance.sampling[-1]),
        "passed_on_j": float(balance.passed[-1]),
        "scale_j": balance.scale,
        "residual_max_j": _largest(balance.residual),
        "unexplained_max_j": _largest(balance.unexplained),
        "sites_unexplained_max_j": {site: _largest(book.unexplained) for site, book in sites.items()},
        "not_judged_s": find_unjudged_spans(balance),
        "ones": _ones(certificate),
    }


def _last(columns: dict[str, Array]) -> dict[str, float]:
    return {name: float(values[-1]) for name, values in columns.items()}


def _largest(values: Array) -> float:
    return float(np.abs(values).max())


def _known(value: float) -> float | None:
    return None if math.isnan(value) else value
