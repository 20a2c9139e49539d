"""Gathers the pages of the site in build/site: those of docs, and what is made from the program.

python docs/site/make_pages.py [--no-pictures]
zensical build --strict -f build/site/zensical.toml
"""

import csv
import html
import inspect
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

from latex2mathml.converter import convert

import trilat_net as tn
from trilat_net.presentation.figures.registry import write_figures

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
SITE = ROOT / "build" / "site"
PAGES = SITE / "docs"
BESIDE = ("CHANGELOG.md", "SECURITY.md", "LICENSE")
"""Pages that stand beside docs in the repository, and in it here."""
MOST_ROWS = 250
"""Largest number of rows of a data file that its page shows."""
LONG_FORMULA = 30
"""Number of characters from which a formula in a line may be wider than a telephone."""
RELATION = "<mo[^>]*>(?:&#x000(?:28|2C|3C|3D|3E);|&#x0226[45];|[(,])</mo>(?:<mspace[^>]*>)?"
SPACES = {
    r"<m[io]>([A-Za-z]{2,})</m[io]>": r'<mo lspace="0.15em" rspace="0.15em">\1</mo>',
    r'<mo(?: stretchy="false")?>(&#x0007C;)</mo>': r'<mo stretchy="false" lspace="0" rspace="0">\1</mo>',
    rf"({RELATION})<mo>(&#x0(?:2212|002B);)": r'\1<mo form="prefix">\2',
    r"<mo>(&#x0221E;)</mo>": r"<mi>\1</mi>",
}
"""Patterns of MathML and their replacements: names of functions, bars, signs and infinity with TeX's spaces."""


def main() -> None:
    """Gathers all pages, and the settings of Zensical beside them."""
    shutil.rmtree(SITE, ignore_errors=True)
    gather_pages(PAGES)
    write("reference/commands.md", list_commands())
    write("reference/python.md", list_functions())
    write("reference/scenario.md", show_template())
    sections = list_scenarios(pictures="--no-pictures" not in sys.argv)
    write("reference/scenarios.md", "\n\n".join(["# Shipped scenarios", *sections]))
    shutil.copy(HERE / "zensical.toml", SITE)
    (PAGES / "assets").mkdir()
    shutil.copy(HERE / "iframe-worker.js", PAGES / "assets")
    shutil.copy(HERE / "formulas.css", PAGES / "assets")


def gather_pages(folder: Path) -> None:
    """Gathers the pages of docs, those beside docs, and the files that they link to, in a folder."""
    shutil.copytree(ROOT / "docs", folder, ignore=shutil.ignore_patterns("site", "media"))
    for name in BESIDE:
        write(name if name.endswith(".md") else f"{name}.md", read_beside_docs(name), folder)
    write("index.md", read_beside_docs("README.md"), folder)
    for page in sorted(folder.rglob("*.md")):
        lift_links_beside_docs(page, folder)
        link_to_rendered_tables(page)
        for example in link_to_examples(page):
            write(f"{example}.md", render_example(example), folder)
        typeset_formulas(page)
    for table in sorted((folder / "data").glob("*.csv")):
        write(f"data/{table.stem}.md", render_table(table), folder)


def write(name: str, text: str, folder: Path = PAGES) -> None:
    """Writes a page."""
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text.rstrip() + "\n", encoding="utf-8")


def read_beside_docs(name: str) -> str:
    """Returns a page that stands beside docs with its links and pictures as docs has them."""
    page = (ROOT / name).read_text(encoding="utf-8")
    return re.sub(r'(\]\(|src=")docs/', r"\1", page)


def lift_links_beside_docs(page: Path, folder: Path) -> None:
    """Rewrites a page's links to what stands beside docs in the repository: here it stands in docs."""
    outside = "](" + "../" * len(page.relative_to(folder).parts)
    inside = outside.removesuffix("../")
    text = page.read_text(encoding="utf-8").replace(f"{outside}README.md", f"{inside}index.md")
    page.write_text(text.replace(outside, inside), encoding="utf-8")


def link_to_rendered_tables(page: Path) -> None:
    """Makes the links of a page to data files lead to the pages that show them as tables."""
    text = page.read_text(encoding="utf-8")
    page.write_text(
        re.sub(r"\]\(((?:\.\./)*data/[\w-]+)\.csv\)", r"](\1.md)", text), encoding="utf-8"
    )


def link_to_examples(page: Path) -> list[str]:
    """Makes the links of a page to files of examples lead to pages that show them.

    Returns the paths of these files in the repository.
    """
    text = page.read_text(encoding="utf-8")
    pattern = r"(\]\((?:\.\./)*)(examples/[\w/-]+\.\w+)\)"
    page.write_text(re.sub(pattern, r"\1\2.md)", text), encoding="utf-8")
    return [path for _, path in re.findall(pattern, text)]


def render_example(path: str) -> str:
    """Returns a file of examples as a page."""
    code = (ROOT / path).read_text(encoding="utf-8")
    name = Path(path).name
    language = {".py": "python", ".toml": "toml"}.get(Path(path).suffix, "text")
    return (
        f"# {name}\n\nThe repository has this file as `{path}`.\n\n~~~~{language}\n{code}~~~~"
    )


