"""Lets a user's program, for example a learned policy, act as the operator of an arm.

The scenario names the class of the program:

    { kind = "own", class = "my_policy:Reach" }

`ProgramHand` holds this table, and `HandPlayer` calls the program at a fixed rate during the
run. The actions of the program take effect at control periods of the arm.

Invariant:
    - Naming the class in a scenario does not run any of its code.
    - If the program fails, it lets go of the arm at that tick and is not called again. The run
      continues, and nothing else at this site or any other site is affected.
"""

import math
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, NamedTuple

from msgspec import Meta, field

from ... import fields
from ...core import (
    Array,
    HandContext,
    HandProgram,
    HandRules,
    HandView,
    OwnHand,
    Site,
    SiteArrays,
    tick_ns,
)
from ...errors import describe_exception
from ...own_code import (
    CLASS_PATTERN,
    CodeKey,
    Watch,
    call_directly,
    make_own_instance,
    read_code,
)
from ...records import NS_PER_S
from . import HeldArm
from .kernel_operators import LiveHand

if TYPE_CHECKING:
    from ..scenario_types import Scenario

PROGRAM_KEYS = ("class", "rate_hz", "delay_ms", "process", "source_sha256", "settings")
"""Keys that a program has in addition to the keys of a live operator."""

POLICY = "policy"
"""Name under which a trained program takes hold of an arm in the log."""

FAILED_HAND = "failed at tick"
"""Phrase used in log events for a program that failed while moving an arm."""


class ProgramHand(
    LiveHand, frozen=True, kw_only=True, tag="own", omit_defaults=True, rename={"code": "class"}
):
    """Operator that is a user's program (a Python class) instead of a person.

    The program observes the information available at its site, and moves, turns or pushes the
    arm. It takes hold of the arm with its first action, and nobody else can hold that arm.
    Otherwise, the rules are those of a live operator (see `LiveHand`).

    Attributes:
        code: Class of the program, for example "my_policy:Reach".
        rate_hz: Rate at which the program is called, in Hz. Must divide the tick rate of the
            site.
        delay_ms: Time from an observation to the resulting action, in ms: the time available to
            the program for its computation.
        process: If True, the program runs in a separate process in a live session (`trilat
            hand`). Otherwise, it runs in the process of the site.
        acceleration_limit_m_s2: As for a live operator, but unlimited by default.
        acceleration_limit_rad_s2: As for a live operator, but unlimited by default.
        source_sha256: SHA-256 hash of the file that contains the class.
        settings: Mapping from name to value of the constructor arguments of the class.
    """

    is_open: ClassVar[bool] = False
    method: ClassVar[str] = "act"
    value_texts: ClassVar[Mapping[str, str]] = {
        **LiveHand.value_texts,
        "class": "a class, as in 'my_policy:Reach'",
        "rate_hz": "a whole number from 10 to 1000, Hz",
        "delay_ms": "a time from 0 to 1000 ms",
        "process": "true or false",
        "settings": "a table of the arguments of its class",
        "source_sha256": "the hash of its file; leave it out",
    }

    code: Annotated[str, Meta(pattern=CLASS_PATTERN, max_length=200)]
    source_sha256: Annotated[str, Meta(pattern=r"^[0-9a-f]{64}$")]
    rate_hz: Annotated[int, Meta(ge=10, le=1000)] = 50
    delay_ms: Annotated[float, Meta(ge=0.0, le=1000.0)] = 20.0
    process: bool = False
    acceleration_limit_m_s2: fields.Positive = fields.MAX_QUANTITY
    acceleration_limit_rad_s2: fields.Positive = fields.MAX_QUANTITY
    settings: dict[str, Any] = field(default_factory=dict)

    @classmethod
    def complete_table(
        cls, table: fields.TomlTable, entry: fields.TomlTable, held_arm: HeldArm, path: str
    ) -> None:
        """Completes the settings of a program that operates an arm.

        Adds the SHA-256 hash of the file that contains the class, which records the version of
        the program used in the experiment. Settings shared with live operators are completed in
        the same way as theirs.

        Args:
            table: Settings of the operator including defaults, modified in place.
            entry: The same settings as written by their author.
            held_arm: The arm that the program moves.
            path: Path of the settings in the scenario, for error messages.

        Raises:
            ScenarioError: The file of the class cannot be read, or a setting is not valid.
        """
        code = table.get("class")
        if isinstance(code, str) and "source_sha256" not in entry:
            table["source_sha256"] = read_code(code, f"{path}.class").sha256
        # A live hand refuses keys that its mode does not have.
        program_table = {key: table.pop(key) for key in PROGRAM_KEYS if key in table}
        super().complete_table(table, entry, held_arm, path)
        table |= program_table


