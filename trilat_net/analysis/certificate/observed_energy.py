"""ObservedEnergy of laws that declare what proves it: energy of lines, observers and tanks,
from the records.

Invariant: a law that declares energies is believed in nothing else. A line is what a site gave
less what its peer took; the arm's port is the torque that was held times the step of the
joints. Lines and stores are never below zero, and what a law has taken for good never falls, or
the certificate says where.
"""

from collections.abc import Iterator, Mapping, Sequence
from enum import StrEnum
from typing import Any, NamedTuple

import numpy as np

from ...core.law_energy import LawEnergies, LawRecords, PeerRecords, sum_work
from ...core.site_setup import Scheme, StaleAction
from ...core.vectors import Array
from ...errors import count_nouns
from ...log.log_reader import Log
from ...results import JsonObject
from ...scenario.imported_code import ImportedLaw
from ..aligned import hold_torque
from ..arm_rows import build_arm_rows
from .premises import Premise

LEAST_ENERGY_J = -1e-9
"""What rounding may leave of an energy that is not below zero, J."""
ROUNDING_SHARE = 1e-12
"""And as a share of the largest energy."""
SAMPLING_SHARE = 1e-2
"""The arms may get so much more than the laws book, as a share of the largest energy."""


class ObservedFinding(StrEnum):
    """Class of a verdict; the text is the word for people."""

    PASSIVE = "observed energy never below zero"
    NEGATIVE = "observed energy below zero"
    BROKEN = "the energies that a law declares do not add up"
    NOT_JUDGED = "observed energy cannot be judged"


class EnergyCurve(NamedTuple):
    """An energy over time.

    Attributes:
        kind: "line" from a peer to a site, "known" there of a peer, "store" of, "taken" by or
            "given" by it.
        site: whose it is.
        peer: the other end; "" of what has none.
        t_s: of the site's ticks, s.
        energy_j: the sum of its parts, shape (K,).
        least_j: that of them which is least, shape (K,).
    """

    kind: str
    site: str
    peer: str
    t_s: Array
    energy_j: Array
    least_j: Array

    @property
    def name(self) -> str:
        """Its name: "line m->s", "known at s of m", "store of s", "taken by s" or "given by s"."""
        site = self.site
        peer = self.peer
        if self.kind == "line":
            return f"line {peer}->{site}"
        if self.kind == "known":
            return f"known at {site} of {peer}"
        return f"{self.kind} {'of' if self.kind == 'store' else 'by'} {site}"


class LeastEnergy(NamedTuple):
    """An energy that must not be below zero, where it is least; named like its curve."""

    name: str
    amount_j: float
    at_s: float


class ObservedEnergy(NamedTuple):
    """Verdict on the energies that laws declare.

    Attributes:
        finding: its class.
        text: the sentence.
        premises: what it rests on, one by one.
        least: every energy where it is least.
        largest_j: the largest of them.
        residual_j: by how much the books of a law do not add up at most.
        sampling_j: the most that the arms got beyond what the laws book.
        curves: of every energy, and of what the arms gave to their laws.
    """

    finding: ObservedFinding
    text: str
    premises: Sequence[Premise] = ()
    least: Sequence[LeastEnergy] = ()
    largest_j: float = 0.0
    residual_j: float = 0.0
    sampling_j: float = 0.0
    curves: Sequence[EnergyCurve] = ()

    def to_json(self) -> JsonObject:
        """Returns it ready for JSON."""
        premises, least = (
            [one._asdict() for one in rows] for rows in (self.premises, self.least)
        )
        plain = {key: value for key, value in self._asdict().items() if key != "curves"}
        return {
            **plain,
            "finding": self.finding.name.lower(),
            "premises": premises,
            "least": least,
        }


class _SiteBooks(NamedTuple):
    """The energies of a site's law at its ticks, from the first one, J.

    Attributes:
        t_s: the ticks' times, s.
        booked: what its law declares.
        port: what the arm gave to the law by its books.
        taken: what the law has taken for good.
        residual: by how much the books do not add up.
        leak: what the arm got beyond the books.
    """

    t_s: Array
    booked: LawEnergies
    port: Array
    taken: Array
    residual: Array
    leak: Array


