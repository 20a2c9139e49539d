"""The control laws that a scenario can choose, their gains, and laws imported from a user's module.

Invariant: each law states its source and the condition of its stability, and says if that condition is
only sufficient. Symbols are the paper's; gains are diagonal, one number per joint or parameter.

A user's law is named `law = "package.module:Law"`. The scenario holds the hash of the file that defines
it, so a log shows if the law executed again is the one that ran. Naming a law runs nothing, not even the
package that contains it; building a site imports it, and only if that file defines a class of that name.
"""

import ast
import hashlib
import importlib
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.machinery import ModuleSpec
from pathlib import Path
from typing import Annotated, Any

from msgspec import Meta, field

from ..core.site_setup import Gains, Law
from ..core.user_law import LawContext, UserLaw, UserLawFactory
from ..core.vectors import Array
from ..errors import ScenarioError
from .fields import (
    MAX_QUANTITY,
    Frozen,
    NotNegative,
    NotNegativeJoints,
    NotNegativeParameters,
    Parameters,
    PositiveJoints,
)

LAW_PATH_PATTERN = r"^[A-Za-z_]\w*(\.[A-Za-z_]\w*)*:[A-Za-z_]\w*$"
_METHODS = ("torque", "memory", "recall")

_imported: dict[str, str] = {}
"""Per module that a law came from the hash that its file had when it was imported."""


class ImportedLaw(Frozen, frozen=True, tag_field="law", tag="own"):
    """A law from outside.

    Attributes:
        code: where it is, as in "package.module:Law".
        source_sha256: hash of the file of that module.
        settings: what it is made with, by name.
    """

    code: Annotated[str, Meta(pattern=LAW_PATH_PATTERN, max_length=200)]
    source_sha256: Annotated[str, Meta(pattern=r"^[0-9a-f]{64}$")]
    settings: dict[str, Any] = field(default_factory=dict)

    def gains(self, theta: Array) -> Gains:  # noqa: ARG002 - as the other laws
        """Returns the numbers for the core: none but which law."""
        return Gains(Law.OWN)

    def maker(self, sites: int) -> UserLawFactory:
        """Returns what makes the law, in a site that is being built.

        Args:
            sites: how many sites the experiment has.
        """

        def make(facts: LawContext) -> UserLaw:
            kind = _found(self.code, f"sites.{facts.site}.control.law")
            _check_kind(kind, self.code, facts, sites)  # before anything of it is called
            try:
                law: UserLaw = kind(facts, **self.settings)
            except (Exception, SystemExit) as error:  # somebody's code
                given = ", ".join(f"{key} = {value!r}" for key, value in self.settings.items())
                raise ScenarioError(
                    f"{self.code} cannot be made with {given or 'no settings'}: "
                    f"{type(error).__name__}: {error}",
                    path=f"sites.{facts.site}.control",
                ) from None
            return law

        return make

    def check_unchanged(self, site: str) -> None:
        """Refuses to begin with another law than the scenario names.

        Raises:
            ScenarioError: the law's file is not there, or is another one.
        """
        path = f"sites.{site}.control"
        if source_sha256(self.code, f"{path}.law") != self.source_sha256:
            raise ScenarioError(
                f"the file of {self.code} is not the one that the scenario names by this hash; put that one "
                f"there, or write law = {self.code!r} to take the one that is",
                path=f"{path}.source_sha256",
            )

    def changed(self) -> str | None:
        """Says how the law's file differs from the one that the scenario names; None where it does not.

        Raises:
            ScenarioError: there is no such file.
        """
        now = source_sha256(self.code, "control.law")
        if now == self.source_sha256:
            return None
        return f"its sha256 is {now[:16]}, and was {self.source_sha256[:16]}"


def source_sha256(code: str, path: str) -> str:
    """Returns the hash of the file that a law is in.

    Args:
        code: where it is.
        path: what errors call the key.

    Raises:
        ScenarioError: there is no such file.
    """
    file = _file(code, path)
    try:
        return hashlib.sha256(file.read_bytes()).hexdigest()
    except OSError as error:
        raise ScenarioError(f"{file} cannot be read: {error.strerror}", path=path) from None


def _check_kind(kind: Any, code: str, facts: LawContext, sites: int) -> None:
    """Refuses what is no law; a log that names any other thing of a machine's modules runs nothing of it.

    A law may say what it is for: `sites = 2` or `sites = (2, 4)`, and `needs_theta = True`.
    """
    path = f"sites.{facts.site}.control.law"
    missing = [name for name in _METHODS if not callable(getattr(kind, name, None))]
    if missing:
        raise ScenarioError(f"{code} has no {', '.join(missing)}; see docs/own-controller.md", path=path)
    stated = getattr(kind, "sites", None)
    least, most = (stated, stated) if isinstance(stated, int) else _range(stated, code, path)
    if not least <= sites <= most:
        asked = f"{least}" if least == most else f"{least} to {most}"
        raise ScenarioError(f"{code} is for {asked} sites, and here are {sites}", path=path)
    if getattr(kind, "needs_theta", False) and not facts.theta:
        raise ScenarioError(
            f"{code} needs the arm's parameters, which nobody knows (arm.known = false): identify the arm "
            "and leave known out, or choose a law that learns them",
            path=path,
        )


