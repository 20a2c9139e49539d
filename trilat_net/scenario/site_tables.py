"""Completes the site tables of a scenario: arms, control laws, limits, operators.

Keys may be specified for all sites at once, in tables such as `[arm]`, and overridden for
individual sites. The law of an arm is either the name of a built-in law or a user's Python
class, given as "module:Class".

Names, types and ranges of all keys have already been checked (see `written_tables`). Only
random numbers, which are drawn here, can still be out of range.
"""

import math
import os
from pathlib import Path
from typing import NamedTuple

from ..core import ArmLinks
from ..errors import ScenarioError
from ..fields import Frozen, TomlTable
from ..own_code import parse_classes
from .arms import BASE_KEYS, CHAIN_KEYS, Arm, ArmModel, Task, build_arm
from .distributions import Draws, has_distribution
from .key_checks import VectorCounts, check_choice, field_names
from .laws import LAWS
from .link_inertia import LinkInertia
from .link_tables import complete_link
from .named_files import NamedFiles
from .operators import ENVIRONMENTS, OPERATORS, HeldArm, resolve_operators
from .own_law import complete_own_law
from .own_plant import OwnPlant
from .refusals import convert_drawn
from .site_spec import GLIDE_TAU_RATE_NM_S, SITE_GROUPS, Limits, SiteSpec
from .written_tables import check_control

_MIN_DOWN_LENGTH = 1e-6
"""Smallest sum of absolute components for which a vector is accepted as a direction."""
_DEFAULT_LAW = "adaptive"
_BELONGS_TO_CHAIN = "belongs to an arm with a urdf, but this arm is planar"


class _SharedByAll(NamedTuple):
    """Tables and files shared by all sites, used to complete the table of each site.

    Attributes:
        rate_hz: Default tick rate, in Hz.
        control: Table `control` for all sites, as written by its author.
        draws: Object that draws the numbers that are specified as distributions.
        files: Files that the sites name.
        chains: True if the arms are modelled as general chains of joints.
    """

    rate_hz: int
    control: TomlTable
    draws: Draws
    files: NamedFiles
    chains: bool


def complete_site_tables(
    tables: TomlTable, rate_hz: int, draws: Draws, files: NamedFiles
) -> TomlTable:
    """Returns a mapping from site name to the complete table of the site.

    Keys that the author left out are taken from the tables for all sites, or set to their
    defaults.

    Args:
        tables: Tables of the scenario file.
        rate_hz: Default tick rate, in Hz.
        draws: Object that draws the numbers that are specified as distributions.
        files: Files that the sites name.

    Raises:
        ScenarioError: A table is not valid.
    """
    control = tables.get("control", {})
    # A mistake in the table for all sites is refused there, and not at the first site.
    _complete_control(control, {}, "control", VectorCounts())
    sites = {name: _join_groups(site, tables) for name, site in tables["sites"].items()}

    # The kernel computes planar arms with their own formulas, and all other arms as chains. If
    # one arm is a chain, all arms are modelled as chains, because every run uses the same
    # functions for all its sites.
    chains = False
    for site in sites.values():
        shares_pose = site["task"].get("space", "joints") != "joints"
        if site["arm"].get("urdf") or shares_pose:
            chains = True

    shared = _SharedByAll(rate_hz, control, draws, files, chains)
    return {name: _complete_site(site, name, shared) for name, site in sites.items()}


def _complete_control(
    written: TomlTable, common: TomlTable, path: str, counts: VectorCounts
) -> TomlTable:
    """Completes a control law table, so that every gain has a value.

    Missing gains are set to their defaults, and a scalar is expanded to a vector with one entry
    per joint.

    Args:
        written: Table `control` of a site as written by its author.
        common: Table `control` for all sites. Its gains replace missing gains only if it names
            the same law, since other laws have other gains.
        path: Path of the table, for error messages.
        counts: Vector lengths to which scalars are expanded.

    Raises:
        ScenarioError: There is no such law, or it has no such gain.
    """
    common_law = common.get("law", _DEFAULT_LAW)
    law = str(written.get("law", common_law))
    if ":" in law:
        return complete_own_law(law, written, common, path)
    if law not in LAWS:
        raise _refuse_law(law, f"{path}.law")
    check_control(written, law, path)
    inherited = common if common_law == law else {}
    return counts.expand_vectors({**inherited, **written, "law": law}, LAWS[law])


