"""Whether files are what they say: how they are built, and whether all of a session is there and right.

Law: one line per check, with where it fails. A file of anybody is judged by how it is built; only a log of
ours by what is in it. Nothing is executed: that is what `verify` does.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from ..errors import LogError
from .chunks import Progress
from .judging import Session
from .structure import Structure

MAX_TOLD = 1000
"""Problems that a finding keeps; more are counted."""


class Place(NamedTuple):
    """Something wrong, and where.

    Attributes:
        file: in which file.
        offset: at which byte, or of the chunk that begins there; None where it is a matter of the whole.
        text: what is wrong.
    """

    file: str
    offset: int | None
    text: str

    def __str__(self) -> str:
        return self.text if self.offset is None else f"byte {self.offset}: {self.text}"


class Finding(NamedTuple):
    """How one check came out.

    Attributes:
        check: its name: "whole", "checksums", "records", "index"; of our logs also "sequence", "accounts",
            "schema", "times", "rates", "scenario".
        passed: whether it passed.
        text: what was found.
        places: what is wrong, at most `MAX_TOLD`.
        wrong: how many things are wrong.
    """

    check: str
    passed: bool
    text: str
    places: list[Place]
    wrong: int


class Soundness(NamedTuple):
    """Files, judged.

    Attributes:
        findings: a check each.
        ours: whether they are a log of trilat-net; else only how they are built was judged.
    """

    findings: list[Finding]
    ours: bool

    @property
    def passed(self) -> bool:
        """True where every check passed."""
        return all(finding.passed for finding in self.findings)


def soundness(paths: Sequence[Path], progress: Progress | None = None) -> Soundness:
    """Looks at every byte of a file, or of files that are parts of one log.

    Args:
        paths: the files.
        progress: told how many bytes are looked at, and how many there are in all.

    Raises:
        LogError: a file cannot be read.
    """
    session = Session()
    files: list[tuple[str, Structure]] = []
    total = sum(_size(path) for path in paths)
    for path in sorted(paths, key=lambda path: path.name):
        before = sum(structure.size for _, structure in files)
        told = None if progress is None else _shifted(progress, before, total)
        try:
            with path.open("rb") as stream:
                structure = Structure(stream, told)
                session.read(str(path), structure)
        except OSError as error:
            raise LogError(f"{path}: cannot be read: {error.strerror}") from None
        files.append((str(path), structure))
    findings = [_built(check, files) for check in _BUILT]
    if session.ours:
        findings += [
            Finding(check, not tally.wrong, text, [Place(*place) for place in tally.places], tally.wrong)
            for check, text, tally in session.judged()
        ]
    return Soundness(findings, session.ours)


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError as error:
        raise LogError(f"{path}: cannot be read: {error.strerror}") from None


def _shifted(progress: Progress, before: int, total: int) -> Progress:
    return lambda done, _: progress(before + done, total)


_BUILT = {"whole": "whole", "crc": "checksums", "records": "records", "index": "index"}
"""Checks of how a file is built, as `Structure` calls them and as people do."""


def _built(check: str, files: Sequence[tuple[str, Structure]]) -> Finding:
    """Returns how a check of how the files are built came out."""
    places = [
        Place(name, problem.offset, problem.text)
        for name, structure in files
        for problem in structure.problems
        if problem.check == check
    ]
    wrong = sum(structure.wrong[check] for _, structure in files)
    text = _wrong_text(places, wrong) if wrong else _right_text(check, [structure for _, structure in files])
    return Finding(_BUILT[check], not wrong, text, places[:MAX_TOLD], wrong)


def _wrong_text(places: Sequence[Place], wrong: int) -> str:
    more = f"; and {wrong - 1} more" if wrong > 1 else ""
    return f"{places[0]}{more}" if places else f"{wrong} problems"


def _right_text(check: str, structures: Sequence[Structure]) -> str:
    size = sum(structure.size for structure in structures)
    chunks = sum(structure.chunks for structure in structures)
    messages = sum(structure.messages.total() for structure in structures)
    return {
        "whole": f"finished, {size / 1e6:.1f} MB",
        "crc": f"{sum(structure.crcs for structure in structures)} compared, all agree",
        "records": f"{messages} messages in {chunks} chunks, built as the format says",
        "index": "is what is there",
    }[check]
