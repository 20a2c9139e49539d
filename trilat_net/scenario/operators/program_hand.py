"""A user's own hand in a scenario: `{ kind = "own", class = "my_policy:Reach", ... }`.

`ProgramHand` is the table of the hand, and `HandPlayer` runs the program of the hand at a site.

Invariant:
    - Naming the class does not run any code of it.
    - A hand that fails lets go at that tick and is not asked again. The run goes on without it,
      and nothing else at the site, or at other sites, is affected.
"""

import math
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, NamedTuple

from msgspec import Meta, field

from ... import fields
from ...core.own_hand import HandContext, HandProgram, HandView, OwnHand
from ...core.site_arrays import SiteArrays
from ...core.site_step import Site
from ...core.ticks import NS_PER_S, tick_ns
from ...core.vectors import Array
from ...laws.interface import make_instance
from ..imported_code import (
    CLASS_PATTERN,
    CodeKey,
    Watch,
    call_directly,
    import_class,
    read_code,
)
from ..operators import HeldArm
from .kernel_operators import LiveHand

if TYPE_CHECKING:
    from ..scenario_types import Scenario

PROGRAM_KEYS = ("class", "rate_hz", "delay_ms", "process", "source_sha256", "settings")
"""The keys of a hand that is a program, besides those of a live hand."""


