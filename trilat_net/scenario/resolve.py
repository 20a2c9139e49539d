"""Resolve an author's tables into a complete scenario: defaults, presets, key checks.

`resolve_scenario` writes out every default, joins the tables of all sites with those of each
site, draws the numbers that are given as distributions, reads the files that the scenario
names (URDF files, delay traces), and checks names and keys. `validate.build_scenario` then
turns the result into types and checks ranges.

Invariant:
    - A key is checked in the table in which its author wrote it, so that the path in an error
      is a path that the author finds in the file.
    - A preset is a table that an author could have written; `scenarios/_presets.toml` contains
      the presets with their sources. A resolved scenario holds the keys of a preset, not its
      name.
"""

import math
import re
import tomllib
from importlib import resources
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import numpy as np

from ..core import dominance
from ..core.two_link_arm import ArmLinks
from ..errors import ScenarioError, count_nouns
from ..fields import (
    Frozen,
    TomlTable,
    VectorCounts,
    check_choice,
    check_finite,
    check_keys,
    expand_vectors,
    field_names,
    find_count_problem,
    is_distribution,
    is_number,
    reword_problem,
    split_refusal,
    suggest_nearest,
)
from ..files import open_regular
from ..laws.sent_vectors import read_sends
from .arms import BASE_KEYS, CHAIN_KEYS, Arm, ArmModel, Task, build_arm, read_arm
from .delay_models import DELAY_MODELS
from .delay_traces import read_trace
from .distributions import Draws
from .expect import Expect, number_window_joints
from .imported_code import CLASS_PATTERN, read_code
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
"""A gravity direction whose components sum to less than this has no direction."""
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
"""Keys of a link by the name of the preset.

A preset of the grid delays each direction by half of the round trip and loses samples
independently of each other.
"""

TRACE_KEYS = ("file", "of")
"""Keys with which an author names the source of a trace; a resolved link has the trace."""


def resolve_scenario(tables: TomlTable, folder: Path | None) -> TomlTable:
    """Returns an author's tables with every default written out, in the shape of `Scenario`.

    Args:
        tables: the author's tables.
        folder: the folder of the files that the tables name; None: they may not name any file.

    Raises:
        ScenarioError: a key is unknown, missing or wrong, with its path.
    """
    _check_top_level(tables)
    draws = Draws(tables.get("seed", _DEFAULT_SEED), tables.get("drawn", {}))
    urdf_texts = _read_urdf_files(tables, folder)
    sites = _resolve_sites(tables, draws, urdf_texts)
    site_names = list(sites)
    expect = _resolve_expect(tables.get("expect", {}), sites, urdf_texts)
    dominance_rows = _resolve_dominance(tables["dominance"], site_names)
    links = resolve_links(tables, site_names, folder)
    _resolve_views(sites, folder)
    top_level = {
        key: _use_unix_line_ends(tables[key])
        for key in _TOP_LEVEL_KEYS
        if key in tables and key != "rate_hz"
    }
    used_files = [site["arm"].get("urdf") for site in sites.values()]
    return {
        "duration_s": 20.0,
        "seed": _DEFAULT_SEED,
        "scheme": "second_order",
        **top_level,
        "sites": sites,
        "dominance": dominance_rows,
        "links": links,
        "timeline": resolve_timeline(tables.get("timeline", []), links, site_names),
        "expect": expect,
        "drawn": msgspec.to_builtins(draws.drawn),
        "urdf": {name: text for name, text in urdf_texts.items() if name in used_files},
    }


def _check_top_level(tables: TomlTable) -> None:
    """Checks the keys of the whole scenario and those of its tables for all sites."""
    check_keys(tables, _TOP_LEVEL_KEYS + _TABLES, "")
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
    """Returns the expectations, with numbers in place of the names of joints in windows."""
    expect = dict(written)
    if "windows" in expect:
        joint_names = {
            name: _list_joint_names(site["arm"], urdf_texts) for name, site in sites.items()
        }
        expect["windows"] = number_window_joints(expect["windows"], joint_names)
    return expect


def _resolve_dominance(written: Any, site_names: list[str]) -> TomlTable:
    """Returns the rows of the dominance matrix by site."""
    table = check_keys(written, site_names, "dominance")
    rows = {}
    for name in site_names:
        path = f"dominance.{name}"
        if name not in table:
            raise ScenarioError("is missing: whom does this site follow?", path=path)
        rows[name] = resolve_dominance_row(table[name], site_names, name, path)
    return rows


