"""Scenarios by name or by path, from TOML, with overrides."""

import tomllib
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

from ..core.delay import LIMIT_US
from ..core.link import AHEAD_LIMIT_S, SAMPLE, calendar_pages
from ..errors import ScenarioError
from .conversion import convert
from .model import Scenario
from .resolution import resolve
from .site import SiteSpec
from .spreading import spread
from .tables import Table, nearest

_KINDS = ("model", "preset", "law")
"""Keys that say which other keys a table has."""

MAX_LINKS_BYTES = 64 << 20
"""Memory of a site's links, at most, in a scenario that somebody else wrote."""

_FOLDER = resources.files("trilat_net") / "scenarios"


def shipped() -> list[str]:
    """Returns the names of the scenarios that come with the package."""
    names = (entry.name for entry in _FOLDER.iterdir())
    return sorted(n.removesuffix(".toml") for n in names if n.endswith(".toml") and not n.startswith("_"))


def shipped_text(name: str) -> str:
    """Returns the text of a shipped scenario as its author wrote it."""
    if name not in shipped():
        raise ScenarioError(
            f"no scenario of that name{nearest(name, shipped())}; "
            f"shipped are {', '.join(shipped())}; a file is named by its path, as in ./mine.toml",
            source=name,
        )
    return (_FOLDER / f"{name}.toml").read_text(encoding="utf-8")


def template_text() -> str:
    """Returns the commented template of a scenario, valid as it stands."""
    return (_FOLDER / "_template.toml").read_text(encoding="utf-8")


def load(source: str | Path | Scenario, overrides: Mapping[str, Any] | Sequence[str] = ()) -> Scenario:
    """Returns a scenario by the name of a shipped one or by path, with overrides applied.

    Args:
        source: a shipped name, a path, or a scenario, in which a key of a group counts for all (`spreading`).
        overrides: `{"control.Kd": 5}` or `["control.Kd=5"]`.

    Raises:
        ScenarioError: the source cannot be read or is not a valid scenario.
    """
    if isinstance(source, Scenario):
        try:
            return parse(source.text, source.name, spread(source, _pairs(overrides))) if overrides else source
        except ScenarioError as error:
            raise ScenarioError(error.problem, path=error.path, source=source.name) from None
    text, folder = written_text(source)
    return parse(text, str(source), overrides, folder)


def written_text(source: str | Path) -> tuple[str, Path]:
    """Returns a scenario as its author wrote it, and the folder where files lie that it names.

    Args:
        source: a shipped name, or a path.

    Raises:
        ScenarioError: it cannot be read.
    """
    name = str(source)
    if not (isinstance(source, Path) or name.endswith(".toml") or "/" in name or "\\" in name):
        return shipped_text(name), Path()
    try:
        return Path(source).read_text(encoding="utf-8"), Path(source).parent
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "not UTF-8 text"
        raise ScenarioError(f"cannot be read: {reason}", source=name) from None


def site_named(scenario: Scenario, name: str) -> SiteSpec:
    """Returns a site of a scenario.

    Raises:
        ScenarioError: it has none of that name.
    """
    if name not in scenario.sites:
        hint = nearest(name, scenario.names)
        raise ScenarioError(
            f"no site {name!r}{hint}; its sites are {', '.join(scenario.names)}", source=scenario.name
        )
    return scenario.sites[name]


def parse(
    text: str,
    source: str = "",
    overrides: Mapping[str, Any] | Sequence[str] = (),
    folder: Path | None = Path(),
) -> Scenario:
    """Returns the scenario that a TOML text describes.

    Args:
        text: the TOML text.
        source: what errors call it.
        overrides: see `load`.
        folder: where the files that it names lie; None where it may name none.

    Raises:
        ScenarioError: with the path of the offending key.
    """
    try:
        tables = _tables(text)
        override(tables, overrides)
        return convert(resolve(tables, folder))
    except ScenarioError as error:
        raise ScenarioError(error.problem, path=error.path, source=source) from None
    except RecursionError:
        raise ScenarioError("is nested too deep", source=source) from None


def _tables(text: str) -> Table:
    try:
        return tomllib.loads(text)
    except ValueError as error:  # TOMLDecodeError is one; a number of 5000 digits is another
        raise ScenarioError(f"is not TOML: {error}") from None


