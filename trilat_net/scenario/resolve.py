"""Completes the tables of a scenario file: defaults, presets, inherited keys, named files.

A scenario is a TOML file that describes an experiment. Its author may leave out most keys. The
function `resolve_scenario` returns tables in which nothing is left out:

1. It checks the names of all keys.
2. It writes out every default, and copies the keys of the tables for all sites (such as
   `[arm]`) into the table of each site.
3. It replaces each number that is given as a probability distribution by a number that is drawn
   from the distribution with the seed of the scenario.
4. It reads the files that the scenario names (URDF files of arms, traces of delays), so that
   the result needs no other file.

Afterwards, `validate.build_scenario` converts the result to types, and checks the ranges.

Invariant:
    - A key is checked in the table in which its author wrote it. Therefore an author finds the
      path in an error message in the file.
    - A preset is a table that an author could have written as well. The file
      `scenarios/_presets.toml` contains the presets and their sources. A resolved scenario
      contains the keys of a preset, but not its name, so that it does not change with a preset.
"""

import math
import re
import tomllib
from collections.abc import Sequence
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any, NoReturn, TypeVar

import msgspec
import numpy as np

from ..core import ROW_SUM_TOLERANCE, ArmLinks, Array
from ..errors import ScenarioError, count_nouns, suggest_nearest
from ..fields import Frozen, TomlTable, reword_problem, split_refusal
from ..files import open_regular
from ..own_code import CLASS_PATTERN, parse_classes, read_code, read_sends
from .arms import BASE_KEYS, CHAIN_KEYS, Arm, ArmModel, Task, build_arm, read_arm
from .delay_models import DELAY_MODELS
from .delay_traces import read_trace
from .distributions import Draws
from .expect import Expect, number_window_joints
from .key_checks import (
    VectorCounts,
    check_choice,
    check_finite,
    check_keys,
    describe_wrong_type,
    expand_vectors,
    field_names,
    find_count_problem,
    is_distribution,
    is_number,
    list_fields,
)
from .laws import LAWS
from .link_inertia import LinkInertia
from .operators import ENVIRONMENTS, OPERATORS, HeldArm, resolve_operators
from .own_plant import resolve_plant
from .scenario_types import (
    GLIDE_TAU_RATE_NM_S,
    SITE_GROUPS,
    TIMELINE_KEYS,
    Limits,
    Scenario,
    SiteSpec,
)
from .urdf import MAX_CHARACTERS

_TOP_LEVEL_KEYS = (
    "name",
    "title",
    "about",
    "assumed",
    "rate_hz",
    "duration_s",
    "seed",
    "scheme",
)
_TABLES = (
    *SITE_GROUPS,
    "control",
    "link",
    *(key for key in field_names(Scenario) if key not in _TOP_LEVEL_KEYS),
)
_SITE_NAME = re.compile(r"[a-z][a-z0-9_]{0,31}")
_RESERVED_NAMES = ("recorder",)
_DEFAULT_SEED = 1
_DEFAULT_LAW = "adaptive"
T = TypeVar("T")
_MIN_DOWN_LENGTH = 1e-6
"""Smallest sum of the absolute components of a vector that still counts as a direction."""
MAX_SITES = 32
"""Largest number of sites of an experiment. Every pair of sites has two links."""

SHIPPED_FOLDER = resources.files("trilat_net") / "scenarios"
_PRESETS_FILE = SHIPPED_FOLDER / "_presets.toml"

GRID_ROUND_TRIPS_MS = (8, 68, 136, 272, 544, 1088)
GRID_LOSSES_PERCENT = (0, 10, 25, 50)
"""Round trips and losses of the grid of presets.

The ranges are those of Rodriguez-Seda, Lee and Spong, "Experimental Comparison Study of Control
Architectures for Bilateral Teleoperators", IEEE Trans. Robotics 25 (2009): round trips of 8 to
1088 ms and losses of 0 to 50 %. The grid points are our choice; the points of that study are
not known to us.
"""


_GRID: dict[str, dict[str, Any]] = {
    f"rtt{rtt_ms}-loss{percent}": {
        "model": "constant",
        "delay_ms": rtt_ms / 2,
        "loss": percent / 100,
    }
    for rtt_ms in GRID_ROUND_TRIPS_MS
    for percent in GRID_LOSSES_PERCENT
}
PRESETS: dict[str, dict[str, Any]] = {
    **tomllib.loads(_PRESETS_FILE.read_text(encoding="utf-8")),
    **_GRID,
}
"""The keys of a link that each preset stands for, by the name of the preset.

The presets of the grid, such as `rtt68-loss10`, delay each direction by half of the round trip.
They lose each sample independently of the others.
"""

TRACE_KEYS = ("file", "of")
"""Keys of a link that name a file of delays. A resolved link contains the delays instead."""


def resolve_scenario(tables: TomlTable, folder: Path | None) -> TomlTable:
    """Writes out every default of a scenario file, and every file that it names.

    The result describes the experiment completely, without any other file.

    Args:
        tables: Tables of the scenario file, as its author wrote them.
        folder: Folder in which the files are searched that the tables name. None refuses
            tables that name a file.

    Returns:
        Tables with the keys of `Scenario`.

    Raises:
        ScenarioError: A key is unknown, missing or wrong. The error contains its path.
    """
    _check_top_level(tables)
    draws = Draws(tables.get("seed", _DEFAULT_SEED), tables.get("drawn", {}))
    urdf_texts = _read_urdf_files(tables, folder)
    sites = _resolve_sites(tables, draws, urdf_texts)
    site_names = list(sites)
    expect = _resolve_expect(tables.get("expect", {}), sites, urdf_texts)
    dominance_rows = _resolve_dominance(tables["dominance"], site_names)
    links = _resolve_links(tables, site_names, folder)
    _resolve_views(sites, folder)
    timeline = _resolve_timeline(tables.get("timeline", []), links, site_names)

    top_level: TomlTable = {"duration_s": 20.0, "seed": _DEFAULT_SEED, "scheme": "second_order"}
    for key in _TOP_LEVEL_KEYS:
        # The common tick rate is already a key of each site.
        if key in tables and key != "rate_hz":
            top_level[key] = _use_unix_line_ends(tables[key])

    used_files = [site["arm"].get("urdf") for site in sites.values()]
    used_texts = {name: text for name, text in urdf_texts.items() if name in used_files}
    return {
        **top_level,
        "sites": sites,
        "dominance": dominance_rows,
        "links": links,
        "timeline": timeline,
        "expect": expect,
        "drawn": msgspec.to_builtins(draws.drawn),
        "urdf": used_texts,
    }


