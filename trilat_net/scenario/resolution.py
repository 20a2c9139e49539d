"""From what an author wrote to a complete scenario: defaults, checks of keys, names and shares.

Law: what a person writes is checked in the shape in which it was written, so that the path in an error is
one that the person can find in the file.
"""

import difflib
import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from ..core import dominance
from ..core.arm import JOINTS, PARAMETERS
from ..errors import ScenarioError
from .expectation import Expect
from .links import LINKS
from .model import LAWS, Arm, Limits, OnStale, Pulse, SiteSpec
from .presets import PRESETS
from .timeline import Change
from .traces import read_trace

Table = dict[str, Any]

_TOP = ("name", "title", "about", "assumed", "rate_hz", "duration_s", "seed", "scheme")
_TABLES = (
    "arm",
    "control",
    "limits",
    "on_stale",
    "link",
    "sites",
    "dominance",
    "links",
    "timeline",
    "expect",
)
_SITE = ("role", "rate_hz", "q0_rad", "qd0_rad_s", "arm", "control", "limits", "on_stale", "hands")
_GROUPS: dict[str, type[msgspec.Struct]] = {"arm": Arm, "limits": Limits, "on_stale": OnStale}
_VECTORS = {
    "Lambda": JOINTS,
    "Kp": JOINTS,
    "Kd": JOINTS,
    "K": JOINTS,
    "d": JOINTS,
    "q0_rad": JOINTS,
    "qd0_rad_s": JOINTS,
    "peak_nm": JOINTS,
    "Gamma": PARAMETERS,
    "theta_hat0": PARAMETERS,
}
_FILE = ("file", "of")
"""Keys that say where a trace comes from; a resolved link has the trace in their place."""
_SITE_NAME = re.compile(r"[a-z][a-z0-9_]{0,31}")
_RESERVED = ("recorder",)


def nearest(word: str, valid: Sequence[str]) -> str:
    """Returns "; did you mean ...?", or "" where nothing valid is near."""
    match = difflib.get_close_matches(word, valid, n=1, cutoff=0.5)
    return f"; did you mean {match[0]!r}?" if match else ""


def _known(table: Any, valid: Sequence[str], path: str) -> Table:
    """Returns the table if it is one and has no key but the valid ones."""
    if not isinstance(table, dict):
        raise ScenarioError("must be a table", path=path)
    for key in table:
        if key not in valid:
            where = f"{path}.{key}" if path else key
            hint = nearest(key, valid) or f"; valid are {', '.join(valid)}"
            raise ScenarioError(f"unknown key{hint}", path=where)
    return table


def _fields(kind: type[msgspec.Struct]) -> tuple[str, ...]:
    return kind.__struct_fields__


def _vectors(table: Table) -> Table:
    """Writes a single number out where a vector is wanted."""
    return {
        key: [value] * _VECTORS[key]
        if key in _VECTORS and isinstance(value, int | float) and not isinstance(value, bool)
        else value
        for key, value in table.items()
    }


def _finite(value: Any, path: str) -> None:
    if isinstance(value, float) and not math.isfinite(value):
        raise ScenarioError(f"must be a finite number, is {value}", path=path)
    if isinstance(value, dict):
        for key, entry in value.items():
            _finite(entry, f"{path}.{key}" if path else key)
    if isinstance(value, list):
        for n, entry in enumerate(value):
            _finite(entry, f"{path}[{n}]")


def resolve(tables: Table, folder: Path) -> Table:
    """Returns the tables with every default written out, in the shape of `Scenario`.

    Args:
        tables: as an author wrote them.
        folder: where files that they name lie.
    """
    _known(tables, _TOP + _TABLES, "")
    _finite(tables, "")
    for required in ("name", "sites", "dominance"):
        if required not in tables:
            raise ScenarioError("is missing", path=required)
    groups: dict[str, type[msgspec.Struct]] = {**_GROUPS, "expect": Expect}
    for group, kind in groups.items():
        _known(tables.get(group, {}), _fields(kind), group)
    _resolve_control(tables.get("control", {}), {}, "control")
    sites = _resolve_sites(tables)
    rows = _resolve_dominance(tables, list(sites))
    links = _resolve_links(tables, list(sites), folder)
    resolved = {key: _unix_lines(tables[key]) for key in _TOP if key in tables and key != "rate_hz"}
    return {
        "duration_s": 20.0,
        "seed": 1,
        "scheme": "second_order",
        **resolved,
        "sites": sites,
        "dominance": rows,
        "links": links,
        "timeline": _resolve_timeline(tables.get("timeline", []), links, list(sites)),
        "expect": tables.get("expect", {}),
    }


