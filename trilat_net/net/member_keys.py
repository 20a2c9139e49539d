"""Creates, renews and reads the keys that prove the identity of a session's processes.

Without keys, any program that can reach a site over the network could send it messages. `trilat
keys new` creates a private certificate authority for the session and signs one certificate per
member. Zenoh, the library that transports the messages, uses these keys to encrypt all
connections (TLS or QUIC with certificates at both ends).

Each member loads the keys from its own folder. The folder contains its private key, its
certificate, the certificate of the authority and a list of all members, from which the access
rules are derived. No other user of the machine can read the private key or change a file in the
folder. The private key of the authority is kept in a separate folder, which should be stored in
a safe place.

The keys expire one day before their certificate. During this day, no member can start with the
keys, but `trilat stop` can still connect and stop the arms. Zenoh needs a valid certificate
whenever it opens or reopens a connection.
"""

import datetime
import ipaddress
import json
import os
import re
import shutil
import stat
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from ..errors import LogRefused, UsageError
from ..files import (
    describe_write_error,
    make_folder,
    open_regular,
    read_foreign_permissions,
    stage_output,
    write_whole,
)
from .zenoh_config import MOST_SESSIONS, PROTOCOLS, make_access_rules

AUTHORITY = "authority.pem"
"""Name of the file that contains the certificate of the authority."""
CERTIFICATE = "certificate.pem"
"""Name of the file that contains the certificate of the member."""
PRIVATE_KEY = "private.key"
"""Name of the file that contains the private key of the member."""
MEMBERS = "members.json"
"""Name of the file that lists all members and the expiry of the keys."""
_AUTHORITY_FOLDER = "authority"
"""Name of the folder of the authority."""
HERE = ("localhost", "127.0.0.1", "::1")
"""Names and addresses of the local machine, which are included in every certificate."""
STOPPING_TIME = datetime.timedelta(days=1)
"""Time after the expiry of the keys during which they can still be used to stop arms."""
_CLOCK_TOLERANCE = datetime.timedelta(hours=1)
"""Tolerated difference between the clocks of two machines."""
_MOST_KEY_BYTES = 65_536
"""Maximum number of bytes that are read from a key file."""
_RENEWAL = (
    "renew the keys with trilat keys renew, or make new keys for all members with trilat keys "
    "new"
)
"""Advice to the user for keys that have expired."""
_DATE = "%Y-%m-%d %H:%M UTC"
"""Format of dates in messages to the user."""
_MOST_DAYS = 3_650
"""Maximum validity of keys, in days."""
MOST_LETTERS = 64
"""Maximum length of a member's name. X.509 limits common names to 64 characters."""


class MemberKeys(NamedTuple):
    """Cryptographic keys with which one member of a session proves its identity.

    Attributes:
        member: Name of the member.
        members: Names of all members of the session for which the keys were created.
        ends: Expiry time of the keys, in UTC. The certificate remains valid for another
            `STOPPING_TIME`, so that the keys can still be used to stop arms.
        settings: Zenoh settings that use the keys, see `make_zenoh_config`.
        folder: Folder that contains the keys.
        hosts: Names and addresses under which other members can reach this member. Connections
            to any other address fail.
    """

    member: str
    members: tuple[str, ...]
    ends: datetime.datetime
    settings: dict[str, Any]
    folder: Path
    hosts: tuple[str, ...] = ()

    def list_risks(self) -> Iterator[str]:
        """Yields a warning for each risk to the keys on this machine, with its remedy."""
        if read_foreign_permissions(self.folder):
            yield f"other users can read {self.folder}; run: chmod 700 {self.folder}"

        # Anybody who has the key of the authority could create keys for further members.
        authority = self.folder.resolve().parent / _AUTHORITY_FOLDER / PRIVATE_KEY
        if authority.exists():
            yield (
                f"the authority's key {authority} should not be on this machine, because it "
                "can create keys for anybody; keep it elsewhere"
            )


