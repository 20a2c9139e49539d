"""The step from an author's tables to a complete scenario: defaults, presets, and checks of
keys and names.

Invariant: what a person writes is checked in the shape in which it was written, so the path in
an error is one that the person finds in the file. A preset is a table that an author could have
written (`scenarios/_presets.toml` has them, each with its source); a resolved scenario holds
its keys, not its name.
"""

import math
import re
import tomllib
from importlib import resources
from pathlib import Path
from typing import Any

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
from .operators import ENVIRONMENTS, OPERATORS, Holding, resolve_operators
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

_TOP = ("name", "title", "about", "assumed", "rate_hz", "duration_s", "seed", "scheme")
_TABLES = (
    *SITE_GROUPS,
    "control",
    "link",
    *(key for key in field_names(Scenario) if key not in _TOP),
)
_SITE_NAME = re.compile(r"[a-z][a-z0-9_]{0,31}")
_RESERVED = ("recorder",)
_DEFAULT_SEED = 1
MAX_SITES = 32
"""Most sites of an experiment; every pair of them has two links."""

SHIPPED_FOLDER = resources.files("trilat_net") / "scenarios"
_PRESETS_FILE = SHIPPED_FOLDER / "_presets.toml"

GRID_ROUND_TRIPS_MS = (8, 68, 136, 272, 544, 1088)
GRID_LOSSES_PERCENT = (0, 10, 25, 50)
"""A grid over the ranges of Rodriguez-Seda, Lee and Spong, "Experimental Comparison Study of
Control Architectures for Bilateral Teleoperators", IEEE Trans. Robotics 25 (2009): round trips
of 8 to 1088 ms and losses of 0 to 50 %. The points are ours; theirs are not known to us.
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
"""Keys of a link by the preset's name; those of the grid: half a round trip each way, single
losses.
"""

TRACE_KEYS = ("file", "of")
"""Keys of an author that name the source of a trace; a resolved link has the trace instead."""


def resolve_scenario(tables: TomlTable, folder: Path | None) -> TomlTable:
    """Returns an author's tables with every default written out, in the shape of `Scenario`.

    Files that they name lie in `folder`; None: they may name none.
    """
    check_keys(tables, _TOP + _TABLES, "")
    check_finite(tables, "")
    for required in ("name", "sites", "dominance"):
        if required not in tables:
            raise ScenarioError("is missing", path=required)
    for group, kind in SITE_GROUPS.items():
        check_keys(tables.get(group, {}), field_names(kind), group)
    check_keys(tables.get("expect", {}), field_names(Expect), "expect")
    _resolve_control(tables.get("control", {}), {}, "control", VectorCounts())
    draws = Draws(tables.get("seed", _DEFAULT_SEED), tables.get("drawn", {}))
    urdf = _read_urdf_files(tables, folder)
    sites = _resolve_sites(tables, draws, urdf)
    named = [site["arm"].get("urdf") for site in sites.values()]
    expect = dict(tables.get("expect", {}))
    if "windows" in expect:
        joints = {name: _name_joints(site["arm"], urdf) for name, site in sites.items()}
        expect["windows"] = number_window_joints(expect["windows"], joints)
    written = check_keys(tables["dominance"], list(sites), "dominance")
    rows = {}
    for name in sites:
        if name not in written:
            raise ScenarioError(
                "is missing: whom does this site follow?", path=f"dominance.{name}"
            )
        rows[name] = resolve_dominance_row(
            written[name], list(sites), name, f"dominance.{name}"
        )
    links = resolve_links(tables, list(sites), folder)
    _resolve_views(sites, folder)
    resolved = {
        key: _unix_lines(tables[key]) for key in _TOP if key in tables and key != "rate_hz"
    }
    return {
        "duration_s": 20.0,
        "seed": _DEFAULT_SEED,
        "scheme": "second_order",
        **resolved,
        "sites": sites,
        "dominance": rows,
        "links": links,
        "timeline": resolve_timeline(tables.get("timeline", []), links, list(sites)),
        "expect": expect,
        "drawn": msgspec.to_builtins(draws.drawn),
        "urdf": {name: text for name, text in urdf.items() if name in named},
    }


def _read_urdf_files(tables: TomlTable, folder: Path | None) -> dict[str, str]:
    """Returns the texts of the files that arms name: of the scenario itself, of `folder`, or
    shipped.
    """
    given = check_keys(tables.get("urdf", {}), list(tables.get("urdf", {})), "urdf")
    for name, text in given.items():
        if not isinstance(text, str):
            raise ScenarioError("must be the text of a URDF", path=f"urdf.{name}")
    sites = tables["sites"] if isinstance(tables["sites"], dict) else {}
    arms = {
        f"sites.{name}.arm": site.get("arm")
        for name, site in sites.items()
        if isinstance(site, dict)
    }
    texts: dict[str, str] = {}
    for path, arm in {"arm": tables.get("arm"), **arms}.items():
        name = arm.get("urdf", "") if isinstance(arm, dict) else ""
        if not isinstance(name, str):
            raise ScenarioError("must be a file's name", path=f"{path}.urdf")
        if name and name not in texts:
            texts[name] = _unix_lines(
                given[name] if name in given else _read_urdf(name, folder, path)
            )
    return texts


def _read_urdf(name: str, folder: Path | None, path: str) -> str:
    if folder is None:
        raise ScenarioError("no file may be named here", path=f"{path}.urdf")
    try:
        with open_regular(_find_file(name, folder), encoding="utf-8") as stream:
            text: str = stream.read(MAX_CHARACTERS + 1)
        return text
    except (
        OSError,
        ValueError,
    ) as error:  # of text that is not UTF-8, and of a name with a null
        reason = getattr(error, "strerror", None) or "not UTF-8 text"
        raise ScenarioError(f"{name} cannot be read: {reason}", path=f"{path}.urdf") from None


def _find_file(name: str, folder: Path) -> Path:
    shipped = Path(str(SHIPPED_FOLDER / name))
    return (
        shipped if "/" not in name and "\\" not in name and shipped.is_file() else folder / name
    )


def _resolve_control(
    written: Any, default: TomlTable, path: str, counts: VectorCounts
) -> TomlTable:
    """Returns a law and its gains: as written, and the rest from a default of the same law."""
    if not isinstance(written, dict):
        raise ScenarioError("must be a table", path=path)
    law = str(written.get("law", default.get("law", "adaptive")))
    if ":" in law:
        return _resolve_user_law(law, written, default, path)
    check_choice(law, [*LAWS, "package.module:Law"], f"{path}.law")
    own = check_keys(written, ("law", *field_names(LAWS[law])), path)
    inherited = default if default.get("law", "adaptive") == law else {}
    return expand_vectors({**inherited, **own, "law": law}, LAWS[law], counts)


def _resolve_user_law(
    code: str, written: TomlTable, default: TomlTable, path: str
) -> TomlTable:
    inherited = default if default.get("law") == code else {}
    settings = {key: value for key, value in {**inherited, **written}.items() if key != "law"}
    if not re.fullmatch(CLASS_PATTERN, code):
        raise ScenarioError(
            f"must be as in package.module:Law, is {code!r}", path=f"{path}.law"
        )
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


def _unix_lines(value: Any) -> Any:
    """Returns text with the line ends that TOML keeps; other values unchanged."""
    if isinstance(value, list):
        return [_unix_lines(entry) for entry in value]
    return value.replace("\r\n", "\n").replace("\r", "\n") if isinstance(value, str) else value


def _resolve_sites(tables: TomlTable, draws: Draws, urdf: dict[str, str]) -> TomlTable:
    if not isinstance(tables["sites"], dict):
        raise ScenarioError("must be tables [sites.NAME]", path="sites")
    written: TomlTable = {}
    groups: dict[str, TomlTable] = {}
    for name, table in tables["sites"].items():
        path = f"sites.{name}"
        if not _SITE_NAME.fullmatch(name) or name in _RESERVED:
            raise ScenarioError(
                "a site's name is lower-case letters, digits and _, beginning with a letter, "
                f"and not {_RESERVED[0]!r}",
                path=path,
            )
        written[name] = check_keys(table, field_names(SiteSpec), path)
        groups[name] = {}
        for group, kind in SITE_GROUPS.items():
            own = check_keys(table.get(group, {}), field_names(kind), f"{path}.{group}")
            groups[name][group] = (
                own if "urdf" in own else _join_group(tables.get(group, {}), own)
            )
    if len(written) > MAX_SITES:
        raise ScenarioError(
            f"has {count_nouns(len(written), 'site')}, at most {MAX_SITES} are taken",
            path="sites",
        )
    if len(written) < 2:
        raise ScenarioError(
            f"an experiment has at least two sites, this one has {len(written)}", path="sites"
        )
    chains = any(
        group["arm"].get("urdf") or group["task"].get("space", "joints") != "joints"
        for group in groups.values()
    )
    return {
        name: _resolve_site(
            name=name,
            site={**table, **groups[name]},
            tables=tables,
            draws=draws,
            urdf=urdf,
            chains=chains,
        )
        for name, table in written.items()
    }


def _join_group(shared: TomlTable, own: TomlTable) -> TomlTable:
    """Returns a site's table of a group upon the one of all sites; of `links` link by link, key
    by key.
    """
    joined = {**shared, **own}
    shared_links = shared.get("links")
    own_links = own.get("links")
    if isinstance(shared_links, dict) and isinstance(own_links, dict):
        joined["links"] = {**shared_links, **own_links}
        for name in shared_links.keys() & own_links.keys():
            if isinstance(shared_links[name], dict) and isinstance(own_links[name], dict):
                joined["links"][name] = {**shared_links[name], **own_links[name]}
    return joined


def _resolve_site(
    name: str,
    site: TomlTable,
    tables: TomlTable,
    draws: Draws,
    urdf: dict[str, str],
    chains: bool,
) -> TomlTable:
    """Returns a site's tables, complete; `chains`: the arms of the scenario are chains."""
    path = f"sites.{name}"
    site["arm"], model = _resolve_arm(
        site=site, draws=draws, urdf=urdf, chains=chains, path=f"{path}.arm"
    )
    counts = model.counts if model is not None else VectorCounts()
    site = expand_vectors({"q0_rad": 0.0, "qd0_rad_s": 0.0, **site}, SiteSpec, counts)
    site["control"] = _resolve_control(
        site.get("control", {}), tables.get("control", {}), f"{path}.control", counts
    )
    if model is not None and model.chain is not None:
        pairs = (("tau_limit_nm", model.efforts), ("qd_limit_rad_s", model.speeds))
        usual = {
            key: [one if 0.0 < one < math.inf else getattr(Limits(), key) for one in stated]
            for key, stated in pairs
        }
        site["limits"] = {**usual, **site["limits"]}
    if site["on_stale"].get("action") == "glide" and site.get("plant") != "external":
        site["limits"] = {"tau_rate_limit_nm_s": GLIDE_TAU_RATE_NM_S, **site["limits"]}
    if "plant" in site:
        site["plant"] = resolve_plant(site["plant"], f"{path}.plant")
    site.setdefault("role", "master")
    site.setdefault("rate_hz", tables.get("rate_hz", 1000))
    site |= draws.draw_numbers({key: site[key] for key in ("q0_rad", "qd0_rad_s")}, path)
    for group in (*(one for one in SITE_GROUPS if one != "arm"), "control"):
        site[group] = draws.draw_numbers(site[group], f"{path}.{group}")
    if isinstance(settings := site["control"].get("settings"), dict):
        site["control"]["settings"] = draws.draw_numbers(settings, f"{path}.control.settings")
    _check_counts(site, counts, path)

    def end_effector() -> list[float]:
        if model is None or not all(map(is_number, site["q0_rad"])):
            return [0.0] * counts.axes
        return model.end_effector(site["q0_rad"])

    holding = Holding(counts, site["q0_rad"], end_effector, draws)
    for group, kinds in (("hands", OPERATORS), ("environment", ENVIRONMENTS)):
        site[group] = resolve_operators(site.get(group, []), kinds, holding, f"{path}.{group}")
    return {key: site[key] for key in field_names(SiteSpec) if key in site}