def _resolve_control(written: Any, default: Table, path: str) -> Table:
    """Returns a law and its gains: what is written, and the rest from a default of the same law."""
    if not isinstance(written, dict):
        raise ScenarioError("must be a table", path=path)
    law = str(written.get("law", default.get("law", "adaptive")))
    _one_of(law, list(LAWS), f"{path}.law")
    own = _known(written, ("law", *_fields(LAWS[law])), path)
    inherited = default if default.get("law", "adaptive") == law else {}
    return _vectors({**inherited, **own, "law": law})


def _one_of(word: Any, valid: Sequence[str], path: str) -> None:
    if word not in valid:
        hint = nearest(str(word), valid)
        raise ScenarioError(f"is {word!r}, must be one of {', '.join(map(repr, valid))}{hint}", path=path)


def _unix_lines(value: Any) -> Any:
    """Returns text with one kind of line ends, which is what TOML keeps; other values as they are."""
    if isinstance(value, list):
        return [_unix_lines(entry) for entry in value]
    return value.replace("\r\n", "\n").replace("\r", "\n") if isinstance(value, str) else value


def _resolve_sites(tables: Table) -> Table:
    sites: Table = {}
    if not isinstance(tables["sites"], dict):
        raise ScenarioError("must be tables [sites.NAME]", path="sites")
    for name, written in tables["sites"].items():
        path = f"sites.{name}"
        if not _SITE_NAME.fullmatch(name) or name in _RESERVED:
            raise ScenarioError(
                "a site's name is lower-case letters, digits and _, beginning with a letter, "
                f"and not {_RESERVED[0]!r}",
                path=path,
            )
        site = _vectors(_known(written, _SITE, path))
        site["control"] = _resolve_control(
            site.get("control", {}), tables.get("control", {}), f"{path}.control"
        )
        for group, kind in _GROUPS.items():
            own = _known(site.get(group, {}), _fields(kind), f"{path}.{group}")
            site[group] = _vectors({**tables.get(group, {}), **own})
        site.setdefault("role", "master")
        site.setdefault("rate_hz", tables.get("rate_hz", 1000))
        site.setdefault("q0_rad", [0.0] * JOINTS)
        site.setdefault("qd0_rad_s", [0.0] * JOINTS)
        hands = site.get("hands", [])
        if not isinstance(hands, list):
            raise ScenarioError(f"must be a list of tables [[{path}.hands]]", path=f"{path}.hands")
        site["hands"] = [
            _vectors(_known(h, _fields(Pulse), f"{path}.hands[{n}]")) for n, h in enumerate(hands)
        ]
        sites[name] = {key: site[key] for key in _fields(SiteSpec)}
    if len(sites) < 2:
        raise ScenarioError(f"an experiment has at least two sites, this one has {len(sites)}", path="sites")
    return sites


def _resolve_dominance(tables: Table, names: list[str]) -> Table:
    written = _known(tables["dominance"], names, "dominance")
    rows: Table = {}
    for own, name in enumerate(names):
        path = f"dominance.{name}"
        if name not in written:
            raise ScenarioError("is missing: whom does this site follow?", path=path)
        rows[name] = _row(_known(written[name], names, path), names, own, path)
    return rows


def _row(row: Table, names: list[str], own: int, path: str) -> Table:
    """Returns one row of the dominance matrix with every peer's share, checked."""
    for peer, share in row.items():
        if isinstance(share, bool) or not isinstance(share, int | float):
            raise ScenarioError(f"must be a number, is {share!r}", path=f"{path}.{peer}")
    fault = dominance.row_fault(np.array([float(row.get(peer, 0.0)) for peer in names]), own)
    if fault:
        raise ScenarioError(fault, path=path)
    return {peer: float(row.get(peer, 0.0)) for peer in names if peer != names[own]}


def _resolve_links(tables: Table, names: list[str], folder: Path) -> Table:
    every = [f"{j}->{i}" for i in names for j in names if i != j]
    written = _known(tables.get("links", {}), every, "links")
    default = resolve_link(tables.get("link", {}), {}, "link")
    links: Table = {}
    for name in every:
        path = f"links.{name}"
        link = resolve_link(written.get(name, {}), default, path)
        if link["model"] == "trace":
            shared = "file" in default and "file" not in written.get(name, {})
            link = _with_trace(link, name, "link" if shared else path, folder)
        for field in msgspec.structs.fields(LINKS[link["model"]]):
            if field.required and field.name not in link:
                raise ScenarioError("is missing; give it here or in [link]", path=f"{path}.{field.name}")
        links[name] = link
    return links