def _range(stated: Any, code: str, path: str) -> tuple[int, int]:
    """Returns the numbers of sites that a law says it is for."""
    if stated is None:
        return 2, sys.maxsize
    ends = tuple(stated) if isinstance(stated, tuple | list) else ()
    if len(ends) != 2 or not all(isinstance(end, int) for end in ends):
        raise ScenarioError(f"{code}: sites must be as in 2 or (2, 4), is {stated!r}", path=path)
    return ends[0], ends[1]


def _file(code: str, path: str) -> Path:
    module = code.partition(":")[0]
    with _here():
        spec = _spec(module)
    if spec is None or spec.origin is None or not Path(spec.origin).is_file():
        raise ScenarioError(
            f"there is no module {module}, where {code} is; install it, or be in the folder that it lies in "
            "(PYTHONPATH counts too)",
            path=path,
        )
    return Path(spec.origin)


def _spec(module: str) -> ModuleSpec | None:
    """Finds a module as an import would, without running the packages that it is in."""
    spec = None
    folders = None
    *packages, last = module.split(".")
    for depth, _ in enumerate([*packages, last], 1):
        name = ".".join([*packages, last][:depth])
        try:
            found = (finder.find_spec(name, folders) for finder in sys.meta_path)
            spec = next((one for one in found if one is not None), None)
        except (ImportError, ValueError, AttributeError):
            return None
        if spec is None:
            return None
        folders = spec.submodule_search_locations
        if folders is None and name != module:
            return None
    return spec


def _found(code: str, path: str) -> Any:
    """Returns the class that a law's name stands for, of the file as it is now."""
    module, _, name = code.partition(":")
    _check_defined(name, _file(code, path), path)
    now = source_sha256(code, path)
    with _here():
        try:
            found = importlib.import_module(module)
            if _imported.setdefault(module, now) != now:  # edited while this program runs
                found = importlib.reload(found)
                _imported[module] = now
        except (Exception, SystemExit) as error:  # somebody's code
            raise ScenarioError(
                f"{module} cannot be imported: {type(error).__name__}: {error}", path=path
            ) from None
    return getattr(found, name)


def _check_defined(name: str, file: Path, path: str) -> None:
    """Refuses a file that defines no class of that name, before anything of it runs."""
    try:
        tree = ast.parse(file.read_bytes())
    except (SyntaxError, ValueError, RecursionError) as error:
        raise ScenarioError(f"{file} is no Python: {error}", path=path) from None
    if not any(isinstance(node, ast.ClassDef) and node.name == name for node in tree.body):
        raise ScenarioError(f"{file} defines no class {name}; see docs/own-controller.md", path=path)


@contextmanager
def _here() -> Iterator[None]:
    """Lets modules be found in the folder that the person is in."""
    here = str(Path.cwd())
    if here in sys.path:
        yield
        return
    sys.path.insert(0, here)
    importlib.invalidate_caches()  # a file that was written a moment ago
    try:
        yield
    finally:
        sys.path.remove(here)


class Adaptive(Frozen, frozen=True, tag_field="law", tag="adaptive"):
    """The paper's adaptive law, Eq. (13) and (15).

    Stable for any constant delays while nobody pushes, if the dominance matrix is irreducible and the Kd of
    all sites are one matrix but for a scalar each (the paper's theorem with the weights of docs/errata.md).
    That is sufficient; what delays that vary do is another question.

    Gamma = 0 and theta_hat0 = theta make the law of known parameters; Kd = 0 takes the error's damping out.

    Attributes:
        Lambda: per joint, 1/s.
        Kp: per joint, N m s/rad.
        Kd: per joint, N m s/rad.
        Gamma: adaptation gain per parameter.
        theta_hat0: first estimate of theta, Eq. (24).
    """

    Lambda: PositiveJoints = (1.0, 1.0)
    Kp: PositiveJoints = (1.0, 1.0)
    Kd: NotNegativeJoints = (3.0, 3.0)
    Gamma: NotNegativeParameters = (1.0,) * 5
    theta_hat0: Parameters = (0.0,) * 5

    def gains(self, theta: Array) -> Gains:  # noqa: ARG002 - as the other laws
        """Returns the numbers for the core, for an arm of parameters theta."""
        return Gains(Law.ADAPTIVE, self.Lambda, self.Kp, self.Kd, self.Gamma, self.theta_hat0)


