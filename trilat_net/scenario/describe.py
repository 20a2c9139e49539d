"""Describes scenarios as lines of text and lists the differences between them.

The description also states facts derived from the scenario, for example whether a control law
satisfies its stability condition, and how long an arm needs to come to rest.

Invariant:
    - A difference shared by several arms or links is listed once. If two arms use different
      control laws, each law is listed in full. Links are always listed in full.
    - Names, titles and expectations are descriptive and are not compared.
"""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np

from ..core import ROW_SUM_TOLERANCE, ChainJoint, IntArray, link_key
from ..errors import count_nouns
from ..records import NS_PER_S
from .arms import TASK_AXES
from .rest_bounds import find_rest_bounds
from .scenario_reader import load_scenario
from .scenario_types import Scenario
from .urdf import UrdfJoint
from .value_text import describe_value

# Notes on the matrix of dominance factors, the weights with which sites follow their peers.
COUPLED_OPERATORS = (
    "note: the weights differ, so the proof covers operators at single sites, but not one who "
    "holds two handles"
)
IRREVERSIBLE_SHARES = (
    "note: the shares are not reversible (alpha_ij alpha_jk alpha_ki is not alpha_ik alpha_kj "
    "alpha_ji), so no damping suffices for every passive operator "
    "(docs/theory/port-conditions.md, 14)"
)


def _describe_idle_shares(scenario: Scenario) -> list[str]:
    """Returns lines about arms whose dominance factors have no effect.

    In some control laws, authority is shared according to other settings.
    """
    ramped_sites = {change.dominance for change in scenario.timeline}
    owners: dict[str, list[str]] = {}
    for name, law, situation in scenario.law_situations():
        reason = law.explain_idle_shares(situation)
        if not reason and name in ramped_sites and law.fixed_shares:
            reason = (
                "the impedances of the lines stay as at the start, whatever the timeline says"
            )
        if reason:
            owners.setdefault(reason, []).append(name)
    return [
        f"dominance without effect at {', '.join(sites)}: {reason}"
        for reason, sites in owners.items()
    ]


def describe_scenario(scenario: str | Path | Mapping[str, Any] | Scenario) -> list[str]:
    """Describes a scenario as lines of text, as printed by `trilat scenario check`.

    >>> len(tn.describe_scenario("paper")) > 5
    True

    Args:
        scenario: A scenario, or any source that `load_scenario` accepts.

    Raises:
        ScenarioError: The scenario is not valid.
    """
    scenario = load_scenario(scenario)
    names = ", ".join(scenario.names)
    tick_counts = [
        f"{count_nouns(scenario.ticks(name), 'tick')} of {name}" for name in scenario.names
    ]
    lines = [
        f"{scenario.name}: valid, sha256 {scenario.sha256[:16]}",
        *_describe_real_arms(scenario),
        f"sites: {names}; {scenario.duration_s:g} s, {', '.join(tick_counts)}",
        *_describe_links(scenario),
        *_describe_shares(scenario),
        *scenario.describe_law_conditions(),
        *_describe_idle_shares(scenario),
        *_describe_arms(scenario),
        *_describe_tasks(scenario),
        *_describe_silences(scenario),
        *_describe_stops(scenario),
    ]
    lines += [f"chosen here, not in the paper: {text}" for text in scenario.assumed]
    for key, drawn in scenario.drawn.items():
        if drawn.normal or drawn.uniform:
            lines.append(
                f"drawn with seed {scenario.seed}: {key} = {drawn.value} ({drawn.describe()})"
            )
    return lines


def _describe_real_arms(scenario: Scenario) -> list[str]:
    """Returns one line per real arm with its limits and start pose, for users to check."""
    lines = []
    for name in scenario.outside:
        spec = scenario.sites[name]
        setup = scenario.setup(name)
        arm = scenario.arms[name]
        limits = scenario.motion_limits(name)
        shape = np.shape(spec.q0_rad)
        units = arm.joint_units("rad")
        lows = np.broadcast_to(limits.q_min, shape)
        highs = np.broadcast_to(limits.q_max, shape)
        ranges = [f"{low:g} to {high:g}" for low, high in zip(lows, highs, strict=True)]
        torques = _format_per_joint(setup.tau_limit_nm, arm.joint_units("N m"))
        speeds = _format_per_joint(setup.qd_limit_rad_s, arm.joint_units("rad/s"))
        lines.append(
            f"{name} is a real arm: at most {torques}, {speeds}, {_join_equal(ranges, units)}; "
            f"it starts at {_format_per_joint(spec.q0_rad, units)}: are these your robot's?"
        )
    return lines


def _format_per_joint(values: Any, units: Sequence[str]) -> str:
    """Formats one value per joint of a quantity, or a single value if all joints agree."""
    texts = [f"{value:g}" for value in np.broadcast_to(values, len(units))]
    return _join_equal(texts, units)


