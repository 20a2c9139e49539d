"""The view of a program in its own process on a folder that contains a planted file."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import trilat_net


def look(program: str, folder: Path) -> Any:
    """The JSON that a program prints in its last line."""
    command = [sys.executable, "-c", program, str(folder)]
    out = subprocess.run(command, capture_output=True, text=True, cwd=folder, check=False)
    assert out.returncode == 0, out.stderr
    return json.loads(out.stdout.splitlines()[-1])


def put_beside(folder: Path, room: str, file: str, text: str) -> None:
    """Puts a file beside those of a room of the package, in a copy made of links below `folder`."""
    at, of = folder / "trilat_net", Path(trilat_net.__file__).parent
    for below in (*Path(room).parts, ""):
        if at.is_symlink():  # of a file put beside others before
            at.unlink()
        at.mkdir(exist_ok=True)
        for source in of.iterdir():
            if source.name not in (below, "__pycache__") and not (at / source.name).exists():
                (at / source.name).symlink_to(source)
        at, of = at / below, of / below
    (at / file).write_text(text)
