"""Digest chain of a log, which reveals changes of the log.

The chain has two SHA-256 digests: of all messages in order, and of everything that describes
them. It protects against alterations, but not against a file that was written anew; signatures
protect against that.

Invariant:
    - The digests depend on the records of the file, and not on chunks or their compression.
    - Any change of a message, of its times or number, of metadata, scenario, schema or channels
      changes one of the digests.
"""

import hashlib
from collections.abc import Mapping
from enum import StrEnum
from typing import NamedTuple

from ..errors import count_nouns
from .log_layout import SESSION

DIGESTS = "trilat.chain"
"""Name of the metadata at the end of a log that contain the digests."""
DIGESTS_KEY = "digest_chain"
"""Entry of the session's metadata that announces the chain and names its algorithm."""
ALGORITHM = "sha256"
RECOVERED = "trilat.recovered"
"""Name of the metadata of a recovered log that describe its source and its losses."""
PREVIOUS_DIGEST_KEY = "previous_records"
"""Entry of a part's metadata: the digest of the messages in the previous part."""


class DigestState(StrEnum):
    """Agreement of a file with its digest chain, from best to worst."""

    INTACT = "intact"
    ABSENT = "absent"
    OPEN = "not closed"
    CHANGED = "changed"


class Integrity(NamedTuple):
    """Agreement of a log with its digest chain.

    Attributes:
        state: the agreement.
        text: a sentence that describes the agreement.
    """

    state: DigestState
    text: str

    @property
    def passed(self) -> bool:
        """False if something was changed, or if records were removed."""
        return self.state is not DigestState.CHANGED


class RunningDigest:
    """The digests of one file while it is written or read.

    Attributes:
        messages: number of messages added.
    """

    def __init__(self) -> None:
        self.messages = 0
        self._records = hashlib.sha256()
        self._descriptions: set[bytes] = set()  # digests of the describing records

    def add_records(self, data: bytes | bytearray | memoryview, messages: int) -> None:
        """Adds messages in the form of records of the file, and their number."""
        self._records.update(data)
        self.messages += messages

    def add_entry(self, opcode: int, content: bytes) -> None:
        """Adds a header, metadata, an attachment, a schema or a channel.

        Repeated entries count once.
        """
        self._descriptions.add(hashlib.sha256(bytes([opcode]) + content).digest())

    def facts(self) -> dict[str, str]:
        """Returns the metadata that close the chain, with digests in hexadecimal."""
        about = hashlib.sha256(b"".join(sorted(self._descriptions))).hexdigest()
        digests = {"records": self._records.hexdigest(), "about": about}
        return {"algorithm": ALGORITHM, "messages": str(self.messages), **digests}

    def judge(
        self, metadata: Mapping[str, Mapping[str, str]], *, finished: bool, damaged: bool
    ) -> Integrity:
        """Returns the agreement of the file with the chain that the file states.

        Args:
            metadata: all metadata of the file, by name.
            finished: True if the file was finished.
            damaged: True if a part of the file cannot be read.
        """
        stated = metadata.get(DIGESTS)
        recovered = metadata.get(RECOVERED, {})
        if recovered.get("chain") == DigestState.CHANGED:
            return Integrity(DigestState.CHANGED, "recovered from a file that had been changed")
        if stated is None:
            is_announced = DIGESTS_KEY in metadata.get(SESSION, {})
            return _judge_without_chain(is_announced=is_announced, finished=finished)
        computed = self.facts()
        if computed == dict(stated):
            since = ""
            if "from" in recovered:
                since = f", since it was recovered from {recovered['from']}"
            agrees = (
                f"the digest chain agrees over {count_nouns(self.messages, 'message')} "
                f"and all metadata{since}"
            )
            return Integrity(DigestState.INTACT, agrees)
        lacks_messages = (
            stated.get("about") == computed["about"]
            and stated.get("messages") != computed["messages"]
        )
        if damaged and lacks_messages:
            return Integrity(
                DigestState.OPEN, "its digest chain cannot be compared: the file is damaged"
            )
        differ = [name for key, name in _COVERED.items() if stated.get(key) != computed[key]]
        return Integrity(
            DigestState.CHANGED, f"changed since it was made: {' and '.join(differ)}"
        )


def _judge_without_chain(*, is_announced: bool, finished: bool) -> Integrity:
    """Returns the agreement of a file that states no digests."""
    if not is_announced:
        return Integrity(DigestState.ABSENT, "no digest chain: an older program made it")
    if not finished:
        text = "its digest chain is not closed: the file was not finished"
        return Integrity(DigestState.OPEN, text)
    return Integrity(DigestState.CHANGED, "its digest chain was removed")


_COVERED = {
    "algorithm": "its digest chain",
    "messages": "the number of its messages",
    "records": "its messages",
    "about": "its metadata, scenario, schemas or channels",
}
