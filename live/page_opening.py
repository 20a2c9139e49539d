"""Opens a browser at a link whose token no other user of the machine may see.

Invariant: the token stands in no command line, since every user of the machine can list those.
The browser gets a file that only its user can read, and which leads on to the link; it is
removed once the page is there.
"""

import html
import os
import shutil
import tempfile
import webbrowser
from contextlib import suppress
from pathlib import Path


class BrowserOpening:
    """A file that leads a browser to a link, until the page is open."""

    def __init__(self, link: str) -> None:
        self._link = link
        self._folder: Path | None = None

    def open(self) -> None:
        """Opens a browser, if the system has one; whatever fails, the link is printed anyway."""
        with suppress(OSError, webbrowser.Error, RuntimeError):  # the last: there is no home
            webbrowser.open(self.write().as_uri())

    def write(self) -> Path:
        """Returns the file, which leads on to the link.

        The file is in a folder of the home directory: browsers that run confined (snap) can
        read neither /tmp nor hidden folders.

        Raises:
            OSError: the file cannot be written.
        """
        # of mode 0700
        self._folder = Path(tempfile.mkdtemp(prefix="trilat-live-", dir=Path.home()))
        link = html.escape(self._link)
        text = (
            '<!DOCTYPE html><meta charset="utf-8"><title>trilat live</title>'
            f'<meta http-equiv="refresh" content="0; url={link}"><p><a href="{link}">trilat live</a>'
        )
        file = self._folder / "open.html"
        descriptor = os.open(file, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        with os.fdopen(descriptor, "wb") as stream:
            stream.write(text.encode())
        return file

    def forget(self) -> None:
        """Removes the file."""
        if self._folder is not None:
            shutil.rmtree(self._folder, ignore_errors=True)
            self._folder = None
