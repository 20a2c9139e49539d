"""The search space of each control law.

Its gains with units and ranges, and the model information all laws share.

Invariant: ranges are log-uniform, one number for both joints and all sites of a role; a quantity has the
same range in every law (stiffness is K or Kp Lambda, damping d or Kp). Of a chain that number is the
heaviest joint's, and the others have their share of it, see `weigh_joints`. All laws get the same gravity
parameters, the true ones times one share, and no inertia: a law that estimates it starts at zero.
"""

import inspect
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from ...analysis.arm_rows import build_arm_rows
from ...errors import ScenarioError, UsageError
from ...scenario import Scenario
from ...scenario.fields import MAX_QUANTITY, is_number, suggest_nearest
from ...scenario.imported_law import LawConsent, allowed_laws, import_law_class, read_law_source
from ...scenario.laws import LAWS

MIN_BOX = 0.1
"""Least half width of a box of estimates, as a share of the given parameters."""


class ModelInformation(NamedTuple):
    """Model information that every law gets: gravity parameters as a share of the true ones."""

    gravity: float = 1.0

    @property
    def box(self) -> float:
        """Half width of a box of estimates, a share of the given parameters: twice the error, or 10 %."""
        return max(MIN_BOX, 2.0 * abs(1.0 / self.gravity - 1.0))

    def prior(self, scenario: Scenario, site: str) -> list[float]:
        """Returns the first estimate of theta, shape (P,): gravity as given, inertia unknown."""
        arm = build_arm_rows(scenario, site)
        theta = np.where(arm.gravity_parameters, arm.theta * self.gravity, 0.0)
        return [float(f"{value:.12g}") for value in theta]

    def box_sides(self, scenario: Scenario, site: str) -> tuple[list[float], list[float]]:
        """Returns the lower and the upper sides of the box, shape (P,) each: of inertia there is none."""
        known = build_arm_rows(scenario, site).gravity_parameters.tolist()
        given = list(zip(self.prior(scenario, site), known, strict=True))
        low, high = (
            [
                float(f"{value + sign * self.box * abs(value):.12g}") if fixed else sign * MAX_QUANTITY
                for value, fixed in given
            ]
            for sign in (-1.0, 1.0)
        )
        return low, high

    @property
    def text(self) -> str:
        """The same in words."""
        how = "exactly" if self.gravity == 1.0 else f"as {100.0 * self.gravity:g} % of what it is"
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


class GainRange(NamedTuple):
    """One gain that is searched, from low to high; `where`: which sites have it, "" for all."""

    name: str
    unit: str
    low: float
    high: float
    where: str = ""


class SearchSpace(NamedTuple):
    """A law and where it is searched.

    Attributes:
        knobs: its gains.
        told: what it uses of the common model information, in words.
        write: writes a choice of gains out as the control of every site, one number for all joints.
    """

    law: str
    knobs: tuple[GainRange, ...]
    told: str
    write: Callable[[Scenario, ModelInformation, GainValues], SiteControls]

    def controls(self, scenario: Scenario, knowledge: ModelInformation, gains: GainValues) -> SiteControls:
        """Returns the control of every site; gains of chains that make a torque have a number per joint."""
        tables = self.write(scenario, knowledge, gains)
        weights = weigh_joints(scenario)
        for table in tables.values() if weights else ():
            for key in _TORQUE_GAINS:
                if key in table:
                    table[key] = [float(f"{table[key] * weight:.4g}") for weight in weights]
        return tables


_TORQUE_GAINS = ("rho_nm", "Kp", "Kd", "K", "d", "P_e", "b", "B")


def weigh_joints(scenario: Scenario) -> list[float]:
    """Returns the share of each joint of chains in a gain that makes a torque, at most 1; [] of planar arms.

    It is the inertia that the joint shows while the others are free, 1 / (M^-1)_ii, least over the sites'
    start poses, as a part of the largest; all less where an arm could not take the upper ends of the ranges
    at its tick rate (`validate`).
    """
    arms = [(scenario.sites[name], model) for name, model in scenario.arms.items() if model.chain is not None]
    if not arms:
        return []
    inverses = [np.linalg.inv(model.inertia(np.array(site.q0_rad))) for site, model in arms]
    inertia = np.min([1.0 / np.diag(inverse) for inverse in inverses], axis=0)
    weights = inertia / inertia.max()
    scaled = np.sqrt(weights)
    most = 1.0 if scenario.scheme == "second_order" else 2.0
    for (site, _), inverse in zip(arms, inverses, strict=True):
        fastest = np.linalg.eigvalsh(scaled * inverse * scaled[:, None])[-1] / site.rate_hz
        weights *= min(1.0, 0.9 * most / ((_KP.high + _KD.high) * fastest))
        scaled = np.sqrt(weights)
    return [float(f"{weight:.2g}") for weight in weights]


