"""A program in its own process, started in a folder that contains a planted file."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import trilat_net


def run_in_folder(program: str, folder: Path) -> Any:
    """Returns the JSON in the last line that a program prints."""
    command = [sys.executable, "-c", program, str(folder)]
    out = subprocess.run(command, capture_output=True, text=True, cwd=folder, check=False)
    assert out.returncode == 0, out.stderr
    return json.loads(out.stdout.splitlines()[-1])


def put_beside(folder: Path, room: str, file: str, text: str) -> None:
    """Adds a file to a subpackage, in a copy of the package that consists of links below `folder`."""
    at = folder / "trilat_net"
    of = Path(trilat_net.__file__).parent
    for below in (*Path(room).parts, ""):
        if at.is_symlink():  # of a file put beside others before
            at.unlink()
        at.mkdir(exist_ok=True)
        for source in of.iterdir():
            if source.name not in (below, "__pycache__") and not (at / source.name).exists():
                (at / source.name).symlink_to(source)
        at = at / below
        of = of / below
    (at / file).write_text(text)