def _resolve_arm(
    site: TomlTable, draws: Draws, urdf: dict[str, str], chains: bool, path: str
) -> tuple[TomlTable, ArmModel | None]:
    table = dict(site["arm"])
    task = site["task"]
    armature = {key: table.pop(key) for key in ("armature_kg_m2",) if key in table}
    links = _resolve_link_inertias(table.pop("links", {}), draws, f"{path}.links")
    table = draws.draw_numbers(table, path) | ({"links": links} if links else {})
    model = _model_arm(table=table, task_table=task, urdf=urdf, chains=chains, path=path)
    if not armature or model is None:
        return {**table, **armature}, model
    if not table.get("urdf"):
        raise ScenarioError(_OF_A_CHAIN, path=f"{path}.armature_kg_m2")
    table |= draws.draw_numbers(expand_vectors(armature, Arm, model.counts), path)
    return table, _model_arm(table=table, task_table=task, urdf=urdf, chains=chains, path=path)


def _resolve_link_inertias(written: Any, draws: Draws, path: str) -> TomlTable:
    """Returns the masses and inertias that an arm gives its links, drawn and checked one by
    one.
    """
    links: TomlTable = {}
    if not isinstance(written, dict):
        raise ScenarioError("must be a table of links", path=path)
    for name, entry in written.items():
        place = f"{path}.{name}"
        check_keys(entry, field_names(LinkInertia), place)
        links[name] = draws.draw_numbers(entry, place)
        try:
            given = msgspec.convert(links[name], LinkInertia)
        except msgspec.ValidationError as error:
            problem, key = split_refusal(error)
            raise ScenarioError(
                reword_problem(problem), path=f"{place}.{key.strip('.')}"
            ) from None
        if not given.list_keys():
            keys = ", ".join(field_names(LinkInertia))
            raise ScenarioError(f"is empty: give {keys}", path=place)
    return links


