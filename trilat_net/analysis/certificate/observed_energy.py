"""Checks the energies that a control law declares against the records of a run.

Some control laws ensure passivity through energy accounting: they keep energy in stores
(tanks), or track the energy in transit between the arms. Such a law declares these energies at
every tick. Since a faulty program could declare a wrong energy, this module computes the same
energies independently, from the recorded torques and motion, and compares them:

- Energy of the connection from arm j to arm i: the energy that the law of j sent, minus the
  energy that the law of i received.
- Energy that the arm supplies to its law: minus the sum of u_k'(q_{k+1} - q_k) over all ticks
  k, where u_k is the torque during tick k, and q_k are the joint angles.

Invariant:
    - A declared energy counts as evidence only if it agrees with the computed energy.
    - The verdict is negative if the energy of a connection or store is ever below zero, or if
      the total energy that a law has dissipated ever decreases.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np

from ...core import Array, LawEnergies, LawRecords
from ...hooks import find_hook
from ...log import Log
from ...results import JsonObject
from ...scenario import Scenario
from ..aligned import hold_torque
from ..arm_rows import build_arm_rows
from .premise_quantities import (
    BookedTorqueQuantities,
    BooksQuantities,
    Premise,
    SamplingQuantities,
)

LEAST_ENERGY_J = -1e-9
"""Rounding error of an energy that is zero, in J. It is negative because it serves as a lower
bound.
"""
ROUNDING_SHARE = 1e-12
"""Additional rounding error, as a share of the largest energy."""
SAMPLING_SHARE = 1e-2
"""Largest energy that an arm may receive without its law accounting for it, as a share of the
largest energy.
"""


_Finding = Literal["passive", "negative", "broken", "not_judged"]
"""Result of checking the energies that control laws declare, such as the energy of a tank.

