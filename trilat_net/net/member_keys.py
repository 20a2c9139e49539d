"""The keys of a session's members: made by `trilat keys new`, used by every member that is
given its folder.

Invariant: a private authority signs one certificate per member, which ends after some days, and
is kept apart. A member's folder holds its own key, which nobody else may read, its certificate,
that of the authority, and the list of members, from which its access rules follow; nobody else
may write any of it. Keys are made whole or not at all.

Keys end a day before their certificate does: no member begins with them any more, but `trilat
stop` still connects. Every connection of Zenoh, also one that is made again, needs a
certificate that holds.
"""

import datetime
import ipaddress
import json
import os
import re
import stat
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from ..errors import UsageError
from ..files import (
    make_folder,
    open_regular,
    read_foreign_permissions,
    stage_output,
    write_whole,
)
from .zenoh_config import MOST_SESSIONS, PROTOCOLS, make_access_rules

AUTHORITY = "authority.pem"
CERTIFICATE = "certificate.pem"
PRIVATE_KEY = "private.key"
MEMBERS = "members.json"
_AUTHORITY_FOLDER = "authority"
HERE = ("localhost", "127.0.0.1", "::1")
"""Names of the own machine, which every certificate holds."""
STOPPING_TIME = datetime.timedelta(days=1)
"""Time after the end of keys during which they still stop arms."""
_BEFORE = datetime.timedelta(hours=1)
"""Clocks of machines may differ by so much."""
MOST_KEY_BYTES = 65_536
"""Of a file of keys; the rest of a longer one is not read."""
_RENEWAL = "renew it with trilat keys renew, or make new keys for all with trilat keys new"
_DATE = "%Y-%m-%d %H:%M UTC"
MOST_DAYS = 3_650
MOST_LETTERS = 64
"""For which certificates may hold, and of a name in one."""


class MemberKeys(NamedTuple):
    """A member's keys.

    Attributes:
        ends: when the keys end, in UTC; their certificate holds for `STOPPING_TIME` longer.
        settings: of Zenoh, see `make_zenoh_config`.
    """

    member: str
    members: tuple[str, ...]
    ends: datetime.datetime
    settings: dict[str, Any]


def create_keys(
    folder: str | Path, members: Sequence[str], hosts: Sequence[str] = (), days: int = 30
) -> list[Path]:
    """Makes an authority and a folder of keys for each member; returns the folders, as `trilat
    keys new`.

    >>> [one.name for one in tn.create_keys("keys", ["m", "s", "recorder"])]
    ['m', 's', 'recorder']

    Args:
        folder: where they are made; it must not exist, or be empty.
        members: sites, and of `recorder`, `operator`, `router` those that there are.
        hosts: names and addresses at which members listen, besides this machine's own.
        days: how long the certificates hold.

    Raises:
        UsageError: a name cannot be one, or the folder is not empty, or cannot be made.
        LogRefused: the disk refused it; nothing is left of it.
    """
    folder = Path(folder)
    faults = [_find_name_fault(members), *map(_find_host_fault, hosts)]
    if not 0 <= days <= MOST_DAYS:
        faults.append(f"keys hold for 0 to {MOST_DAYS} days, not {days}")
    if fault := next(filter(None, faults), ""):
        raise UsageError(fault)
    if not folder.name or (folder.exists() and (not folder.is_dir() or any(folder.iterdir()))):
        raise UsageError(
            f"{folder}: there is something already; keys are never replaced, name a new folder"
        )
    make_folder(folder.parent)
    with stage_output(folder, force=False, manifest=MEMBERS) as staged:
        staged.chmod(0o700)
        _make_all(staged, members, hosts, days)
    return [folder / member for member in members]


def _find_name_fault(members: Sequence[Any]) -> str:
    for name in members:
        of_letters = isinstance(name, str) and re.fullmatch("[A-Za-z0-9_-]+", name)
        if not of_letters or len(name) > MOST_LETTERS or name == _AUTHORITY_FOLDER:
            most = f"at most {MOST_LETTERS} letters, digits, _ and -"
            letters = "" if str(name).isascii() else "; its letters are a to z and A to Z"
            return f"a member's name is {most}, and not {_AUTHORITY_FOLDER}, not {ascii(name)[:80]}{letters}"
    return (
        ""
        if 0 < len(members) == len(set(members))
        else "every member is named once, and there is one"
    )