@cache
def _list_group_paths() -> list[str]:
    """Returns the dotted paths of all keys of the tables for all sites or all links.

    A user who writes only the last part of such a path learns the whole path.
    """
    link_keys = {key for model in DELAY_MODELS.values() for key in field_names(model)}
    gains = {key for law in LAWS.values() for key in field_names(law)}
    paths = [f"link.{key}" for key in ("model", "preset", *sorted(link_keys))]
    paths += [f"control.{key}" for key in ("law", *sorted(gains))]
    for group, kind in SITE_GROUPS.items():
        paths += [f"{group}.{key}" for key in field_names(kind)]
    return paths


def _check_top_level(tables: TomlTable) -> None:
    """Checks the names of the scenario's keys, and those of its tables for all sites.

    Raises:
        ScenarioError: A key is unknown, a required table is missing, or a number is not finite.
    """
    sites = tables.get("sites", {})
    site_paths = [f"sites.{name}" for name in sites] if isinstance(sites, dict) else []
    check_keys(tables, _TOP_LEVEL_KEYS + _TABLES, "", [*site_paths, *_list_group_paths()])
    check_finite(tables, "")
    for required in ("name", "sites", "dominance"):
        if required not in tables:
            raise ScenarioError("is missing", path=required)
    for group, kind in SITE_GROUPS.items():
        check_keys(tables.get(group, {}), field_names(kind), group)
    check_keys(tables.get("expect", {}), field_names(Expect), "expect")
    _resolve_control(tables.get("control", {}), {}, "control", VectorCounts())


def _resolve_expect(
    written: TomlTable, sites: TomlTable, urdf_texts: dict[str, str]
) -> TomlTable:
    """Returns the table of expectations, with indices in place of names of joints.

    An expectation states what a test of the scenario requires of a run. It may apply to a
    window of time and to one joint. The author may name this joint as in the URDF file of the
    arm; the result contains its index.

    Args:
        written: Table `expect` as its author wrote it.
        sites: Resolved tables of the sites, by name.
        urdf_texts: Texts of the URDF files, by name.
    """
    expect = dict(written)
    if "windows" in expect:
        joint_names = {
            name: _list_joint_names(site["arm"], urdf_texts) for name, site in sites.items()
        }
        expect["windows"] = number_window_joints(expect["windows"], joint_names)
    return expect


def _resolve_dominance(written: Any, site_names: list[str]) -> TomlTable:
    """Returns the weights with which every site follows its peers, the dominance factors.

    Args:
        written: Table `dominance` as its author wrote it.
        site_names: Names of the sites.

    Returns:
        For each site, the factor of each of its peers, by name.

    Raises:
        ScenarioError: A site has no row, or its row is not valid.
    """
    table = check_keys(written, site_names, "dominance")
    rows = {}
    for name in site_names:
        path = f"dominance.{name}"
        if name not in table:
            raise ScenarioError("is missing; name the sites that this site follows", path=path)
        rows[name] = resolve_dominance_row(table[name], site_names, name, path)
    return rows


def _read_urdf_files(tables: TomlTable, folder: Path | None) -> dict[str, str]:
    """Returns the text of every URDF file that an arm names, by the name of the file.

    The table `urdf` of a resolved scenario contains the texts of its files. A text in this
    table has priority, then a file that the package ships, then a file in `folder`.

    Raises:
        ScenarioError: A file cannot be read, or no file may be named.
    """
    embedded_texts = check_keys(tables.get("urdf", {}), list(tables.get("urdf", {})), "urdf")
    for name, text in embedded_texts.items():
        if not isinstance(text, str):
            raise ScenarioError("must be the text of a URDF", path=f"urdf.{name}")

    arms = {"arm": tables.get("arm")}
    sites = tables["sites"] if isinstance(tables["sites"], dict) else {}
    for site_name, site in sites.items():
        if isinstance(site, dict):
            arms[f"sites.{site_name}.arm"] = site.get("arm")

    texts: dict[str, str] = {}
    for path, arm in arms.items():
        name = arm.get("urdf", "") if isinstance(arm, dict) else ""
        if not isinstance(name, str):
            raise ScenarioError("must be a file's name", path=f"{path}.urdf")
        if not name or name in texts:
            continue
        if name in embedded_texts:
            text = embedded_texts[name]
        else:
            text = _read_urdf(name, folder, path)
        texts[name] = _use_unix_line_ends(text)
    return texts


def _read_urdf(name: str, folder: Path | None, path: str) -> str:
    """Returns the text of a URDF file.

    At most one character more than allowed is read. The parser then refuses the text as too
    long.

    Args:
        name: Name of the file, as the arm names it.
        folder: Folder of the scenario. None refuses every file.
        path: Path of the arm's table, for error messages.

    Raises:
        ScenarioError: The file cannot be read, or no file may be named.
    """
    if folder is None:
        raise ScenarioError("no file may be named here", path=f"{path}.urdf")
    try:
        with open_regular(_find_file(name, folder), encoding="utf-8") as stream:
            text: str = stream.read(MAX_CHARACTERS + 1)
        return text
    # A ValueError is raised for text that is not UTF-8, and for a name with a null character.
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or "not UTF-8 text"
        raise ScenarioError(f"{name} cannot be read: {reason}", path=f"{path}.urdf") from None


