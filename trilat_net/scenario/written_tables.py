"""Types of the tables that the author of a scenario may write.

An author writes less than the program needs: most keys may be left out, tables such as `[arm]`
apply to all sites, one number may stand for a vector, and a random distribution may stand for a
number. `WrittenScenario` is the type of such a file, and `scenario_types.Scenario` is the type
of the complete scenario.

The keys of some tables depend on one of their values, such as the law in `[control]`. These
tables are checked separately, once that value is known, by `check_control`, `check_link` and
`operators.resolve_operators`.

Invariant:
    - The keys, types and ranges of a group such as `arm` are declared once, in its complete
      type. The type of the written table is derived from it (see `written_kind`).
"""

import re
from collections.abc import Collection, Mapping
from typing import TYPE_CHECKING, Annotated, Literal

import msgspec
from msgspec import UNSET, Meta, UnsetType, field

from ..errors import ScenarioError, count_nouns
from ..fields import Frozen, Joints, RateHz, TomlTable
from .arms import Arm, Task
from .delay_models import DELAY_MODELS
from .distributions import Distribution
from .expect import Expect
from .key_checks import StructType, check_finite, field_names
from .laws import LAWS
from .refusals import check_table, refuse
from .scenario_types import Duration, ScenarioName, SchemeName, Seed
from .site_spec import Limits, OnStale
from .suggestions import list_group_paths
from .written_kinds import written_kind, written_type

MAX_SITES = 32
"""Maximum number of sites. Every pair of sites has two links."""
_SITE_NAME = re.compile(r"[a-z][a-z0-9_]{0,31}")
_RESERVED_NAME = "recorder"
"""Name that no site may have, since the program that writes the log uses it."""
TRACE_KEYS = ("file", "of")
"""Keys of a link that name a delay file. A resolved link contains the delays instead."""


if TYPE_CHECKING:
    WrittenArm = Arm
    WrittenLimits = Limits
    WrittenOnStale = OnStale
    WrittenTask = Task
    WrittenExpect = Expect
    WrittenJoints = Joints
else:
    # Built at run time from the complete types.
    WrittenArm = written_kind(Arm)
    WrittenLimits = written_kind(Limits)
    WrittenOnStale = written_kind(OnStale)
    WrittenTask = written_kind(Task)
    WrittenExpect = written_kind(Expect, takes_distributions=False)
    WrittenJoints = written_type(Joints, takes_distributions=True)

_LINK_TABLES: dict[str, StructType] = {
    model: written_kind(
        kind,
        "model",
        "preset",
        *(TRACE_KEYS if model == "trace" else ()),
        takes_distributions=False,
    )
    for model, kind in DELAY_MODELS.items()
}
_LAW_TABLES: dict[str, StructType] = {
    law: written_kind(kind, "law") for law, kind in LAWS.items()
}
"""Mapping from name to table type, for delay models and for control laws."""
for _kind in _LINK_TABLES.values():
    # The types are used once now, because msgspec 0.22 crashes if two threads first use a type
    # at once.
    msgspec.convert({}, _kind)
_USER_LAW = "own"
"""Name shared by all users' laws.

Since their arguments differ, messages about misplaced keys do not mention these laws.
"""


class WrittenSite(Frozen, frozen=True, kw_only=True):
    """Table of one site as written by an author.

    `site_spec.SiteSpec` is the complete form. The keys of `control`, of `view`, and of each
    table in `hands` and `environment` depend on the kind that the table names.
    """

    role: Literal["master", "slave"] | UnsetType = UNSET
    rate_hz: RateHz | UnsetType = UNSET
    q0_rad: WrittenJoints | UnsetType = UNSET
    qd0_rad_s: WrittenJoints | UnsetType = UNSET
    arm: WrittenArm | UnsetType = UNSET
    control: TomlTable = field(default_factory=dict)
    limits: WrittenLimits | UnsetType = UNSET
    on_stale: WrittenOnStale | UnsetType = UNSET
    task: WrittenTask | UnsetType = UNSET
    hands: list[TomlTable] = field(default_factory=list)
    environment: list[TomlTable] = field(default_factory=list)
    plant: str | TomlTable = "simulated"
    view: TomlTable | UnsetType = UNSET


class WrittenChange(Frozen, frozen=True, kw_only=True, omit_defaults=True):
    """Planned change of a link or of dominance factors, in the form used in scenario files.

    The keys of `to` depend on what is changed (see `change.Change`).
    """

    at_s: Annotated[float, Meta(extra={"must_be": "a time in s"})]
    link: Annotated[str, Meta(extra={"must_be": "a name"})] = ""
    dominance: Annotated[str, Meta(extra={"must_be": "a name"})] = ""
    to: TomlTable = field(default_factory=dict)
    ramp_s: float = 0.0