def create_keys(
    folder: str | Path,
    members: Sequence[str],
    hosts: Sequence[str] = (),
    days: int = 30,
) -> list[Path]:
    """Creates a folder of keys for each member of a session, as `trilat keys new` does.

    With keys, the members encrypt their messages and prove their identities. The keys are
    signed by an authority, which is created along with them and can renew them later.

    >>> [folder.name for folder in tn.create_keys("keys", ["m", "s", "recorder"])]
    ['m', 's', 'recorder']

    Args:
        folder: Folder to create. If it exists, it must be empty.
        members: Names of the sites, plus `recorder`, `operator` and `router` if they take part.
        hosts: Names and addresses on which members listen, in addition to those of the local
            machine.
        days: Number of days for which the keys are valid.

    Returns:
        The folders of the members.

    Raises:
        UsageError: A name is invalid, or the folder is not empty or cannot be created.
        LogRefused: Writing to the disk failed. No files are left behind.
    """
    folder = Path(folder)
    faults = [_find_name_fault(members), *map(_find_host_fault, hosts)]
    if not 0 <= days <= _MOST_DAYS:
        faults.append(f"the validity of keys must be 0 to {_MOST_DAYS} days, not {days}")
    for fault in faults:
        if fault:
            raise UsageError(fault)
    is_empty_folder = folder.is_dir() and not any(folder.iterdir())
    is_occupied = folder.exists() and not is_empty_folder
    if not folder.name or is_occupied:
        raise UsageError(
            f"{folder} already exists, and keys are never replaced: name a new folder, or add "
            "members to this one with trilat keys add"
        )

    make_folder(folder.parent)
    with stage_output(folder, force=False, manifest=MEMBERS) as staged:
        staged.chmod(0o700)
        _write_all_keys(staged, members, hosts, days)
    return [folder / member for member in members]


def _find_name_fault(members: Sequence[Any]) -> str:
    """Describes the first fault in the names of members, as a sentence for the user.

    Args:
        members: The names.

    Returns:
        The fault. Empty if all names are valid.
    """
    for name in members:
        has_valid_letters = isinstance(name, str) and re.fullmatch("[A-Za-z0-9_-]+", name)
        if not has_valid_letters or len(name) > MOST_LETTERS or name == _AUTHORITY_FOLDER:
            hint = ""
            if not str(name).isascii():
                hint = "; only the letters a to z and A to Z are allowed"
            return (
                f"a member's name must have 1 to {MOST_LETTERS} characters (letters, digits, _ "
                f"and -) and must not be {_AUTHORITY_FOLDER}; this name is refused: "
                f"{ascii(name)[:80]}{hint}"
            )
    has_duplicates = len(members) > len(set(members))
    if not members or has_duplicates:
        return "name at least one member, and each member once"
    return ""


def _find_host_fault(host: str) -> str:
    """Explains why a certificate cannot contain a host name or an address.

    Names with a port and patterns that stand for several hosts are rejected.

    Args:
        host: The name or address.

    Returns:
        The fault, as a sentence for the user. Empty if the host is valid.
    """
    # A label, a part between dots, has at most 63 characters, and no hyphen at an end.
    label = "(?!-)[A-Za-z0-9_-]{1,63}(?<!-)"
    try:
        is_valid = not ipaddress.ip_address(host).is_unspecified
    except ValueError:
        # Not an address. The last label of a host name must not be a number.
        is_host_name = bool(re.fullmatch(rf"({label}\.)*(?!\d+$){label}", host))
        is_valid = is_host_name and len(host) <= 253
    if is_valid:
        return ""
    return f"--host must be a single host name or address, without a port, not {host!r}"


