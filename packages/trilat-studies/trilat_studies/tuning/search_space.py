"""Defines which gains of each control law a tuning searches, and within which ranges.

For a fair comparison, each quantity has the same range in every law, under whatever name. For
example, some laws have a stiffness K, and in others the stiffness is the product of Kp and
Lambda. Gains are searched on a logarithmic scale. `SearchSpace.controls` turns chosen gains
into the table [control] of every arm in a scenario.

Invariant:
    - Each gain is a single number for both joints of an arm and for all arms in the same role,
      such as the masters.
    - For an arm with a chain of joints, this number is the gain of the joint with the largest
      inertia. The gains of the other joints are fractions of it, see `weigh_joints`.
    - All laws get the same gravity parameters: the true values times a common factor, which
      tests how robust the laws are.
    - Laws do not get the inertia of the arm. The only exception is `known`, the adaptive law
      without adaptation. A law that estimates the inertia starts at zero.
"""

import inspect
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from trilat_net.analysis import build_arm_rows
from trilat_net.errors import ScenarioError, UsageError, suggest_nearest
from trilat_net.fields import MAX_QUANTITY
from trilat_net.laws import DAMPING, ERROR_DAMPING, ControlLaw, GainRange, TuningSite
from trilat_net.own_code import import_named_class
from trilat_net.scenario import BUILT_IN, Scenario, is_number

MIN_BOX = 0.1
"""Smallest half-width of a box of estimates, as a fraction of the estimated parameter."""


def _round_parameter(value: float) -> float:
    """Rounds a parameter to 12 significant digits.

    Scaling by a factor yields numbers such as 0.30000000000000004, which would make the printed
    commands long.
    """
    return float(f"{value:.12g}")


class ModelInformation(NamedTuple):
    """Information about the arm model that is available to every compared control law.

    Some laws compensate for gravity, which requires parameters of the arm. For a fair
    comparison, all laws get the same parameters, which may be deliberately wrong by a given
    factor.

    Attributes:
        gravity: Ratio of the gravity parameters that the laws get to the true parameters.
    """

    gravity: float = 1.0

    @property
    def box(self) -> float:
        """Half-width of the interval that bounds an adaptive law's estimate, as a fraction.

        The fraction is relative to the first estimate of the parameter, which is the centre of
        the interval. The first estimates of gravity are wrong by the factor `gravity`. The
        interval is twice as wide as needed to contain the true value, with a half-width of at
        least `MIN_BOX`.
        """
        return max(MIN_BOX, 2.0 * abs(1.0 / self.gravity - 1.0))

    def prior(self, scenario: Scenario, site: str) -> list[float]:
        """Returns the parameter values with which an adaptive law starts, shape (P,).

        The P parameters theta of an arm describe its inertia and its gravity torque. The
        inertia parameters are 0, since nothing is known about them. The gravity parameters are
        the true values times `gravity`.

        Args:
            scenario: Scenario in which the laws are compared.
            site: Name of the site.
        """
        arm = build_arm_rows(scenario, site)
        theta = np.where(arm.gravity_parameters, arm.theta * self.gravity, 0.0)
        return [_round_parameter(value) for value in theta]

    def box_sides(self, scenario: Scenario, site: str) -> tuple[list[float], list[float]]:
        """Returns the limits within which an adaptive law keeps its parameter estimates.

        The P parameters of an arm describe its inertia and its gravity torque. Inertia
        estimates are practically unlimited, because nothing is known about the inertia.

        Args:
            scenario: Scenario with the arm.
            site: Name of the arm in the scenario.

        Returns:
            Lower and upper limits of the P parameters.
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
        """Clause for reports that states what the laws know about the arms.

        Example: "every law gets 90 % of the true gravity parameters, and no inertia".
        """
        if self.gravity == 1.0:
            gravity = "the exact gravity parameters"
        else:
            gravity = f"{100.0 * self.gravity:g} % of the true gravity parameters"
        return f"every law gets {gravity}, and no inertia"

    @classmethod
    def of_gravity(cls, gravity_percent: float) -> "ModelInformation":
        """Creates the information for a given error of the gravity parameters.

        The parameters may be deliberately wrong, to test how robust the laws are.

        Args:
            gravity_percent: Gravity parameters that the laws get, in per cent of the true
                values.

        Raises:
            UsageError: The percentage is not between 50 and 150.
        """
        if not 50.0 <= gravity_percent <= 150.0:
            raise UsageError(
                f"--gravity must be from 50 to 150 % of the true value, not {gravity_percent:g}"
            )
        return cls(gravity_percent / 100.0)


GainValues = Mapping[str, float]
"""Mapping from the names of a law's tuned gains to their values."""
SiteControls = dict[str, dict[str, Any]]
"""Complete table [control] of each site, by site name."""


class _TunedGain(NamedTuple):
    """A gain of a control law, with the range in which its best value is searched for.

    Attributes:
        name: Name of the gain.
        unit: Unit of the gain. Empty if it is dimensionless.
        low: Smallest value.
        high: Largest value.
        where: Role of the sites that have the gain. Empty if all sites have it.
    """

    name: str
    unit: str
    low: float
    high: float
    where: str = ""


