"""Checks the arguments that a scenario passes to a user's class, and creates the instance.

The class is a control law, a hand (a program that moves an arm) or a plant (a model of an arm).
Its arguments are the keys that the user wrote next to its name. An argument that the class does
not have, or whose value has the wrong type, is rejected before any code of the class runs. The
error names the class, its file, the argument, and the arguments that the class accepts.
`list_default_arguments` reads the values of arguments that a scenario leaves out.
"""

import ast
import inspect
from collections.abc import Mapping
from typing import Any

from ..errors import ScenarioError, describe_exception, suggest_nearest

_TYPE_NAMES: dict[type, tuple[tuple[type, ...], str]] = {
    float: ((int, float), "a number"),
    int: ((int, float), "a number"),
    str: ((str,), "a text"),
}
"""Maps each checked type to the accepted types of values and the name of the type in error
messages.
"""


def make_own_instance(
    kind: Any, code: str, context: Any, settings: dict[str, Any], path: str
) -> Any:
    """Creates an instance of a user's class, after checking its arguments.

    A wrong argument is reported with its path in the scenario, like any other wrong key, and
    not as an exception within the class. A class without a constructor is created without any
    arguments.

    Args:
        kind: The class.
        code: Module and class, for example "mylaws:Spring", for error messages.
        context: First argument of the class: the facts about the site.
        settings: Keyword arguments of the class.
        path: Path in the scenario of the table with the arguments, for error messages.

    Raises:
        ScenarioError: An argument is unknown, missing or of the wrong type, or the class raised
            any exception.
    """
    _check_arguments(kind, code, settings, path)
    has_init = kind.__init__ is not object.__init__
    has_new = kind.__new__ is not object.__new__
    takes_arguments = has_init or has_new
    try:
        return kind(context, **settings) if takes_arguments else kind()
    except (Exception, SystemExit) as error:  # the user's code may raise any exception
        arguments = ", ".join(f"{key} = {value!r}" for key, value in settings.items())
        problem = (
            f"{code} cannot be created with {arguments or 'no settings'}: "
            f"{describe_exception(error)}"
        )
        raise ScenarioError(problem, path=path) from None


def _check_arguments(kind: Any, code: str, settings: Mapping[str, Any], path: str) -> None:
    """Raises ScenarioError if a user's class does not accept its arguments in the scenario.

    The arguments are compared with the constructor of the class before an instance is created,
    so that the error names the wrong key of the scenario.

    Args:
        kind: The class, whose first argument receives the facts about the site.
        code: Module and class, for example "mylaws:Spring", for error messages.
        settings: Maps the names of the keyword arguments to their values.
        path: Path in the scenario of the table with the arguments, for error messages.

    Raises:
        ScenarioError: The class has no such argument, an argument without a default is missing,
            or a value has the wrong type.
    """
    try:
        signature = inspect.signature(kind)
    except (TypeError, ValueError):
        return  # a class written in C has no signature, and rejects wrong arguments itself
    parameters = list(signature.parameters.values())[1:]  # without the facts about the site
    named = {
        parameter.name: parameter
        for parameter in parameters
        if parameter.kind in (parameter.POSITIONAL_OR_KEYWORD, parameter.KEYWORD_ONLY)
    }
    subject = _describe_class(kind, code)
    takes_any = any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters)
    accepted = "no arguments besides the facts about the site"
    if named:
        accepted = f"the arguments {', '.join(named)}"

    for name, value in settings.items():
        if name in named:
            _check_type(named[name], value, subject, path)
        elif not takes_any:
            hint = suggest_nearest(name, list(named))
            raise ScenarioError(
                f"{subject} has no argument {name}; its __init__ takes {accepted}{hint}",
                path=path,
            )
    for name, parameter in named.items():
        if parameter.default is parameter.empty and name not in settings:
            raise ScenarioError(
                f"{subject} needs a value for its argument {name}, which has no default; its "
                f"__init__ takes {accepted}",
                path=path,
            )


def _describe_class(kind: Any, code: str) -> str:
    """Returns the name of a user's class and the file of its constructor, for errors."""
    file = getattr(getattr(kind.__init__, "__code__", None), "co_filename", "")
    return f"{code} ({file})" if file else code


def _check_type(parameter: inspect.Parameter, value: Any, subject: str, path: str) -> None:
    """Raises ScenarioError if a value does not have the type that a user's class expects.

    The type is that of the annotation. Without an annotation, it is the type of the default.
    The class may then accept other types such as lists, so only a string in place of a number,
    or a number in place of a string, is rejected.

    Args:
        parameter: The argument.
        value: Its value in the scenario.
        subject: Name of the class, for the error message.
        path: Path of the table with the arguments, for the error message.
    """
    annotation = parameter.annotation
    if isinstance(annotation, str):  # a module with `from __future__ import annotations`
        types_by_name = {kind.__name__: kind for kind in _TYPE_NAMES}
        annotation = types_by_name.get(annotation)
    if parameter.annotation is parameter.empty:
        annotation = type(parameter.default)
        if not isinstance(value, str | int | float):
            return
    if annotation not in _TYPE_NAMES:
        return
    accepted, name = _TYPE_NAMES[annotation]
    if not isinstance(value, accepted):
        raise ScenarioError(
            f"{subject}: its argument {parameter.name} must be {name}, but is {value!r}",
            path=path,
        )


def list_default_arguments(content: bytes, name: str) -> dict[str, Any]:
    """Returns the default values of the arguments of a user's class, without running its file.

    A default that is not a literal is returned as its Python source text.

    Args:
        content: Content of the Python file.
        name: Name of the class.

    Returns:
        Maps the name of each argument to its default. Empty if the file does not define the
        arguments.
    """
    tree = ast.parse(content)
    classes = {node.name: node for node in tree.body if isinstance(node, ast.ClassDef)}
    law_class = classes.get(name)
    while law_class is not None:
        for member in law_class.body:
            if isinstance(member, ast.FunctionDef) and member.name == "__init__":
                return _list_defaults(member.args)
        # The class may have the arguments of a base class, which stands before it in the file.
        bases = [base.id for base in law_class.bases if isinstance(base, ast.Name)]
        law_class = classes.pop(bases[0], None) if bases else None
    return {}


def _list_defaults(arguments: ast.arguments) -> dict[str, Any]:
    """Maps the name of each argument of a Python function to its default value.

    Args:
        arguments: The arguments, as returned by Python's parser.
    """
    positional = [*arguments.posonlyargs, *arguments.args]
    # Only the last of the positional arguments have defaults.
    first = len(positional) - len(arguments.defaults)

    pairs = [
        *zip(positional[first:], arguments.defaults, strict=True),
        *zip(arguments.kwonlyargs, arguments.kw_defaults, strict=True),
    ]

    defaults = {}
    for argument, value in pairs:
        if value is None:  # an argument without a default
            continue
        try:
            defaults[argument.arg] = ast.literal_eval(value)
        except ValueError:
            defaults[argument.arg] = ast.unparse(value)
    return defaults
