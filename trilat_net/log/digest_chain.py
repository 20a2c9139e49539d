"""Digest chain of a log: SHA-256 over all messages in order, and over everything that describes them.

Invariant: the digests depend on the records of the file, not on chunks or their compression; any change of a
message, of its times or number, of metadata, scenario, schemas or channels changes one of them. They protect
against alteration, not against a file that was made anew: that is the task of a signature.
"""

import hashlib
from collections.abc import Mapping
from enum import StrEnum

from .log_layout import SESSION

CHAIN = "trilat.chain"
"""Metadata at the end of a log: the digests of all that precedes."""
CHAIN_KEY = "digest_chain"
"""Entry of the session's metadata that announces the chain, by its algorithm."""
ALGORITHM = "sha256"
RECOVERED = "trilat.recovered"
"""Metadata of a recovered log: what it was made from, and what was lost."""
PREVIOUS_DIGEST_KEY = "previous_records"
"""Entry of a part's metadata: the digest of the messages of the part before it."""


class ChainState(StrEnum):
    """Agreement of a file with its digest chain, best first."""

    INTACT = "intact"
    ABSENT = "absent"
    OPEN = "not closed"
    CHANGED = "changed"


class DigestChain:
    """The digests of one file while it is written or read; `records` and `about` in hexadecimal."""

    def __init__(self) -> None:
        self._records = hashlib.sha256()
        self._about: set[bytes] = set()

    def add_records(self, data: bytes | bytearray | memoryview) -> None:
        """Adds messages, as the records that they are in the file."""
        self._records.update(data)

    def add_entry(self, opcode: int, content: bytes) -> None:
        """Adds a header, metadata, an attachment, a schema or a channel; repeated ones count once."""
        self._about.add(hashlib.sha256(bytes([opcode]) + content).digest())

    def facts(self, messages: int) -> dict[str, str]:
        """Returns the metadata that close the chain of a file with so many messages."""
        about = hashlib.sha256(b"".join(sorted(self._about))).hexdigest()
        digests = {"records": self._records.hexdigest(), "about": about}
        return {"algorithm": ALGORITHM, "messages": str(messages), **digests}


def judge_chain(
    chain: DigestChain,
    messages: int,
    metadata: Mapping[str, Mapping[str, str]],
    *,
    finished: bool,
    damaged: bool,
) -> tuple[ChainState, str]:
    """Returns whether a file agrees with the chain that it states, and a sentence for it.

    Args:
        chain: the digests of what was read.
        messages: how many messages that is.
        metadata: all metadata of the file, by name.
        finished: True if it was finished.
        damaged: True if a part of it cannot be read.
    """
    stated, recovered = metadata.get(CHAIN), metadata.get(RECOVERED, {})
    if recovered.get("chain") == ChainState.CHANGED:
        return ChainState.CHANGED, "recovered from a file that had been changed"
    if stated is None:
        if CHAIN_KEY not in metadata.get(SESSION, {}):
            return ChainState.ABSENT, "no digest chain: an older program made it"
        if not finished:
            return ChainState.OPEN, "its digest chain is not closed: the file was not finished"
        return ChainState.CHANGED, "its digest chain was removed"
    found = chain.facts(messages)
    if found == dict(stated):
        since = f", since it was recovered from {recovered['from']}" if "from" in recovered else ""
        return ChainState.INTACT, f"the digest chain agrees over {messages} messages and all metadata{since}"
    if damaged and stated.get("about") == found["about"] and stated.get("messages") != found["messages"]:
        return ChainState.OPEN, "its digest chain cannot be compared: the file is damaged"
    differ = [name for key, name in _COVERED.items() if stated.get(key) != found[key]]
    return ChainState.CHANGED, f"changed since it was made: {' and '.join(differ)}"


_COVERED = {
    "algorithm": "its digest chain",
    "messages": "the number of its messages",
    "records": "its messages",
    "about": "its metadata, scenario, schemas or channels",
}
