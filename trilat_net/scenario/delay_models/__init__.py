"""Common base of all delay models of network links, including loss, duplication and outages.

A delay model computes how long each message takes, for example "uniform between 10 ms and 20
ms". Each model is a class in its own file in this folder; adding a file adds a model.

A model that is built into the simulation kernel returns one of its `LinkModel`s. Other models
define a function of their own, which is compiled.

Invariant:
    - Each model states the mean and the standard deviation of its delay in closed form. The
      kernel draws from exactly the distribution that has these moments.
    - Sample loss is described by two measurable quantities: the fraction of lost samples and
      the mean burst length. The parameters of the two-state Markov chain that draws the losses
      are derived from them in closed form.
    - The name of a key ends in its unit.
"""

import math
from fractions import Fraction
from functools import lru_cache
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple, Union

from msgspec import Meta

from ...core import (
    MAX_DELAY_US,
    IntArray,
    LinkModel,
    LinkSchedule,
    LinkSetup,
    Points,
)
from ...fields import Frozen, KeyProblem, TomlTable

MAX_DELAY_MS = MAX_DELAY_US / 1000
"""Longest delay of a link, in ms."""

MAX_OUTAGES = 1000
"""Largest number of outages of a link; each sample is compared with all of them."""

Milliseconds = Annotated[float, Meta(ge=0.0, le=MAX_DELAY_MS)]
Probability = Annotated[float, Meta(ge=0.0, le=1.0)]
OutageTime = Annotated[float, Meta(ge=0.0, le=1e9)]


class _DelayMoments(NamedTuple):
    """Mean and standard deviation of the random delay of a link, in ms."""

    mean_ms: float
    deviation_ms: float


def ms_to_us(milliseconds: float) -> int:
    """Converts a time in milliseconds to microseconds, rounded to an integer.

    Integer delays make the compiled simulation reproduce the same bits on every machine.
    """
    return round(milliseconds * 1_000)


class _LossChain(NamedTuple):
    """Markov chain that determines which messages a simulated network loses in bursts.

    The network is in either a good or a bad state (Gilbert's model). The state can change from
    one message to the next, and each state has its own loss probability.

    Attributes:
        loss_good: Probability that a sample is lost in the good state.
        loss_bad: Probability that a sample is lost in the bad state.
        enter: Probability per sample of a transition from the good to the bad state.
        leave: Probability per sample of a transition from the bad to the good state.
    """

    loss_good: float
    loss_bad: float
    enter: float
    leave: float


