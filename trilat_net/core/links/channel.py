"""Computes when a simulated network delivers each message, or whether the message is lost.

In each control period, an arm sends a sample over a link to each other arm. The model of a link
may delay, lose or duplicate samples, for example with losses in bursts. `schedule_deliveries`
computes the deliveries of all samples up to a given one.

Invariant (law L4 of docs/develop/design.md):

- What happens to sample m depends only on the key of the link (the seed of its random numbers),
  on m, and on the network model in force when m was sent.
- Models with memory (loss bursts, correlated delays, sample ordering) advance from sample to
  sample by index, regardless of the order in which samples arrive.
"""

from ..step.jit import leaf
from ..step.row_fields import LinkRow
from ..step.ticks import tick_ns
from ..step.vectors import IntArray, Points, Row, RowArray
from .delay import (
    COPY,
    DUPLICATE,
    LOSS,
    DelayKind,
    clamp_delay_us,
    draw_delay_us,
    find_delay_us,
)
from .philox import uniforms

LOST = -1
"""Used as the due time of a sample that the network loses."""

_AR1 = int(DelayKind.AR1)


@leaf
def _in_outage(stamp_ns: int, link: LinkRow, points: Points) -> bool:
    """Returns True if a message was sent during an outage, in which the link delivers nothing.

    Outages are time intervals listed in the scenario. Each includes its start and excludes its
    end.

    Args:
        stamp_ns: Time at which the sample was sent, ns since the epoch (the common start of the
            session).
        link: State of the link, including which rows of `points` hold its outages.
        points: Table of points. The row of an outage contains its start and its end, ns.
    """
    for n in range(link.outage_first, link.outage_first + link.outage_count):
        if points[n, 0] <= stamp_ns < points[n, 1]:
            return True
    return False


@leaf
def loses_samples(model: Row) -> bool:
    """Returns True if the model of a network link drops messages at random.

    Otherwise, no random number needs to be drawn for losses.
    """
    return bool(model.loss_good != 0.0 or model.enter != 0.0)


@leaf
def advance_losses(u: float, v: float, fresh: bool, link: LinkRow, model: Row) -> bool:
    """Decides at random whether the next sample is lost, on a link with bursty losses.

    The link is in a good or a bad state, each with its own loss probability (Gilbert-Elliott
    model). From one sample to the next, a good link turns bad with probability `enter`, and a
    bad link turns good with probability `leave`. For the first sample, the state is drawn from
    the stationary distribution, in which the bad state has probability enter / (enter + leave).

    Args:
        u: Uniform random number that determines the state of the link.
        v: Uniform random number that determines whether the sample is lost.
        fresh: True for the first sample to which the model applies.
        link: State of the link; updated in place.
        model: Model in force, for which `loses_samples` is True.
    """
    if fresh:
        # The test is a product, not a quotient, because enter + leave may be zero.
        link.bad = u * (model.enter + model.leave) < model.enter
    elif link.bad:
        link.bad = u >= model.leave
    else:
        link.bad = u < model.enter
    probability: float = model.loss_bad if link.bad else model.loss_good
    return v < probability


@leaf
def _draw_loss(sample: int, fresh: bool, link: LinkRow, model: Row) -> bool:
    """Decides at random whether the simulated network loses a message.

    Depending on the model, losses are independent or come in bursts. The same seed, link and
    message number always lead to the same decision, so a run can be repeated.

    Args:
        sample: Index of the sample.
        fresh: True for the first sample to which the model applies.
        link: State of the link; updated in place.
        model: Model in force.
    """
    if not loses_samples(model):
        return False
    u, v = uniforms(link.key, sample, LOSS, 0)
    return advance_losses(u, v, fresh, link, model)


@leaf
def delay_sample(stamp_ns: int, delay_us: int, link: LinkRow, model: Row) -> int:
    """Returns when a message that is not lost is delivered, ns since the start of the session.

    The delivery time is the sending time plus the delay. It may be postponed by a minimum delay
    (play-out buffer), and by an older message if messages must arrive in order.

    Args:
        stamp_ns: Time at which the sample was sent, ns since the start of the session.
        delay_us: Delay of the sample, us. If the sample was duplicated, the smaller of the two
            delays.
        link: State of the link. `due_before`, the latest delivery time so far, is updated.
        model: Delay and loss model in force.
    """
    # The receiver's play-out buffer holds each sample for at least `playout_us`.
    due_ns: int = stamp_ns + max(delay_us, model.playout_us) * 1000
    if model.in_order == 1:
        # A sample waits for all older samples.
        due_ns = max(due_ns, link.due_before)
    link.due_before = max(due_ns, link.due_before)
    return due_ns