def renew_keys(folder: str | Path, members: Sequence[str] = (), days: int = 30) -> list[Path]:
    """Renews the certificates of members in place, as `trilat keys renew` does.

    Private keys, host names and member lists stay the same.

    >>> folders = tn.create_keys("lab-keys", ["m", "s"], days=1)
    >>> [folder.name for folder in tn.renew_keys("lab-keys", days=30)]
    ['m', 's']

    Args:
        folder: Folder created by `create_keys`, including its folder `authority`.
        members: Members whose certificates are renewed. If empty, all members that have a
            folder.
        days: Number of days, from now on, for which the keys are valid.

    Returns:
        The folders whose certificates were renewed.

    Raises:
        UsageError: The authority, the folder of a member or a file in it is missing or damaged.
        LogRefused: Writing to the disk failed.
    """
    folder = Path(folder)
    if not 0 <= days <= _MOST_DAYS:
        raise UsageError(f"the validity of keys must be 0 to {_MOST_DAYS} days, not {days}")
    old_authority, authority_key = _read_authority(folder)
    present = [path.name for path in sorted(folder.iterdir()) if (path / MEMBERS).is_file()]
    names = list(members) or present
    missing = [name for name in names if name not in present]
    if missing:
        raise UsageError(
            f"{folder} has no keys for {', '.join(missing)}; the folder has keys for "
            f"{', '.join(present)}"
        )

    ends = datetime.datetime.now(datetime.UTC) + datetime.timedelta(days=days)
    authority = _sign_authority(authority_key, ends)
    # All certificates are signed before the first write, so that a fault changes no file.
    renewed = {
        name: _renew_member(folder / name, old_authority, authority_key, ends) for name in names
    }
    for name, (certificate, member_list) in renewed.items():
        write_whole(folder / name / AUTHORITY, _encode(authority), mode=0o600)
        write_whole(folder / name / CERTIFICATE, _encode(certificate), mode=0o600)
        # The list comes last, because it states the new end of the keys.
        write_whole(folder / name / MEMBERS, member_list, mode=0o600)
    write_whole(folder / _AUTHORITY_FOLDER / AUTHORITY, _encode(authority), mode=0o600)
    return [folder / name for name in names]


def _read_authority(folder: Path) -> tuple[x509.Certificate, Any]:
    """Reads the certificate and private key of the authority that signs the members' keys.

    Args:
        folder: Folder created by `create_keys`.

    Raises:
        UsageError: The authority is missing or damaged.
    """
    if not folder.is_dir():
        raise UsageError(f"{folder} is not a folder of keys made by `trilat keys new`")
    authority_folder = folder / _AUTHORITY_FOLDER
    try:
        authority = x509.load_pem_x509_certificate(_read_trusted(authority_folder / AUTHORITY))
        authority_key: Any = serialization.load_pem_private_key(
            _read_trusted(authority_folder / PRIVATE_KEY), password=None
        )
    except (OSError, ValueError, TypeError) as error:
        raise UsageError(
            f"{authority_folder}: the certificate authority cannot be read ({error}); without "
            "the authority, make new keys for all members with trilat keys new"
        ) from None
    if authority_key.public_key() != authority.public_key():
        raise UsageError(
            f"{authority_folder}: the private key and the certificate do not match"
        )
    return authority, authority_key


