"""Signs logs, so that anyone can later verify that a log has not been changed.

A log contains digests of its contents (`running_digest`). The owner of a private key signs
these digests with Ed25519 and stores the signature in a separate file next to the log. Anyone
who has the public key can verify that the log is the one that was signed. A signature covers
all messages and everything that describes them, but not the compression, so it also holds for a
copy of the log that was compressed differently.

Invariant:
    - A log is only read, never changed.
    - Only a log that matches its digests is signed.
"""

import base64
import json
from collections import deque
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgspec
from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric.ed25519 import (
    Ed25519PrivateKey,
    Ed25519PublicKey,
)

from ..errors import LogError, UsageError, count_nouns
from ..files import (
    open_regular,
    read_foreign_permissions,
    reading,
    refuse_existing,
    write_whole,
)
from .findings import Finding
from .mcap_reader import McapReader, Progress
from .running_digest import DIGESTS, DigestState, Integrity

SUFFIX = ".sig"
"""Suffix of the signature file, appended to the full name of the log."""
_FORMAT = "trilat-net log signature 1"
"""Name and version of the format, at the start of the signed bytes."""
_MAX_BYTES = 65_536
"""Maximum size of a key file or signature file, in bytes."""


class _LogSignature(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Content of the file next to a log that contains its cryptographic signature.

    Attributes:
        format: Name and version of the format.
        chain: The signed digests, as stated in the log.
        public_key: Public key of the signer, 32 bytes in base64. It is not trusted. The person
            who checks the log supplies the key of a trusted signer.
        signature: The signature, 64 bytes in base64.
    """

    format: str
    chain: dict[str, str]
    public_key: str
    signature: str


def create_signing_keys(path: str | Path) -> tuple[Path, Path]:
    """Creates a key pair for signing logs, like `trilat keys pair`.

    The private key is written to PATH.key, which only the user may read, and the public key to
    PATH.pub.

    >>> [file.name for file in tn.create_signing_keys("lab")]
    ['lab.key', 'lab.pub']

    Args:
        path: Path of the files without the suffix.

    Returns:
        Paths of the private and the public key file.

    Raises:
        UsageError: One of the files exists, or cannot be written.
    """
    path = Path(path)
    if not path.name:
        raise UsageError(
            f"{path} is not the name of a key; name the key as in: trilat keys pair lab"
        )
    private_path = path.with_name(f"{path.name}.key")
    public_path = path.with_name(f"{path.name}.pub")
    for file in (private_path, public_path):
        refuse_existing(file, force=False)
    key = Ed25519PrivateKey.generate()
    pem = serialization.Encoding.PEM
    no_password = serialization.NoEncryption()
    private_bytes = key.private_bytes(pem, serialization.PrivateFormat.PKCS8, no_password)
    write_whole(private_path, private_bytes, force=False, mode=0o600)
    public_format = serialization.PublicFormat.SubjectPublicKeyInfo
    write_whole(public_path, key.public_key().public_bytes(pem, public_format), force=False)
    return private_path, public_path


def sign_log(
    path: str | Path,
    key_file: str | Path,
    *,
    force: bool = False,
    progress: Progress | None = None,
) -> Path:
    """Signs a finished log, like `trilat log sign`.

    >>> path = tn.simulate("two_sites", duration_s=0.1).save("signed.mcap")
    >>> tn.sign_log(path, tn.create_signing_keys("mine")[0]).name
    'signed.mcap.sig'

    Args:
        path: Path of the log.
        key_file: Path of the private key file.
        force: True to allow replacing an existing signature.
        progress: Function that is called after every record of the log.

    Returns:
        Path of the signature file.

    Raises:
        LogError: The log cannot be read, has no digests, or does not match its digests.
        UsageError: The key file is not a private key, other users can read it, or a signature
            already exists.
    """
    path = Path(path)
    key_file = Path(key_file)
    key = _load_key(
        key_file,
        Ed25519PrivateKey,
        "private Ed25519 key; make a pair with: trilat keys pair NAME",
    )
    if read_foreign_permissions(key_file):
        raise UsageError(
            f"{key_file}: other users can read this key; protect the key with: "
            f"chmod 600 {key_file}"
        )
    signature_file = path.with_name((path.name or "log") + SUFFIX)
    refuse_existing(signature_file, force=force)
    integrity, chain = _read_chain(path, progress)
    if integrity.state is not DigestState.INTACT:
        advice = {
            DigestState.OPEN: f"; recover the log first with: trilat log recover {path}",
            DigestState.ABSENT: f"; trilat log recover {path} makes a copy with a digest chain",
        }
        raise LogError(
            f"{path} is not signed: {integrity.text}{advice.get(integrity.state, '')}"
        )
    public_key = key.public_key().public_bytes(
        serialization.Encoding.Raw, serialization.PublicFormat.Raw
    )
    signature = _LogSignature(
        format=_FORMAT,
        chain=dict(chain),
        public_key=base64.b64encode(public_key).decode(),
        signature=base64.b64encode(key.sign(_signed_bytes(chain))).decode(),
    )
    content = msgspec.json.format(msgspec.json.encode(signature), indent=1)
    write_whole(signature_file, content + b"\n", force=force)
    return signature_file


def check_signatures(
    paths: Sequence[Path], key_file: Path, progress: Progress | None = None
) -> Finding:
    """Checks that logs are exactly those signed by the owner of a public key.

    A digest reveals only accidental changes, because anyone can recompute it. A signature shows
    who vouches for the log.

    Args:
        paths: Paths of the logs. The signature of each log is in a file next to it.
        key_file: Path of the public key file of a signer whom the user trusts.
        progress: Function that is called after every record of a log.

    Returns:
        A finding with one problem for each log whose signature is missing or invalid.

    Raises:
        LogError: A log cannot be read.
        UsageError: The key file is not a public key.
    """
    key = _load_key(
        key_file, Ed25519PublicKey, "public Ed25519 key; trilat keys pair NAME makes NAME.pub"
    )
    finding = Finding("signature")
    for path in paths:
        problem = _find_problem(path, key, progress)
        if problem:
            finding.add(str(path), None, problem)
    files = "file is" if len(paths) == 1 else count_nouns(len(paths), "file is", "files are")
    return finding.conclude(f"the {files} as signed by the owner of {key_file}")


def _find_problem(path: Path, key: Ed25519PublicKey, progress: Progress | None) -> str:
    """Checks that a log has not been changed since it was signed.

    Args:
        path: Path of the log.
        key: Public key of the signer.
        progress: Function that is called after every record of the log.

    Returns:
        Description of the problem. Empty if the signature is valid.

    Raises:
        LogError: The log cannot be read.
    """
    signature_file = path.with_name((path.name or "log") + SUFFIX)
    try:
        with open_regular(signature_file) as stream:
            stated_signature = msgspec.json.decode(stream.read(_MAX_BYTES), type=_LogSignature)
        signature = base64.b64decode(stated_signature.signature, validate=True)
    except FileNotFoundError:
        return f"there is no signature file {signature_file}"
    except OSError as error:
        return f"{signature_file} cannot be read: {error.strerror}"
    except ValueError as error:  # raised by msgspec and base64
        return f"{signature_file} is not a signature of this program: {error}"

    if stated_signature.format != _FORMAT:
        return (
            f"{signature_file} has the format {stated_signature.format[:40]!r}, not {_FORMAT!r}"
        )
    try:
        key.verify(signature, _signed_bytes(stated_signature.chain))
    except InvalidSignature:
        return f"{signature_file} was not made by the owner of this key, or was changed"

    # The signature is valid for the digests in its file. The log must have the same digests.
    integrity, chain = _read_chain(path, progress)
    if chain != stated_signature.chain:
        return (
            "the signature belongs to other content "
            f"({count_nouns(stated_signature.chain.get('messages', '?'), 'message')})"
        )
    return "" if integrity.state is DigestState.INTACT else integrity.text


def _signed_bytes(chain: Mapping[str, str]) -> bytes:
    """Returns the bytes that are signed to represent a complete log.

    These are the name of the format, and the digests, which depend on every byte of the file.

    Args:
        chain: The digests, as stated in the log.
    """
    facts = json.dumps(dict(chain), sort_keys=True, separators=(",", ":"))
    return f"{_FORMAT}\n{facts}".encode()


def _read_chain(path: Path, progress: Progress | None) -> tuple[Integrity, dict[str, str]]:
    """Reads a complete log, and compares it with the digests stated at its end.

    Digests are checksums of the contents (`running_digest`), which are recomputed while the log
    is read. A log whose digests match (`DigestState.INTACT`) but whose end mark is missing
    counts as unfinished (`DigestState.OPEN`) and is not signed.

    Args:
        path: Path of the log.
        progress: Function that is called after every record of the log.

    Returns:
        The result of the comparison, and the digests stated in the log. Empty if there are
        none.

    Raises:
        LogError: The log cannot be read.
    """
    with reading(path) as stream:
        reader = McapReader(stream, str(path), progress, kept=False)
        # The reader computes the digests while its messages are iterated. The messages
        # themselves are not needed: a deque of length 0 discards them.
        deque(reader.messages(), maxlen=0)
    integrity = reader.judge_digest()
    if integrity.state is DigestState.INTACT and not reader.complete:
        integrity = Integrity(DigestState.OPEN, "the end of the file is missing")
    stated_digests = reader.metadata.get(DIGESTS, {})
    return integrity, stated_digests


def _load_key(path: Path, kind: Any, expected: str) -> Any:
    """Reads a cryptographic key of a given kind from a file.

    Args:
        path: Path of the file.
        kind: Class of the key.
        expected: Description of the expected key for the error message.

    Raises:
        UsageError: The file is not such a key.
    """
    with reading(path, UsageError) as stream:
        data = stream.read(_MAX_BYTES)
    key: object = None
    # A key that needs a password raises a TypeError.
    with suppress(ValueError, TypeError, UnsupportedAlgorithm):
        if kind is Ed25519PrivateKey:
            key = serialization.load_pem_private_key(data, password=None)
        else:
            key = serialization.load_pem_public_key(data)
    if not isinstance(key, kind):
        raise UsageError(f"{path} is not a {expected}")
    return key
