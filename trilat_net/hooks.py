"""Lets a lower-level package call functions of a package that it must not import.

A package may import only packages of lower layers. Some methods of a low layer nevertheless
need functions of a higher one: `Log.plot`, for example, needs the drawing functions of the
package `presentation`. That package registers its function here under a name that describes its
purpose, and the method looks up the name with `find_hook`. Functions registered in this way are
called hooks.

`import_on_use` is for the `__init__.py` of packages. It imports a module only when one of its
names is first used, which makes programs start faster.

Invariant:
    - Registering a function imports nothing. Its module is imported when the function is first
      looked up.
    - `trilat_net/__init__.py` imports every package that registers functions. All hooks are
      therefore known before any other module of the program is imported.
"""

from collections.abc import Callable, Mapping
from functools import partial
from importlib import import_module
from typing import Any

_loaders: dict[str, Callable[[], Any]] = {}
"""Mapping from hook name to a function that imports and returns the registered function."""


def register_hooks(package: str, functions: Mapping[str, str]) -> None:
    """Registers functions of a higher-level package by name, for use in lower-level packages.

    A lower-level package, such as `log`, must not import a higher-level package, such as the
    ROS package. Instead, it looks up the registered function with `find_hook`, which imports
    the function's module only at that time.

    Args:
        package: Name of the package, `__name__` in its `__init__.py`.
        functions: Mapping from hook name to the function, as "module:function". The modules
            belong to `package`.
    """
    for hook, function in functions.items():
        module, _, name = function.partition(":")
        _loaders[hook] = partial(_import_function, f"{package}.{module}", name)


def find_hook(hook: str) -> Any:
    """Returns the function that a higher-level package registered under a name.

    A lower-level package can thus call the function without importing the higher-level one.

    Args:
        hook: Name of the hook, for example "plot a log".

    Raises:
        ModuleNotFoundError: A library required by the function is not installed.
        KeyError: No package has registered a function under this name.
    """
    return _loaders[hook]()


def import_on_use(package: str, modules: Mapping[str, str]) -> Callable[[str], Any]:
    """Returns a `__getattr__` for a package, which imports modules when first needed.

    Importing a name from the package then imports only the module that defines the name. If the
    package imported all of its modules, programs that need only a few of them would start
    slowly, and two packages that need each other's modules could not be imported.

    Args:
        package: Name of the package, `__name__` in its `__init__.py`.
        modules: Mapping from module to the public names that it defines, separated by spaces. A
            name equal to the module's name denotes the module itself.
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
    """Imports a function that a higher-level package has registered as a hook.

    The import takes place when a lower-level package first uses the hook.
    """
    return getattr(import_module(module), name)
