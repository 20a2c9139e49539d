"""Render an event as a sentence for people, also from the logs of older programs."""

from contextlib import suppress

import msgspec

from .run_changes import describe_change
from .scenario_types import Change


def describe_event(kind: str, text: str, command: str) -> str:
    """Returns the sentence of an event for people.

    Older sites quoted the JSON of a change in the text of its event. The sentence of the change
    replaces such a text, so that pages, timelines and views of old and new logs read alike.

    Args:
        kind: kind of the event.
        text: text of the event, as a site or a recorder published it.
        command: JSON of the change that the event reports; empty for other events.
    """
    if kind == "change" and command and command in text:
        # The command of an untrusted log may lack the keys of a change: the text then stays.
        with suppress(msgspec.MsgspecError, KeyError, TypeError, ValueError):
            return describe_change(msgspec.json.decode(command, type=Change))
    return text