class WrittenScenario(Frozen, frozen=True, kw_only=True):
    """A scenario file as written by an author, with many keys left out.

    `scenario_types.Scenario` is the complete form.

    Attributes:
        rate_hz: Default tick rate, in Hz.
        arm: Default arm of all sites.
        limits: Default limits of all sites.
        on_stale: Default reaction of all sites to old or missing samples.
        task: Default shared coordinates of all sites.
        control: Default control law of all sites, with its gains.
        link: Default settings of all links.
    """

    name: ScenarioName
    title: str = ""
    about: str = ""
    assumed: list[str] = field(default_factory=list)
    rate_hz: RateHz = 1000
    duration_s: Duration = 20.0
    seed: Seed = 1
    scheme: SchemeName = "second_order"
    arm: WrittenArm | UnsetType = UNSET
    limits: WrittenLimits | UnsetType = UNSET
    on_stale: WrittenOnStale | UnsetType = UNSET
    task: WrittenTask | UnsetType = UNSET
    control: TomlTable = field(default_factory=dict)
    link: TomlTable = field(default_factory=dict)
    sites: Annotated[dict[str, WrittenSite], Meta(extra={"must_be": "tables [sites.NAME]"})]
    dominance: TomlTable
    links: TomlTable = field(default_factory=dict)
    timeline: list[WrittenChange] = field(default_factory=list)
    expect: WrittenExpect | UnsetType = UNSET
    drawn: dict[str, Distribution] = field(default_factory=dict)
    urdf: dict[str, Annotated[str, Meta(extra={"must_be": "the text of a URDF"})]] = field(
        default_factory=dict
    )

    @classmethod
    def check(cls, tables: TomlTable) -> "WrittenScenario":
        """Converts the tables of a scenario file to a `WrittenScenario`.

        Conditions that involve several tables are checked later.

        Args:
            tables: Tables of the file as written by its author.

        Returns:
            The typed tables, with the defaults of scenario-level keys filled in.

        Raises:
            ScenarioError: A key is unknown or missing, or a value has a wrong type or is out of
                range.
        """
        check_finite(tables, "")
        try:
            written = msgspec.convert(tables, WrittenScenario)
        except msgspec.ValidationError as error:
            sites = tables.get("sites")
            site_paths = [f"sites.{name}" for name in sites] if isinstance(sites, dict) else []
            paths = [*site_paths, *list_group_paths()]
            raise refuse(error, tables, WrittenScenario, "", paths) from None
        _check_site_names(written.sites)
        return written


def _check_site_names(names: Collection[str]) -> None:
    """Raises ScenarioError if a site name, or the number of sites, is not valid.

    Args:
        names: Names of the sites.

    Raises:
        ScenarioError: A name or the number of sites is not valid.
    """
    for name in names:
        if not _SITE_NAME.fullmatch(name) or name == _RESERVED_NAME:
            raise ScenarioError(
                "the name of a site must consist of lower-case letters, digits and _, begin "
                f"with a letter, and not be {_RESERVED_NAME!r}",
                path=f"sites.{name}",
            )
    if len(names) > MAX_SITES:
        raise ScenarioError(
            f"has {count_nouns(len(names), 'site')}, but at most {MAX_SITES} are allowed",
            path="sites",
        )
    if len(names) < 2:
        raise ScenarioError(
            f"an experiment must have at least two sites, but this one has {len(names)}",
            path="sites",
        )


def check_control(table: TomlTable, law: str, path: str) -> None:
    """Raises ScenarioError if a `control` table has an unknown key or an invalid gain.

    Args:
        table: The table as written by its author.
        law: Name of a built-in law, or "own".
        path: Dotted path of the table.
    """
    _check_foreign_keys(table, _LAW_TABLES, "law", law, path)
    check_table(table, _LAW_TABLES[law], path)


def check_link(table: TomlTable, model: str, path: str) -> None:
    """Raises ScenarioError if a link table has a key that its delay model does not have.

    Args:
        table: The table as written by its author.
        model: Name of the delay model.
        path: Dotted path of the table.
    """
    _check_foreign_keys(table, _LINK_TABLES, "model", model, path)
    # The table `links` contains the settings of single links, and the table `link` those of all
    # links.
    link_paths = [f"links.{key}" for key in table if path == "link" and "->" in key]
    check_table(table, _LINK_TABLES[model], path, link_paths)


def _check_foreign_keys(
    table: TomlTable, kinds: Mapping[str, StructType], group: str, chosen: str, path: str
) -> None:
    """Raises ScenarioError if a key belongs to another control law or delay model.

    The comparison ignores case, so that the user of `control.D` learns about `d`. A key that
    differs from a valid key only in case is rejected by `check_table`, which suggests the valid
    key.

    Args:
        table: Table of a control law or a delay model.
        kinds: Types of the tables of all laws or models.
        group: "law" or "model".
        chosen: Name of the law or model of the table.
        path: Dotted path of the table.

    Raises:
        ScenarioError: The key belongs to other kinds.
    """
    valid = field_names(kinds[chosen])
    valid_words = {key.casefold() for key in valid}
    for key in table:
        sought = key.casefold()
        if sought in valid_words:
            continue
        owners = {}
        for name, kind in kinds.items():
            for owned in field_names(kind):
                if owned.casefold() == sought and name != _USER_LAW:
                    owners[name] = owned
        if not owners:
            continue
        owned_keys = " or ".join(dict.fromkeys(owners.values()))
        subject = "belongs to" if owned_keys == key else f"{owned_keys} belongs to"
        other_keys = [owned for owned in valid if owned != group]
        raise ScenarioError(
            f"{subject} {group} {', '.join(owners)}, but {path}.{group} is {chosen}, which "
            f"has {', '.join(other_keys)}",
            path=f"{path}.{key}",
        )
