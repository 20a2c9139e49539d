"""Controls the content of an experiment's pages: consent, readiness, trials, questionnaires.

`Stage` asks the users to complete the steps between trials and collects their replies.
`TrialWatch` judges a trial while its session runs.

Invariant:
    - A reply counts only for the step shown on the page, and only from the first page of a
      user's site.
    - A trial is judged by every record of the slave arm. The later evaluation of the log uses
      the same records.
    - Rests of users and absences of pages are measured on the monotonic clock, so adjusting the
      time of day does not affect any duration.
    - The pages of users never show the condition of the experiment, such as the delay or the
      control law, since this could influence the users.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from typing import Any

import msgspec

from trilat_net.core import tick_ns
from trilat_net.errors import UsageError
from trilat_net.net import HALTED_MODES, Clock
from trilat_net.records import NS_PER_S

from ..experiment.protocol import ExperimentPlan, Step
from ..experiment.trial_run import ExperimentTrial, TrialEntry, TrialJudge
from .page_orders import AbortTrial, StageMessage
from .session_view import SessionView

MAX_ABSENCE_NS = 8 * NS_PER_S
"""Absence of a user's page after which a trial is aborted, in ns. Reloading is faster."""
END_DELAY_NS = NS_PER_S // 2
"""Time between the end of a trial and the end of its session, in ns.

During this time, the mark of the trial's end reaches the log.
"""

Json = dict[str, Any]
"""A JSON object."""


class TrialWatch:
    """Decides during a trial whether it succeeds, fails or must be repeated.

    `poll` must be called many times per second while the session runs.

    Args:
        trial: The trial, with its task and the names of its sites.
        clock: Clock of this process.

    Attributes:
        trial: The trial.
        judge: Evaluates the records of the slave arm and determines the outcome.
        aborted: Reason why the trial must be repeated. Empty otherwise.
        diverged: True if an arm exceeded a safety limit, in which case the trial fails.
    """

    def __init__(self, trial: ExperimentTrial, clock: Clock) -> None:
        self.trial = trial
        self.judge = TrialJudge(trial)
        self.aborted = ""
        self._clock = clock
        self._next_tick = 0
        self._ended_ns = 0
        self._has_appeared = False
        self.diverged = False

    @property
    def over(self) -> bool:
        """True once the session of the trial can end.

        After an abort, the session can end immediately. Once the outcome is known, the session
        continues for `END_DELAY_NS`, so that the log contains the motion after the trial.
        """
        if self.aborted:
            return True
        has_outcome = self.judge.outcome is not None
        return has_outcome and self._clock.monotonic_ns() - self._ended_ns > END_DELAY_NS

    def poll(self, view: SessionView, absent: Collection[str]) -> list[str]:
        """Judges the trial from new records of the slave arm, and detects reasons to repeat it.

        The trial must be repeated if an arm was stopped, or if the web page of a participant
        has been missing for too long. In these cases, the records are not judged.

        Args:
            view: Current state of the session.
            absent: Sites whose participant's page has been missing for too long.

        Returns:
            Messages to write into the log as events at the current time. Empty if nothing has
            happened or the trial has ended.
        """
        if self.over or self.judge.outcome is not None or not view.running:
            return []

        modes = {name: site.record.mode for name, site in view.sites.items() if site.record}
        self.diverged = "diverged" in modes.values()
        halted_sites = [name for name, mode in modes.items() if mode in HALTED_MODES]

        if absent:
            self.aborted = f"the page of {', '.join(absent)} is gone"
        elif halted_sites:
            self.aborted = f"{', '.join(halted_sites)} stopped"
        if self.aborted:
            return [f"trial {self.trial.planned.number} aborted: {self.aborted}"]
        return self._judge_records(view)

    def _judge_records(self, view: SessionView) -> list[str]:
        """Judges the new records of the slave in order, up to the outcome of the trial.

        A record is judged only once no earlier record can still arrive, so that the evaluation
        of the log gives the same outcome. Records that are permanently lost are skipped.

        Args:
            view: State of the session.

        Returns:
            Messages that mark this moment in the log, such as "trial 3 begins".
        """
        slave = view.sites[self.trial.slave]
        number = self.trial.planned.number
        log_marks: list[str] = []
        first_tick = max(self._next_tick, slave.window.first)
        last_tick = slave.complete
        if last_tick < first_tick:
            return []

        if self._next_tick == 0:
            log_marks.append(f"trial {number} begins")
        self._next_tick = last_tick + 1

        rows = slave.window.rows(first_tick, last_tick)
        are_known = rows.known.tolist()
        positions = rows.q.tolist()
        torques = rows.tau_x.tolist()
        ticks = range(first_tick, last_tick + 1)
        records = zip(ticks, are_known, positions, torques, strict=True)
        for tick, is_known, q, tau_x in records:
            t_s = tick_ns(tick, slave.window.rate_hz) / NS_PER_S
            if not self._has_appeared and t_s >= self.trial.appears_s:
                self._has_appeared = True
                log_marks.append("target appears")

            outcome = self.judge.accept(t_s, q, tau_x) if is_known else None
            if outcome is not None:
                self._ended_ns = self._clock.monotonic_ns()
                result = "succeeded" if outcome.succeeded else "failed"
                return [*log_marks, f"trial {number} {result}"]
        return log_marks

    def describe(self, t_s: float, site: str) -> Json:
        """Describes, for a page, the target that the participants must reach at a given time.

        Also states whether the target has appeared.

        Args:
            t_s: Time of the pose shown on the page, in s since the start of the session.
            site: Name of the site of the page's user. If empty, the target is the midpoint of
                all users' targets.

        Returns:
            Position and width of the target, the corridor to it if there is one, and the
            remaining time, as JSON-compatible values.
        """
        goal = self.judge.goal
        trial = self.trial
        users = trial.protocol.users
        user = users.index(site) if site in users else None
        target_m = goal.find_target_m(t_s, user)
        fields: Json = {
            "target": {"site": trial.slave, "at": target_m.tolist(), "width_m": goal.width_m}
        }

        corridor = goal.find_corridor(t_s)
        if corridor is not None:
            start_m, width_m = corridor
            fields["way"] = {"from": start_m.tolist(), "width_m": width_m}

        fields["appeared"] = t_s >= goal.appears_s
        # The time of a trial starts when the target appears.
        running_s = max(t_s, goal.appears_s)
        fields["left_s"] = max(0.0, trial.longest_s - running_s)
        return fields


