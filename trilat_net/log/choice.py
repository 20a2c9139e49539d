"""Which channels a log takes: by key expressions, as Zenoh has them.

Law: what is not chosen has no channel in the file and owes it nothing; the file says what was chosen.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass

from ..errors import UsageError
from ..net.bus import matches


@dataclass(frozen=True, slots=True)
class Choice:
    """What is taken.

    Attributes:
        include: key expressions of the only channels that are; none: all.
        exclude: key expressions of channels that are not.
    """

    include: tuple[str, ...] = ()
    exclude: tuple[str, ...] = ()

    def takes(self, key: str) -> bool:
        """Says whether a channel is taken."""
        if any(matches(expression, key) for expression in self.exclude):
            return False
        return not self.include or any(matches(expression, key) for expression in self.include)

    def facts(self) -> Mapping[str, str]:
        """Returns what the file says of it; nothing where all is taken."""
        told = {"include": " ".join(self.include), "exclude": " ".join(self.exclude)}
        return {name: text for name, text in told.items() if text}


ALL = Choice()


def choice(include: Collection[str], exclude: Collection[str]) -> Choice:
    """Returns what a person asks for; a leading slash, as topics have it, is fine.

    Raises:
        UsageError: a text is no key expression: it would match nothing, and say nothing.
    """
    for option, texts in (("--include", include), ("--exclude", exclude)):
        for text in texts:
            if not all(_is_chunk(chunk) for chunk in text.strip("/").split("/")):
                raise UsageError(
                    f"{option} is a key expression like 'trilat/*/m1/**' or '**/link': names, * for one of "
                    f"them, ** for any number, $* for a part of one; not {text!r}"
                )
    return Choice(tuple(text.strip("/") for text in include), tuple(text.strip("/") for text in exclude))


def _is_chunk(chunk: str) -> bool:
    rest = chunk.replace("$*", "")
    return chunk in ("*", "**") or bool(chunk and not set(rest) & set("*$#?"))
