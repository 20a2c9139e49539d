"""Cases of the command line: command lines that are refused alike, and the files that they read."""

import os
import shlex
import shutil
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

import msgspec

from tests.cli.running import trilat
from tests.refusals.corpus import Case


class CommandCase(Case, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Command lines that are refused with the same message, and leave no file behind."""

    commands: tuple[str, ...]
    """Command lines without the name of the program."""
    files: dict[str, str] = msgspec.field(default_factory=dict)
    """Texts of files in the folder of the command, by name."""
    hex: dict[str, str] = msgspec.field(default_factory=dict)
    """Contents of other files, in hexadecimal digits."""
    copies: dict[str, str] = msgspec.field(default_factory=dict)
    """Names of inputs that the part's test prepares, such as logs, by the name of the copy."""
    folders: tuple[str, ...] = ()
    """Names of empty folders."""
    pipes: tuple[str, ...] = ()
    """Names of pipes."""

    def check_commands(
        self, folder: Path, inputs: Mapping[str, Path] = MappingProxyType({})
    ) -> None:
        """Asserts that each command is refused in one line on stderr, and writes no file.

        Args:
            folder: An empty folder, in which the commands run.
            inputs: Files and folders to copy, by the names that cases give them.
        """
        self.write_files(folder, inputs)
        before = list_contents(folder)
        assert self.commands, self.name
        for command in self.commands:
            done = trilat(*shlex.split(command), cwd=folder)
            done.refuses(code=self.exit_code)
            assert done.err[:-1].isprintable(), done
            self.check_message(done.err.removesuffix("\n"), done.code)
            assert list_contents(folder) == before, command

    def write_files(self, folder: Path, inputs: Mapping[str, Path]) -> None:
        """Writes and copies the files of the case into a folder."""
        for name in self.folders:
            (folder / name).mkdir()
        for name in self.pipes:
            os.mkfifo(folder / name)
        for name, text in self.files.items():
            (folder / name).write_text(text, encoding="utf-8")
        for name, digits in self.hex.items():
            (folder / name).write_bytes(bytes.fromhex(digits))
        for name, key in self.copies.items():
            if inputs[key].is_dir():
                shutil.copytree(inputs[key], folder / name)
            else:
                shutil.copy(inputs[key], folder / name)


def list_contents(folder: Path) -> dict[str, bytes | None]:
    """Returns the contents of all files below a folder. None for folders and pipes."""
    return {
        str(path.relative_to(folder)): path.read_bytes() if path.is_file() else None
        for path in sorted(folder.rglob("*"))
    }