def add_keys(
    folder: str | Path,
    members: Sequence[str],
    hosts: Sequence[str] = (),
    days: int = 30,
) -> list[Path]:
    """Creates keys for additional members of a session, as `trilat keys add` does.

    The keys of the existing members stay valid. Only the list of all members in their folders
    (members.json) is replaced.

    >>> folders = tn.create_keys("lab-keys", ["m", "s"])
    >>> [folder.name for folder in tn.add_keys("lab-keys", ["s2"])]
    ['s2']

    Args:
        folder: Folder created by `create_keys`, with its folder `authority` and the folders of
            all members.
        members: Names of the new members.
        hosts: Names and addresses on which the new members listen, in addition to those of the
            local machine.
        days: Number of days for which the new keys are valid.

    Returns:
        The folders of the new members.

    Raises:
        UsageError: A name is invalid or already in use, or the authority or the folder of a
            member is missing or damaged.
        LogRefused: Writing to the disk failed. The folder is unchanged.
    """
    folder = Path(folder)
    faults = [_find_name_fault(members), *map(_find_host_fault, hosts)]
    if not 0 <= days <= _MOST_DAYS:
        faults.append(f"the validity of keys must be 0 to {_MOST_DAYS} days, not {days}")
    for fault in faults:
        if fault:
            raise UsageError(fault)
    authority, authority_key = _read_authority(folder)
    old_lists = _read_member_lists(folder)
    old_names = list(next(iter(old_lists.values()))["members"])
    for name in members:
        if name in old_names or (folder / name).exists():
            raise UsageError(
                f"{folder}: {name} has keys already; name a new member, or renew its keys with "
                "trilat keys renew"
            )

    ends = datetime.datetime.now(datetime.UTC) + datetime.timedelta(days=days)
    # The certificate of the authority must be valid for as long as the certificates that it
    # signs.
    needs_longer = authority.not_valid_after_utc < ends + STOPPING_TIME
    if needs_longer:
        authority = _sign_authority(authority_key, ends)
    names = [*old_names, *members]
    lists = {
        folder / name / MEMBERS: f"{json.dumps({**entry, 'members': names})}\n"
        for name, entry in old_lists.items()
    }
    files = dict(lists)
    if needs_longer:
        files[folder / _AUTHORITY_FOLDER / AUTHORITY] = _encode(authority).decode()
    _add_folders(
        folder=folder,
        members=members,
        files=files,
        write=lambda staged: _write_member_keys(
            staged, members, names, hosts, authority, authority_key, ends
        ),
    )
    return [folder / member for member in members]


def _read_member_lists(folder: Path) -> dict[str, dict[str, Any]]:
    """Reads the lists of members in the folders of all members.

    Args:
        folder: Folder that contains the keys of all members.

    Returns:
        A mapping from the name of each member to the content of its file `MEMBERS`.

    Raises:
        UsageError: A list is missing or damaged, or two lists have different members.
    """
    lists: dict[str, dict[str, Any]] = {}
    unread_members = sorted(path.parent.name for path in folder.glob(f"*/{MEMBERS}"))
    if not unread_members:
        raise UsageError(f"{folder} has no keys made by `trilat keys new`")

    while unread_members:
        name = unread_members.pop(0)
        entry = _read_member_list(folder, name)
        lists[name] = entry
        # A list may name members without a folder here. They must be found as well.
        for other in entry["members"]:
            if other not in lists and other not in unread_members:
                unread_members.append(other)

    first_list = next(iter(lists.values()))["members"]
    for name, entry in lists.items():
        if set(entry["members"]) != set(first_list):
            raise UsageError(
                f"{folder / name / MEMBERS} lists different members than the other folders: "
                f"copy the newest folder of each member to {folder}"
            )
    return lists


def _read_member_list(folder: Path, name: str) -> dict[str, Any]:
    """Reads the list of members in the folder of one member.

    Args:
        folder: Folder that contains the keys of all members.
        name: Name of the member.

    Returns:
        The content of the file `MEMBERS`: the name of the member, and the names of all members.

    Raises:
        UsageError: The list is missing or damaged.
    """
    path = folder / name / MEMBERS
    try:
        entry: dict[str, Any] = json.loads(_read_trusted(path))
        is_valid = entry["member"] == name and not _find_name_fault(entry["members"])
    except OSError:
        raise UsageError(
            f"{folder} has no folder for {name}, but the list of members of {name} must be "
            f"updated too: copy {name}/{MEMBERS} from the machine of {name} to {folder}"
        ) from None
    except (ValueError, TypeError, KeyError):
        is_valid = False
    if not is_valid:
        raise UsageError(f"{path} is damaged, or was not made by `trilat keys new`")
    return entry


