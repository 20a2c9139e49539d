"""Resolves the tables of a scenario file: defaults, presets, inherited keys, named files.

The author of a scenario may leave out most keys. `resolve_scenario` returns tables in which
every key is present:

1. Unknown keys and values of a wrong type are rejected (see `written_tables`).
2. Defaults are written out, and the keys of tables for all sites (such as `[arm]`) are copied
   into the table of each site.
3. Each probability distribution is replaced with a number drawn from it, using the seed of the
   scenario.
4. Named files (URDF files of arms, delay traces) are read, so the result depends on no other
   file.

`validate.build_scenario` then converts the result to the type `Scenario` and checks conditions
that involve several tables.

Invariant:
    - A key is checked in the table in which its author wrote it, so the path in an error
      message can be found in the file.
"""

from collections.abc import Sequence
from pathlib import Path

import msgspec

from ..errors import ScenarioError, suggest_nearest
from ..fields import TomlTable
from .distributions import Draws
from .dominance_rows import resolve_dominance_row
from .expect import Expect
from .key_checks import check_keys
from .link_tables import change_link, complete_link_tables
from .named_files import NamedFiles, use_unix_line_ends
from .site_tables import complete_site_tables
from .written_tables import WrittenChange, WrittenScenario


def resolve_scenario(tables: TomlTable, folder: Path | None) -> TomlTable:
    """Fills in all defaults of a scenario, and the contents of the files that it names.

    The result describes the experiment completely and depends on no other file.

    Args:
        tables: Tables of the scenario file, as written by its author.
        folder: Folder in which files named in the scenario are looked up. If None, a scenario
            that names a file is rejected.

    Returns:
        Tables with the keys of `Scenario`.

    Raises:
        ScenarioError: A key is unknown, missing or wrong. The error contains its path.
    """
    written = WrittenScenario.check(tables)
    files = NamedFiles.of_arms(tables, written.urdf, folder)
    draws = Draws(written.seed, written.drawn)
    # The tables of sites are completed as they were written and not as typed values, because
    # the order of their keys is the order of the random draws.
    sites = complete_site_tables(tables, written.rate_hz, draws, files)
    site_names = list(sites)
    expect = Expect.complete_table(tables.get("expect", {}), sites, files.urdf_texts)
    check_keys(written.dominance, site_names, "dominance")
    dominance_rows = {
        name: resolve_dominance_row(
            written.dominance.get(name), site_names, name, f"dominance.{name}"
        )
        for name in site_names
    }
    links = complete_link_tables(written.link, written.links, site_names, files)
    return {
        "name": written.name,
        "title": use_unix_line_ends(written.title),
        "about": use_unix_line_ends(written.about),
        "assumed": [use_unix_line_ends(assumption) for assumption in written.assumed],
        "duration_s": written.duration_s,
        "seed": written.seed,
        "scheme": written.scheme,
        "sites": sites,
        "dominance": dominance_rows,
        "links": links,
        "timeline": _complete_timeline(written.timeline, links, site_names),
        "expect": expect,
        "drawn": draws.drawn,
        "urdf": files.list_used_texts(sites),
    }


def _complete_timeline(
    written: Sequence[WrittenChange], links: TomlTable, site_names: list[str]
) -> list[TomlTable]:
    """Returns the planned changes of a scenario, each complete in itself.

    An author may write only those link settings that change. In the result, each change
    contains all settings, with unchanged settings carried over from earlier changes.

    Args:
        written: Changes as written by their author.
        links: Mapping from name to complete link at the start of the run.
        site_names: Names of all sites of the scenario.

    Raises:
        ScenarioError: A change is not valid, or the changes are not in ascending order of time.
    """
    current_links = dict(links)
    changes = []
    previous_s = 0.0
    for n, change in enumerate(written):
        path = f"timeline[{n}]"
        if change.at_s < previous_s:
            raise ScenarioError(
                f"must not be earlier than the previous change, at {previous_s:g} s",
                path=f"{path}.at_s",
            )
        previous_s = change.at_s
        if bool(change.link) == bool(change.dominance):
            raise ScenarioError(
                "must name either a link (link = ...) or a site (dominance = ...)", path=path
            )

        target = complete_target(change, current_links, site_names, path)
        if change.link:
            current_links[change.link] = target
        changes.append({**msgspec.to_builtins(change), "to": target})
    return changes


def complete_target(
    change: WrittenChange, current_links: TomlTable, site_names: list[str], path: str
) -> TomlTable:
    """Completes the new settings of a planned or requested change.

    Args:
        change: Change of a link, or of the dominance factors of a site.
        current_links: Mapping from link name to the settings before the change.
        site_names: Names of all sites of the scenario.
        path: Path of the change, for error messages.

    Returns:
        All settings of the link after the change, or the dominance factors for all peers.

    Raises:
        ScenarioError: There is no such link or site, or a value is not valid.
    """
    if change.link:
        return change_link(change.to, change.link, current_links, path)
    site = change.dominance
    if site not in site_names:
        hint = suggest_nearest(site, site_names) or f"; the sites are {', '.join(site_names)}"
        raise ScenarioError(f"there is no site {site!r}{hint}", path=f"{path}.dominance")
    return resolve_dominance_row(change.to, site_names, site, f"{path}.to")