def _adaptive(scenario: Scenario, knowledge: ModelInformation, gains: GainValues) -> SiteControls:
    return {
        name: {"law": "adaptive", **gains, "theta_hat0": knowledge.prior(scenario, name)}
        for name in scenario.names
    }


def _adaptive_box(scenario: Scenario, knowledge: ModelInformation, gains: GainValues) -> SiteControls:
    controls = _adaptive(scenario, knowledge, gains)
    for name, table in controls.items():
        table["law"] = "adaptive_box"
        table["theta_low"], table["theta_high"] = knowledge.box_sides(scenario, name)
    return controls


def _adaptive_robust(scenario: Scenario, knowledge: ModelInformation, gains: GainValues) -> SiteControls:
    """Where r = 0 the robust term damps by a tenth of Kp, which the joints can take besides."""
    controls = _adaptive_box(scenario, knowledge, gains)
    for table in controls.values():
        table |= {"law": "adaptive_robust", "width_rad_s": 10.0 * gains["rho_nm"] / gains["Kp"]}
    return controls


def _known(scenario: Scenario, knowledge: ModelInformation, gains: GainValues) -> SiteControls:
    controls = _adaptive(scenario, knowledge, {**gains, "Gamma": 0.0})
    for name, table in controls.items():
        arm = build_arm_rows(scenario, name)
        theta = zip(arm.gravity_parameters, table["theta_hat0"], arm.theta.tolist(), strict=True)
        table["theta_hat0"] = [told if gravity else truth for gravity, told, truth in theta]
    return controls


def _p_f(scenario: Scenario, knowledge: ModelInformation, gains: GainValues) -> SiteControls:
    parts = {
        "master": {"K": 0.0, "d": gains["d_master"], "k_f": gains["k_f"]},
        "slave": {"K": gains["K"], "d": gains["d_slave"], "k_f": 0.0},
    }
    return {
        name: {"law": "p_f", **parts[spec.role], "gravity": knowledge.gravity}
        for name, spec in scenario.sites.items()
    }


def _tell_gains(
    law: str, *, gravity: bool = True, **masters: bool
) -> Callable[[Scenario, ModelInformation, GainValues], SiteControls]:
    """Returns the writer of a law's own gains; `masters`: a key that is this at masters and not so at slaves.

    `gravity`: the law is told its share.
    """

    def controls(scenario: Scenario, knowledge: ModelInformation, gains: GainValues) -> SiteControls:
        told = {"gravity": knowledge.gravity} if gravity else {}
        return {
            name: {
                "law": law,
                **gains,
                **{key: value == (spec.role == "master") for key, value in masters.items()},
                **told,
            }
            for name, spec in scenario.sites.items()
        }

    return controls


def _wave(scenario: Scenario, knowledge: ModelInformation, gains: GainValues) -> SiteControls:
    """All ends are matched to their lines, masters too, so that no wave is reflected for ever."""
    matched = {"law": "wave", **gains, "B": gains["b"], "gravity": knowledge.gravity}
    return {name: dict(matched) for name in scenario.names}


def _sync(scenario: Scenario, knowledge: ModelInformation, gains: GainValues) -> SiteControls:
    known = {"law": "sync", "Lambda": gains["Lambda"], "K": gains["Kp"], "Gamma": gains["Gamma"]}
    return {name: {**known, "theta_hat0": knowledge.prior(scenario, name)} for name in scenario.names}


def _lee_spong(scenario: Scenario, knowledge: ModelInformation, gains: GainValues) -> SiteControls:
    """T_max is half of the longest mean round trip: for delays that vary its bound is not proved."""
    mean_ms = {name: link.moments().mean_ms for name, link in scenario.links.items()}
    trips_ms = [there + mean_ms["->".join(reversed(name.split("->")))] for name, there in mean_ms.items()]
    bound = {"law": "lee_spong", "T_max_ms": 0.5 * max(trips_ms), "P_e": gains["d_extra"]}
    told = {"K": gains["K"], "Kd": gains["Kd"], "gravity": knowledge.gravity}
    return {name: {**bound, **told} for name in scenario.names}


_LAMBDA = GainRange("Lambda", "1/s", 0.2, 20.0)
_KP = GainRange("Kp", "N m s/rad", 0.5, 200.0)
_KD = GainRange("Kd", "N m s/rad", 0.1, 50.0)
_GAMMA = GainRange("Gamma", "", 0.01, 10.0)
_K = GainRange("K", "N m/rad", 1.0, 1000.0)
_D = GainRange("d", "N m s/rad", 0.5, 200.0)
_B = _D._replace(name="B")
_CHANNELS = (_K, _B)
_IMPEDANCE = (GainRange("M", "kg m^2", 0.1, 10.0), _B, _K)
_PREDICTING = (_K, _D, GainRange("inertia", "kg m^2", 0.1, 10.0))
_ADAPTING = (_LAMBDA, _KP, _KD, _GAMMA)
_REFLECTING = (
    _K._replace(where="slave"),
    _D._replace(name="d_slave", where="slave"),
    _D._replace(name="d_master", where="master"),
    GainRange("k_f", "", 0.05, 2.0, "master"),
)
_AS_FIRST = "gravity, as its first estimate"

