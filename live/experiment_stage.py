"""What an experiment asks of people on their pages: consent, whether they are ready, a trial,
questionnaires.

Invariant: a reply counts for the step that its page was shown, from the first page of a user's
site alone. A trial is judged by every record of its slave, as its log is afterwards. How long
people rest or are away is told by the monotonic clock. Users are not told the condition.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from typing import Any

import msgspec

from trilat_net.core.ticks import NS_PER_S, tick_ns
from trilat_net.errors import UsageError
from trilat_net.net.clock import Clock
from trilat_net.net.messages import HALTED_MODES
from trilat_net.studies.experiment.protocol import ExperimentPlan, Step
from trilat_net.studies.experiment.trial_run import ExperimentTrial, TrialEntry, TrialJudge

from .page_orders import AbortTrial, StageMessage
from .session_view import SessionView

AWAY_NS = 8 * NS_PER_S
"""A page that is reloaded within a trial is back by then; one that is away for longer ends the
trial.
"""
END_NS = NS_PER_S // 2
"""From the end of a trial to that of its session, in which its last mark reaches the log."""

Json = dict[str, Any]


class TrialWatch:
    """A trial while its session runs.

    Attributes:
        trial: which.
        judge: judges it, record by record.
        aborted: why it is to be made again; "" if it is not.
        diverged: whether an arm went past its limits, with which the trial has failed.
    """

    def __init__(self, trial: ExperimentTrial, clock: Clock) -> None:
        self.trial = trial
        self.judge = TrialJudge(trial)
        self.aborted = ""
        self._clock = clock
        self._next = 0
        self._ended_ns = 0
        self._appeared = self.diverged = False

    @property
    def over(self) -> bool:
        """True once its session can end."""
        ended = self.judge.outcome is not None
        return bool(self.aborted) or (
            ended and self._clock.monotonic_ns() - self._ended_ns > END_NS
        )

    def poll(self, view: SessionView, away: Collection[str]) -> list[str]:
        """Takes in the records that have come, and whose page is `away`; returns moments for
        the log.
        """
        if self.over or self.judge.outcome is not None or not view.running:
            return []
        modes = {name: site.record.mode for name, site in view.sites.items() if site.record}
        self.diverged = "diverged" in modes.values()
        halted = [name for name, mode in modes.items() if mode in HALTED_MODES]
        if away or halted:
            self.aborted = (
                f"the page of {', '.join(away)} is gone"
                if away
                else f"{', '.join(halted)} stopped"
            )
            return [f"trial {self.trial.planned.number} aborted: {self.aborted}"]
        return self._judge(view)

    def _judge(self, view: SessionView) -> list[str]:
        slave = view.sites[self.trial.slave]
        number = self.trial.planned.number
        moments = list[str]()
        first = max(self._next, slave.window.first)
        last = slave.complete
        if last < first:
            return []
        if self._next == 0:
            moments.append(f"trial {number} begins")
        self._next = last + 1
        rows = slave.window.rows(first, last)
        told = rows.known.tolist(), rows.q.tolist(), rows.tau_x.tolist()
        for tick, known, q, tau_x in zip(range(first, last + 1), *told, strict=True):
            t_s = tick_ns(tick, slave.window.rate_hz) / NS_PER_S
            if not self._appeared and t_s >= self.trial.appears_s:
                self._appeared = True
                moments.append("target appears")
            if known and (outcome := self.judge.take(t_s, q, tau_x)) is not None:
                self._ended_ns = self._clock.monotonic_ns()
                return [
                    *moments,
                    f"trial {number} {'succeeded' if outcome.succeeded else 'failed'}",
                ]
        return moments

    def describe(self, t_s: float, site: str) -> Json:
        """Returns what a page draws at a time of its arms, s; a user's page as that user is
        shown it.
        """
        goal = self.judge.goal
        trial = self.trial
        users = self.trial.protocol.users
        at = goal.place(t_s, users.index(site) if site in users else None)
        way = goal.find_corridor(t_s)
        return {
            "target": {"site": trial.slave, "at": at.tolist(), "width_m": goal.width_m},
            **({} if way is None else {"way": {"from": way[0].tolist(), "width_m": way[1]}}),
            "appeared": t_s >= goal.appears_s,
            "left_s": max(0.0, trial.longest_s - max(t_s, goal.appears_s)),
        }


@dataclass
class Asked:
    """A step that people are asked for.

    Attributes:
        step: which.
        from_ns: until then people rest.
        replies: of the users who have done it, by site: the answers, and the page that gave
            them.
    """

    step: Step
    from_ns: int = 0
    replies: dict[str, tuple[dict[str, float | None], int]] = field(default_factory=dict)


class Stage:
    """What pages are shown around a session; the one who runs the experiment sets it, the
    server asks it.

    Attributes:
        users: the sites of those who take part.
        shows_ages: whether pages begin with the ages of samples shown; they could tell the
            answer of a pair.
    """

    def __init__(self, plan: ExperimentPlan, clock: Clock) -> None:
        self.users = plan.protocol.users
        self._plan = plan
        self._clock = clock
        self.shows_ages = plan.protocol.staircase is None
        self._asked: Asked | None = None
        self._watch: TrialWatch | None = None
        self._step: Step | None = None
        self._phase = "checking"
        self._told: Json = {"why": "", "measures": {}}
        self._holders: dict[str, int] = {}
        self._seen_ns: dict[str, int] = {}

    def ask(self, step: Step, rest_s: float = 0.0, done: Collection[str] = ()) -> Asked:
        """Asks users for a step, but those who have `done` it; returns what they reply, as it
        comes.
        """
        asked = Asked(step, self._clock.monotonic_ns() + int(rest_s * NS_PER_S))
        asked.replies |= {site: ({}, 0) for site in done}
        self._step = step
        self._watch = None
        self._phase = step.kind
        self._asked = asked
        return asked

    def begin(self, watch: TrialWatch) -> None:
        """Shows a trial whose session is about to begin."""
        self._asked = None
        self._watch = watch
        self._phase = "starting"

    def check(self) -> None:
        """Shows that a trial has ended, and its log is looked at."""
        self._watch = None
        self._phase = "checking"

    def tell(self, entry: TrialEntry | None, why: str = "") -> None:
        """Shows the feedback on a trial, as far as the protocol has any; or why it is made
        again.
        """
        names = self._plan.protocol.feedback if entry is not None else ()
        self._told = {
            "why": why,
            "measures": {
                name: entry.measures[name] for name in names if entry and name in entry.measures
            },
        }
        if entry is not None and names:
            self._told["succeeded"] = entry.succeeded

    def close(self) -> None:
        """Shows that all is done."""
        self._asked = None
        self._step = None
        self._phase = "over"

    def poll(self, view: SessionView, pages: Sequence[tuple[str, int]]) -> list[str]:
        """Takes in what has come, and site and number of each user's page; returns moments for
        the log.
        """
        now_ns = self._clock.monotonic_ns()
        asked = self._asked
        self._holders = {site: min(n for at, n in pages if at == site) for site, _ in pages}
        self._seen_ns |= dict.fromkeys(self._holders, now_ns)
        if asked is not None and asked.step.kind == "trial":  # who leaves is not ready any more
            for site, (_, page) in list(asked.replies.items()):
                if self._holders.get(site) != page:
                    del asked.replies[site]
        if self._watch is None:
            return []
        if view.running and self._phase == "starting":
            self._phase = "trial"
        away = [
            site for site in self.users if now_ns - self._seen_ns.get(site, now_ns) > AWAY_NS
        ]
        return self._watch.poll(view, away)

    def take(self, site: str, page: int, message: StageMessage) -> bool:
        """Takes a message of a user's page, or of an experimenter's, ""; false: nobody asked
        for it.
        """
        if isinstance(message, AbortTrial):
            watch = self._watch
            who = site or "the experimenter"
            if watch is None or watch.over or (site and self._holders.get(site) != page):
                return False
            watch.aborted = f"{who} stopped it" + (f": {message.why}" if message.why else "")
            return True
        asked = self._asked
        early = self._asked and self._clock.monotonic_ns() < self._asked.from_ns
        if (
            asked is None
            or early
            or self._holders.get(site) != page
            or message.key != asked.step.key
        ):
            return False
        try:
            asked.replies[site] = (
                asked.step.form.read(message.answers) if asked.step.form else {},
                page,
            )
        except UsageError:
            return False
        return True

    def describe(self, role: str, site: str, page: int, t_s: float | None) -> Json:
        """Returns what a page shows, by role, site and number, at a time of its arms, s, if
        there are any.
        """
        step = self._step
        asked = self._asked
        watch = self._watch
        protocol = self._plan.protocol
        found: Json = {
            "phase": self._phase,
            "title": protocol.title or protocol.name,
            "told": self._told,
        }
        if step is None:
            return found
        planned = step.planned
        replies = {} if asked is None else asked.replies
        names = dict(zip(self.users, planned.group, strict=True))
        states = {
            at: "done" if at in replies else "here" if at in self._holders else ""
            for at in self.users
        }
        found |= {
            "key": step.key,
            "users": [
                {"site": at, "who": names[at], "state": state} for at, state in states.items()
            ],
            "task": protocol.task.ask(self._plan.scenarios[planned.condition].slave),
            "trial": planned.trial,
            "trials": self._plan.trials[-1].trial,
            "block": planned.block,
            "blocks": len(protocol.conditions),
            "practice": planned.practice,
        }
        if asked is not None:
            found["rest_s"] = max(0.0, (asked.from_ns - self._clock.monotonic_ns()) / NS_PER_S)
        if watch is not None and t_s is not None:
            found |= watch.describe(t_s, site)
        if role == "experimenter":
            found |= {"number": planned.number, "of": len(self._plan.trials)}
            also = (
                f", {planned.phase}"
                if planned.phase
                else ", a catch trial"
                if planned.catch
                else ""
            )
            found |= {"condition": planned.condition + also}
        if site in names and role == "user":
            found |= {
                "who": names[site],
                "done": site in replies,
                "second": self._holders.get(site) != page,
            }
            if step.kind == "consent":
                found["text"] = protocol.consent
            if step.form is not None:
                found["form"] = {
                    **msgspec.to_builtins(step.form),
                    "forced": step.form.is_forced,
                }
        return found
