"""The delay models that a link can have, and what they share: loss, duplicates, outages, order,
play-out.

Invariant: each model states its mean and deviation in closed form, and the core draws from just
that distribution. It is found by its file in this folder; nothing else lists them. The kernel's
own models name a `DelayKind`, any other has a function. Loss is stated by its share and the
mean length of its bursts, as measured; the two-state chain that draws it follows from these in
closed form. Keys end in their unit.
"""

from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple, Union

import numpy as np
from msgspec import Meta

from ...core.delay import LINK_MODEL_DTYPE, MAX_DELAY_US, DelayKind, LinkModel
from ...core.plugged import compile_to_address, list_numbers
from ...core.vectors import Points
from ...fields import Frozen, KeyProblem, TomlTable, find_kinds

MAX_DELAY_MS = MAX_DELAY_US / 1000
"""The longest delay."""

MAX_OUTAGES = 1000
"""Most outages of a link: each sample is compared with all of them."""

Milliseconds = Annotated[float, Meta(ge=0.0, le=MAX_DELAY_MS)]
Probability = Annotated[float, Meta(ge=0.0, le=1.0)]
OutageTime = Annotated[float, Meta(ge=0.0, le=1e9)]


class DelayMoments(NamedTuple):
    """Mean and standard deviation of a delay, ms."""

    mean_ms: float
    deviation_ms: float


def ms_to_us(milliseconds: float) -> int:
    """Returns a time in whole microseconds (L4)."""
    return round(milliseconds * 1_000)


_SURE = (DelayKind.CONSTANT, DelayKind.SINE, DelayKind.TRACE, DelayKind.MEASURED)


