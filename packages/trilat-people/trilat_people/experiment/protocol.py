"""Reads the protocol of an experiment with people and plans its trials.

A protocol is a TOML file that specifies the scenario (the robot arms and their network), the
conditions (scenario keys whose values differ), the task, and the number of participants and
trials. The plan lists all trials in the order in which they are run. The order of conditions is
balanced over participants, so that practice and fatigue affect all conditions equally. Targets
are drawn at random.

Invariant:
    - The plan depends only on the protocol and on the scenarios of its conditions.
    - The digest of the plan covers the protocol and the source of each condition's scenario.
      The log of each trial contains the digest, which proves that the trial follows the plan.
    - A protocol that cannot be carried out is rejected as a whole, with a list of all problems.
"""

import hashlib
import itertools
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import msgspec
import numpy as np
from msgspec import Meta, field
from msgspec.structs import replace

from trilat_net.errors import ScenarioError, TrilatError, UsageError, count_nouns
from trilat_net.fields import Frozen, Positive
from trilat_net.presentation import Block, TextTable
from trilat_net.results import Result
from trilat_net.scenario import Scenario, load_scenario

from .questionnaires import Name, Questionnaire
from .staircase import COMPARISON, STANDARD, Staircase
from .synthetic_participant import ParticipantModel, Share
from .tasks import AnyTask, ReachTrial

Wait = Annotated[float, Meta(ge=0.0, le=60.0)]
"""A waiting time, in s."""
Pseudonym = Annotated[str, Meta(pattern=r"^[A-Za-z0-9_]{1,20}\Z")]
"""Name of a participant, which becomes part of file names."""
Count = Annotated[int, Meta(ge=1, le=1000)]
Counted = Annotated[int, Meta(ge=0, le=1000)]
Feedback = Literal[
    "completion_s",
    "movement_s",
    "reaction_s",
    "error_end_mm",
    "error_rms_mm",
    "path_m",
    "wall_force_n",
]


class _CatchTrials(Frozen, frozen=True):
    """Trials of an unexpected condition, mixed into a block of another condition.

    They prevent participants from anticipating the condition of the next trial, and are
    excluded from the analysis.

    Attributes:
        condition: Condition of the catch trials. Blocks of this condition have no catch trials.
        share: Number of catch trials in a block, as a fraction of the block's counted trials.
            The resulting number is rounded.
    """

    condition: Name
    share: Annotated[float, Meta(gt=0.0, le=0.5)] = 0.1


class _Training(Frozen, frozen=True):
    """Training in which authority over the slave arm passes from an expert to a learner.

    The first user is the expert, and the second user is the learner.

    Attributes:
        lead: Mapping from condition to the expert's share of the users' authority in the first
            and last trial of the training, between 0 and 1.
        before: Number of trials in which the learner acts alone before the training.
        after: Number of trials in which the learner acts alone directly after the training
            (transfer).
        retention: Number of trials in which the learner acts alone after a rest (retention).
        rest_s: Rest before the retention trials, in s.
    """

    lead: dict[Name, tuple[Share, Share]]
    before: Counted = 2
    after: Counted = 2
    retention: Counted = 0
    rest_s: Annotated[float, Meta(ge=0.0, le=1e6)] = 600.0

    def describe(self) -> str:
        """Describes the design of the training in one sentence, for use in a paper.

        During the training, an expert initially leads the slave, and authority gradually passes
        to the learner. The sentence states the first and last values of the expert's share, as
        in "0.9 to 0.1 (guided)", and the numbers of trials before the training, after the
        training and in the retention test.
        """
        courses: list[str] = []
        for condition, (first_lead, last_lead) in self.lead.items():
            courses.append(f"{first_lead:g} to {last_lead:g} ({condition})")
        retention_text = ""
        if self.retention:
            retention_text = f", and {self.retention} more after {self.rest_s:g} s"
        return (
            "In the training trials, the expert's share of the authority changed from "
            f"{', '.join(courses)}; "
            f"{count_nouns(self.before, 'trial')} before and "
            f"{self.after} after them{retention_text} were done by the learner alone and are "
            "compared"
        )


