"""Connections and Zenoh configurations that are refused before a connection is opened."""

from pathlib import Path
from typing import Any

import msgspec
import pytest

from tests.refusals.corpus import Case, names_file, parametrize_cases
from trilat_net.errors import UsageError
from trilat_net.net.connection import Connection
from trilat_net.net.zenoh_bus import read_zenoh_file
from trilat_net.net.zenoh_config import ZenohFile

NAME = "mine.json5"


class ConnectionCase(Case, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of a member of a session that contradict each other or the member's own file."""

    listen: list[str] | None = None
    connect: list[str] | None = None
    routers: list[str] | None = None
    file: dict[str, Any] = msgspec.field(default_factory=dict)
    """Settings of the Zenoh configuration of the member. Empty if there is none."""


@parametrize_cases("connections.toml", ConnectionCase)
def test_contradicting_connections_are_refused(case: ConnectionCase) -> None:
    zenoh_settings = ZenohFile.check(NAME, case.file, lambda _: "") if case.file else None
    defaults = {"listen_else": ["tcp/127.0.0.1:1"], "connect_else": ["tcp/127.0.0.1:2"]}
    with pytest.raises(UsageError) as caught:
        Connection.of_member(
            case.listen, case.connect, case.routers, zenoh_settings, **defaults
        )
    case.check_message(str(caught.value), caught.value.exit_code)


class ZenohCase(Case, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A Zenoh configuration file, as text or in hexadecimal digits, or a missing file."""

    text: str | None = None
    hex: str = ""


@parametrize_cases("zenoh_files.toml", ZenohCase)
def test_wrong_zenoh_files_are_refused(case: ZenohCase, tmp_path: Path) -> None:
    file = tmp_path / NAME
    if case.text is not None:
        file.write_text(case.text, encoding="utf-8")
    if case.hex:
        file.write_bytes(bytes.fromhex(case.hex))
    with pytest.raises(UsageError) as caught:
        read_zenoh_file(file)
    message = str(caught.value)
    assert names_file(message, file)
    assert "/root/" not in message
    case.check_message(message, caught.value.exit_code)
