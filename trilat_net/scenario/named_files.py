"""Reads the files named in a scenario: URDF files of arms and recorded delays of links.

A complete scenario contains the contents of these files instead of their names.

Invariant:
    - Files can be named only if a folder is given. A scenario from a log or from another
      computer must not read files on this computer.
"""

from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import NamedTuple

from ..errors import ScenarioError
from ..fields import TomlTable
from ..files import open_regular
from .delay_traces import read_trace
from .urdf import MAX_CHARACTERS

SHIPPED_FOLDER = resources.files("trilat_net") / "scenarios"


class NamedFiles(NamedTuple):
    """Files named in a scenario: the folder to search, and the contents of the URDF files.

    Other files, such as delay traces, are read from the folder when needed.

    Attributes:
        folder: Folder in which files are looked up. If None, every file is rejected.
        urdf_texts: Mapping from name to content of the arms' URDF files.
    """

    folder: Path | None
    urdf_texts: dict[str, str]

    @classmethod
    def of_arms(
        cls, tables: TomlTable, embedded_texts: Mapping[str, str], folder: Path | None
    ) -> "NamedFiles":
        """Reads every URDF file that an arm of a scenario names.

        A file embedded in the scenario takes precedence over a file shipped with the package,
        which takes precedence over a file in `folder`.

        Args:
            tables: Tables of the scenario file.
            embedded_texts: Table `urdf` of the scenario, a mapping from file name to content.
            folder: Folder in which files are looked up. If None, a scenario that names a file
                is rejected.

        Raises:
            ScenarioError: A file cannot be read, or must be read although `folder` is None.
        """
        arms = {"arm": tables.get("arm", {})}
        arms |= {
            f"sites.{name}.arm": site.get("arm", {}) for name, site in tables["sites"].items()
        }
        texts: dict[str, str] = {}
        for path, arm in arms.items():
            name = arm.get("urdf")
            if not name or name in texts:
                continue
            text = embedded_texts.get(name)
            if text is None:
                text = _read_urdf(name, folder, f"{path}.urdf")
            texts[name] = use_unix_line_ends(text)
        return cls(folder, texts)

    def list_used_texts(self, sites: TomlTable) -> dict[str, str]:
        """Returns a mapping from name to content of the URDF files that the sites use.

        A file named in `[arm]` is unused if every site has its own arm.

        Args:
            sites: Mapping from site name to the complete table of the site.
        """
        used_names = [site["arm"].get("urdf") for site in sites.values()]
        return {name: text for name, text in self.urdf_texts.items() if name in used_names}

    def read_trace(self, link: TomlTable, name: str, path: str) -> str:
        """Returns the delay trace of a link, from its table or from the file that it names.

        The file is either a CSV file of times and delays, or a log. From a log, the delays of
        the link named by the key `of` are read, by default those of the link `name`.

        Args:
            link: Table of a link with the delay model "trace".
            name: Name of the link.
            path: Path of the table that names the file, for error messages.

        Raises:
            ScenarioError: The keys contradict each other, or the file cannot be used.
        """
        file_path = f"{path}.file"
        if "file" not in link:
            if "trace" not in link:
                raise ScenarioError(
                    "is missing; name a table or a log of delays", path=file_path
                )
            if "of" in link:
                raise ScenarioError(
                    "needs the key file, which must name the log that contains this link",
                    path=f"{path}.of",
                )
            return str(link["trace"])
        if "trace" in link:
            raise ScenarioError("give either trace or file, not both", path=file_path)
        if self.folder is None:
            raise ScenarioError("no file may be named here", path=file_path)
        try:
            return read_trace(_find_file(link["file"], self.folder), link.get("of", name))
        except ScenarioError as error:
            raise ScenarioError(error.problem, path=file_path) from None


def _read_urdf(name: str, folder: Path | None, path: str) -> str:
    """Reads a URDF file.

    Reads at most one character more than allowed, so a huge file cannot fill the memory. The
    parser then rejects the text as too long.

    Args:
        name: Name of the file, as given in the arm table.
        folder: Folder of the scenario. If None, the file is rejected.
        path: Path of the key that names the file, for error messages.

    Raises:
        ScenarioError: The file cannot be read, or `folder` is None.
    """
    if folder is None:
        raise ScenarioError("no file may be named here", path=path)
    try:
        with open_regular(_find_file(name, folder), encoding="utf-8") as stream:
            text: str = stream.read(MAX_CHARACTERS + 1)
        return text
    # A ValueError is raised for text that is not UTF-8, and for a name with a null character.
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or "not UTF-8 text"
        raise ScenarioError(f"{name} cannot be read: {reason}", path=path) from None


def _find_file(name: str, folder: Path) -> Path:
    """Returns the path of a file named in a scenario, in the package or in the user's folder.

    A file shipped with the package takes precedence, but only for a name with no folder. The
    returned path need not exist.
    """
    shipped = Path(str(SHIPPED_FOLDER / name))
    is_plain_name = "/" not in name and "\\" not in name
    return shipped if is_plain_name and shipped.is_file() else folder / name


def use_unix_line_ends(text: str) -> str:
    r"""Converts all line ends to line feeds.

    A file written on Windows would otherwise have a different hash and count as a different
    experiment.
    """
    return text.replace("\r\n", "\n").replace("\r", "\n")
