"""What a check has found wrong so far: all of it counted, the first of it kept."""

from dataclasses import dataclass, field

MOST = 1000
"""Places that a tally keeps."""


@dataclass(slots=True)
class Tally:
    """What is wrong, of one kind.

    Attributes:
        wrong: how many things.
        places: the first of them: in which file, at which byte (None: the whole), what.
    """

    wrong: int = 0
    places: list[tuple[str, int | None, str]] = field(default_factory=list)

    def tell(self, file: str, offset: int | None, text: str) -> None:
        """Takes in that something is wrong."""
        self.wrong += 1
        if len(self.places) < MOST:
            self.places.append((file, offset, text))

    def text(self) -> str:
        """Returns the first of it, and how much more there is."""
        _, offset, text = self.places[0]
        first = text if offset is None else f"byte {offset}: {text}"
        return f"{first}; and {self.wrong - 1} more" if self.wrong > 1 else first
