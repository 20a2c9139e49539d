"""What people read of an event: its text, and for a change a sentence, also in logs of older
programs.
"""

from contextlib import suppress

import msgspec

from .run_changes import describe_change
from .scenario_types import Change


def describe_event(kind: str, text: str, command: str) -> str:
    """Returns the sentence of an event for people.

    Sites once quoted the JSON of a change in the event's text. That text is replaced by the
    sentence of the change, so that pages, timelines and views of old logs read as those of new
    ones.

    Args:
        kind: kind of the event.
        text: text of the event, as a site or a recorder published it.
        command: JSON of the change that the event reports; empty for other events.
    """
    if kind == "change" and command and command in text:
        # The command of a stranger may be no change, or lack the keys of one: its text stays.
        with suppress(msgspec.MsgspecError, KeyError, TypeError, ValueError):
            return describe_change(msgspec.json.decode(command, type=Change))
    return text