def _refuse_law(law: str, path: str) -> ScenarioError:
    """Returns the error for a control law that does not exist.

    If there is a Python file of that name, the message contains the correct name of its class.

    Args:
        law: The name.
        path: Path of the key, for error messages.
    """
    file = Path(law if law.endswith(".py") else f"{law}.py")
    if os.path.isfile(file):  # noqa: PTH113 - Path.is_file raises for a very long name
        classes = parse_classes(file.read_bytes(), file, path)
        names = [f"{file.stem}:{name}" for name in classes]
        remedy = f"write {' or '.join(names)}" if names else "it defines no class"
        return ScenarioError(f"is {law!r}, but a law in a file is a class: {remedy}", path=path)
    # "own" is the type of users' laws in canonical texts.
    built_in = [name for name in LAWS if name != "own"]
    check_choice(law, [*built_in, "module:Class"], path)
    return ScenarioError(f"is {law!r}, but must name a class as module:Class", path=path)


def _join_groups(written: TomlTable, tables: TomlTable) -> TomlTable:
    """Merges the table of a site with the keys shared by all sites.

    The groups of keys in `SITE_GROUPS`, such as `arm` and `limits`, may be set for all sites
    and overridden for individual ones.

    The table `arm.links` contains one table per robot link. These are merged link by link and
    key by key, so a site may change a single inertia.

    Args:
        written: Table of the site as written by its author.
        tables: Tables of the scenario file.
    """
    site = dict(written)
    for group in SITE_GROUPS:
        common = tables.get(group, {})
        local = written.get(group, {})
        if "urdf" in local:
            # An arm with its own file inherits nothing, because the keys for all arms describe
            # another arm.
            common = {}
        joined = {**common, **local}
        if "links" in common and "links" in local:
            joined["links"] = {
                name: {**common["links"].get(name, {}), **local["links"].get(name, {})}
                for name in {**common["links"], **local["links"]}
            }
        site[group] = joined
    return site


def _complete_site(site: TomlTable, name: str, shared: _SharedByAll) -> TomlTable:
    """Returns the complete table of one site.

    The arm model is built first, since its number of joints determines the lengths of all
    vectors. The order in which random numbers are drawn must not change: it determines the
    order of the table `drawn`, and with it the hash of the scenario.

    Args:
        site: Table of the site, merged with the tables for all sites.
        name: Name of the site.
        shared: Tables and files shared by all sites.

    Raises:
        ScenarioError: A table is not valid.
    """
    path = f"sites.{name}"
    model, arm = _complete_arm(site, shared, f"{path}.arm")
    counts = model.counts
    site = counts.expand_vectors({"q0_rad": 0.0, "qd0_rad_s": 0.0, **site}, SiteSpec)
    site["arm"] = arm
    site["control"] = _complete_control(
        site.get("control", {}), shared.control, f"{path}.control", counts
    )
    site["limits"] = {**_list_default_limits(site, model), **site["limits"]}
    site.setdefault("role", "master")
    site.setdefault("rate_hz", shared.rate_hz)
    if "plant" in site:
        site["plant"] = OwnPlant.complete_table(site["plant"], f"{path}.plant")
    if "view" in site:
        site["view"] = complete_link(site["view"], {}, name, shared.files, f"{path}.view")

    _draw_numbers(site, shared.draws, path)
    _check_counts(site, counts, path)
    held_arm = HeldArm(
        counts, site["q0_rad"], lambda: model.end_effector(site["q0_rad"]), shared.draws
    )
    for group, kinds in (("hands", OPERATORS), ("environment", ENVIRONMENTS)):
        actors = site.get(group, [])
        site[group] = resolve_operators(actors, kinds, held_arm, f"{path}.{group}")
    return {key: site[key] for key in field_names(SiteSpec) if key in site}


def _complete_arm(
    site: TomlTable, shared: _SharedByAll, path: str
) -> tuple[ArmModel, TomlTable]:
    """Returns the model of an arm and its complete table.

    The key `armature_kg_m2` (rotor inertias) may contain one number for all joints, but the
    number of joints is known only from the model. The model is therefore first built without
    this key, and then again with it.

    Args:
        site: Table of the site.
        shared: Tables and files shared by all sites.
        path: Path of the arm's table, for error messages.

    Raises:
        ScenarioError: A drawn number is out of range, a key belongs to another kind of arm, or
            the URDF file of the arm cannot be used.
    """
    table = dict(site["arm"])
    links = table.pop("links", {})
    for name, link in links.items():
        if not link:
            keys = ", ".join(field_names(LinkInertia))
            raise ScenarioError(
                f"is empty: give at least one of {keys}", path=f"{path}.links.{name}"
            )
    # The numbers in the tables of links are drawn table by table, because
    # `Draws.draw_numbers` leaves out inner tables.
    drawn_links = {
        name: shared.draws.draw_numbers(link, f"{path}.links.{name}")
        for name, link in links.items()
    }
    armature = table.pop("armature_kg_m2", None)
    table = shared.draws.draw_numbers(table, path)
    if drawn_links:
        table["links"] = drawn_links
    model = _model_arm(table, site["task"], shared, path)
    if armature is None:
        return model, table

    if not table.get("urdf"):
        raise ScenarioError(_BELONGS_TO_CHAIN, path=f"{path}.armature_kg_m2")
    armatures = model.counts.expand_vectors({"armature_kg_m2": armature}, Arm)
    table |= shared.draws.draw_numbers(armatures, path)
    return _model_arm(table, site["task"], shared, path), table