def resolve_link(written: Any, base: Table, path: str) -> Table:
    """Returns a link: what is written upon what it was, or anew where a model or a preset is named.

    The file of a trace is not read yet.

    Args:
        written: the author's table.
        base: what the link is otherwise.
        path: what errors call it.
    """
    if not isinstance(written, dict):
        raise ScenarioError("must be a table", path=path)
    start = {} if "model" in written or "preset" in written else base
    if "preset" in written:
        _one_of(written["preset"], list(PRESETS), f"{path}.preset")
        start = PRESETS[written["preset"]]
    model = written.get("model", start.get("model", "constant"))
    _one_of(model, list(LINKS), f"{path}.model")
    if model != start.get("model", model):
        named = f"the preset {written['preset']!r} is {start['model']!r}: give one of the two"
        raise ScenarioError(f"is {model!r}, but {named}", path=f"{path}.model")
    files = _FILE if model == "trace" else ()
    valid = ("model", "preset", *_fields(LINKS[model]), *files)
    own = _known(written, valid, path)
    replaced = _FILE if "trace" in own else ("trace",) if "file" in own else ()
    link = {**{key: value for key, value in start.items() if key not in replaced}, **own, "model": model}
    link.pop("preset", None)
    return link


def _with_trace(link: Table, name: str, path: str, folder: Path) -> Table:
    """Returns a link that holds the trace of its file; of a log that of the link of its name, or of `of`."""
    link = dict(link)
    file, of = (link.pop(key, None) for key in _FILE)
    if ("trace" in link) == (file is not None):
        problem = "give either trace or file" if "trace" in link else "is missing: a table or a log of delays"
        raise ScenarioError(problem, path=f"{path}.file")
    if file is None and of is not None:
        raise ScenarioError("names a link of the log that file names", path=f"{path}.of")
    if file is not None:
        try:
            link["trace"] = read_trace(folder / str(file), str(of or name))
        except ScenarioError as error:
            raise ScenarioError(error.problem, path=f"{path}.file") from None
    return link


def _resolve_timeline(written: Any, links: Table, names: list[str]) -> list[Table]:
    """Returns the changes, each complete in itself, checked against the sites and the change before."""
    if not isinstance(written, list):
        raise ScenarioError("must be a list of tables [[timeline]]", path="timeline")
    present = dict(links)
    changes = []
    before_s = 0.0
    for n, entry in enumerate(written):
        path = f"timeline[{n}]"
        change = dict(_known(entry, _fields(Change), path))
        at_s = change.get("at_s")
        if not isinstance(at_s, int | float) or isinstance(at_s, bool):
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
        if "link" in change:
            change["to"] = present[change["link"]] = change_link(
                change.get("to", {}), change["link"], present, path
            )
        else:
            change["to"] = change_shares(change.get("to", {}), change["dominance"], names, path)
        changes.append(change)
    return changes


def change_link(written: Any, link: str, present: Table, path: str) -> Table:
    """Returns what a link becomes.

    Args:
        written: what is to change of it.
        link: its name.
        present: what every link is now.
        path: what errors call the change.
    """
    if link not in present:
        hint = nearest(link, list(present)) or f"; links are {', '.join(present)}"
        raise ScenarioError(f"there is no link {link!r}{hint}", path=f"{path}.link")
    after = resolve_link(written, present[link], f"{path}.to")
    before = present[link]
    if "file" in after or "of" in after:
        raise ScenarioError("no file can be named here", path=f"{path}.to.file")
    if after["model"] == "trace" and after.get("trace") != before.get("trace"):
        raise ScenarioError("a run cannot change to another trace", path=f"{path}.to.model")
    if "outages_s" in written and written["outages_s"] != before.get("outages_s"):
        raise ScenarioError("belongs to [links], it cannot change", path=f"{path}.to.outages_s")
    return {**after, "outages_s": before["outages_s"]} if "outages_s" in before else after


def change_shares(written: Any, site: str, names: list[str], path: str) -> Table:
    """Returns a row of the dominance matrix, complete and checked.

    Args:
        written: the shares; a peer that is not named has none.
        site: whose row it is.
        names: the sites.
        path: what errors call the change.
    """
    if site not in names:
        hint = nearest(site, names) or f"; sites are {', '.join(names)}"
        raise ScenarioError(f"there is no site {site!r}{hint}", path=f"{path}.dominance")
    return _row(_known(written, names, f"{path}.to"), names, names.index(site), f"{path}.to")