def embedded(text: str, source: str = "") -> Scenario:
    """Returns the scenario that a log or a peer holds: resolved, and written by who knows whom.

    Args:
        text: the TOML text.
        source: what errors call it.

    Raises:
        ScenarioError: it is none, or names a file, or leaves to defaults what would fill the memory.
    """
    scenario = parse(text, source, folder=None)
    changed = (change.after for change in scenario.timeline if change.link)
    traces = sum(len(getattr(link, "trace", "")) for link in (*scenario.links.values(), *changed))
    if traces > len(text):
        raise ScenarioError("its traces are not written out, link by link", source=source)
    for name in scenario.names:
        rates = [scenario.sites[peer].rate_hz for peer in scenario.peers(name)]
        if sum(map(_pages_at_most, rates)) * SAMPLE.itemsize <= MAX_LINKS_BYTES:
            continue  # plainly little: the compiled core takes half a second to load, and a log opens faster
        pages = sum(map(calendar_pages, rates))
        if pages * SAMPLE.itemsize > MAX_LINKS_BYTES:
            wanted = pages * SAMPLE.itemsize >> 20
            raise ScenarioError(
                f"its links would take {wanted} MiB, at most {MAX_LINKS_BYTES >> 20} are given",
                path=f"sites.{name}",
                source=source,
            )
    return scenario


def _pages_at_most(rate_hz: int) -> int:
    """Returns what `calendar_pages` does not exceed."""
    return 2 * ((LIMIT_US // 1_000_000 + AHEAD_LIMIT_S) * rate_hz + 3)


def override(tables: Table, overrides: Mapping[str, Any] | Sequence[str]) -> None:
    """Writes overrides into the tables of a scenario, in place.

    Args:
        tables: as read from TOML.
        overrides: a mapping from dotted keys, or texts KEY=VALUE whose value is TOML or a bare word. A number
            means what stands there in a list, counted from 0, as in sites.s.environment.0.stiffness_n_m. One
            that names a kind (a link's model or preset, a law) replaces what the table said besides.
    """
    pairs = _pairs(overrides)
    overridden = {key for key, _ in pairs}
    for key, value in pairs:
        *folders, last = key.split(".")
        sites = tables.get("sites")
        if len(folders) > 1 and folders[0] == "sites" and isinstance(sites, dict) and folders[1] not in sites:
            hint = nearest(folders[1], list(sites)) or f"; its sites are {', '.join(sites)}"
            raise ScenarioError(f"no such site{hint}", path=key)
        table = _reached(tables, folders, last)
        if isinstance(table, list):
            table[_place(table, last, key)] = value
            continue
        if last in _KINDS:  # what the file says is of another kind
            for other in [k for k in table if ".".join([*folders, k]) not in overridden]:
                del table[other]
        table[last] = value


def _reached(tables: Table, folders: Sequence[str], last: str) -> Table | list[Any]:
    """Returns the table or list that dotted keys lead to; tables that are not there are made.

    Args:
        tables: where to begin.
        folders: keys of tables, and numbers of what stands in a list.
        last: the key that will be sought in it.
    """
    reached: Any = tables
    for depth, name in enumerate(folders):
        path = ".".join(folders[: depth + 1])
        if isinstance(reached, list):
            entry = reached[_place(reached, name, path)]
        else:
            after = (*folders, last)[depth + 1]
            entry = reached.setdefault(name, [] if after.isdecimal() else {})
        if not isinstance(entry, dict | list):
            raise ScenarioError("is a value, not a table", path=path)
        reached = entry
    return reached  # type: ignore[no-any-return]


def _place(entries: list[Any], name: str, path: str) -> int:
    """Returns the place in a list that a part of a key means."""
    if not name.isdecimal() or int(name) >= len(entries):
        counted = f"it has {len(entries)}, counted from 0" if entries else "it has none"
        raise ScenarioError(f"no such entry: {counted}", path=path)
    return int(name)


def _pairs(overrides: Mapping[str, Any] | Sequence[str]) -> list[tuple[str, Any]]:
    if isinstance(overrides, Mapping):
        return list(overrides.items())
    pairs = []
    for text in overrides:
        key, equals, value = text.partition("=")
        if not equals or not key.strip():
            raise ScenarioError(f"an override reads KEY=VALUE, as in control.Kd=5, not {text!r}")
        try:
            parsed: Any = tomllib.loads(f"value = {value}")["value"]
        except tomllib.TOMLDecodeError:
            parsed = value.strip()
        pairs.append((key.strip(), parsed))
    return pairs
