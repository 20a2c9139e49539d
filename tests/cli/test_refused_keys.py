"""Unsuitable keys: every row is a command with a folder of keys, and the reason for the
refusal.

Each refusal comes before a connection is opened.
"""

import json
import os
import shutil
import subprocess
from collections.abc import Callable, Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest

from tests.cli.running import COMMAND, PLAIN, trilat
from trilat_net.app.running_session import hand, session
from trilat_net.errors import LogRefused, TrilatError, UsageError
from trilat_net.net import member_keys
from trilat_net.net.arm_client import ArmClient, SwitchClient
from trilat_net.net.member_keys import (
    CERTIFICATE,
    MEMBERS,
    PRIVATE_KEY,
    create_keys,
    read_member_keys,
)

MEMBERS_MADE = ("m1", "m2", "s", "recorder", "operator", "router", "bridge")
AUTHORITY = "authority.pem"
Change = Callable[[Path], object]


@pytest.fixture(scope="module")
def key_folders(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Makes keys of a session, and as `old`, `early` and `others` keys that have ended, begin
    later, or are foreign.
    """
    folder = tmp_path_factory.mktemp("keys")
    create_keys(folder / "k", MEMBERS_MADE)
    create_keys(folder / "others", MEMBERS_MADE)
    create_keys(folder / "old", MEMBERS_MADE, days=0)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(member_keys, "_CLOCK_TOLERANCE", -timedelta(days=2))
        create_keys(folder / "early", MEMBERS_MADE)
    return folder


@pytest.fixture
def keys(key_folders: Path, tmp_path: Path) -> Path:
    shutil.copytree(key_folders, tmp_path / "made")
    return tmp_path / "made" / "k"


SITE = ("site", "m1", "--scenario", "paper", "--keys")
RECORD = ("record", "--session", "paper", "--keys")
TWO_NAMES = "--keys: these are the keys of {}; the keys of {} are needed"

OF_ANOTHER = [
    (("site", "m1", "--scenario", "paper"), "m2", "m1"),
    (("site", "m1", "--scenario", "paper"), "recorder", "m1"),
    (("site", "m1", "--scenario", "paper"), "operator", "m1"),
    (("site", "s", "--scenario", "paper"), "router", "s"),
    (("record", "--session", "paper"), "m1", "recorder"),
    (("record", "--session", "paper"), "operator", "recorder"),
    (("router",), "m1", "router"),
    (("set", "--session", "paper", "link", "m1->s", "--delay", "1ms"), "m1", "operator"),
    (("enable", "--session", "paper"), "m1", "operator"),
    (("reset", "--session", "paper", "s"), "recorder", "operator"),
    (("stop", "--session", "paper", "--end"), "s", "operator"),
    (("watch", "--session", "paper"), "m1", "operator"),
    (("live", "--session", "paper"), "recorder", "operator"),
    (("ros2", "--session", "paper"), "operator", "bridge"),
]


@pytest.mark.parametrize(
    ("arguments", "whose", "due"), OF_ANOTHER, ids=lambda value: str(value)[:40]
)
def test_commands_take_the_keys_of_their_member(
    arguments: Sequence[str], whose: str, due: str, key_folders: Path, tmp_path: Path
) -> None:
    insertion = arguments.index("link") if "link" in arguments else len(arguments)
    command = [
        *arguments[:insertion],
        "--keys",
        str(key_folders / "k" / whose),
        *arguments[insertion:],
    ]
    trilat(*command, cwd=tmp_path).refuses(TWO_NAMES.format(whose, due))
    assert list(tmp_path.iterdir()) == []


FROM_PYTHON = [
    (lambda keys: hand("paper", "m1", keys=keys).__enter__(), "m1", "operator"),
    (lambda keys: session("paper", keys=keys).enable(), "m1", "operator"),
    (lambda keys: session("paper", keys=keys).end(), "recorder", "operator"),
    (lambda keys: session("paper", keys=keys).set_link("m1->s", delay_ms=1), "s", "operator"),
    (
        lambda keys: ArmClient.connected("two_sites", "s", ["tls/127.0.0.1:9"], keys),
        "operator",
        "s",
    ),
    (
        lambda keys: SwitchClient.connected("two_sites", "s", ["tls/127.0.0.1:9"], keys),
        "s",
        "operator",
    ),
]


@pytest.mark.parametrize(("act", "whose", "due"), FROM_PYTHON)
def test_python_takes_the_keys_of_its_member(
    act: Any, whose: str, due: str, key_folders: Path
) -> None:
    with pytest.raises(UsageError, match=TWO_NAMES.removeprefix("--").format(whose, due)):
        act(key_folders / "k" / whose)


ENDPOINTS = [
    ("--listen", "tcp/127.0.0.1:7447", "with --keys an endpoint must be encrypted"),
    ("--listen", "tcp/[::1]:7447", "with --keys an endpoint must be encrypted"),
    ("--listen", "tcp/192.0.2.1:7447", "with --keys an endpoint must be encrypted"),
    ("--connect", "tcp/localhost:7447", "with --keys an endpoint must be encrypted"),
    ("--connect", "unixsock-stream//tmp/x", "with --keys an endpoint must be encrypted"),
    ("--connect", "udp/127.0.0.1:7447", "UDP is not supported"),
    ("--router", "tcp/127.0.0.1:7447", "with --keys an endpoint must be encrypted"),
    (
        "--connect",
        "tls/127.0.0.1:7447#verify_name_on_connect=false",
        "--keys sets the encryption",
    ),
]


@pytest.mark.parametrize(("option", "place", "reason"), ENDPOINTS)
def test_endpoints_with_keys_are_encrypted_as_stated(
    option: str, place: str, reason: str, key_folders: Path, tmp_path: Path
) -> None:
    trilat(*SITE, key_folders / "k" / "m1", option, place, cwd=tmp_path).refuses(place, reason)


ZENOH_FILES = [
    (
        '{ listen: { endpoints: ["tcp/127.0.0.1:7447"] } }',
        "with --keys an endpoint must be encrypted",
    ),
    (
        "{ transport: { link: { protocols: ['tcp', 'tls'] } } }",
        "transport/link/protocols is also set by --keys",
    ),
    (
        "{ transport: { link: { tls: { enable_mtls: false } } } }",
        "transport/link/tls is also set by --keys",
    ),
    ("{ access_control: { enabled: false } }", "access_control is also set by --keys"),
]


@pytest.mark.parametrize(("text", "reason"), ZENOH_FILES)
def test_a_users_zenoh_settings_cannot_loosen_keys(
    text: str, reason: str, key_folders: Path, tmp_path: Path
) -> None:
    file = tmp_path / "own.json5"
    file.write_text(text)
    trilat(*SITE, key_folders / "k" / "m1", "--zenoh-config", file, cwd=tmp_path).refuses(
        reason
    )


def use_keys_of(name: str, source: str) -> Change:
    return lambda keys: (keys / "m1" / name).write_bytes(
        (keys.parent / source / name).read_bytes()
    )


def change_facts(**facts: object) -> Change:
    def change(keys: Path) -> None:
        listed = json.loads((keys / "m1" / MEMBERS).read_text())
        (keys / "m1" / MEMBERS).write_text(json.dumps({**listed, **facts}))

    return change


def mode(name: str, bits: int) -> Change:
    return lambda keys: (keys / "m1" / name).chmod(bits)


def whole(source: str) -> Change:
    def change(keys: Path) -> None:
        shutil.rmtree(keys / "m1")
        (keys.parent / source / "m1").rename(keys / "m1")

    return change


SPOILT: list[tuple[Change, str]] = [
    (mode("", 0o777), "and so decide who takes part; protect the keys with: chmod go-w"),
    (mode("", 0o770), "other users can write to this path"),
    (mode(MEMBERS, 0o666), "members.json: other users can write to this path"),
    (mode(MEMBERS, 0o620), "members.json: other users can write to this path"),
    (mode(AUTHORITY, 0o664), "authority.pem: other users can write to this path"),
    (mode(CERTIFICATE, 0o646), "certificate.pem: other users can write to this path"),
    (
        mode(PRIVATE_KEY, 0o640),
        "other users can read private.key; protect the key with: chmod 600",
    ),
    (lambda keys: (keys / "m1" / MEMBERS).unlink(), "members.json: No such file"),
    (lambda keys: (keys / "m1" / PRIVATE_KEY).unlink(), "private.key: No such file"),
    (
        lambda keys: (keys / "m1" / MEMBERS).write_text("secret"),
        "the keys are damaged, or were not made by `trilat keys new`",
    ),
    (
        lambda keys: (keys / "m1" / MEMBERS).write_text("[" * 9999),
        "the keys are damaged, or were not made by `trilat keys new`",
    ),
    (
        lambda keys: (keys / "m1" / CERTIFICATE).write_text("secret"),
        "the keys are damaged, or were not made by `trilat keys new`",
    ),
    (change_facts(member="m2"), "the certificate is for m1, but members.json names m2"),
    (change_facts(members=["m2", "s"]), "members.json does not list m1"),
    (change_facts(members=["m1", "*"]), "a member's name must have 1 to 64 characters"),
    (change_facts(members=["m1", "m1"]), "each member once"),
    (change_facts(members=["m1", 7]), "a member's name must have 1 to 64 characters"),
    (use_keys_of(CERTIFICATE, "k/m2"), "the certificate is for m2, but members.json names m1"),
    (use_keys_of(PRIVATE_KEY, "k/m2"), "the private key and the certificate do not match"),
    (use_keys_of(AUTHORITY, "others/m1"), "the authority has not signed this certificate"),
    (use_keys_of(CERTIFICATE, "others/m1"), "the authority has not signed this certificate"),
    (whole("old"), "the keys expired on"),
    (whole("early"), "the certificate is not valid before"),
]


@pytest.mark.parametrize(
    ("change", "reason"), SPOILT, ids=[reason[:40] for _, reason in SPOILT]
)
def test_spoilt_keys_are_refused(change: Change, reason: str, keys: Path) -> None:
    read_member_keys(keys / "m1")
    change(keys)
    done = trilat(*SITE, keys / "m1", cwd=keys)
    done.refuses(reason)
    assert "secret" not in done.err


def test_the_folder_of_all_keys_is_no_member(key_folders: Path, tmp_path: Path) -> None:
    trilat(*RECORD, key_folders / "k", cwd=tmp_path).refuses(
        "has the keys of all members; name the folder of one member"
    )


def test_folders_with_the_sticky_bit_are_accepted(keys: Path) -> None:
    """The volumes of containers are such folders."""
    (keys / "m1").chmod(0o1777)
    assert read_member_keys(keys / "m1").member == "m1"


def test_files_of_another_user_are_refused(
    key_folders: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whoever may write the folder above could replace the folder of keys."""
    owner = (key_folders / "k" / "m1" / MEMBERS).stat()
    theirs = os.stat_result((owner.st_mode, *owner[1:4], 65533, *owner[5:10]))
    monkeypatch.setattr(os, "geteuid", lambda: 65534)
    with pytest.raises(UsageError, match="belongs to another user, who can change the keys"):
        member_keys._check_permissions(key_folders / MEMBERS, theirs)


NEW = [
    (["m1", "--host", "*"], "single host name or address, without a port, not '*'"),
    (["m1", "--host", "*.example"], "single host name or address"),
    (["m1", "--host", "0.0.0.0"], "single host name or address"),
    (["m1", "--host", "::"], "single host name or address"),
    (["m1", "--host", "10.0.0.0/8"], "single host name or address"),
    (["m1", "--host", "robot:7447"], "single host name or address"),
    (["m1", "--host", ""], "single host name or address"),
    (["m1", "--host", "robot.example\n"], "single host name or address"),
    (["*"], "a member's name must have 1 to 64 characters"),
    (["m" * 65], "a member's name must have 1 to 64 characters"),
    (["authority"], "and must not be authority"),
    (["../m1"], "a member's name must have 1 to 64 characters"),
    (["m1", "m1"], "each member once"),
]


@pytest.mark.parametrize(("arguments", "reason"), NEW, ids=lambda value: str(value)[:40])
def test_invalid_requests_for_keys_leave_no_files(
    arguments: list[str], reason: str, tmp_path: Path
) -> None:
    trilat("keys", "new", "k", *arguments, cwd=tmp_path).refuses(reason)
    assert list(tmp_path.iterdir()) == []


def test_keys_are_never_replaced(keys: Path) -> None:
    before = sorted(keys.rglob("*"))
    trilat("keys", "new", keys, "m1", cwd=keys).refuses(
        "keys are never replaced: name a new folder"
    )
    assert sorted(keys.rglob("*")) == before


def test_python_makes_keys_for_so_many_days(tmp_path: Path) -> None:
    for days in (-1, 3651, 10**9):
        with pytest.raises(UsageError, match=f"0 to 3650 days, not {days}"):
            create_keys(tmp_path / "k", ["m1"], days=days)


@pytest.mark.parametrize("failing", range(1, 11))
def test_keys_are_complete_or_absent(
    failing: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The disk refuses the n-th file, or Ctrl-C comes there: earlier files are removed too."""
    put, written = member_keys._write_new_file, list[Path]()

    def refuse(error: BaseException) -> Callable[[Path, bytes], None]:
        def act(path: Path, content: bytes) -> None:
            if len(written) + 1 == failing:
                raise error
            written.append(path)
            put(path, content)

        return act

    for error, kind in (
        (OSError(28, "No space left on device"), LogRefused),
        (KeyboardInterrupt(),) * 2,
    ):
        written.clear()
        monkeypatch.setattr(member_keys, "_write_new_file", refuse(error))
        caught: Any = kind if isinstance(kind, type) else KeyboardInterrupt
        with pytest.raises(caught) as raised:
            create_keys(tmp_path / "k", ["m1", "m2"])
        if isinstance(raised.value, TrilatError):
            assert f"{tmp_path / 'k'}: cannot be written: No space left on device" in str(
                raised.value
            )
        assert list(tmp_path.iterdir()) == []


def test_keys_are_private_whatever_the_umask(tmp_path: Path) -> None:
    before = os.umask(0)
    try:
        create_keys(
            tmp_path / "k", ["m1", "recorder"], ["192.0.2.1", "robot.example", "2001:db8::1"]
        )
    finally:
        os.umask(before)
    assert {path.stat().st_mode & 0o077 for path in (tmp_path / "k").rglob("*")} == {0}
    assert read_member_keys(tmp_path / "k" / "m1").ends > datetime.now(UTC) + timedelta(days=29)


def test_valid_keys_are_accepted(key_folders: Path, tmp_path: Path) -> None:
    """By a process of its own, which listens over TLS instead of TCP, and waits for the others."""
    command = [*COMMAND, *SITE, str(key_folders / "k" / "m1"), "--join-timeout", "0"]
    done = subprocess.run(
        command,
        cwd=tmp_path,
        env={**PLAIN, "NUMBA_DISABLE_JIT": "1"},
        capture_output=True,
        text=True,
    )
    assert "m1: others connect to tls/127.0.0.1:" in done.stdout
    assert "did not join" in done.stderr
    assert done.returncode == 2


def test_the_table_has_forty_rows() -> None:
    assert sum(map(len, (OF_ANOTHER, FROM_PYTHON, ENDPOINTS, ZENOH_FILES, SPOILT, NEW))) >= 40


def test_printed_settings_agree_with_key_rules(tmp_path: Path) -> None:
    """A few lines for a person, the settings of Zenoh on request, and the same in JSON."""
    create_keys(tmp_path / "k", MEMBERS_MADE, ["192.0.2.7"])
    for member in MEMBERS_MADE:
        folder = str(tmp_path / "k" / member)
        lines = trilat("keys", "info", folder, cwd=tmp_path).succeeds().splitlines()
        assert len(lines) <= 6
        assert f" {member}, for a session with" in lines[0]
        assert lines[1].startswith("valid until ")
        assert lines[2].endswith(": localhost, 127.0.0.1, ::1, 192.0.2.7")
        rules = json.loads(trilat("keys", "info", folder, "--rules", cwd=tmp_path).succeeds())
        whole = json.loads(trilat("keys", "info", folder, "--json", cwd=tmp_path).succeeds())
        assert {"member", "members", "until", "zenoh"} < set(whole)
        assert whole["zenoh"] == rules
        own_keys = {
            key
            for rule in rules["access_control"]["rules"]
            if rule["id"].rpartition(" ")[0] == member
            and "ingress" in rule["flows"]
            and {"put", "query"} & set(rule["messages"])
            for key in rule["key_exprs"]
        }
        orders_allowed = any(key.endswith("/*/set") for key in own_keys)
        assert any("all orders" in line for line in lines) == orders_allowed
        switch_allowed = any(key.endswith("/enable") for key in own_keys)
        assert any("dead-man switch" in line for line in lines) == switch_allowed