def _join_equal(texts: Sequence[str], units: Sequence[str]) -> str:
    """Joins the per-joint strings into one, writing equal values or units only once.

    For example, "1", "1" with the unit "rad" becomes "1 rad", and "1", "2" becomes "1, 2 rad".
    """
    if len(set(units)) > 1:
        return ", ".join(f"{text} {unit}" for text, unit in zip(texts, units, strict=True))
    return f"{texts[0] if len(set(texts)) == 1 else ', '.join(texts)} {units[0]}"


def _describe_links(scenario: Scenario) -> list[str]:
    """Returns one line per network link, or a single line if all links are equal.

    Additional lines describe the delay with which users see the other arms (views).
    """
    descriptions = {name: link.describe() for name, link in scenario.links.items()}
    if len(set(descriptions.values())) > 1:
        lines = [f"link {name}: {text}" for name, text in descriptions.items()]
    else:
        lines = [f"every link: {next(iter(descriptions.values()))}"]
    for name, site in scenario.sites.items():
        if site.view:
            lines.append(f"view of {name}: {site.view.describe()}")
    return lines


def _describe_shares(scenario: Scenario) -> list[str]:
    """Returns lines about consequences of the dominance factors."""
    beta = scenario.beta
    weights = "none: alpha is reducible, some site's weight is zero"
    if beta is not None:
        pairs = zip(scenario.names, beta, strict=True)
        weights = ", ".join(f"{name} {len(beta) * pi:.4g}" for name, pi in pairs)
    lines = [
        "weights of the sites in the proof of stability, pi with the sum "
        f"{len(scenario.names)} (these are beta if all have the same Kd): {weights}"
    ]
    if beta is not None and np.ptp(beta) >= ROW_SUM_TOLERANCE:
        lines.append(COUPLED_OPERATORS)
    if scenario.has_irreversible_shares:
        lines.append(IRREVERSIBLE_SHARES)
    return lines


def _describe_arms(scenario: Scenario) -> list[str]:
    """Returns lines about each distinct arm with a URDF file: its joints, limits and notes."""
    lines: list[str] = []
    for arm, owners in scenario.group_chains():
        chain = arm.read_chain(scenario.urdf)
        model = scenario.arms[owners[0]]
        mass_kg = sum(joint.inertia[0] for joint in chain.joints)
        joints = count_nouns(len(chain.joints), "joint")
        lines.append(
            f"arm of {', '.join(owners)}: {arm.urdf}, {joints} from {chain.base} to "
            f"{chain.tip}, {mass_kg:.4g} kg move"
        )
        assert model.chain is not None
        for joint, drive in zip(chain.joints, model.chain.joints, strict=True):
            lines.append(_describe_joint(joint, drive))
        lines += [f"  note: {note}" for note in chain.notes]
    return lines + [f"note: {note}" for note in scenario.list_start_notes()]


def _describe_joint(joint: UrdfJoint, drive: ChainJoint) -> str:
    """Returns one line about a joint: its link, its limits and the inertia of its drive."""
    unit = "m" if drive.prismatic else "rad"
    effort_unit = "N" if drive.prismatic else "N m"
    inertia_unit = "kg" if drive.prismatic else "kg m^2"
    parts = [f"  {joint.name} moves {joint.link}, {joint.inertia[0]:.4g} kg"]
    if joint.lower > -math.inf:
        parts.append(f"{joint.lower:.4g} to {joint.upper:.4g} {unit}")
    if joint.effort_limit < math.inf:
        parts.append(f"{joint.effort_limit:.4g} {effort_unit}")
    if joint.velocity_limit < math.inf:
        parts.append(f"{joint.velocity_limit:.4g} {unit}/s")
    if drive.armature_kg_m2 > 0.0:
        parts.append(f"drive {drive.armature_kg_m2:.4g} {inertia_unit}")
    return "; ".join(parts)


def _describe_tasks(scenario: Scenario) -> list[str]:
    """Returns lines about the arms that follow each other's end effectors instead of joints."""
    lines = []
    for name, model in scenario.arms.items():
        if not model.shares_pose:
            continue
        spec = scenario.sites[name]
        is_followed = np.array(model.axes) > 0.0
        J = model.task_jacobian(spec.q0_rad)[is_followed]
        singular_values = np.linalg.svd(J, compute_uv=False)
        least = singular_values[-1]
        bound = spec.task.singular_value
        consequence = ", so its inverse is damped there" if least < bound else ""
        axes = [TASK_AXES[n] for n in np.flatnonzero(is_followed)]
        lines.append(
            f"{name} follows along {', '.join(axes)}: least singular value of its start pose "
            f"{least:.3g}, damped below {bound:g}{consequence}"
        )
    return lines