def _find_host_fault(host: str) -> str:
    """Returns why a certificate cannot be made for a host, "" if it can: no certificate is good
    for many.
    """
    label = "(?!-)[A-Za-z0-9_-]{1,63}(?<!-)"
    try:
        one = not ipaddress.ip_address(host).is_unspecified
    except ValueError:
        one = bool(re.fullmatch(rf"({label}\.)*(?!\d+$){label}", host)) and len(host) <= 253
    return (
        ""
        if one
        else f"--host: a certificate is for one host name or address, without a port, not {host!r}"
    )


def renew_keys(folder: str | Path, members: Sequence[str] = (), days: int = 30) -> list[Path]:
    """Renews the certificates of members in place; the command is `trilat keys renew`.

    Private keys, hosts and the lists of members stay as they are.

    >>> folders = tn.create_keys("lab-keys", ["m", "s"], days=1)
    >>> [folder.name for folder in tn.renew_keys("lab-keys", days=30)]
    ['m', 's']

    Args:
        folder: the folder that `create_keys` made, with its folder `authority`.
        members: whose certificates are renewed; none: those of all members whose folders are
            there.
        days: how long the keys hold from now on.

    Returns:
        The renewed folders.

    Raises:
        UsageError: the authority, a member's folder or a file in it is missing or damaged.
        LogRefused: the disk refused it.
    """
    folder = Path(folder)
    if not 0 <= days <= MOST_DAYS:
        raise UsageError(f"keys hold for 0 to {MOST_DAYS} days, not {days}")
    try:
        before = x509.load_pem_x509_certificate(_read(folder / _AUTHORITY_FOLDER / AUTHORITY))
        key: Any = serialization.load_pem_private_key(
            _read(folder / _AUTHORITY_FOLDER / PRIVATE_KEY), password=None
        )
    except (OSError, ValueError, TypeError) as error:
        raise UsageError(
            f"{folder / _AUTHORITY_FOLDER}: no authority ({error}): without it, make new keys for all with "
            "trilat keys new"
        ) from None
    if key.public_key() != before.public_key():
        raise UsageError(
            f"{folder / _AUTHORITY_FOLDER}: the private key is not that of the certificate"
        )
    present = [path.name for path in sorted(folder.iterdir()) if (path / MEMBERS).is_file()]
    chosen = list(members) or present
    if missing := [name for name in chosen if name not in present]:
        raise UsageError(
            f"{folder}: holds no keys of {', '.join(missing)}; it has {', '.join(present)}"
        )
    ends = datetime.datetime.now(datetime.UTC) + datetime.timedelta(days=days)
    authority = _sign_authority(key, ends)
    # all of them, or none
    renewed = {name: _renew(folder / name, before, key, ends) for name in chosen}
    for name, (certificate, listed) in renewed.items():
        write_whole(folder / name / AUTHORITY, _encode(authority), mode=0o600)
        write_whole(folder / name / CERTIFICATE, _encode(certificate), mode=0o600)
        # last: it says when the keys end
        write_whole(folder / name / MEMBERS, listed, mode=0o600)
    write_whole(folder / _AUTHORITY_FOLDER / AUTHORITY, _encode(authority), mode=0o600)
    return [folder / name for name in chosen]


def _renew(
    folder: Path, authority: x509.Certificate, key: Any, ends: datetime.datetime
) -> tuple[x509.Certificate, str]:
    """Returns the new certificate of a member, and its list of members with the new end."""
    try:
        before = x509.load_pem_x509_certificate(_read(folder / CERTIFICATE))
        before.verify_directly_issued_by(authority)
        listed = json.loads(_read(folder / MEMBERS))
        names = before.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
        certificate = _sign_member(
            subject=before.subject, own=before.public_key(), names=names, key=key, ends=ends
        )
        return certificate, _list_members(listed["member"], listed["members"], ends)
    except UsageError:
        raise
    except Exception as error:  # cryptography's errors have no common base
        raise UsageError(f"{folder}: damaged, or not of this authority ({error!r})") from None


