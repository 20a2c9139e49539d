"""Scenarios by name, by path or from a log, with overrides applied.

Invariant: text from a log or a peer is not trusted: it names no file, its laws may not run, and
it writes out what it has.
"""

import re
import tomllib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from threading import RLock
from typing import Any, NamedTuple

import tomli_w

from ..errors import ScenarioError
from ..fields import suggest_nearest
from ..files import open_regular
from .code_consent import allow_own_code
from .imported_code import name_law_classes
from .override import apply_overrides, expand_overrides, parse_overrides, split_entries
from .resolve import SHIPPED_FOLDER, resolve_scenario
from .scenario_types import Scenario, SiteSpec
from .validate import build_scenario

MAX_KEY_PARTS = 32
"""Parts of a key, as in sites.m1.arm; a scenario needs four."""


def list_shipped() -> list[str]:
    """Returns the names of the scenarios that come with the package; the command is `trilat
    scenario list`.

    >>> "paper" in tn.list_shipped()
    True
    """
    names = (entry.name for entry in SHIPPED_FOLDER.iterdir())
    return sorted(
        n.removesuffix(".toml") for n in names if n.endswith(".toml") and not n.startswith("_")
    )


def read_shipped(name: str) -> str:
    """Returns the TOML text of a shipped scenario, of one that is not listed too: its name
    begins with _.
    """
    if name not in list_shipped() and not (
        len(name) < 80 and (SHIPPED_FOLDER / f"{name}.toml").is_file()
    ):
        raise ScenarioError(
            f"no scenario of that name{suggest_nearest(name, list_shipped())}; "
            f"shipped are {', '.join(list_shipped())}; a file is named by its path, as in ./mine.toml",
            source=name,
        )
    return (SHIPPED_FOLDER / f"{name}.toml").read_text(encoding="utf-8")


def read_template() -> str:
    """Returns the commented template of a scenario, valid as it stands; as `trilat scenario
    new`.

    >>> tn.load_scenario(tn.read_template()).names
    ('m1', 'm2', 's')
    """
    return (SHIPPED_FOLDER / "_template.toml").read_text(encoding="utf-8")


def load_scenario(
    source: str | Path | Mapping[str, Any] | Scenario,
    overrides: Mapping[str, Any] | Sequence[str] = (),
    *,
    duration_s: float | None = None,
    seed: int | None = None,
) -> Scenario:
    """Returns a scenario with overrides applied; the command is `trilat scenario show`.

    >>> tn.load_scenario("paper", {"control.Kd": 5}).names
    ('m1', 'm2', 's')

    Args:
        source: the name of a shipped scenario, a path, a TOML text of several lines, its
            tables, a scenario, or a run or log, which has one.
        overrides: as in `{"control.Kd": 5}` or `["control.Kd=5"]`; in a scenario a key of a
            group applies to all (`override`).
        duration_s: the duration, s; by default the scenario's.
        seed: the seed; by default the scenario's.

    Raises:
        ScenarioError: the source cannot be read or is not a valid scenario.
    """
    source = getattr(source, "scenario", source)
    given = {"duration_s": duration_s, "seed": seed}
    more = {key: value for key, value in given.items() if value is not None}
    if isinstance(overrides, Mapping):
        overrides = {**overrides, **more}
    else:
        listed = overrides if isinstance(overrides, list | tuple) else [overrides]
        overrides = [*listed, *(f"{key}={value}" for key, value in more.items())]
    if isinstance(source, Scenario):
        try:
            expanded = expand_overrides(source, parse_overrides(overrides))
            changed = (
                parse_scenario(source.text, source.name, expanded) if overrides else source
            )
            # of laws, hands and plants
            named = re.findall(r"[\w.]+:\w+", repr(list(expanded.values())))
            return allow_own_code(changed, named, source)
        except ScenarioError as error:
            raise ScenarioError(error.problem, path=error.path, source=source.name) from None
    found = read_experiment(source)
    in_file = not isinstance(source, Mapping) and "\n" not in str(source)
    called = found.label if in_file else "scenario"
    return allow_own_code(parse_scenario(found.text, called, overrides, found.folder))


class ExperimentText(NamedTuple):
    """An experiment as its author wrote it.

    Attributes:
        label: what a command calls it: a shipped name or a path; of one that is in no file the
            path at which a command would look for it.
        folder: of the files that it names; None: it is resolved, and names none.
    """

    label: str
    text: str
    folder: Path | None

    def load(self, overrides: Sequence[str] = ()) -> Scenario:
        """Returns it with overrides.

        Raises:
            ScenarioError: it is not valid with them.
        """
        if self.folder is None:
            return load_scenario(parse_scenario(self.text, self.label, folder=None), overrides)
        return allow_own_code(parse_scenario(self.text, self.label, overrides, self.folder))


