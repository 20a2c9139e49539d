"""Renders web pages from the Jinja templates in the folder `templates`.

`report.html` is the page that reports a run. The other templates contain macros, each for a
piece of HTML such as a table. The `page_...` modules compute the values for their sections of
the report; all HTML is in the templates.

Invariant:
    - Templates escape every plain string. Only `Markup` values, which are the results of other
      templates or files of this package, are inserted as HTML.
    - Referring to a value that was not passed to the template raises an error.
    - This module imports Jinja, and is itself imported only when HTML is rendered.
"""

import json
import re
from functools import cache, partial
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape

from .untrusted_text import HASH

_CODE = re.compile(r"`([^`]+)`")
"""Matches text in backticks, which the page shows as code."""


def render_template(name: str, /, **values: Any) -> Markup:
    """Renders a complete Jinja template, such as the web page of a report.

    Plain strings are escaped, so that they cannot inject HTML.

    Args:
        name: File name of the template.
        **values: Values of the template's variables.
    """
    return Markup(_make_environment().get_template(name).render(values))


def render_macro(template: str, macro: str, /, **values: Any) -> Markup:
    """Renders a single macro of a Jinja template, for example a table.

    Args:
        template: File name of the template.
        macro: Name of the macro.
        **values: Arguments of the macro.
    """
    macros = _make_environment().get_template(template).module
    return Markup(getattr(macros, macro)(**values))


@cache
def _make_environment() -> Environment:
    """Returns the Jinja environment of the report: settings and functions for all templates.

    The result is cached, so that each template is compiled only once.
    """
    environment = Environment(
        loader=PackageLoader(__package__, "templates"),
        autoescape=True,
        keep_trailing_newline=True,
        undefined=StrictUndefined,
    )
    environment.globals["zip"] = zip
    environment.filters["code"] = _mark_code
    environment.filters["hashes"] = _mark_hashes

    # JSON has no NaN and no infinity. Texts are written as they are, not as escape sequences.
    dump = partial(json.dumps, allow_nan=False, ensure_ascii=False)
    environment.policies["json.dumps_function"] = dump
    environment.policies["json.dumps_kwargs"] = {}
    return environment


def _mark_hashes(text: str) -> Markup:
    """Converts plain text to HTML, keeping each hash on a single line for copying.

    A hash is a long hexadecimal number that identifies a file.

    Args:
        text: Plain text.
    """
    # `str`, because the parts that `sub` joins are escaped again if the text is `Markup`.
    return Markup(HASH.sub(r'<span style="white-space:nowrap">\g<0></span>', str(escape(text))))


def _mark_code(text: str) -> Markup:
    """Converts plain text to HTML, showing text in backticks as code."""
    return Markup(_CODE.sub(r"<code>\1</code>", str(escape(text))))
