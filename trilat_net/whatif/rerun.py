"""Replay into the experiment: one or more sites of a log executed afresh, and what that changed.

    again = rerun("run.mcap", replace=["s"], set={"control.Kd": 5})
    again.sites["s"].error_rms_rad, again.after["s"].q

Law: in an open loop the recorded sites do not react; in a closed loop every site is executed and reacts, over
the network of the log. Nothing changed, both give the log, bit for bit.
"""

import io
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from .. import collector
from ..core.fingerprint import fingerprint
from ..log.chunks import Progress
from ..log.container import Sink
from ..log.logfile import new_log
from ..log.reader import Log, open_log
from ..log.views import VIEWS_HZ
from ..replay.outside import outside_laws
from ..replay.verify import executed_sites
from .actor import Made
from .effect import LinkEffect, SiteEffect, effects
from .performance import Performance
from .premise import Overrides, Premise, premise
from .recording import write
from .wording import lines

_MOST = 120


@dataclass(frozen=True, repr=False)
class Rerun:
    """A log and what became of it.

    Attributes:
        before: the log.
        premise: what was asked of it.
        made: every tick that was made, in the order in which they were.
        sites: per site that was executed what it changed.
        links: the same of the links that these sites receive over.
    """

    before: Log
    premise: Premise
    made: list[Made]
    sites: dict[str, SiteEffect]
    links: dict[str, LinkEffect]

    def __repr__(self) -> str:
        asked = self.premise
        changed = "; ".join(lines(asked)) or "nothing changed"
        words = f"{asked.mode}, {', '.join(asked.replaced)} executed afresh, {changed}"
        return f"<Rerun of {self.before.source}: {words[:_MOST]}>"

    @cached_property
    def after(self) -> Log:
        """The rerun as a log: the sites that were executed, and the others as they were recorded."""
        stream = io.BytesIO()
        self.write(stream)
        stream.seek(0)
        return open_log(stream)

    def write(self, stream: Sink) -> None:
        """Writes the same into a stream, which stays open.

        Raises:
            LogRefused: the disk refused.
        """
        write(self.before, self.premise, self.made, stream)

    def save(self, path: Path, *, force: bool = False) -> None:
        """Writes the same into a file, with the channels that viewers read.

        Args:
            path: the file.
            force: whether it may replace one.

        Raises:
            UsageError: the file exists, or cannot be made.
            LogRefused: the disk refused.
        """
        with new_log(path, force=force) as stream:
            write(self.before, self.premise, self.made, stream, VIEWS_HZ)

    @property
    def diverged(self) -> bool:
        """True where a site left its limits that had not left them in the log."""
        return any(
            effect.diverged_at_s is not None and self.before[name].states[-1].mode != "diverged"
            for name, effect in self.sites.items()
        )

    @property
    def identical(self) -> bool:
        """True where every record that was compared has the same bits as in the log."""
        return all(effect.identical == effect.compared for effect in self.sites.values())

    @property
    def broken(self) -> bool:
        """True where it should have been the log, bit for bit, and is not."""
        same_platform = self.before.session.get("fingerprint") == fingerprint()
        whole = set(self.premise.replaced) <= set(executed_sites(self.before))
        return same_platform and whole and not self.premise.changes and not self.identical

    @property
    def notes(self) -> list[str]:
        """What limits the answer, a sentence each."""
        return list(_notes(self))

    def facts(self) -> dict[str, Any]:
        """Returns all that there is to say of it, ready for JSON; keys end in their unit."""
        return {
            "log": self.before.source,
            "mode": self.premise.mode,
            "replaced": list(self.premise.replaced),
            "recorded": list(self.premise.recorded),
            "changes": [changed._asdict() for changed in self.premise.changes],
            "without_effect": [changed.key for changed in self.premise.without_effect],
            "identical": self.identical,
            "diverged": self.diverged,
            "sites": {name: _site_facts(effect) for name, effect in self.sites.items()},
            "links": {name: _pairs(effect._asdict()) for name, effect in self.links.items()},
            "notes": self.notes,
        }