def _add_folders(
    folder: Path,
    members: Sequence[str],
    files: dict[Path, str],
    write: Callable[[Path], None],
) -> None:
    """Adds folders for members and replaces files. If this fails, nothing is changed.

    Args:
        folder: Folder that contains the keys of all members.
        members: Names of the new folders.
        files: Mapping from existing file to new content.
        write: Function that writes the new folders into the folder passed to it.

    Raises:
        LogRefused: Writing to the disk failed. The folder is unchanged.
    """
    old_contents = {path: path.read_text(encoding="utf-8") for path in files}
    try:
        # The scratch folder is on the same disk, so that moving a folder out of it cannot fail
        # halfway.
        with tempfile.TemporaryDirectory(prefix=".add-", dir=folder) as scratch:
            write(Path(scratch))
            for member in members:
                (Path(scratch) / member).rename(folder / member)
        for path, content in files.items():
            write_whole(path, content, mode=0o600)
    except BaseException as error:
        # Restores the previous state: the old files, and no new folders.
        for path, content in old_contents.items():
            with suppress(OSError, LogRefused):
                if path.read_text(encoding="utf-8") != content:
                    write_whole(path, content, mode=0o600)
        for member in members:
            shutil.rmtree(folder / member, ignore_errors=True)
        if isinstance(error, OSError):
            raise describe_write_error(folder, error, "nothing was added") from None
        raise


def _renew_member(
    folder: Path,
    authority: x509.Certificate,
    authority_key: Any,
    ends: datetime.datetime,
) -> tuple[x509.Certificate, str]:
    """Signs a new certificate for the existing private key of one member.

    Args:
        folder: Folder of the member.
        authority: Previous certificate of the authority, which must have signed the previous
            certificate of the member.
        authority_key: Private key of the authority.
        ends: Expiry time of the keys.

    Returns:
        The new certificate, and the new content of the list of members.

    Raises:
        UsageError: A file is damaged, or the authority has not signed the previous certificate.
    """
    try:
        old_certificate = x509.load_pem_x509_certificate(_read_trusted(folder / CERTIFICATE))
        old_certificate.verify_directly_issued_by(authority)
        member_list = json.loads(_read_trusted(folder / MEMBERS))
        host_names = old_certificate.extensions.get_extension_for_class(
            x509.SubjectAlternativeName
        ).value
        certificate = _sign_member(
            subject=old_certificate.subject,
            public_key=old_certificate.public_key(),
            names=host_names,
            authority_key=authority_key,
            ends=ends,
        )
        return certificate, _format_member_list(
            member_list["member"], member_list["members"], ends
        )
    except UsageError:
        raise
    except Exception as error:  # the errors of cryptography have no common base class
        raise UsageError(
            f"{folder}: the keys are damaged, or were not issued by this authority ({error!r})"
        ) from None


def _write_all_keys(
    folder: Path,
    members: Sequence[str],
    hosts: Sequence[str],
    days: int,
) -> None:
    """Creates the folders of the authority and of all members.

    Args:
        folder: Folder in which they are created.
        members: Names of the members.
        hosts: Names and addresses on which members listen.
        days: Number of days for which the keys are valid.
    """
    ends = datetime.datetime.now(datetime.UTC) + datetime.timedelta(days=days)
    authority_key = ec.generate_private_key(ec.SECP256R1())
    authority = _sign_authority(authority_key, ends)
    _write_folder(folder / _AUTHORITY_FOLDER, authority, authority, authority_key)

    _write_member_keys(folder, members, members, hosts, authority, authority_key, ends)


def _write_member_keys(
    folder: Path,
    members: Sequence[str],
    all_members: Sequence[str],
    hosts: Sequence[str],
    authority: x509.Certificate,
    authority_key: Any,
    ends: datetime.datetime,
) -> None:
    """Creates the folders of members, each with a new private key.

    Args:
        folder: Folder in which they are created.
        members: Names of the members whose folders are created.
        all_members: Names of all members of the session.
        hosts: Names and addresses on which the members listen.
        authority: Certificate of the authority.
        authority_key: Private key of the authority.
        ends: Expiry time of the keys.
    """
    for member in members:
        member_key = ec.generate_private_key(ec.SECP256R1())
        certificate = _sign_member(
            subject=_make_subject(member),
            public_key=member_key.public_key(),
            names=_make_alternative_names(hosts),
            authority_key=authority_key,
            ends=ends,
        )
        _write_folder(folder / member, authority, certificate, member_key)
        member_list = _format_member_list(member, all_members, ends)
        _write_new_file(folder / member / MEMBERS, member_list.encode())


