"""The types of a scenario, complete and frozen, and what the core is built from.

Law: keys end in their unit; symbols are the paper's. `Scenario.text` is canonical: it loads to the same
scenario, and its SHA-256 names the experiment.
"""

import hashlib
import re
from functools import cached_property
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
import tomli_w
from msgspec import Meta

from ..core import dominance
from ..core.arm import Array
from ..core.draw import link_key
from ..core.setup import LinkSetup, Scheme, SiteSetup
from ..core.tick import Ramp
from .expectation import Expect
from .frozen import Frozen
from .link import LinkBase
from .links import Link
from .own_law import Own
from .site import SiteSpec
from .timeline import Change, later_links

_UNASKED: dict[str, tuple[Any, ...]] = {
    "timeline": ((), []),
    "expect": ({},),
    "on_stale": ({},),
    "environment": ((), []),
    "plant": ("simulated",),
}
"""Keys that older scenarios do not have, and the values that say nothing."""
_NUMBERS = re.compile(r"\[\n(?:    [-+.\de]+,\n)+\]")


def _one_line(numbers: re.Match[str]) -> str:
    """Puts a list of numbers on one line."""
    return "[" + ", ".join(line.strip(" ,") for line in numbers[0][1:-1].split()) + "]"


class Scenario(Frozen, frozen=True, dict=True):
    """An experiment, resolved: every value of every site and link is explicit.

    Attributes:
        name: what the session and the log are called.
        title: one line for people.
        about: a paragraph for people.
        assumed: what the source of the experiment does not say, and is assumed here.
        duration_s: how long it runs, s.
        seed: what every random draw is a function of.
        scheme: "second_order" or "digital", see `core.site.Scheme`.
        sites: the manipulators, in order; the first leads a live session.
        dominance: row i, column j: share of site j in the reference of site i, Eq. (6).
        links: "j->i" for every pair of sites.
        timeline: what changes during the run.
        expect: what `trilat test` demands of it.
    """

    name: Annotated[str, Meta(pattern=r"^[A-Za-z0-9][A-Za-z0-9_\-]*$", max_length=64)]
    duration_s: Annotated[float, Meta(gt=0.0, le=86_400.0)]
    seed: Annotated[int, Meta(ge=0, le=2**63 - 1)]
    scheme: Literal["second_order", "digital"]
    sites: dict[str, SiteSpec]
    dominance: dict[str, dict[str, float]]
    links: dict[str, Link]
    timeline: tuple[Change, ...] = ()
    expect: Expect = Expect()
    title: str = ""
    about: str = ""
    assumed: tuple[str, ...] = ()

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the sites, in order."""
        return tuple(self.sites)

    @cached_property
    def alpha(self) -> Array:
        """The dominance matrix, shape (N, N), Eq. (6)."""
        return np.array([[self.dominance[i].get(j, 0.0) for j in self.names] for i in self.names])

    @property
    def beta(self) -> Array | None:
        """Left null vector of Upsilon, shape (N,), sum 1, Eq. (20); None where alpha is reducible."""
        return dominance.perron(self.alpha) if dominance.irreducible(self.alpha) else None

    @cached_property
    def text(self) -> str:
        """The canonical TOML text."""
        tables: dict[str, Any] = msgspec.to_builtins(self)
        words = {key: tables.pop(key) for key in ("name", "title", "about", "assumed")}
        words = {key: value for key, value in words.items() if value}
        for site in tables["sites"].values():
            if site["arm"]["known"]:
                del site["arm"]["known"]
        for table in (tables, *tables["sites"].values()):
            for key, unasked in _UNASKED.items():  # what nobody asked for is not there
                if table.get(key) in unasked:
                    del table[key]
        numbers = _NUMBERS.sub(_one_line, tomli_w.dumps(tables))
        return tomli_w.dumps(words, multiline_strings=True) + numbers

    @cached_property
    def sha256(self) -> str:
        """Names the experiment: hash of the canonical text."""
        return hashlib.sha256(self.text.encode()).hexdigest()

    def ticks(self, site: str) -> int:
        """Returns how many ticks a site makes."""
        return max(1, round(self.duration_s * self.sites[site].rate_hz))

    def peers(self, site: str) -> tuple[str, ...]:
        """Returns the peers of a site, in scenario order."""
        return tuple(name for name in self.names if name != site)

    def _all_links(self) -> list[LinkBase]:
        """Returns what every link is at any time of the run."""
        later = [link for name in self.links for _, link in later_links(self.timeline, name)]
        return [*self.links.values(), *later]

    @property
    def random(self) -> bool:
        """True where anything is drawn: then another seed is another run."""
        return any(link.random for link in self._all_links())

    @property
    def measured(self) -> bool:
        """True where a sample of some link is in use as soon as it has come: then the network decides."""
        return any(link.measured for link in self._all_links())

    @property
    def external(self) -> tuple[str, ...]:
        """The sites whose arms are outside of the program."""
        return tuple(name for name, spec in self.sites.items() if spec.plant == "external")

    def setup(self, site: str) -> SiteSetup:
        """Returns all that the core needs to build a site."""
        spec = self.sites[site]
        return SiteSetup(
            name=site,
            rate_hz=spec.rate_hz,
            scheme=Scheme[self.scheme.upper()],
            gains=spec.control.gains(spec.arm.theta),
            theta=spec.arm.theta,
            g_m_s2=spec.arm.g_m_s2,
            lengths_m=(spec.arm.l1_m, spec.arm.l2_m),
            tau_limit_nm=spec.limits.tau_limit_nm,
            qd_limit_rad_s=spec.limits.qd_limit_rad_s,
            q0=spec.q0_rad,
            qd0=spec.qd0_rad_s,
            actors=tuple(one.actor for one in (*spec.hands, *spec.environment)),
            links=tuple(self._link_setup(peer, site) for peer in self.peers(site)),
            ramps=tuple(
                self.ramp(site, change.shares, change.start_ns, change.ramp_s)
                for change in self.timeline
                if change.dominance == site
            ),
            on_stale=spec.on_stale.rule,
            external=spec.plant == "external",
            own=spec.control.maker(len(self.sites)) if isinstance(spec.control, Own) else None,
            theta_known=spec.arm.known,
        )

    def _link_setup(self, peer: str, site: str) -> LinkSetup:
        name = f"{peer}->{site}"
        first = self.links[name]
        models: list[tuple[int, LinkBase]] = [(0, first), *later_links(self.timeline, name)]
        return LinkSetup(
            peer=peer,
            alpha=self.dominance[site].get(peer, 0.0),
            rate_hz=self.sites[peer].rate_hz,
            q0=self.sites[peer].q0_rad,
            key=link_key(self.seed, name),
            models=tuple(link.core(from_ns) for from_ns, link in models),
            traces=tuple(link.points for _, link in models),
            outages=tuple((round(a * 1e9), round(b * 1e9)) for a, b in first.outages_s),
        )

    def ramp(self, site: str, shares: dict[str, float], start_ns: int, ramp_s: float) -> Ramp:
        """Returns a change of a site's shares, as the core has it."""
        alpha = tuple(shares.get(peer, 0.0) for peer in self.peers(site))
        return Ramp(start_ns, start_ns + round(ramp_s * 1e9), alpha)

    def without_hands(self) -> "Scenario":
        """Returns the same experiment with nobody at the arms: the twin that hands are measured against."""
        sites = {name: msgspec.structs.replace(spec, hands=()) for name, spec in self.sites.items()}
        return msgspec.structs.replace(self, sites=sites)