def _describe_silences(scenario: Scenario) -> list[str]:
    """Returns lines about how often arms will have to wait for late messages.

    Only arms with the stale rule "glide" wait, coming to rest in the meantime. The number is
    computed from the delays and losses that the links will draw in the run.
    """
    lines = []
    for name, spec in scenario.sites.items():
        if spec.on_stale.action != "glide":
            continue
        for peer in scenario.peers(name):
            link = scenario.links[f"{peer}->{name}"]
            if link.measured or not scenario.dominance[name].get(peer):
                continue
            used = link.draw_used_samples(
                key=link_key(scenario.seed, f"{peer}->{name}"),
                receiver_hz=spec.rate_hz,
                sender_hz=scenario.sites[peer].rate_hz,
                duration_s=scenario.duration_s,
            )
            count = _count_silences(used, spec.rate_hz, spec.on_stale.rule.age_ns)
            if not count:
                continue
            per_minute = 60.0 * count / scenario.duration_s
            advice = ""
            if per_minute > 1.0:
                advice = "; a play-out (playout_ms) or a longer silence_ms makes this rarer"
            lines.append(
                f"{name} will hold {per_minute:.3g} times a minute: "
                f"{spec.on_stale.silence_ms:g} ms without a new sample of {peer}, outages "
                f"not counted{advice}"
            )
    return lines


def _count_silences(used: IntArray, receiver_hz: int, silence_ns: int) -> int:
    """Counts how often a site uses no new sample of a peer for longer than a limit.

    The time before the first sample is ignored.

    Args:
        used: Index of the sample in use at every tick; -1 before the first sample.
        receiver_hz: Tick rate of the site, in Hz.
        silence_ns: Longest time without a new sample that does not count as a silence, in ns.
    """
    new_sample_ticks = np.flatnonzero(np.diff(used, prepend=-1) > 0)
    if not len(new_sample_ticks):
        return 0
    gap_ticks = np.diff(new_sample_ticks, append=len(used))
    gaps_ns = gap_ticks * NS_PER_S // receiver_hz
    # Without a silence, the distance between new samples is one period.
    period_ns = NS_PER_S // receiver_hz
    return int(np.count_nonzero(gaps_ns - period_ns > silence_ns))


def _describe_stops(scenario: Scenario) -> list[str]:
    """Returns lines about how arms come to rest while a peer is silent (stale rule "glide").

    Arms with the same description share one line.
    """
    owners: dict[str, list[str]] = {}
    for name, spec in scenario.sites.items():
        if spec.on_stale.action != "glide":
            continue
        for text in _describe_stop(scenario, name):
            owners.setdefault(text, []).append(name)
    return [f"arms of {', '.join(names)} {text}" for text, names in owners.items()]


def _describe_stop(scenario: Scenario, name: str) -> list[str]:
    """Describes the motion of an arm after a stop, as sentence endings.

    They state when the arm comes to rest, and whether its motors are strong enough.
    """
    spec = scenario.sites[name]
    if not spec.arm.known:
        return ["have no stated time to rest: their inertia is not known (arm.known)"]
    bounds = find_rest_bounds(scenario, name)
    if not math.isfinite(bounds.rest_s):
        return [
            "need more than limits.tau_limit_nm to hold themselves against gravity: they sink"
        ]
    qd = np.broadcast_to(scenario.setup(name).qd_limit_rad_s, len(spec.q0_rad))
    speed = f"limits.qd_limit_rad_s = {np.max(qd):g}"
    texts = [f"come to rest within {bounds.rest_s:.3g} s of a stop at {speed}"]
    if bounds.bearable_share < 1.0:
        bearable = bounds.bearable_share * np.max(qd)
        texts.append(
            f"can be faster than their motors bear: beyond {bearable:.3g} rad/s a joint may "
            f"speed up to {np.max(bounds.peak_rad_s):.3g} rad/s while they brake from {speed}"
        )
    return texts


_NOT_COMPARED = ("name", "title", "about", "assumed", "expect", "drawn", "sites", "links")
"""Keys that only describe a scenario, or that are compared separately."""
_EVERY_LINK = "every link"
_SOME_LINKS = "link "
"""Prefix of the key of a difference between links, followed by the names of the links."""


