"""Selects the files that the web server sends: the page and the results.

The results are the log of the session and the report computed from it. They are offered for
download on the page once the session has ended.

Invariant:
    - A page runs only scripts from its own server. A report runs its own scripts, isolated from
      the page, since it may come from somebody else's log.
    - Nobody can guess the address of a report or a log.
"""

import secrets
from collections.abc import Iterable
from http import HTTPStatus
from importlib import resources
from pathlib import Path

from websockets.datastructures import Headers
from websockets.http11 import Response

_KINDS = {
    "html": "text/html; charset=utf-8",
    "css": "text/css; charset=utf-8",
    "js": "text/javascript; charset=utf-8",
    "svg": "image/svg+xml",
    "LICENSE": "text/plain; charset=utf-8",
}
"""Media types of files, by the end of their names."""
_REPORT_POLICY = (
    "sandbox allow-scripts allow-downloads allow-popups; default-src 'none'; "
    "script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data: blob:"
)
"""Content security policy of a report and a log."""
MAX_FILE_BYTES = 256 << 20
"""Largest size of a log that is sent to a page. Users open a larger log in its folder."""
_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' data: blob:; connect-src 'self'; base-uri 'none'; "
    "form-action 'none'; frame-ancestors 'none'"
)
"""Content security policy of the page's own files."""


class PageFiles:
    """Files that the server sends to browsers: the web page and the results.

    The results are the report and the log of the session. They become available after the
    session, at addresses that nobody can guess.

    Attributes:
        results: Mapping from the path in the web address of each result to its path on disk.
            Empty while the session runs.
    """

    def __init__(self) -> None:
        self._assets = _list_assets()
        self.results: dict[str, Path] = {}

    def add_results(self, paths: Iterable[Path]) -> None:
        """Offers the report and log of an ended session for download.

        Each call uses a new secret in the addresses. Files larger than `MAX_FILE_BYTES` are
        skipped.

        Args:
            paths: Paths of the files.
        """
        secret = secrets.token_urlsafe()
        sendable = (path for path in paths if path.stat().st_size <= MAX_FILE_BYTES)
        self.results |= {f"/{secret}/{path.name}": path for path in sendable}

    def find(self, path: str) -> Response | None:
        """Returns the HTTP response to a browser's request for a file.

        Args:
            path: Path of the requested address.

        Returns:
            The response with the content of the file, or `None` if there is no such file.
        """
        result = self.results.get(path)
        if result is not None and result.is_file():
            media_type = _KINDS.get(result.suffix[1:], "application/octet-stream")
            return _make_response(media_type, result.read_bytes(), _REPORT_POLICY, "no-store")

        asset = self._assets.get(path)
        if asset is None:
            return None

        media_type, content = asset
        # The start page has a token in its address, and must not be stored.
        cache_control = "no-store" if path in ("/", "/index.html") else "no-cache"
        return _make_response(media_type, content, _POLICY, cache_control)


def _list_assets() -> dict[str, tuple[str, bytes]]:
    """Returns the page's own files by their addresses, such as "/main.js".

    They come from this package and from the package of the report, whose plots the page uses.

    Returns:
        The media type and the content of each file.
    """
    plot_assets = (resources.files("trilat_net.presentation") / "assets").iterdir()
    page_assets = (resources.files(__package__) / "assets").iterdir()
    assets = {}
    for file in [*page_assets, *plot_assets]:
        address = "/" + file.name
        # The suffix follows the last "." or "-" of the name, as in "uPlot-LICENSE".
        _, _, behind_dot = file.name.rpartition(".")
        _, _, ending = behind_dot.rpartition("-")
        media_type = _KINDS.get(ending)
        is_report_asset = file.name.startswith("report.")
        if media_type is not None and not is_report_asset and address not in assets:
            assets[address] = media_type, file.read_bytes()
    assets["/"] = assets["/index.html"]
    return assets


def _make_response(kind: str, content: bytes, policy: str, cache: str) -> Response:
    """Returns the response that sends a file.

    Args:
        kind: Media type of the file.
        content: Bytes of the file.
        policy: Content security policy of the file.
        cache: Whether browsers may store the file, as in the header `Cache-Control`.
    """
    headers = {
        "Content-Type": kind,
        "Content-Length": str(len(content)),
        "Content-Security-Policy": policy,
        "X-Content-Type-Options": "nosniff",
        "Referrer-Policy": "no-referrer",
        "Cache-Control": cache,
        "Connection": "close",
    }
    return Response(HTTPStatus.OK, "OK", Headers(headers), content)
