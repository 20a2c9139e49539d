"""Changes made to a running experiment, such as a new delay, and their descriptions.

Early versions of the program logged a change only as JSON. `Change.describe_event` turns that
JSON into the sentence that newer versions log.

Invariant:
    - A change contains the time from which it applies and all settings that result from it, so
      it can be understood without the earlier changes.
"""

import re
from contextlib import suppress

import msgspec

from ..errors import ScenarioError
from ..recorded_change import RecordedChange
from .delay_models import Link, LinkBase
from .refusals import refuse

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
"""Mapping from command to the sentence that describes it."""


class Change(RecordedChange, frozen=True, omit_defaults=True):
    """Change of a network link or of dominance factors during a run, or a command to a site.

    Changes are either planned in the scenario or requested by a user during the run. Exactly
    one of `link`, `dominance` and `site` is non-empty and identifies what is changed. Commands
    (`site`) occur only in logs.
    """

    @property
    def start_ns(self) -> int:
        """Time at which the change takes effect, in ns after the common start of the session.

        Like all simulation times, this is an integer, so that results are identical on every
        machine.
        """
        return round(self.at_s * 1e9)

    @property
    def after(self) -> LinkBase:
        """All settings of the network link after this change, including unchanged ones.

        Only defined for a change of a link.
        """
        return msgspec.convert(self.to, Link)

    @property
    def owner(self) -> str:
        """Name of the site that carries out the change.

        A change of a link is carried out by the receiver of that link. All other changes name
        their site.
        """
        return self.site or self.dominance or self.link.partition("->")[2]

    def check_link(self, path: str) -> None:
        """Raises ScenarioError if a link would have invalid settings after the change.

        A change of anything but a link is accepted.

        Args:
            path: Path of the change in the scenario, for error messages.

        Raises:
            ScenarioError: A setting of the link is not valid, or the change of a link specifies
                a transition time. The error contains the path of the key.
        """
        if not self.link:
            return
        if self.ramp_s:
            raise ScenarioError(
                "a link changes at once; only shares have a ramp", path=f"{path}.ramp_s"
            )
        try:
            link = self.after
        except msgspec.ValidationError as error:
            raise refuse(error, self.to, Link, f"{path}.to") from None
        problem = link.find_problem()
        if problem is not None:
            raise ScenarioError(problem.problem, path=f"{path}.to.{problem.key}")

    def describe(self, ordered_by: str = "") -> str:
        """Returns a human-readable phrase that describes the change.

        An example is "m2 was stopped by the experimenter at 58.2 s", with no full stop.

        Args:
            ordered_by: Noun phrase for the person or program that requested the change. Empty
                if unknown.
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
        """Finds out from a logged sentence who requested a stop.

        Args:
            sentence: A sentence that `describe` returned.

        Returns:
            Noun phrase for the requester. Empty if the sentence does not describe a stop or
            does not name a requester.
        """
        match = re.fullmatch(r"\S+ was stopped by (.+) at [\d.]+ s", sentence)
        return "" if match is None else match[1]

    @classmethod
    def describe_event(cls, kind: str, text: str, command: str) -> str:
        """Returns a human-readable sentence that describes an event of a log.

        Older versions of the program logged a change as JSON instead of a sentence; for such an
        event, the sentence is built from the JSON. Otherwise `text` is returned unchanged.

        Args:
            kind: Machine-readable kind of the event.
            text: Event message, as published by a site or recorder.
            command: The reported change as JSON. Empty for other events.
        """
        if kind == "change" and command and command in text:
            # The command of an untrusted log may lack the keys of a change. The text is then
            # kept.
            with suppress(msgspec.MsgspecError, KeyError, TypeError, ValueError):
                return msgspec.json.decode(command, type=cls).describe()
        return text