def observe_energies(log: Log, *, own_laws: bool = False) -> ObservedEnergy | None:
    """Returns the verdict on the energies that the laws of a log declare; None if none declares
    any.

    A law from outside is asked with `own_laws` alone, since that runs its code.

    Raises:
        LogError: a record cannot be read.
        ScenarioError: the file of a law from outside is missing.
    """
    laws: dict[str, Any] = {}
    for name, spec in log.scenario.sites.items():
        setup = log.scenario.setup(name)
        if setup.law_factory is not None and (
            own_laws or not isinstance(spec.control, ImportedLaw)
        ):
            law = setup.law_factory(setup.law_context())
            laws |= {name: law} if callable(getattr(law, "energies", None)) else {}
    if not laws:
        return None
    silent = [name for name in log.sites if name not in laws]
    gaps = [
        name
        for name in log.sites
        if not len(log[name]) or log[name].missing or log[name].tick[0]
    ]
    if silent or gaps:
        why = f"the law of {', '.join(silent)} declares none"
        why = why if silent else f"records of {', '.join(gaps)} are missing"
        return ObservedEnergy(
            ObservedFinding.NOT_JUDGED, f"{ObservedFinding.NOT_JUDGED}: {why}"
        )
    return _judge(log, {name: _read_books(log, name, law) for name, law in laws.items()})


def _read_books(log: Log, name: str, law: Any) -> _SiteBooks:
    part = log[name]
    setup = log.scenario.setup(name)
    count = len(part) - int(part.mode[-1] == "diverged")
    records = _read_law_records(log, name, law, count)
    booked: LawEnergies = law.energies(records)
    limit_nm = np.array(setup.tau_limit_nm)
    digital = setup.scheme is Scheme.DIGITAL
    given = -sum_work(hold_torque(records.tau, limit_nm, digital=digital), records.q)
    if setup.theta_known:  # holding the arm is no work of the law
        potential = build_arm_rows(log.scenario, name).potential_energy(records.q)
        given += booked.gravity * (potential - potential[0])
    given *= booked.weight
    port = given if booked.port is None else booked.port
    store = np.zeros(count) if booked.store is None else _add_parts(booked.store)
    flows = sum(map(_add_parts, booked.took)) - sum(map(_add_parts, booked.gave))
    left = port + flows - store
    left -= left[0]
    taken = left if booked.taken is None else booked.taken - booked.taken[0]
    t_s = part.t_s[:count]
    return _SiteBooks(
        t_s=t_s, booked=booked, port=port, taken=taken, residual=left - taken, leak=port - given
    )


def _add_parts(energy: Array) -> Array:
    """Returns the sum of an energy's parts, shape (K,)."""
    whole: Array = energy.reshape(len(energy), -1).sum(axis=1)
    return whole


def _read_law_records(log: Log, name: str, law: Any, count: int) -> LawRecords:
    part = log[name]
    rule = log.scenario.sites[name].on_stale.rule
    life = part.layout.count_life_memory(len(part.peers), degrades=rule.degrades)
    own = life if rule.action is StaleAction.GLIDE else part.layout.shared + 1
    attributes = getattr(law, "remembers", ())
    lengths = [np.size(getattr(law, attribute)) for attribute in attributes]
    mem = part.memory(own, sum(lengths))[:count]
    parts = np.split(mem, np.cumsum(lengths, dtype=np.int64)[:-1], axis=1)
    memory = dict(zip(attributes, parts, strict=False))  # without any, the one part is empty
    sent = {key: values[:count] for key, values in part.sent.items()}
    peers = []
    for peer in part.peers:
        tick = part.used[peer][:count]
        there = log[peer].sent
        heard = {key.removesuffix(f"[{name}]"): values for key, values in there.items()}
        received = {
            key: np.where(tick[:, None] >= 0, values[np.maximum(tick, 0)], 0.0)
            for key, values in heard.items()
            if "[" not in key
        }
        alone = {
            key.partition("[")[0]: values
            for key, values in sent.items()
            if key.endswith(f"[{peer}]")
        }
        peers.append(PeerRecords(tick, received, alone))
    to_all = {key: values for key, values in sent.items() if "[" not in key}
    motion = (part.q[:count], part.qd[:count], part.tau[:count], part.tau_x[:count])
    return LawRecords(1.0 / part.rate_hz, *motion, to_all, memory, peers)