class AdaptiveBox(Frozen, frozen=True, tag_field="law", tag="adaptive_box"):
    """The paper's law with every estimate held in a box.

    A box that holds the truth strictly inside leaves V' <= 0 and takes away the spring by which learning
    gravity ties the arms to a pose. Projection after Ioannou and Sun, "Robust Adaptive Control" (1996), 4.4.

    Attributes:
        Lambda: per joint, 1/s.
        Kp: per joint, N m s/rad.
        Kd: per joint, N m s/rad.
        Gamma: adaptation gain per parameter.
        theta_hat0: first estimate of theta, Eq. (24).
        theta_low: least that each estimate may be.
        theta_high: most that it may be.
    """

    Lambda: PositiveJoints = (1.0, 1.0)
    Kp: PositiveJoints = (1.0, 1.0)
    Kd: NotNegativeJoints = (3.0, 3.0)
    Gamma: NotNegativeParameters = (1.0,) * 5
    theta_hat0: Parameters = (0.0,) * 5
    theta_low: Parameters = (-MAX_QUANTITY,) * 5
    theta_high: Parameters = (MAX_QUANTITY,) * 5

    def gains(self, theta: Array) -> Gains:  # noqa: ARG002 - as the other laws
        """Returns the numbers for the core, for an arm of parameters theta."""
        return Gains(
            Law.ADAPTIVE,
            self.Lambda,
            self.Kp,
            self.Kd,
            self.Gamma,
            self.theta_hat0,
            self.theta_low,
            self.theta_high,
        )


class ProportionalDamped(Frozen, frozen=True, tag_field="law", tag="p_d"):
    """P+d with known gravity: tau = G(q) - K e - d qd.

    For equal gains and one constant delay T the linearised loop of N sites is stable if and only if
    d > abs(lambda_min(alpha)) K T; two sites need 4 d_1 d_2 > (T_1 + T_2)^2 K_1 K_2.

    Attributes:
        K: stiffness per joint, N m/rad.
        d: damping per joint, N m s/rad.
        gravity: share of gravity that it knows, 1: exactly.
    """

    K: PositiveJoints = (10.0, 10.0)
    d: NotNegativeJoints = (3.0, 3.0)
    gravity: NotNegative = 1.0

    def gains(self, theta: Array) -> Gains:
        """Returns the numbers for the core, for an arm of parameters theta."""
        return Gains(Law.KNOWN, known=(theta * self.gravity).tolist(), K=self.K, d=self.d)


class ProportionalDerivativeDamped(Frozen, frozen=True, tag_field="law", tag="pd_d"):
    """PD+d with known gravity: tau = G(q) - K e - Kd ed - d qd.

    For constant delays the condition of P+d on K and d is sufficient (its source).

    Attributes:
        K: stiffness per joint, N m/rad.
        Kd: damping of the error's velocity, per joint, N m s/rad.
        d: damping of the arm's velocity, per joint, N m s/rad.
        gravity: share of gravity that it knows, 1: exactly.
    """

    K: PositiveJoints = (10.0, 10.0)
    Kd: NotNegativeJoints = (3.0, 3.0)
    d: NotNegativeJoints = (5.0, 5.0)
    gravity: NotNegative = 1.0

    def gains(self, theta: Array) -> Gains:
        """Returns the numbers for the core, for an arm of parameters theta."""
        return Gains(Law.KNOWN, Kd=self.Kd, known=(theta * self.gravity).tolist(), K=self.K, d=self.d)


class ForceReflecting(Frozen, frozen=True, tag_field="law", tag="p_f"):
    """Direct force reflection with known gravity: tau = G(q) - K e - d qd + k_f felt.

    `felt` is the torque of hands and environments on the peers' arms as it came over the links, weighted by
    dominance. A slave has K and k_f = 0, a master K = 0 and k_f. In free motion it is calm; in contact no
    damping makes it stable for every stiffness and delay: the classic that contact separates. It is for one
    master and one slave.

    Attributes:
        K: stiffness per joint, N m/rad.
        d: damping per joint, N m s/rad.
        k_f: share of what the peers feel, per joint.
        gravity: share of gravity that it knows, 1: exactly.
    """

    K: NotNegativeJoints = (0.0, 0.0)
    d: NotNegativeJoints = (5.0, 5.0)
    k_f: NotNegativeJoints = (0.0, 0.0)
    gravity: NotNegative = 1.0

    def gains(self, theta: Array) -> Gains:
        """Returns the numbers for the core, for an arm of parameters theta."""
        return Gains(Law.KNOWN, known=(theta * self.gravity).tolist(), K=self.K, d=self.d, k_f=self.k_f)


ControlLaw = (
    Adaptive | AdaptiveBox | ProportionalDamped | ProportionalDerivativeDamped | ForceReflecting | ImportedLaw
)
LAWS: dict[str, type[Frozen]] = {
    "adaptive": Adaptive,
    "adaptive_box": AdaptiveBox,
    "p_d": ProportionalDamped,
    "pd_d": ProportionalDerivativeDamped,
    "p_f": ForceReflecting,
    "own": ImportedLaw,
}
"""The laws by their names."""
