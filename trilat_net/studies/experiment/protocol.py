"""The protocol of an experiment with people, from one TOML file, and the trials that follow
from it.

Invariant: the plan is a function of the protocol. Its digest, over the protocol and the text of
the scenario of every condition, stands in the log of every trial: what was planned before
anybody sat down can be shown afterwards. A protocol that cannot be carried out is refused as a
whole, with everything that is wrong.
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

from ...errors import ScenarioError, TrilatError, UsageError, count_nouns
from ...fields import Frozen, Positive
from ...reporting.result_text import Block, TextTable
from ...results import Result
from ...scenario import Scenario, load_scenario
from .questionnaires import Name, Questionnaire, find_form
from .staircase import COMPARISON, STANDARD, Staircase
from .synthetic_participant import ParticipantModel, Share
from .tasks import AnyTask, ReachTrial

Wait = Annotated[float, Meta(ge=0.0, le=60.0)]
Pseudonym = Annotated[str, Meta(pattern=r"^[A-Za-z0-9_]{1,20}\Z")]
"""It becomes part of file names."""
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


class CatchTrials(Frozen, frozen=True):
    """Trials of another condition among those of a block, so that nobody learns what to expect
    of it.

    Attributes:
        condition: which.
        share: of the trials of a block that count, rounded; blocks of that condition have none.
    """

    condition: Name
    share: Annotated[float, Meta(gt=0.0, le=0.5)] = 0.1


class Training(Frozen, frozen=True):
    """Authority that moves from the first user, an expert, to the second one, who learns.

    Attributes:
        lead: by condition the expert's part of what both share at the slave, in the first and
            last trial.
        before: trials of a block before that, which the second user makes alone.
        after: trials alone right afterwards: what was learned.
        retention: trials alone later, after a rest: what is left of it.
        rest_s: that rest, s.
    """

    lead: dict[Name, tuple[Share, Share]]
    before: Counted = 2
    after: Counted = 2
    retention: Counted = 0
    rest_s: Annotated[float, Meta(ge=0.0, le=1e6)] = 600.0

    def describe(self) -> str:
        """Returns it in a sentence of a methods paragraph."""
        parts = ", ".join(
            f"{first:g} to {last:g} ({name})" for name, (first, last) in self.lead.items()
        )
        later = f", and {self.retention} more after {self.rest_s:g} s" if self.retention else ""
        return (
            f"In these the expert's part of the authority went from {parts}; "
            f"{count_nouns(self.before, 'trial')} before and "
            f"{self.after} after them{later} were made without it and are compared"
        )


class Protocol(Frozen, frozen=True):
    """An experiment, as its file has it.

    Attributes:
        name: of the experiment.
        title: in words.
        scenario: name or path of the scenario that all conditions are made of.
        users: the sites that participants hold; two of them are held by a pair.
        participants: how many, or their pseudonyms.
        design: how the order of conditions is balanced over participants, see
            docs/experiments.md.
        trials: trials of a block that count; a block is all trials of one condition.
        practice: trials before those, which do not.
        foreperiod_s: range of the time from the begin of a trial until its target appears, s;
            drawn evenly.
        seed: of orders, targets and synthetic participants.
        set: keys of the scenario that are alike in all conditions.
        conditions: the keys of the scenario that each sets, by name.
        task: what a participant does.
        model: the numbers of synthetic participants.
        consent: what people agree to before their first trial; "" asks for nothing.
        questionnaires: what people answer, and when.
        rest_s: how long people rest at least between two blocks, s.
        feedback: the measures that people are told after a trial.
        force_limit_n: largest force of the live hands of participants who bear less, N, by
            pseudonym.
        catch: trials of another condition among those of a block; they do not count.
        training: trials in which authority moves from an expert to somebody who learns.
        staircase: pairs of trials by which a key is adapted to what a participant can tell.
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
    catch: CatchTrials | None = None
    training: Training | None = None
    staircase: Staircase | None = None

    def list_phases(
        self, condition: str, random: np.random.Generator
    ) -> list[tuple[str, float | None]]:
        """Returns phase and first user's part of what two share, of every trial of a block
        after practice.
        """
        if self.staircase is not None:
            pairs = [
                random.permutation([STANDARD, COMPARISON]).tolist()
                for _ in range(self.trials // 2)
            ]
            return [(phase, None) for phase in itertools.chain(*pairs)]
        if (how := self.training) is None:
            return [("", None)] * self.trials
        parts = np.linspace(*how.lead[condition], self.trials).tolist()
        alone = {"before": how.before, "after": how.after, "retention": how.retention}
        before, after, later = ([(phase, 0.0)] * count for phase, count in alone.items())
        return [*before, *(("training", part) for part in parts), *after, *later]

    @property
    def forms(self) -> list[Questionnaire]:
        """What is answered: questionnaires, and the choices of a staircase."""
        return [*self.questionnaires, *([self.staircase.form] if self.staircase else [])]

    @property
    def groups(self) -> list[tuple[str, ...]]:
        """Who takes part together: one participant, or a pair."""
        names = self.participants
        if isinstance(names, int):
            names = tuple(f"P{n:0{len(str(self.participants))}d}" for n in range(1, names + 1))
        size = len(self.users)
        return [names[n : n + size] for n in range(0, len(names), size)]


class PlannedTrial(NamedTuple):
    """One trial of the plan.

    Attributes:
        number: its place in the experiment, from 1.
        group: who takes part, by the users of the protocol.
        condition: by name.
        block: the how manyth condition of this group it is, from 1.
        trial: its place in the block, from 1; practice comes first.
        practice: whether it does not count.
        before: how many trials the group has made before.
        target: the number of its target; each block begins at another, which is drawn, so that
            what the direction of a target does is no learning. Both trials of a pair have one.
        seed: of what is drawn in it.
        catch: whether its condition is another than the block's, and it does not count.
        phase: of a training: "before", "training", "after" or "retention"; of a staircase which
            trial of its pair it is: "standard" or "comparison".
        lead: the first user's part of what two users share at the slave; None: as the scenario
            has it.
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
        """The name of its log."""
        who = "-".join(self.group)
        return f"{self.number:05d}-{who}-b{self.block}-t{self.trial:02d}-{self.condition}.mcap"


Choices = Mapping[int, float]
"""Which trial, 1 or 2, was chosen of each pair of a staircase so far, by the number of its
second trial.
"""


class Step(NamedTuple):
    """Something that people do in an experiment.

    Attributes:
        kind: "consent", "trial" or "questionnaire".
        planned: the trial that it is, comes before, or comes after.
        form: what is answered, of a questionnaire.
    """

    kind: Literal["consent", "trial", "questionnaire"]
    planned: PlannedTrial
    form: Questionnaire | None = None

    @property
    def key(self) -> str:
        """What it is called in notes and messages."""
        return f"{self.kind} {self.planned.number}" + (
            f" {self.form.name}" if self.form else ""
        )


@dataclass(frozen=True, repr=False)
class ExperimentPlan(Result):
    """A protocol, the scenario of every condition, and all trials in their order.

    Attributes:
        digest: SHA-256 of protocol and scenarios, in hexadecimal digits.
    """

    protocol: Protocol
    scenarios: Mapping[str, Scenario]
    trials: Sequence[PlannedTrial]
    digest: str

    def to_dict(self) -> dict[str, Any]:
        """Returns it as `trilat experiment check --json`."""
        protocol = self.protocol
        facts = {"name": protocol.name, "digest": self.digest, "groups": len(protocol.groups)}
        counted = sum(not (one.practice or one.catch) for one in self.trials)
        counts = {"trials": len(self.trials), "counted": counted}
        return {
            **facts,
            **counts,
            "conditions": list(protocol.conditions),
            "orders": self.list_orders(),
        }

    def list_steps(self) -> Iterator[Step]:
        """Yields what people do, in order."""
        protocol = self.protocol
        for planned in self.trials:
            if protocol.consent and planned.block == planned.trial == 1:
                yield Step("consent", planned)
            yield Step("trial", planned)
            counted = planned.trial - protocol.practice
            if (stairs := protocol.staircase) is not None and counted > 0 and counted % 2 == 0:
                yield Step("questionnaire", planned, stairs.form)
            if planned.trial == self.trials[-1].trial:
                left = planned.block == len(protocol.conditions)
                asked = [
                    form for form in protocol.questionnaires if left or form.after == "block"
                ]
                yield from (Step("questionnaire", planned, find_form(form)) for form in asked)

    def judge_choices(self, planned: PlannedTrial, choices: Choices) -> list[bool]:
        """Returns whether each choice of a trial's block is the trial that had more."""
        block = self.trials[planned.number - planned.trial :][: self.trials[-1].trial]
        seconds = [one for one in block if one.number in choices]
        return [
            choices[second.number] == 1 + (second.phase == COMPARISON) for second in seconds
        ]

    def find_pair(self, planned: PlannedTrial, choices: Choices) -> tuple[float, bool | None]:
        """Returns the difference in a trial's pair, and whether the choice was right; None: it
        is to come.
        """
        stairs = self.protocol.staircase
        number = (planned.trial - self.protocol.practice - 1) // 2
        assert stairs is not None
        right = self.judge_choices(planned, choices)
        return stairs.list_differences(right)[number], right[number] if number < len(
            right
        ) else None

    def find_scenario(self, planned: PlannedTrial, choices: Choices) -> Scenario:
        """Returns the scenario of a trial, after the choices of its block before it."""
        scenario = self.scenarios[planned.condition]
        stairs = self.protocol.staircase
        if stairs is None or planned.practice:
            return scenario
        more = self.find_pair(planned, choices)[0] if planned.phase == COMPARISON else 0.0
        return load_scenario(scenario, {stairs.key: stairs.standard + more})

    def rest_before_s(self, planned: PlannedTrial) -> float:
        """Returns how long people rest at least before a trial, s."""
        training = self.protocol.training
        before = self.trials[max(planned.number - 2, 0)]
        if training is not None and planned.phase == "retention" != before.phase:
            return training.rest_s
        return self.protocol.rest_s if planned.trial == 1 and planned.block > 1 else 0.0

    def list_orders(self) -> dict[str, list[str]]:
        """Returns the order of conditions of each group, by its name."""
        found: dict[str, list[str]] = {}
        for trial in (one for one in self.trials if not one.catch):
            order = found.setdefault("-".join(trial.group), [])
            if trial.condition not in order:
                order.append(trial.condition)
        return found

    def blocks(self) -> Iterator[Block]:
        """Yields its text."""
        protocol = self.protocol
        facts = self.to_dict()
        whose = "pairs" if len(protocol.users) > 1 else "participants"
        yield f"{protocol.name}: {protocol.title or protocol.task.description}"
        yield f"{facts['groups']} {whose} at {', '.join(protocol.users)}, {protocol.task.description}"
        trials = self.trials[-1].trial - protocol.practice
        each = (
            f"{count_nouns(len(protocol.conditions), 'condition')} of "
            f"{protocol.practice} + {count_nouns(trials, 'trial')}"
        )
        longest_s = protocol.foreperiod_s[1] + protocol.task.longest_s
        yield (
            f"{each}: {count_nouns(len(self.trials), 'trial')} of at most {longest_s:g} "
            f"s; design {protocol.design}"
        )
        yield TextTable(
            ("", "order of conditions"),
            [(name, ", ".join(one)) for name, one in facts["orders"].items()],
        )
        yield f"sha256 of the plan {self.digest}"


def read_protocol(file: str | Path) -> Protocol:
    """Returns the protocol of a file.

    Raises:
        UsageError: it cannot be read, or a key or value of it is not valid.
    """
    path = Path(file)
    try:
        tables = tomllib.loads(path.read_text(encoding="utf-8"))
        return msgspec.convert(tables, Protocol)
    except OSError as error:
        raise UsageError(f"{path}: cannot be read: {error.strerror}") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise UsageError(f"{path}: is no TOML: {error}") from None
    except msgspec.ValidationError as error:
        valid = ", ".join(one.encode_name for one in msgspec.structs.fields(Protocol))
        raise UsageError(f"{path}: {error}; the keys of a protocol are {valid}") from None


def plan_experiment(
    protocol: Protocol,
    folder: Path | None = None,
    scenarios: Mapping[str, Scenario] | None = None,
) -> ExperimentPlan:
    """Returns the plan of a protocol; a path of its scenario is from `folder`, or all
    `scenarios` are given.

    Raises:
        UsageError: it cannot be carried out; the error names everything that is wrong.
    """
    problems = list(_find_problems(protocol))
    found = dict(scenarios or {})
    source: str | Path = protocol.scenario
    if folder is not None and (folder / protocol.scenario).is_file():
        source = folder / protocol.scenario
    for name, keys in protocol.conditions.items() if scenarios is None else ():
        try:
            every = _list_keys(protocol.set) | _list_keys(keys)
            found[name] = _prepare(load_scenario(source, every), protocol)
        except TrilatError as error:
            problems.append(f"condition {name}: {error}")
    if problems:
        raise UsageError(f"{protocol.name}: " + "; ".join(problems))
    texts = {name: scenario.text for name, scenario in found.items()}
    whole = msgspec.json.encode([msgspec.to_builtins(protocol), texts], order="sorted")
    return ExperimentPlan(
        protocol, found, list(_list_trials(protocol)), hashlib.sha256(whole).hexdigest()
    )


def _list_keys(table: Mapping[str, Any], path: str = "") -> dict[str, Any]:
    """Returns keys of a scenario, each written out that is of a site, a link or a row of
    dominance.
    """
    found = dict[str, Any]()
    for name, value in table.items():
        key = f"{path}.{name}" if path else name
        inside = key in ("sites", "links", "dominance") or path in ("sites", "links")
        found |= (
            _list_keys(value, key) if inside and isinstance(value, Mapping) else {key: value}
        )
    return found


def _find_problems(protocol: Protocol) -> Iterator[str]:
    """Yields what no scenario is needed to see."""
    size = len(protocol.users)
    names = [name for group in protocol.groups for name in group]
    if protocol.foreperiod_s[0] > protocol.foreperiod_s[1]:
        yield f"foreperiod_s is from the shorter to the longer time, not {list(protocol.foreperiod_s)}"
    if len(set(names)) < len(names):
        yield "two participants have one pseudonym"
    if unknown := protocol.force_limit_n.keys() - set(names):
        yield f"force_limit_n: there is no participant {', '.join(sorted(unknown))}"
    if protocol.catch is not None and protocol.catch.condition not in protocol.conditions:
        yield f"catch.condition: there is no condition {protocol.catch.condition}"
    if (
        protocol.training is not None
        and protocol.training.lead.keys() != protocol.conditions.keys()
    ):
        yield f"training.lead: is a pair of numbers for each of {', '.join(protocol.conditions)}"
    if (
        sum(one is not None for one in (protocol.training, protocol.catch, protocol.staircase))
        > 1
    ):
        yield "an experiment has one of catch trials, a training and a staircase"
    if protocol.staircase is not None:
        yield from _find_staircase_problems(protocol, protocol.staircase)
    if size != 2 and (protocol.training is not None or protocol.task.needs_pair):
        yield "a training, a handover and users who are shown different targets need two users"
    forms = [form.name for form in protocol.forms]
    if len(set(forms)) < len(forms):
        yield "two questionnaires have one name"
    for form in protocol.questionnaires:
        try:
            find_form(form)
        except UsageError as error:
            yield str(error)
    if not 1 <= size <= 2 or len(set(protocol.users)) < size:
        yield f"users are one or two sites, not {', '.join(protocol.users)}"
    elif len(names) % size:
        lone = count_nouns(len(names), "participant makes", "participants make")
        yield f"{lone} no pairs: their number must be even"
    rows = len(list_orders(protocol.design, list(protocol.conditions), protocol.seed))
    if protocol.design in ("williams", "latin") and len(protocol.groups) % rows:
        whose = "pairs" if size == 2 else "participants"
        yield (
            f"a {protocol.design} design of "
            f"{count_nouns(len(protocol.conditions), 'condition')} has {count_nouns(rows, 'order')}: the "
            f"number of {whose} must be a multiple of {rows}, is {len(protocol.groups)}"
        )


def _find_staircase_problems(protocol: Protocol, stairs: Staircase) -> Iterator[str]:
    if len(protocol.users) != 1:
        yield "staircase: is of one user, who answers"
    if protocol.trials % 2:
        yield f"trials: a staircase is of pairs, their number must be even, is {protocol.trials}"
    if setting := [
        name for name, keys in protocol.conditions.items() if stairs.key in _list_keys(keys)
    ]:
        yield f"staircase.key: {stairs.key} is set by condition {', '.join(setting)} too"


def _prepare(scenario: Scenario, protocol: Protocol) -> Scenario:
    """Returns the scenario of a condition, if participants can hold its masters."""
    for user in protocol.users:
        if user not in scenario.names:
            raise ScenarioError(
                f"has no site {user}; there are {', '.join(scenario.names)}", path="users"
            )
        if scenario.sites[user].find_live_hand(is_open=True) is None:
            raise ScenarioError(
                "has no live hand, so nobody can hold it: hands = [{ kind = 'live' }]",
                path=f"sites.{user}.hands",
            )
    slave = scenario.slave
    if protocol.task.needs_wall and not scenario.sites[slave].environment:
        raise ScenarioError("there is no wall to press", path=f"sites.{slave}.environment")
    shares = [scenario.dominance[slave].get(user, 0.0) for user in protocol.users]
    if (protocol.training is not None or protocol.task.needs_pair) and min(shares) <= 0.0:
        raise ScenarioError("both users are to have a share", path=f"dominance.{slave}")
    for group in protocol.groups:
        limit_forces(scenario, protocol, group)
    if (stairs := protocol.staircase) is not None:
        for value in (stairs.standard, stairs.standard + stairs.start):
            load_scenario(scenario, {stairs.key: value})
    return scenario


def limit_forces(
    scenario: Scenario, protocol: Protocol, group: Sequence[str]
) -> dict[str, Any]:
    """Returns the users' sites whose live hand is to be weaker than the scenario's, by
    `force_limit_n`.

    Raises:
        ScenarioError: a hand has no such limit, or a lower one already.
    """
    found = {}
    # an odd one out is refused by itself
    for user, name in zip(protocol.users, group, strict=False):
        spec = scenario.sites[user]
        most = protocol.force_limit_n.get(name)
        hand = spec.find_live_hand(is_open=True)
        if most is None or hand is None:
            continue
        if hand.mode == "joint" or hand.force_limit_n < most:
            has = "none, N" if hand.mode == "joint" else f"{hand.force_limit_n:g} N"
            raise ScenarioError(
                f"{most:g} N: the live hand at {user} has a limit of {has}",
                path=f"force_limit_n.{name}",
            )
        limited = tuple(
            replace(one, force_limit_n=most) if one is hand else one for one in spec.hands
        )
        found[user] = replace(spec, hands=limited)
    return found


def list_orders(design: str, conditions: Sequence[str], seed: int) -> list[tuple[str, ...]]:
    """Returns the orders of conditions that participants get in turn.

    Williams (1949): each condition is equally often at each place, and equally often right
    after each other one; of an odd number of conditions there are twice as many orders. A
    cyclic Latin square balances places alone. "random": every permutation, shuffled; "fixed":
    as written.
    """
    n = len(conditions)
    if design == "fixed":
        return [tuple(conditions)]
    if design == "random":
        random = np.random.default_rng(seed)
        return [
            tuple(np.array(conditions)[random.permutation(n)].tolist()) for _ in range(1000)
        ]
    first = list(range(n))
    if design == "williams":  # 0, 1, n - 1, 2, n - 2, ...
        first = [
            0,
            *(place for k in range(1, n // 2 + 1) for place in dict.fromkeys((k, n - k))),
        ][:n]
    rows = [[(place + shift) % n for place in first] for shift in range(n)]
    if design == "williams" and n % 2:
        rows += [row[::-1] for row in rows]
    return [tuple(conditions[place] for place in row) for row in rows]


def _list_trials(protocol: Protocol) -> Iterator[PlannedTrial]:
    orders = list_orders(protocol.design, list(protocol.conditions), protocol.seed)
    number = 0
    for (n, group), block in itertools.product(
        enumerate(protocol.groups), range(len(protocol.conditions))
    ):
        condition = orders[n % len(orders)][block]
        random = np.random.default_rng([protocol.seed, n, block, 2])
        phases = [*[("", None)] * protocol.practice, *protocol.list_phases(condition, random)]
        for trial, phase in enumerate(phases):
            number += 1
            caught = trial in _draw_catches(protocol, condition, (n, block))
            drawn = np.random.SeedSequence([protocol.seed, number]).generate_state(1)
            seed = int(drawn[0]) >> 1
            practice = trial < protocol.practice
            first = np.random.default_rng([protocol.seed, n, block]).integers(1000)
            target = int(first) + (
                (trial - protocol.practice) // 2 if protocol.staircase else trial
            )
            counts = block + 1, trial + 1, practice, block * len(phases) + trial, target
            shown = (
                protocol.catch.condition if protocol.catch is not None and caught else condition
            )
            yield PlannedTrial(number, group, shown, *counts, seed, caught, *phase)


def _draw_catches(protocol: Protocol, condition: str, block: tuple[int, int]) -> set[int]:
    """Returns which trials of a block, from 0, are catch trials."""
    catch = protocol.catch
    if catch is None or catch.condition == condition:
        return set()
    random = np.random.default_rng([protocol.seed, *block, 1])
    count = round(catch.share * protocol.trials)
    return set((protocol.practice + random.permutation(protocol.trials)[:count]).tolist())
