"""Opens a browser at a link that contains a secret token.

The link leads to the page on which people watch and control a session. Anybody who knows the
token can take part in the session, so other users of the same machine must not see it.

Invariant:
    - The token never appears on a command line, since every user of the machine can list
      command lines.
    - The browser opens a file that only its user can read and that redirects to the link. The
      file is removed once the page is open.
"""

import os
import shutil
import tempfile
import webbrowser
from contextlib import suppress
from pathlib import Path

from jinja2 import Environment, PackageLoader, StrictUndefined, Template


class BrowserOpening:
    """Opens a browser at a secret link, through a temporary file that only the user can read.

    The file redirects the browser to the link. It exists until the page is open.

    Args:
        link: The link, which contains a secret token.
    """

    def __init__(self, link: str) -> None:
        self._target_link = link
        self._folder: Path | None = None

    def open(self) -> None:
        """Opens a browser at the secret link of a page, through a file that redirects to it.

        Does nothing if there is no browser or the file cannot be written, since the link is
        also printed for the user.
        """
        # A RuntimeError means that the user has no home directory.
        with suppress(OSError, webbrowser.Error, RuntimeError):
            webbrowser.open(self.write().as_uri())

    def write(self) -> Path:
        """Writes an HTML file that redirects a browser to the secret link of the page.

        Only the user can read the file. It is placed in a new folder in the home directory,
        since a browser installed as a snap can read neither /tmp nor hidden folders.

        Returns:
            Path of the file.

        Raises:
            OSError: The file cannot be written.
        """
        # `mkdtemp` creates the folder with mode 0700.
        self._folder = Path(tempfile.mkdtemp(prefix="trilat-live-", dir=Path.home()))
        text = _make_template().render(link=self._target_link)
        file = self._folder / "open.html"
        # The file must be new, and only its user may read it (mode 0600).
        descriptor = os.open(file, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        with os.fdopen(descriptor, "wb") as stream:
            stream.write(text.encode())
        return file

    def remove_file(self) -> None:
        """Removes the temporary file that holds the secret link of a page.

        Called when the browser has opened the page or the server shuts down.
        """
        if self._folder is not None:
            shutil.rmtree(self._folder, ignore_errors=True)
            self._folder = None


def _make_template() -> Template:
    """Returns the template of the file that redirects to the link, with HTML escaping."""
    environment = Environment(
        loader=PackageLoader(__package__, "templates"),
        autoescape=True,
        undefined=StrictUndefined,
    )
    return environment.get_template("open.html")
