"""Skeletons of code of one's own: a law, a hand or a plant that works, with comments, and its
test.

Invariant: a skeleton is a file of this package, as `scenarios/_law.txt`; mylaw.py gets the
class MyLaw. What is written runs as it is, and its test passes.
"""

import keyword
import re
from importlib.util import find_spec
from pathlib import Path

from ..errors import UsageError
from ..files import refuse_existing, write_whole
from .resolve import SHIPPED_FOLDER


def new_law(path: str | Path, *, force: bool = False) -> list[Path]:
    """Writes the skeleton of a law, and its test beside it; the command is `trilat new law`.

    >>> [path.name for path in tn.new_law("mylaw.py")]
    ['mylaw.py', 'test_mylaw.py']

    Args:
        path: the file, whose name becomes that of the module: mylaw.py has the class MyLaw.
        force: whether files of these names may be replaced.

    Raises:
        UsageError: a file exists, or Python would find another module by that name.
    """
    return _write_skeleton("law", Path(path), force=force)


def new_hand(path: str | Path, *, force: bool = False) -> list[Path]:
    """Writes the skeleton of a hand, a program that acts as a user, as `new_law`: `trilat new
    hand`.

    >>> [path.name for path in tn.new_hand("myhand.py")]
    ['myhand.py', 'test_myhand.py']
    """
    return _write_skeleton("hand", Path(path), force=force)


def new_plant(path: str | Path, *, force: bool = False) -> list[Path]:
    """Writes the skeleton of a plant, which moves an arm, as `new_law`: `trilat new plant`.

    >>> [path.name for path in tn.new_plant("myplant.py")]
    ['myplant.py', 'test_myplant.py']
    """
    return _write_skeleton("plant", Path(path), force=force)


def _write_skeleton(kind: str, file: Path, *, force: bool) -> list[Path]:
    module = file.stem
    if file.suffix != ".py" or not module.isidentifier() or keyword.iskeyword(module):
        named = f"my{kind}.py or my_{kind}.py"
        raise UsageError(f"{file}: a {kind} is in a Python module, whose name is as in {named}")
    files = {file: f"_{kind}.txt", file.with_name(f"test_{file.name}"): f"_{kind}_test.txt"}
    for one in files:
        refuse_existing(one, force=force)
    known = find_spec(module)
    if known is not None and not (
        known.origin and file.exists() and file.samefile(known.origin)
    ):
        raise UsageError(f"{file}: Python has a module {module} already; choose another name")
    for one, template in files.items():
        text = (SHIPPED_FOLDER / template).read_text(encoding="utf-8")
        named = text.replace(f"My{kind.title()}", name_skeleton_class(module, kind))
        write_whole(one, named.replace(f"my{kind}", module), force=force)
    return list(files)


def name_skeleton_class(module: str, kind: str = "law") -> str:
    """Returns the class of a module's skeleton: MyLaw of mylaw and my_law, Spring of spring."""
    words = re.sub(rf"(?<=[a-z0-9]){kind}$", f"_{kind}", module).split("_")
    return "".join(word[:1].upper() + word[1:] for word in words) or kind.title()