def typeset_formulas(page: Path) -> None:
    """Turns the formulas of a page into MathML, which browsers draw without a script.

    They are written as on GitHub: ```math before a block, and $`...`$ in a line.
    """
    text = page.read_text(encoding="utf-8")
    text = re.sub(
        r"^```math\n(.*?)^```$",
        lambda found: typeset_block(found[1]),
        text,
        flags=re.DOTALL | re.MULTILINE,
    )
    text = re.sub(
        r"(\(?)\$`([^`]+)`\$([).,;:]*)",
        lambda found: typeset_in_line(found[2], before=found[1], after=found[3]),
        text,
    )
    page.write_text(text, encoding="utf-8")


def typeset_block(latex: str) -> str:
    """Returns a formula as a block, which scrolls where the page is narrower."""
    return f'<div class="formula">{convert_formula(latex, "block")}</div>'


def typeset_in_line(latex: str, *, before: str, after: str) -> str:
    """Returns a formula in an element that no line break parts from the punctuation around it.

    A line that began with the formula itself would count as a block. A long formula scrolls.
    """
    formula = convert_formula(latex, "inline")
    characters = html.unescape(re.sub("<[^>]*>", "", formula))
    kind = "formula long" if len(characters) >= LONG_FORMULA else "formula"
    return f'<span class="{kind}">{before}{formula}{after}</span>'


def convert_formula(latex: str, display: str) -> str:
    """Returns a formula as MathML. Blanks are removed, because Markdown would see paragraphs."""
    mathml = re.sub(r"\s*\n\s*", " ", convert(latex.strip(), display=display))
    for pattern, replacement in SPACES.items():
        mathml = re.sub(pattern, replacement, mathml)
    return mathml


def render_table(path: Path) -> str:
    """Returns a data file as a page: its first rows as a table, and a link to the file."""
    with path.open(encoding="utf-8", newline="") as file:
        heads, *rows = list(csv.reader(file))
    title = path.stem.replace("-", " ").replace("_", " ")
    download = f"[Download {path.name}]({path.name}), which has {len(rows)} rows."
    if len(rows) > MOST_ROWS:
        download += f" Here are the first {MOST_ROWS}."
    lines = [heads, ["---"] * len(heads), *rows[:MOST_ROWS]]
    table = "\n".join(f"| {' | '.join(map(escape_cell, line))} |" for line in lines)
    # Rows of data would stand before the pages that explain them among the results of a search.
    hidden = "---\nsearch:\n  exclude: true\n---\n"
    return f"{hidden}\n# {title[:1].upper()}{title[1:]}\n\n{download}\n\n{table}"


def escape_cell(text: str) -> str:
    """Returns the text of a cell so that Markdown shows it as it is, apart from code in backticks."""
    parts = text.replace("|", "\\|").replace("<", "&lt;").split("`")
    parts[::2] = [re.sub(r"([*_\[\]])", r"\\\1", part) for part in parts[::2]]
    return "`".join(parts)


def list_commands() -> str:
    """Returns the help of every command, as Typer writes it, with links to the pages that it names."""
    run = [
        sys.executable,
        "-m",
        "typer",
        "trilat_net.app.cli",
        "utils",
        "docs",
        "--name",
        "trilat",
        "--title",
        "Commands",
    ]
    text = subprocess.run(run, check=True, capture_output=True, text=True, cwd=ROOT).stdout
    return re.sub(r"(^Docs: |, )docs/(\S+\.md)", r"\1[\2](../\2)", text, flags=re.MULTILINE)


def list_functions() -> str:
    """Returns a place for the docstring of every public name."""
    text = [
        "# Python",
        "[From Python](../studies/python.md) says what there is; here is each function with its arguments.",
    ]
    for name in tn.__all__:
        if name != "__version__":
            made = getattr(tn, name)
            if made.__name__ != name:
                text += [f"## {name}", f"`tn.{name}` is another name of the following one."]
            text.append(f"::: {inspect.getmodule(made).__name__}.{made.__name__}")
    return "\n\n".join(text)


def show_template() -> str:
    """Returns the commented template of a scenario, which has all keys."""
    said = "`trilat scenario new FILE` writes this text."
    return f"# Scenario keys\n\n{said}\n\n```toml\n{tn.read_template()}\n```"


def list_scenarios(*, pictures: bool) -> Iterator[str]:
    """Yields a section per shipped scenario: what it shows, and a run of it in virtual time."""
    for name in sorted(tn.list_shipped(), key=lambda one: one != "paper"):  # the paper's first
        scenario = tn.load_scenario(name)
        parts = [
            f"## {name}",
            scenario.title,
            scenario.about.strip(),
            f"    $ trilat sim {name} -o {name}.mcap",
        ]
        if pictures:
            write_figures(
                tn.simulate(name),
                PAGES / "reference" / "scenarios" / name,
                ["overview"],
                width_in=7.0,
                formats=["png"],
            )
            parts.append(
                f"![{name}: errors, speeds, torques and ages](scenarios/{name}/overview.png)"
            )
        yield "\n\n".join(part for part in parts if part)


if __name__ == "__main__":
    main()