def _name_joints(table: TomlTable, urdf: dict[str, str]) -> tuple[str, ...]:
    if not table.get("urdf"):
        return ()
    return tuple(joint.name for joint in read_arm(msgspec.convert(table, Arm), urdf).joints)


_OF_A_CHAIN = "belongs to an arm with a urdf, and this one is planar"


def _model_arm(
    table: TomlTable, task_table: TomlTable, urdf: dict[str, str], chains: bool, path: str
) -> ArmModel | None:
    """Returns the model of an arm; None where the table of a planar arm is refused later, at
    its own key.
    """
    try:
        arm = msgspec.convert(table, Arm)
    except msgspec.ValidationError as error:
        if not (table.get("urdf") or chains):
            return None
        problem, place = split_refusal(error)
        raise ScenarioError(
            reword_problem(problem), path=f"{path}.{place.strip('.')}"
        ) from None
    foreign = [key for key in table if key in (ArmLinks._fields if arm.urdf else CHAIN_KEYS)]
    if foreign:
        owner = (
            f"belongs to the planar arm, and this one is {arm.urdf}"
            if arm.urdf
            else _OF_A_CHAIN
        )
        raise ScenarioError(owner, path=f"{path}.{foreign[0]}")
    if placed := [key for key in BASE_KEYS if key in table and not chains]:
        problem = "has no effect where all arms are planar and share joint angles: set task.space, or leave it out"
        raise ScenarioError(problem, path=f"{path}.{placed[0]}")
    if sum(abs(x) for x in arm.down) < 1e-6:
        raise ScenarioError("must point somewhere, is zero", path=f"{path}.down")
    own = f"{path.removesuffix('arm')}task"
    try:
        task = msgspec.convert(task_table, Task)
    except msgspec.ValidationError as error:
        if any(map(is_distribution, task_table.values())):
            return None
        problem, place = split_refusal(error)
        raise ScenarioError(reword_problem(problem), path=f"{own}.{place.strip('.')}") from None
    if idle := task.find_idle_key(task_table):
        raise ScenarioError(idle.problem, path=f"{own}.{idle.key}")
    try:
        return build_arm(arm, task, urdf, chains)
    except ScenarioError as error:
        if not arm.urdf:
            return None
        raise ScenarioError(error.problem, path=f"{path}.{error.path or 'urdf'}") from None


