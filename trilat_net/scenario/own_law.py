"""A control law of somebody's own, as a scenario names it: `law = "package.module:Law"`.

Law: the scenario holds the hash of the file that the law is in, so that a log says whether the law that is
executed again is the one that ran. Naming a law runs nothing; a site that is built imports it.
"""

import hashlib
import importlib
import importlib.util
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

from msgspec import Meta, field

from ..core.arm import Array
from ..core.own import Facts, OwnLaw, OwnLawMaker
from ..core.setup import Gains, Law
from ..errors import ScenarioError
from .frozen import Frozen

CODE = r"^[A-Za-z_][\w.]*:[A-Za-z_]\w*$"


class Own(Frozen, frozen=True, tag_field="law", tag="own"):
    """A law from outside.

    Attributes:
        code: where it is, as in "package.module:Law".
        source_sha256: hash of the file of that module.
        settings: what it is made with, by name.
    """

    code: Annotated[str, Meta(pattern=CODE, max_length=200)]
    source_sha256: Annotated[str, Meta(pattern=r"^[0-9a-f]{64}$")]
    settings: dict[str, Any] = field(default_factory=dict)

    def gains(self, theta: Array) -> Gains:  # noqa: ARG002 - as the other laws
        """Returns the numbers for the core: none but which law."""
        return Gains(Law.OWN)

    @property
    def maker(self) -> OwnLawMaker:
        """What makes the law, in a site that is being built."""

        def make(facts: Facts) -> OwnLaw:
            kind = _found(self.code)
            _check_methods(kind, self.code, facts.site)  # before anything of it is called
            try:
                law: OwnLaw = kind(facts, **self.settings)
            except Exception as error:  # somebody's code
                raise ScenarioError(
                    f"{self.code} cannot be made with {', '.join(self.settings) or 'no settings'}: "
                    f"{type(error).__name__}: {error}",
                    path=f"sites.{facts.site}.control",
                ) from None
            return law

        return make

    def changed(self) -> str | None:
        """Says how the law differs from the one that the scenario names; None where it does not."""
        try:
            now = source_sha256(self.code, "control.law")
        except ScenarioError as error:
            return error.problem
        return None if now == self.source_sha256 else f"the file of {self.code} was changed"


def source_sha256(code: str, path: str) -> str:
    """Returns the hash of the file that a law is in.

    Args:
        code: where it is.
        path: what errors call the key.

    Raises:
        ScenarioError: there is no such file.
    """
    return hashlib.sha256(_file(code, path).read_bytes()).hexdigest()


def _check_methods(kind: Any, code: str, site: str) -> None:
    """Refuses what is no law; a log that names any other thing of a machine's modules runs nothing of it."""
    path = f"sites.{site}.control.law"
    if not isinstance(kind, type):
        raise ScenarioError(f"{code} is no class; see docs/own-controller.md", path=path)
    missing = [name for name in ("torque", "memory", "recall") if not callable(getattr(kind, name, None))]
    if missing:
        raise ScenarioError(f"{code} has no {', '.join(missing)}; see docs/own-controller.md", path=path)


def _file(code: str, path: str) -> Path:
    module = code.partition(":")[0]
    with _here():
        try:
            spec = importlib.util.find_spec(module)
        except (ImportError, ValueError) as error:
            raise ScenarioError(f"{module} cannot be found: {error}", path=path) from None
    if spec is None or spec.origin is None or not Path(spec.origin).is_file():
        raise ScenarioError(
            f"there is no module {module}; it must be installed, or lie in the folder that you are in",
            path=path,
        )
    return Path(spec.origin)


def _found(code: str) -> Any:
    module, _, name = code.partition(":")
    _file(code, "control.law")
    with _here():
        try:
            return getattr(importlib.import_module(module), name)
        except AttributeError:
            raise ScenarioError(f"{module} has no {name}", path="control.law") from None
        except Exception as error:  # somebody's code
            raise ScenarioError(
                f"{module} cannot be imported: {type(error).__name__}: {error}", path="control.law"
            ) from None


@contextmanager
def _here() -> Iterator[None]:
    """Lets modules be found in the folder that the person is in."""
    here = str(Path.cwd())
    if here in sys.path:
        yield
        return
    sys.path.insert(0, here)
    try:
        yield
    finally:
        sys.path.remove(here)
