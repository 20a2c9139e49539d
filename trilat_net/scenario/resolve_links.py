"""Links and rows of the dominance matrix, from an author's tables to complete ones, with the link presets.

Invariant: tables are checked as the author wrote them. A preset is a table that an author could have written
(`scenarios/_presets.toml` has them, each with its source); a resolved scenario holds its keys, not its name.
"""

import tomllib
from importlib import resources
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from ..core import dominance
from ..errors import ScenarioError
from .delay_models import DELAY_MODELS
from .delay_traces import read_trace
from .fields import TomlTable, check_choice, check_keys, field_names, is_number

_PRESETS_FILE = resources.files("trilat_net") / "scenarios" / "_presets.toml"

GRID_ROUND_TRIPS_MS = (8, 68, 136, 272, 544, 1088)
GRID_LOSSES_PERCENT = (0, 10, 25, 50)
"""A grid over the ranges of Rodriguez-Seda, Lee and Spong, "Experimental Comparison Study of Control
Architectures for Bilateral Teleoperators", IEEE Trans. Robotics 25 (2009): round trips of 8 to 1088 ms
and losses of 0 to 50 %. The points are ours; theirs are not known to us."""


_GRID: dict[str, dict[str, Any]] = {
    f"rtt{rtt_ms}-loss{percent}": {"model": "constant", "delay_ms": rtt_ms / 2, "loss": percent / 100}
    for rtt_ms in GRID_ROUND_TRIPS_MS
    for percent in GRID_LOSSES_PERCENT
}
PRESETS: dict[str, dict[str, Any]] = {**tomllib.loads(_PRESETS_FILE.read_text(encoding="utf-8")), **_GRID}
"""Keys of a link by the preset's name; those of the grid: half a round trip each way, single losses."""

TRACE_KEYS = ("file", "of")
"""Keys of an author that name the source of a trace; a resolved link has the trace instead."""


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
    """Returns every link, complete, from [link] and [links]; files of traces lie in `folder`, if any may."""
    every = [f"{j}->{i}" for i in names for j in names if i != j]
    written = check_keys(tables.get("links", {}), every, "links")
    default = resolve_link(tables.get("link", {}), {}, "link")
    links: TomlTable = {}
    for name in every:
        path = f"links.{name}"
        link = resolve_link(written.get(name, {}), default, path)
        if link["model"] == "trace":
            shared = "file" in default and "file" not in written.get(name, {})
            link = _read_trace_file(link, name, "link" if shared else path, folder)
        for field in msgspec.structs.fields(DELAY_MODELS[link["model"]]):
            if field.required and field.name not in link:
                raise ScenarioError("is missing; give it here or in [link]", path=f"{path}.{field.name}")
        links[name] = link
    return links


def resolve_link(written: Any, base: TomlTable, path: str) -> TomlTable:
    """Returns a link: what is written upon its base, or upon nothing if a model or a preset is named.

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
    link = {**{key: value for key, value in start.items() if key not in replaced}, **own, "model": model}
    link.pop("preset", None)
    return link


def _read_trace_file(link: TomlTable, name: str, path: str, folder: Path | None) -> TomlTable:
    """Returns a link with the trace of its file; of a log that of the link of its name, or of `of`."""
    link = dict(link)
    file, of = (link.pop(key, None) for key in TRACE_KEYS)
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