def _find_file(name: str, folder: Path) -> Path:
    """Returns the shipped file of a name, or the file in `folder` if there is none.

    Only a name without a folder can be that of a shipped file. The returned path need not
    exist.
    """
    shipped = Path(str(SHIPPED_FOLDER / name))
    is_plain_name = "/" not in name and "\\" not in name
    return shipped if is_plain_name and shipped.is_file() else folder / name


def _check_kind_keys(
    table: TomlTable,
    valid: Sequence[str],
    path: str,
    kind: str,
    keys_by_kind: dict[str, tuple[str, ...]],
) -> None:
    """Refuses a key that belongs to another law or delay model than that of a table.

    Upper and lower case count as equal, so that the user of `control.D` learns of `d`. A key
    that differs from a valid one only in its case is left to `check_keys`, which suggests it.

    Args:
        table: Table of a control law or a delay model.
        valid: The keys that the table may have.
        path: Dotted path of the table, for errors.
        kind: The kind of the table, as in "law adaptive" or "model constant".
        keys_by_kind: The keys of every kind.

    Raises:
        ScenarioError: The key belongs to other kinds.
    """
    valid_words = {key.casefold() for key in valid}
    for key in table:
        sought = key.casefold()
        if sought in valid_words:
            continue
        owners = {
            name: owned
            for name, keys in keys_by_kind.items()
            for owned in keys
            if owned.casefold() == sought
        }
        if owners:
            group, _, name = kind.partition(" ")
            owned_keys = " or ".join(dict.fromkeys(owners.values()))
            subject = "belongs to" if owned_keys == key else f"{owned_keys} belongs to"
            raise ScenarioError(
                f"{subject} {group} {', '.join(owners)}, but {path}.{group} is {name}, which "
                f"has {', '.join(owned for owned in valid if owned != group)}",
                path=f"{path}.{key}",
            )


def _resolve_control(
    written: Any, default: TomlTable, path: str, counts: VectorCounts
) -> TomlTable:
    """Returns the complete table of a control law and its gains.

    Args:
        written: Table `control` of a site as its author wrote it.
        default: Table `control` for all sites. Its gains replace missing gains if it names the
            same law; other laws have other gains.
        path: Path of the table, for error messages.
        counts: Lengths to which a single number per vector is expanded.

    Raises:
        ScenarioError: There is no such law, or it has no such gain.
    """
    if not isinstance(written, dict):
        raise ScenarioError("must be a table", path=path)
    default_law = default.get("law", _DEFAULT_LAW)
    law = str(written.get("law", default_law))
    if ":" in law:
        return _resolve_user_law(law, written, default, path)
    if law not in LAWS:
        _refuse_law(law, f"{path}.law")
    gain_names = {name: field_names(kind) for name, kind in LAWS.items() if name != "own"}
    valid_keys = ("law", *field_names(LAWS[law]))
    _check_kind_keys(written, valid_keys, path, f"law {law}", gain_names)
    gains = check_keys(written, valid_keys, path)
    inherited = default if default_law == law else {}
    return expand_vectors({**inherited, **gains, "law": law}, LAWS[law], counts)


def _refuse_law(law: str, path: str) -> NoReturn:
    """Refuses the name of a control law that does not exist.

    If a Python file of that name exists, the message contains the right name of its class.

    Args:
        law: The name.
        path: Path of the key, for error messages.

    Raises:
        ScenarioError: In every case.
    """
    file = Path(law if law.endswith(".py") else f"{law}.py")
    if file.is_file():
        classes = parse_classes(file.read_bytes(), file, path)
        names = [f"{file.stem}:{name}" for name in classes]
        remedy = f"write {' or '.join(names)}" if names else "it defines no class"
        raise ScenarioError(f"is {law!r}, but a law in a file is a class: {remedy}", path=path)
    # "own" is the type of users' laws in canonical texts.
    built_in = [name for name in LAWS if name != "own"]
    check_choice(law, [*built_in, "module:Class"], path)
    raise ScenarioError(f"is {law!r}, but must name a class as module:Class", path=path)


def _resolve_user_law(
    code: str, written: TomlTable, default: TomlTable, path: str
) -> TomlTable:
    """Returns the table of a control law that a user wrote as a Python class.

    The table contains the name of the class, the hash of its file, and the vectors that the law
    sends to its peers. The file is read, but not executed.

    Args:
        code: Module and class, for example "package.module:Law".
        written: Table `control` of the site. Apart from the key `law`, it contains the
            arguments of the class.
        default: Table `control` for all sites. Its arguments apply if it names the same class.
        path: Path of the table, for error messages.

    Raises:
        ScenarioError: The name is not valid, the file cannot be read, or the table contains a
            key that it must not have.
    """
    if not re.fullmatch(CLASS_PATTERN, code):
        problem = f"must have the form package.module:Law, but is {code!r}"
        raise ScenarioError(problem, path=f"{path}.law")
    inherited = default if default.get("law") == code else {}
    settings = {**inherited, **written}
    settings.pop("law", None)
    if "settings" in settings:
        raise ScenarioError(
            "the settings of a user's law must be written next to the key law, as in "
            "control.gain = 5",
            path=f"{path}.settings",
        )
    if "sends" in settings:
        raise ScenarioError(
            "is declared by the class of the law, not here", path=f"{path}.sends"
        )
    source = read_code(code, f"{path}.law")
    sends = msgspec.to_builtins(read_sends(source.content, source.file, code, f"{path}.law"))
    return {
        "law": "own",
        "code": code,
        "source_sha256": source.sha256,
        "settings": settings,
        "sends": sends,
    }