def rerun(
    log: str | Path | Log,
    replace: Sequence[str] = (),
    set: Overrides = (),  # noqa: A002 - the command's --set, by its name
    *,
    closed_loop: bool = False,
    progress: Progress | None = None,
) -> Rerun:
    """Executes sites of a log afresh and compares them with it.

    Args:
        log: the log, or where it is.
        replace: which sites; the others stand as recorded and do not react.
        set: what is otherwise for them, as in `{"control.Kd": 5}`.
        closed_loop: executes all of them.
        progress: told now and then how many ticks are made, and how many there will be at most.

    Raises:
        LogError: the log cannot be read, or does not tell enough.
        UsageError: it is not said which sites, or in two ways.
        ScenarioError: there is no such site, or an override is not valid or cannot have an effect.
    """
    before = log if isinstance(log, Log) else open_log(log)
    names = [replace] if isinstance(replace, str) else list(replace)
    asked = premise(before, names, set, closed_loop=closed_loop)
    with collector.paused():
        performance = Performance(before, asked)
        made = list(performance.run(progress))
        by_site: dict[str, list[Made]] = {name: [] for name in asked.replaced}
        for one in made:
            by_site[one.site].append(one)
        sites: dict[str, SiteEffect] = {}
        links: dict[str, LinkEffect] = {}
        for name, ticks in by_site.items():
            site, over = effects(before, asked, performance.actors[name], performance.came[name], ticks)
            sites[name] = site
            links |= {link.link: link for link in over}
    return Rerun(before, asked, made, sites, links)


def _site_facts(effect: SiteEffect) -> dict[str, Any]:
    first = effect.first
    return {**_pairs(effect._asdict()), "first": None if first is None else first._asdict()}


def _known(value: Any) -> Any:
    """Returns a figure as JSON can hold it: one beyond all numbers is not known."""
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _pairs(facts: dict[str, Any]) -> dict[str, Any]:
    """Returns facts with every pair spelt out."""
    return {
        key: _pairs(value._asdict()) if hasattr(value, "_asdict") else _known(value)
        for key, value in facts.items()
    }


def _notes(again: Rerun) -> Iterator[str]:
    log, asked = again.before, again.premise
    if asked.recorded and asked.changes:
        sites = " and ".join(asked.recorded)
        are, do = ("are", "they do") if len(asked.recorded) > 1 else ("is", "it does")
        yield f"{sites} {are} as recorded: nothing is changed there, and {do} not react"
    if others := [name for name in asked.replaced if name not in executed_sites(log)]:
        yield f"this file is a rerun itself: its {', '.join(others)} met samples that are not in it"
    if not asked.changes and not again.identical and log.session.get("fingerprint") != fingerprint():
        yield "the log was made with another platform's arithmetic: equal bits cannot be expected"
    if not log.complete:
        yield "the log was not finished: executed as far as it goes"
    for law in outside_laws(asked.scenario):
        if law.changed and any(site in asked.replaced for site in law.sites):
            yield f"executed as its file is now: {law}"
    yield from _later_changes(again)
    for effect in again.sites.values():
        yield from _unknown(effect)


def _later_changes(again: Rerun) -> Iterator[str]:
    """Says where a link or a row that is otherwise is changed during the run: then that counts."""
    keys = [changed.key for changed in again.premise.changes]
    changes = [c.link or c.dominance for c in again.premise.scenario.timeline]
    for name in again.premise.replaced:
        for commands in again.before.commands(name).values():
            for command in commands:
                peer = again.before[name].peers[command.peer]
                changes.append(name if command.peer < 0 else f"{peer}->{name}")
    for about in dict.fromkeys(changes):
        prefix = f"links.{about}." if "->" in about else f"dominance.{about}."
        if any(key.startswith(prefix) for key in keys):
            yield f"{about} is changed during the run, in the log as here: from then on that counts"


def _unknown(effect: SiteEffect) -> Iterator[str]:
    if effect.stands:
        yield f"{effect.site}: {effect.stands} records stand as they are: too little is known to execute them"
    if effect.assumed:
        yield f"{effect.site}: {effect.assumed} ticks have no record in the log: what arrived then is assumed"
    if effect.lacking:
        yield f"{effect.site}: {effect.lacking} samples that arrived are not in the log: done without them"
    if not effect.executed:
        yield f"{effect.site}: nothing could be executed"
