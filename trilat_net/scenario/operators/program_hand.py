"""A hand of one's own in a scenario: `{ kind = "own", class = "package.module:Class", ... }`.

Invariant: naming the class runs nothing. A hand that fails lets go at that tick and is not
asked again, and the run goes on without it: whoever else holds the arm, and all other sites,
never notice.
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

OWN_KEYS = ("class", "rate_hz", "delay_ms", "process", "source_sha256", "settings")


class ProgramHand(
    LiveHand, frozen=True, kw_only=True, tag="own", omit_defaults=True, rename={"code": "class"}
):
    """An operator that is a class of one's own: it sees what its site knows, and moves, turns
    or pushes.

    It takes hold at its first action. All else is as of a live hand; nobody else can hold the
    arm.

    Attributes:
        code: its class, as in "my_policy:Reach".
        rate_hz: how often it is asked, Hz; the tick rate of the site is a multiple of it.
        delay_ms: time from what it sees to what it does: it may think for so long.
        process: true: live it runs in a process of its own (`trilat hand`), else in that of the
            site.
        acceleration_limit_m_s2: as of a live hand; left out, there is none.
        acceleration_limit_rad_s2: likewise.
        source_sha256: hash of the file of its class.
        settings: the arguments of its class, by name.
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
    def complete(
        cls, table: fields.TomlTable, entry: fields.TomlTable, holding: HeldArm, path: str
    ) -> None:
        """Names the file of its class by a hash, and does as a live hand."""
        code = table.get("class")
        place = f"{path}.class"
        if isinstance(code, str) and "source_sha256" not in entry:
            table["source_sha256"] = read_code(code, place).sha256
        kept = {key: table.pop(key) for key in OWN_KEYS if key in table}
        super().complete(table, entry, holding, path)
        table |= kept


class HandSite(NamedTuple):
    """A site as its hand of one's own needs it, which is asked `rate_hz` times a second.

    Attributes:
        delay_s: time from what it sees to what it does, s.
    """

    scenario: "Scenario"
    name: str
    spec: LiveHand
    rate_hz: int
    delay_s: float

    @property
    def program(self) -> str:
        """What the scenario calls its class."""
        return self.spec.code if isinstance(self.spec, ProgramHand) else "a program"

    @property
    def has_separate_process(self) -> bool:
        """True if live it runs in a process of its own."""
        return isinstance(self.spec, ProgramHand) and self.spec.process

    @property
    def source(self) -> str:
        """What its messages are known by: its class, and the scenario that has it."""
        return f"{self.program[:40]} {self.scenario.sha256[:16]}"

    def describe(self) -> HandContext:
        """Returns what its program knows before it begins."""
        scenario = self.scenario
        name = self.name
        spec = self.spec
        rules = spec.make_rules(scenario.sites[name].rate_hz, scenario.arms[name])
        limit = spec.torque_limit_nm if spec.mode == "joint" else spec.force_limit_n
        own = (self.rate_hz, self.delay_s, rules.speed_limit, limit, scenario.draw_seed(name))
        return HandContext(name, scenario.peers(name), spec.mode, rules.size, *own)

    def make_hand(self) -> OwnHand:
        """Returns the hand."""
        tick_rate_hz = self.scenario.sites[self.name].rate_hz
        arm = self.scenario.arms[self.name]
        place: Any = list if self.spec.mode == "joint" else arm.end_effector
        delay = math.ceil(round(self.delay_s * tick_rate_hz, 6))
        return OwnHand(
            self.spec.make_rules(tick_rate_hz, arm), tick_rate_hz // self.rate_hz, delay, place
        )


class HandPlayer:
    """A hand of one's own at its site: asks its class, lets it act, and lets go of the arm if
    it fails.

    Attributes:
        hand: when it is asked and acts.
        failure: why it failed; "": it did not.
        news: ticks, and sentences on what it has done that no event names yet.
    """

    def __init__(self, at: HandSite, program: Any, watch: Watch = call_directly) -> None:
        self._program = program
        self._watch = watch
        self.failure = ""
        self.news = list[tuple[int, str]]()
        self._site = at.name
        self._code = at.program
        self._layout = at.scenario.layout(at.name)
        self._rate_hz = at.scenario.sites[at.name].rate_hz
        self.hand = at.make_hand()

    def track(self, site: Site, k: int) -> list[float]:
        """Returns what it does in tick k, which its site is about to make; see `HandInForce`."""
        step = self.hand.advance_to(k, self._begin(k, site.arrays))
        self.news += [(k, self._tell(k, change)) for _, change in step.changes]
        return step.vector

    def compute_actions(self, k: int, end: int, arrays: SiteArrays) -> Array:
        """Returns what it does from tick k until it needs the arm again, before tick `end`, a
        row a tick.
        """
        return self.hand.advance_span(k, end, self._begin(k, arrays))

    def _begin(self, k: int, arrays: SiteArrays) -> Callable[[], list[float]]:
        """Asks, if it is time to; returns what reads the angles of the joints, rad."""
        if self.hand.is_decision_tick(k) and not self.failure:
            self.ask(k, arrays)
        angles: Array = arrays.site[0]["q"][: self._layout.joints]
        return angles.tolist

    def view(self, k: int, arrays: SiteArrays) -> HandView:
        """Returns what it sees at tick k."""
        return self.hand.build_view(k, arrays, self._layout)

    def ask(self, k: int, arrays: SiteArrays) -> None:
        """Asks its class at tick k."""
        view = self.view(k, arrays)
        try:
            self.hand.accept_decision(k, self._watch(k, lambda: self._program.act(view)))
        except (Exception, SystemExit) as error:  # the user's code
            self.fail(k, f"{type(error).__name__}: {error}")

    def fail(self, k: int, problem: str) -> None:
        """Lets go at tick k, for good."""
        self.failure = f"{self._site}: its hand {self._code} failed at tick {k}: {problem}"
        self.news.append((k, f"{self.failure}; it lets go and is not asked again"))
        self.hand.release(k)

    def _tell(self, k: int, change: str) -> str:
        return f"{self._site}: {self._code} {change} at t = {tick_ns(k, self._rate_hz) / NS_PER_S:.3f} s"


def find_own_hand(scenario: "Scenario", site: str) -> HandSite | None:
    """Returns a site with its hand of one's own, or None if it has none."""
    spec = next(
        (one for one in scenario.sites[site].hands if isinstance(one, ProgramHand)), None
    )
    return (
        None
        if spec is None
        else HandSite(
            scenario=scenario,
            name=site,
            spec=spec,
            rate_hz=spec.rate_hz,
            delay_s=spec.delay_ms * 1e-3,
        )
    )


def make_hand_program(at: HandSite) -> HandProgram:
    """Returns the program of a hand.

    Raises:
        CodeWithheld: its class may not run.
        ScenarioError: it cannot be made.
    """
    path = f"sites.{at.name}.hands"
    spec = at.spec
    assert isinstance(spec, ProgramHand)
    kind = import_class(CodeKey.of(spec), f"{path}.class", spec.method)
    made: HandProgram = make_instance(kind, spec.code, at.describe(), spec.settings, path=path)
    return made


def make_hand_players(scenario: "Scenario") -> dict[str, HandPlayer]:
    """Returns the players of all hands of one's own, by site.

    Raises:
        CodeWithheld: a class may not run.
        ScenarioError: one cannot be made.
    """
    placed = (find_own_hand(scenario, name) for name in scenario.names)
    return {at.name: HandPlayer(at, make_hand_program(at)) for at in placed if at is not None}
