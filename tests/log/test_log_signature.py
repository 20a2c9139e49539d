"""Signatures: what was signed holds, whatever else is changed does not; Ed25519 by another program agrees."""

import base64
import errno
import io
import json
from pathlib import Path
from unittest import mock

import pytest
from cryptography.hazmat.primitives.asymmetric import ed25519, rsa
from cryptography.hazmat.primitives.serialization import (
    BestAvailableEncryption,
    Encoding,
    NoEncryption,
    PrivateFormat,
    load_pem_public_key,
)

from tests.cli.running import trilat
from tests.log.builders import edit_log_bytes, make_log_bytes, write_log
from trilat_net.errors import LogError, LogRefused, UsageError
from trilat_net.log.log_signature import check_signatures, create_signing_keys, sign_log
from trilat_net.log.mcap_reader import McapReader
from trilat_net.log.recovery import recover


@pytest.fixture
def signed(tmp_path: Path) -> tuple[Path, Path]:
    """A signed log, and the public key."""
    path = write_log(tmp_path, make_log_bytes("paper"))
    private, public = create_signing_keys(tmp_path / "lab")
    assert private.stat().st_mode & 0o777 == 0o600
    assert sign_log(path, private) == tmp_path / "run.mcap.sig"
    return path, public


def find_problem(path: Path, key: Path) -> str:
    report = check_signatures([path], key)
    assert report.passed == (not report.places)
    return "" if report.passed else report.text


def test_signatures_hold_without_touching_the_log(signed: tuple[Path, Path]) -> None:
    path, key = signed
    assert path.read_bytes() == make_log_bytes("paper")
    assert find_problem(path, key) == ""


def test_signatures_follow_rfc_8032_over_digests(signed: tuple[Path, Path]) -> None:
    """The file is enough for any other program: the bytes that are signed are made of it alone."""
    path, key = signed
    stated = json.loads(path.with_name("run.mcap.sig").read_text())
    reader = McapReader(io.BytesIO(make_log_bytes("paper")), "log")
    list(reader.messages())
    assert stated["chain"] == reader.metadata["trilat.chain"]
    text = json.dumps(stated["chain"], sort_keys=True, separators=(",", ":"))
    public = load_pem_public_key(key.read_bytes())
    assert isinstance(public, ed25519.Ed25519PublicKey)
    public.verify(base64.b64decode(stated["signature"]), f"{stated['format']}\n{text}".encode())


@pytest.mark.parametrize(
    "what", ["log", "chain", "signature", "log and chain", "another's", "gone", "text"]
)
def test_any_change_shows(what: str, signed: tuple[Path, Path], tmp_path: Path) -> None:
    path, key = signed
    file = path.with_name("run.mcap.sig")
    stated = json.loads(file.read_text())
    other = make_log_bytes("paper", {"seed": 2, "duration_s": 0.05})
    if what == "log":
        path.write_bytes(
            edit_log_bytes(make_log_bytes("paper"), record=lambda r: {**r, "q": [0.0, 0.0]})
        )
    elif what == "chain":
        file.write_text(json.dumps({**stated, "chain": {**stated["chain"], "messages": "1"}}))
    elif what == "signature":
        file.write_text(
            json.dumps({**stated, "signature": base64.b64encode(bytes(64)).decode()})
        )
    elif what == "log and chain":  # a file that was made anew: the chain agrees with it
        path.write_bytes(other)
    elif what == "another's":
        create_signing_keys(tmp_path / "forger")
        sign_log(path, tmp_path / "forger.key", force=True)
    elif what == "gone":
        file.unlink()
    else:
        file.write_text("signed, honestly")
    assert find_problem(path, key)


def test_only_logs_agreeing_with_chains_are_signed(tmp_path: Path) -> None:
    private, key = create_signing_keys(tmp_path / "lab")
    path = write_log(tmp_path, make_log_bytes("paper")[:-200])
    with pytest.raises(LogError, match=r"is not signed: .*trilat log recover"):
        sign_log(path, private)
    recovered = recover(path).output
    assert find_problem(recovered, key) == f"there is no signature file {recovered}.sig"
    sign_log(recovered, private)
    assert find_problem(recovered, key) == ""


def test_invalid_or_open_keys_are_refused(signed: tuple[Path, Path], tmp_path: Path) -> None:
    path, public = signed
    private = tmp_path / "lab.key"
    with pytest.raises(UsageError, match=r"exists; choose another name"):
        sign_log(path, private)
    locked = ed25519.Ed25519PrivateKey.generate().private_bytes(
        Encoding.PEM, PrivateFormat.PKCS8, BestAvailableEncryption(b"word")
    )
    foreign = rsa.generate_private_key(65537, 2048).private_bytes(
        Encoding.PEM, PrivateFormat.PKCS8, NoEncryption()
    )
    for content in (b"", locked, foreign, public.read_bytes()):
        (tmp_path / "odd.key").write_bytes(content)
        with pytest.raises(UsageError, match="not a private Ed25519 key"):
            sign_log(path, tmp_path / "odd.key", force=True)
    with pytest.raises(UsageError, match="not a public Ed25519 key"):
        check_signatures([path], private)
    private.chmod(0o644)
    with pytest.raises(UsageError, match="chmod 600"):
        sign_log(path, private, force=True)
    with pytest.raises(UsageError, match="exists"):
        create_signing_keys(tmp_path / "lab")


def test_keys_are_private_and_full_disks_leave_none(tmp_path: Path) -> None:
    full = OSError(errno.ENOSPC, "No space left on device")
    with (
        mock.patch("os.fsync", side_effect=full),
        pytest.raises(LogRefused, match=r"lab\.key cannot be written"),
    ):
        create_signing_keys(tmp_path / "lab")
    assert not list(tmp_path.iterdir())
    private, _ = create_signing_keys(tmp_path / "lab")
    assert private.stat().st_mode & 0o777 == 0o600


def test_the_command_exits_0_or_1(tmp_path: Path) -> None:
    write_log(tmp_path, make_log_bytes("paper"))
    trilat("keys", "pair", "lab", cwd=tmp_path).succeeds()
    trilat("log", "sign", "run.mcap", "--key", "lab.key", cwd=tmp_path).succeeds()
    assert (
        "signature"
        in trilat("log", "check", "run.mcap", "--key", "lab.pub", cwd=tmp_path).succeeds()
    )
    (tmp_path / "run.mcap.sig").unlink()
    done = trilat("log", "check", "run.mcap", "--key", "lab.pub", "--json", cwd=tmp_path)
    assert done.code == 1
    assert [
        check["check"] for check in json.loads(done.out)["checks"] if not check["passed"]
    ] == ["signature"]