def _model_arm(
    table: TomlTable, task_table: TomlTable, shared: _SharedByAll, path: str
) -> ArmModel:
    """Builds the model of an arm from its table, to determine its joints and dynamics.

    Args:
        table: Table of the arm.
        task_table: Table `task` of the site, with the shared coordinates. Its random numbers
            have not been drawn yet, but do not affect vector lengths.
        shared: Tables and files shared by all sites.
        path: Path of the arm's table, for error messages.

    Raises:
        ScenarioError: A drawn number is out of range, a key belongs to another kind of arm, or
            the URDF file of the arm cannot be used.
    """
    draws = shared.draws
    arm = convert_drawn(table=table, kind=Arm, path=path, drawn=draws.drawn, seed=draws.seed)
    _check_arm_keys(arm, table, shared.chains, path)

    task_path = f"{path.removesuffix('arm')}task"
    certain = {key: value for key, value in task_table.items() if not has_distribution(value)}
    task = convert_drawn(
        table=certain, kind=Task, path=task_path, drawn=draws.drawn, seed=draws.seed
    )
    idle_key = task.find_idle_key(task_table)
    if idle_key is not None:
        raise ScenarioError(idle_key.problem, path=f"{task_path}.{idle_key.key}")

    try:
        return build_arm(arm, task, shared.files.urdf_texts, shared.chains)
    except ScenarioError as error:
        key = error.path or ("urdf" if arm.urdf else "")
        raise ScenarioError(error.problem, path=f"{path}.{key}".rstrip(".")) from None


def _check_arm_keys(arm: Arm, table: TomlTable, chains: bool, path: str) -> None:
    """Raises ScenarioError for arm keys that have no effect, or gravity with no direction.

    Some keys apply only to the planar two-link arm, others only to a chain from a URDF file.

    Args:
        arm: The arm.
        table: Table from which the arm was built, which shows the keys set by the author.
        chains: True if the arms of the scenario are modelled as chains.
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


def _list_default_limits(site: TomlTable, model: ArmModel) -> TomlTable:
    """Returns the default limits of an arm.

    The effort and velocity limits of a chain are taken from its URDF file. A joint with no
    positive finite limit in the file has the default of `Limits`. A simulated arm with the
    stale rule "glide" also has a limit on the torque's rate of change.
    """
    limits: TomlTable = {}
    if site["on_stale"].get("action") == "glide" and site.get("plant") != "external":
        limits["tau_rate_limit_nm_s"] = GLIDE_TAU_RATE_NM_S
    if model.chain is None:
        return limits

    file_limits = {"tau_limit_nm": model.efforts, "qd_limit_rad_s": model.speeds}
    for key, stated_limits in file_limits.items():
        default = getattr(Limits(), key)
        limits[key] = [limit if 0.0 < limit < math.inf else default for limit in stated_limits]
    return limits


def _draw_numbers(site: TomlTable, draws: Draws, path: str) -> None:
    """Replaces the random distributions in a site table with drawn numbers, in place.

    Covers the start pose, the limits, the stale rule, the task and the gains of the control
    law. The numbers of the arm have already been drawn.
    """
    start = {key: site[key] for key in ("q0_rad", "qd0_rad_s")}
    site |= draws.draw_numbers(start, path)
    drawn_groups = [group for group in SITE_GROUPS if group != "arm"]
    for group in (*drawn_groups, "control"):
        site[group] = draws.draw_numbers(site[group], f"{path}.{group}")
    settings = site["control"].get("settings")
    if settings is not None:
        site["control"]["settings"] = draws.draw_numbers(settings, f"{path}.control.settings")


def _check_counts(site: TomlTable, counts: VectorCounts, path: str) -> None:
    """Raises ScenarioError if a vector, such as gains per joint, has the wrong length.

    Args:
        site: Complete table of the site.
        counts: Number of joints of the arm, and number of coordinates that the sites share.
        path: Path of the site, for error messages.
    """
    law = site["control"]["law"]
    tables: list[tuple[TomlTable, type[Frozen], str]] = [
        (site, SiteSpec, path),
        (site["arm"], Arm, f"{path}.arm"),
        (site["task"], Task, f"{path}.task"),
        (site["control"], LAWS[law], f"{path}.control"),
        (site["limits"], Limits, f"{path}.limits"),
    ]
    for table, kind, table_path in tables:
        problem = counts.find_problem(table, kind)
        if problem is not None:
            raise ScenarioError(problem.problem, path=f"{table_path}.{problem.key}")