def _use_unix_line_ends(value: Any) -> Any:
    r"""Returns a string, or a list of strings, with "\n" at the end of each line.

    TOML stores line ends in this form. Without the conversion, a file that was written on
    Windows would be another experiment. Values of other types are returned unchanged.
    """
    if isinstance(value, list):
        return [_use_unix_line_ends(entry) for entry in value]
    if isinstance(value, str):
        return value.replace("\r\n", "\n").replace("\r", "\n")
    return value


def _resolve_sites(tables: TomlTable, draws: Draws, urdf_texts: dict[str, str]) -> TomlTable:
    """Returns the complete table of every site, by name.

    Args:
        tables: Tables of the scenario file.
        draws: Draws the numbers that are given as distributions.
        urdf_texts: Texts of the URDF files, by name.

    Raises:
        ScenarioError: There are too few or too many sites, or a table is not valid.
    """
    if not isinstance(tables["sites"], dict):
        raise ScenarioError("must be tables [sites.NAME]", path="sites")
    site_tables = {
        name: _join_site_groups(name, site, tables) for name, site in tables["sites"].items()
    }
    if len(site_tables) > MAX_SITES:
        raise ScenarioError(
            f"has {count_nouns(len(site_tables), 'site')}, but at most {MAX_SITES} are allowed",
            path="sites",
        )
    if len(site_tables) < 2:
        raise ScenarioError(
            f"an experiment must have at least two sites, but this one has {len(site_tables)}",
            path="sites",
        )

    # The kernel computes planar arms with their own formulas, and all other arms as chains. If
    # one arm is a chain, all arms are: every run uses the same functions for all its sites.
    chains = False
    for site in site_tables.values():
        shares_pose = site["task"].get("space", "joints") != "joints"
        if site["arm"].get("urdf") or shares_pose:
            chains = True

    return {
        name: _resolve_site(
            name=name,
            site=site,
            tables=tables,
            draws=draws,
            urdf_texts=urdf_texts,
            chains=chains,
        )
        for name, site in site_tables.items()
    }


def _join_site_groups(name: str, written: Any, tables: TomlTable) -> TomlTable:
    """Returns the table of a site, completed with the keys that all sites share.

    The groups of keys in `SITE_GROUPS`, such as `arm` and `limits`, may be written once for all
    sites, and again for a single site. The keys of the single site have priority.

    Args:
        name: Name of the site.
        written: Table of the site as its author wrote it.
        tables: Tables of the scenario file.

    Raises:
        ScenarioError: The name is not valid, or a key is unknown.
    """
    path = f"sites.{name}"
    if not _SITE_NAME.fullmatch(name) or name in _RESERVED_NAMES:
        raise ScenarioError(
            "the name of a site must consist of lower-case letters, digits and _, begin with "
            f"a letter, and not be {_RESERVED_NAMES[0]!r}",
            path=path,
        )
    site = dict(check_keys(written, field_names(SiteSpec), path))
    for group, kind in SITE_GROUPS.items():
        local_table = check_keys(site.get(group, {}), field_names(kind), f"{path}.{group}")
        if "urdf" in local_table:
            # An arm with its own file inherits nothing: the keys for all arms mean another arm.
            site[group] = local_table
        else:
            site[group] = _join_group(tables.get(group, {}), local_table)
    return site


def _join_group(shared: TomlTable, local: TomlTable) -> TomlTable:
    """Returns a site's table of one group, with missing keys from the table for all sites.

    The table `links` of an arm contains a table for each link. These are joined link by link
    and key by key, so that a site may change a single inertia.

    Args:
        shared: Table of the group for all sites.
        local: Table of the group of the site.
    """
    joined = {**shared, **local}
    shared_links = shared.get("links")
    local_links = local.get("links")
    if isinstance(shared_links, dict) and isinstance(local_links, dict):
        joined["links"] = {**shared_links, **local_links}
        for name in shared_links.keys() & local_links.keys():
            if isinstance(shared_links[name], dict) and isinstance(local_links[name], dict):
                joined["links"][name] = {**shared_links[name], **local_links[name]}
    return joined


def _resolve_site(
    name: str,
    site: TomlTable,
    tables: TomlTable,
    draws: Draws,
    urdf_texts: dict[str, str],
    chains: bool,
) -> TomlTable:
    """Returns the complete table of a site.

    The steps depend on each other. The model of the arm is built first, because it states the
    number of joints, and thereby the lengths of the site's vectors. The order of the draws
    decides which random number each key gets, so it must not change.

    Args:
        name: Name of the site.
        site: Table of the site, joined with the tables for all sites. It is changed.
        tables: Tables of the scenario file.
        draws: Draws the numbers that are given as distributions.
        urdf_texts: Texts of the URDF files, by name.
        chains: Whether the arms of the scenario are general chains of joints.
    """
    path = f"sites.{name}"
    site["arm"], model = _resolve_arm(
        site=site, draws=draws, urdf_texts=urdf_texts, chains=chains, path=f"{path}.arm"
    )
    counts = model.counts if model is not None else VectorCounts()
    site = expand_vectors({"q0_rad": 0.0, "qd0_rad_s": 0.0, **site}, SiteSpec, counts)
    site["control"] = _resolve_control(
        site.get("control", {}), tables.get("control", {}), f"{path}.control", counts
    )
    site["limits"] = {**_list_default_limits(site, model), **site["limits"]}
    if "plant" in site:
        site["plant"] = resolve_plant(site["plant"], f"{path}.plant")
    site.setdefault("role", "master")
    site.setdefault("rate_hz", tables.get("rate_hz", 1000))
    _draw_site_numbers(site, draws, path)
    _check_counts(site, counts, path)

    def locate_end_effector() -> list[float]:
        # If the table is wrong, `validate` refuses it later. Until then, zeros stand in.
        if model is None or not all(map(is_number, site["q0_rad"])):
            return [0.0] * counts.axes
        return model.end_effector(site["q0_rad"])

    held_arm = HeldArm(counts, site["q0_rad"], locate_end_effector, draws)
    for group, kinds in (("hands", OPERATORS), ("environment", ENVIRONMENTS)):
        actors = site.get(group, [])
        site[group] = resolve_operators(actors, kinds, held_arm, f"{path}.{group}")
    return {key: site[key] for key in field_names(SiteSpec) if key in site}


