"""One choice of gains as a scenario, and as the command that runs it.

Law: a candidate's scenario is loaded through the very settings that its command names, so that the command
runs what was measured.
"""

import shlex
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

from ..errors import ScenarioError
from ..scenario import Scenario, load
from .goal import twin
from .knowledge import Knowledge
from .pool import Task
from .space import Controls, Gains, Space


class Base(NamedTuple):
    """The experiment in which laws are compared.

    Attributes:
        source: what a command calls it: a shipped name or a path.
        overrides: what was changed of it, as texts KEY=VALUE.
        scenario: it, with those.
    """

    source: str
    overrides: tuple[str, ...]
    scenario: Scenario

    def with_controls(self, controls: Controls) -> "Base":
        """Returns the same with the control of every site replaced, in as few settings as say it."""
        single = [f"sites.{name}.control={_inline(table)}" for name, table in controls.items()]
        wanted = load(self.source, [*self.overrides, *single])
        first = next(iter(controls.values()))
        if all(table == first for table in controls.values()):
            texts = (*self.overrides, f"control={_inline(first)}")
            with suppress(ScenarioError):  # a site has gains of its own, which are none of this law
                scenario = load(self.source, texts)
                if scenario.sites == wanted.sites:
                    return Base(self.source, texts, scenario)
        return Base(self.source, (*self.overrides, *single), wanted)

    def with_gains(self, space: Space, knowledge: Knowledge, gains: Gains) -> "Base":
        """Returns the same under a law with a choice of gains."""
        return self.with_controls(space.controls(self.scenario, knowledge, gains))

    @property
    def task(self) -> Task:
        """What has to be run to measure it."""
        alone = twin(self.scenario)
        return self.scenario.text, None if alone is None else alone.text

    @property
    def command(self) -> str:
        """The command that makes a log of it."""
        words = [word for text in self.overrides for word in ("--set", text)]
        return shlex.join(["trilat", "sim", self.source, *words])


def base(source: str | Path, overrides: Sequence[str] = ()) -> Base:
    """Returns the experiment that a name or path and overrides mean.

    Raises:
        ScenarioError: there is none.
    """
    return Base(str(source), tuple(overrides), load(source, overrides))


def _inline(value: Any) -> str:
    """Returns a value as TOML on one line."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key} = {_inline(entry)}" for key, entry in value.items()) + "}"
    if isinstance(value, list):
        return f"[{', '.join(map(_inline, value))}]"
    if isinstance(value, str):
        return f'"{value}"'
    return f"{value:g}" if float(f"{value:g}") == value else repr(value)