class LinkBase(Frozen, frozen=True, tag_field="model", omit_defaults=True):
    """A directed link; a subclass states its delay in the methods that begin with an
    underscore.

    Attributes:
        loss: share of samples that are lost in the long run.
        loss_burst: mean number of samples lost in a row; 0: each is lost by itself.
        loss_bad: of a burst's samples, the share that is lost; below 1 bursts have holes.
        duplicate: share of samples that come twice, the copy with a delay of its own.
        outages_s: times between which the link is cut, by the samples' stamps, s.
        order: "newest": a newer sample replaces an older one; "in_order": none overtakes an
            older one.
        playout_ms: every sample is held at least so long: jitter below it becomes a constant
            delay.
    """

    loss: Probability = 0.0
    loss_burst: Annotated[float, Meta(ge=0.0, le=1e6)] = 0.0
    loss_bad: Annotated[float, Meta(gt=0.0, le=1.0)] = 1.0
    duplicate: Probability = 0.0
    outages_s: Annotated[
        tuple[tuple[OutageTime, OutageTime], ...], Meta(max_length=MAX_OUTAGES)
    ] = ()
    order: Literal["newest", "in_order"] = "newest"
    playout_ms: Milliseconds = 0.0

    @classmethod
    def derive_keys(cls, table: TomlTable) -> TomlTable:  # noqa: ARG003 - for the models that derive keys
        """Returns keys that an author may leave out and that follow from the others of a link's
        table.
        """
        return {}

    def _delay(self) -> LinkModel:
        """Returns the delay alone, as the core has it."""
        raise NotImplementedError

    def _moments(self) -> tuple[float, float]:
        """Returns mean and standard deviation of the delay, ms."""
        raise NotImplementedError

    def _reach_ms(self) -> float:
        """Returns the longest delay, ms: three deviations above the mean if there is none."""
        mean_ms, deviation_ms = self._moments()
        return mean_ms + 3.0 * deviation_ms

    def _find_delay_problem(self) -> KeyProblem | None:
        return None

    def _describe_delay(self) -> str:
        mean_ms, deviation_ms = self._moments()
        return f"{self.__struct_config__.tag} {mean_ms:.4g} +- {deviation_ms:.3g} ms"

    def moments(self) -> DelayMoments:
        """Returns the moments of the stated delay, before play-out, order and the cut at
        `MAX_DELAY_MS`.
        """
        return DelayMoments(*self._moments())

    @property
    def random(self) -> bool:
        """True if anything of it is drawn."""
        drawn = self._delay().kind not in _SURE
        return drawn or 0.0 < self.loss < 1.0 or 0.0 < self.duplicate < 1.0

    @property
    def measured(self) -> bool:
        """True if nothing is injected."""
        return self._delay().kind == DelayKind.MEASURED

    @property
    def points(self) -> Points | None:
        """The points of its trace, if it has one."""
        return None

    def to_core_model(self, from_ns: int = 0) -> LinkModel:
        """Returns the core's model of the link, which applies from the stamp `from_ns` on, ns."""
        good, bad, enter, leave = self._loss_chain()
        return self._delay()._replace(
            from_ns=from_ns,
            loss_good=good,
            loss_bad=bad,
            enter=enter,
            leave=leave,
            duplicate=self.duplicate,
            in_order=int(self.order == "in_order"),
            playout_us=ms_to_us(self.playout_ms),
        )

    def _loss_chain(self) -> tuple[float, float, float, float]:
        """Returns the chain of losses: loss in good and bad state, probability to enter and
        leave the bad.

        In the bad state a sample is lost with h = `loss_bad`, in the good one never. A run of
        losses goes on with (1 - leave) h, so its mean length is B = 1 / (1 - (1 - leave) h);
        the share of bad samples is loss / h = enter / (enter + leave).
        """
        if self.loss_burst == 0.0 or self.loss == 0.0:
            return self.loss, 0.0, 0.0, 1.0
        leave = 1.0 - (1.0 - 1.0 / self.loss_burst) / self.loss_bad
        bad = self.loss / self.loss_bad
        return 0.0, self.loss_bad, leave * bad / (1.0 - bad), leave

    def find_problem(self) -> KeyProblem | None:
        """Returns a problem that no range of a single key shows, or None."""
        if problem := self._find_delay_problem():
            return problem
        for n, (start_s, end_s) in enumerate(self.outages_s):
            if end_s <= start_s:
                text = f"must end after it begins, reads {start_s:g} to {end_s:g}"
                return KeyProblem(f"outages_s[{n}]", text)
        if (reach_ms := self._reach_ms()) > MAX_DELAY_MS:
            text = f"its delays reach {reach_ms:g} ms; beyond {MAX_DELAY_MS:g} ms they would be cut off"
            return KeyProblem("model", text)
        if self.loss_burst and self.loss:
            return self._find_burst_problem()
        return None

    def _find_burst_problem(self) -> KeyProblem | None:
        if self.loss_burst < 1.0:
            return KeyProblem(
                "loss_burst", f"must be 0 or at least 1 sample, is {self.loss_burst:g}"
            )
        if self.loss >= self.loss_bad:
            text = f"must be below loss_bad = {self.loss_bad:g} in bursts, is {self.loss:g}"
            return KeyProblem("loss", text)
        _, _, enter, leave = self._loss_chain()
        if leave <= 0.0:
            longest = 1.0 / (1.0 - self.loss_bad)
            return KeyProblem(
                "loss_burst", f"must be below {longest:g} with loss_bad = {self.loss_bad:g}"
            )
        if enter > 1.0:
            return KeyProblem(
                "loss_burst", f"{self.loss_burst:g} is too short for a loss of {self.loss:g}"
            )
        return None

    def describe(self) -> str:
        """Returns the link in a few words, with the mean and deviation that its model states."""
        words = [self._describe_delay()]
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


class OwnDelay(LinkBase, frozen=True, kw_only=True):
    """A delay with a function of its own, a file of this folder; its keys are numbers.

    It states `_moments`, and `_reach_ms` if three deviations above the mean are not the
    longest.
    """

    def draw(self, now: Any) -> None:
        """Writes `now.drawn_us`, the delay of a sample, us, by `now.sample` and `now.stamp_ns`.

        It is compiled. Chance is `core.delay.draw_pair` of `now` alone: a function of the
        link's key and an index (L4).
        """
        raise NotImplementedError

    @property
    def points(self) -> Points:
        """Its numbers, bit for bit, two a row: they stand where a trace has its points."""
        numbers = list_numbers(self)
        return np.resize(numbers, (-(-max(len(numbers), 1) // 2), 2)).view(np.int64)

    def _delay(self) -> LinkModel:
        return LinkModel(kind=DelayKind.OWN, location=1e3 * self._reach_ms())

    def to_core_model(self, from_ns: int = 0) -> LinkModel:
        """Returns the core's model, as of any link, with the address of `draw`, which is
        compiled here.
        """
        return (
            super().to_core_model(from_ns)._replace(call=compile_to_address(self, "draw", LINK_MODEL_DTYPE))
        )


DELAY_MODELS = {
    str(kind.__struct_config__.tag): kind for kind in find_kinds(__name__, LinkBase)
}
"""The models by name."""
if TYPE_CHECKING:
    Link = LinkBase
else:
    Link = Union[tuple(DELAY_MODELS.values())]  # noqa: UP007 - made of what was found