class LinkBase(Frozen, frozen=True, tag_field="model", omit_defaults=True):
    """Settings of a network link between two sites, apart from its delay.

    They specify how many samples are lost, duplicated or reordered. Subclasses define the delay
    by overriding the methods whose names begin with an underscore.

    Attributes:
        loss: Long-run fraction of samples that are lost.
        loss_burst: Mean number of consecutive lost samples. If 0, losses are independent.
        loss_bad: Fraction of samples lost within a burst. If below 1, bursts have gaps.
        duplicate: Fraction of samples that arrive twice. The delay of the copy is drawn
            separately.
        outages_s: Intervals of send time, in s, in which every sample is lost.
        order: "newest" to discard a sample that arrives after a newer one, or "in_order" to
            prevent a sample from overtaking an earlier one.
        playout_ms: Play-out delay, in ms. Every sample is held until this time has passed since
            it was sent. All shorter delays therefore become equal to the play-out delay.
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
        """Returns defaults for keys that can be computed from other keys.

        A delay model that has such keys overrides this method. Returns an empty table by
        default.

        Args:
            table: The link table as written by its author.
        """
        return {}

    @property
    def constant_delay_ms(self) -> float | None:
        """Delay of every message, in ms, or None if the delay varies."""
        return None

    @property
    def repetition_s(self) -> Fraction | None:
        """Period after which the delay repeats, in s, or None if the delay has no period.

        The period is a `Fraction`, so that common multiples of periods can be computed exactly.
        """
        return None

    @property
    def has_ending_trace(self) -> bool:
        """True if the link plays a delay trace that does not restart at its end.

        The delay after the end is not a repetition, so the link has no period.
        """
        return False

    def _delay(self) -> LinkModel:
        """Returns the delay of the link in the format read by the compiled simulation.

        Excludes losses, which are added by `to_core_model`.
        """
        raise NotImplementedError

    def _moments(self) -> tuple[float, float]:
        """Returns the mean and the standard deviation of the delay, in ms."""
        raise NotImplementedError

    def _reach_ms(self) -> float:
        """Returns the longest delay of a message on the link, in ms.

        An unbounded distribution is cut off three standard deviations above its mean.
        """
        mean_ms, deviation_ms = self._moments()
        return mean_ms + 3.0 * deviation_ms

    def _find_delay_problem(self) -> KeyProblem | None:
        """Returns a contradiction between keys of the delay, or None."""
        return None

    def _describe_delay(self) -> str:
        """Returns a short description of the delay, with its mean and standard deviation."""
        mean_ms, deviation_ms = self._moments()
        return f"{self.__struct_config__.tag} {mean_ms:.4g} +- {deviation_ms:.3g} ms"

    def moments(self) -> _DelayMoments:
        """Returns the mean and standard deviation of the delay distribution of the link.

        The delay in a run can differ, since three effects are not included: the play-out delay
        `playout_ms`, in-order delivery (`order`), and the upper limit on all delays,
        `MAX_DELAY_MS`.
        """
        return _DelayMoments(*self._moments())

    @property
    def random(self) -> bool:
        """True if delays, losses or duplicates of the link are random.

        The run then depends on the seed. Losses are random only if the loss fraction is between
        0 and 1, exclusive.
        """
        return self._delay().is_random or 0.0 < self.loss < 1.0 or 0.0 < self.duplicate < 1.0

    @property
    def measured(self) -> bool:
        """True if the link adds no artificial delay to that of the real network.

        Such a link cannot be simulated without the log of a live session.
        """
        return self._delay().is_measured

    @property
    def points(self) -> Points | None:
        """Recorded delays over time, for a link that replays a delay trace; otherwise None."""
        return None

    def to_core_model(self, from_ns: int = 0) -> LinkModel:
        """Converts the link to the parameters used to simulate delays and losses.

        Args:
            from_ns: Send time of the first message to which these settings apply, in ns after
                the common start time of all sites.
        """
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

    def find_effective_delay(self, receiver_hz: int) -> float:
        """Returns the delay with which the receiver of the link uses samples, in s.

        A constant delay is rounded up to a multiple of the receiver's control period. Returns
        NaN if the delay varies or the link loses samples.

        Args:
            receiver_hz: Tick rate of the receiver, in Hz.
        """
        if self.constant_delay_ms is None or self.loss:
            return math.nan
        model = self.to_core_model()
        delay_us = max(round(model.location), model.playout_us)
        # rounded up, because without a delay a sample is used from the next tick on
        ticks = max(1, -(-delay_us * receiver_hz // 1_000_000))
        return ticks / receiver_hz

    def _loss_chain(self) -> _LossChain:
        """Computes the Markov chain that produces the configured losses.

        A sample is lost with probability h = `loss_bad` in the bad state, and never in the good
        state. A run of lost samples continues with probability (1 - leave) h. Its mean length
        is therefore

            B = 1 / (1 - (1 - leave) h), so that leave = 1 - (1 - 1 / B) / h.

        The fraction of samples in the bad state is loss / h = enter / (enter + leave), which
        determines `enter`.
        """
        if self.loss_burst == 0.0 or self.loss == 0.0:
            return _LossChain(loss_good=self.loss, loss_bad=0.0, enter=0.0, leave=1.0)
        leave = 1.0 - (1.0 - 1.0 / self.loss_burst) / self.loss_bad
        bad_fraction = self.loss / self.loss_bad
        enter = leave * bad_fraction / (1.0 - bad_fraction)
        return _LossChain(loss_good=0.0, loss_bad=self.loss_bad, enter=enter, leave=leave)

    def find_problem(self) -> KeyProblem | None:
        """Checks the keys of the link for contradictions between them.

        For example, an outage must not end before it starts. Each value has already been
        checked against its type.

        Returns:
            The key and the reason, or None if the keys are consistent.
        """
        delay_problem = self._find_delay_problem()
        if delay_problem is not None:
            return delay_problem

        for n, (start_s, end_s) in enumerate(self.outages_s):
            if end_s <= start_s:
                problem = f"must end after its start, but is {start_s:g} to {end_s:g}"
                return KeyProblem(f"outages_s[{n}]", problem)
        reach_ms = self._reach_ms()
        if reach_ms > MAX_DELAY_MS:
            return KeyProblem(
                "model",
                f"the delays reach {reach_ms:g} ms, but delays above {MAX_DELAY_MS:g} ms would "
                "be cut off",
            )
        if self.loss_burst and self.loss:
            return self._find_burst_problem()
        return None

    def _find_burst_problem(self) -> KeyProblem | None:
        """Returns a problem if the configured burst losses are impossible, or None.

        They are impossible if no Markov chain that alternates between good and bad periods can
        produce them.
        """
        if self.loss_burst < 1.0:
            return KeyProblem(
                "loss_burst", f"must be 0 or at least 1 sample, but is {self.loss_burst:g}"
            )
        if self.loss >= self.loss_bad:
            return KeyProblem(
                "loss",
                f"must be below loss_bad = {self.loss_bad:g} in bursts, but is {self.loss:g}",
            )

        chain = self._loss_chain()
        if chain.leave <= 0.0:
            # leave > 0 requires 1 / B > 1 - h, see `_loss_chain`.
            longest = 1.0 / (1.0 - self.loss_bad)
            return KeyProblem(
                "loss_burst", f"must be below {longest:g} with loss_bad = {self.loss_bad:g}"
            )
        if chain.enter > 1.0:
            return KeyProblem(
                "loss_burst", f"{self.loss_burst:g} is too short for a loss of {self.loss:g}"
            )
        return None

    @lru_cache(maxsize=256)  # noqa: B019 - a link is a small value that never changes
    def draw_used_samples(
        self, key: int, receiver_hz: int, sender_hz: int, duration_s: float
    ) -> IntArray:
        """Computes which sample of the peer is in use in each tick of the receiver.

        Accounts for delays and losses of this link only; other links of the receiver are
        ignored.

        Args:
            key: Key of the link's random draws.
            receiver_hz: Tick rate of the receiving site, in Hz.
            sender_hz: Tick rate of the peer, in Hz.
            duration_s: Duration of the run, in s.

        Returns:
            Index of the sample in use at every tick, shape (ticks,); -1 before the first
            sample.
        """
        setup = LinkSetup(
            peer="peer",
            alpha=1.0,
            rate_hz=sender_hz,
            q0=(),
            key=key,
            models=(self.to_core_model(),),
            traces=(self.points,),
        )
        used = LinkSchedule(setup).draw_run(receiver_hz, duration_s)
        used.flags.writeable = False
        return used

    def describe(self) -> str:
        """Returns a short human-readable description of the link.

        Contains the kind of delay with its mean and standard deviation, and any other
        properties of the link, such as losses.
        """
        parts = [self._describe_delay()]
        if self.loss:
            bursts = f" in bursts of {self.loss_burst:g}" if self.loss_burst else ""
            parts.append(f"loss {100 * self.loss:g} %{bursts}")
        if self.duplicate:
            parts.append(f"duplicates {100 * self.duplicate:g} %")
        for start_s, end_s in self.outages_s:
            parts.append(f"cut {start_s:g}-{end_s:g} s")
        if self.order == "in_order":
            parts.append("in order")
        if self.playout_ms:
            parts.append(f"play-out {self.playout_ms:g} ms")
        return ", ".join(parts)


class OwnDelay(LinkBase, frozen=True, kw_only=True):
    """Base class for a delay model that computes the delay of one message in Python.

    To add a model, add a file with a subclass to this folder. The attributes of the class are
    the numeric settings of the model. The subclass defines

    - `draw`, which computes the delay of one message,
    - `_moments`, which returns the mean and standard deviation of the delay in ms,
    - optionally `_reach_ms`, which returns the longest delay in ms. By default, this is three
      standard deviations above the mean.
    """

    def draw(self, now: Any) -> None:
        """Computes the delay of one message and stores it in `now.drawn_us`, in microseconds.

        This method is compiled. It may use the sample number `now.sample` and the send time
        `now.stamp_ns`. Draw random numbers with `trilat_net.core.draw_pair` only: its results
        depend only on the key of the link and an index, so a repeated run draws the same
        numbers (law L4 of docs/develop/design.md).

        Args:
            now: The sample, and the field that receives the result.
        """
        raise NotImplementedError

    @property
    def points(self) -> Points:
        """Numeric settings of the delay model, packed for the compiled simulation."""
        return LinkModel.pack_settings(self)

    def _delay(self) -> LinkModel:
        """Returns the delay in the format read by the compiled simulation.

        The parameter `location` is the longest delay, in microseconds.
        """
        return LinkModel.custom(1e3 * self._reach_ms())

    def to_core_model(self, from_ns: int = 0) -> LinkModel:
        """Converts the link to the record read by the compiled simulation.

        The record contains the address of the compiled `draw` method.

        Args:
            from_ns: Send time of the first message to which these settings apply, in ns after
                the common start time of all sites.
        """
        return super().to_core_model(from_ns).draw_with(self)


DELAY_MODELS = {str(kind.__struct_config__.tag): kind for kind in LinkBase.find_kinds(__name__)}
"""Mapping from name to class of all delay models."""
if TYPE_CHECKING:
    Link = LinkBase
else:
    # Built at run time from the classes in this folder.
    Link = Union[tuple(DELAY_MODELS.values())]  # noqa: UP007
