"""Every file that a user may start or copy is named on some page."""

import re
import subprocess
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
KNOWN_BY_NAME = {
    "LICENSE",
    "README.md",
    "CITATION.cff",
    "pyproject.toml",
    "Dockerfile",
    "Makefile",
}
"""Files at the top level that people and tools look for without being told."""


def list_files(*patterns: str) -> list[str]:
    listed = subprocess.run(
        ["git", "ls-files", *patterns], cwd=ROOT, check=True, capture_output=True, text=True
    )
    return listed.stdout.split()


def test_pages_name_all_examples_and_top_files() -> None:
    pages = [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]
    text = "\n".join(page.read_text(encoding="utf-8") for page in pages)
    named = set(re.findall(r"[\w.-]+", text))
    top_level = [
        name
        for name in list_files(":(glob)*")
        if not name.startswith(".") and name not in KNOWN_BY_NAME
    ]
    files = top_level + list_files("examples/*")
    assert len(files) > 20
    assert [name for name in files if Path(name).name not in named] == []
