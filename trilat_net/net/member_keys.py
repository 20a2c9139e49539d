"""The keys of a session's members: made by `trilat keys new`, used by every member that is given its folder.

Invariant: a private authority signs one certificate per member, which ends after some days, and is kept
apart. A member's folder holds its own key, which nobody else may read, its certificate, that of the
authority, and the list of members, from which its access rules follow.
"""

import datetime
import ipaddress
import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from ..errors import UsageError
from ..files import open_regular
from .access_rules import MOST_SESSIONS, PROTOCOLS, make_access_rules

AUTHORITY, CERTIFICATE, PRIVATE_KEY, MEMBERS = (
    "authority.pem",
    "certificate.pem",
    "private.key",
    "members.json",
)
_AUTHORITY_FOLDER = "authority"
HERE = ("localhost", "127.0.0.1", "::1")
"""Names of the own machine, which every certificate holds."""
_BEFORE = datetime.timedelta(hours=1)
"""Clocks of machines may differ by so much."""
MOST_KEY_BYTES = 65_536
"""Of a file of keys; the rest of a longer one is not read."""


class MemberKeys(NamedTuple):
    """A member's keys.

    Attributes:
        member: whose they are.
        members: all that were made with them.
        ends: when the certificate ends, in UTC.
        settings: of Zenoh, see `make_zenoh_config`.
    """

    member: str
    members: tuple[str, ...]
    ends: datetime.datetime
    settings: dict[str, Any]


def create_keys(
    folder: str | Path, members: Sequence[str], hosts: Sequence[str] = (), days: int = 30
) -> list[Path]:
    """Makes an authority and a folder of keys for each member; returns the folders, as `trilat keys new`.

    >>> [one.name for one in tn.create_keys("keys", ["m", "s", "recorder"])]
    ['m', 's', 'recorder']

    Args:
        folder: where they are made; it must not exist, or be empty.
        members: sites, and of `recorder`, `operator`, `router` those that there are.
        hosts: names and addresses at which members listen, besides this machine's own.
        days: how long the certificates hold.

    Raises:
        UsageError: a name cannot be one, or the folder is not empty.
    """
    folder = Path(folder)
    for name in members:
        if not name or not all(c.isalnum() or c in "_-" for c in name) or name == _AUTHORITY_FOLDER:
            raise UsageError(f"a member's name is letters, digits, _ and -, not {name!r}")
    if len(set(members)) < len(members):
        raise UsageError("every member is named once")
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise UsageError(f"{folder}: there is something already; keys are never replaced, name a new folder")
    ends = datetime.datetime.now(datetime.UTC) + datetime.timedelta(days=days)
    key, issuer = ec.generate_private_key(ec.SECP256R1()), _name("trilat-net authority")
    constraints = x509.BasicConstraints(ca=True, path_length=0)
    authority = (
        _certificate(issuer, issuer, key, ends)
        .add_extension(constraints, critical=True)
        .sign(key, hashes.SHA256())
    )
    _write(folder / _AUTHORITY_FOLDER, authority, authority, key)
    made = []
    for member in members:
        own = ec.generate_private_key(ec.SECP256R1())
        builder = _certificate(_name(member), issuer, own, ends).add_extension(
            _alternatives(hosts), critical=False
        )
        uses = x509.ExtendedKeyUsage([ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH])
        certificate = builder.add_extension(uses, critical=False).sign(key, hashes.SHA256())
        _write(folder / member, authority, certificate, own)
        listed = json.dumps({"member": member, "members": list(members)})
        (folder / member / MEMBERS).write_text(listed + "\n", encoding="utf-8")
        made.append(folder / member)
    return made


def _name(common: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common)])


def _certificate(
    subject: x509.Name, issuer: x509.Name, key: ec.EllipticCurvePrivateKey, ends: datetime.datetime
) -> x509.CertificateBuilder:
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(datetime.datetime.now(datetime.UTC) - _BEFORE)
        .not_valid_after(ends)
    )


