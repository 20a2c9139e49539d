"""Keys that a command refuses before a connection is opened, and requests for such keys."""

import json
import shutil
from collections.abc import Mapping
from datetime import timedelta
from pathlib import Path
from typing import Any

import msgspec
import pytest

from tests.refusals.command_cases import CommandCase
from tests.refusals.corpus import parametrize_cases
from trilat_net.errors import UsageError
from trilat_net.net import member_keys
from trilat_net.net.member_keys import MEMBERS, create_keys, read_member_keys

NAMES = ("m1", "m2", "s", "recorder", "operator", "router", "bridge")


class Change(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A change of a file in the folder of keys of m1, or of the folder itself."""

    file: str = ""
    """Name of the file. Empty for the folder."""
    mode: int = 0
    """New permissions."""
    text: str = ""
    """New content."""
    source: str = ""
    """Other folder of keys, as in "k/m2", from which the file is taken."""
    facts: dict[str, Any] = msgspec.field(default_factory=dict)
    """New values in the list of members."""
    is_removed: bool = False

    def apply(self, keys: Path) -> None:
        """Changes a file.

        Args:
            keys: Folder that contains the folders of all sets of keys.
        """
        path = keys / "k" / "m1" / self.file
        if self.mode:
            path.chmod(self.mode)
        if self.text:
            path.write_text(self.text, encoding="utf-8")
        if self.source:
            path.write_bytes((keys / self.source / self.file).read_bytes())
        if self.facts:
            stored = json.loads(path.read_text(encoding="utf-8"))
            path.write_text(json.dumps({**stored, **self.facts}), encoding="utf-8")
        if self.is_removed:
            path.unlink()


class KeyCase(CommandCase, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Commands in a folder that contains the folder `keys`, which a case may change.

    The keys of a session are in `keys/k`. Those in `keys/old` have expired, those in
    `keys/early` begin later, and those in `keys/others` have another authority.
    """

    changes: tuple[Change, ...] = ()

    def write_files(self, folder: Path, inputs: Mapping[str, Path]) -> None:
        """Copies all keys into a folder and applies the changes of the case."""
        CommandCase.write_files(self, folder, inputs)
        shutil.copytree(inputs["all keys"], folder / "keys")
        for change in self.changes:
            change.apply(folder / "keys")


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The folder of all keys, by its name."""
    folder = tmp_path_factory.mktemp("keys")
    create_keys(folder / "k", NAMES)
    create_keys(folder / "others", NAMES)
    create_keys(folder / "old", NAMES, days=0)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(member_keys, "_CLOCK_TOLERANCE", -timedelta(days=2))
        create_keys(folder / "early", NAMES)
    assert read_member_keys(folder / "k" / "m1").members == NAMES
    assert MEMBERS in {path.name for path in (folder / "k" / "m1").iterdir()}
    return {"all keys": folder}


@parametrize_cases("keys.toml", KeyCase)
def test_unsuitable_keys_are_refused(
    case: KeyCase, inputs: dict[str, Path], tmp_path: Path
) -> None:
    """Changed keys are refused by the reader of keys as well, with the same words."""
    case.check_commands(tmp_path, inputs)
    if case.changes:
        with pytest.raises(UsageError) as caught:
            read_member_keys(tmp_path / "keys" / "k" / "m1")
        assert [text for text in case.words if text not in str(caught.value)] == []
