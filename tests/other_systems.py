"""A process of this system that hides from the program all that Windows, macOS or Linux lacks.

The names of each system come from typeshed, which is a part of mypy. Only the modules of the
program are restricted, because Python's library and other packages have separate code for every
system. The process reports to be one of Windows, and lacks the functions that only Windows has.
"""

import ast
import json
import os
import sys
from collections.abc import Iterator
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from .house import ROOT, TOPS

OTHERS = ("win32", "darwin")

_START = """
import builtins, json, os, sys, types, warnings
from pathlib import Path

HERE = Path(__file__).parent
FACTS = json.loads((HERE / "facts.json").read_text("utf-8"))
SAYS = {"sys": {"platform": "win32"}, "os": {"name": "nt"}}
faces, really = {}, builtins.__import__
sys.modules["zenoh"] = None
warnings.filterwarnings("error", category=EncodingWarning, module=f"({'|'.join(FACTS['ours'])})([.]|$)")


class Face(types.ModuleType):
    def __init__(self, module):
        super().__init__(module.__name__)
        self.__dict__.update(SAYS.get(module.__name__, {}), real=module)

    def __getattr__(self, name):
        if name in FACTS["lacks"].get(self.__name__, ()):
            raise AttributeError(f"not every system has {self.__name__}.{name}")
        return getattr(self.real, name)


def imported(name, globals=None, locals=None, fromlist=(), level=0):
    importer = str((globals or {}).get("__package__") or (globals or {}).get("__name__"))
    if level or importer.partition(".")[0] not in FACTS["ours"]:
        return really(name, globals, locals, fromlist, level)
    if name in FACTS["refused"]:
        raise ModuleNotFoundError(f"not every system has {name}")
    (HERE / f"{os.getpid()}.process").touch()
    module = really(name, globals, locals, fromlist, level)
    known = module.__name__ in {**FACTS["lacks"], **SAYS}
    return faces.setdefault(module.__name__, Face(module)) if known else module


builtins.__import__ = imported
"""


def _list_names(body: list[ast.stmt], platform: str) -> Iterator[tuple[str, bool]]:
    """Yields what a stub declares for a platform, and whether it declares it itself."""
    facts = {"sys": SimpleNamespace(platform=platform, version_info=sys.version_info)}
    for node in body:
        if isinstance(node, ast.If):
            holds = eval(compile(ast.Expression(node.test), "", "eval"), facts)
            yield from _list_names(node.body if holds else node.orelse, platform)
        elif isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            yield node.name, True
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            yield from ((target.id, True) for target in targets if isinstance(target, ast.Name))
        elif isinstance(node, ast.ImportFrom):
            yield from ((alias.asname or alias.name, False) for alias in node.names)


@cache
def read_typeshed() -> tuple[dict[str, list[str]], list[str]]:
    """Returns the names of each module of Python that not every system has, and the modules."""
    spec = find_spec("mypy")
    assert spec is not None
    assert spec.origin is not None
    stubs = Path(spec.origin).parent / "typeshed" / "stdlib"
    lacks = {}
    refused = []
    for file in stubs.rglob("*.pyi"):
        body = ast.parse(file.read_text(encoding="utf-8")).body
        linux_names, *other_names = (
            set(_list_names(body, platform)) for platform in ("linux", *OTHERS)
        )
        if missing := {
            name for name, _ in linux_names.difference(set.intersection(*other_names))
        }:
            module = ".".join(file.relative_to(stubs).with_suffix("").parts).removesuffix(
                ".__init__"
            )
            lacks[module] = sorted(missing)
            if not all(
                any(is_own and not name.startswith("_") for name, is_own in names)
                for names in other_names
            ):
                refused.append(module)
    return lacks, refused


def replace_os(**functions: Any) -> Any:
    """Returns `os` for a module under test: it says that it is that of Windows, and has these functions."""
    return SimpleNamespace(**{**vars(os), "name": "nt", **functions})


def prepare_process(folder: Path) -> dict[str, str]:
    """Returns the environment of such a process and its workers; each leaves a file in a folder."""
    folder.mkdir()
    lacks, refused = read_typeshed()
    facts = {"lacks": lacks, "refused": refused, "ours": [*TOPS]}
    (folder / "facts.json").write_text(json.dumps(facts), encoding="utf-8")
    (folder / "sitecustomize.py").write_text(_START, encoding="utf-8")
    return {
        **os.environ,
        "PYTHONPATH": os.pathsep.join([str(folder), str(ROOT)]),
        "PYTHONIOENCODING": "cp1252",  # of a pipe in Western Europe
        "PYTHONWARNDEFAULTENCODING": "1",
        "LOCALAPPDATA": os.environ.get("XDG_CACHE_HOME", str(Path.home() / ".cache")),
    }
