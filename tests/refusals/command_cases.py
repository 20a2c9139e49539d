"""Cases of the command line: command lines that are refused alike, and the files that they read."""

import os
import shlex
from collections.abc import Callable, Mapping
from pathlib import Path

import msgspec

from tests.cli.running import trilat
from tests.refusals.corpus import Case


class CommandCase(Case, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Command lines that are refused with the same message, and leave no file behind."""

    commands: list[str]
    """Command lines without the name of the program."""
    files: dict[str, str] = msgspec.field(default_factory=dict)
    """Texts of files in the folder of the command, by name."""
    hex: dict[str, str] = msgspec.field(default_factory=dict)
    """Contents of other files, in hexadecimal digits."""
    copies: dict[str, str] = msgspec.field(default_factory=dict)
    """Names of inputs that the part's test makes, such as logs, by the name of the file."""
    folders: tuple[str, ...] = ()
    pipes: tuple[str, ...] = ()

    def check_commands(
        self, folder: Path, inputs: Mapping[str, Callable[[], bytes]] | None = None
    ) -> None:
        """Asserts that each command of the case is refused in one line and changes no file.

        Args:
            folder: An empty folder, in which the commands run.
            inputs: Functions that return the contents of the inputs of `copies`.
        """
        for name in self.folders:
            (folder / name).mkdir()
        for name in self.pipes:
            os.mkfifo(folder / name)
        for name, text in self.files.items():
            (folder / name).write_text(text, encoding="utf-8")
        for name, digits in self.hex.items():
            (folder / name).write_bytes(bytes.fromhex(digits))
        for name, key in self.copies.items():
            (folder / name).write_bytes((inputs or {})[key]())
        before = list_contents(folder)
        assert self.commands, self.name
        for command in self.commands:
            done = trilat(*shlex.split(command), cwd=folder)
            done.refuses(code=self.exit_code)
            assert done.err[:-1].isprintable(), done
            self.check_message(done.err.removesuffix("\n"), done.code)
            assert done.out == "", done
            assert list_contents(folder) == before, command


def list_contents(folder: Path) -> dict[str, bytes | None]:
    """Returns the contents of all files below a folder. None for folders and pipes."""
    return {
        str(path.relative_to(folder)): path.read_bytes() if path.is_file() else None
        for path in sorted(folder.rglob("*"))
    }
