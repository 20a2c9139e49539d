"""Where each law is searched: its gains, their units and ranges, in one table.

Law: ranges are log-uniform, one number for both joints and for all sites of a role, and the same quantity
has the same range in every law. Stiffness is K, or Kp Lambda; damping is d, or Kp.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

from ..errors import ScenarioError, UsageError
from ..scenario import Scenario
from ..scenario.tables import nearest
from .knowledge import GRAVITY, Knowledge

Gains = Mapping[str, float]
Controls = dict[str, dict[str, Any]]
"""Per site the whole of its [control]."""


class Knob(NamedTuple):
    """One gain that is searched.

    Attributes:
        name: what it is called.
        unit: its unit, or "".
        low: the least that is tried.
        high: the most.
        where: which sites have it; "" for all.
    """

    name: str
    unit: str
    low: float
    high: float
    where: str = ""


class Space(NamedTuple):
    """A law and where it is searched.

    Attributes:
        law: what the law is called here.
        knobs: its gains.
        told: what of the common knowledge it can use, in words.
        controls: writes a choice of gains out as the control of every site.
    """

    law: str
    knobs: tuple[Knob, ...]
    told: str
    controls: Callable[[Scenario, Knowledge, Gains], Controls]


def _adaptive(scenario: Scenario, knowledge: Knowledge, gains: Gains) -> Controls:
    return {
        name: {"law": "adaptive", **gains, "theta_hat0": knowledge.prior(scenario, name)}
        for name in scenario.names
    }


def _adaptive_box(scenario: Scenario, knowledge: Knowledge, gains: Gains) -> Controls:
    return {
        name: {
            "law": "adaptive_box",
            **gains,
            "theta_hat0": knowledge.prior(scenario, name),
            "theta_low": knowledge.low(scenario, name),
            "theta_high": knowledge.high(scenario, name),
        }
        for name in scenario.names
    }


def _known(scenario: Scenario, knowledge: Knowledge, gains: Gains) -> Controls:
    controls = {}
    for name in scenario.names:
        theta = knowledge.prior(scenario, name)
        theta[: GRAVITY.start] = [float(value) for value in scenario.sites[name].arm.theta[: GRAVITY.start]]
        controls[name] = {"law": "adaptive", **gains, "Gamma": 0.0, "theta_hat0": theta}
    return controls


def _knowing_gravity(law: str) -> Callable[[Scenario, Knowledge, Gains], Controls]:
    def controls(scenario: Scenario, knowledge: Knowledge, gains: Gains) -> Controls:
        return {name: {"law": law, **gains, "gravity": knowledge.gravity} for name in scenario.names}

    return controls


def _p_f(scenario: Scenario, knowledge: Knowledge, gains: Gains) -> Controls:
    parts = {
        "master": {"K": 0.0, "d": gains["d_master"], "k_f": gains["k_f"]},
        "slave": {"K": gains["K"], "d": gains["d_slave"], "k_f": 0.0},
    }
    return {
        name: {"law": "p_f", **parts[spec.role], "gravity": knowledge.gravity}
        for name, spec in scenario.sites.items()
    }


_LAMBDA = Knob("Lambda", "1/s", 0.2, 20.0)
_KP = Knob("Kp", "N m s/rad", 0.5, 200.0)
_KD = Knob("Kd", "N m s/rad", 0.1, 50.0)
_GAMMA = Knob("Gamma", "", 0.01, 10.0)
_K = Knob("K", "N m/rad", 1.0, 1000.0)
_D = Knob("d", "N m s/rad", 0.5, 200.0)
_ADAPTING = (_LAMBDA, _KP, _KD, _GAMMA)
_AS_FIRST = "gravity, as its first estimate"

SPACES: dict[str, Space] = {
    space.law: space
    for space in (
        Space("adaptive", _ADAPTING, _AS_FIRST, _adaptive),
        Space("adaptive_box", _ADAPTING, f"{_AS_FIRST}; the box is around it", _adaptive_box),
        Space("p_d", (_K, _D), "gravity", _knowing_gravity("p_d")),
        Space("pd_d", (_K, _KD, _D), "gravity", _knowing_gravity("pd_d")),
        Space(
            "p_f",
            (
                _K._replace(where="slave"),
                _D._replace(name="d_slave", where="slave"),
                _D._replace(name="d_master", where="master"),
                Knob("k_f", "", 0.05, 2.0, "master"),
            ),
            "gravity",
            _p_f,
        ),
        Space("known", (_LAMBDA, _KP, _KD), "gravity, AND inertia exactly: more than the others", _known),
    )
}
"""The laws that can be tuned, by name; `known` is `adaptive` with Gamma = 0 and the true inertia."""

USUAL = ("adaptive", "adaptive_box", "p_d", "pd_d")
"""The laws that are compared unless others are named: all that take any number of sites."""
PRINTED: Gains = {"Lambda": 1.0, "Kp": 1.0, "Kd": 3.0, "Gamma": 1.0}
"""The gains that the paper prints for `adaptive`."""


def chosen(laws: Sequence[str], scenario: Scenario) -> list[Space]:
    """Returns where the named laws are searched, once each, in their order.

    Args:
        laws: names; none means `USUAL`.
        scenario: for which.

    Raises:
        UsageError: there is no such law to tune.
        ScenarioError: the scenario has not the sites that it needs.
    """
    names = list(dict.fromkeys(laws)) or list(USUAL)
    for name in names:
        if ":" in name or name == "own":
            raise UsageError(
                f"--law {name}: nobody has said where a law from outside is to be searched; "
                f"tuned are {', '.join(SPACES)}"
            )
        if name not in SPACES:
            raise UsageError(
                f"--law: there is no law {name!r} to tune{nearest(name, list(SPACES))}; "
                f"tuned are {', '.join(SPACES)}"
            )
    roles = sorted(spec.role for spec in scenario.sites.values())
    if "p_f" in names and roles != ["master", "slave"]:
        raise ScenarioError(
            f"law p_f reflects force between one master and one slave; this has {len(roles)} sites, "
            f"{roles.count('master')} of them masters: leave p_f out, or take contact",
            source=scenario.name,
        )
    return [SPACES[name] for name in names]
