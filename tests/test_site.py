"""The site of documentation: links and pictures work, every name is present, and nothing is
loaded from a network.
"""

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
    """The parts of a page, its links, and the files that a browser loads for the page."""

    def __init__(self, page: Path) -> None:
        super().__init__()
        self.ids: set[str] = set()
        self.leads: set[str] = set()
        self.loads: set[str] = set()
        self.feed(page.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        attributes = {key: value for key, value in attrs if value}
        self.ids |= {attributes[key] for key in ("id",) if key in attributes}
        self.leads |= {attributes["href"]} if tag == "a" and "href" in attributes else set()
        self.loads |= {
            attributes[key] for key in ("src", "href") if tag != "a" and key in attributes
        }


def test_the_first_pages_links_exist() -> None:
    overview = (ROOT / "docs" / "overview.md").read_text(encoding="utf-8")
    text = MAKE.read_beside_docs("README.md") + overview.replace("](../", "](")
    named = re.findall(r'(?:\]\(|src=")(?!https?:)([^)"#]+)', text)
    assert len(named) > 60
    places = [ROOT / "docs" / name for name in named if name not in MAKE.BESIDE]
    assert [missing for missing in places if not missing.is_file()] == []


def test_links_of_gathered_pages_lead_to_files(tmp_path: Path) -> None:
    """This includes links to files beside docs in the repository, such as examples."""
    folder = tmp_path / "docs"
    MAKE.gather_pages(folder)
    assert (folder / "examples/package/trilat_lag.py.md").is_file()
    made_later = {f"{name}.md" for name in ("commands", "python", "scenario", "scenarios")}
    absent = []
    for page in folder.rglob("*.md"):
        text = re.sub(
            r"```.*?```|~~~~.*?~~~~", "", page.read_text(encoding="utf-8"), flags=re.DOTALL
        )
        for address in re.findall(r"\]\((?!\w+:)([^)#\s]+)", text):
            target = page.parent / unquote(address)
            if not target.exists() and target.name not in made_later:
                absent.append((page.name, address))
    assert absent == []


def test_the_menu_has_nine_entries_at_most() -> None:
    settings = tomllib.loads((ROOT / "docs/site/zensical.toml").read_text(encoding="utf-8"))
    entries = settings["project"]["nav"]
    assert len(entries) <= 9
    named = [page for entry in entries for pages in entry.values() for page in pages]
    assert len(named) == len(set(named))
    docs = ROOT / "docs"
    pages = {page.relative_to(docs).as_posix() for page in docs.rglob("*.md")}
    pages_in_menu = {"index.md", "SECURITY.md", "CHANGELOG.md", "LICENSE.md"}
    pages_in_menu |= {
        f"reference/{name}.md" for name in ("commands", "python", "scenario", "scenarios")
    }
    assert pages | pages_in_menu == set(named)


def test_pages_are_found_in_their_menus_folder() -> None:
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
    """All pages have at most 72 000 words; the median page has at most 1 200, and none has more than 2 500."""
    pages = list((ROOT / "docs").rglob("*.md"))
    formula = re.compile(r"```math\n.*?```|\$`[^`]+`\$", re.DOTALL)
    counts = [
        len(formula.sub("formula", page.read_text(encoding="utf-8")).split()) for page in pages
    ]
    assert sum(counts) <= 72_000
    assert statistics.median(counts) <= 1_200
    assert max(counts) <= 2_500
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


def test_formula_keeps_punctuation_and_scrolls_if_long() -> None:
    short, long = (
        MAKE.typeset_in_line("+".join("a" * count), before="(", after=").") for count in (3, 30)
    )
    assert short.startswith('<span class="formula">(<math')
    assert short.endswith("</math>).</span>")
    assert long.startswith('<span class="formula long">(<math')


@pytest.mark.long
@needs_browser
def test_the_site_is_whole() -> None:
    """Zensical refuses a Markdown link or an anchor that leads nowhere, but does not check
    pictures in HTML.
    """
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
    absent = []
    foreign = []
    for path in HTML.rglob("*.html"):
        page = Page(path)
        foreign += [(path.name, address) for address in page.loads if urlsplit(address).netloc]
        for address in map(urlsplit, page.leads | page.loads):
            if (
                not (address.scheme or address.netloc)
                and address.path
                and path.name != "404.html"
            ):
                target = path.parent / unquote(address.path)
                absent += [(path.name, address.path)] if not target.exists() else []
    assert absent == []
    assert foreign == []
    check_search()


def check_search() -> None:
    """Searches from a page in a folder, opened as a file: each result leads to its place, and
    nothing is fetched.
    """
    with browser_page("about:blank") as page:
        requests: list[str] = []
        page.on("request", lambda request: requests.append(request.url))
        page.goto((HTML / "maps" / "index.html").as_uri())
        page.locator(".md-search__button").first.click()
        page.locator("dialog input").first.fill("dominance")
        page.locator("dialog a", has_text="trilat set dominance").first.click()
        page.wait_for_url("**/reference/commands.html*#trilat-set-dominance")
        assert {urlsplit(url).scheme for url in requests} <= {"file", "data", "blob"}