def _list_default_limits(site: TomlTable, model: ArmModel | None) -> TomlTable:
    """Returns the limits of a site that apply if its author states none.

    The efforts and speeds of a chain's joints come from its URDF file. A joint for which the
    file states no positive finite limit has the default of `Limits`. A simulated arm with the
    stale rule "glide" also has a limit on the torque's rate of change.
    """
    limits: TomlTable = {}
    if site["on_stale"].get("action") == "glide" and site.get("plant") != "external":
        limits["tau_rate_limit_nm_s"] = GLIDE_TAU_RATE_NM_S
    if model is None or model.chain is None:
        return limits

    file_limits = {"tau_limit_nm": model.efforts, "qd_limit_rad_s": model.speeds}
    for key, stated_limits in file_limits.items():
        default = getattr(Limits(), key)
        limits[key] = [limit if 0.0 < limit < math.inf else default for limit in stated_limits]
    return limits


def _draw_site_numbers(site: TomlTable, draws: Draws, path: str) -> None:
    """Draws the numbers of a site that are given as distributions, in place.

    These are the start, the limits, the rules for stale samples, the task and the gains of the
    control law. The order of the draws decides the order of the keys in the table `drawn`, and
    thereby the text and the hash of the scenario.
    """
    start = {key: site[key] for key in ("q0_rad", "qd0_rad_s")}
    site |= draws.draw_numbers(start, path)
    drawn_groups = [group for group in SITE_GROUPS if group != "arm"]
    for group in (*drawn_groups, "control"):
        site[group] = draws.draw_numbers(site[group], f"{path}.{group}")
    settings = site["control"].get("settings")
    if isinstance(settings, dict):
        site["control"]["settings"] = draws.draw_numbers(settings, f"{path}.control.settings")


def _resolve_arm(
    site: TomlTable, draws: Draws, urdf_texts: dict[str, str], chains: bool, path: str
) -> tuple[TomlTable, ArmModel | None]:
    """Returns the complete table of an arm and its model.

    The key `armature_kg_m2` (rotor inertias) may contain one number per joint, and only the
    model knows the number of joints. Therefore the model is built without this key first, and
    again with the key. The key `links` contains tables instead of numbers, and is resolved
    separately.

    Args:
        site: Table of the site.
        draws: Draws the numbers that are given as distributions.
        urdf_texts: Texts of the URDF files, by name.
        chains: Whether the arms of the scenario are general chains of joints.
        path: Path of the arm's table, for error messages.

    Returns:
        The table and the model. The model is None if validation will refuse the table.
    """
    table = dict(site["arm"])
    task_table = site["task"]
    armature = {}
    if "armature_kg_m2" in table:
        armature["armature_kg_m2"] = table.pop("armature_kg_m2")
    links = _resolve_link_inertias(table.pop("links", {}), draws, f"{path}.links")
    table = draws.draw_numbers(table, path)
    if links:
        table["links"] = links

    def build_model() -> ArmModel | None:
        return _model_arm(
            table=table, task_table=task_table, urdf_texts=urdf_texts, chains=chains, path=path
        )

    model = build_model()
    if not armature or model is None:
        return {**table, **armature}, model
    if not table.get("urdf"):
        raise ScenarioError(_BELONGS_TO_CHAIN, path=f"{path}.armature_kg_m2")
    table |= draws.draw_numbers(expand_vectors(armature, Arm, model.counts), path)
    return table, build_model()


def _resolve_link_inertias(written: Any, draws: Draws, path: str) -> TomlTable:
    """Returns the masses and inertias that an author states for links of an arm.

    They replace those of the URDF file. Numbers that are given as distributions are drawn.

    Args:
        written: Table `links` of the arm as its author wrote it.
        draws: Draws the numbers.
        path: Path of the table, for error messages.

    Raises:
        ScenarioError: A table is not valid, or states nothing.
    """
    links: TomlTable = {}
    if not isinstance(written, dict):
        raise ScenarioError("must be a table of links", path=path)
    for name, entry in written.items():
        link_path = f"{path}.{name}"
        check_keys(entry, field_names(LinkInertia), link_path)
        links[name] = draws.draw_numbers(entry, link_path)
        inertia = _convert_table(links[name], LinkInertia, link_path)
        if not inertia.list_given_keys():
            keys = ", ".join(field_names(LinkInertia))
            raise ScenarioError(f"is empty: give at least one of {keys}", path=link_path)
    return links


def _convert_table(table: TomlTable, kind: type[T], path: str) -> T:
    """Converts a table to a struct of a given type.

    Raises:
        ScenarioError: A value has a wrong type or range. The error contains the path of its
            key.
    """
    try:
        return msgspec.convert(table, kind)
    except msgspec.ValidationError as error:
        problem, key = split_refusal(error)
        raise ScenarioError(reword_problem(problem), path=f"{path}.{key.strip('.')}") from None


def _list_joint_names(arm_table: TomlTable, urdf_texts: dict[str, str]) -> tuple[str, ...]:
    """Returns the names of an arm's joints. Empty for the planar arm."""
    if not arm_table.get("urdf"):
        return ()
    chain = read_arm(msgspec.convert(arm_table, Arm), urdf_texts)
    return tuple(joint.name for joint in chain.joints)