def _read_urdf_files(tables: TomlTable, folder: Path | None) -> dict[str, str]:
    """Returns the text of every URDF file that an arm names, by the name of the file.

    A text in the table `urdf` of the scenario comes first, then a shipped file, then a file in
    `folder`.
    """
    embedded = check_keys(tables.get("urdf", {}), list(tables.get("urdf", {})), "urdf")
    for name, text in embedded.items():
        if not isinstance(text, str):
            raise ScenarioError("must be the text of a URDF", path=f"urdf.{name}")
    sites = tables["sites"] if isinstance(tables["sites"], dict) else {}
    arms = {"arm": tables.get("arm")}
    for site_name, site in sites.items():
        if isinstance(site, dict):
            arms[f"sites.{site_name}.arm"] = site.get("arm")
    texts: dict[str, str] = {}
    for path, arm in arms.items():
        name = arm.get("urdf", "") if isinstance(arm, dict) else ""
        if not isinstance(name, str):
            raise ScenarioError("must be a file's name", path=f"{path}.urdf")
        if name and name not in texts:
            text = embedded[name] if name in embedded else _read_urdf(name, folder, path)
            texts[name] = _use_unix_line_ends(text)
    return texts


def _read_urdf(name: str, folder: Path | None, path: str) -> str:
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
    """Returns the shipped file of a plain name, else the file in `folder`."""
    shipped = Path(str(SHIPPED_FOLDER / name))
    is_plain_name = "/" not in name and "\\" not in name
    return shipped if is_plain_name and shipped.is_file() else folder / name


def _resolve_control(
    written: Any, default: TomlTable, path: str, counts: VectorCounts
) -> TomlTable:
    """Returns a law and its gains; missing gains come from a default of the same law."""
    if not isinstance(written, dict):
        raise ScenarioError("must be a table", path=path)
    default_law = default.get("law", _DEFAULT_LAW)
    law = str(written.get("law", default_law))
    if ":" in law:
        return _resolve_user_law(law, written, default, path)
    check_choice(law, [*LAWS, "package.module:Law"], f"{path}.law")
    gains = check_keys(written, ("law", *field_names(LAWS[law])), path)
    inherited = default if default_law == law else {}
    return expand_vectors({**inherited, **gains, "law": law}, LAWS[law], counts)