class SearchSpace(NamedTuple):
    """Gains of one control law that are tuned automatically, with their units and ranges.

    Attributes:
        law: Name of the law. "known" means the law `adaptive` with adaptation switched off and
            the true inertia of the arm.
        knobs: The gains to be tuned, with their units and ranges.
        known_facts: Information about the arm that the law gets, as text for tables.
        kind: Class of a built-in law. `None` for a user's law.
    """

    law: str
    knobs: tuple[_TunedGain, ...]
    known_facts: str
    kind: type[ControlLaw] | None = None

    def controls(
        self, scenario: Scenario, knowledge: ModelInformation, gains: GainValues
    ) -> SiteControls:
        """Returns the table [control] of every arm for the given gains.

        Except for the planar two-joint arm, a gain that produces a torque becomes a list with
        one value per joint, because the joints have different inertias, see `weigh_joints`.

        Args:
            scenario: Scenario in which the laws are compared.
            knowledge: Information about the arm that the law gets.
            gains: Mapping from gain name to value.

        Returns:
            The tables, by the name of the arm.
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
        """Returns the table [control] of one site, where each gain is a single number.

        Args:
            scenario: Scenario in which the laws are compared.
            site: Name of the site.
            knowledge: Information about the arm model that the law gets.
            gains: Mapping from gain name to value.
            longest_ms: Half of the longest round trip between two sites, in ms.
        """
        if self.kind is None:  # a user's law
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
        tuning_site = TuningSite(
            role=scenario.sites[site].role,
            gravity=knowledge.gravity,
            estimate=estimate,
            box=knowledge.box_sides(scenario, site),
            longest_ms=longest_ms,
        )
        return {"law": law, **self.kind.write_control(gains, tuning_site)}

    @classmethod
    def of_user_law(cls, code: str) -> "SearchSpace":
        """Reads the search space of a user's law from the attribute `tune` of its class.

        The attribute maps each gain to (low, high) or (low, high, unit), as in `tune = {"K":
        (10.0, 300.0)}`. If the constructor of the class has an argument `gravity`, it gets the
        factor by which all laws over- or underestimate gravity.

        Args:
            code: Module and class, as in "mylaws:Spring".

        Returns:
            The law with the ranges of its gains.

        Raises:
            ScenarioError: The class does not exist.
            UsageError: The class has no ranges, or a range is not valid.
        """
        kind = import_named_class(code, "--law")

        ranges = getattr(kind, "tune", None)
        if not isinstance(ranges, Mapping) or not ranges:
            raise UsageError(
                f"--law {code} has no search ranges: its class needs "
                'tune = {"K": (10.0, 300.0)}'
            )

        knobs = tuple(_parse_user_range(code, name, entry) for name, entry in ranges.items())
        takes_gravity = "gravity" in inspect.signature(kind).parameters
        facts = _GRAVITY_ONLY if takes_gravity else "what it reads from its argument now"
        return cls(code, knobs, facts)

    @classmethod
    def select(cls, laws: Sequence[str], scenario: Scenario) -> "list[SearchSpace]":
        """Returns the search spaces of the given control laws, dropping repeated laws.

        Args:
            laws: Names of built-in laws, or classes as in "mylaws:Spring". If empty,
                `DEFAULT_LAWS`.
            scenario: Scenario in which the laws are compared.

        Raises:
            UsageError: A law does not exist or has no gains to tune.
            ScenarioError: A law does not fit the number or the roles of the sites.
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
        return [SEARCH_SPACES.get(name) or cls.of_user_law(name) for name in names]


def _find_longest_round_trip_ms(scenario: Scenario) -> float:
    """Returns the longest mean round trip between two sites, in ms.

    A round trip is the sum of the mean delays of a link and of the link in the opposite
    direction.
    """
    mean_delays_ms = {name: link.moments().mean_ms for name, link in scenario.links.items()}
    round_trips_ms = []
    for name, delay_ms in mean_delays_ms.items():
        return_link = "->".join(reversed(name.split("->")))
        round_trips_ms.append(delay_ms + mean_delays_ms[return_link])
    return max(round_trips_ms)


_TORQUE_GAINS = ("rho_nm", "Kp", "Kd", "K", "d", "P_e", "b", "B")
"""Gains that produce a torque. For the joints of a chain, they are proportional to the inertia.
"""


def _spread_over_joints(table: dict[str, Any], weights: Sequence[float]) -> None:
    """Replaces each gain that produces a torque with a list of values, one per joint.

    The joints of a chain have different inertias, and their gains must be in proportion.

    Args:
        table: Table [control] of a site, which is modified in place.
        weights: For each joint, its fraction of the gain.
    """
    for key in _TORQUE_GAINS:
        if key in table:
            table[key] = [float(f"{table[key] * weight:.4g}") for weight in weights]


