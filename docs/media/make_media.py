"""Makes the pictures of README.md, docs/gallery.md and docs/tutorials/first-result.md.

python docs/media/make_media.py [NAME...]

`moving_picture.py` draws that of README.md, and `report_picture.py` the report of
first-result.md, for which Chromium must be installed. A section of the gallery has a picture, as
in `![...](img/gallery/wall/contact/contact.png)`, and a block of commands, which write
`contact/contact.png` into the folder in which they run. NAME is the name of such a folder, here
`wall`; without one, all pictures are made.

Invariant:
    - The page is the only list of pictures. A command that a reader copies from it makes the
      picture that stands above it.
    - Equal versions of the program and of matplotlib give equal bytes.
"""

import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "gallery.md"
PICTURES = ROOT / "docs" / "img" / "gallery"
MAKE_ALL = "make media"
"""Block of the pictures that `moving_picture.py` draws, and not a command of the program."""


class Picture(NamedTuple):
    """A picture of the gallery.

    Attributes:
        title: Heading of its section.
        path: Name of the folder in which the commands run, and the path of the picture in it.
        commands: The commands that make it, one per line.
    """

    title: str
    path: Path
    commands: str


def read_gallery(text: str) -> Iterator[Picture]:
    """Yields the pictures of the gallery that commands of the program make.

    Args:
        text: Text of the page.
    """
    for section in text.split("\n## ")[1:]:
        title = section.partition("\n")[0]
        paths = re.findall(r"!\[[^\]]*\]\(img/([^)]+)\)", section)
        blocks = re.findall(r"^```sh\n(.*?)^```$", section, re.DOTALL | re.MULTILINE)
        for path, commands in zip(paths, blocks, strict=True):
            if commands.strip() != MAKE_ALL:
                yield Picture(title, Path(path.removeprefix("gallery/")), commands)


def make_picture(picture: Picture, folder: Path) -> Path:
    """Runs the commands of a picture in a new folder, and returns the path of the picture.

    Args:
        picture: The picture.
        folder: Folder in which the new folder is made.
    """
    # The first part of the path names the picture, and the rest is what the commands write.
    work_folder = folder / picture.path.parts[0]
    work_folder.mkdir()
    programs = Path(sys.executable).parent
    environment = {**os.environ, "PATH": f"{programs}{os.pathsep}{os.environ['PATH']}"}
    subprocess.run(
        ["sh", "-e", "-c", picture.commands],
        cwd=work_folder,
        env=environment,
        stdin=subprocess.DEVNULL,
        check=True,
    )
    return folder / picture.path


def main() -> None:
    """Makes the pictures that the command line names, or all of them."""
    wanted = sys.argv[1:]
    if not wanted:
        for program in ("moving_picture.py", "report_picture.py"):
            path = Path(__file__).with_name(program)
            subprocess.run([sys.executable, path], check=True)
    with tempfile.TemporaryDirectory() as folder:
        for picture in read_gallery(PAGE.read_text(encoding="utf-8")):
            if wanted and picture.path.parts[0] not in wanted:
                continue
            new_path = make_picture(picture, Path(folder))
            kept_path = PICTURES / picture.path
            kept_path.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(new_path, kept_path)
            print(f"{picture.title}: {kept_path.stat().st_size / 1000:.0f} kB", flush=True)


if __name__ == "__main__":
    main()
