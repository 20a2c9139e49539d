"""Runs user-written code, once a person has permitted it.

A scenario may name user-written classes: control laws, programs that move an arm, and plants
(simulations of an arm). Since a scenario may come from an unknown author, its code must not run
without permission.

- `imported_code` finds a class by module and name, and imports it if permitted.
- `code_consent` manages permissions, for scenarios and logs from unknown authors.
- `sent_channel` reads which vectors a law sends from its source, without running it.
- `class_arguments` checks the arguments that a scenario passes to a class.

Invariant:
    - Nothing outside this package imports a module that a scenario or a log names.
    - This package does not import the types of a scenario: it accepts any object whose sites
      name code.
"""

from typing import TYPE_CHECKING

from ..hooks import import_on_use

__all__ = [
    # Permissions
    "LawFiles",
    "LoggedUserLaw",
    "allow_logged_code",
    "allow_own_code",
    "list_named_code",
    # Import
    "CLASS_PATTERN",
    "CodeConsents",
    "CodeKey",
    "ImportedLaw",
    "Watch",
    "allowed_code",
    "allowing_any_settings",
    "call_directly",
    "import_named_class",
    "make_own_instance",
    "name_law_classes",
    "read_code",
    # Vectors that a law sends
    "parse_classes",
    "read_sends",
]

if TYPE_CHECKING:
    from .class_arguments import make_own_instance
    from .code_consent import (
        LawFiles,
        LoggedUserLaw,
        allow_logged_code,
        allow_own_code,
        import_named_class,
        list_named_code,
    )
    from .imported_code import (
        CLASS_PATTERN,
        CodeConsents,
        CodeKey,
        ImportedLaw,
        Watch,
        allowed_code,
        allowing_any_settings,
        call_directly,
        name_law_classes,
        read_code,
    )
    from .sent_channel import parse_classes, read_sends
else:
    __getattr__ = import_on_use(
        __name__,
        {
            "class_arguments": "make_own_instance",
            "code_consent": (
                "LawFiles LoggedUserLaw allow_logged_code allow_own_code import_named_class "
                "list_named_code"
            ),
            "imported_code": (
                "CLASS_PATTERN CodeConsents CodeKey ImportedLaw Watch allowed_code "
                "allowing_any_settings call_directly name_law_classes read_code"
            ),
            "sent_channel": "parse_classes read_sends",
        },
    )