_BELONGS_TO_CHAIN = "belongs to an arm with a urdf, but this arm is planar"


def _model_arm(
    table: TomlTable,
    task_table: TomlTable,
    urdf_texts: dict[str, str],
    chains: bool,
    path: str,
) -> ArmModel | None:
    """Returns the model of an arm, which knows the dynamics and the number of joints.

    A planar arm is not needed for the resolution itself. If its tables contain a wrong value,
    the result is None, and `validate.build_scenario` refuses the value later with a better
    message.

    Args:
        table: Table of the arm.
        task_table: Table `task` of the site: the coordinates that the sites share.
        urdf_texts: Texts of the URDF files, by name.
        chains: Whether the arms of the scenario are general chains of joints.
        path: Path of the arm's table, for error messages.

    Raises:
        ScenarioError: The model needs a key that is wrong, or a key belongs to another kind of
            arm.
    """
    try:
        arm = msgspec.convert(table, Arm)
    except msgspec.ValidationError:
        if not (table.get("urdf") or chains):
            return None
        arm = _convert_table(table, Arm, path)
    _check_arm_keys(arm, table, chains, path)

    task_path = f"{path.removesuffix('arm')}task"
    try:
        task = msgspec.convert(task_table, Task)
    except msgspec.ValidationError:
        if any(map(is_distribution, task_table.values())):
            return None
        # The conversion is repeated, because it raises a readable error.
        task = _convert_table(task_table, Task, task_path)
    unused_key = task.find_idle_key(task_table)
    if unused_key is not None:
        raise ScenarioError(unused_key.problem, path=f"{task_path}.{unused_key.key}")

    try:
        return build_arm(arm, task, urdf_texts, chains)
    except ScenarioError as error:
        if not arm.urdf:
            return None
        raise ScenarioError(error.problem, path=f"{path}.{error.path or 'urdf'}") from None


def _check_arm_keys(arm: Arm, table: TomlTable, chains: bool, path: str) -> None:
    """Refuses keys that belong to another kind of arm, and gravity without a direction.

    Args:
        arm: The arm.
        table: Table from which the arm was built. It shows which keys the author wrote.
        chains: Whether the arms of the scenario are general chains of joints.
        path: Path of the table, for error messages.
    """
    foreign_keys = ArmLinks._fields if arm.urdf else CHAIN_KEYS
    for key in table:
        if key in foreign_keys:
            problem = _BELONGS_TO_CHAIN
            if arm.urdf:
                problem = f"belongs to the planar arm, but this arm is {arm.urdf}"
            raise ScenarioError(problem, path=f"{path}.{key}")
    for key in BASE_KEYS:
        if key in table and not chains:
            raise ScenarioError(
                "has no effect where all arms are planar and share joint angles: "
                "set task.space, or leave this key out",
                path=f"{path}.{key}",
            )
    if sum(abs(component) for component in arm.down) < _MIN_DOWN_LENGTH:
        raise ScenarioError("must be a vector other than zero", path=f"{path}.down")


def _check_counts(site: TomlTable, counts: VectorCounts, path: str) -> None:
    """Refuses vectors of a site that have too few or too many numbers.

    Args:
        site: Resolved table of the site.
        counts: Number of joints of the arm, and number of coordinates that the sites share.
        path: Path of the site, for error messages.
    """
    law = site["control"].get("law", _DEFAULT_LAW)
    tables: list[tuple[TomlTable, type[Frozen], str]] = [
        (site, SiteSpec, path),
        (site["arm"], Arm, f"{path}.arm"),
        (site["task"], Task, f"{path}.task"),
    ]
    if law in LAWS:
        tables.append((site["control"], LAWS[law], f"{path}.control"))
    for table, kind, table_path in tables:
        problem = find_count_problem(table, kind, counts)
        if problem is not None:
            raise ScenarioError(problem.problem, path=f"{table_path}.{problem.key}")
    for key, value in site["limits"].items():
        length = counts.joints
        owner = f"the arm has {count_nouns(counts.joints, 'joint')}"
        if key == "qd_des_limit_rad_s":
            length = counts.shared
            owner = f"sites share {count_nouns(counts.shared, 'coordinate')}"
        if isinstance(value, str | bool | dict):
            each = "coordinate that the sites share" if key == "qd_des_limit_rad_s" else "joint"
            raise ScenarioError(
                describe_wrong_type(value, f"a number, or a list with one for each {each}"),
                path=f"{path}.limits.{key}",
            )
        if isinstance(value, list | tuple) and len(value) != length:
            raise ScenarioError(
                f"has {count_nouns(len(value), 'number')}, and {owner}",
                path=f"{path}.limits.{key}",
            )


def find_row_problem(row: Array, site: int) -> str | None:
    """Returns the reason why a row of the dominance matrix is not valid, Eq. (7).

    The row contains the weights with which one site follows the others. They must lie between 0
    and 1 and sum to 1, and the site must not follow itself.

    Args:
        row: Dominance factors of one site, shape (N,).
        site: Index of that site.

    Returns:
        A clause for an error message. None if the row is valid.
    """
    if not np.isfinite(row).all():
        return "shares must be finite numbers"
    if row[site] != 0.0:
        return f"a site does not follow itself, yet its own share is {row[site]:g}"
    if (row < 0.0).any() or (row > 1.0).any():
        return "shares must lie between 0 and 1"
    if abs(row.sum() - 1.0) > ROW_SUM_TOLERANCE:
        return f"shares must sum to 1, Eq. (7), and sum to {row.sum():.12g}"
    return None


