"""Installs optional packages into this clone's `.venv`: `make extras EXTRAS=view,frames`.

Invariant: the versions are those of `requirements/dev.lock`, and their hashes are checked, wherever uv is
installed, which finds the packages that an extra needs; without uv pip installs the newest that fit.
"""

import re
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[1]
VENV = ROOT / ".venv"


def list_extras() -> dict[str, list[str]]:
    """Returns the extras that bring packages, by name."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    return {name: needs for name, needs in project["optional-dependencies"].items() if needs}


def parse_extras(text: str) -> list[str]:
    """Returns the names in a text, between commas or spaces.

    Raises:
        SystemExit: there is none, which succeeds and says which there are, or one is no extra.
    """
    extras = list_extras()
    names = [name for name in re.split(r"[\s,]+", text) if name]
    unknown = [name for name in names if name not in extras]
    if names and not unknown:
        return names
    usage = "which extras? as in: make extras EXTRAS=view"
    lines = [f"there is no extra {', '.join(unknown)}" if unknown else usage]
    lines += [f"  {name:8} {', '.join(needs)}" for name, needs in extras.items()]
    if not unknown:
        print("\n".join(lines))
        raise SystemExit(0)
    raise SystemExit("\n".join(lines))


def install_extras(names: list[str]) -> None:
    """Installs the packages of some extras.

    Raises:
        SystemExit: an installer failed; it has said why.
    """
    python = str(VENV / "bin" / "python")
    uv = VENV / "bin" / "uv"
    if not uv.exists():
        wanted = [need for name in names for need in list_extras()[name]]
        command = [
            python,
            "-m",
            "pip",
            "--disable-pip-version-check",
            "install",
            "--quiet",
            *wanted,
        ]
        raise SystemExit(subprocess.run(command, check=False).returncode)
    with tempfile.TemporaryDirectory() as scratch:
        lock = Path(scratch) / "extras.lock"
        of_extras = [word for name in names for word in ("--extra", name)]
        resolve = [
            uv,
            "pip",
            "compile",
            "--quiet",
            "pyproject.toml",
            *of_extras,
            "--generate-hashes",
        ]
        resolve += [
            "--python",
            python,
            "--constraints",
            "requirements/dev.lock",
            "--output-file",
            lock,
        ]
        install = [uv, "pip", "install", "--quiet", "--python", python, "--require-hashes"]
        install += ["--only-binary", ":all:", "-r", lock]
        for command in (resolve, install):
            if code := subprocess.run(command, cwd=ROOT, check=False).returncode:
                raise SystemExit(code)
    print(f"installed into {VENV.name}: {', '.join(names)}")


if __name__ == "__main__":
    install_extras(parse_extras(" ".join(sys.argv[1:])))
