"""What the page's server sends for a request: the page's own files, and report and log of an
ended session.

Invariant: a page runs scripts of its own server alone; a report runs its own, cut off from the
page. Nobody can guess the address of a report or a log.
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
_REPORT_POLICY = (
    "sandbox allow-scripts allow-downloads allow-popups; default-src 'none'; script-src 'unsafe-inline'; "
    "style-src 'unsafe-inline'; img-src data: blob:"
)
LARGEST_BYTES = 256 << 20
"""A larger log is not sent to a page: it is read from its folder."""
_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)


class PageFiles:
    """The files of one server.

    Attributes:
        results: report and log by their addresses, once the session has ended.
    """

    def __init__(self) -> None:
        self._own = _list_assets()
        self.results: dict[str, Path] = {}

    def offer(self, paths: Iterable[Path]) -> None:
        """Adds files of the ended session, unless they are too large."""
        secret = secrets.token_urlsafe()
        small = (path for path in paths if path.stat().st_size <= LARGEST_BYTES)
        self.results |= {f"/{secret}/{path.name}": path for path in small}

    def find(self, path: str) -> Response | None:
        """Returns the answer to a request for a path; None if there is no such file."""
        if (result := self.results.get(path)) is not None and result.is_file():
            kind = _KINDS.get(result.suffix[1:], "application/octet-stream")
            return _send_file(kind, result.read_bytes(), _REPORT_POLICY, "no-store")
        if (file := self._own.get(path)) is None:
            return None
        return _send_file(
            *file, _POLICY, "no-store" if path in ("/", "/index.html") else "no-cache"
        )


def _list_assets() -> dict[str, tuple[str, bytes]]:
    plots = (resources.files("trilat_net.reporting") / "assets").iterdir()
    files = {}
    for file in [*(resources.files("live") / "assets").iterdir(), *plots]:
        kind = _KINDS.get(file.name.rpartition(".")[2].rpartition("-")[2])
        if (
            kind is not None
            and not file.name.startswith("report.")
            and "/" + file.name not in files
        ):
            files["/" + file.name] = kind, file.read_bytes()
    files["/"] = files["/index.html"]
    return files


def _send_file(kind: str, content: bytes, policy: str, cache: str) -> Response:
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