def _check_counts(site: TomlTable, counts: VectorCounts, path: str) -> None:
    law = site["control"].get("law", "adaptive")
    tables: list[tuple[TomlTable, type[Frozen], str]]
    tables = [
        (site, SiteSpec, path),
        (site["arm"], Arm, f"{path}.arm"),
        (site["task"], Task, f"{path}.task"),
    ]
    tables += [(site["control"], LAWS[law], f"{path}.control")] if law in LAWS else []
    for table, kind, place in tables:
        if found := find_count_problem(table, kind, counts):
            raise ScenarioError(found.problem, path=f"{place}.{found.key}")
    for key, value in site["limits"].items():
        wanted = counts.joints
        owner = f"the arm has {count_nouns(counts.joints, 'joint')}"
        if key == "qd_des_limit_rad_s":
            wanted = counts.shared
            owner = f"sites share {count_nouns(counts.shared, 'coordinate')}"
        if isinstance(value, list) and len(value) != wanted:
            raise ScenarioError(
                f"has {count_nouns(len(value), 'number')}, and {owner}",
                path=f"{path}.limits.{key}",
            )


def resolve_dominance_row(written: Any, names: list[str], site: str, path: str) -> TomlTable:
    """Returns a site's row of the dominance matrix, checked, with every peer's factor."""
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
    """Returns every link, complete, from [link] and [links]; files of traces lie in `folder`,
    if any may.
    """
    every = [f"{j}->{i}" for i in names for j in names if i != j]
    written = check_keys(tables.get("links", {}), every, "links")
    default = resolve_link(tables.get("link", {}), {}, "link")
    links: TomlTable = {}
    for name in every:
        path = f"links.{name}"
        link = resolve_link(written.get(name, {}), default, path)
        shared = "file" in default and "file" not in written.get(name, {})
        links[name] = _complete_link(
            link=link,
            name=name,
            path=path,
            folder=folder,
            trace_path="link" if shared else path,
        )
    return links