def resolve_dominance_row(written: Any, names: list[str], site: str, path: str) -> TomlTable:
    """Returns the dominance factors of a site: the weights with which it follows its peers.

    Args:
        written: Row as its author wrote it. A peer that it does not name has the factor 0.
        names: Names of all sites of the scenario.
        site: Name of the site that follows.
        path: Path of the row, for error messages.

    Returns:
        The factor of every peer, by name.

    Raises:
        ScenarioError: A factor is not a number, or the row as a whole is not valid.
    """
    row = check_keys(written, names, path)
    for peer, factor in row.items():
        if not is_number(factor):
            raise ScenarioError(f"must be a number, but is {factor!r}", path=f"{path}.{peer}")

    factors = {name: float(row.get(name, 0.0)) for name in names}
    row_vector = np.array(list(factors.values()))
    problem = find_row_problem(row_vector, names.index(site))
    if problem:
        raise ScenarioError(problem, path=path)
    del factors[site]
    return factors


def _resolve_links(tables: TomlTable, names: list[str], folder: Path | None) -> TomlTable:
    """Returns the complete table of every link, from the tables `link` and `links`.

    A link is the directed connection from a peer to a site. The table `link` applies to all
    links, and the table `links` contains exceptions by name, for example "m1->s".

    Args:
        tables: Tables of the scenario file.
        names: Names of all sites, between which there are links.
        folder: Folder of the files of delays that links name. None refuses every file.
    """
    link_names = [f"{peer}->{site}" for site in names for peer in names if peer != site]
    link_paths = [key for key in _list_group_paths() if key.startswith("link.")]
    written = check_keys(tables.get("links", {}), link_names, "links", link_paths)
    default = _resolve_link(tables.get("link", {}), {}, "link")
    links: TomlTable = {}
    for name in link_names:
        path = f"links.{name}"
        local_table = written.get(name, {})
        link = _resolve_link(local_table, default, path)
        has_default_file = "file" in default and "file" not in local_table
        links[name] = _complete_link(
            link=link,
            name=name,
            path=path,
            folder=folder,
            trace_path="link" if has_default_file else path,
        )
    return links


def _resolve_views(sites: TomlTable, folder: Path | None) -> None:
    """Completes the table `view` of each site that has one, in place.

    A view is the delay with which the user of a site sees the other arms. It has the keys of a
    link, but does not inherit any from the table `link`.
    """
    for name, site in sites.items():
        if "view" in site:
            path = f"sites.{name}.view"
            link = _resolve_link(site["view"], {}, path)
            site["view"] = _complete_link(link, name, path, folder)


def _complete_link(
    link: TomlTable, name: str, path: str, folder: Path | None, trace_path: str = ""
) -> TomlTable:
    """Returns a link with the delays from its file, and with the keys that follow from others.

    Args:
        link: Table of the link.
        name: Name of the link, by which a log stores its delays.
        path: Path of the link, for error messages.
        folder: Folder of the file. None refuses a link that names a file.
        trace_path: Path of the table that names the file. Empty for a view: its file is named
            at `path`, and no key can come from the table `link`.

    Raises:
        ScenarioError: A key is missing, or the file cannot be used.
    """
    if link["model"] == "trace":
        link = _read_trace_file(link, name, trace_path or path, folder)
    kind = DELAY_MODELS[link["model"]]
    link = {**kind.derive_keys(link), **link}
    for field in list_fields(kind):
        if field.required and field.name not in link:
            advice = "; give it here or in [link]" if trace_path else ""
            raise ScenarioError(f"is missing{advice}", path=f"{path}.{field.name}")
    return link


def _list_link_paths(written: TomlTable, path: str) -> list[str]:
    """Returns the paths that the author of the common settings of links may have meant.

    The settings of one link stand in the table `links`, those of all links in the table `link`.

    Args:
        written: Settings as the author wrote them.
        path: Path of the settings.
    """
    return [f"links.{key}" for key in written if path == "link" and "->" in key]


def _resolve_link(written: Any, base: TomlTable, path: str) -> TomlTable:
    """Completes the settings of a link with defaults.

    A link is the one-way network connection between two sites, the processes of the arms. The
    source of settings that its author left out depends on what the author wrote:

    - If the link names a preset, they are taken from the preset.
    - If it names only a delay model, no other settings are taken over, because each model has
      its own.
    - Otherwise they are taken from the common settings of all links.

    Files with recorded delays are not read here.

    Args:
        written: Settings of the link as the author wrote them.
        base: Common settings of all links, completed.
        path: Path of the settings in the scenario, for error messages.

    Raises:
        ScenarioError: There is no such preset, model or key, or the preset has another model.
    """
    if not isinstance(written, dict):
        raise ScenarioError("must be a table", path=path)
    defaults = {} if "model" in written else base
    if "preset" in written:
        check_choice(written["preset"], list(PRESETS), f"{path}.preset")
        defaults = PRESETS[written["preset"]]

    model = written.get("model", defaults.get("model", "constant"))
    check_choice(model, list(DELAY_MODELS), f"{path}.model")
    if model != defaults.get("model", model):
        conflict = f"the preset {written['preset']!r} is {defaults['model']!r}"
        raise ScenarioError(
            f"is {model!r}, but {conflict}: give only one of the two", path=f"{path}.model"
        )

    file_keys = TRACE_KEYS if model == "trace" else ()
    valid_keys = ("model", "preset", *field_names(DELAY_MODELS[model]), *file_keys)
    model_keys = {name: field_names(kind) for name, kind in DELAY_MODELS.items()}
    model_keys["trace"] = (*model_keys["trace"], *TRACE_KEYS)
    _check_kind_keys(written, valid_keys, path, f"model {model}", model_keys)
    local_table = check_keys(written, valid_keys, path, _list_link_paths(written, path))

    # Delays that are written out replace the file of the defaults, and a file replaces delays.
    replaced_keys: tuple[str, ...] = ()
    if "trace" in local_table:
        replaced_keys = TRACE_KEYS
    elif "file" in local_table:
        replaced_keys = ("trace",)
    inherited = {key: value for key, value in defaults.items() if key not in replaced_keys}
    link = {**inherited, **local_table, "model": model}
    link.pop("preset", None)
    return link