class HandSite(NamedTuple):
    """A site at which a program (a user's Python class) operates the arm.

    Attributes:
        scenario: The scenario.
        name: Name of the site.
        spec: Settings of the program in the scenario.
        rate_hz: Rate at which the program is called, in Hz.
        delay_s: Time from an observation of the arm to the resulting action, in s.
    """

    scenario: "Scenario"
    name: str
    spec: LiveHand
    rate_hz: int
    delay_s: float

    @property
    def program(self) -> str:
        """Name of the class that operates the arm, for example "my_policy:Reach".

        "a program" if no class is named.
        """
        return self.spec.code if isinstance(self.spec, ProgramHand) else "a program"

    @property
    def source(self) -> str:
        """Identifier by which a site recognises the messages of this program.

        Combines the class of the program with the hash of the scenario, as in "my_policy:Reach
        5cfbf3f16ec0c567". Both are shortened to fit into a message.
        """
        return f"{self.program[:40]} {self.scenario.sha256[:16]}"

    def describe(self) -> HandContext:
        """Returns the information that the program receives when it is created.

        Includes the name of its site, the other sites, and the mode in which the program moves
        the arm.
        """
        spec = self.spec
        rules = self.make_rules()
        return HandContext(
            site=self.name,
            peers=self.scenario.peers(self.name),
            mode=spec.mode,
            size=rules.size,
            rate_hz=self.rate_hz,
            delay_s=self.delay_s,
            speed_limit=rules.speed_limit,
            limit=spec.torque_limit_nm if spec.mode == "joint" else spec.force_limit_n,
            seed=self.scenario.draw_seed(self.name),
        )

    def make_rules(self) -> HandRules:
        """Returns the limits on what the program that moves this arm may command.

        They bound the speed and range of the target to which the arm is pulled, and the forces.
        """
        tick_rate_hz = self.scenario.sites[self.name].rate_hz
        return self.spec.make_rules(tick_rate_hz, self.scenario.arms[self.name])

    def make_hand(self) -> OwnHand:
        """Creates the object that calls the program and applies its actions at the right ticks.

        The program is called `rate_hz` times per second. An action takes effect `delay_s` after
        the observation on which it is based, rounded up to a whole number of control periods.
        """
        tick_rate_hz = self.scenario.sites[self.name].rate_hz
        arm = self.scenario.arms[self.name]
        locate: Any = list if self.spec.mode == "joint" else arm.end_effector
        # The product is rounded first, because in floating point 9 ms at 1000 Hz is slightly
        # more than 9 ticks.
        delay_ticks = math.ceil(round(self.delay_s * tick_rate_hz, 6))
        return OwnHand(self.make_rules(), tick_rate_hz // self.rate_hz, delay_ticks, locate)

    @classmethod
    def find(cls, scenario: "Scenario", site: str) -> "HandSite | None":
        """Returns the program that operates the arm of a site, if there is one.

        Args:
            scenario: The scenario.
            site: Name of the site.

        Returns:
            The site with its program, or None if no operator of the site is a program.
        """
        for hand in scenario.sites[site].hands:
            if isinstance(hand, ProgramHand):
                return HandSite(
                    scenario=scenario,
                    name=site,
                    spec=hand,
                    rate_hz=hand.rate_hz,
                    delay_s=hand.delay_ms * 1e-3,
                )
        return None

    def make_program(self) -> HandProgram:
        """Creates an instance of the user's class that operates the arm.

        Imports the class, provided that a person has permitted its code to run.

        Raises:
            CodeWithheld: Nobody has permitted the code of the class to run.
            ScenarioError: The class cannot be imported or instantiated.
        """
        path = f"sites.{self.name}.hands"
        spec = self.spec
        assert isinstance(spec, ProgramHand)
        kind = CodeKey.of(spec).import_class(f"{path}.class", spec.method)
        program: HandProgram = make_own_instance(
            kind, spec.code, self.describe(), spec.settings, path
        )
        return program


class HandPlayer:
    """Calls a program that operates an arm, and passes its actions to the site.

    A program that fails lets go of the arm for the rest of the run.

    Args:
        hand_site: The site, and the settings of the program.
        program: Instance of the user's class.
        watch: Function through which the program is called, for example with a time limit.

    Attributes:
        hand: Schedule that determines when the program is called and when its actions take
            effect.
        failure: Reason why the program failed. Empty if the program has not failed.
        news: Events that have not been published yet, for example that the program took hold of
            the arm. Each event is a pair of tick number and sentence.
    """

    def __init__(self, hand_site: HandSite, program: Any, watch: Watch = call_directly) -> None:
        self._program = program
        self._watch = watch
        self.failure = ""
        self.news = list[tuple[int, str]]()
        scenario = hand_site.scenario
        self._site = hand_site.name
        self._code = hand_site.program
        self._layout = scenario.layout(hand_site.name)
        self._rate_hz = scenario.sites[hand_site.name].rate_hz
        self.hand = hand_site.make_hand()

    @staticmethod
    def make_all(scenario: "Scenario") -> "dict[str, HandPlayer]":
        """Creates the programs of all sites whose arm is operated by a program.

        Args:
            scenario: The scenario.

        Returns:
            Mapping from site name to the object that calls the program. Empty if no site has a
            program.

        Raises:
            CodeWithheld: Nobody has permitted the code of a class to run.
            ScenarioError: A program cannot be created.
        """
        players = {}
        for name in scenario.names:
            hand_site = HandSite.find(scenario, name)
            if hand_site is not None:
                players[name] = HandPlayer(hand_site, hand_site.make_program())
        return players

    def track(self, site: Site, k: int) -> list[float]:
        """Returns the action of the program in one control period.

        Calls the program if a call is due; otherwise the previous action continues. Must be
        called once per control period, in order.

        Args:
            site: State of the site before the control period.
            k: Number of the control period.

        Returns:
            The action in the format of `HandInForce`, for example the target to which the
            program pulls the arm.
        """
        step = self.hand.advance_to(k, self._prepare(k, site.arrays))
        self.news += [(k, self._describe_change(k, change)) for _, change in step.changes]
        return step.vector

    def compute_actions(self, k: int, end: int, arrays: SiteArrays) -> Array:
        """Computes the actions of the program for several control periods at once.

        Stops before the first period in which the program has to observe a state of the arm
        that has not been computed yet.

        Args:
            k: Number of the first control period.
            end: Upper bound on the control period numbers, exclusive.
            arrays: State of the site before period `k`.

        Returns:
            One row per control period in the format of `HandInForce`, for example with the
            target to which the program pulls the arm.
        """
        return self.hand.advance_span(k, end, self._prepare(k, arrays))

    def _prepare(self, k: int, arrays: SiteArrays) -> Callable[[], list[float]]:
        """Calls the program that moves the arm, if a decision is due in control period k.

        Returns:
            A function that returns the joint angles of the arm, in rad.
        """
        if self.hand.is_decision_tick(k) and not self.failure:
            self.request_action(k, arrays)
        angles: Array = arrays.site[0]["q"][: self._layout.joints]
        return angles.tolist

    def view(self, k: int, arrays: SiteArrays) -> HandView:
        """Returns what the program observes in control period k, such as the arms' states.

        Args:
            k: Number of the tick.
            arrays: State of the site before the tick.
        """
        return self.hand.build_view(k, arrays, self._layout)

    def request_action(self, k: int, arrays: SiteArrays) -> None:
        """Calls the program and schedules the action that it returns.

        The program receives its observation in this control period. Its action takes effect
        after the delay configured for the program.

        Args:
            k: Number of the tick.
            arrays: State of the site before the tick.
        """
        view = self.view(k, arrays)
        try:
            action = self._watch(k, lambda: self._program.act(view))
            self.hand.accept_decision(k, action)
        # The user's code may raise anything.
        except (Exception, SystemExit) as error:
            self.fail(k, describe_exception(error))

    def fail(self, k: int, problem: str) -> None:
        """Makes a failed program let go of the arm for the rest of the run.

        The run continues without the program, and the reason is recorded.

        Args:
            k: Number of the tick in which the program lets go.
            problem: Human-readable reason for the failure.
        """
        self.failure = f"{self._site}: its hand {self._code} {FAILED_HAND} {k}: {problem}"
        self.news.append((k, f"{self.failure}; it lets go and is not asked again"))
        self.hand.release(k)

    def _describe_change(self, k: int, change: str) -> str:
        """Returns a sentence about the program, for example that it takes hold of the arm."""
        t_s = tick_ns(k, self._rate_hz) / NS_PER_S
        return f"{self._site}: {self._code} {change} at t = {t_s:.3f} s"
