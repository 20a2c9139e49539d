"""Writes skeleton files for users' own control laws, operators and plants.

`new_law`, `new_hand` and `new_plant` each write a minimal class and a test for it, so users can
start from working code.

Invariant:
    - The skeletons are files of this package, such as `scenarios/_law.txt`. The name of the
      class is derived from the file name: mylaw.py contains the class MyLaw.
    - The generated code runs unchanged, and its test passes.
"""

import keyword
import re
from importlib.util import find_spec
from pathlib import Path

from ..errors import UsageError
from ..files import refuse_existing, write_whole
from .named_files import SHIPPED_FOLDER


def new_law(path: str | Path, *, force: bool = False) -> list[Path]:
    """Writes a template for a control law, and a test for it.

    Equivalent to the command `trilat new law`.

    >>> [path.name for path in tn.new_law("mylaw.py")]
    ['mylaw.py', 'test_mylaw.py']

    Args:
        path: Python module to write. For example, mylaw.py will contain the class MyLaw.
        force: If True, existing files are overwritten.

    Returns:
        Paths of the files written.

    Raises:
        UsageError: A file already exists, or Python has another module of that name.
    """
    return _write_skeleton("law", Path(path), force=force)


def new_hand(path: str | Path, *, force: bool = False) -> list[Path]:
    """Writes a template for an operator, and a test for it.

    The operator is a program that moves an arm in place of a person. Equivalent to the command
    `trilat new hand`. See `new_law` for the arguments.

    >>> [path.name for path in tn.new_hand("myhand.py")]
    ['myhand.py', 'test_myhand.py']
    """
    return _write_skeleton("hand", Path(path), force=force)


def new_plant(path: str | Path, *, force: bool = False) -> list[Path]:
    """Writes a template for a plant, and a test for it.

    The plant is a program that computes the motion of an arm. Equivalent to the command `trilat
    new plant`. See `new_law` for the arguments.

    >>> [path.name for path in tn.new_plant("myplant.py")]
    ['myplant.py', 'test_myplant.py']
    """
    return _write_skeleton("plant", Path(path), force=force)


def _write_skeleton(kind: str, file: Path, *, force: bool) -> list[Path]:
    """Writes a Python file with a template for a class, and a file with its test.

    Args:
        kind: "law", "hand" or "plant".
        file: Path of the skeleton.
        force: If True, existing files are overwritten.

    Raises:
        UsageError: A file already exists, its name is not a valid module name, or Python has
            another module of that name.
    """
    module = file.stem
    is_module_name = module.isidentifier() and not keyword.iskeyword(module)
    if file.suffix != ".py" or not is_module_name:
        examples = f"my{kind}.py or my_{kind}.py"
        raise UsageError(
            f"{file}: a {kind} must be in a Python module with a name such as {examples}"
        )
    templates = {
        file: f"_{kind}.txt",
        file.with_name(f"test_{file.name}"): f"_{kind}_test.txt",
    }
    for new_file in templates:
        refuse_existing(new_file, force=force)
    if _is_other_module(module, file):
        raise UsageError(f"{file}: Python already has a module {module}; choose another name")
    for new_file, template in templates.items():
        text = (SHIPPED_FOLDER / template).read_text(encoding="utf-8")
        text = text.replace(f"My{kind.title()}", name_skeleton_class(module, kind))
        text = text.replace(f"my{kind}", module)
        write_whole(new_file, text, force=force)
    return list(templates)


def _is_other_module(module: str, file: Path) -> bool:
    """Returns True if the name of a new module is already taken by another Python module."""
    spec = find_spec(module)
    if spec is None:
        return False
    if spec.origin is None or not file.exists():
        return True
    return not file.samefile(spec.origin)


def name_skeleton_class(module: str, kind: str) -> str:
    """Derives the name of the class in a skeleton file from the module name.

    For example, the modules mylaw and my_law contain the class MyLaw, and the module spring
    contains Spring.

    Args:
        module: Name of the Python module that contains the skeleton.
        kind: "law" for a control law, "hand" for an operator, or "plant".
    """
    parts = re.sub(rf"(?<=[a-z0-9]){kind}$", f"_{kind}", module).split("_")
    return "".join(part[:1].upper() + part[1:] for part in parts) or kind.title()