The declared energy stays above zero ("passive") if the law never returns more energy than it
received. The result is "broken" if the declared energy does not match the recorded torques and
velocities, and "not_judged" if the records are not sufficient.
"""
_EnergyKind = Literal["line", "known", "store", "taken", "given"]


class _EnergyCurve(NamedTuple):
    """One kind of energy over time that a control law declares, such as a stored energy.

    Some laws also keep account of the energy in transit to another arm.

    Attributes:
        kind: "line" for the energy in transit from a peer to the site, "known" for the part of
            this energy that the site knows, "store" for energy that the law stores, "taken" for
            energy that the law dissipated, "given" for energy that the arm gave to the law.
        site: Name of the site.
        peer: Name of the site at the other end of a line. Empty for other kinds.
        t_s: Times of the site's ticks, shape (K,), in s.
        energy_j: The energy, summed over its parts, shape (K,), in J.
        least_j: The smallest of the parts, shape (K,), in J. For "taken" it is the energy minus
            its largest earlier value, because a dissipated energy must not fall.
    """

    kind: _EnergyKind
    site: str
    peer: str
    t_s: Array
    energy_j: Array
    least_j: Array

    @property
    def name(self) -> str:
        """Short name of the energy for reports.

        For sites m and s, the energy in transit from m to s is named "line m->s", the part of
        it that is known to s "known at s of m", and the energy stored at s "store of s".
        """
        return _name_energy(self.kind, self.site, self.peer)


class _LeastEnergy(NamedTuple):
    """Minimum over time of an energy that must never be negative.

    An example is the level of an energy tank, from which a control law takes the energy that it
    adds.

    Attributes:
        kind: Kind of the energy, as in `_EnergyCurve`.
        site: Name of the site.
        peer: Name of the site at the other end of a line. Empty for other kinds.
        amount_j: The minimum.
        at_s: Time of the minimum.
    """

    kind: _EnergyKind
    site: str
    peer: str
    amount_j: float
    at_s: float

    @property
    def name(self) -> str:
        """Short name of the energy for reports, identical to that of its curve."""
        return _name_energy(self.kind, self.site, self.peer)

    def to_json(self) -> JsonObject:
        """Converts the minimum to plain values for JSON."""
        return {"name": self.name, "amount_j": self.amount_j, "at_s": self.at_s}


def _name_energy(kind: _EnergyKind, site: str, peer: str) -> str:
    """Returns the short name of an energy, such as "line m->s" or "store of s"."""
    if kind == "line":
        return f"line {peer}->{site}"
    if kind == "known":
        return f"known at {site} of {peer}"
    preposition = "of" if kind == "store" else "by"
    return f"{kind} {preposition} {site}"


class ObservedEnergy(NamedTuple):
    """Verdict on a run, based on energies that its laws declare, such as the level of a tank.

    `ObservedEnergy.of_log` computes the declared energies and compares them with recorded
    torques and motion. If no law returns more energy than it received, this is evidence that
    the run is stable.

    Attributes:
        finding: Whether the energies stay above zero, or why this cannot be judged.
        premises: The conditions under which the energies count as evidence, each with the
            result of its check.
        least: Minimum of every energy over time.
        largest_j: Largest of all energies, in J.
        residual_j: Largest difference between the energy that a law dissipated and the sum of
            the other energies that it declares, in J.
        sampling_j: Largest energy that an arm received without its law accounting for it, in J.
            Such energy arises because the torque is constant between ticks.
        curves: Every energy over time, and the energies that the arms supplied to their laws.
        undeclared_sites: Sites whose laws declare no energies, although other laws do. The
            energies are then not judged.
        incomplete_sites: Sites with missing records, because of which the energies are not
            judged.
    """

    finding: _Finding
    premises: Sequence[Premise] = ()
    least: Sequence[_LeastEnergy] = ()
    largest_j: float = 0.0
    residual_j: float = 0.0
    sampling_j: float = 0.0
    curves: Sequence[_EnergyCurve] = ()
    undeclared_sites: tuple[str, ...] = ()
    incomplete_sites: tuple[str, ...] = ()

    @property
    def text(self) -> str:
        """The verdict as a sentence for the user, generated by the package `presentation`."""
        return str(find_hook("describe a finding")(self))

    def to_json(self) -> JsonObject:
        """Returns the verdict, its premises and the smallest energies as values for JSON.

        The energies over time are omitted, because they have one value per tick and are meant
        for figures.
        """
        return {
            "finding": self.finding,
            "text": self.text,
            "premises": [premise.to_json() for premise in self.premises],
            "least": [least.to_json() for least in self.least],
            "largest_j": self.largest_j,
            "residual_j": self.residual_j,
            "sampling_j": self.sampling_j,
        }

    @classmethod
    def of_log(cls, log: Log, *, own_laws: bool = False) -> "ObservedEnergy | None":
        """Checks the energies that control laws declare against recorded torques and motion.

        A control law may declare how much energy it stores. This check shows whether the
        declaration is correct, and whether the law produced energy, which can make the arms
        unstable.

        Args:
            log: The log of the run.
            own_laws: True to also evaluate laws that are not part of this program, which
                executes their code.

        Returns:
            The verdict, or `None` if no law declares energies.

        Raises:
            LogError: A record cannot be read.
            ScenarioError: The file of a law that is not part of this program is missing.
        """
        laws = cls.find_laws(log.scenario, own_laws=own_laws)
        if not laws:
            return None

        unjudged: _Finding = "not_judged"
        undeclared_sites = [site for site in log.sites if site not in laws]
        if undeclared_sites:
            return ObservedEnergy(unjudged, undeclared_sites=tuple(undeclared_sites))

        parts = {site: log[site] for site in log.sites}
        incomplete = []
        for site, part in parts.items():
            # a first tick above 0 means that records before it are missing
            if not len(part) or part.missing or part.tick[0]:
                incomplete.append(site)
        if incomplete:
            return ObservedEnergy(unjudged, incomplete_sites=tuple(incomplete))

        accounts = {site: _read_books(log, site, law) for site, law in laws.items()}
        return _judge_books(log, accounts)

    @staticmethod
    def find_laws(scenario: Scenario, *, own_laws: bool = False) -> dict[str, Any]:
        """Returns the control laws that declare their stored and dissipated energy, by site.

        An example is a law with an energy tank that declares the level of the tank.

        Args:
            scenario: Scenario of the run.
            own_laws: True to also create laws that are not part of this program, which executes
                their code.

        Raises:
            ScenarioError: The file of a law that is not part of this program is missing.
        """
        laws: dict[str, Any] = {}
        user_laws = scenario.user_laws
        for site in scenario.names:
            setup = scenario.setup(site)
            is_allowed = own_laws or site not in user_laws
            if setup.law_factory is not None and is_allowed:
                law = setup.law_factory(setup.law_context())
                if callable(getattr(law, "energies", None)):
                    laws[site] = law
        return laws


class _SiteBooks(NamedTuple):
    """Energies that a control law declares, together with those that follow from the records.

    Arrays have the shape (K,) and are in J. They start at the first tick (control period).

    Attributes:
        t_s: Times of the ticks, in s.
        declared: The energies that the law declares.
        port: Energy that the arm gave to the law, according to the law.
        taken: Energy that the law dissipated.
        residual: Part of the dissipated energy that the other declared energies do not explain.
        leak: Energy that the arm received and the law does not account for.
    """

    t_s: Array
    declared: LawEnergies
    port: Array
    taken: Array
    residual: Array
    leak: Array


def _read_books(log: Log, site: str, law: Any) -> _SiteBooks:
    """Computes the energies that a control law declares, and the same energies from records.

    A law that is wrong may declare energies that did not flow. The comparison reveals this.

    Args:
        log: The log of the run.
        site: Name of the site.
        law: The law, which has a method `energies`.
    """
    site_log = log[site]
    site_setup = log.scenario.setup(site)
    # no law computed a record with the mode "diverged"
    tick_count = len(site_log) - int(site_log.mode[-1] == "diverged")
    records = _read_law_records(log, site, law, tick_count)
    declared: LawEnergies = law.energies(records)
    limit_nm = np.array(site_setup.tau_limit_nm)
    held_torque = hold_torque(records.tau, limit_nm, digital=site_setup.digital)

    arm_gave = -records.sum_work(held_torque)
    if site_setup.theta_known:
        # the torque that holds the arm against gravity is not counted as work of the law
        potential = build_arm_rows(log.scenario, site).potential_energy(records.q)
        arm_gave += declared.gravity * (potential - potential[0])
    arm_gave *= declared.weight
    port = arm_gave if declared.port is None else declared.port
    stored = np.zeros(tick_count)
    if declared.store is not None:
        stored = _add_parts(declared.store)
    received = sum(map(_add_parts, declared.took))
    sent = sum(map(_add_parts, declared.gave))
    dissipated = port + (received - sent) - stored
    dissipated -= dissipated[0]

    taken = dissipated
    if declared.taken is not None:
        taken = declared.taken - declared.taken[0]
    return _SiteBooks(
        t_s=site_log.t_s[:tick_count],
        declared=declared,
        port=port,
        taken=taken,
        residual=dissipated - taken,
        leak=port - arm_gave,
    )


def _add_parts(energy: Array) -> Array:
    """Returns the sum of an energy over all of its parts at every tick, shape (K,).

    A law may declare an energy in parts, for example one per joint.
    """
    parts = energy.reshape(len(energy), -1)
    total: Array = parts.sum(axis=1)
    return total


def _read_law_records(
    log: Log,
    site: str,
    law: Any,
    count: int,
) -> LawRecords:
    """Collects the recorded data of one arm in the form that its control law requires.

    The law computes from these data the energies that it declares, such as its stored energy.

    Args:
        log: The log of the run.
        site: Name of the site.
        law: The law.
        count: Number of records, beginning with the first.
    """
    site_log = log[site]
    sent = {key: values[:count] for key, values in site_log.sent.items()}
    return LawRecords(
        h_s=1.0 / site_log.rate_hz,
        q=site_log.q[:count],
        qd=site_log.qd[:count],
        tau=site_log.tau[:count],
        tau_x=site_log.tau_x[:count],
        to_all={key: values for key, values in sent.items() if "[" not in key},
        memory=_read_law_memory(log, site, law, count),
        peers=[
            LawRecords.select_messages(
                site=site,
                peer=peer,
                tick=site_log.used[peer][:count],
                sent=sent,
                sent_by_peer=log[peer].sent,
            )
            for peer in site_log.peers
        ],
    )


def _read_law_memory(
    log: Log,
    site: str,
    law: Any,
    count: int,
) -> dict[str, Array]:
    """Returns the recorded values that a control law keeps from one tick to the next.

    An example is an integral of the error. A tick is a period of the control loop.

    Args:
        log: The log of the run.
        site: Name of the site, the process that controls the arm.
        law: The law. Its attribute `remembers` lists the names of these values.
        count: Number of records to read, beginning with the first.

    Returns:
        For each name, the values in these records.
    """
    site_log = log[site]
    rule = log.scenario.sites[site].on_stale.rule
    life_length = site_log.layout.count_life_memory(len(site_log.peers), degrades=rule.degrades)
    # the law's memory comes after the memory of the session state or of the reference
    first = site_log.layout.shared + 1
    if rule.glides:
        first = life_length

    attributes = getattr(law, "remembers", ())
    lengths = [np.size(getattr(law, attribute)) for attribute in attributes]
    memory = site_log.memory(first, sum(lengths))[:count]
    ends = np.cumsum(lengths, dtype=np.int64)
    parts = np.split(memory, ends[:-1], axis=1)
    # without attributes there is one empty part
    return dict(zip(attributes, parts, strict=False))


def _judge_books(log: Log, accounts: Mapping[str, _SiteBooks]) -> ObservedEnergy:
    """Judges whether the energies that laws declare are contradictory, negative or passive.

    A control law may state how much energy it stores and dissipates. A law is passive if it
    never gives back more energy than it received, which is a sign of stability.

    Args:
        log: The log of the run.
        accounts: Energies of every site's law.
    """
    curves = list(_find_curves(log, accounts))
    # the minimum over time of every energy that must not be below zero
    least = []
    for curve in curves:
        row = int(curve.least_j.argmin())
        minimum = _LeastEnergy(
            kind=curve.kind,
            site=curve.site,
            peer=curve.peer,
            amount_j=float(curve.least_j[row]),
            at_s=float(curve.t_s[row]),
        )
        least.append(minimum)

    largest_j = max(float(curve.energy_j.max()) for curve in curves)
    for site, account in accounts.items():
        port = account.port
        curve = _EnergyCurve(
            kind="given",
            site=site,
            peer="",
            t_s=account.t_s,
            energy_j=port,
            least_j=port,
        )
        curves.append(curve)

    port_sizes_j = [float(np.abs(account.port).max()) for account in accounts.values()]
    scale_j = max(largest_j, *port_sizes_j)
    premises = _check_books(log, accounts, scale_j)

    lowest = min(least, key=lambda energy: energy.amount_j)
    finding: _Finding = "passive"
    if not premises[0].holds:
        finding = "broken"
    elif lowest.amount_j < LEAST_ENERGY_J - ROUNDING_SHARE * scale_j:
        finding = "negative"
    return ObservedEnergy(
        finding=finding,
        premises=premises,
        least=least,
        largest_j=largest_j,
        residual_j=max(_largest_residual_j(account) for account in accounts.values()),
        sampling_j=max(float(account.leak.max()) for account in accounts.values()),
        curves=curves,
    )


def _find_curves(log: Log, accounts: Mapping[str, _SiteBooks]) -> Iterator[_EnergyCurve]:
    """Yields the energies over time that a passive control law never lets fall below zero.

    These energies are the energy in transit between two arms (line), the part of it that the
    receiver knows, the stored energy, and the energy that a law dissipated.

    Args:
        log: The log of the run.
        accounts: Energies of every site's law.
    """
    for site, account in accounts.items():
        declared = account.declared
        energies: list[tuple[_EnergyKind, str, Array]] = []
        if declared.store is not None:
            energies.append(("store", "", declared.store))
        for j, peer in enumerate(log[site].peers):
            peer_account = accounts[peer]
            index_at_peer = log[peer].peers.index(site)
            sent_j = peer_account.declared.gave[index_at_peer]
            # the peer's last tick at each tick of this site
            next_row = np.searchsorted(peer_account.t_s, account.t_s + 1e-9, side="right")
            line_j = sent_j[next_row - 1] - declared.took[j]
            energies.append(("line", peer, line_j))
            if declared.observed:
                energies.append(("known", peer, declared.observed[j]))

        for kind, peer, energy in energies:
            parts = energy.reshape(len(energy), -1)
            yield _EnergyCurve(
                kind=kind,
                site=site,
                peer=peer,
                t_s=account.t_s,
                energy_j=_add_parts(energy),
                least_j=parts.min(axis=1),
            )
        yield _EnergyCurve(
            kind="taken",
            site=site,
            peer="",
            t_s=account.t_s,
            energy_j=account.taken,
            least_j=account.taken - np.maximum.accumulate(account.taken),
        )


def _largest_residual_j(account: _SiteBooks) -> float:
    """Returns the largest error in the energies that a control law declares, in J.

    The energies must add up: the dissipated energy must equal the sum of the others.
    """
    return float(np.abs(account.residual).max())


def _check_books(log: Log, accounts: Mapping[str, _SiteBooks], scale_j: float) -> list[Premise]:
    """Checks the conditions under which the declared energies count as evidence.

    - books: the energies that each law declares add up;
    - torque: each law uses the torque that the arm received, even if the torque was cut off;
    - sampling: arms receive little energy between the ticks that their laws do not account for.

    Args:
        log: The log of the run.
        accounts: Energies of every site's law.
        scale_j: Largest energy that occurs.
    """
    residual_j = {site: _largest_residual_j(account) for site, account in accounts.items()}
    worst_site = max(residual_j, key=residual_j.__getitem__)
    holds = residual_j[worst_site] <= -LEAST_ENERGY_J + 1e-9 * scale_j
    books_quantities = BooksQuantities(worst_site, residual_j[worst_site], scale_j)
    premises = [Premise("books", holds, books_quantities)]

    limited = []
    for site in accounts:
        limit_nm = np.array(log.scenario.setup(site).tau_limit_nm)
        if (np.abs(log[site].tau) >= limit_nm).any():
            limited.append(site)
    uncounted_j = {site: float(account.leak.max()) for site, account in accounts.items()}
    largest_uncounted_j = SAMPLING_SHARE * scale_j + 1e-9
    unbooked = tuple(site for site in limited if uncounted_j[site] > largest_uncounted_j)
    torques = BookedTorqueQuantities(tuple(limited), unbooked)
    premises.append(Premise("torque", not unbooked, torques))

    worst_site = max(uncounted_j, key=uncounted_j.__getitem__)
    sampling = SamplingQuantities(worst_site, uncounted_j[worst_site])
    premises.append(
        Premise("sampling", uncounted_j[worst_site] <= largest_uncounted_j, sampling)
    )
    return premises