_STABLE_SHARE = 0.9
"""Product of damping rate and tick period used in tuning, as a fraction of the largest stable
one.
"""


def weigh_joints(scenario: Scenario) -> list[float]:
    """Returns a scaling factor for the torque-producing gains of each joint of a chain.

    The factor of joint i is its inertia while the other joints are free, 1 / (M^-1)_ii,
    relative to the largest such inertia of all joints, where M is the inertia matrix. For each
    joint, the smallest of its inertias in the start poses of the sites is used.

    All factors are reduced if the largest damping in the search ranges would make the arms
    unstable at their tick rate. `validate` rejects damping gains D for which the largest
    eigenvalue of h M^-1 D, with the tick period h, reaches 1 under the integration scheme
    `second_order`, or 2 under `digital`.

    Args:
        scenario: Scenario in which the laws are compared.

    Returns:
        The factors, at most 1, with two significant digits. Empty for planar arms.
    """
    chains = [
        (scenario.sites[name], model)
        for name, model in scenario.arms.items()
        if model.chain is not None
    ]
    if not chains:
        return []

    inverses = []
    for site, model in chains:
        start_inertia = model.inertia(np.array(site.q0_rad))
        inverses.append(np.linalg.inv(start_inertia))
    free_inertia = np.min([1.0 / np.diag(inverse) for inverse in inverses], axis=0)
    weights = free_inertia / free_inertia.max()

    # reduce the weights until the largest damping of the ranges suits every tick rate
    limit = 1.0 if scenario.scheme == "second_order" else 2.0
    largest_damping = DAMPING[1] + ERROR_DAMPING[1]
    for (site, _), inverse in zip(chains, inverses, strict=True):
        # M^-1 D has the eigenvalues of the symmetric matrix D^(1/2) M^-1 D^(1/2).
        root_weights = np.sqrt(weights)
        scaled_inverse = root_weights * inverse * root_weights[:, None]
        largest_rate = np.linalg.eigvalsh(scaled_inverse)[-1] / site.rate_hz
        weights *= min(1.0, _STABLE_SHARE * limit / (largest_damping * largest_rate))
    return [float(f"{weight:.2g}") for weight in weights]


_KNOWN = "known"
"""Name of the search space of `adaptive` with known inertia."""
_GRAVITY_ONLY = "gravity"
"""Value of `known_facts` for a law that uses only the gravity parameters."""


def _list_search_spaces() -> Iterator[SearchSpace]:
    """Yields the search space of each built-in control law that can be tuned.

    The law `known` has the gains of `adaptive`, except for the adaptation gain Gamma.
    """
    for name, kind in BUILT_IN.items():
        knobs = tuple(_read_range(gain, entry) for gain, entry in kind.tune.items())
        if knobs:
            yield SearchSpace(name, knobs, kind.known_facts, kind)
        if name == "adaptive":
            facts = "gravity, AND inertia exactly: more than the others"
            known_knobs = tuple(knob for knob in knobs if knob.name != "Gamma")
            yield SearchSpace(_KNOWN, known_knobs, facts, kind)


def _read_range(gain: str, entry: GainRange) -> _TunedGain:
    """Converts the range of a gain, as a built-in law states it in `tune`, to a `_TunedGain`.

    Args:
        gain: Name of the gain.
        entry: Smallest value, largest value, unit, and optionally the role of the sites.
    """
    low, high, unit = entry[:3]
    role = entry[3] if len(entry) == 4 else ""
    return _TunedGain(gain, unit, low, high, where=role)


SEARCH_SPACES = {space.law: space for space in _list_search_spaces()}
"""Search spaces of the laws that can be tuned, by law name."""

DEFAULT_LAWS = ("adaptive", "adaptive_box", "p_d", "pd_d")
"""Laws that are compared by default, all of which work with any number of sites."""
PAPER_GAINS: GainValues = {"Lambda": 1.0, "Kp": 1.0, "Kd": 3.0, "Gamma": 1.0}
"""Gains for `adaptive` that are printed in the paper."""


def _parse_user_range(code: str, name: Any, entry: Any) -> _TunedGain:
    """Converts an entry of a user law's attribute `tune` to a `_TunedGain`.

    Args:
        code: Module and class, for the error message.
        name: Name of the gain.
        entry: The range, (low, high) or (low, high, unit) with 0 < low < high.

    Raises:
        UsageError: The entry is not a range of this form.
    """
    values = list(entry) if isinstance(entry, tuple | list) else []
    # An empty text replaces a missing value. It is valid as a unit, but not as a limit.
    low, high, unit = (*values, "", "", "")[:3]
    in_order = is_number(low) and is_number(high) and 0.0 < low < high
    if not in_order or not isinstance(unit, str):
        form = "(low, high) or (low, high, unit) with 0 < low < high, as in (10.0, 300.0)"
        raise UsageError(f"--law {code}: tune[{name!r}] must be {form}, not {entry!r}")
    return _TunedGain(str(name), unit, float(low), float(high))