def _read_trace_file(link: TomlTable, name: str, path: str, folder: Path | None) -> TomlTable:
    """Returns a link with the delays from its file in place of the keys that name the file.

    The file is a table of times and delays, or a log. From a log, the delays of the link `of`
    are taken, by default those of the link with the same name.

    Args:
        link: Table of the link. It is not changed.
        name: Name of the link.
        path: Path of the table that names the file, for error messages.
        folder: Folder of the file. None refuses every file.

    Raises:
        ScenarioError: The keys contradict each other, or the file cannot be used.
    """
    link = dict(link)
    file = link.pop("file", None)
    log_link = link.pop("of", None)
    if "trace" in link and file is not None:
        raise ScenarioError("give either trace or file, not both", path=f"{path}.file")
    if "trace" not in link and file is None:
        raise ScenarioError("is missing; name a table or a log of delays", path=f"{path}.file")
    if file is None:
        if log_link is not None:
            raise ScenarioError(
                "needs the key file, which must name the log that contains this link",
                path=f"{path}.of",
            )
        return link
    if folder is None:
        raise ScenarioError("no file may be named here", path=f"{path}.file")
    try:
        link["trace"] = read_trace(_find_file(str(file), folder), str(log_link or name))
    except ScenarioError as error:
        raise ScenarioError(error.problem, path=f"{path}.file") from None
    return link


def _resolve_timeline(written: Any, links: TomlTable, names: list[str]) -> list[TomlTable]:
    """Returns the planned changes of a scenario, each complete in itself.

    A change affects a link or the dominance factors of a site. An author may state only those
    keys of a link that change. In the result, each change states the whole link: the other keys
    have the values that the earlier changes left.

    Args:
        written: List `timeline` as its author wrote it.
        links: Resolved links at the start of the run, by name.
        names: Names of all sites of the scenario.

    Raises:
        ScenarioError: A change is not valid, or the changes are not in the order of their
            times.
    """
    if not isinstance(written, list):
        raise ScenarioError("must be a list of tables [[timeline]]", path="timeline")
    current_links = dict(links)
    changes = []
    previous_s = 0.0
    for n, entry in enumerate(written):
        path = f"timeline[{n}]"
        change = dict(check_keys(entry, TIMELINE_KEYS, path))

        at_s = change.get("at_s")
        if not is_number(at_s):
            raise ScenarioError("must be a time in s", path=f"{path}.at_s")
        if at_s < previous_s:
            raise ScenarioError(
                f"must not be earlier than the previous change, at {previous_s:g} s",
                path=f"{path}.at_s",
            )
        previous_s = at_s

        names_both_or_neither = ("link" in change) == ("dominance" in change)
        if names_both_or_neither:
            raise ScenarioError(
                "must name either a link (link = ...) or a site (dominance = ...)", path=path
            )
        for key in ("link", "dominance"):
            if not isinstance(change.get(key, ""), str):
                raise ScenarioError(
                    f"must be a name, but is {change[key]!r}", path=f"{path}.{key}"
                )

        change["to"] = resolve_target(change, current_links, names, path)
        if "link" in change:
            current_links[change["link"]] = change["to"]
        changes.append(change)
    return changes


def resolve_target(
    change: TomlTable, current_links: TomlTable, names: list[str], path: str
) -> TomlTable:
    """Completes the new settings that a change during a run states.

    A change concerns a link, which is the one-way connection between two sites (the processes
    of the arms), or the weights with which one site follows the others.

    Args:
        change: The change. It contains the key `link` or `dominance`, and the new settings.
        current_links: Settings of all links before the change, by name.
        names: Names of all sites of the scenario.
        path: Path of the change, for error messages.

    Returns:
        All settings of the link after the change, or the weights for all other sites.

    Raises:
        ScenarioError: There is no such link or site, or a value is not valid.
    """
    written = change.get("to", {})
    if "link" in change:
        return _change_link(written, change["link"], current_links, path)
    site = change["dominance"]
    if site not in names:
        hint = suggest_nearest(site, names) or f"; the sites are {', '.join(names)}"
        raise ScenarioError(f"there is no site {site!r}{hint}", path=f"{path}.dominance")
    return resolve_dominance_row(written, names, site, f"{path}.to")


def _change_link(written: Any, link: str, current_links: TomlTable, path: str) -> TomlTable:
    """Returns the complete table of a link after a change.

    A change may neither read a file nor move the outages of the link. It may not replace one
    table of recorded delays by another.

    Args:
        written: Table `to` of the change, with the keys that change.
        link: Name of the link.
        current_links: Links before the change, by name.
        path: Path of the change, for error messages.
    """
    if link not in current_links:
        names = list(current_links)
        hint = suggest_nearest(link, names) or f"; the links are {', '.join(names)}"
        raise ScenarioError(f"there is no link {link!r}{hint}", path=f"{path}.link")

    before = current_links[link]
    after = _resolve_link(written, before, f"{path}.to")
    if any(key in after for key in TRACE_KEYS):
        raise ScenarioError("no file can be named here", path=f"{path}.to.file")
    if after["model"] == "trace" and after.get("trace") != before.get("trace"):
        raise ScenarioError("a run cannot change to another trace", path=f"{path}.to.model")
    if "outages_s" in written and written["outages_s"] != before.get("outages_s"):
        raise ScenarioError(
            "belongs to [links]; outages cannot be changed during a run",
            path=f"{path}.to.outages_s",
        )

    after = {**DELAY_MODELS[after["model"]].derive_keys(after), **after}
    if "outages_s" in before:
        after["outages_s"] = before["outages_s"]
    return after
