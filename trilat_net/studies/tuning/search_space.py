"""The search space of each control law.

Its gains with units and ranges, and the model information all laws share.

Invariant: ranges are log-uniform, one number for both joints and all sites of a role; a
quantity has the same range in every law (stiffness is K or Kp Lambda, damping d or Kp). Of a
chain that number is the heaviest joint's, and the others have their share of it, see
`weigh_joints`. All laws get the same gravity parameters, the true ones times one share, and no
inertia: a law that estimates it starts at zero.
"""

import inspect
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from ...analysis.arm_rows import build_arm_rows
from ...errors import ScenarioError, UsageError
from ...fields import MAX_QUANTITY, is_number, suggest_nearest
from ...laws.interface import DAMPING, ERROR_DAMPING, ControlLaw, TuningSite
from ...scenario import Scenario
from ...scenario.imported_code import (
    CodeConsent,
    CodeKey,
    allowed_code,
    import_class,
    read_code,
)
from ...scenario.laws import BUILT_IN

MIN_BOX = 0.1
"""Least half width of a box of estimates, as a share of the given parameters."""


class ModelInformation(NamedTuple):
    """Model information that every law gets: gravity parameters as a share of the true ones."""

    gravity: float = 1.0

    @property
    def box(self) -> float:
        """Half width of a box of estimates, a share of the given parameters: twice the error,
        or 10 %.
        """
        return max(MIN_BOX, 2.0 * abs(1.0 / self.gravity - 1.0))

    def prior(self, scenario: Scenario, site: str) -> list[float]:
        """Returns the first estimate of theta, shape (P,): gravity as given, inertia unknown."""
        arm = build_arm_rows(scenario, site)
        theta = np.where(arm.gravity_parameters, arm.theta * self.gravity, 0.0)
        return [float(f"{value:.12g}") for value in theta]

    def box_sides(self, scenario: Scenario, site: str) -> tuple[list[float], list[float]]:
        """Returns the lower and the upper sides of the box, shape (P,) each: of inertia there
        is none.
        """
        known = build_arm_rows(scenario, site).gravity_parameters.tolist()
        given = list(zip(self.prior(scenario, site), known, strict=True))
        low, high = (
            [
                float(f"{value + sign * self.box * abs(value):.12g}")
                if fixed
                else sign * MAX_QUANTITY
                for value, fixed in given
            ]
            for sign in (-1.0, 1.0)
        )
        return low, high

    @property
    def text(self) -> str:
        """The same in words."""
        how = (
            "exactly" if self.gravity == 1.0 else f"as {100.0 * self.gravity:g} % of what it is"
        )
        return f"every law is told gravity {how}, and nothing of inertia"


def build_model_information(gravity_percent: float) -> ModelInformation:
    """Returns the model information with a share of the true gravity, in per cent.

    Raises:
        UsageError: it is none that an arm could be built with.
    """
    if not 50.0 <= gravity_percent <= 150.0:
        raise UsageError(f"--gravity is from 50 to 150 % of the truth, not {gravity_percent:g}")
    return ModelInformation(gravity_percent / 100.0)


GainValues = Mapping[str, float]
SiteControls = dict[str, dict[str, Any]]
"""Per site the whole of its [control]."""


class TunedGain(NamedTuple):
    """One gain that is searched, from low to high; `where`: which sites have it, "" for all."""

    name: str
    unit: str
    low: float
    high: float
    where: str = ""


class SearchSpace(NamedTuple):
    """A law and where it is searched.

    Attributes:
        law: its name; `known` is `adaptive` with Gamma = 0 and the true inertia.
        knobs: its gains.
        told: what it uses of the common model information, in words.
        kind: its class, if it is a built-in one; None: a law of one's own.
    """

    law: str
    knobs: tuple[TunedGain, ...]
    told: str
    kind: type[ControlLaw] | None = None

    def controls(
        self, scenario: Scenario, knowledge: ModelInformation, gains: GainValues
    ) -> SiteControls:
        """Returns the control of every site; gains of chains that make a torque have a number
        per joint.
        """
        mean_ms = {name: link.moments().mean_ms for name, link in scenario.links.items()}
        trips = (
            there + mean_ms["->".join(reversed(name.split("->")))]
            for name, there in mean_ms.items()
        )
        longest_ms = 0.5 * max(trips)
        tables = {
            name: self._write(
                scenario=scenario,
                site=name,
                knowledge=knowledge,
                gains=gains,
                longest_ms=longest_ms,
            )
            for name in scenario.names
        }
        weights = weigh_joints(scenario)
        for table in tables.values() if weights else ():
            for key in _TORQUE_GAINS:
                if key in table:
                    table[key] = [float(f"{table[key] * weight:.4g}") for weight in weights]
        return tables

    def _write(
        self,
        scenario: Scenario,
        site: str,
        knowledge: ModelInformation,
        gains: GainValues,
        longest_ms: float,
    ) -> dict[str, Any]:
        if self.kind is None:
            told = {"gravity": knowledge.gravity} if self.told == "gravity" else {}
            return {"law": self.law, **gains, **told}
        estimate = knowledge.prior(scenario, site)
        law = self.law
        if law == _KNOWN:
            arm = build_arm_rows(scenario, site)
            gains = {**gains, "Gamma": 0.0}
            law = "adaptive"
            estimate = np.where(arm.gravity_parameters, estimate, arm.theta).tolist()
        at = TuningSite(
            role=scenario.sites[site].role,
            gravity=knowledge.gravity,
            estimate=estimate,
            box=knowledge.box_sides(scenario, site),
            longest_ms=longest_ms,
        )
        return {"law": law, **self.kind.write_control(gains, at)}


