"""Runs code of users, if a person has permitted it: control laws, hands and plants.

- `imported_code` finds a class by its module and name, and imports it if it is permitted.
- `code_consent` manages permissions, for scenarios and logs that strangers may have written.
- `sent_channel` reads which vectors the source of a law sends, without running it.
- `class_arguments` checks the arguments that a scenario gives to a class.

Invariant:
    - Nothing outside this package imports a module that a scenario or a log names.
    - Nothing here knows the scenarios: a scenario is something with sites that name code.
"""