def _find_curves(log: Log, books: Mapping[str, _SiteBooks]) -> Iterator[EnergyCurve]:
    """Yields the energies that must not be below zero."""
    for site, own in books.items():
        booked = own.booked
        energies = []
        if booked.store is not None:
            energies.append(("store", "", booked.store))
        # what the peer had given by each tick of this site
        for j, peer in enumerate(log[site].peers):
            other = books[peer]
            gave = other.booked.gave[log[peer].peers.index(site)]
            row = np.searchsorted(other.t_s, own.t_s + 1e-9, side="right") - 1
            energies.append(("line", peer, gave[row] - booked.took[j]))
            if booked.observed:
                energies.append(("known", peer, booked.observed[j]))
        for kind, peer, energy in energies:
            least = energy.reshape(len(energy), -1).min(axis=1)
            yield EnergyCurve(
                kind=kind,
                site=site,
                peer=peer,
                t_s=own.t_s,
                energy_j=_add_parts(energy),
                least_j=least,
            )
        falls = own.taken - np.maximum.accumulate(own.taken)
        yield EnergyCurve(
            kind="taken", site=site, peer="", t_s=own.t_s, energy_j=own.taken, least_j=falls
        )


def _judge(log: Log, books: Mapping[str, _SiteBooks]) -> ObservedEnergy:
    curves = list(_find_curves(log, books))
    least = []
    for one in curves:
        low = int(one.least_j.argmin())
        least.append(LeastEnergy(one.name, float(one.least_j[low]), float(one.t_s[low])))
    largest = max(float(one.energy_j.max()) for one in curves)
    curves += [
        EnergyCurve(
            kind="given", site=site, peer="", t_s=one.t_s, energy_j=one.port, least_j=one.port
        )
        for site, one in books.items()
    ]
    scale = max(largest, *(float(np.abs(own.port).max()) for own in books.values()))
    residual = max(float(np.abs(own.residual).max()) for own in books.values())
    sampling = max(float(own.leak.max()) for own in books.values())
    premises = _check_premises(log, books, scale)
    lowest = min(least, key=lambda one: one.amount_j)
    failed = [premise.name for premise in premises if not premise.holds]
    if not premises[0].holds:
        finding = ObservedFinding.BROKEN
        text = premises[0].text
    elif lowest.amount_j < LEAST_ENERGY_J - ROUNDING_SHARE * scale:
        finding = ObservedFinding.NEGATIVE
        text = f"{lowest.name} is {lowest.amount_j:.3g} J at {lowest.at_s:.4g} s"
    else:
        finding = ObservedFinding.PASSIVE
        text = f"{count_nouns(len(least), 'energy')}, the largest {largest:.4g} J"
        text += f"; but a premise fails: {', '.join(failed)}" * bool(failed)
    numbers = (least, largest, residual, sampling, curves)
    return ObservedEnergy(finding, f"{finding}: {text}", premises, *numbers)


def _check_premises(log: Log, books: Mapping[str, _SiteBooks], scale: float) -> list[Premise]:
    residual = {site: float(np.abs(own.residual).max()) for site, own in books.items()}
    site = max(residual, key=residual.__getitem__)
    text = f"the law of {site} adds up to {residual[site]:.1e} J of {scale:.4g} J, the others closer"
    premises = [Premise("books", residual[site] <= -LEAST_ENERGY_J + 1e-9 * scale, text)]
    limits = {name: np.array(log.scenario.setup(name).tau_limit_nm) for name in books}
    cut = [name for name in books if (np.abs(log[name].tau) >= limits[name]).any()]
    leak = {name: float(own.leak.max()) for name, own in books.items()}
    most = SAMPLING_SHARE * scale + 1e-9
    missed = [name for name in cut if leak[name] > most]
    text = f"cut off at {', '.join(missed or cut)}" if cut else "never cut off"
    text += (
        ": the arm got another one than the law books"
        if missed
        else ", and booked so" * bool(cut)
    )
    premises.append(Premise("torque", not missed, text))
    site = max(leak, key=leak.__getitem__)
    text = (
        f"the arm of {site} got up to {leak[site]:.3g} J more than its law books, between ticks"
    )
    premises.append(Premise("sampling", leak[site] <= most, text))
    return premises
