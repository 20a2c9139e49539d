"""Digest chain of a log: SHA-256 over all messages in order, and over everything that describes
them.

Invariant: the digests depend on the records of the file, not on chunks or their compression;
any change of a message, of its times or number, of metadata, scenario, schemas or channels
changes one of them. They protect against alteration, not against a file that was made anew:
that is the task of a signature.
"""

import hashlib
from collections.abc import Mapping
from enum import StrEnum
from typing import NamedTuple

from ..errors import count_nouns
from .log_layout import SESSION

DIGESTS = "trilat.chain"
"""Metadata at the end of a log: the digests of all that precedes."""
DIGESTS_KEY = "digest_chain"
"""Entry of the session's metadata that announces the chain, by its algorithm."""
ALGORITHM = "sha256"
RECOVERED = "trilat.recovered"
"""Metadata of a recovered log: what it was made from, and what was lost."""
PREVIOUS_DIGEST_KEY = "previous_records"
"""Entry of a part's metadata: the digest of the messages of the part before it."""


class DigestState(StrEnum):
    """Agreement of a file with its digest chain, best first."""

    INTACT = "intact"
    ABSENT = "absent"
    OPEN = "not closed"
    CHANGED = "changed"


class Integrity(NamedTuple):
    """Whether a log is as it was made, and a sentence for it."""

    state: DigestState
    text: str

    @property
    def passed(self) -> bool:
        """False if something was changed, or if records are missing that were there."""
        return self.state is not DigestState.CHANGED


class RunningDigest:
    """The digests of one file while it is written or read.

    Attributes:
        messages: number of messages added.
    """

    def __init__(self) -> None:
        self.messages = 0
        self._records = hashlib.sha256()
        self._about: set[bytes] = set()

    def add_records(self, data: bytes | bytearray | memoryview, messages: int) -> None:
        """Adds messages, as the records that they are in the file, and their number."""
        self._records.update(data)
        self.messages += messages

    def add_entry(self, opcode: int, content: bytes) -> None:
        """Adds a header, metadata, an attachment, a schema or a channel; repeated ones count
        once.
        """
        self._about.add(hashlib.sha256(bytes([opcode]) + content).digest())

    def facts(self) -> dict[str, str]:
        """Returns the metadata that close the chain, digests in hexadecimal."""
        about = hashlib.sha256(b"".join(sorted(self._about))).hexdigest()
        digests = {"records": self._records.hexdigest(), "about": about}
        return {"algorithm": ALGORITHM, "messages": str(self.messages), **digests}

    def judge(
        self, metadata: Mapping[str, Mapping[str, str]], *, finished: bool, damaged: bool
    ) -> Integrity:
        """Returns whether a file agrees with the chain that it states.

        Args:
            metadata: all metadata of the file, by name.
            finished: True if it was finished.
            damaged: True if a part of it cannot be read.
        """
        stated = metadata.get(DIGESTS)
        recovered = metadata.get(RECOVERED, {})
        if recovered.get("chain") == DigestState.CHANGED:
            return Integrity(DigestState.CHANGED, "recovered from a file that had been changed")
        if stated is None:
            if DIGESTS_KEY not in metadata.get(SESSION, {}):
                return Integrity(
                    DigestState.ABSENT, "no digest chain: an older program made it"
                )
            if not finished:
                why = "its digest chain is not closed: the file was not finished"
                return Integrity(DigestState.OPEN, why)
            return Integrity(DigestState.CHANGED, "its digest chain was removed")
        found = self.facts()
        if found == dict(stated):
            since = (
                f", since it was recovered from {recovered['from']}"
                if "from" in recovered
                else ""
            )
            agrees = (
                f"the digest chain agrees over {count_nouns(self.messages, 'message')} "
                f"and all metadata{since}"
            )
            return Integrity(DigestState.INTACT, agrees)
        if (
            damaged
            and stated.get("about") == found["about"]
            and stated.get("messages") != found["messages"]
        ):
            return Integrity(
                DigestState.OPEN, "its digest chain cannot be compared: the file is damaged"
            )
        differ = [name for key, name in _COVERED.items() if stated.get(key) != found[key]]
        return Integrity(
            DigestState.CHANGED, f"changed since it was made: {' and '.join(differ)}"
        )


_COVERED = {
    "algorithm": "its digest chain",
    "messages": "the number of its messages",
    "records": "its messages",
    "about": "its metadata, scenario, schemas or channels",
}
