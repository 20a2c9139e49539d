"""Stability certificate of a log: premises, energy balance, end of the run and the verdict,
also as JSON.

Invariant: V falls except for supplied energy. A rise beyond operator and environment is
reported with its time, amount and sources; energy without a source means that the log's
equations did not produce it. What a log cannot decide is stated: without a functional the end
of the run alone decides. JSON keys end in their unit, and unknown values are null.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from ...core.vectors import Array
from ...log.accounting import MIN_COVERAGE
from ...log.log_reader import Log
from ...results import JsonObject, Result, finite_or_none
from ..run_end import EndBehaviour, RunEnd, Stability, classify_log_end
from ..twin_growth import TwinGrowth, TwinVerdict, judge_end_by_twins
from . import energy_terms
from .energy_balance import (
    EXTERNAL_SOURCES,
    ZERO_ENERGY_J,
    EnergyBalance,
    SiteEnergy,
    compute_energy_balance,
    rise_above_minimum,
)
from .observed_energy import ObservedEnergy, ObservedFinding, observe_energies
from .premises import (
    Evidence,
    FunctionalFacts,
    Premise,
    check_premises,
    collect_evidence,
    describe_closed_groups,
    find_unjudged_spans,
    gather_facts,
)

BROKEN_BALANCE_SHARE = 2e-4
"""Largest unexplained energy as a share of the scale, beyond the uncertainty of the trapezoid
rule.
"""
CLEAR_BREAK_SHARE = 1e-3
"""With more than this, and no uncertainty of that size, the period is not the cause."""
TORQUE_TOLERANCE = 1e-6
"""A recorded torque that differs from Eq. (13) by more, relative to 1 + |tau|, was not made by
it.
"""
COARSE_TOLERANCE_SHARE = 1e-2
"""A tolerance above this share of the scale decides nothing about a rise."""

FALSE_RECORDS_TEXT = "these records were not made by the equations that the log claims"
_PERIOD_OR_FALSE = f"the period is too long for these gains, or {FALSE_RECORDS_TEXT}; `trilat verify` tells which"


_REFUTES = (ObservedFinding.NEGATIVE, ObservedFinding.BROKEN)


class StabilityFinding(StrEnum):
    """Class of a verdict; the text is the word for people."""

    COVERED = "covered by the theorem"
    DID_NOT_RISE = "outside the theorem, yet V did not rise"
    ROSE = "V rose"
    BROKEN = "the energy balance is broken"
    NOT_JUDGED = "V cannot be judged"


class FunctionalRise(NamedTuple):
    """The largest rise of V that operator and environment did not supply.

    Attributes:
        from_s, at_s: when V was lowest before it, and when it was highest, s.
        amount: its size, J.
        causes: the sources of more than 5 % of it and their work in between, J, largest first.
    """

    from_s: float
    at_s: float
    amount: float
    causes: dict[str, float]


class StabilityVerdict(NamedTuple):
    """Verdict on V: its class and the sentence.

    Attributes:
        rise: the largest rise beyond the tolerance; None if V did not rise.
        tolerance: the size that a rise must exceed, J.
    """

    finding: StabilityFinding
    text: str
    rise: FunctionalRise | None = None
    tolerance: float = 0.0


class EndPoseRoots(NamedTuple):
    """The loop linearised where a run ended.

    Attributes:
        verdict: stable, unstable or at the edge, of small motions there; "" if there is no such
            loop.
        rate_per_s: the largest real part of a root that is not zero by structure, 1/s; None
            without one.
        exact: True of the sampled loop where delays repeat; else the roots are no proof, but
            may be a doubt.
        text: the rest and its roots, or why there are none.
    """

    verdict: str
    rate_per_s: float | None
    exact: bool
    text: str


@dataclass(frozen=True, repr=False)
class Certificate(Result):
    """Stability certificate of a log.

    Attributes:
        premises, verdict, end: of the theorem, on V, and of the run from e and qd alone.
        evidence: how much of the run the log has, and that nothing was changed.
        balance: of all sites; None without a functional, or if beta is not unique.
        paper_balance: the same with the paper's weights; None if those are right, or without a balance.
        groups: closed groups of sites, if there are several: then beta is not unique.
        energies: of every site; {} without a functional.
        roots: of the loop where the run ended; None if nobody looked.
        observed: of the energies that laws declare; None if none does.
        twins: what became of small pushes; None if nobody looked.
    """

    premises: list[Premise]
    verdict: StabilityVerdict
    end: RunEnd
    evidence: Evidence
    balance: EnergyBalance | None = None
    paper_balance: EnergyBalance | None = None
    groups: tuple[tuple[str, ...], ...] = ()
    energies: Mapping[str, SiteEnergy] = field(default_factory=lambda: MappingProxyType({}))
    roots: EndPoseRoots | None = None
    observed: ObservedEnergy | None = None
    twins: TwinGrowth | None = None

    @property
    def paper_weights_rise(self) -> FunctionalRise | None:
        """The largest rise of V with the paper's weights; None if it did not rise, or if they
        are right.
        """
        return (
            None
            if self.paper_balance is None
            else _find_largest_rise(self.paper_balance, self.verdict.tolerance)
        )

    @property
    def bounded_by_v(self) -> bool:
        """True if V bounds every site: it did not rise, and no site's weight in it is zero.

        A site of no weight is bounded as well if the dominance factors are all that fails: it
        converges after those that it follows (docs/errata.md, 11).
        """
        sound = (StabilityFinding.COVERED, StabilityFinding.DID_NOT_RISE)
        if self.balance is None or self.verdict.finding not in sound:
            return False
        failed = [premise.name for premise in self.premises if premise.holds is not True]
        constant = all(energy.motion.dominance.constant for energy in self.energies.values())
        return bool((self.balance.beta > 0.0).all()) or (failed == ["shares"] and constant)

    @property
    def reasons(self) -> tuple[str, ...]:
        """What leaves the run open or false, in words: of the log, its end, V, the roots at its
        end pose.
        """
        broken = self.verdict.finding is StabilityFinding.BROKEN
        found = [self.verdict.text] if broken else []
        if self.balance is not None and not broken:
            found += describe_unsupplied_growth(self.balance, self.verdict.tolerance)
        roots = self.roots
        twins = self.twins
        if roots is not None and roots.verdict == "unstable":
            doubt = None if roots.exact else roots.rate_per_s
            if doubt is None or twins is None or doubt <= twins.excluded_rate_per_s:
                # roots that are no proof give way to pushes in the run's own ticks
                found.append(roots.text)
        if self.observed is not None and self.observed.finding in _REFUTES:
            found.append(self.observed.text)
        told = self._by_twins.reason
        return (*self.end.reasons, *([told] if told else []), *found, *self.evidence.reasons)

    @property
    def _by_twins(self) -> TwinVerdict:
        if self.twins is None:
            return TwinVerdict(self.end.stability)
        known = {"stable": True, "unstable": False}
        settles = (
            known.get(self.roots.verdict)
            if self.roots is not None and self.roots.exact
            else None
        )
        if self.verdict.finding is StabilityFinding.COVERED:
            settles = True
        rose = self.verdict.finding is StabilityFinding.ROSE
        return judge_end_by_twins(self.end, self.twins, settles=settles, rises=rose)

    @property
    def stability(self) -> Stability:
        """The judgement: of its end and its twins; what else is known may leave a stable run
        open.
        """
        own = self._by_twins.stability
        return Stability.OPEN if own is Stability.STABLE and self.reasons else own

    @property
    def passed(self) -> bool:
        """Decides the exit code: the run is stable."""
        return self.accepts(())

    def headline(self) -> str:
        """Returns the judgement, and how the run ended."""
        by_twins = (
            self.stability is Stability.STABLE and self.end.stability is not Stability.STABLE
        )
        return f"{self.stability}: {self.end.behaviour}{', yet every push dies away' if by_twins else ''}"

    def to_dict(self) -> JsonObject:
        """Returns plain values, with the keys of `trilat certify --json`."""
        verdict = self.verdict
        end = self.end
        balance = self.balance
        return {
            "passed": self.passed,
            "stability": self.stability.value,
            "reasons": list(self.reasons),
            "verdict": verdict.finding.name.lower(),
            "text": verdict.text,
            "rise": _rise_to_json(verdict.rise),
            "tolerance_j": verdict.tolerance,
            "closed_groups": [list(group) for group in self.groups],
            "premises": [premise._asdict() for premise in self.premises],
            "growth": {
                "motion": end.behaviour.name.lower(),
                "text": end.text,
                "where": end.where or None,
                "error_rate_per_s": finite_or_none(end.error.rate_per_s),
                "speed_rate_per_s": finite_or_none(end.speed.rate_per_s),
                "end_error_rad": end.end_error_rad,
                "end_speed_rad_s": end.end_speed_rad_s,
            },
            "evidence": self.evidence.to_json(),
            "roots": None if self.roots is None else self.roots._asdict(),
            "observed": None if self.observed is None else self.observed.to_json(),
            "twins": None if self.twins is None else self.twins.to_json(),
            "functional": None if balance is None else _functional_to_json(self, balance),
        }

    def to_rows(self) -> list[JsonObject]:
        """Returns a row per premise."""
        return [premise._asdict() for premise in self.premises]

    def accepts(self, accepted: Collection[str]) -> bool:
        """True if the run is stable, or bounded or open where that is accepted.

        Never with a broken balance or a changed log.
        """
        if (
            self.verdict.finding is StabilityFinding.BROKEN
            or not self.evidence.integrity.passed
        ):
            return False
        bounded = "bounded" in accepted and self.end.behaviour is EndBehaviour.BOUNDED
        opened = "open" in accepted and self.stability is Stability.OPEN
        return bounded or opened or self.stability is Stability.STABLE


def certify(
    log: Log, *, min_coverage: float = MIN_COVERAGE, own_laws: bool = False
) -> Certificate:
    """Returns the certificate of a log; torn, short and empty ones too.

    Of a run of which less than `min_coverage` of every site's ticks can be judged, a stable end
    is open. With `own_laws` the code of laws from outside runs, as far as they declare
    energies.

    Raises:
        LogError: a record cannot be read, or names a change that is none.
    """
    run = gather_facts(log)
    known = run.functional
    premises = check_premises(run)
    verdict = StabilityVerdict(StabilityFinding.NOT_JUDGED, run.unknown)
    if known is not None:
        verdicts = (judge(known, premises) for judge in JUDGEMENTS)
        verdict = next(verdict for verdict in verdicts if verdict is not None)
        verdict = verdict if known.groups else verdict._replace(tolerance=known.tolerance)
    if verdict.finding in (StabilityFinding.BROKEN, StabilityFinding.NOT_JUDGED):
        verdict = verdict._replace(text=f"{verdict.finding}: {verdict.text}")
    end = classify_log_end(log)
    observed = observe_energies(log, own_laws=own_laws)
    found = Certificate(
        premises, verdict, end, collect_evidence(run, min_coverage), observed=observed
    )
    if known is None:
        return found
    if known.groups:
        return replace(found, groups=known.groups, energies=known.energies)
    alike = np.allclose(known.balance.beta, 1.0)
    ones = None if alike else compute_energy_balance(known.energies, paper_weights=True)
    return replace(found, balance=known.balance, paper_balance=ones, energies=known.energies)


def _judge_site_balances(run: FunctionalFacts, _: Sequence[Premise]) -> StabilityVerdict | None:
    """A site's balance does not close; each site counts by itself.

    An arm outside of the program need not follow its theta, nor are its angles and velocities
    measured at once; the records of any other are not what they claim, unless the period may be
    the cause.
    """
    energies = run.energies
    scale = run.balance.scale

    def allow(site: str, share: float = BROKEN_BALANCE_SHARE) -> float:
        return share * scale + 2.0 * energies[site].uncertainty + ZERO_ENERGY_J

    worst = {site: _largest(energy.unexplained) for site, energy in energies.items()}
    wrong = [site for site in energies if worst[site] > allow(site)]
    if not wrong:
        return None
    outside = run.log.scenario.external
    ours = [site for site in wrong if not {*outside} & {site, *energies[site].followed}]
    site = max(ours or wrong, key=worst.__getitem__)
    energy = energies[site]
    at_s = energy.motion.records.t_s[int(np.argmax(np.abs(energy.unexplained) > allow(site)))]
    amount = f"{worst[site]:.3g} J of {scale:.4g} J"
    text = f"the energy of {site} does not add up from {at_s:.4g} s on, by {amount}"
    if not ours:
        why = f"the arm of {', '.join(outside)}, outside of the program, does not move as its theta says"
        return StabilityVerdict(
            StabilityFinding.NOT_JUDGED, f"{text}: {why}, or somebody pushes it"
        )
    clear = worst[site] > allow(site, CLEAR_BREAK_SHARE)
    certain = clear and energy.uncertainty < CLEAR_BREAK_SHARE * scale
    why = FALSE_RECORDS_TEXT if certain else _PERIOD_OR_FALSE
    return StabilityVerdict(StabilityFinding.BROKEN, f"{text}: {why}")


def _judge_torques(run: FunctionalFacts, _: Sequence[Premise]) -> StabilityVerdict | None:
    """Recorded torques are not those of Eq. (13)."""
    for site, energy in run.energies.items():
        error = energy_terms.measure_torque_error(energy.motion)
        records = energy.motion.records
        wrong = error > TORQUE_TOLERANCE * (1.0 + np.abs(records.tau).max(axis=1))
        if wrong.any():
            off = f"{error.max():.3g} N m, from {records.t_s[int(np.argmax(wrong))]:.4g} s on"
            text = f"the torque of {site} is not that of Eq. (13), by up to {off}: {FALSE_RECORDS_TEXT}"
            return StabilityVerdict(StabilityFinding.BROKEN, text)
    return None


def _judge_weights(run: FunctionalFacts, _: Sequence[Premise]) -> StabilityVerdict | None:
    """There is no unique beta."""
    if not run.groups:
        return None
    return StabilityVerdict(StabilityFinding.NOT_JUDGED, describe_closed_groups(run.groups))


def _judge_precision(run: FunctionalFacts, _: Sequence[Premise]) -> StabilityVerdict | None:
    """The energies are known too badly."""
    scale = run.balance.scale
    tolerance = run.tolerance
    if tolerance <= COARSE_TOLERANCE_SHARE * scale + 2.0 * ZERO_ENERGY_J:
        return None
    known = f"its energies are known only to {tolerance:.3g} J of {scale:.4g} J"
    why = f"the period is too long for these gains, so that {known}"
    return StabilityVerdict(StabilityFinding.NOT_JUDGED, why)


def _judge_course(run: FunctionalFacts, premises: Sequence[Premise]) -> StabilityVerdict:
    balance = run.balance
    sources = list(run.balance.external)
    failed = [premise.name for premise in premises if premise.holds is False]
    outside = f"outside the theorem ({', '.join(failed)})"
    rise = _find_largest_rise(balance, run.tolerance)
    if rise is not None:
        held = "though the premises of the theorem hold, which is one of continuous time"
        causes = ", ".join(
            f"{name} {amount:.3g} J" for name, amount in list(rise.causes.items())[:4]
        )
        who = f"; given by {causes}" if causes else "; nobody gave it"
        share = f"{100.0 * rise.amount / balance.V.max():.3g} % of its largest value"
        text = f"V rose by {rise.amount:.3g} J ({share}) from {rise.from_s:.4g} to {rise.at_s:.4g} s{who}"
        return StabilityVerdict(
            StabilityFinding.ROSE, f"{outside if failed else held}: {text}", rise
        )
    first, last = (x if x > ZERO_ENERGY_J else 0.0 for x in (balance.V[0], balance.V[-1]))
    fell = (
        f"V rose by no more than the {' and '.join(sources)} gave"
        if sources
        else "V did not rise"
    )
    fell += (
        f": {first:.4g} J at {balance.t_s[0]:.4g} s, {last:.4g} J at {balance.t_s[-1]:.4g} s"
    )
    undecided = [premise.text for premise in premises if premise.holds is None]
    text = "; ".join([fell, *undecided])
    if failed:
        return StabilityVerdict(StabilityFinding.DID_NOT_RISE, f"{outside}, yet {text}")
    covered = f"{StabilityFinding.COVERED}{', as far as the log tells' if undecided else ''}"
    return StabilityVerdict(StabilityFinding.COVERED, f"{covered}: {text}")


JUDGEMENTS = (
    _judge_site_balances,
    _judge_torques,
    _judge_weights,
    _judge_precision,
    _judge_course,
)
"""What refutes the log, what keeps V from being judged, and what V did: the first that applies
decides.
"""


def _find_largest_rise(balance: EnergyBalance, tolerance: float) -> FunctionalRise | None:
    """Returns the largest rise of V that operator and environment did not supply, if above a
    tolerance, J.
    """
    V = balance.unsupplied
    rise = rise_above_minimum(V)
    last = int(rise.argmax())
    if rise[last] <= tolerance:
        return None
    first = int(V[: last + 1].argmin())
    inner = {name: x for name, x in balance.work.items() if name not in EXTERNAL_SOURCES}
    sources = {
        **{("" if "->" in name else "the ") + name: x for name, x in inner.items()},
        "sampling": balance.sampling,
        "what beta does not cancel": -balance.transfer,
    }
    causes = {name: float(x[last] - x[first]) for name, x in sources.items()}
    ordered = sorted(causes.items(), key=lambda cause: -cause[1])
    notable = {name: amount for name, amount in ordered if amount > 0.05 * rise[last]}
    return FunctionalRise(
        float(balance.t_s[first]), float(balance.t_s[last]), float(rise[last]), notable
    )


def describe_unsupplied_growth(balance: EnergyBalance, tolerance: float) -> list[str]:
    """Returns what V, less the work of operator and environment, says against a run that looks
    stable.

    It must not end above its beginning, nor rise at the end of the judged half: to above its
    least value there, by more than half of what it fell within that half.
    """
    V = balance.unsupplied
    half = len(balance.unsupplied) // 2
    found = []
    gained = float(V[-1] - V[0])
    if gained > tolerance:
        found.append(f"V ends {gained:.3g} J above its beginning, and nobody gave that")
    judged = V[half:]
    lowest = int(judged.argmin())
    risen = float(judged[-1] - judged[lowest])
    fell = float(judged[0] - judged[lowest])
    if risen > tolerance and risen > 0.5 * fell:
        from_s = float(balance.t_s[half + lowest])
        found.append(
            f"V rises at the end: by {risen:.3g} J from {from_s:.4g} s on, and nobody gave that"
        )
    return found


def _functional_to_json(certificate: Certificate, balance: EnergyBalance) -> JsonObject:
    V = balance.V
    sites = certificate.energies
    ones = certificate.paper_balance
    with_ones: JsonObject | None = None
    if ones is not None:
        with_ones = {"v_first_j": float(ones.V[0]), "v_max_j": float(ones.V.max())}
        with_ones["rise"] = _rise_to_json(certificate.paper_weights_rise)
    return {
        "beta_first": dict(zip(sites, balance.beta[0].tolist(), strict=True)),
        "beta_last": dict(zip(sites, balance.beta[-1].tolist(), strict=True)),
        "v_first_j": float(V[0]),
        "v_last_j": float(V[-1]),
        "v_max_j": float(V.max()),
        "parts_last_j": _last(balance.parts),
        "taken_j": _last(balance.dissipation),
        "given_j": _last(balance.work),
        "sampling_j": float(balance.sampling[-1]),
        "passed_on_j": float(balance.transfer[-1]),
        "scale_j": balance.scale,
        "residual_max_j": _largest(balance.residual),
        "unexplained_max_j": _largest(balance.unexplained),
        "sites_unexplained_max_j": {
            site: _largest(energy.unexplained) for site, energy in sites.items()
        },
        "not_judged_s": find_unjudged_spans(balance),
        "ones": with_ones,
    }


def _rise_to_json(rise: FunctionalRise | None) -> JsonObject | None:
    if rise is None:
        return None
    return {
        "from_s": rise.from_s,
        "at_s": rise.at_s,
        "amount_j": rise.amount,
        "causes_j": rise.causes,
    }


def _last(columns: dict[str, Array]) -> dict[str, float]:
    return {name: float(values[-1]) for name, values in columns.items()}


def _largest(values: Array) -> float:
    return float(np.abs(values).max())
