"""Writes the sentence that describes an event of a session, for example a changed delay.

Since old versions of the program stored the settings of a change in place of a sentence, old
logs would show JSON to people. This module composes the missing sentence, so that old and new
logs read alike.
"""

from contextlib import suppress

import msgspec

from .run_changes import describe_change
from .scenario_types import Change


def describe_event(kind: str, text: str, command: str) -> str:
    """Returns the sentence that describes an event of a log to people.

    Older versions of the program logged the JSON text of a change in place of a sentence. For
    such an event, the sentence is composed here, so that old and new logs read alike. All other
    texts are returned unchanged.

    Args:
        kind: Kind of the event, a short name for programs.
        text: Text of the event, as a site or a recorder published it.
        command: JSON text of the change that the event reports. Empty for other events.
    """
    if kind == "change" and command and command in text:
        # The command of an untrusted log may lack the keys of a change. The text is then kept.
        with suppress(msgspec.MsgspecError, KeyError, TypeError, ValueError):
            return describe_change(msgspec.json.decode(command, type=Change))
    return text
