"""Loads scenarios from files, strings, tables or logs.

Overrides such as `control.Kd=5` change individual keys while loading, without editing the file.

Invariant:
    - A scenario from a log or from another member of a session is not trusted. It must not name
      files, its traces (recorded delays of a network) must be written out, and its code does
      not run until a person permits it.
"""

import pickle
import re
import tomllib
from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from threading import RLock
from typing import Any, NamedTuple

import tomli_w

from ..errors import ScenarioError, suggest_nearest
from ..files import open_regular
from ..own_code import allow_own_code, name_law_classes
from ..toml_text import parse_toml
from .named_files import SHIPPED_FOLDER
from .override import ScenarioOverrides, find_written_path
from .resolve import resolve_scenario
from .scenario_types import Scenario
from .validate import build_scenario

_MAX_NAME_LENGTH = 80


def list_shipped() -> list[str]:
    """Returns the names of the example scenarios in the package.

    These are the names listed by `trilat scenario list`. Files whose names begin with an
    underscore are excluded.

    >>> "paper" in tn.list_shipped()
    True
    """
    files = [entry.name for entry in SHIPPED_FOLDER.iterdir()]
    return sorted(
        file.removesuffix(".toml")
        for file in files
        if file.endswith(".toml") and not file.startswith("_")
    )


def read_shipped(name: str) -> str:
    """Returns the TOML source of an example scenario in the package, such as "paper".

    Args:
        name: Name of the scenario. Unlisted files, whose names begin with an underscore, are
            also accepted.

    Raises:
        ScenarioError: There is no such scenario.
    """
    file = SHIPPED_FOLDER / f"{name}.toml"
    shipped_names = list_shipped()
    if name not in shipped_names and not (len(name) < _MAX_NAME_LENGTH and file.is_file()):
        hint = suggest_nearest(name, shipped_names)
        # A hint ends the sentence with a question mark.
        separator = " The" if hint else "; the"
        raise ScenarioError(
            f"there is no scenario of that name{hint}{separator} shipped scenarios are "
            f"{', '.join(shipped_names)}; name a file by its path, as in ./mine.toml",
            source=name,
        )
    return file.read_text(encoding="utf-8")


def read_template() -> str:
    """Returns the template written by `trilat scenario new`: a valid, commented scenario.

    Users edit it to describe their own experiment.

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
    """Loads a scenario and applies overrides to it.

    Equivalent to the command `trilat scenario show`.

    >>> tn.load_scenario("paper", {"control.Kd": 5}).names
    ('m1', 'm2', 's')

    Args:
        source: Name of a scenario in the package, path of a file, TOML source of several lines,
            tables, a `Scenario`, or a run or log (which contains a scenario).
        overrides: Keys to change, for example `{"control.Kd": 5}` or `["control.Kd=5"]`. If
            `source` is a `Scenario`, a key of a group such as `control` applies to all sites or
            links (see `override`).
        duration_s: Duration of the run, in s. By default, that of the scenario.
        seed: Random seed. By default, that of the scenario. With a different seed, numbers
            specified as distributions are drawn again.

    Raises:
        ScenarioError: The source cannot be read or is not a valid scenario.
    """
    source = getattr(source, "scenario", source)
    if isinstance(source, Scenario):
        changed_seed = seed if overrides or seed != source.seed else None
        pairs = _join_overrides(overrides, duration_s, changed_seed)
        return _change_scenario(source, pairs)
    pairs = _join_overrides(overrides, duration_s, seed)
    experiment = ExperimentText.read(source)
    is_text = isinstance(source, Mapping) or "\n" in str(source)
    label = "scenario" if is_text else experiment.label
    return allow_own_code(parse_scenario(experiment.text, label, pairs, experiment.folder))


def _join_overrides(
    overrides: Mapping[str, Any] | Sequence[str], duration_s: float | None, seed: int | None
) -> Mapping[str, Any] | Sequence[str]:
    """Adds a duration and a seed to the overrides, unless they are None.

    The result has the type of `overrides`: a mapping, or a list of strings.
    """
    options = {"duration_s": duration_s, "seed": seed}
    chosen_options = {key: value for key, value in options.items() if value is not None}
    if isinstance(overrides, Mapping):
        return {**overrides, **chosen_options}
    texts = overrides if isinstance(overrides, list | tuple) else [overrides]
    return [*texts, *(f"{key}={value}" for key, value in chosen_options.items())]


def _change_scenario(
    scenario: Scenario, overrides: Mapping[str, Any] | Sequence[str]
) -> Scenario:
    """Returns a copy of a scenario with overrides applied.

    A key such as `control` applies to all sites. By naming a class in an override, a user
    permits its code to run.

    Raises:
        ScenarioError: An override is not valid.
    """
    parsed = ScenarioOverrides(())
    try:
        parsed = ScenarioOverrides.parse(overrides)
        values = dict(parsed.expand(scenario).pairs)
        changed = scenario
        if overrides:
            changed = parse_scenario(scenario.text, scenario.name, values)
        # A person who names the class of a law, hand or plant in an override permits its code
        # to run.
        named_classes = re.findall(r"[\w.]+:\w+", repr(list(values.values())))
        return allow_own_code(changed, named_classes, scenario)
    except ScenarioError as error:
        path = find_written_path(error, parsed.nest())
        raise ScenarioError(error.problem, path=path, source=scenario.name) from None


class ExperimentText(NamedTuple):
    """Source text of a scenario, before it is validated and completed.

    Attributes:
        label: Name under which a command finds the scenario: the name of a scenario in the
            package, or a path. For a scenario that is not in a file, the path at which a
            command would look for it.
        text: TOML source.
        folder: Folder in which files named in the scenario are looked up. None for a resolved
            scenario, which names no files.
    """

    label: str
    text: str
    folder: Path | None

    def read_tables(self, overrides: Sequence[str]) -> dict[str, Any]:
        """Parses the source and applies overrides, without validating the result.

        Args:
            overrides: Strings of the form KEY=VALUE.

        Raises:
            ScenarioError: The source is not valid TOML, or an override is not valid.
        """
        tables: dict[str, Any] = pickle.loads(_parse_toml(self.text))
        ScenarioOverrides.parse(overrides).apply_to(tables)
        return tables

    def load(self, overrides: Sequence[str] = ()) -> Scenario:
        """Applies overrides to the source and converts it to a complete scenario.

        Args:
            overrides: Strings of the form KEY=VALUE. Empty by default.

        Raises:
            ScenarioError: The result is not a valid scenario.
        """
        if self.folder is None:
            return load_scenario(parse_scenario(self.text, self.label, folder=None), overrides)
        return allow_own_code(parse_scenario(self.text, self.label, overrides, self.folder))

    @classmethod
    def read(cls, source: str | Path | Mapping[str, Any] | Scenario) -> "ExperimentText":
        """Reads the source of a scenario without validating it.

        Args:
            source: Name of a scenario in the package, path of a file, TOML source, nested
                dictionaries of settings, or a `Scenario`.

        Raises:
            ScenarioError: The source cannot be read.
        """
        if isinstance(source, Scenario):
            return ExperimentText(f"./{source.name}.toml", source.text, None)
        if isinstance(source, Mapping):
            name = str(source.get("name", "scenario"))
            text = tomli_w.dumps(name_law_classes(source))
            return ExperimentText(f"./{name}.toml", text, Path())
        if isinstance(source, str) and "\n" in source:
            return ExperimentText("./scenario.toml", source, Path())
        text, folder = _read_source(source)
        return ExperimentText(str(source), text, folder)


def _read_source(source: str | Path) -> tuple[str, Path]:
    """Reads the TOML source of a scenario from the package or from a file.

    Args:
        source: Name of a scenario in the package, or a path. Treated as a path if it ends in
            ".toml" or contains a slash or backslash.

    Returns:
        The TOML source, and the folder in which files named in the scenario are looked up.

    Raises:
        ScenarioError: The source cannot be read.
    """
    name = str(source)
    is_path = isinstance(source, Path) or name.endswith(".toml") or "/" in name or "\\" in name
    if not is_path:
        return read_shipped(name), Path()
    try:
        with open_regular(Path(source), encoding="utf-8") as stream:
            return stream.read(), Path(source).parent
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "not UTF-8 text"
        raise ScenarioError(f"cannot be read: {reason}", source=name) from None


_PARSE_LOCK = RLock()
"""Held while a scenario is parsed.

