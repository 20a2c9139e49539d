"""The site of documentation: links and pictures hold, it has every name, and takes nothing from a network."""

import re
import runpy
import statistics
import subprocess
import sys
import tomllib
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace
from urllib.parse import unquote, urlsplit

import pytest

import trilat_net as tn
from tests.golden.surface import all_options
from tests.live.browsers import browser_page, needs_browser
from trilat_net.files import find_page

ROOT = Path(__file__).resolve().parents[1]
HTML = ROOT / "build" / "site" / "html"
MAKE = SimpleNamespace(**runpy.run_path(str(ROOT / "docs" / "site" / "make_pages.py")))


class Page(HTMLParser):
    """What a page's parts are called, where it leads to, and what a browser loads for it."""

    def __init__(self, page: Path) -> None:
        super().__init__()
        self.ids: set[str] = set()
        self.leads: set[str] = set()
        self.loads: set[str] = set()
        self.feed(page.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = {key: value for key, value in attrs if value}
        self.ids |= {given[key] for key in ("id",) if key in given}
        self.leads |= {given["href"]} if tag == "a" and "href" in given else set()
        self.loads |= {given[key] for key in ("src", "href") if tag != "a" and key in given}


def test_every_picture_and_page_that_first_page_names_is_there() -> None:
    overview = (ROOT / "docs" / "overview.md").read_text(encoding="utf-8")
    text = MAKE.read_beside_docs("README.md") + overview.replace("](../", "](")
    named = re.findall(r'(?:\]\(|src=")(?!https?:)([^)"#]+)', text)
    assert len(named) > 60
    places = [ROOT / "docs" / one for one in named if one not in MAKE.BESIDE]
    assert [place for place in places if not place.is_file()] == []


def test_the_menu_has_nine_entries_at_most_and_every_page_once() -> None:
    settings = tomllib.loads((ROOT / "docs/site/zensical.toml").read_text(encoding="utf-8"))
    entries = settings["project"]["nav"]
    assert len(entries) <= 9
    named = [page for entry in entries for pages in entry.values() for page in pages]
    assert len(named) == len(set(named))
    docs = ROOT / "docs"
    pages = {page.relative_to(docs).as_posix() for page in docs.rglob("*.md")}
    made = {"index.md", "SECURITY.md", "CHANGELOG.md", "LICENSE.md"}
    made |= {f"reference/{name}.md" for name in ("commands", "python", "scenario", "scenarios")}
    assert pages | made == set(named)


def test_a_page_is_found_by_its_name_and_lies_in_the_folder_of_its_menu() -> None:
    settings = tomllib.loads((ROOT / "docs/site/zensical.toml").read_text(encoding="utf-8"))
    names: list[str] = []
    for entry in settings["project"]["nav"]:
        for pages in entry.values():
            inside = [Path(page) for page in pages if "/" in page and "maps/" not in page]
            assert len({page.parent for page in inside}) <= 1
            names += [page.name for page in inside if (ROOT / "docs" / page).is_file()]
    assert len(set(names)) == len(names)
    assert find_page("sweep.md") == ROOT / "docs" / "studies" / "sweep.md"


def test_pages_are_short() -> None:
    """At most 72 000 words in all; the median page has at most 1 200, none more than 2 500.

    A formula counts as a word.
    """
    pages = list((ROOT / "docs").rglob("*.md"))
    formula = re.compile(r"```math\n.*?```|\$`[^`]+`\$", re.DOTALL)
    words = [
        len(formula.sub("formula", page.read_text(encoding="utf-8")).split()) for page in pages
    ]
    assert sum(words) <= 72_000
    assert statistics.median(words) <= 1_200
    assert max(words) <= 2_500
    assert len((ROOT / "README.md").read_text(encoding="utf-8").split()) <= 1_100
    assert len((ROOT / "CHANGELOG.md").read_text(encoding="utf-8").split()) <= 1_500


def test_the_list_of_scenarios_begins_with_the_paper() -> None:
    sections = list(MAKE.list_scenarios(pictures=False))
    assert sections[0].startswith("## paper\n")
    assert len(sections) == len(tn.list_shipped())


def test_a_formula_has_the_spaces_of_tex() -> None:
    formula = MAKE.convert_formula(r"|a| = -b \cos x", "inline")
    assert '<mo lspace="0.15em" rspace="0.15em">cos</mo>' in formula
    assert '<mo form="prefix">&#x02212;</mo>' in formula
    assert formula.count('lspace="0" rspace="0">&#x0007C;</mo>') == 2


def test_a_formula_keeps_its_punctuation_and_scrolls_if_long() -> None:
    short, long = (
        MAKE.typeset_in_line("+".join("a" * count), before="(", after=").") for count in (3, 30)
    )
    assert short.startswith('<span class="formula">(<math')
    assert short.endswith("</math>).</span>")
    assert long.startswith('<span class="formula long">(<math')


@pytest.mark.long
@needs_browser
def test_the_site_is_whole() -> None:
    """Zensical refuses a Markdown link or an anchor that leads nowhere; pictures in HTML it does not see."""
    subprocess.run(
        [sys.executable, "docs/site/make_pages.py", "--no-pictures"], cwd=ROOT, check=True
    )
    build = [
        Path(sys.executable).with_name("zensical"),
        "build",
        "--strict",
        "-f",
        "zensical.toml",
    ]
    subprocess.run(build, cwd=ROOT / "build" / "site", check=True)
    names = {name.rpartition(".")[2] for name in Page(HTML / "reference" / "python.html").ids}
    assert not {name for name in tn.__all__ if name != "__version__"} - names
    commands = Page(HTML / "reference" / "commands.html").ids
    assert not {command.replace(" ", "-") for command in all_options()} - {"trilat"} - commands
    assert (HTML / "search.js").exists()
    absent, foreign = [], []
    for path in HTML.rglob("*.html"):
        page = Page(path)
        foreign += [(path.name, one) for one in page.loads if urlsplit(one).netloc]
        for one in map(urlsplit, page.leads | page.loads):
            if not (one.scheme or one.netloc) and one.path and path.name != "404.html":
                target = path.parent / unquote(one.path)
                absent += [(path.name, one.path)] if not target.exists() else []
    assert absent == []
    assert foreign == []
    check_search()


def check_search() -> None:
    """From a page in a folder, opened as a file: what is found leads to its place, and nothing is fetched."""
    with browser_page("about:blank") as page:
        asked: list[str] = []
        page.on("request", lambda request: asked.append(request.url))
        page.goto((HTML / "maps" / "index.html").as_uri())
        page.locator(".md-search__button").first.click()
        page.locator("dialog input").first.fill("dominance")
        page.locator("dialog a", has_text="trilat set dominance").first.click()
        page.wait_for_url("**/reference/commands.html*#trilat-set-dominance")
        assert {urlsplit(url).scheme for url in asked} <= {"file", "data", "blob"}
