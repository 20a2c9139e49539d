"""The search space of each control law, and the model information that all laws share.

A search space lists the gains of a law, each with its unit and range. `SearchSpace.controls`
turns a choice of gains into the control tables of all sites.

Invariant:
    - The ranges are log-uniform.
    - A gain is one number for both joints, and for all sites of a role.
    - A quantity has the same range in every law: stiffness is K or Kp Lambda, damping is d or
      Kp.
    - For a chain the number is the gain of the heaviest joint. The other joints have a share of
      it, see `weigh_joints`.
    - All laws get the same gravity parameters: the true ones times a common share.
    - No law gets the inertia: a law that estimates it starts at zero. The law `known` is the
      exception.
"""

import inspect
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from ...analysis.arm_rows import build_arm_rows
from ...errors import ScenarioError, UsageError
from ...fields import MAX_QUANTITY, is_number, suggest_nearest
from ...laws.interface import (
    DAMPING,
    ERROR_DAMPING,
    ControlLaw,
    GainRange,
    TuningSite,
)
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
"""Least half width of a box of estimates, as a share of the estimated parameter."""


def _round_parameter(value: float) -> float:
    """Returns a parameter with 12 significant digits, so that commands stay short."""
    return float(f"{value:.12g}")


class ModelInformation(NamedTuple):
    """Model information that every law gets.

    Attributes:
        gravity: the gravity parameters that laws get, as a share of the true ones.
    """

    gravity: float = 1.0

    @property
    def box(self) -> float:
        """Half width of a box of estimates, as a share of the estimated parameter.

        The width is twice the error of the gravity parameters, but at least `MIN_BOX`.
        """
        return max(MIN_BOX, 2.0 * abs(1.0 / self.gravity - 1.0))

    def prior(self, scenario: Scenario, site: str) -> list[float]:
        """Returns the first estimate of theta, shape (P,): no inertia, and shared gravity."""
        arm = build_arm_rows(scenario, site)
        theta = np.where(arm.gravity_parameters, arm.theta * self.gravity, 0.0)
        return [_round_parameter(value) for value in theta]

    def box_sides(self, scenario: Scenario, site: str) -> tuple[list[float], list[float]]:
        """Returns the lower and the upper sides of the box of estimates, shape (P,) each.

        The parameters of inertia are unbounded: nothing is known about them.
        """
        is_gravity = build_arm_rows(scenario, site).gravity_parameters.tolist()
        estimate = self.prior(scenario, site)
        lower = []
        upper = []
        for value, is_known in zip(estimate, is_gravity, strict=True):
            if is_known:
                half_width = self.box * abs(value)
                lower.append(_round_parameter(value - half_width))
                upper.append(_round_parameter(value + half_width))
            else:
                lower.append(-MAX_QUANTITY)
                upper.append(MAX_QUANTITY)
        return lower, upper

    @property
    def text(self) -> str:
        """The model information as a clause of a sentence."""
        if self.gravity == 1.0:
            gravity = "the exact gravity parameters"
        else:
            gravity = f"{100.0 * self.gravity:g} % of the true gravity parameters"
        return f"every law gets {gravity}, and no inertia"


def build_model_information(gravity_percent: float) -> ModelInformation:
    """Returns the model information with a share of the true gravity.

    Args:
        gravity_percent: the share, in per cent.

    Raises:
        UsageError: the share is not from 50 to 150 %.
    """
    if not 50.0 <= gravity_percent <= 150.0:
        raise UsageError(f"--gravity is from 50 to 150 % of the truth, not {gravity_percent:g}")
    return ModelInformation(gravity_percent / 100.0)


GainValues = Mapping[str, float]
"""The values of a law's tuned gains, by name."""
SiteControls = dict[str, dict[str, Any]]
"""The complete table [control] of each site, by the name of the site."""


class TunedGain(NamedTuple):
    """A gain of a law that is searched between `low` and `high`.

    Attributes:
        name: the name of the gain.
        unit: the unit of the gain; "" without a unit.
        low: the least value.
        high: the largest value.
        where: the role of the sites that have the gain; "" if all sites have it.
    """

    name: str
    unit: str
    low: float
    high: float
    where: str = ""