def _resolve_views(sites: TomlTable, folder: Path | None) -> None:
    for name, site in sites.items():
        if "view" in site:
            link = resolve_link(site["view"], {}, f"sites.{name}.view")
            site["view"] = _complete_link(link, name, f"sites.{name}.view", folder)


def _complete_link(
    link: TomlTable, name: str, path: str, folder: Path | None, trace_path: str = ""
) -> TomlTable:
    """Returns a resolved link with the trace that its file has; refuses one that lacks a key."""
    if link["model"] == "trace":
        link = _read_trace_file(link, name, trace_path or path, folder)
    kind = DELAY_MODELS[link["model"]]
    link = {**kind.derive_keys(link), **link}
    for field in msgspec.structs.fields(kind):
        if field.required and field.name not in link:
            where = "; give it here or in [link]" if trace_path else ""
            raise ScenarioError(f"is missing{where}", path=f"{path}.{field.name}")
    return link


def resolve_link(written: Any, base: TomlTable, path: str) -> TomlTable:
    """Returns a link: what is written upon its base, or upon nothing if a model or a preset is
    named.

    The file of a trace is not read yet.
    """
    if not isinstance(written, dict):
        raise ScenarioError("must be a table", path=path)
    start = {} if "model" in written or "preset" in written else base
    if "preset" in written:
        check_choice(written["preset"], list(PRESETS), f"{path}.preset")
        start = PRESETS[written["preset"]]
    model = written.get("model", start.get("model", "constant"))
    check_choice(model, list(DELAY_MODELS), f"{path}.model")
    if model != start.get("model", model):
        named = f"the preset {written['preset']!r} is {start['model']!r}: give one of the two"
        raise ScenarioError(f"is {model!r}, but {named}", path=f"{path}.model")
    files = TRACE_KEYS if model == "trace" else ()
    valid = ("model", "preset", *field_names(DELAY_MODELS[model]), *files)
    own = check_keys(written, valid, path)
    replaced = TRACE_KEYS if "trace" in own else ("trace",) if "file" in own else ()
    link = {
        **{key: value for key, value in start.items() if key not in replaced},
        **own,
        "model": model,
    }
    link.pop("preset", None)
    return link