@dataclass
class _StepRequest:
    """A step that the users are currently asked to complete, such as a questionnaire.

    Attributes:
        step: The step.
        from_ns: Earliest time at which replies are accepted, in ns on the monotonic clock. The
            users rest until then.
        replies: Mapping from the site of each user who has completed the step to the answers
            and the number of the page that sent them.
    """

    step: Step
    from_ns: int = 0
    replies: dict[str, tuple[dict[str, float | None], int]] = field(default_factory=dict)


class Stage:
    """Determines the content of an experiment's web pages before, during and after trials.

    Each trial is a session of its own. Between trials, the participants complete steps on their
    pages, such as a questionnaire. The program that conducts the experiment calls
    `request_step` and `show_trial`. The page server, which runs in another thread, calls
    `describe` for the content of a page, `accept` for the reply of a participant, and `poll`
    regularly.

    Args:
        plan: Plan of the experiment.
        clock: Clock of this process.

    Attributes:
        users: Names of the sites whose arms the participants hold.
        shows_ages: True if the pages initially show the ages of the displayed poses of the
            other arms. False in a staircase, where the ages could reveal the answer.
    """

    def __init__(self, plan: ExperimentPlan, clock: Clock) -> None:
        self.users = plan.protocol.users
        self._plan = plan
        self._clock = clock
        self.shows_ages = plan.protocol.staircase is None
        self._request: _StepRequest | None = None
        self._watch: TrialWatch | None = None
        self._step: Step | None = None
        self._phase = "checking"
        self._feedback: Json = {"why": "", "measures": {}}
        self._holders: dict[str, int] = {}
        self._page_seen_ns: dict[str, int] = {}

    def request_step(
        self, step: Step, rest_s: float = 0.0, done: Collection[str] = ()
    ) -> _StepRequest:
        """Asks users on their pages to complete a step, such as a questionnaire.

        The experiment waits for all users before continuing with the next step.

        Args:
            step: The step.
            rest_s: Minimum time that the users rest before the step, in s.
            done: Sites of the users who have already completed the step.

        Returns:
            The request, which collects the replies of the users.
        """
        rest_end_ns = self._clock.monotonic_ns() + int(rest_s * NS_PER_S)
        request = _StepRequest(step, rest_end_ns)
        no_answers: dict[str, float | None] = {}
        request.replies |= dict.fromkeys(done, (no_answers, 0))
        self._step = step
        self._watch = None
        self._phase = step.kind
        self._request = request
        return request

    def show_trial(self, watch: TrialWatch) -> None:
        """Shows on all open web pages that a trial is about to begin.

        Args:
            watch: Judge of the trial while its session runs.
        """
        self._request = None
        self._watch = watch
        self._phase = "starting"

    def show_checking(self) -> None:
        """Shows on all open web pages that a trial has ended and its log is being verified."""
        self._watch = None
        self._phase = "checking"

    def show_feedback(self, entry: TrialEntry | None, why: str = "") -> None:
        """Shows the participants the result of a trial, or why the trial must be repeated.

        Participants see only the measures that the protocol of the experiment selects.

        Args:
            entry: Result of the trial, or `None` if the trial must be repeated.
            why: Reason for the repetition.
        """
        self._feedback = {"why": why, "measures": {}}
        measure_names = self._plan.protocol.feedback
        if entry is not None and measure_names:
            measures = {
                name: entry.measures[name] for name in measure_names if name in entry.measures
            }
            self._feedback["measures"] = measures
            self._feedback["succeeded"] = entry.succeeded

    def show_end(self) -> None:
        """Shows on all open web pages that the experiment has ended."""
        self._request = None
        self._step = None
        self._phase = "over"

    def poll(self, view: SessionView, pages: Sequence[tuple[str, int]]) -> list[str]:
        """Evaluates the new records of a trial and updates which users have an open page.

        Called by the page server many times per second.

        Args:
            view: Current state of the session.
            pages: One pair per open page of a user: the name of the user's site and the number
                of the page.

        Returns:
            Messages to write into the log as events at the current time. Empty if no trial is
            running.
        """
        now_ns = self._clock.monotonic_ns()
        request = self._request

        # The first page of a site has the smallest number. Only the replies of this page count.
        self._holders = {}
        for site, number in pages:
            self._holders[site] = min(number, self._holders.get(site, number))
        self._page_seen_ns |= dict.fromkeys(self._holders, now_ns)

        if request is not None and request.step.kind == "trial":
            # A user who leaves is no longer ready.
            for site, (_, replying_page) in list(request.replies.items()):
                if self._holders.get(site) != replying_page:
                    del request.replies[site]

        if self._watch is None:
            return []

        if view.running and self._phase == "starting":
            self._phase = "trial"

        absent_sites: list[str] = []
        for site in self.users:
            absence_ns = now_ns - self._page_seen_ns.get(site, now_ns)
            if absence_ns > MAX_ABSENCE_NS:
                absent_sites.append(site)
        return self._watch.poll(view, absent_sites)

    def accept(self, site: str, page: int, message: StageMessage) -> bool:
        """Processes a message from a participant's page, such as questionnaire answers.

        Args:
            site: Name of the user's site. Empty for an experimenter.
            page: Number of the page that sent the message.
            message: The message.

        Returns:
            True if the message was accepted, False if it was not requested from that page and
            is ignored.
        """
        is_holder = self._holders.get(site) == page
        if isinstance(message, AbortTrial):
            is_allowed = is_holder or not site
            return is_allowed and self._abort_trial(site, message.why)

        request = self._request
        if request is None or self._clock.monotonic_ns() < request.from_ns:
            return False

        is_for_this_step = message.key == request.step.key
        if not is_holder or not is_for_this_step:
            return False

        form = request.step.form
        try:
            answers = form.read(message.answers) if form else {}
        except UsageError:
            return False
        request.replies[site] = (answers, page)
        return True

    def _abort_trial(self, site: str, why: str) -> bool:
        """Aborts the running trial, to be repeated later. Returns False if no trial is running.

        For example, the experimenter may notice that a participant has misunderstood the task.

        Args:
            site: Site of the user who aborts the trial. Empty for the experimenter.
            why: Reason, for the journal. May be empty.
        """
        watch = self._watch
        if watch is None or watch.over:
            return False
        reason_text = f": {why}" if why else ""
        watch.aborted = f"{site or 'the experimenter'} stopped it{reason_text}"
        return True

    def describe(self, role: str, site: str, page: int, t_s: float | None) -> Json:
        """Describes the current content of a page of the experiment.

        Called by the page server for each message that it sends to the page.

        Args:
            role: Role of the page's user: experimenter, user of one arm, or watcher.
            site: Name of the site of the page's user. Empty if the page does not belong to a
                user of an arm.
            page: Number of the page.
            t_s: Time of the pose shown on the page, in s, or `None` if the page shows no arms.

        Returns:
            The current phase, the requested step, the task, the users and whatever else the
            role may see, as JSON-compatible values.
        """
        step = self._step
        request = self._request
        watch = self._watch
        protocol = self._plan.protocol
        fields: Json = {
            "phase": self._phase,
            "title": protocol.title or protocol.name,
            "told": self._feedback,
        }
        if step is None:
            return fields

        planned = step.planned
        # The experiment's thread may end the request at any time.
        done_sites = () if request is None else tuple(request.replies)

        slave = self._plan.scenarios[planned.condition].slave
        fields |= {
            "key": step.key,
            "users": self._describe_users(step, done_sites),
            "task": protocol.task.render_instructions(slave),
            "trial": planned.trial,
            "trials": self._plan.trials[-1].trial,
            "block": planned.block,
            "blocks": len(protocol.conditions),
            "practice": planned.practice,
        }

        if request is not None:
            rest_ns = request.from_ns - self._clock.monotonic_ns()
            fields["rest_s"] = max(0.0, rest_ns / NS_PER_S)
        if watch is not None and t_s is not None:
            fields |= watch.describe(t_s, site)
        if role == "experimenter":
            fields |= self._describe_for_experimenter(step)
        if role == "user" and site in self.users:
            fields |= self._describe_for_user(step, site, page)
            fields["done"] = site in done_sites
        return fields

    def _describe_users(self, step: Step, done_sites: Collection[str]) -> list[Json]:
        """Describes the users for all pages: pseudonym, and whether present or done.

        Shows the experimenter which users the experiment is waiting for.

        Args:
            step: The step that the users have to complete.
            done_sites: Sites of the users who have completed the step.

        Returns:
            One entry per user, whose "state" is "done", "here" or empty.
        """
        users: list[Json] = []
        for site, pseudonym in zip(self.users, step.planned.group, strict=True):
            state = "here" if site in self._holders else ""
            if site in done_sites:
                state = "done"
            users.append({"site": site, "who": pseudonym, "state": state})
        return users

    def _describe_for_experimenter(self, step: Step) -> Json:
        """Returns what only experimenters see of the current step, such as the condition.

        Participants who knew the condition might expect an effect.

        Args:
            step: The current step.
        """
        planned = step.planned
        condition = planned.condition
        if planned.phase:
            condition += f", {planned.phase}"
        elif planned.catch:
            condition += ", a catch trial"
        return {
            "number": planned.number,
            "of": len(self._plan.trials),
            "condition": condition,
        }

    def _describe_for_user(self, step: Step, site: str, page: int) -> Json:
        """Returns the content shown only on a participant's page, such as a questionnaire.

        Args:
            step: The current step.
            site: Site of the participant's arm.
            page: Number of the page. If a site has several pages, only the first one counts,
                and the field "second" is true for the others.
        """
        pseudonyms = dict(zip(self.users, step.planned.group, strict=True))
        fields: Json = {
            "who": pseudonyms[site],
            "second": self._holders.get(site) != page,
        }
        if step.kind == "consent":
            fields["text"] = self._plan.protocol.consent
        if step.form is not None:
            form = msgspec.to_builtins(step.form)
            fields["form"] = {**form, "forced": step.form.is_forced}
        return fields
