"""A scenario in lines of text, and the differences between scenarios.

Invariant: a difference that several sites or links share is one entry; a law of another kind
and a link are entries as a whole. Names, titles and expectations describe an experiment and do
not count as differences.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np

from ..core.delay import DelayKind
from ..core.dominance import ROW_SUM_TOLERANCE, find_balancing_weights
from ..core.philox import link_key
from ..core.vectors import Array
from ..errors import count_nouns
from ..laws.conditions import LawSituation, StabilityCondition
from ..laws.interface import LawSettings
from .arms import TASK_AXES, Arm, read_arm
from .delay_models import LinkBase
from .rest_bounds import find_rest_bounds
from .sample_uses import count_silences, draw_used_samples
from .scenario_reader import load_scenario
from .scenario_types import Scenario

COUPLED_OPERATORS = (
    "beta differs between sites: it weighs operators of one site each, and says nothing of hands that are "
    "coupled to one another (one user at two handles)"
)
IRREVERSIBLE_SHARES = (
    "the shares are not reversible (alpha_ij alpha_jk alpha_ki is not alpha_ik alpha_kj alpha_ji): some "
    "passive operators make the loop unstable, whatever its damping (docs/errata.md, 14)"
)


def lacks_detailed_balance(scenario: Scenario) -> bool:
    """True if all sites exchange positions and know gravity, and no D > 0 makes D (I - alpha)
    symmetric.
    """
    laws = [spec.control for spec in scenario.sites.values()]
    return (
        all(law.exchanges_positions() for law in laws)
        and find_balancing_weights(scenario.alpha) is None
    )


def _find_link_delays(links: Mapping[str, LinkBase], rates_hz: Mapping[str, int]) -> Array:
    """Returns the delay of every link as in `LawSituation.delay_s`."""
    names = list(rates_hz)
    delay_s = np.zeros((len(names), len(names)))
    for name, link in links.items():
        peer, _, site = name.partition("->")
        model = link.to_core_model()
        rate_hz = rates_hz[site]
        constant = model.kind == DelayKind.CONSTANT and not link.loss and not link.measured
        delay_us = max(round(model.location), model.playout_us)
        ticks = max(1, -(-delay_us * rate_hz // 1_000_000))
        delay_s[names.index(site), names.index(peer)] = ticks / rate_hz if constant else np.nan
    return delay_s


def _list_situations(scenario: Scenario) -> Iterator[tuple[str, LawSettings, LawSituation]]:
    rates_hz = {name: site.rate_hz for name, site in scenario.sites.items()}
    every = (
        scenario.names,
        scenario.controls,
        scenario.alpha,
        _find_link_delays(scenario.links, rates_hz),
    )
    ticks_s = {1.0 / rate_hz for rate_hz in rates_hz.values()}
    hold_s = (
        0.0
        if scenario.scheme != "digital"
        else ticks_s.pop()
        if len(ticks_s) == 1
        else math.nan
    )
    for n, (name, site) in enumerate(scenario.sites.items()):
        limits_nm = tuple(np.atleast_1d(site.limits.tau_limit_nm).tolist())
        gravity_nm = scenario.arms[name].largest_gravity(site.arm.g_m_s2)
        situation = LawSituation(
            n, *every, limits_nm, site.rate_hz, gravity_nm=gravity_nm, hold_s=hold_s
        )
        yield name, scenario.controls[n], situation


def describe_law_conditions(scenario: Scenario) -> list[str]:
    """Returns what the stability of the sites' laws rests on, a line for sites of whom the same
    holds.
    """
    owners: dict[tuple[str, StabilityCondition], list[str]] = {}
    for name, law, situation in _list_situations(scenario):
        if found := law.condition(situation):
            owners.setdefault((law.tag, found), []).append(name)
    words = {True: "holds", False: "does not hold", None: "is not decided here"}
    return [
        f"condition of {tag} at {', '.join(where)} {words[one.holds]}: {one.text}"
        for (tag, one), where in owners.items()
    ]


def _describe_idle_shares(scenario: Scenario) -> list[str]:
    ramped = {change.dominance for change in scenario.timeline}
    owners: dict[str, list[str]] = {}
    for name, law, situation in _list_situations(scenario):
        why = law.explain_idle_shares(situation)
        if not why and name in ramped and law.fixed_shares:
            why = "lines stay as they are at the start, whatever the timeline says"
        if why:
            owners.setdefault(why, []).append(name)
    return [
        f"dominance without effect at {', '.join(where)}: {why}"
        for why, where in owners.items()
    ]


def describe_scenario(scenario: str | Path | Mapping[str, Any] | Scenario) -> list[str]:
    """Returns the facts of a valid scenario and their consequences, as lines; as `trilat
    scenario check`.

    >>> len(tn.describe_scenario("paper")) > 5
    True
    """
    scenario = load_scenario(scenario)
    beta = scenario.beta
    weights = (
        "none: alpha is reducible, some site's weight is zero"
        if beta is None
        else ", ".join(
            f"{name} {len(beta) * pi:.4g}"
            for name, pi in zip(scenario.names, beta, strict=True)
        )
    )
    words = {name: link.describe() for name, link in scenario.links.items()}
    links = [f"link {name}: {text}" for name, text in words.items()]
    return [
        f"{scenario.name}: valid, sha256 {scenario.sha256[:16]}",
        f"sites: {', '.join(scenario.names)}; {scenario.duration_s:g} s, "
        + ", ".join(
            f"{count_nouns(scenario.ticks(name), 'tick')} of {name}" for name in scenario.names
        ),
        *(
            links
            if len(set(words.values())) > 1
            else [f"every link: {next(iter(words.values()))}"]
        ),
        *(
            f"view of {name}: {one.view.describe()}"
            for name, one in scenario.sites.items()
            if one.view
        ),
        f"pi, the left null vector of Upsilon, sum N (beta_i = pi_i / c_i with Kd_i = c_i Kbar): {weights}",
        *([] if beta is None or np.ptp(beta) < ROW_SUM_TOLERANCE else [COUPLED_OPERATORS]),
        *([IRREVERSIBLE_SHARES] if lacks_detailed_balance(scenario) else []),
        *describe_law_conditions(scenario),
        *_describe_idle_shares(scenario),
        *_describe_arms(scenario),
        *_describe_tasks(scenario),
        *_describe_silences(scenario),
        *_describe_stops(scenario),
        *(f"assumed: {text}" for text in scenario.assumed),
        *(
            f"drawn with seed {scenario.seed}: {key} = {one.value} ({one.describe()})"
            for key, one in scenario.drawn.items()
            if one.normal or one.uniform
        ),
    ]


def _describe_arms(scenario: Scenario) -> list[str]:
    lines: list[str] = []
    for arm, owners in _group_chains(scenario):
        chain = read_arm(arm, scenario.urdf)
        model = scenario.arms[owners[0]]
        mass = sum(joint.inertia[0] for joint in chain.joints)
        lines.append(
            f"arm of {', '.join(owners)}: {arm.urdf}, {count_nouns(len(chain.joints), 'joint')} "
            f"from {chain.base} to {chain.tip}, {mass:.4g} kg move"
        )
        assert model.chain is not None
        for joint, drive in zip(chain.joints, model.chain.joints, strict=True):
            unit, effort, inertia = (
                ("m", "N", "kg") if drive.prismatic else ("rad", "N m", "kg m^2")
            )
            facts = [
                f"{joint.lower:.4g} to {joint.upper:.4g} {unit}" * (joint.lower > -math.inf),
                f"{joint.effort_limit:.4g} {effort}" * (joint.effort_limit < math.inf),
                f"{joint.velocity_limit:.4g} {unit}/s" * (joint.velocity_limit < math.inf),
                f"drive {drive.armature_kg_m2:.4g} {inertia}" * (drive.armature_kg_m2 > 0.0),
            ]
            moved = f"  {joint.name} moves {joint.link}, {joint.inertia[0]:.4g} kg"
            lines.append("; ".join([moved, *filter(None, facts)]))
        lines += [f"  note: {note}" for note in chain.notes]
    return lines + [f"note: {note}" for note in _list_start_notes(scenario)]


def _group_chains(scenario: Scenario) -> list[tuple[Arm, list[str]]]:
    """Returns every different arm of a URDF, with the sites that have it."""
    grouped: list[tuple[Arm, list[str]]] = []
    for name, spec in scenario.sites.items():
        if not spec.arm.urdf:
            continue
        owners = next((owners for arm, owners in grouped if arm == spec.arm), None)
        if owners is None:
            grouped.append((spec.arm, [name]))
        else:
            owners.append(name)
    return grouped


def list_arm_notes(scenario: Scenario) -> list[str]:
    """Returns how the arms of a run differ from what their files state, a sentence each, with
    the sites.
    """
    notes = [
        f"arm of {', '.join(owners)}: {note}"
        for arm, owners in _group_chains(scenario)
        for note in read_arm(arm, scenario.urdf).notes
    ]
    return notes + _list_start_notes(scenario)


def _list_start_notes(scenario: Scenario) -> list[str]:
    """Returns which joints start beyond a stop or a limit of position, and what follows, a
    sentence each.
    """
    notes: list[str] = []
    for name, spec in scenario.sites.items():
        model = scenario.arms[name]
        units = model.joint_units("rad")
        if spec.arm.urdf and spec.arm.stops:
            for n, joint in enumerate(read_arm(spec.arm, scenario.urdf).joints):
                start = spec.q0_rad[n]
                beyond = max(joint.lower - start, start - joint.upper)
                if beyond > 0.0:
                    notes.append(
                        f"{name} starts {beyond:.3g} {units[n]} beyond a stop of joint {joint.name}: "
                        "the stop lies where the arm starts"
                    )
        given = spec.limits.motion
        in_force = scenario.motion_limits(name)
        for key, before, after in (
            ("q_min_rad", given.q_min, in_force.q_min),
            ("q_max_rad", given.q_max, in_force.q_max),
        ):
            shape = (len(spec.q0_rad),)
            moved = np.broadcast_to(before, shape) != np.broadcast_to(after, shape)
            for n in np.flatnonzero(moved).tolist():
                limit = float(np.broadcast_to(after, shape)[n])
                notes.append(
                    f"{name} starts beyond {key} of joint {model.joint_names[n]}: the limit lies at "
                    f"{limit:.4g} {units[n]} in this run"
                )
    return notes


def _describe_tasks(scenario: Scenario) -> list[str]:
    lines = []
    for name, model in scenario.arms.items():
        if model.shares_pose:
            spec = scenario.sites[name]
            followed = np.array(model.axes) > 0.0
            least = np.linalg.svd(model.task_jacobian(spec.q0_rad)[followed], compute_uv=False)[
                -1
            ]
            bound = spec.task.singular_value
            near = ", so that its inverse is damped there" if least < bound else ""
            axes = ", ".join(axis for axis, on in zip(TASK_AXES, followed, strict=False) if on)
            lines.append(
                f"{name} follows along {axes}: least singular value of its start pose {least:.3g}, damped "
                f"below {bound:g}{near}"
            )
    return lines


def _describe_silences(scenario: Scenario) -> list[str]:
    """Returns how often sites under the rule `glide` will hold, by the draws of their links."""
    lines = []
    for name, spec in scenario.sites.items():
        if spec.on_stale.action != "glide":
            continue
        for peer in scenario.peers(name):
            link = scenario.links[f"{peer}->{name}"]
            if link.measured or not scenario.dominance[name].get(peer):
                continue
            key = link_key(scenario.seed, f"{peer}->{name}")
            rates_hz = spec.rate_hz, scenario.sites[peer].rate_hz
            used = draw_used_samples(link, key, *rates_hz, scenario.duration_s)
            count = count_silences(used, spec.rate_hz, spec.on_stale.rule.age_ns)
            if not count:
                continue
            a_minute = 60.0 * count / scenario.duration_s
            advice = (
                "; a play-out (playout_ms) or a longer silence_ms lessens that"
                if a_minute > 1.0
                else ""
            )
            lines.append(
                f"{name} will hold {a_minute:.3g} times a minute: {spec.on_stale.silence_ms:g} ms without a "
                f"new sample of {peer}, outages aside{advice}"
            )
    return lines


def _describe_stops(scenario: Scenario) -> list[str]:
    """Returns when arms under the rule `glide` come to rest, and what their motors cannot hold."""
    lines: dict[str, list[str]] = {}
    for name, spec in scenario.sites.items():
        if spec.on_stale.action != "glide":
            continue
        if not spec.arm.known:
            text = "have no stated time to rest: their inertia is not known (arm.known)"
            lines.setdefault(text, []).append(name)
            continue
        qd = np.broadcast_to(scenario.setup(name).qd_limit_rad_s, len(spec.q0_rad))
        bounds = find_rest_bounds(scenario, name)
        speed = f"limits.qd_limit_rad_s = {np.max(qd):g}"
        if not math.isfinite(bounds.rest_s):
            text = "need more than limits.tau_limit_nm to hold themselves against gravity: they sink"
            lines.setdefault(text, []).append(name)
            continue
        text = f"come to rest within {bounds.rest_s:.3g} s of a stop at {speed}"
        lines.setdefault(text, []).append(name)
        if bounds.bearable_share < 1.0:
            most = bounds.bearable_share * np.max(qd)
            text = (
                f"can be faster than their motors bear: beyond {most:.3g} rad/s a joint may speed up to "
                f"{np.max(bounds.peak_rad_s):.3g} rad/s while they brake from {speed}"
            )
            lines.setdefault(text, []).append(name)
    return [f"arms of {', '.join(names)} {text}" for text, names in lines.items()]


_NOT_COMPARED = ("name", "title", "about", "assumed", "expect", "drawn", "sites", "links")
_MOST = 80
"""Most letters of a value."""


class ScenarioDifference(NamedTuple):
    """A difference between experiments.

    Attributes:
        key: its dotted path; below `sites.NAME` without that.
        owners: its sites; none for a key of the whole experiment.
        values: per experiment, in words; "none" if it has no such key.
    """

    key: str
    owners: tuple[str, ...]
    values: tuple[str, ...]

    def __str__(self) -> str:
        return f"{self.key} of {', '.join(self.owners)}" if self.owners else self.key


def compare_scenarios(scenarios: Sequence[Scenario]) -> list[ScenarioDifference]:
    """Returns the differences between experiments, in the order of their keys."""
    names = [", ".join(scenario.names) for scenario in scenarios]
    found = [] if len(set(names)) == 1 else [ScenarioDifference("sites", (), tuple(names))]
    tables: list[dict[str, Any]] = [msgspec.to_builtins(scenario) for scenario in scenarios]
    found += _compare_tables(
        [
            {key: value for key, value in table.items() if key not in _NOT_COMPARED}
            for table in tables
        ]
    )
    owners: dict[tuple[str, tuple[str, ...]], list[str]] = {}
    for site in (
        name for name in scenarios[0].names if all(name in other.sites for other in scenarios)
    ):
        for row in _compare_tables([table["sites"][site] for table in tables]):
            owners.setdefault((row.key, row.values), []).append(site)
    found += [
        ScenarioDifference(key, tuple(sites), values) for (key, values), sites in owners.items()
    ]
    return found + _compare_links(scenarios)


def _compare_tables(tables: Sequence[Mapping[str, Any]]) -> list[ScenarioDifference]:
    if len({table.get("control", {}).get("law") for table in tables}) > 1:
        laws = ScenarioDifference(
            "control", (), tuple(describe_law(table["control"]) for table in tables)
        )
        rest = [
            {key: value for key, value in table.items() if key != "control"} for table in tables
        ]
        return [laws, *_compare_tables(rest)]
    flat = [dict(flatten_table(table)) for table in tables]
    return [
        ScenarioDifference(key, (), tuple(describe_value(one.get(key)) for one in flat))
        for key in dict.fromkeys(key for one in flat for key in one)
        if any(one.get(key) != flat[0].get(key) for one in flat)
    ]


def _compare_links(scenarios: Sequence[Scenario]) -> list[ScenarioDifference]:
    alike: dict[tuple[str, ...], list[str]] = {}
    common = [
        name for name in scenarios[0].links if all(name in other.links for other in scenarios)
    ]
    for name in common:
        links = [scenario.links[name] for scenario in scenarios]
        if any(link != links[0] for link in links):
            alike.setdefault(tuple(link.describe() for link in links), []).append(name)
    return [
        ScenarioDifference(
            "every link" if names == common else f"link {', '.join(names)}", (), values
        )
        for values, names in alike.items()
    ]


def flatten_table(table: Mapping[str, Any], path: str = "") -> list[tuple[str, Any]]:
    """Returns the values of a table and of those in it, with dotted keys."""
    pairs: list[tuple[str, Any]] = []
    for key, value in table.items():
        where = f"{path}.{key}" if path else key
        pairs += flatten_table(value, where) if isinstance(value, dict) else [(where, value)]
    return pairs


def describe_law(control: Mapping[str, Any]) -> str:
    """Returns a law and its gains in a few words, from its table."""
    if "code" in control:  # a user's law: the settings are its gains, and its file has a hash
        settings = control.get("settings", {})
        gains = ", ".join(f"{key} {describe_value(value)}" for key, value in settings.items())
        return f"{control['code']} ({gains})" if gains else str(control["code"])
    gains = ", ".join(
        f"{key} {describe_value(value)}" for key, value in control.items() if key != "law"
    )
    return f"{control['law']} ({gains})"


def describe_value(value: Any) -> str:
    """Returns a value in words; a list of equal numbers as one of them."""
    if value is None or value == [] or value == ():
        return "none"
    if isinstance(value, dict):
        words = [
            describe_value(entry) if key == "kind" else f"{key} {describe_value(entry)}"
            for key, entry in value.items()
        ]
        return " ".join(words)
    if isinstance(value, list | tuple):
        entries = [describe_value(entry) for entry in value]
        alike = isinstance(value[0], int | float) and len(set(entries)) == 1
        text = entries[0] if alike else f"[{', '.join(entries)}]"
    else:
        text = f"{value:g}" if isinstance(value, float) else str(value)
    return text if len(text) <= _MOST else f"{text[: _MOST - 3]}..."
