"""Defines a change of a running experiment, such as a new delay, and describes it to people.

Since old versions of the program stored the settings of a change in place of a sentence, old
logs would show JSON to people. `Change.describe_event` composes the missing sentence, so that
old and new logs read alike.

Invariant:
    - A change contains the time from which it holds, and the complete settings after it, so
      that it can be understood without the earlier changes.
"""

import re
from contextlib import suppress

import msgspec

from ..recorded_change import RecordedChange
from .delay_models import Link, LinkBase

_ORDER_SENTENCES = {
    "stop": "{site} was stopped{by} at {at}",
    "enable": "{site} was enabled{by} at {at}",
    "reset": "the fault of {site} was reset{by} at {at}",
    "held": "the dead-man switch of {site} was held again at {at}",
    "released": "the dead-man switch of {site} was released at {at}",
    "arm_silent": "no measurement came from the arm of {site} at {at}",
    "arm_lost": "the arm of {site} was silent for too long at {at}",
    "arm_back": "measurements came again from the arm of {site} at {at}",
    "overrun": "{site} missed {ticks} {noun} before {at}",
}
"""Sentence that describes each command to people."""


class Change(RecordedChange, frozen=True, omit_defaults=True):
    """Change of a network link or of weights during a run, or a command to one arm's process.

    The weights (dominance factors) state how much an arm follows the others. A scenario plans
    changes, and users request further ones. Exactly one of `link`, `dominance` and `site` is
    not empty, and says what is changed. Commands (`site`) occur only in the log of a run.
    """

    @property
    def start_ns(self) -> int:
        """Time at which the change takes effect, in ns after the common start of the session.

        Times of the simulation are integers, so they are the same on every machine.
        """
        return round(self.at_s * 1e9)

    @property
    def after(self) -> LinkBase:
        """All settings of a network link after this change, including those that stay the same.

        Only a change of a link has this property.
        """
        return msgspec.convert(self.to, Link)

    @property
    def owner(self) -> str:
        """Name of the site, the process of an arm, that must carry out the change.

        The receiver of a network link carries out a change of this link. Any other change names
        its site.
        """
        return self.site or self.dominance or self.link.partition("->")[2]

    def describe(self, ordered_by: str = "") -> str:
        """Describes the change in a phrase for people.

        An example is "m2 was stopped by the experimenter at 58.2 s", without a full stop.

        Args:
            ordered_by: Who requested the change, as a noun phrase. Empty if the requester is
                not known.
        """
        by = f" by {ordered_by}" if ordered_by else ""
        if self.order:
            sentence = _ORDER_SENTENCES[self.order]
            return sentence.format(
                site=self.site,
                by=by,
                at=f"{self.at_s:.1f} s",
                ticks=self.ticks,
                noun="tick" if self.ticks == 1 else "ticks",
            )
        at = f"{round(self.at_s, 3):g} s"
        if self.link:
            link = self.after.describe()
            return f"the link {self.link} was set to {link}{by}, from {at} on"
        shares = ", ".join(f"{peer} {share:g}" for peer, share in self.to.items() if share)
        ramp = f" within {self.ramp_s:g} s" if self.ramp_s else ""
        target = shares or "nobody"
        return f"the shares of {self.dominance} were set to {target}{ramp}{by}, from {at} on"

    @staticmethod
    def find_requester(sentence: str) -> str:
        """Returns who requested a stop, from the sentence about it in a log, for a report.

        Args:
            sentence: Sentence that `describe` returned.

        Returns:
            The requester as a noun phrase. Empty if the sentence is not about a stop, or does
            not say who requested it.
        """
        match = re.fullmatch(r"\S+ was stopped by (.+) at [\d.]+ s", sentence)
        return "" if match is None else match[1]

    @classmethod
    def describe_event(cls, kind: str, text: str, command: str) -> str:
        """Returns the sentence that describes an event of a log to people.

        Older versions of the program logged the JSON text of a change in place of a sentence.
        For such an event, the sentence is composed here, so that old and new logs read alike.
        All other texts are returned unchanged.

        Args:
            kind: Kind of the event, a short name for programs.
            text: Text of the event, as a site or a recorder published it.
            command: JSON text of the change that the event reports. Empty for other events.
        """
        if kind == "change" and command and command in text:
            # The command of an untrusted log may lack the keys of a change. The text is then
            # kept.
            with suppress(msgspec.MsgspecError, KeyError, TypeError, ValueError):
                return msgspec.json.decode(command, type=cls).describe()
        return text