def read_experiment(source: str | Path | Mapping[str, Any] | Scenario) -> ExperimentText:
    """Returns the text of a shipped name, a path, a TOML text, tables, or a scenario.

    Raises:
        ScenarioError: it cannot be read.
    """
    if isinstance(source, Scenario):
        return ExperimentText(f"./{source.name}.toml", source.text, None)
    if isinstance(source, Mapping):
        named = str(source.get("name", "scenario"))
        return ExperimentText(
            f"./{named}.toml", tomli_w.dumps(name_law_classes(source)), Path()
        )
    if isinstance(source, str) and "\n" in source:
        return ExperimentText("./scenario.toml", source, Path())
    text, folder = read_source(source)
    return ExperimentText(str(source), text, folder)


def reseed_scenario(scenario: Scenario, seed: int) -> Scenario:
    """Returns the same experiment with another seed, which draws its random numbers again.

    Raises:
        ScenarioError: the seed is not valid, or draws a number that its key does not take.
    """
    return load_scenario(scenario, {"seed": seed}) if scenario.seed != seed else scenario


def read_source(source: str | Path) -> tuple[str, Path]:
    """Returns the TOML text of a shipped name or a path, and the folder of the files that it
    names.

    Raises:
        ScenarioError: it cannot be read.
    """
    name = str(source)
    if not (isinstance(source, Path) or name.endswith(".toml") or "/" in name or "\\" in name):
        return read_shipped(name), Path()
    try:
        with open_regular(Path(source), encoding="utf-8") as stream:
            return stream.read(), Path(source).parent
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "not UTF-8 text"
        raise ScenarioError(f"cannot be read: {reason}", source=name) from None


def find_site(scenario: Scenario, name: str) -> SiteSpec:
    """Returns a site of a scenario.

    Raises:
        ScenarioError: it has no site of that name.
    """
    if name not in scenario.sites:
        hint = suggest_nearest(name, scenario.names)
        raise ScenarioError(
            f"no site {name!r}{hint}; its sites are {', '.join(scenario.names)}",
            source=scenario.name,
        )
    return scenario.sites[name]


_TURN = RLock()
"""msgspec crashes where two threads are the first to use a type (0.22)."""


def parse_scenario(
    text: str,
    source: str = "",
    overrides: Mapping[str, Any] | Sequence[str] = (),
    folder: Path | None = Path(),
) -> Scenario:
    """Returns the scenario that a TOML text describes; errors call it `source`.

    The files that it names are in `folder`; None: it may name none.

    Raises:
        ScenarioError: with the path of the offending key.
    """
    with _TURN:
        try:
            _refuse_long_keys(text)
            try:
                tables = tomllib.loads(text)
            except (
                ValueError
            ) as error:  # TOMLDecodeError is one; a number of 5000 digits is another
                raise ScenarioError(f"is not TOML: {error}") from None
            own, of_entries = split_entries(tables, parse_overrides(overrides))
            apply_overrides(tables, own)
            scenario = build_scenario(resolve_scenario(tables, folder))
            if of_entries:
                tables = tomllib.loads(scenario.text)
                apply_overrides(tables, expand_overrides(scenario, of_entries))
                scenario = build_scenario(resolve_scenario(tables, folder))
            return scenario
        except ScenarioError as error:
            raise ScenarioError(error.problem, path=error.path, source=source) from None
        except RecursionError:
            raise ScenarioError("is nested too deep", source=source) from None


_KEY_PART = re.compile(
    r"""(?P<word>[\w-]+|"[^"]*"|'[^']*')|(?P<dot>\s{0,9}\.\s{0,9})|(?P<other>.)"""
)


def _refuse_long_keys(text: str) -> None:
    """Refuses keys of very many parts: the time of a parser grows by more than the square of
    their number.

    Raises:
        ScenarioError: with the line of the key.
    """
    for number, line in enumerate(text.split("\n"), 1):
        if line.count(".") < MAX_KEY_PARTS:
            continue
        dots = 0
        before = ""
        for found in _KEY_PART.finditer(line):
            kind = found.lastgroup or ""
            dots = dots + (kind == "dot") if {kind, before} == {"word", "dot"} else 0
            before = kind
            if dots >= MAX_KEY_PARTS:
                raise ScenarioError(f"line {number}: a key has more than {MAX_KEY_PARTS} parts")


def parse_embedded(text: str, source: str = "") -> Scenario:
    """Returns the resolved scenario of a log or a peer, which is not trusted.

    Raises:
        ScenarioError: it is not valid, or names a file, or would fill the memory by its
            defaults.
    """
    scenario = parse_scenario(text, source, folder=None)
    changed = (change.after for change in scenario.timeline if change.link)
    traces = sum(
        len(getattr(link, "trace", "")) for link in (*scenario.links.values(), *changed)
    )
    if traces > len(text):
        raise ScenarioError("its traces are not written out, link by link", source=source)
    return scenario


def embedded_names_reader(source: str) -> Callable[[str], tuple[str, ...]]:
    """Returns the function that reads the sites' names of embedded scenarios; errors call these
    `source`.
    """
    return lambda text: parse_embedded(text, source).names