def _format_member_list(member: str, members: Sequence[str], ends: datetime.datetime) -> str:
    """Returns the names of all members and the expiry of their keys as JSON.

    Each member has this JSON in its file `MEMBERS`, next to its keys.

    Args:
        member: Name of the member.
        members: Names of all members.
        ends: Expiry time of the keys.
    """
    content = {"member": member, "members": list(members), "ends": ends.isoformat()}
    return f"{json.dumps(content)}\n"


def _sign_authority(
    key: ec.EllipticCurvePrivateKey, ends: datetime.datetime
) -> x509.Certificate:
    """Returns the certificate of the authority that signs the certificates of all members.

    The certificate is self-signed, since there is no higher authority.

    Args:
        key: Private key of the authority.
        ends: Expiry time of the keys.
    """
    constraints = x509.BasicConstraints(ca=True, path_length=0)
    builder = _start_certificate(_ISSUER, key.public_key(), ends)
    return builder.add_extension(constraints, critical=True).sign(key, hashes.SHA256())


def _sign_member(
    subject: x509.Name,
    public_key: Any,
    names: x509.SubjectAlternativeName,
    authority_key: ec.EllipticCurvePrivateKey,
    ends: datetime.datetime,
) -> x509.Certificate:
    """Returns a certificate for the public key of a member, signed by the authority.

    Args:
        subject: Name of the member.
        public_key: Public key of the member.
        names: Host names and addresses on which the member may listen.
        authority_key: Private key of the authority.
        ends: Expiry time of the keys.
    """
    uses = x509.ExtendedKeyUsage(
        [ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH]
    )
    builder = _start_certificate(subject, public_key, ends)
    builder = builder.add_extension(names, critical=False)
    builder = builder.add_extension(uses, critical=False)
    return builder.sign(authority_key, hashes.SHA256())


def _make_subject(common_name: str) -> x509.Name:
    """Returns the X.509 name that identifies the holder of a certificate, for example "m1"."""
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common_name)])


_ISSUER = _make_subject("trilat-net authority")
"""Name of the authority in the certificates."""


def _start_certificate(
    subject: x509.Name, public_key: Any, ends: datetime.datetime
) -> x509.CertificateBuilder:
    """Returns an unsigned certificate with the fields common to all certificates.

    Args:
        subject: Name of the member or the authority.
        public_key: Public key of the member or the authority.
        ends: Expiry time of the keys. The certificate expires `STOPPING_TIME` later.
    """
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(_ISSUER)
        .public_key(public_key)
        .serial_number(x509.random_serial_number())
        .not_valid_before(datetime.datetime.now(datetime.UTC) - _CLOCK_TOLERANCE)
        .not_valid_after(ends + STOPPING_TIME)
    )


def _encode(certificate: x509.Certificate) -> bytes:
    """Encodes a certificate in PEM format, as required by Zenoh."""
    return certificate.public_bytes(serialization.Encoding.PEM)


def _make_alternative_names(hosts: Sequence[str]) -> x509.SubjectAlternativeName:
    """Returns the host names and addresses for which a certificate is valid, as X.509 objects.

    Connections to a member under any other name or address fail.

    Args:
        hosts: Names and addresses in addition to those of the local machine.
    """
    names: list[x509.GeneralName] = []
    for host in dict.fromkeys((*HERE, *hosts)):
        try:
            names.append(x509.IPAddress(ipaddress.ip_address(host)))
        except ValueError:
            names.append(x509.DNSName(host))
    return x509.SubjectAlternativeName(names)


def _list_hosts(certificate: x509.Certificate) -> tuple[str, ...]:
    """Returns the host names and addresses for which the certificate of a member is valid.

    Connections to a member fail if the endpoint names another host. The result is empty if the
    certificate names no hosts or cannot be read.
    """
    try:
        names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName)
    except (ValueError, x509.ExtensionNotFound):
        return ()
    return tuple(
        str(name.value)
        for name in names.value
        if isinstance(name, x509.DNSName | x509.IPAddress)
    )


