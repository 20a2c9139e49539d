"""The site of documentation: its links hold, and it has every name, command and key."""

import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path

import pytest

import trilat_net as tn
from tests.golden.surface import all_options

ROOT = Path(__file__).resolve().parents[1]
HTML = ROOT / "build" / "site" / "html"


class Ids(HTMLParser):
    """What a page's parts are called."""

    def __init__(self, page: Path) -> None:
        super().__init__()
        self.found: set[str] = set()
        self.feed(page.read_text(encoding="utf-8"))

    def handle_starttag(self, _: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found |= {value for key, value in attrs if key == "id" and value}


@pytest.mark.long
def test_the_site_is_whole() -> None:
    """Zensical refuses a link or an anchor that leads nowhere."""
    subprocess.run([sys.executable, "docs/site/make_pages.py", "--no-gallery"], cwd=ROOT, check=True)
    build = [Path(sys.executable).with_name("zensical"), "build", "--strict", "-f", "zensical.toml"]
    subprocess.run(build, cwd=ROOT / "build" / "site", check=True)
    names = {name.rpartition(".")[2] for name in Ids(HTML / "reference" / "python.html").found}
    assert not {name for name in tn.__all__ if name != "__version__"} - names
    commands = Ids(HTML / "reference" / "commands.html").found
    assert not {command.replace(" ", "-") for command in all_options()} - {"trilat"} - commands
    assert (HTML / "search.js").exists()
