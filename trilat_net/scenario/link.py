"""What every directed link has besides its delay: loss, duplicates, outages, order, play-out.

Law: loss is stated by what a person measures, its share and the mean length of its bursts; the chain of two
states that draws it follows from these in closed form.
"""

from typing import Annotated, Literal, NamedTuple

from msgspec import Meta

from ..core.delay import LIMIT_US, Delay, Model, Points
from .frozen import Frozen

LIMIT_MS = LIMIT_US / 1000
"""No delay is longer."""

MAX_OUTAGES = 1000
"""Most outages of a link: each sample is held against all of them."""

Milliseconds = Annotated[float, Meta(ge=0.0, le=LIMIT_MS)]
Probability = Annotated[float, Meta(ge=0.0, le=1.0)]
Instant = Annotated[float, Meta(ge=0.0, le=1e9)]


class Fault(NamedTuple):
    """What is wrong with a link: the key, and why."""

    key: str
    problem: str


class Moments(NamedTuple):
    """Mean and standard deviation of a delay, ms."""

    mean_ms: float
    deviation_ms: float


class LinkBase(Frozen, frozen=True, tag_field="model", omit_defaults=True):
    """What every model has besides its delay.

    Attributes:
        loss: share of samples that are lost in the long run.
        loss_burst: mean number of samples lost in a row; 0: each is lost by itself.
        loss_bad: of a burst's samples, the share that is lost; below 1 bursts have holes.
        duplicate: share of samples that come twice, the copy with a delay of its own.
        outages_s: times between which the link is cut, by the samples' stamps, s.
        order: "newest": a newer sample replaces an older one; "in_order": none overtakes an older one.
        playout_ms: every sample is held at least so long: jitter below it becomes a constant delay.
    """

    loss: Probability = 0.0
    loss_burst: Annotated[float, Meta(ge=0.0, le=1e6)] = 0.0
    loss_bad: Annotated[float, Meta(gt=0.0, le=1.0)] = 1.0
    duplicate: Probability = 0.0
    outages_s: Annotated[tuple[tuple[Instant, Instant], ...], Meta(max_length=MAX_OUTAGES)] = ()
    order: Literal["newest", "in_order"] = "newest"
    playout_ms: Milliseconds = 0.0

    def delay(self) -> Model:
        """Returns the delay alone, as the core has it."""
        raise NotImplementedError

    def moments(self) -> Moments:
        """Returns what the model states of its delay, before play-out, order and the cut at `LIMIT_MS`."""
        raise NotImplementedError

    def reach_ms(self) -> float:
        """Returns how far its delays go, ms: three deviations above the mean where they have no end."""
        mean_ms, deviation_ms = self.moments()
        return mean_ms + 3.0 * deviation_ms

    @property
    def random(self) -> bool:
        """True where anything of it is drawn."""
        drawn = self.delay().kind not in (Delay.CONSTANT, Delay.SINE, Delay.TRACE, Delay.MEASURED)
        return drawn or 0.0 < self.loss < 1.0 or 0.0 < self.duplicate < 1.0

    @property
    def measured(self) -> bool:
        """True where nothing is injected."""
        return self.delay().kind == Delay.MEASURED

    @property
    def points(self) -> Points | None:
        """The points of its trace, if it has one."""
        return None

    def core(self, from_ns: int = 0) -> Model:
        """Returns what the core builds the link from.

        Args:
            from_ns: the first stamp that it applies to, ns since the epoch.
        """
        good, bad, enter, leave = self._chain()
        return self.delay()._replace(
            from_ns=from_ns,
            loss_good=good,
            loss_bad=bad,
            enter=enter,
            leave=leave,
            duplicate=self.duplicate,
            in_order=int(self.order == "in_order"),
            playout_us=whole_us(self.playout_ms),
        )

    def _chain(self) -> tuple[float, float, float, float]:
        """Returns the chain of losses: loss in good and bad state, probability to enter and leave the bad.

        In the bad state a sample is lost with h = `loss_bad`, in the good one never. A run of losses goes
        on with (1 - leave) h, so its mean length is B = 1 / (1 - (1 - leave) h); the share of bad samples
        is loss / h = enter / (enter + leave).
        """
        if self.loss_burst == 0.0 or self.loss == 0.0:
            return self.loss, 0.0, 0.0, 1.0
        leave = 1.0 - (1.0 - 1.0 / self.loss_burst) / self.loss_bad
        bad = self.loss / self.loss_bad
        return 0.0, self.loss_bad, leave * bad / (1.0 - bad), leave

    def fault(self) -> Fault | None:
        """Returns what is wrong with it that no range of a single key shows."""
        for n, (start_s, end_s) in enumerate(self.outages_s):
            if end_s <= start_s:
                return Fault(f"outages_s[{n}]", f"must end after it begins, reads {start_s:g} to {end_s:g}")
        if (reach_ms := self.reach_ms()) > LIMIT_MS:
            problem = f"its delays reach {reach_ms:g} ms; beyond {LIMIT_MS:g} ms they would be cut off"
            return Fault("model", problem)
        if self.loss_burst and self.loss:
            return self._burst_fault()
        return None

    def _burst_fault(self) -> Fault | None:
        if self.loss_burst < 1.0:
            return Fault("loss_burst", f"must be 0 or at least 1 sample, is {self.loss_burst:g}")
        if self.loss >= self.loss_bad:
            return Fault("loss", f"must be below loss_bad = {self.loss_bad:g} in bursts, is {self.loss:g}")
        _, _, enter, leave = self._chain()
        if leave <= 0.0:
            longest = 1.0 / (1.0 - self.loss_bad)
            return Fault("loss_burst", f"must be below {longest:g} with loss_bad = {self.loss_bad:g}")
        if enter > 1.0:
            return Fault("loss_burst", f"{self.loss_burst:g} is too short for a loss of {self.loss:g}")
        return None

    def describe(self) -> str:
        """Returns what it does, in a few words, with the mean and deviation that its model states."""
        words = [self._words()]
        if self.loss:
            bursts = f" in bursts of {self.loss_burst:g}" if self.loss_burst else ""
            words.append(f"loss {100 * self.loss:g} %{bursts}")
        if self.duplicate:
            words.append(f"duplicates {100 * self.duplicate:g} %")
        words += [f"cut {start:g}-{end:g} s" for start, end in self.outages_s]
        if self.order == "in_order":
            words.append("in order")
        if self.playout_ms:
            words.append(f"play-out {self.playout_ms:g} ms")
        return ", ".join(words)

    def _words(self) -> str:
        mean_ms, deviation_ms = self.moments()
        return f"{self.__struct_config__.tag} {mean_ms:.4g} +- {deviation_ms:.3g} ms"


def whole_us(milliseconds: float) -> int:
    """Returns a time in whole microseconds (L4)."""
    return round(milliseconds * 1_000)