def _write_folder(
    folder: Path,
    authority: x509.Certificate,
    certificate: x509.Certificate,
    key: ec.EllipticCurvePrivateKey,
) -> None:
    """Creates the folder of a member or of the authority.

    Args:
        folder: The folder.
        authority: Certificate of the authority.
        certificate: Certificate of the member. For the authority's own folder, pass the same
            object as `authority`; it is then written only once.
        key: Private key that belongs to the certificate.
    """
    folder.mkdir(mode=0o700, parents=True)
    _write_new_file(folder / AUTHORITY, authority.public_bytes(serialization.Encoding.PEM))
    if certificate is not authority:
        _write_new_file(
            folder / CERTIFICATE, certificate.public_bytes(serialization.Encoding.PEM)
        )
    private = key.private_bytes(
        serialization.Encoding.PEM,
        serialization.PrivateFormat.PKCS8,
        serialization.NoEncryption(),
    )
    _write_new_file(folder / PRIVATE_KEY, private)


def _write_new_file(path: Path, content: bytes) -> None:
    """Writes a file that only its owner can read, such as a private key.

    An existing file is never overwritten, because a lost key could not be restored.

    Raises:
        FileExistsError: The file exists.
    """
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    with os.fdopen(descriptor, "wb") as file:
        file.write(content)


def _read_trusted(path: Path) -> bytes:
    """Reads a key file, provided no other user of the machine can change it.

    Otherwise, an unknown process could join the session with a manipulated file.

    Raises:
        UsageError: Another user can change the file.
    """
    with open_regular(path) as stream:
        _check_permissions(path, os.fstat(stream.fileno()))
        content: bytes = stream.read(_MOST_KEY_BYTES)
    return content


def _check_permissions(path: Path, status: os.stat_result) -> None:
    """Raises UsageError if another user can change a file or folder.

    In a folder with the sticky bit, users cannot change the files of others, so such a folder
    may be shared. On Windows, permission bits do not show who can write, and nothing is
    checked.

    Args:
        path: The file or folder.
        status: Its permissions.

    Raises:
        UsageError: Another user can change it.
    """
    if sys.platform == "win32":
        return
    # The administrator (0) can change every file anyway, and accepts all owners.
    user = os.geteuid()
    if user != 0 and status.st_uid not in (0, user):
        raise UsageError(
            f"{path} belongs to another user, who can change the keys: use keys of your own"
        )

    is_sticky_folder = stat.S_ISDIR(status.st_mode) and status.st_mode & stat.S_ISVTX
    others_may_write = status.st_mode & (stat.S_IWGRP | stat.S_IWOTH)
    if others_may_write and not is_sticky_folder:
        raise UsageError(
            f"{path}: other users can write to this path and so decide who takes part; "
            f"protect the keys with: chmod go-w {path}"
        )