SEARCH_SPACES: dict[str, SearchSpace] = {
    space.law: space
    for space in (
        SearchSpace("adaptive", _ADAPTING, _AS_FIRST, _adaptive),
        SearchSpace("adaptive_box", _ADAPTING, f"{_AS_FIRST}; the box is around it", _adaptive_box),
        SearchSpace(
            "adaptive_robust",
            (*_ADAPTING, GainRange("rho_nm", "N m", 0.05, 5.0)),
            f"{_AS_FIRST}; the box is around it",
            _adaptive_robust,
        ),
        SearchSpace("p_d", (_K, _D), "gravity", _tell_gains("p_d")),
        SearchSpace("pd_d", (_K, _KD, _D), "gravity", _tell_gains("pd_d")),
        SearchSpace(
            "saturated_pd", (_K, GainRange("P", "N m", 0.5, 50.0), _D), "gravity", _tell_gains("saturated_pd")
        ),
        SearchSpace("four_channel", _CHANNELS, "gravity", _tell_gains("four_channel")),
        SearchSpace("six_channel", _CHANNELS, "gravity", _tell_gains("six_channel")),
        SearchSpace("authority", (_K, _D), "gravity", _tell_gains("authority", leads=True)),
        SearchSpace(
            "impedance",
            _IMPEDANCE,
            "gravity AND inertia exactly: more than the others",
            _tell_gains("impedance", gravity=False, follows=False),
        ),
        SearchSpace("sync", (_LAMBDA, _KP, _GAMMA), _AS_FIRST, _sync),
        SearchSpace("lee_spong", (_K, _KD, _D._replace(name="d_extra")), "gravity", _lee_spong),
        SearchSpace("smith", _PREDICTING, "gravity", _tell_gains("smith", predicts=True)),
        SearchSpace("p_f", _REFLECTING, "gravity", _p_f),
        SearchSpace("known", _ADAPTING[:3], "gravity, AND inertia exactly: more than the others", _known),
        SearchSpace("wave", (_D._replace(name="b"), _K), "gravity", _wave),
        SearchSpace("tdpa", _CHANNELS, "gravity, and inertia for two ticks", _tell_gains("tdpa")),
        SearchSpace("tanks", (_K, _KD), "gravity", _tell_gains("tanks")),
    )
}
"""The laws that can be tuned, by name; `known` is `adaptive` with Gamma = 0 and the true inertia."""

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
        wanted = getattr(getattr(LAWS.get(name), "core_class", None), "sites", None)
        if wanted not in (None, len(scenario.names)):
            problem = f"law {name} is for {wanted} sites, and this has {len(scenario.names)}: leave it out"
            raise ScenarioError(problem, source=scenario.name)
    roles = sorted(spec.role for spec in scenario.sites.values())
    if "p_f" in names and roles != ["master", "slave"]:
        raise ScenarioError(
            f"law p_f reflects force between one master and one slave; this has {len(roles)} sites, "
            f"{roles.count('master')} of them masters: leave p_f out, or take contact",
            source=scenario.name,
        )
    return [SEARCH_SPACES.get(name) or build_own_search_space(name) for name in names]


def build_own_search_space(code: str) -> SearchSpace:
    """Returns where a law of one's own is searched: its class says it, as `tune = {"K": (10.0, 300.0)}`.

    A third entry is the unit. A class with an argument `gravity` is told the share that all laws are told.

    Raises:
        ScenarioError: there is no such class.
        UsageError: it has no ranges, or one of them is none.
    """
    sha256 = read_law_source(code, "--law").sha256
    allowed_laws[code, sha256] = LawConsent(None, sha256)
    kind = import_law_class(code, sha256, "--law")
    ranges = getattr(kind, "tune", None)
    if not isinstance(ranges, Mapping) or not ranges:
        raise UsageError(f'--law {code} has no search ranges: its class needs tune = {{"K": (10.0, 300.0)}}')
    knobs = []
    for name, entry in ranges.items():
        low, high, unit = (*entry, "", "", "")[:3] if isinstance(entry, tuple | list) else ("", "", "")
        if not (is_number(low) and is_number(high) and 0.0 < low < high and isinstance(unit, str)):
            problem = "is as in (10.0, 300.0), from above 0 to more, or with a unit behind"
            raise UsageError(f"--law {code}: tune[{name!r}] {problem}, not {entry!r}")
        knobs.append(GainRange(str(name), unit, float(low), float(high)))
    told = "gravity" in inspect.signature(kind).parameters
    writer = _tell_gains(code, gravity=told)
    return SearchSpace(code, tuple(knobs), "gravity" if told else "what it asks of now", writer)
