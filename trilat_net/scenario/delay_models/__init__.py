"""The delay models of links, and the keys that all links share, such as loss and order.

A model is one class, found by its file in this folder; nothing else lists the models. The
models that the kernel computes name a `DelayKind`; any other model has a function of its own.

Invariant:
    - Each model states the mean and the deviation of its delay in closed form, and the core
      draws from exactly that distribution.
    - Loss is stated by its share and the mean length of its bursts, as it is measured. The
      two-state chain that draws the losses follows from these in closed form.
    - Keys end in their unit.
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
"""Largest number of outages of a link: each sample is compared with all of them."""

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


_DETERMINISTIC_KINDS = (
    DelayKind.CONSTANT,
    DelayKind.SINE,
    DelayKind.TRACE,
    DelayKind.MEASURED,
)


class _LossChain(NamedTuple):
    """The two-state Markov chain of losses (Gilbert's model).

    Attributes:
        loss_good: probability of a loss in the good state.
        loss_bad: probability of a loss in the bad state.
        enter: probability to enter the bad state, per sample.
        leave: probability to leave the bad state, per sample.
    """

    loss_good: float
    loss_bad: float
    enter: float
    leave: float


class LinkBase(Frozen, frozen=True, tag_field="model", omit_defaults=True):
    """A directed link.

    A subclass states its delay in the methods that begin with an underscore.

    Attributes:
        loss: share of samples that are lost in the long run.
        loss_burst: mean number of samples that are lost in a row; 0: losses are independent.
        loss_bad: share of the samples of a burst that are lost; below 1 bursts have holes.
        duplicate: share of samples that arrive twice; the copy has a delay of its own.
        outages_s: intervals of stamps in which all samples are lost, s.
        order: "newest": a newer sample replaces an older one; "in_order": a sample does not
            overtake an older one.
        playout_ms: shortest time for which every sample is held, ms; jitter below it becomes a
            constant delay.
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
    def derive_keys(cls, table: TomlTable) -> TomlTable:  # noqa: ARG003 - subclasses use it
        """Returns the keys that an author may leave out because they follow from the others.

        Args:
            table: the table of the link.
        """
        return {}

    def _delay(self) -> LinkModel:
        """Returns the core's model of the delay alone, without loss."""
        raise NotImplementedError

    def _moments(self) -> tuple[float, float]:
        """Returns the mean and the standard deviation of the delay, ms."""
        raise NotImplementedError

    def _reach_ms(self) -> float:
        """Returns the longest delay, ms; three deviations above the mean if it is unbounded."""
        mean_ms, deviation_ms = self._moments()
        return mean_ms + 3.0 * deviation_ms

    def _find_delay_problem(self) -> KeyProblem | None:
        """Returns a problem of the keys of the delay that no range of a single key shows."""
        return None

    def _describe_delay(self) -> str:
        mean_ms, deviation_ms = self._moments()
        return f"{self.__struct_config__.tag} {mean_ms:.4g} +- {deviation_ms:.3g} ms"

    def moments(self) -> DelayMoments:
        """Returns the moments of the stated delay.

        Play-out, order and the cut at `MAX_DELAY_MS` do not enter them.
        """
        return DelayMoments(*self._moments())

    @property
    def random(self) -> bool:
        """True if the delay, the loss or the duplicates are drawn."""
        is_delay_drawn = self._delay().kind not in _DETERMINISTIC_KINDS
        return is_delay_drawn or 0.0 < self.loss < 1.0 or 0.0 < self.duplicate < 1.0

    @property
    def measured(self) -> bool:
        """True if the link injects no delay: the real network alone decides."""
        return self._delay().kind == DelayKind.MEASURED

    @property
    def points(self) -> Points | None:
        """The points of the link's trace; None without a trace."""
        return None

    def to_core_model(self, from_ns: int = 0) -> LinkModel:
        """Returns the core's model of the link, for stamps from `from_ns` on, ns."""
        chain = self._loss_chain()
        return self._delay()._replace(
            from_ns=from_ns,
            loss_good=chain.loss_good,
            loss_bad=chain.loss_bad,
            enter=chain.enter,
            leave=chain.leave,
            duplicate=self.duplicate,
            in_order=int(self.order == "in_order"),
            playout_us=ms_to_us(self.playout_ms),
        )

    def _loss_chain(self) -> _LossChain:
        """Returns the chain of losses.

        In the bad state a sample is lost with the probability h = `loss_bad`, in the good state
        never. A run of losses continues with the probability (1 - leave) h, so its mean length
        is B = 1 / (1 - (1 - leave) h), and leave = 1 - (1 - 1 / B) / h. The share of samples in
        the bad state is loss / h = enter / (enter + leave).
        """
        if self.loss_burst == 0.0 or self.loss == 0.0:
            return _LossChain(loss_good=self.loss, loss_bad=0.0, enter=0.0, leave=1.0)
        leave = 1.0 - (1.0 - 1.0 / self.loss_burst) / self.loss_bad
        bad_share = self.loss / self.loss_bad
        enter = leave * bad_share / (1.0 - bad_share)
        return _LossChain(loss_good=0.0, loss_bad=self.loss_bad, enter=enter, leave=leave)

    def find_problem(self) -> KeyProblem | None:
        """Returns a problem that no range of a single key shows, or None."""
        delay_problem = self._find_delay_problem()
        if delay_problem is not None:
            return delay_problem
        for n, (start_s, end_s) in enumerate(self.outages_s):
            if end_s <= start_s:
                problem = f"must end after it begins, reads {start_s:g} to {end_s:g}"
                return KeyProblem(f"outages_s[{n}]", problem)
        reach_ms = self._reach_ms()
        if reach_ms > MAX_DELAY_MS:
            return KeyProblem(
                "model",
                f"its delays reach {reach_ms:g} ms; beyond {MAX_DELAY_MS:g} ms they would be "
                "cut off",
            )
        if self.loss_burst and self.loss:
            return self._find_burst_problem()
        return None

    def _find_burst_problem(self) -> KeyProblem | None:
        """Returns a problem of a link that loses samples in bursts, or None."""
        if self.loss_burst < 1.0:
            return KeyProblem(
                "loss_burst", f"must be 0 or at least 1 sample, is {self.loss_burst:g}"
            )
        if self.loss >= self.loss_bad:
            return KeyProblem(
                "loss",
                f"must be below loss_bad = {self.loss_bad:g} in bursts, is {self.loss:g}",
            )
        chain = self._loss_chain()
        if chain.leave <= 0.0:
            longest = 1.0 / (1.0 - self.loss_bad)
            return KeyProblem(
                "loss_burst", f"must be below {longest:g} with loss_bad = {self.loss_bad:g}"
            )
        if chain.enter > 1.0:
            return KeyProblem(
                "loss_burst", f"{self.loss_burst:g} is too short for a loss of {self.loss:g}"
            )
        return None

    def describe(self) -> str:
        """Returns a short text on the link, with the mean and deviation of its delay."""
        facts = [self._describe_delay()]
        if self.loss:
            bursts = f" in bursts of {self.loss_burst:g}" if self.loss_burst else ""
            facts.append(f"loss {100 * self.loss:g} %{bursts}")
        if self.duplicate:
            facts.append(f"duplicates {100 * self.duplicate:g} %")
        facts += [f"cut {start:g}-{end:g} s" for start, end in self.outages_s]
        if self.order == "in_order":
            facts.append("in order")
        if self.playout_ms:
            facts.append(f"play-out {self.playout_ms:g} ms")
        return ", ".join(facts)


class OwnDelay(LinkBase, frozen=True, kw_only=True):
    """A delay that is a function in a file of this folder; its keys are numbers.

    A subclass states `_moments`, and `_reach_ms` unless its longest delay is three deviations
    above the mean.
    """

    def draw(self, now: Any) -> None:
        """Writes the delay of a sample to `now.drawn_us`, us, from its number and stamp.

        The function is compiled. It sees `now.sample` and `now.stamp_ns`. Random numbers come
        from `core.delay.draw_pair` of `now` alone: a function of the link's key and an index
        (L4).
        """
        raise NotImplementedError

    @property
    def points(self) -> Points:
        """The numbers of the keys, bit for bit, two per row, where a trace has its points."""
        numbers = list_numbers(self)
        rows = -(-max(len(numbers), 1) // 2)
        return np.resize(numbers, (rows, 2)).view(np.int64)

    def _delay(self) -> LinkModel:
        return LinkModel(kind=DelayKind.CUSTOM, location=1e3 * self._reach_ms())

    def to_core_model(self, from_ns: int = 0) -> LinkModel:
        """Returns the core's model of the link, with the address of the compiled `draw`."""
        model = super().to_core_model(from_ns)
        return model._replace(call=compile_to_address(self, "draw", LINK_MODEL_DTYPE))


DELAY_MODELS = {
    str(kind.__struct_config__.tag): kind for kind in find_kinds(__name__, LinkBase)
}
"""The models by name."""
if TYPE_CHECKING:
    Link = LinkBase
else:
    # Built at run time from the classes in this folder.
    Link = Union[tuple(DELAY_MODELS.values())]  # noqa: UP007
