"""Allowed and refused settings of a person's own Zenoh configuration."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from trilat_net.errors import UsageError
from trilat_net.net.zenoh_bus import MAX_DEPTH, read_zenoh_file
from trilat_net.net.zenoh_config import (
    REQUIREMENTS,
    ZenohFile,
    make_zenoh_config,
    merge_settings,
)

SOURCE = "mine.json5"


def nest_value(path: str, value: object) -> Any:
    for key in reversed(path.split("/")):
        value = {key: value}
    return value


def look_up(settings: Mapping[str, Any], path: str) -> object:
    value: Any = settings
    for key in path.split("/"):
        value = value[key]
    return value


def check_stated(stated: object) -> ZenohFile:
    return ZenohFile.check(SOURCE, stated, lambda _: "")


WRONG = {
    "connect/timeout_ms": 0,
    "connect/exit_on_failure": True,
    "listen/timeout_ms": -1,
    "listen/exit_on_failure": {"peer": False},
    "scouting/multicast/enabled": True,
    "scouting/gossip/enabled": True,
    "transport/link/tx/queue/congestion_control/drop/wait_before_drop": 1000,
    "transport/link/tx/queue/batching/enabled": False,
    "transport/link/tx/batch_size": 1400,
    "transport/link/tx/lease": 500,
    "transport/unicast/lowlatency": True,
    "transport/shared_memory/enabled": True,
    "qos/publication": [{"key_exprs": ["**"], "config": {"congestion_control": "block"}}],
    "qos/network": [{"messages": ["put"], "flows": ["egress"], "overwrite": {"express": True}}],
    "downsampling": [
        {"messages": ["put"], "flows": ["egress"], "rules": [{"key_expr": "**", "freq": 1}]}
    ],
    "low_pass_filter": [
        {"messages": ["put"], "flows": ["egress"], "key_exprs": ["**"], "size_limit": 1}
    ],
    **{path: 2 for path in REQUIREMENTS if "/queue/size/" in path},
}


@pytest.mark.parametrize("path", REQUIREMENTS)
def test_settings_against_needs_are_refused_with_reason(path: str) -> None:
    with pytest.raises(UsageError) as refused:
        check_stated(nest_value(path, WRONG[path]))
    assert str(refused.value).startswith(f"{SOURCE}: {path}: ")
    assert f" must be {REQUIREMENTS[path][1]}" in str(refused.value)


@given(data=st.data())
def test_accepted_files_keep_the_sessions_needs(data: st.DataObject) -> None:
    """Any file is refused, or the needs hold in the resulting configuration."""
    stated: dict[str, Any] = {}
    for path in data.draw(st.lists(st.sampled_from(sorted(REQUIREMENTS)), max_size=4)):
        value = data.draw(
            st.sampled_from(
                [WRONG[path], 0, 1, 16, 5000, 65_535, True, False, None, [], {}, "", 15.9, "16"]
            )
        )
        stated = merge_settings(stated, nest_value(path, value))
    try:
        file = check_stated(stated)
    except UsageError:
        return
    settings = make_zenoh_config([], [], "peer", file.settings)
    plain = make_zenoh_config([], [])
    for path, (holds, _) in REQUIREMENTS.items():
        try:
            value = look_up(settings, path)
        except KeyError:
            continue  # neither stated nor set: Zenoh's default is what is needed
        assert holds(value) or value == look_up(plain, path), path


def test_unneeded_settings_are_kept() -> None:
    checked_file = check_stated(
        {
            "transport": {
                "link": {"tx": {"lease": 9_000, "keep_alive": 3}, "protocols": ["tls"]},
                "unicast": {"open_timeout": 700},
                "auth": {"usrpwd": {"user": "u", "password": "p"}},
            },
            "connect": {"retry": {"period_max_ms": 900}},
            "access_control": {"enabled": False},
        }
    ).settings
    settings = make_zenoh_config(["tcp/a:1"], ["tcp/b:1"], "peer", checked_file)
    assert look_up(settings, "transport/link/tx/lease") == 9_000
    assert look_up(settings, "transport/link/protocols") == ["tls"]
    assert look_up(settings, "transport/unicast/open_timeout") == 700
    assert look_up(settings, "transport/unicast/accept_timeout") == 2_000
    assert look_up(settings, "transport/auth/usrpwd/password") == "p"
    retry = {"period_init_ms": 100, "period_max_ms": 900, "period_increase_factor": 1.5}
    assert look_up(settings, "connect/retry") == retry
    assert look_up(settings, "connect/endpoints") == ["tcp/b:1"]
    assert look_up(settings, "access_control/enabled") is False


STOCK = Path(__file__).with_name("stock_session.json5")
"""What a machine of ROS 2 has."""


def test_stock_files_are_refused_for_gossip_only() -> None:
    """All other settings that a session makes have the session's values there."""
    with pytest.raises(UsageError) as refused:
        read_zenoh_file(STOCK)
    assert str(refused.value).startswith(
        f"{STOCK}: scouting/gossip/enabled: true must be false"
    )
    assert str(refused.value).count("must be") == 1


def test_stock_files_without_gossip_are_accepted(tmp_path: Path) -> None:
    path = tmp_path / "session.json5"
    path.write_text(
        STOCK.read_text().replace("gossip: { enabled: true }", "gossip: { enabled: false }")
    )
    file = read_zenoh_file(path)
    assert file.endpoints("connect", "peer") == ["tcp/127.0.0.1:17447"]
    settings = make_zenoh_config(
        [], file.endpoints("connect", "peer") or [], "peer", file.settings
    )
    assert look_up(settings, "transport/unicast/open_timeout") == 60_000
    plain = make_zenoh_config([], [])
    for key in ("connect/timeout_ms", "connect/exit_on_failure", "listen/exit_on_failure"):
        assert look_up(settings, key) == look_up(plain, key)