class ScenarioDifference(NamedTuple):
    """A key whose value differs between scenarios, as one row of a comparison table.

    Attributes:
        key: Dotted path of the key, relative to `sites.NAME` for a key of a site.
        owners: Names of the sites to which the difference applies. Empty for a key of the whole
            scenario.
        values: Value in each scenario as a string, or "none" if the scenario does not have the
            key.
    """

    key: str
    owners: tuple[str, ...]
    values: tuple[str, ...]

    @classmethod
    def list_between(cls, scenarios: Sequence[Scenario]) -> list["ScenarioDifference"]:
        """Finds the settings in which several scenarios differ.

        Includes settings that only some of the scenarios have.

        Args:
            scenarios: At least two scenarios.

        Returns:
            One entry per difference, in the order of the keys. Empty if the scenarios are
            equal.
        """
        differences: list[ScenarioDifference] = []
        site_lists = [", ".join(scenario.names) for scenario in scenarios]
        if len(set(site_lists)) > 1:
            differences.append(cls("sites", (), tuple(site_lists)))
        tables: list[dict[str, Any]] = [msgspec.to_builtins(scenario) for scenario in scenarios]
        common_tables = [_omit_keys(table, _NOT_COMPARED) for table in tables]
        differences += _compare_tables(common_tables)

        # Sites with the same difference are collected in one entry.
        owners: dict[tuple[str, tuple[str, ...]], list[str]] = {}
        for site in scenarios[0].names:
            if not all(site in other.sites for other in scenarios):
                continue
            site_tables = [table["sites"][site] for table in tables]
            for difference in _compare_tables(site_tables):
                owners.setdefault((difference.key, difference.values), []).append(site)
        for (key, values), sites in owners.items():
            differences.append(cls(key, tuple(sites), values))
        return differences + _compare_links(scenarios)

    @property
    def concerns_link(self) -> bool:
        """True if the difference concerns the settings of network links.

        The key is then "every link" or, for example, "link m1->s".
        """
        return self.key == _EVERY_LINK or self.key.startswith(_SOME_LINKS)

    def __str__(self) -> str:
        """Returns the key that differs, with the names of the arms to which this applies."""
        return f"{self.key} of {', '.join(self.owners)}" if self.owners else self.key


def _omit_keys(table: Mapping[str, Any], keys: Sequence[str]) -> dict[str, Any]:
    """Returns a copy of a table without the given keys."""
    return {key: value for key, value in table.items() if key not in keys}


def _compare_tables(tables: Sequence[Mapping[str, Any]]) -> list[ScenarioDifference]:
    """Returns the differences between several scenario tables, key by key.

    Control laws of different kinds are compared as a whole, since their gains have different
    meanings.
    """
    laws = {table.get("control", {}).get("law") for table in tables}
    if len(laws) > 1:
        descriptions = tuple(describe_law(table["control"]) for table in tables)
        rest = [_omit_keys(table, ["control"]) for table in tables]
        return [ScenarioDifference("control", (), descriptions), *_compare_tables(rest)]
    flat_tables = [dict(flatten_table(table)) for table in tables]
    keys = dict.fromkeys(key for table in flat_tables for key in table)
    differences = []
    for key in keys:
        values = [table.get(key) for table in flat_tables]
        if any(value != values[0] for value in values):
            texts = tuple(describe_value(value) for value in values)
            differences.append(ScenarioDifference(key, (), texts))
    return differences


def _compare_links(scenarios: Sequence[Scenario]) -> list[ScenarioDifference]:
    """Returns the differences between the network links of several scenarios.

    Links with the same difference share one entry.
    """
    names_by_values: dict[tuple[str, ...], list[str]] = {}
    common_names = list(scenarios[0].links)
    for other in scenarios[1:]:
        common_names = [name for name in common_names if name in other.links]
    for name in common_names:
        links = [scenario.links[name] for scenario in scenarios]
        if any(link != links[0] for link in links):
            values = tuple(link.describe() for link in links)
            names_by_values.setdefault(values, []).append(name)
    differences = []
    for values, names in names_by_values.items():
        key = _SOME_LINKS + ", ".join(names)
        if names == common_names:
            key = _EVERY_LINK
        differences.append(ScenarioDifference(key, (), values))
    return differences


def flatten_table(table: Mapping[str, Any], path: str = "") -> list[tuple[str, Any]]:
    """Flattens nested tables into pairs of dotted key and value.

    For example, {"a": {"b": 1}} becomes [("a.b", 1)].

    Args:
        table: A table, possibly nested.
        path: Dotted key of `table` itself. Empty for the outermost table.
    """
    pairs: list[tuple[str, Any]] = []
    for key, value in table.items():
        key_path = f"{path}.{key}" if path else key
        if isinstance(value, dict):
            pairs += flatten_table(value, key_path)
        else:
            pairs.append((key_path, value))
    return pairs


def describe_law(control: Mapping[str, Any]) -> str:
    """Returns the name and gains of a control law, as in "p_d (K 20, d 4)".

    Args:
        control: The `control` table of a scenario.
    """
    # The gains of a user's law are its settings; the hash of its file is left out.
    if "code" in control:
        name = str(control["code"])
        gains = control.get("settings", {})
    else:
        name = str(control["law"])
        gains = _omit_keys(control, ["law"])
    text = ", ".join(f"{key} {describe_value(value)}" for key, value in gains.items())
    return f"{name} ({text})" if text or "code" not in control else name
