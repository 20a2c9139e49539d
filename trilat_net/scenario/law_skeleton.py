"""The skeleton of a law of one's own, and its test.

Invariant: both work as they are written: the test passes, and neither replaces a file.
"""

import keyword
import re
from importlib import resources
from importlib.util import find_spec
from pathlib import Path

from ..errors import UsageError
from ..files import refuse_existing, write_whole

_FOLDER = resources.files("trilat_net") / "scenarios"
_TEMPLATES = {"": "_law.txt", "test_": "_law_test.txt"}


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
    file = Path(path)
    module = file.stem
    if file.suffix != ".py" or not module.isidentifier() or keyword.iskeyword(module):
        raise UsageError(f"{file}: a law is in a Python module, whose name is as in mylaw.py or my_law.py")
    files = {file.with_name(f"{prefix}{file.name}"): text for prefix, text in _TEMPLATES.items()}
    for one in files:
        refuse_existing(one, force=force)
    known = find_spec(module)
    if known is not None and not (known.origin and file.exists() and file.samefile(known.origin)):
        raise UsageError(f"{file}: Python has a module {module} already; choose another name")
    for one, template in files.items():
        text = (_FOLDER / template).read_text(encoding="utf-8")
        named = text.replace("MyLaw", name_skeleton_class(module)).replace("mylaw", module)
        write_whole(one, named, force=force)
    return list(files)


def name_skeleton_class(module: str) -> str:
    """Returns the class of a module's skeleton: MyLaw of mylaw and my_law, Spring of spring."""
    words = re.sub(r"(?<=[a-z0-9])law$", "_law", module).split("_")
    return "".join(word[:1].upper() + word[1:] for word in words) or "Law"
