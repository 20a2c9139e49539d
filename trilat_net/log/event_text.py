"""What people read of an event: its text, and for a change a sentence, also in logs of older programs."""

from contextlib import suppress

import msgspec

from ..net.messages import Event
from ..scenario.run_changes import describe_change
from ..scenario.scenario_types import Change


def describe_event(event: Event) -> str:
    """Returns the sentence of an event for people.

    Sites once quoted the JSON of a change in the event's text. That text is replaced by the sentence of the
    change, so that pages, timelines and views of old logs read as those of new ones.

    Args:
        event: as a site or a recorder published it.
    """
    if event.kind == "change" and event.command and event.command in event.text:
        # The command of a stranger may be no change, or lack the keys of one: its text stays.
        with suppress(msgspec.MsgspecError, KeyError, TypeError, ValueError):
            return describe_change(msgspec.json.decode(event.command, type=Change))
    return event.text