def _read_trace_file(link: TomlTable, name: str, path: str, folder: Path | None) -> TomlTable:
    """Returns a link with the trace of its file; of a log that of the link of its name, or of
    `of`.
    """
    link = dict(link)
    file, of = (link.pop(key, None) for key in TRACE_KEYS)
    if ("trace" in link) == (file is not None):
        problem = (
            "give either trace or file"
            if "trace" in link
            else "is missing: a table or a log of delays"
        )
        raise ScenarioError(problem, path=f"{path}.file")
    if file is None and of is not None:
        raise ScenarioError("names a link of the log that file names", path=f"{path}.of")
    if file is not None:
        if folder is None:
            raise ScenarioError("no file may be named here", path=f"{path}.file")
        try:
            link["trace"] = read_trace(_find_file(str(file), folder), str(of or name))
        except ScenarioError as error:
            raise ScenarioError(error.problem, path=f"{path}.file") from None
    return link


def resolve_timeline(written: Any, links: TomlTable, names: list[str]) -> list[TomlTable]:
    """Returns the changes, each complete in itself, checked against the sites and the change
    before.
    """
    if not isinstance(written, list):
        raise ScenarioError("must be a list of tables [[timeline]]", path="timeline")
    present = dict(links)
    changes = []
    before_s = 0.0
    for n, entry in enumerate(written):
        path = f"timeline[{n}]"
        change = dict(check_keys(entry, TIMELINE_KEYS, path))
        at_s = change.get("at_s")
        if not is_number(at_s):
            raise ScenarioError("must be a time in s", path=f"{path}.at_s")
        if at_s < before_s:
            raise ScenarioError(
                f"must not be before the change above it, {before_s:g} s", path=f"{path}.at_s"
            )
        before_s = at_s
        if ("link" in change) == ("dominance" in change):
            raise ScenarioError("names either a link or, as dominance, a site", path=path)
        for key in ("link", "dominance"):
            if not isinstance(change.get(key, ""), str):
                raise ScenarioError(f"must be a name, is {change[key]!r}", path=f"{path}.{key}")
        change["to"] = resolve_target(change, present, names, path)
        if "link" in change:
            present[change["link"]] = change["to"]
        changes.append(change)
    return changes


def resolve_target(
    change: TomlTable, present: TomlTable, names: list[str], path: str
) -> TomlTable:
    """Returns the complete link, or row of the dominance matrix, that a change leads to."""
    written = change.get("to", {})
    if "link" in change:
        return _change_link(written, change["link"], present, path)
    site = change["dominance"]
    if site not in names:
        hint = suggest_nearest(site, names) or f"; sites are {', '.join(names)}"
        raise ScenarioError(f"there is no site {site!r}{hint}", path=f"{path}.dominance")
    return resolve_dominance_row(written, names, site, f"{path}.to")


def _change_link(written: Any, link: str, present: TomlTable, path: str) -> TomlTable:
    if link not in present:
        hint = suggest_nearest(link, list(present)) or f"; links are {', '.join(present)}"
        raise ScenarioError(f"there is no link {link!r}{hint}", path=f"{path}.link")
    before = present[link]
    after = resolve_link(written, before, f"{path}.to")
    if any(key in after for key in TRACE_KEYS):
        raise ScenarioError("no file can be named here", path=f"{path}.to.file")
    if after["model"] == "trace" and after.get("trace") != before.get("trace"):
        raise ScenarioError("a run cannot change to another trace", path=f"{path}.to.model")
    if "outages_s" in written and written["outages_s"] != before.get("outages_s"):
        raise ScenarioError("belongs to [links], it cannot change", path=f"{path}.to.outages_s")
    after = {**DELAY_MODELS[after["model"]].derive_keys(after), **after}
    return {**after, "outages_s": before["outages_s"]} if "outages_s" in before else after
