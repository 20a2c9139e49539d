"""Keys of members: who may use the keys, what becomes of them, and what is printed of them."""

import json
import os
import shutil
import subprocess
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest

from tests.cli.running import COMMAND, PLAIN, trilat
from trilat_net.app.running_session import hand, session
from trilat_net.errors import LogRefused, TrilatError, UsageError
from trilat_net.net import member_keys
from trilat_net.net.arm_client import ArmClient, SwitchClient
from trilat_net.net.member_keys import MEMBERS, create_keys, read_member_keys

MEMBERS_MADE = ("m1", "m2", "s", "recorder", "operator", "router", "bridge")


@pytest.fixture(scope="module")
def key_folders(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Returns a folder with the keys of a session in `k`."""
    folder = tmp_path_factory.mktemp("keys")
    create_keys(folder / "k", MEMBERS_MADE)
    return folder


@pytest.fixture
def keys(key_folders: Path, tmp_path: Path) -> Path:
    shutil.copytree(key_folders, tmp_path / "made")
    return tmp_path / "made" / "k"


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
    with pytest.raises(
        UsageError, match=f"keys: these are the keys of {whose}; the keys of {due} are needed"
    ):
        act(key_folders / "k" / whose)


def test_deeply_nested_lists_of_members_are_refused(keys: Path) -> None:
    (keys / "m1" / MEMBERS).write_text("[" * 9999)
    with pytest.raises(UsageError, match="the keys are damaged, or were not made by"):
        read_member_keys(keys / "m1")


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


def test_python_makes_keys_for_so_many_days(tmp_path: Path) -> None:
    for days in (-1, 3651, 10**9):
        with pytest.raises(UsageError, match=f"0 to 3650 days, not {days}"):
            create_keys(tmp_path / "k", ["m1"], days=days)


@pytest.mark.parametrize("failing", range(1, 11))
def test_keys_are_complete_or_absent(
    failing: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The disk refuses the n-th file, or Ctrl-C comes there: earlier files are removed too."""
    put = member_keys._write_new_file
    written: list[Path] = []

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
            assert f"{tmp_path / 'k'} cannot be written: No space left on device" in str(
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
    command = [*COMMAND, "site", "m1", "--scenario", "paper", "--join-timeout", "0"]
    command += ["--keys", str(key_folders / "k" / "m1")]
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