def _make_all(folder: Path, members: Sequence[str], hosts: Sequence[str], days: int) -> None:
    ends = datetime.datetime.now(datetime.UTC) + datetime.timedelta(days=days)
    key = ec.generate_private_key(ec.SECP256R1())
    authority = _sign_authority(key, ends)
    _write(folder / _AUTHORITY_FOLDER, authority, authority, key)
    for member in members:
        own = ec.generate_private_key(ec.SECP256R1())
        certificate = _sign_member(
            subject=_name(member),
            own=own.public_key(),
            names=_alternatives(hosts),
            key=key,
            ends=ends,
        )
        _write(folder / member, authority, certificate, own)
        _put(folder / member / MEMBERS, _list_members(member, members, ends).encode())


def _list_members(member: str, members: Sequence[str], ends: datetime.datetime) -> str:
    listed = {"member": member, "members": list(members), "ends": ends.isoformat()}
    return f"{json.dumps(listed)}\n"


def _sign_authority(
    key: ec.EllipticCurvePrivateKey, ends: datetime.datetime
) -> x509.Certificate:
    constraints = x509.BasicConstraints(ca=True, path_length=0)
    builder = _certificate(_ISSUER, key.public_key(), ends)
    return builder.add_extension(constraints, critical=True).sign(key, hashes.SHA256())


def _sign_member(
    subject: x509.Name,
    own: Any,
    names: x509.SubjectAlternativeName,
    key: ec.EllipticCurvePrivateKey,
    ends: datetime.datetime,
) -> x509.Certificate:
    """Returns the certificate for a member's public key, signed by the key of the authority."""
    uses = x509.ExtendedKeyUsage(
        [ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH]
    )
    builder = _certificate(subject, own, ends).add_extension(names, critical=False)
    return builder.add_extension(uses, critical=False).sign(key, hashes.SHA256())


def _name(common: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common)])


_ISSUER = _name("trilat-net authority")


def _certificate(
    subject: x509.Name, own: Any, ends: datetime.datetime
) -> x509.CertificateBuilder:
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(_ISSUER)
        .public_key(own)
        .serial_number(x509.random_serial_number())
        .not_valid_before(datetime.datetime.now(datetime.UTC) - _BEFORE)
        .not_valid_after(ends + STOPPING_TIME)
    )


def _encode(certificate: x509.Certificate) -> bytes:
    return certificate.public_bytes(serialization.Encoding.PEM)


def _alternatives(hosts: Sequence[str]) -> x509.SubjectAlternativeName:
    names: list[x509.GeneralName] = []
    for host in dict.fromkeys((*HERE, *hosts)):
        try:
            names.append(x509.IPAddress(ipaddress.ip_address(host)))
        except ValueError:
            names.append(x509.DNSName(host))
    return x509.SubjectAlternativeName(names)


def _write(
    folder: Path,
    authority: x509.Certificate,
    certificate: x509.Certificate,
    key: ec.EllipticCurvePrivateKey,
) -> None:
    folder.mkdir(mode=0o700, parents=True)
    _put(folder / AUTHORITY, authority.public_bytes(serialization.Encoding.PEM))
    if certificate is not authority:
        _put(folder / CERTIFICATE, certificate.public_bytes(serialization.Encoding.PEM))
    private = key.private_bytes(
        serialization.Encoding.PEM,
        serialization.PrivateFormat.PKCS8,
        serialization.NoEncryption(),
    )
    _put(folder / PRIVATE_KEY, private)


def _put(path: Path, content: bytes) -> None:
    with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
        file.write(content)


def _read(path: Path) -> bytes:
    with open_regular(path) as stream:
        _refuse_of_others(path, os.fstat(stream.fileno()))
        content: bytes = stream.read(MOST_KEY_BYTES)
    return content


def _refuse_of_others(path: Path, facts: os.stat_result) -> None:
    """Refuses what another user can change; in a folder of many (sticky) nobody changes files
    of others.

    On Windows these bits do not tell who may: nothing is refused.
    """
    if sys.platform == "win32":
        return
    if os.geteuid() and facts.st_uid not in (0, os.geteuid()):
        raise UsageError(
            f"{path}: belongs to another user, who can change it: take keys of your own"
        )
    shared = stat.S_ISDIR(facts.st_mode) and facts.st_mode & stat.S_ISVTX
    if facts.st_mode & 0o022 and not shared:
        raise UsageError(
            f"{path}: others may write it, and so say who takes part: chmod go-w {path}"
        )