msgspec 0.22 crashes if two threads use a type for the first time at once.
"""


def parse_scenario(
    text: str,
    source: str = "",
    overrides: Mapping[str, Any] | Sequence[str] = (),
    folder: Path | None = Path(),
) -> Scenario:
    """Parses the TOML source of a scenario into a complete, validated `Scenario`.

    Args:
        text: Content of a scenario file.
        source: Name of the source, for error messages.
        overrides: Keys to change (see `load_scenario`).
        folder: Folder in which files named in the scenario are looked up. If None, a scenario
            that names a file is rejected.

    Raises:
        ScenarioError: The source is not a valid scenario. The error contains the path of the
            key.
    """
    written: dict[str, Any] = {}
    with _PARSE_LOCK:
        try:
            tables = pickle.loads(_parse_toml(text))
            written = tables
            parsed = ScenarioOverrides.parse(overrides)
            applicable, waiting = parsed.split_entries(tables)
            applicable.apply_to(tables)
            scenario = build_scenario(resolve_scenario(tables, folder))
            if waiting.pairs:
                # The vectors of these entries exist only in the resolved scenario.
                written = waiting.nest()
                tables = tomllib.loads(scenario.text)
                waiting.expand(scenario).apply_to(tables)
                scenario = build_scenario(resolve_scenario(tables, folder))
            return scenario
        except ScenarioError as error:
            path = find_written_path(error, written)
            raise ScenarioError(error.problem, path=path, source=source) from None
        except RecursionError:
            raise ScenarioError("is nested too deeply", source=source) from None


@lru_cache(maxsize=4)
def _parse_toml(text: str) -> bytes:
    """Parses TOML and returns the tables, pickled.

    The runs of a study share one source with different overrides. Copying the tables takes far
    less time than parsing the source again.

    Raises:
        ScenarioError: The text is not valid TOML, or contains a key with too many parts.
    """
    return pickle.dumps(parse_toml(text))


def parse_embedded(text: str, source: str = "") -> Scenario:
    """Parses a scenario that comes from a log or from another process.

    Such a source is not trusted. A short text could fill the memory, because a delay trace in
    the table for all links is repeated for every link. The traces of all links together must
    therefore not be longer than the text itself.

    Args:
        text: TOML source of a resolved scenario, which names no files.
        source: Name of the source, for error messages.

    Raises:
        ScenarioError: The scenario is not valid, names a file, or contains delay traces that
            are together longer than the source.
    """
    scenario = parse_scenario(text, source, folder=None)
    changed_links = [change.after for change in scenario.timeline if change.link]
    links = [*scenario.links.values(), *changed_links]
    trace_length = sum(len(getattr(link, "trace", "")) for link in links)
    if trace_length > len(text):
        raise ScenarioError(
            "the traces are not written out separately for every link", source=source
        )
    return scenario