def _alternatives(hosts: Sequence[str]) -> x509.SubjectAlternativeName:
    names: list[x509.GeneralName] = []
    for host in dict.fromkeys((*HERE, *hosts)):
        try:
            names.append(x509.IPAddress(ipaddress.ip_address(host)))
        except ValueError:
            names.append(x509.DNSName(host))
    return x509.SubjectAlternativeName(names)


def _write(
    folder: Path, authority: x509.Certificate, certificate: x509.Certificate, key: ec.EllipticCurvePrivateKey
) -> None:
    folder.mkdir(mode=0o700, parents=True)
    (folder / AUTHORITY).write_bytes(authority.public_bytes(serialization.Encoding.PEM))
    if certificate is not authority:
        (folder / CERTIFICATE).write_bytes(certificate.public_bytes(serialization.Encoding.PEM))
    private = key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    with os.fdopen(os.open(folder / PRIVATE_KEY, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
        file.write(private)


def _read(path: Path) -> bytes:
    with open_regular(path) as stream:
        content: bytes = stream.read(MOST_KEY_BYTES)
    return content


def read_member_keys(folder: str | Path) -> MemberKeys:
    """Returns the keys in a member's folder; the command is `trilat keys info`.

    >>> tn.read_member_keys(tn.create_keys("lab-keys", ["m", "s"])[0]).member
    'm'

    Raises:
        UsageError: something is missing, has ended, or does not belong together.
    """
    folder = Path(folder)
    if (folder / _AUTHORITY_FOLDER).is_dir():
        raise UsageError(f"{folder}: holds the keys of all; name the folder of one member, as in {folder}/m1")
    try:
        listed = json.loads(_read(folder / MEMBERS))
        member, members = str(listed["member"]), tuple(map(str, listed["members"]))
        authority, certificate = (
            x509.load_pem_x509_certificate(_read(folder / name)) for name in (AUTHORITY, CERTIFICATE)
        )
        key = serialization.load_pem_private_key(_read(folder / PRIVATE_KEY), password=None)
        certificate.verify_directly_issued_by(authority)
    except OSError as error:
        raise UsageError(f"{error.filename}: {error.strerror}: no keys of `trilat keys new`") from None
    except (ValueError, TypeError, KeyError) as error:
        raise UsageError(f"{folder}: damaged, no keys of `trilat keys new` ({error})") from None
    except Exception as error:  # cryptography's errors have no common base
        raise UsageError(f"{folder}: the authority has not signed this certificate ({error!r})") from None
    mode = (folder / PRIVATE_KEY).stat().st_mode
    common = certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)[0].value
    ends = certificate.not_valid_after_utc
    faults = {
        f"{PRIVATE_KEY} can be read by others: chmod 600 {folder / PRIVATE_KEY}": mode & 0o077,
        f"the certificate is that of {common!s}, and {MEMBERS} names {member}": common != member,
        f"{MEMBERS} does not list {member}": member not in members,
        "the private key is not that of the certificate": key.public_key() != certificate.public_key(),
        f"the certificate ended on {ends:%Y-%m-%d %H:%M} UTC: make new keys for all with trilat keys new": (
            ends <= datetime.datetime.now(datetime.UTC)
        ),
    }
    for text, fault in faults.items():
        if fault:
            raise UsageError(f"{folder}: {text}")
    return MemberKeys(member, members, ends, _make_settings(folder.resolve(), members))


def _make_settings(folder: Path, members: Sequence[str]) -> dict[str, Any]:
    files = {
        **{f"{side}_certificate": str(folder / CERTIFICATE) for side in ("listen", "connect")},
        **{f"{side}_private_key": str(folder / PRIVATE_KEY) for side in ("listen", "connect")},
    }
    tls = {
        "root_ca_certificate": str(folder / AUTHORITY),
        "enable_mtls": True,
        "verify_name_on_connect": True,
        "close_link_on_expiration": True,
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