@pytest.mark.parametrize("mode", ["peer", "client", "router"])
def test_values_equal_to_the_sessions_are_accepted(mode: str) -> None:
    """A value may stand once, or by mode; values of another mode are refused."""
    plain = make_zenoh_config([], [], mode)  # type: ignore[arg-type]
    for key in ("connect/timeout_ms", "connect/exit_on_failure", "listen/exit_on_failure"):
        used = look_up(plain, key)
        other = {-1: 0, 0: -1}[used] if key == "connect/timeout_ms" else not used
        assert check_stated({"mode": mode, **nest_value(key, used)}).mode == mode
        assert check_stated(nest_value(key, {mode: used})).mode == ""
        for wrong in ({"mode": mode, **nest_value(key, other)}, nest_value(key, {mode: other})):
            with pytest.raises(
                UsageError, match=f"{key}: .* must be left out, or as a session sets it"
            ):
                check_stated(wrong)
    with pytest.raises(UsageError, match="listen/timeout_ms"):
        check_stated(nest_value("listen/timeout_ms", False))


def test_all_contradicting_keys_are_named_at_once() -> None:
    stated: dict[str, Any] = {
        "transport": {"link": {"tls": {"root_ca_certificate": "/nowhere.pem"}}}
    }
    for path, value in WRONG.items():
        stated = merge_settings(stated, nest_value(path, value))
    stated["access_control"] = {"default_permission": "deny"}
    with pytest.raises(UsageError) as refused:
        check_stated(stated)
    message = str(refused.value)
    assert message.startswith(f"{SOURCE}: {len(WRONG) + 2} settings cannot be accepted: ")
    assert [key for key in WRONG if f"{key}: " not in message] == []
    assert "root_ca_certificate: /nowhere.pem cannot be read" in message
    assert "access_control: must have `enabled: true`" in message


def test_all_keys_refused_by_zenoh_are_named(tmp_path: Path) -> None:
    path = tmp_path / SOURCE
    path.write_text("{mod: 'peer', transport: {link: {foo: 1, tx: {lease: 'x'}}}, connect: 3}")
    with pytest.raises(UsageError) as refused:
        read_zenoh_file(path)
    message = str(refused.value)
    assert "4 settings cannot be accepted" in message
    for part in (
        "mod: Zenoh has no such key; did you mean 'mode'?",
        "connect: invalid type",
        "link/foo",
        "tx/lease",
    ):
        assert part in message


def test_null_says_nothing() -> None:
    assert check_stated(
        {"id": None, "transport": {"link": {"tx": {"lease": None}}}}
    ).settings == {"transport": {"link": {"tx": {}}}}


def test_endpoints_and_mode_may_depend_on_mode() -> None:
    file = check_stated(
        {
            "mode": "client",
            "connect": {"endpoints": ["tcp/a:1"]},
            "listen": {"endpoints": {"router": ["tcp/b:1"], "peer": "tcp/c:1"}},
        }
    )
    assert file.mode == "client"
    assert file.settings == {"connect": {}, "listen": {}}
    assert file.endpoints("connect", "peer") == ["tcp/a:1"]
    assert file.endpoints("listen", "router") == ["tcp/b:1"]
    assert file.endpoints("listen", "peer") == ["tcp/c:1"]
    assert file.endpoints("listen", "client") is None
    assert ZenohFile("").endpoints("listen", "peer") is None


def test_unreadable_certificates_are_reported_beforehand(tmp_path: Path) -> None:
    key = "transport/link/tls/root_ca_certificate"
    with pytest.raises(
        UsageError, match=rf"{SOURCE}: {key}: {tmp_path}/none.pem cannot be read: No such"
    ):
        check_stated(nest_value(key, f"{tmp_path}/none.pem"))
    with pytest.raises(UsageError, match="dictionary_file"):
        check_stated(nest_value("transport/auth/usrpwd/dictionary_file", str(tmp_path)))
    (tmp_path / "ca.pem").write_text("")
    assert check_stated(nest_value(key, f"{tmp_path}/ca.pem")).settings


def test_json5_is_read_as_in_zenoh(tmp_path: Path) -> None:
    path = tmp_path / SOURCE
    path.write_text(
        "\ufeff{ // comment\n 'mode': \"client\", transport: {link: {tx: {lease: 0x1f40,},},}, }\n//"
    )
    file = read_zenoh_file(path)
    assert (file.source, file.mode) == (str(path), "client")
    assert file.settings == {"transport": {"link": {"tx": {"lease": 8000}}}}


def test_zenoh_takes_the_needs_in_every_mode(tmp_path: Path) -> None:
    """The generated configuration is a valid one of Zenoh: all its keys exist there."""
    path = tmp_path / SOURCE
    for mode in ("peer", "client", "router"):
        settings = make_zenoh_config([], [], mode)
        for side in ("listen", "connect"):
            settings[side] = {
                key: settings[side][key]
                for key in settings[side]
                if key in ("endpoints", "retry")
            }
        path.write_text(str(settings).replace("True", "true").replace("False", "false"))
        assert read_zenoh_file(path).mode == mode


def test_deeply_nested_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / SOURCE
    path.write_text("[" * 100_000)
    with pytest.raises(UsageError, match=f"nested more than {MAX_DEPTH} levels deep"):
        read_zenoh_file(path)


def test_a_folder_is_no_zenoh_file(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="is a folder, not a file"):
        read_zenoh_file(tmp_path)
