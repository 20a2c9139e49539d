"""Computes the digests of a log, which reveal whether it was modified after recording.

A log contains two SHA-256 digests: one of all messages in order, and one of everything that
describes the messages (metadata, scenario, schemas and channels). If a log has several parts,
each part repeats the digest of the previous one, so the digests form a chain. The digests
reveal modifications, but not that a whole file was rewritten with new digests. Signatures
protect against this (`log_signature`).

Invariant:
    - The digests depend on the records of the file, but not on their division into chunks or on
      the compression.
    - Any modification of a message, of its times or number, or of metadata, scenario, schema or
      channels changes one of the digests.
"""

import hashlib
from collections.abc import Mapping
from enum import StrEnum
from typing import NamedTuple

from ..errors import count_nouns
from .log_layout import SESSION

DIGESTS = "trilat.chain"
"""Name of the metadata record with the digests, at the end of a log."""
DIGESTS_KEY = "digest_chain"
"""Key of the session metadata that announces the digests and names their algorithm."""
ALGORITHM = "sha256"
"""Name of the algorithm."""
RECOVERED = "trilat.recovered"
"""Name of the metadata record that describes the source and the losses of a recovered log."""
PREVIOUS_DIGEST_KEY = "previous_records"
"""Key, in the metadata of a part, of the digest of the messages in the previous part."""


class DigestState(StrEnum):
    """Result of comparing a file with its digests, ordered from best to worst.

    A digest is a checksum of the contents that reveals modifications.

    - INTACT: The file matches its digests.
    - ABSENT: The file has no digests, because it was written by an old version of the program.
    - OPEN: The file was not finished or is damaged, and cannot be compared.
    - CHANGED: The file differs from its digests, or the digests were removed.
    """

    INTACT = "intact"
    ABSENT = "absent"
    OPEN = "not closed"
    CHANGED = "changed"


class Integrity(NamedTuple):
    """States whether a log matches its digests, checksums that reveal modifications.

    Every certificate and check reports this, because a modified log proves nothing.

    Attributes:
        state: The result of the comparison.
        text: A sentence that explains the result to the user.
    """

    state: DigestState
    text: str

    @property
    def passed(self) -> bool:
        """False only if something in the file was modified or removed after it was recorded.

        A file without digests, or an unfinished file, cannot be compared. It passes, because
        nothing shows that it was modified.
        """
        return self.state is not DigestState.CHANGED


class RunningDigest:
    """Computes the digests (SHA-256 checksums) of one file while it is written or read.

    One digest covers the messages, the other everything that describes them.

    Attributes:
        messages: Number of messages added so far.
    """

    def __init__(self) -> None:
        self.messages = 0
        self._records = hashlib.sha256()
        # A digest of each record that describes the messages. The digests form a set, because
        # such a record may be repeated, and because the order of these records does not matter.
        self._descriptions: set[bytes] = set()

    def add_records(self, data: bytes | bytearray | memoryview, messages: int) -> None:
        """Updates the hash of a file's messages with further messages, in file order.

        Args:
            data: The messages with their headers, as in an uncompressed chunk of the MCAP file.
            messages: Number of messages in `data`.
        """
        self._records.update(data)
        self.messages += messages

    def add_entry(self, opcode: int, content: bytes) -> None:
        """Updates the hash of the records that describe the messages, such as schemas.

        The order of these records does not matter, and repeated records count once.

        Args:
            opcode: Identifies the kind of record: header, metadata, attachment, schema or
                channel.
            content: Content of the record.
        """
        self._descriptions.add(hashlib.sha256(bytes([opcode]) + content).digest())

    def facts(self) -> dict[str, str]:
        """Returns the hashes of everything in the file so far, as metadata for the file.

        A reader recomputes them to find out whether the file was modified.

        Returns:
            A dictionary of strings: "algorithm" (the hash method), "messages" (the number of
                messages), "records" (the checksum of the messages) and "about" (the checksum of
                the records that describe them). The checksums are in hexadecimal digits.
        """
        about = hashlib.sha256(b"".join(sorted(self._descriptions))).hexdigest()
        digests = {"records": self._records.hexdigest(), "about": about}
        return {"algorithm": ALGORITHM, "messages": str(self.messages), **digests}

    def judge(
        self, metadata: Mapping[str, Mapping[str, str]], *, finished: bool, damaged: bool
    ) -> Integrity:
        """Decides from the hashes stored in a file whether the file was modified.

        Args:
            metadata: Maps the name of each metadata record of the file, including its digests,
                to its contents.
            finished: True if the file was finished. A finished file must contain digests.
            damaged: True if a part of the file cannot be read.

        Returns:
            Whether the file matches its digests, with an explanation.
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

        # If a part of the file is damaged, messages are missing although nobody changed the
        # file.
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
    """Returns the result of checking a file that contains no digests.

    Args:
        is_announced: True if the beginning of the file announces digests.
        finished: True if the file was finished.
    """
    if not is_announced:
        return Integrity(DigestState.ABSENT, "no digest chain: written by an older program")
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
"""Maps each entry of the digests to the part of the log that has changed if the entry differs,
as a noun phrase.
"""