class SearchSpace(NamedTuple):
    """A law with the ranges in which its gains are searched.

    Attributes:
        law: the name of the law; `known` is `adaptive` with Gamma = 0 and the true inertia.
        knobs: the gains that are searched.
        known_facts: the part of the common model information that the law uses, in words.
        kind: the class of a built-in law; None for a user's law.
    """

    law: str
    knobs: tuple[TunedGain, ...]
    known_facts: str
    kind: type[ControlLaw] | None = None

    def controls(
        self, scenario: Scenario, knowledge: ModelInformation, gains: GainValues
    ) -> SiteControls:
        """Returns the control table of every site for a choice of gains.

        For chains, a gain that makes a torque becomes a list with a value per joint.
        """
        longest_ms = 0.5 * _find_longest_round_trip_ms(scenario)
        tables = {}
        for site in scenario.names:
            table = self._write_control(
                scenario=scenario,
                site=site,
                knowledge=knowledge,
                gains=gains,
                longest_ms=longest_ms,
            )
            tables[site] = table
        weights = weigh_joints(scenario)
        if weights:
            for table in tables.values():
                _spread_over_joints(table, weights)
        return tables

    def _write_control(
        self,
        scenario: Scenario,
        site: str,
        knowledge: ModelInformation,
        gains: GainValues,
        longest_ms: float,
    ) -> dict[str, Any]:
        """Returns the control table of one site, with scalar gains."""
        if self.kind is None:
            table: dict[str, Any] = {"law": self.law, **gains}
            if self.known_facts == _GRAVITY_ONLY:
                table["gravity"] = knowledge.gravity
            return table
        law = self.law
        estimate = knowledge.prior(scenario, site)
        if law == _KNOWN:
            law = "adaptive"
            gains = {**gains, "Gamma": 0.0}
            arm = build_arm_rows(scenario, site)
            estimate = np.where(arm.gravity_parameters, estimate, arm.theta).tolist()
        facts = TuningSite(
            role=scenario.sites[site].role,
            gravity=knowledge.gravity,
            estimate=estimate,
            box=knowledge.box_sides(scenario, site),
            longest_ms=longest_ms,
        )
        return {"law": law, **self.kind.write_control(gains, facts)}


def _find_longest_round_trip_ms(scenario: Scenario) -> float:
    """Returns the longest mean round trip between two sites, in ms."""
    mean_delays_ms = {name: link.moments().mean_ms for name, link in scenario.links.items()}
    round_trips_ms = []
    for name, delay_ms in mean_delays_ms.items():
        return_link = "->".join(reversed(name.split("->")))
        round_trips_ms.append(delay_ms + mean_delays_ms[return_link])
    return max(round_trips_ms)


_TORQUE_GAINS = ("rho_nm", "Kp", "Kd", "K", "d", "P_e", "b", "B")
"""Gains that make a torque: the joints of a chain have them in proportion to their inertia."""


def _spread_over_joints(table: dict[str, Any], weights: Sequence[float]) -> None:
    """Replaces the torque gains of a control table by lists with a value per joint."""
    for key in _TORQUE_GAINS:
        if key in table:
            table[key] = [float(f"{table[key] * weight:.4g}") for weight in weights]


_STABLE_SHARE = 0.9
"""Share of the largest stable product of damping rate and tick period that tuning uses."""


def weigh_joints(scenario: Scenario) -> list[float]:
    """Returns the share that each joint of a chain has in a gain that makes a torque.

    The share of joint i is its inertia while the other joints are free, 1 / (M^-1)_ii, as a
    part of the largest such inertia. Of the sites' start poses the least inertia counts.

    All shares are reduced if the arms could not take the largest damping of the ranges at their
    tick rate: `validate` refuses damping gains D for which the largest eigenvalue of h M^-1 D
    reaches 1 under scheme `second_order`, or 2 under `digital`.

    Returns:
        The shares, at most 1, with two significant digits; empty for planar arms.
    """
    chains = [
        (scenario.sites[name], model)
        for name, model in scenario.arms.items()
        if model.chain is not None
    ]
    if not chains:
        return []
    inverses = [np.linalg.inv(model.inertia(np.array(site.q0_rad))) for site, model in chains]
    inertia = np.min([1.0 / np.diag(inverse) for inverse in inverses], axis=0)
    weights = inertia / inertia.max()
    limit = 1.0 if scenario.scheme == "second_order" else 2.0
    largest_damping = DAMPING[1] + ERROR_DAMPING[1]
    for (site, _), inverse in zip(chains, inverses, strict=True):
        # M^-1 D has the eigenvalues of the symmetric D^(1/2) M^-1 D^(1/2)
        root = np.sqrt(weights)
        fastest = np.linalg.eigvalsh(root * inverse * root[:, None])[-1] / site.rate_hz
        weights *= min(1.0, _STABLE_SHARE * limit / (largest_damping * fastest))
    return [float(f"{weight:.2g}") for weight in weights]


