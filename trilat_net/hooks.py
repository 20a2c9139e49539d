"""Lets a package call a function of a package that it must not import.

A package may import only packages of lower layers. Nevertheless `Log.plot`, a method of a low
layer, needs the drawing functions of the higher package `presentation`. Therefore
`presentation` registers its function here under the name of its purpose, and the method looks
up this name with `find_hook`. Such a registered function is called a hook.

`import_on_use` serves the `__init__.py` of packages: it imports a module only when somebody
uses one of its names, so that programs start fast.

Invariant:
    - Registering imports nothing. The module of a function is imported when the function is
      first looked up.
    - `trilat_net/__init__.py` imports every package that registers functions. All hooks are
      therefore known before any other module of the program is imported.
"""

from collections.abc import Callable, Mapping
from functools import partial
from importlib import import_module
from typing import Any

_loaders: dict[str, Callable[[], Any]] = {}
"""For each hook, a function that imports the registered function and returns it."""


def register_hooks(package: str, functions: Mapping[str, str]) -> None:
    """Registers functions of an upper package by name, so that lower packages can call them.

    A lower package, such as `log`, must not import an upper package, such as the ROS package.
    It looks up the registered function instead (`find_hook`). The modules are imported only
    then.

    Args:
        package: Name of the package, `__name__` in its `__init__.py`.
        functions: For each hook, the function as "module:function". The modules belong to
            `package`.
    """
    for hook, function in functions.items():
        module, _, name = function.partition(":")
        _loaders[hook] = partial(_import_function, f"{package}.{module}", name)


def find_hook(hook: str) -> Any:
    """Returns the function that an upper package has registered under a name.

    A lower package can thus call a function that it must not import.

    Args:
        hook: Name of the hook, as in "plot a log".

    Raises:
        ModuleNotFoundError: A library that the function needs is not installed.
        KeyError: No package has registered a function under this name.
    """
    return _loaders[hook]()


def list_hooks() -> list[str]:
    """Returns the names under which upper packages have registered functions, for the tests."""
    return list(_loaders)


def import_on_use(package: str, modules: Mapping[str, str]) -> Callable[[str], Any]:
    """Returns the `__getattr__` of a package, which imports a module when it is first needed.

    Importing a name from the package therefore imports only the module that defines the name.
    If the package imported all of its modules, programs that need few of them would start late,
    and two packages that need each other's modules could not be imported.

    Args:
        package: Name of the package, `__name__` in its `__init__.py`.
        modules: For each module, the names of the interface that it defines, separated by
            spaces. If a name equals the name of the module, it stands for the module itself.
    """
    module_of_name = {}
    for module_name, names in modules.items():
        for name in names.split():
            module_of_name[name] = f"{package}.{module_name}"

    def find_name(name: str) -> Any:
        full_module_name = module_of_name.get(name)
        if full_module_name is None:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        module = import_module(full_module_name)
        is_module_itself = full_module_name.endswith(f".{name}")
        return module if is_module_itself else getattr(module, name)

    return find_name


def _import_function(module: str, name: str) -> Any:
    """Imports a function that an upper package has registered as a hook.

    The import happens when a lower package uses the hook for the first time.
    """
    return getattr(import_module(module), name)