_TORQUE_GAINS = ("rho_nm", "Kp", "Kd", "K", "d", "P_e", "b", "B")


def weigh_joints(scenario: Scenario) -> list[float]:
    """Returns the share of each joint of chains in a gain that makes a torque, at most 1; [] of
    planar arms.

    It is the inertia that the joint shows while the others are free, 1 / (M^-1)_ii, least over
    the sites' start poses, as a part of the largest; all less where an arm could not take the
    upper ends of the ranges at its tick rate (`validate`).
    """
    arms = [
        (scenario.sites[name], model)
        for name, model in scenario.arms.items()
        if model.chain is not None
    ]
    if not arms:
        return []
    inverses = [np.linalg.inv(model.inertia(np.array(site.q0_rad))) for site, model in arms]
    inertia = np.min([1.0 / np.diag(inverse) for inverse in inverses], axis=0)
    weights = inertia / inertia.max()
    scaled = np.sqrt(weights)
    most = 1.0 if scenario.scheme == "second_order" else 2.0
    for (site, _), inverse in zip(arms, inverses, strict=True):
        fastest = np.linalg.eigvalsh(scaled * inverse * scaled[:, None])[-1] / site.rate_hz
        weights *= min(1.0, 0.9 * most / ((DAMPING[1] + ERROR_DAMPING[1]) * fastest))
        scaled = np.sqrt(weights)
    return [float(f"{weight:.2g}") for weight in weights]


_KNOWN = "known"


def _list_search_spaces() -> Iterator[SearchSpace]:
    for name, kind in BUILT_IN.items():
        knobs = tuple(
            TunedGain(gain, tune[2], tune[0], tune[1], *tune[3:])
            for gain, tune in kind.tune.items()
        )
        if knobs:
            yield SearchSpace(name, knobs, kind.known_facts, kind)
        if name == "adaptive":
            told = "gravity, AND inertia exactly: more than the others"
            yield SearchSpace(
                _KNOWN, tuple(one for one in knobs if one.name != "Gamma"), told, kind
            )


SEARCH_SPACES = {space.law: space for space in _list_search_spaces()}
"""The laws that can be tuned, by name."""

DEFAULT_LAWS = ("adaptive", "adaptive_box", "p_d", "pd_d")
"""The laws that are compared unless others are named: all that take any number of sites."""
PAPER_GAINS: GainValues = {"Lambda": 1.0, "Kp": 1.0, "Kd": 3.0, "Gamma": 1.0}
"""The gains that the paper prints for `adaptive`."""


def select_search_spaces(laws: Sequence[str], scenario: Scenario) -> list[SearchSpace]:
    """Returns where the named laws are searched, once each, in their order.

    Raises:
        UsageError: there is no such law to tune.
        ScenarioError: the scenario has not the sites that it needs.
    """
    names = list(dict.fromkeys(laws)) or list(DEFAULT_LAWS)
    tuned = f"; tuned are {', '.join(SEARCH_SPACES)}"
    for name in names:
        if ":" in name:
            continue
        if name not in SEARCH_SPACES:
            hint = suggest_nearest(name, list(SEARCH_SPACES))
            raise UsageError(f"--law: there is no law {name!r} to tune{hint}{tuned}")
        roles = [spec.role for spec in scenario.sites.values()]
        kind = SEARCH_SPACES[name].kind
        if kind is not None and (why := kind.explain_misfit(roles)):
            raise ScenarioError(f"law {name} {why}", source=scenario.name)
    return [SEARCH_SPACES.get(name) or build_own_search_space(name) for name in names]


def build_own_search_space(code: str) -> SearchSpace:
    """Returns where a law of one's own is searched: its class says it, as `tune = {"K": (10.0,
    300.0)}`.

    A third entry is the unit. A class with an argument `gravity` is told the share that all
    laws are told.

    Raises:
        ScenarioError: there is no such class.
        UsageError: it has no ranges, or one of them is none.
    """
    sha256 = read_code(code, "--law").sha256
    key = CodeKey(code, sha256, "{}")
    allowed_code[key] = CodeConsent(None, sha256)
    kind = import_class(key, "--law")
    ranges = getattr(kind, "tune", None)
    if not isinstance(ranges, Mapping) or not ranges:
        raise UsageError(
            f'--law {code} has no search ranges: its class needs tune = {{"K": (10.0, 300.0)}}'
        )
    knobs = []
    for name, entry in ranges.items():
        low, high, unit = (
            (*entry, "", "", "")[:3] if isinstance(entry, tuple | list) else ("", "", "")
        )
        if not (
            is_number(low) and is_number(high) and 0.0 < low < high and isinstance(unit, str)
        ):
            problem = "is as in (10.0, 300.0), from above 0 to more, or with a unit behind"
            raise UsageError(f"--law {code}: tune[{name!r}] {problem}, not {entry!r}")
        knobs.append(TunedGain(str(name), unit, float(low), float(high)))
    told = "gravity" in inspect.signature(kind).parameters
    return SearchSpace(code, tuple(knobs), "gravity" if told else "what it asks of now")