_KNOWN = "known"
_GRAVITY_ONLY = "gravity"
"""`known_facts` of a law that uses the gravity parameters only."""


def _list_search_spaces() -> Iterator[SearchSpace]:
    """Yields the search spaces of the built-in laws that have gains to tune."""
    for name, kind in BUILT_IN.items():
        knobs = tuple(_read_range(gain, entry) for gain, entry in kind.tune.items())
        if knobs:
            yield SearchSpace(name, knobs, kind.known_facts, kind)
        if name == "adaptive":
            facts = "gravity, AND inertia exactly: more than the others"
            known_knobs = tuple(knob for knob in knobs if knob.name != "Gamma")
            yield SearchSpace(_KNOWN, known_knobs, facts, kind)


def _read_range(gain: str, entry: GainRange) -> TunedGain:
    """Returns the gain that an entry of a built-in law's `tune` describes."""
    low, high, unit = entry[:3]
    role = entry[3] if len(entry) == 4 else ""
    return TunedGain(gain, unit, low, high, where=role)


SEARCH_SPACES = {space.law: space for space in _list_search_spaces()}
"""The search spaces of the laws that can be tuned, by the name of the law."""

DEFAULT_LAWS = ("adaptive", "adaptive_box", "p_d", "pd_d")
"""The laws that are compared unless others are named: all of them take any number of sites."""
PAPER_GAINS: GainValues = {"Lambda": 1.0, "Kp": 1.0, "Kd": 3.0, "Gamma": 1.0}
"""The gains that the paper prints for `adaptive`."""


def select_search_spaces(laws: Sequence[str], scenario: Scenario) -> list[SearchSpace]:
    """Returns the search spaces of the named laws, in order and without duplicates.

    Args:
        laws: names of built-in laws, or classes as in "mylaws:Spring"; empty: `DEFAULT_LAWS`.
        scenario: the scenario in which the laws are compared.

    Raises:
        UsageError: a law does not exist or has no gains to tune.
        ScenarioError: a law does not fit the sites of the scenario.
    """
    names = list(dict.fromkeys(laws)) or list(DEFAULT_LAWS)
    roles = [spec.role for spec in scenario.sites.values()]
    for name in names:
        if ":" in name:
            continue
        if name not in SEARCH_SPACES:
            hint = suggest_nearest(name, list(SEARCH_SPACES))
            tuned = f"tuned are {', '.join(SEARCH_SPACES)}"
            raise UsageError(f"--law: there is no law {name!r} to tune{hint}; {tuned}")
        kind = SEARCH_SPACES[name].kind
        misfit = "" if kind is None else kind.explain_misfit(roles)
        if misfit:
            raise ScenarioError(f"law {name} {misfit}", source=scenario.name)
    return [SEARCH_SPACES.get(name) or build_user_search_space(name) for name in names]


def build_user_search_space(code: str) -> SearchSpace:
    """Returns the search space of a user's law, from the attribute `tune` of its class.

    The attribute holds (low, high) or (low, high, unit) per gain, as in
    `tune = {"K": (10.0, 300.0)}`. A class with an argument `gravity` gets the share of gravity
    that all laws get.

    Args:
        code: the class, as in "mylaws:Spring".

    Raises:
        ScenarioError: the class does not exist.
        UsageError: the class has no ranges, or a range is not valid.
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
    knobs = tuple(_parse_user_range(code, name, entry) for name, entry in ranges.items())
    takes_gravity = "gravity" in inspect.signature(kind).parameters
    facts = _GRAVITY_ONLY if takes_gravity else "what it reads from its argument now"
    return SearchSpace(code, knobs, facts)


def _parse_user_range(code: str, name: Any, entry: Any) -> TunedGain:
    """Returns the gain that an entry of a user's `tune` describes.

    Raises:
        UsageError: the entry is not (low, high) or (low, high, unit) with 0 < low < high.
    """
    values = list(entry) if isinstance(entry, tuple | list) else []
    low, high, unit = (*values, "", "", "")[:3]
    in_order = is_number(low) and is_number(high) and 0.0 < low < high
    if not in_order or not isinstance(unit, str):
        form = "(low, high) or (low, high, unit) with 0 < low < high, as in (10.0, 300.0)"
        raise UsageError(f"--law {code}: tune[{name!r}] must be {form}, not {entry!r}")
    return TunedGain(str(name), unit, float(low), float(high))