def _resolve_user_law(
    code: str, written: TomlTable, default: TomlTable, path: str
) -> TomlTable:
    """Returns the table of a user's law, with the hash of its file and its sent vectors."""
    if not re.fullmatch(CLASS_PATTERN, code):
        problem = f"must be as in package.module:Law, is {code!r}"
        raise ScenarioError(problem, path=f"{path}.law")
    inherited = default if default.get("law") == code else {}
    settings = {**inherited, **written}
    settings.pop("law", None)
    if "settings" in settings:
        raise ScenarioError(
            "the settings of a user's law stand next to its name, as in control.gain = 5",
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
    """Returns a text, or each text in a list, with the line ends that TOML keeps."""
    if isinstance(value, list):
        return [_use_unix_line_ends(entry) for entry in value]
    if isinstance(value, str):
        return value.replace("\r\n", "\n").replace("\r", "\n")
    return value


def _resolve_sites(tables: TomlTable, draws: Draws, urdf_texts: dict[str, str]) -> TomlTable:
    """Returns the complete table of every site."""
    if not isinstance(tables["sites"], dict):
        raise ScenarioError("must be tables [sites.NAME]", path="sites")
    site_tables = {
        name: _join_site_groups(name, site, tables) for name, site in tables["sites"].items()
    }
    if len(site_tables) > MAX_SITES:
        raise ScenarioError(
            f"has {count_nouns(len(site_tables), 'site')}, at most {MAX_SITES} are allowed",
            path="sites",
        )
    if len(site_tables) < 2:
        raise ScenarioError(
            f"an experiment has at least two sites, this one has {len(site_tables)}",
            path="sites",
        )
    # If one arm is a chain, all arms are: every run computes with the same leaves.
    chains = any(
        site["arm"].get("urdf") or site["task"].get("space", "joints") != "joints"
        for site in site_tables.values()
    )
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
    """Returns a site's table in which each group is joined with the table of all sites."""
    path = f"sites.{name}"
    if not _SITE_NAME.fullmatch(name) or name in _RESERVED_NAMES:
        raise ScenarioError(
            "a site's name is lower-case letters, digits and _, beginning with a letter, "
            f"and not {_RESERVED_NAMES[0]!r}",
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
    """Returns a site's table of a group, with the keys that only the table of all sites has.

    The inertias in the table `links` of an arm are joined link by link and key by key.
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

    Args:
        name: the name of the site.
        site: its table, joined with the tables of all sites.
        tables: the tables of the scenario.
        draws: draws the numbers that are given as distributions.
        urdf_texts: the texts of URDF files, by name.
        chains: whether the arms of the scenario are chains.
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
        if model is None or not all(map(is_number, site["q0_rad"])):
            return [0.0] * counts.axes
        return model.end_effector(site["q0_rad"])

    held_arm = HeldArm(counts, site["q0_rad"], locate_end_effector, draws)
    for group, kinds in (("hands", OPERATORS), ("environment", ENVIRONMENTS)):
        actors = site.get(group, [])
        site[group] = resolve_operators(actors, kinds, held_arm, f"{path}.{group}")
    return {key: site[key] for key in field_names(SiteSpec) if key in site}


def _list_default_limits(site: TomlTable, model: ArmModel | None) -> TomlTable:
    """Returns the limits of a site that follow from its arm's file and from its stale rule."""
    limits: TomlTable = {}
    if site["on_stale"].get("action") == "glide" and site.get("plant") != "external":
        limits["tau_rate_limit_nm_s"] = GLIDE_TAU_RATE_NM_S
    if model is None or model.chain is None:
        return limits
    for key, stated_limits in (
        ("tau_limit_nm", model.efforts),
        ("qd_limit_rad_s", model.speeds),
    ):
        default = getattr(Limits(), key)
        limits[key] = [limit if 0.0 < limit < math.inf else default for limit in stated_limits]
    return limits


def _draw_site_numbers(site: TomlTable, draws: Draws, path: str) -> None:
    """Draws the start, the limits, the rules, the task and the gains of a site, in place.

    The order of the draws decides the order of keys in the table `drawn`.
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
    """Returns the complete table of an arm, and its model or None, see `_model_arm`.

    The table `links` and the armature are resolved apart: the table holds tables instead of
    numbers, and the armature has one number per joint, which only the model knows.
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
    """Returns the masses and inertias that an arm gives its links, drawn and checked."""
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
            raise ScenarioError(f"is empty: give {keys}", path=link_path)
    return links


def _convert_table(table: TomlTable, kind: type[T], path: str) -> T:
    """Returns the struct of a table.

    Raises:
        ScenarioError: a value is refused, with the path of its key below `path`.
    """
    try:
        return msgspec.convert(table, kind)
    except msgspec.ValidationError as error:
        problem, key = split_refusal(error)
        raise ScenarioError(reword_problem(problem), path=f"{path}.{key.strip('.')}") from None


def _list_joint_names(arm_table: TomlTable, urdf_texts: dict[str, str]) -> tuple[str, ...]:
    """Returns the names of an arm's joints; () for the planar arm."""
    if not arm_table.get("urdf"):
        return ()
    chain = read_arm(msgspec.convert(arm_table, Arm), urdf_texts)
    return tuple(joint.name for joint in chain.joints)


_BELONGS_TO_CHAIN = "belongs to an arm with a urdf, and this one is planar"


def _model_arm(
    table: TomlTable,
    task_table: TomlTable,
    urdf_texts: dict[str, str],
    chains: bool,
    path: str,
) -> ArmModel | None:
    """Returns the model of an arm, or None if validation will refuse a key of its tables.

    Raises:
        ScenarioError: the model needs a key that is wrong, or a key belongs to another kind of
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
        task = _convert_table(task_table, Task, task_path)
    idle = task.find_idle_key(task_table)
    if idle is not None:
        raise ScenarioError(idle.problem, path=f"{task_path}.{idle.key}")
    try:
        return build_arm(arm, task, urdf_texts, chains)
    except ScenarioError as error:
        if not arm.urdf:
            return None
        raise ScenarioError(error.problem, path=f"{path}.{error.path or 'urdf'}") from None


def _check_arm_keys(arm: Arm, table: TomlTable, chains: bool, path: str) -> None:
    """Refuses keys that the kind of arm does not have, and gravity without a direction."""
    foreign_keys = ArmLinks._fields if arm.urdf else CHAIN_KEYS
    for key in table:
        if key in foreign_keys:
            problem = _BELONGS_TO_CHAIN
            if arm.urdf:
                problem = f"belongs to the planar arm, and this one is {arm.urdf}"
            raise ScenarioError(problem, path=f"{path}.{key}")
    for key in BASE_KEYS:
        if key in table and not chains:
            raise ScenarioError(
                "has no effect where all arms are planar and share joint angles: "
                "set task.space, or leave it out",
                path=f"{path}.{key}",
            )
    if sum(abs(component) for component in arm.down) < _MIN_DOWN_LENGTH:
        raise ScenarioError("must point somewhere, is zero", path=f"{path}.down")


def _check_counts(site: TomlTable, counts: VectorCounts, path: str) -> None:
    """Refuses vectors of a site that have too few or too many numbers."""
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
        if isinstance(value, list) and len(value) != length:
            raise ScenarioError(
                f"has {count_nouns(len(value), 'number')}, and {owner}",
                path=f"{path}.limits.{key}",
            )


def resolve_dominance_row(written: Any, names: list[str], site: str, path: str) -> TomlTable:
    """Returns a site's row of the dominance matrix, checked, with the factor of every peer."""
    row = check_keys(written, names, path)
    for peer, factor in row.items():
        if not is_number(factor):
            raise ScenarioError(f"must be a number, is {factor!r}", path=f"{path}.{peer}")
    factors = {name: float(row.get(name, 0.0)) for name in names}
    problem = dominance.find_row_problem(np.array(list(factors.values())), names.index(site))
    if problem:
        raise ScenarioError(problem, path=path)
    del factors[site]
    return factors


def resolve_links(tables: TomlTable, names: list[str], folder: Path | None) -> TomlTable:
    """Returns every link, complete, from the tables [link] and [links].

    Args:
        tables: the tables of the scenario.
        names: the names of the sites.
        folder: the folder of the files of traces; None: no file may be named.
    """
    link_names = [f"{peer}->{site}" for site in names for peer in names if peer != site]
    written = check_keys(tables.get("links", {}), link_names, "links")
    default = resolve_link(tables.get("link", {}), {}, "link")
    links: TomlTable = {}
    for name in link_names:
        path = f"links.{name}"
        local_table = written.get(name, {})
        link = resolve_link(local_table, default, path)
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
    """Completes the table `view` of each site that has one, in place."""
    for name, site in sites.items():
        if "view" in site:
            path = f"sites.{name}.view"
            link = resolve_link(site["view"], {}, path)
            site["view"] = _complete_link(link, name, path, folder)


def _complete_link(
    link: TomlTable, name: str, path: str, folder: Path | None, trace_path: str = ""
) -> TomlTable:
    """Returns a link with the trace from its file and the keys that follow from others.

    Args:
        link: the table of the link.
        name: the name of the link, by which a log stores its delays.
        path: the path of the link in errors.
        folder: the folder of the file; None: no file may be named.
        trace_path: the path of the table that names the file; "": it is `path`, and there is
            no table [link] from which a missing key could come.

    Raises:
        ScenarioError: a key is missing, or the file cannot be used.
    """
    if link["model"] == "trace":
        link = _read_trace_file(link, name, trace_path or path, folder)
    kind = DELAY_MODELS[link["model"]]
    link = {**kind.derive_keys(link), **link}
    for field in msgspec.structs.fields(kind):
        if field.required and field.name not in link:
            advice = "; give it here or in [link]" if trace_path else ""
            raise ScenarioError(f"is missing{advice}", path=f"{path}.{field.name}")
    return link


def resolve_link(written: Any, base: TomlTable, path: str) -> TomlTable:
    """Returns a link: its written keys, and all other keys from its base.

    A link that names a preset takes the other keys from the preset, and a link that names a
    model takes none. The file of a trace is not read yet.

    Args:
        written: the table of the link as its author wrote it.
        base: a resolved link.
        path: the path of the table in errors.
    """
    if not isinstance(written, dict):
        raise ScenarioError("must be a table", path=path)
    start = {} if "model" in written else base
    if "preset" in written:
        check_choice(written["preset"], list(PRESETS), f"{path}.preset")
        start = PRESETS[written["preset"]]
    model = written.get("model", start.get("model", "constant"))
    check_choice(model, list(DELAY_MODELS), f"{path}.model")
    if model != start.get("model", model):
        conflict = f"the preset {written['preset']!r} is {start['model']!r}"
        raise ScenarioError(
            f"is {model!r}, but {conflict}: give one of the two", path=f"{path}.model"
        )
    file_keys = TRACE_KEYS if model == "trace" else ()
    valid_keys = ("model", "preset", *field_names(DELAY_MODELS[model]), *file_keys)
    local_table = check_keys(written, valid_keys, path)
    # A trace replaces the file of the base, and a file replaces its trace.
    replaced_keys: tuple[str, ...] = ()
    if "trace" in local_table:
        replaced_keys = TRACE_KEYS
    elif "file" in local_table:
        replaced_keys = ("trace",)
    kept = {key: value for key, value in start.items() if key not in replaced_keys}
    link = {**kept, **local_table, "model": model}
    link.pop("preset", None)
    return link


def _read_trace_file(link: TomlTable, name: str, path: str, folder: Path | None) -> TomlTable:
    """Returns a link with the trace from its file in place of the keys that name the file.

    If the file is a log, the trace is that of the log's link `of`, by default the link `name`.
    """
    link = dict(link)
    file = link.pop("file", None)
    log_link = link.pop("of", None)
    if "trace" in link and file is not None:
        raise ScenarioError("give either trace or file", path=f"{path}.file")
    if "trace" not in link and file is None:
        raise ScenarioError("is missing: a table or a log of delays", path=f"{path}.file")
    if file is None:
        if log_link is not None:
            raise ScenarioError("names a link of the log that file names", path=f"{path}.of")
        return link
    if folder is None:
        raise ScenarioError("no file may be named here", path=f"{path}.file")
    try:
        link["trace"] = read_trace(_find_file(str(file), folder), str(log_link or name))
    except ScenarioError as error:
        raise ScenarioError(error.problem, path=f"{path}.file") from None
    return link


def resolve_timeline(written: Any, links: TomlTable, names: list[str]) -> list[TomlTable]:
    """Returns the changes of the timeline, each complete in itself.

    A change of a link states the whole link: keys that it leaves out are those after the
    changes before it.

    Args:
        written: the author's list of changes.
        links: the links at the start, resolved, by name.
        names: the names of the sites.
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
                f"must not be before the change above it, {previous_s:g} s",
                path=f"{path}.at_s",
            )
        previous_s = at_s
        if ("link" in change) == ("dominance" in change):
            raise ScenarioError("names either a link or, as dominance, a site", path=path)
        for key in ("link", "dominance"):
            if not isinstance(change.get(key, ""), str):
                raise ScenarioError(f"must be a name, is {change[key]!r}", path=f"{path}.{key}")
        change["to"] = resolve_target(change, current_links, names, path)
        if "link" in change:
            current_links[change["link"]] = change["to"]
        changes.append(change)
    return changes


def resolve_target(
    change: TomlTable, current_links: TomlTable, names: list[str], path: str
) -> TomlTable:
    """Returns the complete link, or row of the dominance matrix, to which a change leads.

    Args:
        change: the table of the change, with a key `link` or `dominance`.
        current_links: the links before the change, by name.
        names: the names of the sites.
        path: the path of the change in errors.
    """
    written = change.get("to", {})
    if "link" in change:
        return _change_link(written, change["link"], current_links, path)
    site = change["dominance"]
    if site not in names:
        hint = suggest_nearest(site, names) or f"; sites are {', '.join(names)}"
        raise ScenarioError(f"there is no site {site!r}{hint}", path=f"{path}.dominance")
    return resolve_dominance_row(written, names, site, f"{path}.to")


def _change_link(written: Any, link: str, current_links: TomlTable, path: str) -> TomlTable:
    """Returns the complete link after a change of it."""
    if link not in current_links:
        names = list(current_links)
        hint = suggest_nearest(link, names) or f"; links are {', '.join(names)}"
        raise ScenarioError(f"there is no link {link!r}{hint}", path=f"{path}.link")
    before = current_links[link]
    after = resolve_link(written, before, f"{path}.to")
    if any(key in after for key in TRACE_KEYS):
        raise ScenarioError("no file can be named here", path=f"{path}.to.file")
    if after["model"] == "trace" and after.get("trace") != before.get("trace"):
        raise ScenarioError("a run cannot change to another trace", path=f"{path}.to.model")
    if "outages_s" in written and written["outages_s"] != before.get("outages_s"):
        raise ScenarioError("belongs to [links], it cannot change", path=f"{path}.to.outages_s")
    after = {**DELAY_MODELS[after["model"]].derive_keys(after), **after}
    if "outages_s" in before:
        after["outages_s"] = before["outages_s"]
    return after