def read_member_keys(folder: str | Path, *, stops: bool = False) -> MemberKeys:
    """Reads and checks the keys in a member's folder, as `trilat keys info` does.

    >>> tn.read_member_keys(tn.create_keys("lab-keys", ["m", "s"])[0]).member
    'm'

    Args:
        folder: Folder of one member.
        stops: True if the keys are only used to stop arms. Expired keys are then accepted for
            another `STOPPING_TIME`, until their certificate expires too.

    Returns:
        The keys.

    Raises:
        UsageError: A file is missing or damaged, the keys have expired, or the files do not
            belong together.
    """
    folder = Path(folder)
    if (folder / _AUTHORITY_FOLDER).is_dir():
        raise UsageError(
            f"{folder} has the keys of all members; name the folder of one member, as in "
            f"{folder}/m1"
        )

    try:
        _check_permissions(folder, folder.stat())
        members_text = _read_trusted(folder / MEMBERS)
        authority_pem = _read_trusted(folder / AUTHORITY)
        certificate_pem = _read_trusted(folder / CERTIFICATE)
        private_pem = _read_trusted(folder / PRIVATE_KEY)
    except OSError as error:
        raise UsageError(
            f"{error.filename}: {error.strerror}: the folder has no keys made by "
            "`trilat keys new`"
        ) from None
    try:
        member_list = json.loads(members_text)
        member = member_list["member"]
        members = tuple(member_list["members"])
        authority = x509.load_pem_x509_certificate(authority_pem)
        certificate = x509.load_pem_x509_certificate(certificate_pem)
        key = serialization.load_pem_private_key(private_pem, password=None)
        ends = certificate.not_valid_after_utc
        # Keys of earlier versions end with their certificate.
        if "ends" in member_list:
            ends = min(ends, datetime.datetime.fromisoformat(member_list["ends"]))
        certificate.verify_directly_issued_by(authority)
    except (ValueError, TypeError, KeyError, RecursionError) as error:
        raise UsageError(
            f"{folder}: the keys are damaged, or were not made by `trilat keys new` ({error})"
        ) from None
    except Exception as error:  # the errors of cryptography have no common base class
        raise UsageError(
            f"{folder}: the authority has not signed this certificate ({error!r})"
        ) from None

    fault = _find_name_fault(members) or _find_key_fault(
        folder=folder,
        member=member,
        members=members,
        certificate=certificate,
        key=key,
        ends=certificate.not_valid_after_utc if stops else ends,
    )
    if fault:
        raise UsageError(f"{folder}: {fault}")
    return MemberKeys(
        member=member,
        members=members,
        ends=ends,
        settings=_make_settings(folder.resolve(), members),
        hosts=_list_hosts(certificate),
        folder=folder,
    )


def _find_key_fault(
    folder: Path,
    member: str,
    members: Sequence[str],
    certificate: x509.Certificate,
    key: Any,
    ends: datetime.datetime,
) -> str:
    """Describes the first fault in the keys of a member. Empty if the keys are valid.

    Args:
        folder: Folder of the member.
        member: Name of the member, from its list of members.
        members: Names of all members.
        certificate: Certificate of the member.
        key: Private key of the member.
        ends: Expiry time of the keys.
    """
    common_name = ", ".join(
        name.rfc4514_string().removeprefix("CN=") for name in certificate.subject.rdns
    )
    begins = certificate.not_valid_before_utc
    private = folder / PRIVATE_KEY
    now = datetime.datetime.now(datetime.UTC)

    # Each entry: whether the fault is present, and its description for the user.
    faults = (
        (
            read_foreign_permissions(private),
            f"other users can read {PRIVATE_KEY}; protect the key with: chmod 600 {private}",
        ),
        (
            common_name != member,
            f"the certificate is for {common_name}, but {MEMBERS} names {member}",
        ),
        (member not in members, f"{MEMBERS} does not list {member}"),
        (
            key.public_key() != certificate.public_key(),
            "the private key and the certificate do not match",
        ),
        (
            begins > now,
            f"the certificate is not valid before {begins:{_DATE}}: check the clock of this "
            "machine",
        ),
        (
            ends <= now,
            f"the keys expired on {ends:{_DATE}}: {_RENEWAL}",
        ),
    )

    for is_present, text in faults:
        if is_present:
            return text
    return ""


def _make_settings(folder: Path, members: Sequence[str]) -> dict[str, Any]:
    """Returns the Zenoh settings that make a member use its keys for encryption.

    Args:
        folder: Folder of the member.
        members: Names of all members, whose access rules are part of the settings.
    """
    tls = {
        "root_ca_certificate": str(folder / AUTHORITY),
        "enable_mtls": True,
        "verify_name_on_connect": True,
        # Expiry of a certificate does not end a session, see `Connection.require_keys_until`.
        "close_link_on_expiration": False,
        "listen_certificate": str(folder / CERTIFICATE),
        "connect_certificate": str(folder / CERTIFICATE),
        "listen_private_key": str(folder / PRIVATE_KEY),
        "connect_private_key": str(folder / PRIVATE_KEY),
    }
    return {
        "transport": {
            "link": {"protocols": list(PROTOCOLS), "tls": tls},
            "unicast": {"max_sessions": MOST_SESSIONS, "accept_pending": MOST_SESSIONS},
        },
        "adminspace": {"enabled": False},
        **make_access_rules(members),
    }