class ExperimentProtocol(Frozen, frozen=True):
    """Protocol of an experiment with people, as written by an experimenter in a TOML file.

    The attributes are the keys of the file.

    Attributes:
        name: Name of the experiment.
        title: Human-readable title of the experiment.
        scenario: Name or path of the scenario on which all conditions are based.
        users: Names of the sites whose arms participants hold. Two sites are operated by a
            pair.
        participants: Number of participants, or a list of their pseudonyms.
        design: Method for balancing the order of conditions over participants (see
            docs/reference/experiment-protocol.md).
        trials: Number of counted trials per block. A block contains all trials of a condition.
        practice: Number of practice trials at the start of each block.
        foreperiod_s: Minimum and maximum time from the start of a trial until its target
            appears, in s. The actual time is drawn uniformly.
        seed: Random seed for orders, targets and synthetic participants.
        set: Scenario keys to set in all conditions.
        conditions: Mapping from condition name to the scenario keys that the condition sets.
        task: Task of the participants.
        model: Parameters of synthetic participants.
        consent: Consent text to which people agree before their first trial. Empty if no
            consent is requested.
        questionnaires: Questionnaires, and when they are answered.
        rest_s: Minimum rest between two blocks, in s.
        feedback: Measures shown to people after a trial.
        force_limit_n: Mapping from pseudonym to the largest force, in N, with which that
            participant can push the arm. Only for participants who need a lower limit.
        catch: Catch trials: trials of another condition within a block, excluded from the
            analysis.
        training: Trials in which authority passes from an expert to a learner.
        staircase: Pairs of trials that adapt a scenario key to a participant's perception
            threshold.
    """

    name: Name
    scenario: str
    conditions: dict[Name, dict[str, Any]]
    set: dict[str, Any] = field(default_factory=dict)
    title: str = ""
    users: tuple[str, ...] = ("m1",)
    participants: Count | tuple[Pseudonym, ...] = 12
    design: Literal["williams", "latin", "random", "fixed"] = "williams"
    trials: Count = 10
    practice: Counted = 0
    foreperiod_s: tuple[Wait, Wait] = (0.5, 1.0)
    seed: Annotated[int, Meta(ge=0, lt=2**31)] = 1
    task: AnyTask = field(default_factory=ReachTrial)
    model: ParticipantModel = field(default_factory=ParticipantModel)
    consent: Annotated[str, Meta(max_length=20_000)] = ""
    questionnaires: tuple[Questionnaire, ...] = ()
    rest_s: Annotated[float, Meta(ge=0.0, le=3600.0)] = 0.0
    feedback: tuple[Feedback, ...] = ()
    force_limit_n: dict[Pseudonym, Positive] = field(default_factory=dict)
    catch: _CatchTrials | None = None
    training: _Training | None = None
    staircase: Staircase | None = None

    def list_phases(
        self, condition: str, random: np.random.Generator
    ) -> list[tuple[str, float | None]]:
        """Lists the phase and authority of each trial of a block, excluding practice trials.

        A block contains all trials of a participant under one condition. If the experiment
        includes training, the phases are "before", "training", "after" and "retention". If it
        includes a staircase, trials come in pairs of a standard trial and a comparison trial.

        Args:
            condition: Name of the condition of the block.
            random: Generator for the order within the pairs of a staircase.

        Returns:
            For each trial, the phase and the first user's share of the authority over the slave
            arm, between 0 and 1. The phase is empty if there is neither training nor a
            staircase. If the share is `None`, the authority defined in the scenario is kept.
        """
        phases: list[tuple[str, float | None]] = []
        if self.staircase is not None:
            for _ in range(self.trials // 2):
                pair_phases = random.permutation([STANDARD, COMPARISON]).tolist()
                phases += [(phase, None) for phase in pair_phases]
            return phases

        training = self.training
        if training is None:
            phases += [("", None)] * self.trials
            return phases

        first_lead, last_lead = training.lead[condition]
        phases += [("before", 0.0)] * training.before
        leads = np.linspace(first_lead, last_lead, self.trials).tolist()
        phases += [("training", lead) for lead in leads]
        phases += [("after", 0.0)] * training.after
        phases += [("retention", 0.0)] * training.retention
        return phases

    @property
    def forms(self) -> list[Questionnaire]:
        """Forms that participants fill in during the experiment.

        Includes the questionnaires and, if the experiment measures a perception threshold, the
        question asked after each pair of trials.
        """
        forms = list(self.questionnaires)
        if self.staircase:
            forms.append(self.staircase.form)
        return forms

    @property
    def groups(self) -> list[tuple[str, ...]]:
        """Participants who take part together, as tuples of one or two pseudonyms.

        If the protocol contains a number of participants, such as 12, the pseudonyms are P01 to
        P12. If the task has two users, consecutive participants form pairs.
        """
        participants = self.participants
        if isinstance(participants, int):
            digits = len(str(participants))
            numbers = range(1, participants + 1)
            names = tuple(f"P{number:0{digits}d}" for number in numbers)
        else:
            names = participants
        group_size = len(self.users)
        groups: list[tuple[str, ...]] = []
        for first in range(0, len(names), group_size):
            group = names[first : first + group_size]
            groups.append(group)
        return groups

    @classmethod
    def read(cls, file: str | Path) -> "ExperimentProtocol":
        """Reads a protocol from a TOML file, without planning its trials.

        Args:
            file: Path of the TOML file.

        Raises:
            UsageError: The file cannot be read, or a key or value in it is not valid.
        """
        path = Path(file)
        try:
            tables = tomllib.loads(path.read_text(encoding="utf-8"))
            return msgspec.convert(tables, ExperimentProtocol)
        except OSError as error:
            raise UsageError(f"{path} cannot be read: {error.strerror}") from None
        except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
            raise UsageError(f"{path} is not valid TOML: {error}") from None
        except msgspec.ValidationError as error:
            valid = ", ".join(
                key.encode_name for key in msgspec.structs.fields(ExperimentProtocol)
            )
            raise UsageError(f"{path}: {error}; the keys of a protocol are {valid}") from None

    def limit_forces(self, scenario: Scenario, group: Sequence[str]) -> dict[str, Any]:
        """Lowers the force limits for participants who must not push hard.

        These participants and their limits are listed in the protocol under `force_limit_n`.

        Args:
            scenario: Scenario of the condition.
            group: Pseudonyms of the participants.

        Returns:
            Mapping from site name to the new specification of each site whose limit changes.
            Empty if no participant of the group needs a lower limit.

        Raises:
            ScenarioError: The scenario has no force limit for the site, or already has a lower
                one.
        """
        limited_sites: dict[str, Any] = {}
        # The lengths may differ: `_find_problems` reports a group that is too small.
        for user, name in zip(self.users, group, strict=False):
            site_settings = scenario.sites[user]
            limit_n = self.force_limit_n.get(name)
            live_hand = site_settings.find_live_hand(is_open=True)
            if limit_n is None or live_hand is None:
                continue

            key = f"force_limit_n.{name}"
            if live_hand.mode == "joint":
                raise ScenarioError(
                    f"the live hand at {user} has the mode 'joint' and therefore no limit in N",
                    path=key,
                )
            hand_limit_n = live_hand.force_limit_n
            if hand_limit_n < limit_n:
                raise ScenarioError(
                    f"{limit_n:g} N exceeds the limit of the live hand at {user}, "
                    f"which is {hand_limit_n:g} N",
                    path=key,
                )

            limited_hand = replace(live_hand, force_limit_n=limit_n)
            hands = tuple(
                limited_hand if hand is live_hand else hand for hand in site_settings.hands
            )
            limited_sites[user] = replace(site_settings, hands=hands)
        return limited_sites

    def list_orders(self) -> list[tuple[str, ...]]:
        """Lists the orders of the conditions, which are assigned to participants in turn.

        Participants improve with practice and tire over time. Varying the order of conditions
        between participants makes these effects equal for all conditions on average.

        In the design "williams", each condition occurs equally often at each position and
        equally often directly after each other condition (Williams 1949); an odd number of
        conditions requires twice as many orders. "latin" is a cyclic Latin square, which
        balances only the positions. "random" uses 1000 random permutations drawn with the seed
        of the protocol. "fixed" is the order of `conditions`.
        """
        conditions = list(self.conditions)
        count = len(conditions)
        if self.design == "fixed":
            return [tuple(conditions)]

        if self.design == "random":
            random = np.random.default_rng(self.seed)
            names = np.array(conditions)
            orders: list[tuple[str, ...]] = []
            for _ in range(1000):
                order = names[random.permutation(count)]
                orders.append(tuple(order.tolist()))
            return orders

        # Each row of the square is an order, as indices of conditions.
        first_row = list(range(count))
        if self.design == "williams":
            # The first row is 0, 1, n - 1, 2, n - 2, ...
            first_row = [0]
            for step in range(1, count // 2 + 1):
                first_row += [step, count - step]
            first_row = first_row[:count]

        rows = []
        for shift in range(count):
            row = [(index + shift) % count for index in first_row]
            rows.append(row)
        if self.design == "williams" and count % 2:
            # For an odd number, only the rows and their mirror images together are balanced.
            rows += [row[::-1] for row in rows]
        return [tuple(conditions[index] for index in row) for row in rows]


class PlannedTrial(NamedTuple):
    """One trial in the plan of an experiment, with its participants and condition.

    Attributes:
        number: Number of the trial in the experiment, starting at 1.
        group: Pseudonyms of the participants, in the order of the protocol's users.
        condition: Name of the condition.
        block: Number of the block within the group, starting at 1.
        trial: Number of the trial within the block, starting at 1. Practice trials come first.
        practice: True for a practice trial, which is excluded from the analysis.
        before: Number of trials that the group has done before.
        target: Number of the target. The first target of each block is drawn at random, so that
            an effect of target direction is not mistaken for learning. Both trials of a
            staircase pair have the same target.
        seed: Random seed of the trial.
        catch: True for a catch trial, whose condition differs from that of its block. Excluded
            from the analysis.
        phase: "before", "training", "after" or "retention" in an experiment with training;
            "standard" or "comparison" in an experiment with a staircase; otherwise empty.
        lead: First user's share of the two users' combined authority over the slave. If `None`,
            the scenario's dominance factors are kept.
    """

    number: int
    group: tuple[str, ...]
    condition: str
    block: int
    trial: int
    practice: bool
    before: int
    target: int
    seed: int
    catch: bool = False
    phase: str = ""
    lead: float | None = None

    @property
    def file(self) -> str:
        """Name of the trial's log file, for example "00017-P01-P02-b1-t03-near.mcap".

        Composed of number, participants, block, trial and condition.
        """
        group = "-".join(self.group)
        position = f"b{self.block}-t{self.trial:02d}"
        return f"{self.number:05d}-{group}-{position}-{self.condition}.mcap"


Choices = Mapping[int, float]
"""Mapping from the second trial of each staircase pair to the chosen trial, 1 or 2."""


class Step(NamedTuple):
    """A step that participants of an experiment complete: a consent, trial or questionnaire.

    Attributes:
        kind: "consent", "trial" or "questionnaire".
        planned: The trial of the step. For a consent, the next trial; for a questionnaire, the
            previous one.
        form: The questionnaire, or `None` for other kinds.
    """

    kind: Literal["consent", "trial", "questionnaire"]
    planned: PlannedTrial
    form: Questionnaire | None = None

    @property
    def key(self) -> str:
        """Identifier of the step in journal notes and messages.

        Composed of the kind, the number of the trial and, for a questionnaire, its name, as in
        "trial 17" or "questionnaire 24 tlx".
        """
        key = f"{self.kind} {self.planned.number}"
        if self.form is not None:
            return f"{key} {self.form.name}"
        return key


@dataclass(frozen=True, repr=False)
class ExperimentPlan(Result):
    """Plan of an experiment that is ready to run: its protocol and all of its trials.

    Created from a protocol by `of_protocol`.

    Attributes:
        protocol: Design of the experiment: conditions, task and participants.
        scenarios: Mapping from condition name to scenario.
        trials: All trials, in the order in which they are run.
        digest: SHA-256 hash of the protocol and scenarios, in hexadecimal.
    """

    protocol: ExperimentProtocol
    scenarios: Mapping[str, Scenario]
    trials: Sequence[PlannedTrial]
    digest: str

    def to_dict(self) -> dict[str, Any]:
        """Summarises the plan as plain values, as printed by `trilat experiment check --json`.

        Contains counts, conditions, and the order of conditions for each group. "counted" is
        the number of trials excluding practice and catch trials.
        """
        protocol = self.protocol
        uncounted = [trial for trial in self.trials if trial.practice or trial.catch]
        return {
            "name": protocol.name,
            "digest": self.digest,
            "groups": len(protocol.groups),
            "trials": len(self.trials),
            "counted": len(self.trials) - len(uncounted),
            "conditions": list(protocol.conditions),
            "orders": self.list_orders(),
        }

    def list_steps(self) -> Iterator[Step]:
        """Yields everything that participants have to do, group by group.

        A group does one block of trials per condition. Its steps are:

        - the consent, before its first trial;
        - all trials;
        - in an experiment with a staircase, the choice between the two trials of a pair, after
          each pair (practice trials do not form pairs);
        - questionnaires, after every block or only after the last block of the group.
        """
        protocol = self.protocol
        trials_per_block = self.trials[-1].trial
        for planned in self.trials:
            is_first_of_group = planned.block == planned.trial == 1
            if protocol.consent and is_first_of_group:
                yield Step("consent", planned)
            yield Step("trial", planned)

            trial_after_practice = planned.trial - protocol.practice
            ends_pair = trial_after_practice > 0 and trial_after_practice % 2 == 0
            if protocol.staircase is not None and ends_pair:
                yield Step("questionnaire", planned, protocol.staircase.form)

            ends_block = planned.trial == trials_per_block
            if ends_block:
                ends_experiment = planned.block == len(protocol.conditions)
                for questionnaire in protocol.questionnaires:
                    if ends_experiment or questionnaire.after == "block":
                        yield Step("questionnaire", planned, questionnaire.find_form())

    def judge_choices(self, planned: PlannedTrial, choices: Choices) -> list[bool]:
        """Determines whether participants' answers in a perception test were right.

        In each pair of trials, a quantity such as the delay has its standard value in one trial
        and a larger value in the other (the comparison trial). The participants then choose one
        of the two. Choosing the comparison trial is right.

        Args:
            planned: Any trial of the block, which contains all trials of the participants under
                one condition.
            choices: Mapping from the number of the second trial of a pair to the choice, 1
                (first trial) or 2 (second trial).

        Returns:
            One entry per choice in the block, in the order of the trials: True if the choice is
                right.
        """
        # Both numbers start at 1, so the difference is the index of the first trial.
        block_start = planned.number - planned.trial
        trials_per_block = self.trials[-1].trial  # all blocks are equally long
        block_end = block_start + trials_per_block
        judgements: list[bool] = []
        for trial in self.trials[block_start:block_end]:
            is_second_of_judged_pair = trial.number in choices
            if is_second_of_judged_pair:
                comparison_is_second = trial.phase == COMPARISON
                right_choice = 2 if comparison_is_second else 1
                judgements.append(choices[trial.number] == right_choice)
        return judgements

    def find_pair(self, planned: PlannedTrial, choices: Choices) -> tuple[float, bool | None]:
        """Returns the difference within a pair of trials, and whether the choice was right.

        A staircase (a perception test) presents pairs of trials that differ in the value of one
        scenario key. The participant chooses the trial in which the value was larger.

        Args:
            planned: A trial of the pair.
            choices: Choices of the participants.

        Returns:
            The difference between the two trials, in the unit of the staircase key; and True if
            the participant's choice was right, False if it was wrong, or `None` before the
            choice.
        """
        staircase = self.protocol.staircase
        assert staircase is not None
        index_in_block = planned.trial - self.protocol.practice - 1
        pair_index = index_in_block // 2
        judgements = self.judge_choices(planned, choices)
        differences = staircase.list_differences(judgements)
        is_right = None
        if pair_index < len(judgements):
            is_right = judgements[pair_index]
        return differences[pair_index], is_right

    def find_scenario(self, planned: PlannedTrial, choices: Choices) -> Scenario:
        """Returns the scenario for a trial.

        This is the scenario of the trial's condition. In a perception test (staircase), one key
        is adapted to the participant's earlier choices.

        Args:
            planned: The planned trial.
            choices: Choices that the participants have made so far.
        """
        scenario = self.scenarios[planned.condition]
        staircase = self.protocol.staircase
        if staircase is None or planned.practice:
            return scenario

        difference = 0.0  # in the standard trial of a pair
        if planned.phase == COMPARISON:
            difference, _ = self.find_pair(planned, choices)
        value = staircase.standard + difference
        return load_scenario(scenario, {staircase.key: value})

    def rest_before_s(self, planned: PlannedTrial) -> float:
        """Returns the minimum rest of the participants before a trial, in s.

        Participants rest before the first trial of every block except the first block, and
        before the retention test that follows the training. The rest is 0 before all other
        trials.

        Args:
            planned: The planned trial.
        """
        training = self.protocol.training
        # Numbers start at 1, so the previous trial has the index `number` - 2.
        previous = self.trials[max(planned.number - 2, 0)]
        starts_retention = planned.phase == "retention" and previous.phase != "retention"

        if training is not None and starts_retention:
            return training.rest_s

        starts_later_block = planned.trial == 1 and planned.block > 1
        if starts_later_block:
            return self.protocol.rest_s
        return 0.0

    def list_orders(self) -> dict[str, list[str]]:
        """Returns the order of conditions for each group of participants.

        The order may differ between groups, because participants improve with practice.

        Returns:
            Mapping from group name to the ordered names of the conditions, for example
            {"P01-P02": ["near", "far"]}.
        """
        orders: dict[str, list[str]] = {}
        for trial in self.trials:
            if trial.catch:
                continue
            group = "-".join(trial.group)
            order = orders.setdefault(group, [])
            if trial.condition not in order:
                order.append(trial.condition)
        return orders

    def blocks(self) -> Iterator[Block]:
        """Yields the parts of the report that `trilat experiment check` prints.

        The report states the number of trials, the maximum duration of a trial, and the order
        of conditions for each group.
        """
        protocol = self.protocol
        facts = self.to_dict()
        unit = "pair" if len(protocol.users) > 1 else "participant"
        units_text = count_nouns(facts["groups"], unit)
        users = ", ".join(protocol.users)
        yield f"{protocol.name}: {protocol.title or protocol.task.description}"
        yield f"{units_text} at {users}, {protocol.task.description}"

        conditions_text = count_nouns(len(protocol.conditions), "condition")
        block_size = self.trials[-1].trial
        counted_text = count_nouns(block_size - protocol.practice, "trial")
        total_text = count_nouns(len(self.trials), "trial")
        _, longest_foreperiod_s = protocol.foreperiod_s
        longest_s = longest_foreperiod_s + protocol.task.longest_s
        yield (
            f"{conditions_text} of {protocol.practice} + {counted_text}: "
            f"{total_text} of at most {longest_s:g} s; design {protocol.design}"
        )
        rows = [(name, ", ".join(order)) for name, order in facts["orders"].items()]
        yield TextTable(("", "order of conditions"), rows)
        yield f"sha256 of the plan {self.digest}"

    @classmethod
    def of_protocol(
        cls,
        protocol: ExperimentProtocol,
        folder: Path | None = None,
        scenarios: Mapping[str, Scenario] | None = None,
    ) -> "ExperimentPlan":
        """Plans all trials of an experiment.

        The same protocol always gives the same plan, so the plan can be published before the
        experiment.

        Args:
            protocol: Design of the experiment: conditions, task and participants.
            folder: Folder to which the path of the protocol's scenario is relative.
            scenarios: Mapping from condition name to scenario. If `None`, the scenarios are
                loaded as specified in the protocol.

        Raises:
            UsageError: The protocol cannot be carried out. The error lists all problems.
        """
        problems = list(_find_problems(protocol))
        condition_scenarios: dict[str, Scenario] = {}
        if scenarios is not None:
            condition_scenarios |= scenarios
        else:
            source: str | Path = protocol.scenario
            if folder is not None and (folder / protocol.scenario).is_file():
                source = folder / protocol.scenario
            for name, keys in protocol.conditions.items():
                settings = _list_keys(protocol.set) | _list_keys(keys)
                try:
                    scenario = load_scenario(source, settings)
                    condition_scenarios[name] = _check_scenario(scenario, protocol)
                except TrilatError as error:
                    problems.append(f"condition {name}: {error}")

        if problems:
            raise UsageError(f"{protocol.name}: " + "; ".join(problems))

        # The digest proves later that a trial follows this plan.
        texts = {name: scenario.text for name, scenario in condition_scenarios.items()}
        tables = msgspec.to_builtins(protocol)
        content = msgspec.json.encode([tables, texts], order="sorted")
        return cls(
            protocol=protocol,
            scenarios=condition_scenarios,
            trials=list(_list_trials(protocol)),
            digest=hashlib.sha256(content).hexdigest(),
        )


def _list_keys(table: Mapping[str, Any], path: str = "") -> dict[str, Any]:
    """Flattens a table of scenario settings into dotted keys and their values.

    Tables of sites, links and dominance factors are expanded; other tables are kept as values.

    Args:
        table: The table.
        path: Dotted key of the table. Empty at the top level.
    """
    keys = dict[str, Any]()
    for name, value in table.items():
        key = f"{path}.{name}" if path else name
        has_members = key in ("sites", "links", "dominance")
        is_member = path in ("sites", "links")
        if isinstance(value, Mapping) and (has_members or is_member):
            keys |= _list_keys(value, key)
        else:
            keys[key] = value
    return keys


def _find_problems(protocol: ExperimentProtocol) -> Iterator[str]:
    """Yields all problems of a protocol that can be found without its scenario.

    Each problem is a sentence that names the key. See `_check_scenario` for problems with the
    scenario.
    """
    shortest_s, longest_s = protocol.foreperiod_s
    if shortest_s > longest_s:
        foreperiod_s = list(protocol.foreperiod_s)
        yield f"foreperiod_s must go from the shorter to the longer time, not {foreperiod_s}"
    yield from _find_pseudonym_problems(protocol)
    yield from _find_table_problems(protocol)
    yield from _find_form_problems(protocol)
    yield from _find_group_problems(protocol)


def _list_pseudonyms(protocol: ExperimentProtocol) -> list[str]:
    """Returns the pseudonyms of all participants, in the order of the groups."""
    return [name for group in protocol.groups for name in group]


def _find_pseudonym_problems(protocol: ExperimentProtocol) -> Iterator[str]:
    """Yields a sentence for each mistake in the participants' pseudonyms.

    A mistake is a pseudonym shared by two participants, or a force limit for a pseudonym that
    no participant has.
    """
    names = _list_pseudonyms(protocol)
    if len(set(names)) < len(names):
        yield "two participants have the same pseudonym"
    unknown = protocol.force_limit_n.keys() - set(names)
    if unknown:
        yield f"force_limit_n: there is no participant {', '.join(sorted(unknown))}"


def _find_table_problems(protocol: ExperimentProtocol) -> Iterator[str]:
    """Yields a sentence for each contradiction in the optional tables of a protocol.

    These are [catch], [training] and [staircase] (a perception test), some of which are
    mutually exclusive.
    """
    catch = protocol.catch
    training = protocol.training
    staircase = protocol.staircase
    if catch is not None and catch.condition not in protocol.conditions:
        yield f"catch.condition: there is no condition {catch.condition}"
    if training is not None and training.lead.keys() != protocol.conditions.keys():
        conditions = ", ".join(protocol.conditions)
        yield f"training.lead: must have a pair of numbers for each of {conditions}"

    tables = [table for table in (training, catch, staircase) if table is not None]
    if len(tables) > 1:
        yield "catch trials, a training and a staircase exclude each other"

    if staircase is not None:
        yield from _find_staircase_problems(protocol, staircase)

    needs_pair = training is not None or protocol.task.needs_pair
    if needs_pair and len(protocol.users) != 2:
        yield "a training, a handover and a task with two targets need two users"


def _find_form_problems(protocol: ExperimentProtocol) -> Iterator[str]:
    """Yields a sentence for each questionnaire that is unknown or listed twice."""
    names = [form.name for form in protocol.forms]
    if len(set(names)) < len(names):
        yield "two questionnaires have the same name"
    for form in protocol.questionnaires:
        try:
            form.find_form()
        except UsageError as error:
            yield str(error)


def _find_group_problems(protocol: ExperimentProtocol) -> Iterator[str]:
    """Yields a sentence for each mistake in the number of participants or users.

    Some designs balance the order of conditions only if the number of groups is a multiple of
    the number of orders. The number of users must be that required by the task.
    """
    users = protocol.users
    name_count = len(_list_pseudonyms(protocol))
    has_repeated_user = len(set(users)) < len(users)
    if not 1 <= len(users) <= 2 or has_repeated_user:
        yield f"users must be one or two sites, not {', '.join(users)}"
    elif name_count % len(users):
        participants = count_nouns(name_count, "participant")
        yield f"{participants} cannot form pairs: the number of participants must be even"

    orders = protocol.list_orders()
    group_count = len(protocol.groups)
    if protocol.design in ("williams", "latin") and group_count % len(orders):
        units_text = "pairs" if len(users) == 2 else "participants"
        conditions_text = count_nouns(len(protocol.conditions), "condition")
        yield (
            f"a {protocol.design} design of {conditions_text} has "
            f"{count_nouns(len(orders), 'order')}: the number of {units_text} must be "
            f"a multiple of {len(orders)}, not {group_count}"
        )


def _find_staircase_problems(
    protocol: ExperimentProtocol, staircase: Staircase
) -> Iterator[str]:
    """Yields a sentence for each rule of the perception test that the protocol violates.

    A staircase requires exactly one user, an even number of trials, and a key that no condition
    sets.

    Args:
        protocol: The protocol.
        staircase: Its table [staircase].
    """
    if len(protocol.users) != 1:
        yield "staircase: needs exactly one user, who answers after each pair of trials"
    if protocol.trials % 2:
        yield (
            "trials: a staircase consists of pairs of trials: the number of trials must be "
            f"even, not {protocol.trials}"
        )
    key = staircase.key
    conditions = [name for name, keys in protocol.conditions.items() if key in _list_keys(keys)]
    if conditions:
        yield f"staircase.key: {key} must not be set by condition {', '.join(conditions)} too"


def _check_scenario(scenario: Scenario, protocol: ExperimentProtocol) -> Scenario:
    """Raises ScenarioError if the experiment cannot be run with the scenario of a condition.

    For example, each user needs a site at which a person can move the arm. Returns the scenario
    otherwise.

    Raises:
        ScenarioError: A user's site is missing or cannot be held by a person, or a wall, a
            dominance factor, a force limit or a key of the staircase is unsuitable.
    """
    for user in protocol.users:
        if user not in scenario.names:
            raise ScenarioError(
                f"the scenario has no site {user}; its sites are {', '.join(scenario.names)}",
                path="users",
            )
        if scenario.sites[user].find_live_hand(is_open=True) is None:
            raise ScenarioError(
                "has no live hand, so nobody can hold this arm; "
                "add hands = [{ kind = 'live' }]",
                path=f"sites.{user}.hands",
            )

    slave = scenario.slave
    if protocol.task.needs_wall and not scenario.sites[slave].environment:
        raise ScenarioError(
            "the slave has no wall to press against", path=f"sites.{slave}.environment"
        )

    user_shares = [scenario.dominance[slave].get(user, 0.0) for user in protocol.users]
    needs_shares = protocol.training is not None or protocol.task.needs_pair
    if needs_shares and min(user_shares) <= 0.0:
        raise ScenarioError("both users must have a share above 0", path=f"dominance.{slave}")

    for group in protocol.groups:
        protocol.limit_forces(scenario, group)

    staircase = protocol.staircase
    if staircase is not None:
        largest_value = staircase.standard + staircase.start
        for value in (staircase.standard, largest_value):
            load_scenario(scenario, {staircase.key: value})
    return scenario


def _list_trials(protocol: ExperimentProtocol) -> Iterator[PlannedTrial]:
    """Yields all trials of an experiment in the order in which they are run.

    Each group of participants does one block of trials per condition. The conditions follow the
    next order from `ExperimentProtocol.list_orders`. A block begins with practice trials,
    followed by the trials of `ExperimentProtocol.list_phases`, each of which has a phase (of a
    training or staircase, otherwise empty) and a lead (the first user's share of the authority
    over the slave arm). The condition of a catch trial differs from that of its block. Numbers
    start at 1, and indices at 0.

    Each random quantity has its own generator, whose seed consists of the seed of the protocol,
    the group, the block and a number that distinguishes the quantities: none for the first
    target, 1 for catch trials, and 2 for phases. A change in one quantity therefore does not
    affect the others.

    Args:
        protocol: Design of the experiment: conditions, task and participants.
    """
    orders = protocol.list_orders()
    groups = list(enumerate(protocol.groups))
    blocks = range(len(protocol.conditions))
    number = 0
    for (group_index, group), block in itertools.product(groups, blocks):
        condition = orders[group_index % len(orders)][block]
        phase_random = np.random.default_rng([protocol.seed, group_index, block, 2])
        phases: list[tuple[str, float | None]] = [("", None)] * protocol.practice
        phases += protocol.list_phases(condition, phase_random)
        catch_trials = _draw_catches(protocol, condition, group_index, block)
        target_random = np.random.default_rng([protocol.seed, group_index, block])
        # A task has fewer targets than this number, and takes it modulo the number of its
        # targets.
        first_target = int(target_random.integers(1000))
        for trial, (phase, lead) in enumerate(phases):
            number += 1
            is_catch = trial in catch_trials
            trial_condition = condition
            if protocol.catch is not None and is_catch:
                trial_condition = protocol.catch.condition
            seed_sequence = np.random.SeedSequence([protocol.seed, number])
            state = seed_sequence.generate_state(1)
            target_step = trial
            if protocol.staircase:
                # Both trials of a pair have the same target.
                target_step = (trial - protocol.practice) // 2
            yield PlannedTrial(
                number=number,
                group=group,
                condition=trial_condition,
                block=block + 1,
                trial=trial + 1,
                practice=trial < protocol.practice,
                before=block * len(phases) + trial,
                target=first_target + target_step,
                # 31 bits, so that the seed is a positive 32-bit integer.
                seed=int(state[0]) >> 1,
                catch=is_catch,
                phase=phase,
                lead=lead,
            )


def _draw_catches(
    protocol: ExperimentProtocol, condition: str, group: int, block: int
) -> set[int]:
    """Draws which trials of a block are catch trials.

    Catch trials have an unexpected condition, so participants cannot rely on the condition of
    the block. Different behaviour in a catch trial shows that they have adapted to that
    condition.

    Args:
        protocol: Design of the experiment: conditions, task and participants.
        condition: Condition of the block.
        group: Index of the group.
        block: Index of the block.

    Returns:
        Indices of the catch trials in the block, starting at 0 and including practice trials.
    """
    catch = protocol.catch
    if catch is None or catch.condition == condition:
        return set()
    random = np.random.default_rng([protocol.seed, group, block, 1])
    count = round(catch.share * protocol.trials)
    drawn_trials = random.permutation(protocol.trials)[:count]
    indices = protocol.practice + drawn_trials
    return set(indices.tolist())
