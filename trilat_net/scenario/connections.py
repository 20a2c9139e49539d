"""Who hears whom and how, from what an author wrote: rows of shares, links, and how both change.

Law: what a person writes is checked in the shape in which it was written; a change is made complete upon what
was there before it.
"""

from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from ..core import dominance
from ..errors import ScenarioError
from .links import LINKS
from .presets import PRESETS
from .tables import Table, fields, is_number, known, nearest, one_of
from .timeline import Change
from .traces import read_trace

_FILE = ("file", "of")
"""Keys that say where a trace comes from; a resolved link has the trace in their place."""


def resolve_row(row: Table, names: list[str], own: int, path: str) -> Table:
    """Returns one row of the dominance matrix with every peer's share, checked."""
    for peer, share in row.items():
        if not is_number(share):
            raise ScenarioError(f"must be a number, is {share!r}", path=f"{path}.{peer}")
    fault = dominance.row_fault(np.array([float(row.get(peer, 0.0)) for peer in names]), own)
    if fault:
        raise ScenarioError(fault, path=path)
    return {peer: float(row.get(peer, 0.0)) for peer in names if peer != names[own]}


def resolve_links(tables: Table, names: list[str], folder: Path | None) -> Table:
    """Returns every link, complete, from [link] and [links].

    Args:
        tables: the scenario's.
        names: the sites.
        folder: where a trace's file lies; None where no file may be named.
    """
    every = [f"{j}->{i}" for i in names for j in names if i != j]
    written = known(tables.get("links", {}), every, "links")
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
        one_of(written["preset"], list(PRESETS), f"{path}.preset")
        start = PRESETS[written["preset"]]
    model = written.get("model", start.get("model", "constant"))
    one_of(model, list(LINKS), f"{path}.model")
    if model != start.get("model", model):
        named = f"the preset {written['preset']!r} is {start['model']!r}: give one of the two"
        raise ScenarioError(f"is {model!r}, but {named}", path=f"{path}.model")
    files = _FILE if model == "trace" else ()
    valid = ("model", "preset", *fields(LINKS[model]), *files)
    own = known(written, valid, path)
    replaced = _FILE if "trace" in own else ("trace",) if "file" in own else ()
    link = {**{key: value for key, value in start.items() if key not in replaced}, **own, "model": model}
    link.pop("preset", None)
    return link


def _with_trace(link: Table, name: str, path: str, folder: Path | None) -> Table:
    """Returns a link that holds the trace of its file; of a log that of the link of its name, or of `of`."""
    link = dict(link)
    file, of = (link.pop(key, None) for key in _FILE)
    if ("trace" in link) == (file is not None):
        problem = "give either trace or file" if "trace" in link else "is missing: a table or a log of delays"
        raise ScenarioError(problem, path=f"{path}.file")
    if file is None and of is not None:
        raise ScenarioError("names a link of the log that file names", path=f"{path}.of")
    if file is not None:
        if folder is None:
            raise ScenarioError("no file may be named here", path=f"{path}.file")
        try:
            link["trace"] = read_trace(folder / str(file), str(of or name))
        except ScenarioError as error:
            raise ScenarioError(error.problem, path=f"{path}.file") from None
    return link


def resolve_timeline(written: Any, links: Table, names: list[str]) -> list[Table]:
    """Returns the changes, each complete in itself, checked against the sites and the change before."""
    if not isinstance(written, list):
        raise ScenarioError("must be a list of tables [[timeline]]", path="timeline")
    present = dict(links)
    changes = []
    before_s = 0.0
    for n, entry in enumerate(written):
        path = f"timeline[{n}]"
        change = dict(known(entry, fields(Change), path))
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
    return resolve_row(known(written, names, f"{path}.to"), names, names.index(site), f"{path}.to")