class ProgramHand(
    LiveHand, frozen=True, kw_only=True, tag="own", omit_defaults=True, rename={"code": "class"}
):
    """An operator that is a user's class: from what its site knows it moves, turns or pushes.

    The hand takes hold of the arm at its first action. Nobody else can hold that arm. Otherwise
    it is as a live hand.

    Attributes:
        code: its class, as in "my_policy:Reach".
        rate_hz: how often the class is asked for an action, Hz; it divides the tick rate of the
            site.
        delay_ms: time from a view to the action on it, which is the time that the class may
            take to decide.
        process: true: in a live session the class runs in a process of its own (`trilat hand`);
            false: in that of the site.
        acceleration_limit_m_s2: as of a live hand; left out: no limit.
        acceleration_limit_rad_s2: as of a live hand; left out: no limit.
        source_sha256: hash of the file of the class.
        settings: the arguments of the class, by name.
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
        """Adds the hash of the file of the class, and completes the keys of a live hand."""
        code = table.get("class")
        if isinstance(code, str) and "source_sha256" not in entry:
            table["source_sha256"] = read_code(code, f"{path}.class").sha256
        # A live hand refuses keys that its mode does not have.
        program_table = {key: table.pop(key) for key in PROGRAM_KEYS if key in table}
        super().complete_table(table, entry, held_arm, path)
        table |= program_table


class HandSite(NamedTuple):
    """A site with a user's own hand.

    Attributes:
        scenario: the scenario.
        name: the site.
        spec: the hand in the scenario.
        rate_hz: how often the hand is asked for an action, Hz.
        delay_s: time from a view to the action on it, s.
    """

    scenario: "Scenario"
    name: str
    spec: LiveHand
    rate_hz: int
    delay_s: float

    @property
    def program(self) -> str:
        """The name of the hand's class in the scenario."""
        return self.spec.code if isinstance(self.spec, ProgramHand) else "a program"

    @property
    def has_separate_process(self) -> bool:
        """True if the hand runs in a process of its own in a live session."""
        return isinstance(self.spec, ProgramHand) and self.spec.process

    @property
    def source(self) -> str:
        """The source that marks the hand's messages: its class and the hash of the scenario."""
        return f"{self.program[:40]} {self.scenario.sha256[:16]}"

    def describe(self) -> HandContext:
        """Returns the facts with which the program of the hand is made."""
        spec = self.spec
        rules = spec.make_rules(
            self.scenario.sites[self.name].rate_hz, self.scenario.arms[self.name]
        )
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

    def make_hand(self) -> OwnHand:
        """Returns the hand, which knows when the program is asked and its actions apply."""
        tick_rate_hz = self.scenario.sites[self.name].rate_hz
        arm = self.scenario.arms[self.name]
        locate: Any = list if self.spec.mode == "joint" else arm.end_effector
        # Rounded first: in floating point 9 ms at 1000 Hz are a little more than 9 ticks.
        delay_ticks = math.ceil(round(self.delay_s * tick_rate_hz, 6))
        rules = self.spec.make_rules(tick_rate_hz, arm)
        return OwnHand(rules, tick_rate_hz // self.rate_hz, delay_ticks, locate)


class HandPlayer:
    """Runs a user's own hand at its site.

    The player asks the program of the hand for actions and applies them. If the program fails,
    the hand lets go of the arm for good.

    Attributes:
        hand: the hand, which decides when the program is asked and when its actions apply.
        failure: why the program failed; "": it did not.
        news: ticks, and sentences on changes of the hand that no event reports yet.
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

    def track(self, site: Site, k: int) -> list[float]:
        """Returns the action of the hand in tick `k`, the next tick of its site.

        The numbers are those of `HandInForce`.
        """
        step = self.hand.advance_to(k, self._prepare(k, site.arrays))
        self.news += [(k, self._describe_change(k, change)) for _, change in step.changes]
        return step.vector

    def compute_actions(self, k: int, end: int, arrays: SiteArrays) -> Array:
        """Returns the actions from tick `k` until the hand needs the arm's state again.

        Returns:
            A row per tick, at most until before tick `end`.
        """
        return self.hand.advance_span(k, end, self._prepare(k, arrays))

    def _prepare(self, k: int, arrays: SiteArrays) -> Callable[[], list[float]]:
        """Asks the program for an action if tick `k` is due for one.

        Returns:
            A function that returns the joint angles of the arm, rad.
        """
        if self.hand.is_decision_tick(k) and not self.failure:
            self.request_action(k, arrays)
        angles: Array = arrays.site[0]["q"][: self._layout.joints]
        return angles.tolist

    def view(self, k: int, arrays: SiteArrays) -> HandView:
        """Returns what the program sees at tick `k`."""
        return self.hand.build_view(k, arrays, self._layout)

    def request_action(self, k: int, arrays: SiteArrays) -> None:
        """Asks the program for an action at tick `k`."""
        view = self.view(k, arrays)
        try:
            action = self._watch(k, lambda: self._program.act(view))
            self.hand.accept_decision(k, action)
        # The user's code may raise anything.
        except (Exception, SystemExit) as error:
            self.fail(k, f"{type(error).__name__}: {error}")

    def fail(self, k: int, problem: str) -> None:
        """Makes the hand let go at tick `k`, for good."""
        self.failure = f"{self._site}: its hand {self._code} failed at tick {k}: {problem}"
        self.news.append((k, f"{self.failure}; it lets go and is not asked again"))
        self.hand.release(k)

    def _describe_change(self, k: int, change: str) -> str:
        t_s = tick_ns(k, self._rate_hz) / NS_PER_S
        return f"{self._site}: {self._code} {change} at t = {t_s:.3f} s"


def find_own_hand(scenario: "Scenario", site: str) -> HandSite | None:
    """Returns a site with its own hand, or None if none of its hands is a program."""
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


def make_hand_program(hand_site: HandSite) -> HandProgram:
    """Returns the program of a hand: an instance of its class.

    Raises:
        CodeWithheld: the class may not run.
        ScenarioError: the class cannot be imported, or its instance cannot be made.
    """
    path = f"sites.{hand_site.name}.hands"
    spec = hand_site.spec
    assert isinstance(spec, ProgramHand)
    kind = import_class(CodeKey.of(spec), f"{path}.class", spec.method)
    program: HandProgram = make_instance(
        kind, spec.code, hand_site.describe(), spec.settings, path=path
    )
    return program


def make_hand_players(scenario: "Scenario") -> dict[str, HandPlayer]:
    """Returns the players of all users' own hands, by site.

    Raises:
        CodeWithheld: a class may not run.
        ScenarioError: a program cannot be made.
    """
    players = {}
    for name in scenario.names:
        hand_site = find_own_hand(scenario, name)
        if hand_site is not None:
            players[name] = HandPlayer(hand_site, make_hand_program(hand_site))
    return players