@leaf
def find_due_ns(
    sample: int,
    stamp_ns: int,
    lost: bool,
    delay_us: int,
    link: LinkRow,
    model: Row,
    points: Points,
) -> int:
    """Computes when a network link delivers a message whose loss and delay have been drawn.

    Outages, duplicates and message ordering are taken into account here. This function must be
    called exactly once per sample, in order of increasing index.

    Args:
        sample: Index of the sample.
        stamp_ns: Time at which the sample was sent, ns since the start of the session.
        lost: True if the random loss model drops the sample.
        delay_us: Delay of the sample, us, or LOST if a trace marks the sample as lost.
        link: State of the link, including the seed `key` of its random numbers; updated in
            place. `copies` counts the duplicated samples, and `due_before` is the latest due
            time so far, ns.
        model: Delay and loss model in force, a row of LINK_MODEL_DTYPE.
        points: Delay traces and outages of all links of the receiver.

    Returns:
        The due time, at which the link delivers the sample, ns since the start of the session.
        LOST if the link loses the sample.
    """
    lost_by_trace = delay_us < 0
    if lost or lost_by_trace or _in_outage(stamp_ns, link, points):
        return LOST

    if model.duplicate > 0.0:
        u, _ = uniforms(link.key, sample, DUPLICATE, 0)
        is_duplicated = u < model.duplicate
        if is_duplicated:
            link.copies += 1
            # The receiver uses whichever of the two arrives first. The types before AR1 are
            # distributions, from which the copy draws its own delay. With all other types, the
            # copy has the same delay as the sample and makes no difference.
            draws_delay_of_copy = model.kind < _AR1
            if draws_delay_of_copy:
                copy_us = clamp_delay_us(draw_delay_us(link.key, sample, COPY, model))
                delay_us = min(delay_us, copy_us)

    return delay_sample(stamp_ns, delay_us, link, model)


@leaf
def _due_ns(
    sample: int, stamp_ns: int, fresh: bool, link: LinkRow, model: Row, points: Points
) -> int:
    """Computes when a network link delivers a message, or whether the message is lost.

    This function must be called exactly once per sample, in order, because loss bursts and
    correlated delays depend on the previous message. For the same reason, loss and delay are
    drawn even for a message that is lost for another reason.

    Args:
        sample: Index of the sample, which is the tick in which it was sent.
        stamp_ns: Time at which the sample was sent, ns since the epoch (the common start of the
            session).
        fresh: True for the first sample to which the model applies, which initialises the
            model's state.
        link: State of the link; updated in place, see `find_due_ns`.
        model: Delay and loss model in force, a row of LINK_MODEL_DTYPE.
        points: Delay traces and outages of all links of the receiver.

    Returns:
        The due time, see `find_due_ns`.
    """
    lost = _draw_loss(sample, fresh, link, model)
    delay_us = find_delay_us(
        sample=sample, stamp_ns=stamp_ns, fresh=fresh, link=link, model=model, points=points
    )
    return find_due_ns(
        sample=sample,
        stamp_ns=stamp_ns,
        lost=lost,
        delay_us=delay_us,
        link=link,
        model=model,
        points=points,
    )


@leaf
def select_model(sample: int, stamp_ns: int, link: LinkRow, models: RowArray) -> bool:
    """Selects the delay and loss model for a message according to when it was sent.

    A scenario may change the model at planned times, for example to a slower network after 5 s.
    Messages sent before that time keep the earlier model.

    Args:
        sample: Index of the sample.
        stamp_ns: Time at which the sample was sent, ns since the start of the session.
        link: State of the link. Its field `model`, the index of the model, is updated.
        models: Models of the link, in the order in which they take effect.

    Returns:
        True if the sample is the first one to which the selected model applies.
    """
    fresh = sample == 0
    # Advance while a later model took effect before the sample was sent.
    while link.model + 1 < link.models and models[link.model + 1].from_ns <= stamp_ns:
        link.model += 1
        fresh = True
    return fresh


@leaf
def schedule_deliveries(
    sample: int, link: LinkRow, models: RowArray, dues: IntArray, points: Points
) -> None:
    """Computes when a simulated network link delivers its messages, up to a given message.

    The delay and loss model may change at planned times. Each message follows the model that
    was in force when it was sent.

    Args:
        sample: Index of the last sample to compute. Samples already computed are skipped.
        link: State of the link; updated in place.
        models: Delay and loss models of the link, in the order in which they take effect.
        dues: Output ring buffer for the delivery times in ns since the start of the session, or
            LOST. Sample m is stored at index m modulo its length.
        points: Delay traces and outages of all links of the receiver.
    """
    kept = dues.shape[0]
    while link.scheduled < sample:
        m = link.scheduled + 1
        stamp_ns = tick_ns(m, link.rate_hz)
        fresh = select_model(m, stamp_ns, link, models)
        dues[m % kept] = _due_ns(
            sample=m,
            stamp_ns=stamp_ns,
            fresh=fresh,
            link=link,
            model=models[link.model],
            points=points,
        )
        link.scheduled = m