def read_member_keys(folder: str | Path, *, stops: bool = False) -> MemberKeys:
    """Returns the keys in a member's folder; the command is `trilat keys info`.

    >>> tn.read_member_keys(tn.create_keys("lab-keys", ["m", "s"])[0]).member
    'm'

    Args:
        folder: the folder of one member.
        stops: true if the keys serve to stop arms alone: they may have ended, while their
            certificate holds.

    Raises:
        UsageError: something is missing, has ended, or does not belong together.
    """
    folder = Path(folder)
    if (folder / _AUTHORITY_FOLDER).is_dir():
        raise UsageError(
            f"{folder}: holds the keys of all; name the folder of one member, as in {folder}/m1"
        )
    try:
        _refuse_of_others(folder, folder.stat())
        listed, *pems, private = map(
            _read, (folder / one for one in (MEMBERS, AUTHORITY, CERTIFICATE, PRIVATE_KEY))
        )
    except OSError as error:
        raise UsageError(
            f"{error.filename}: {error.strerror}: no keys of `trilat keys new`"
        ) from None
    try:
        named = json.loads(listed)
        member = named["member"]
        members = tuple(named["members"])
        authority, certificate = map(x509.load_pem_x509_certificate, pems)
        key = serialization.load_pem_private_key(private, password=None)
        ends = certificate.not_valid_after_utc
        if "ends" in named:  # keys of earlier versions end with their certificate
            ends = min(ends, datetime.datetime.fromisoformat(named["ends"]))
        certificate.verify_directly_issued_by(authority)
    except (ValueError, TypeError, KeyError, RecursionError) as error:
        raise UsageError(f"{folder}: damaged, no keys of `trilat keys new` ({error})") from None
    except Exception as error:  # cryptography's errors have no common base
        raise UsageError(
            f"{folder}: the authority has not signed this certificate ({error!r})"
        ) from None
    last = certificate.not_valid_after_utc if stops else ends
    if fault := _find_name_fault(members) or _find_fault(
        folder=folder,
        member=member,
        members=members,
        certificate=certificate,
        key=key,
        ends=last,
    ):
        raise UsageError(f"{folder}: {fault}")
    return MemberKeys(member, members, ends, _make_settings(folder.resolve(), members))


def _find_fault(
    folder: Path,
    member: str,
    members: Sequence[str],
    certificate: x509.Certificate,
    key: Any,
    ends: datetime.datetime,
) -> str:
    common = ", ".join(
        name.rfc4514_string().removeprefix("CN=") for name in certificate.subject.rdns
    )
    begins = certificate.not_valid_before_utc
    private = folder / PRIVATE_KEY
    now = datetime.datetime.now(datetime.UTC)
    for fault, text in (
        (
            read_foreign_permissions(private),
            f"{PRIVATE_KEY} can be read by others: chmod 600 {private}",
        ),
        (
            common != member,
            f"the certificate is that of {common}, and {MEMBERS} names {member}",
        ),
        (member not in members, f"{MEMBERS} does not list {member}"),
        (
            key.public_key() != certificate.public_key(),
            "the private key is not that of the certificate",
        ),
        (
            begins > now,
            f"the certificate begins on {begins:{_DATE}}: is the clock of this machine right?",
        ),
        (
            ends <= now,
            f"the certificate ended on {ends:{_DATE}}: {_RENEWAL}",
        ),
    ):
        if fault:
            return text
    return ""


def _make_settings(folder: Path, members: Sequence[str]) -> dict[str, Any]:
    files = {
        **{f"{side}_certificate": str(folder / CERTIFICATE) for side in ("listen", "connect")},
        **{f"{side}_private_key": str(folder / PRIVATE_KEY) for side in ("listen", "connect")},
    }
    tls = {
        "root_ca_certificate": str(folder / AUTHORITY),
        "enable_mtls": True,
        "verify_name_on_connect": True,
        "close_link_on_expiration": False,  # no date ends a session; see `Connection.require_keys_until`
        **files,
    }
    return {
        "transport": {
            "link": {"protocols": list(PROTOCOLS), "tls": tls},
            "unicast": {"max_sessions": MOST_SESSIONS, "accept_pending": MOST_SESSIONS},
        },
        "adminspace": {"enabled": False},
        **make_access_rules(members),
    }
