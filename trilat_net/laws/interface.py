"""What a built-in control law is made of, and the gains of a law as a scenario holds them.

Invariant: a law is one class. Its annotations are its gains, with their ranges and defaults: of
them the frozen `Settings` of a scenario are made, with the methods of the class that speak of
gains; at a site an instance computes torques. The kernel's own laws have `gains` in place of
`torque`.
"""

import ast
import inspect
import re
import sys
import textwrap
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, NamedTuple, cast, get_origin

import msgspec
from msgspec.structs import asdict

from ..core.site_setup import Gains, Law
from ..core.user_law import LawContext, UserLaw, UserLawFactory
from ..core.vectors import Array
from ..errors import ScenarioError
from ..fields import Frozen, KeyProblem, NotNegative
from ..files import find_page
from .conditions import LawSituation, LinearForm, LinearSituation, StabilityCondition
from .sent_vectors import SentVectorSpecs, convert_sends

GainRange = tuple[float, float, str] | tuple[float, float, str, str]
"""Of a gain that is tuned: the least and the largest value, the unit, and the role of sites
that have it.
"""
STIFFNESS = (1.0, 1000.0, "N m/rad")
DAMPING = (0.5, 200.0, "N m s/rad")
ERROR_DAMPING = (0.1, 50.0, "N m s/rad")
CONVERGENCE = (0.2, 20.0, "1/s")
ADAPTATION = (0.01, 10.0, "")
INERTIA = (0.1, 10.0, "kg m^2")


class TuningSite(NamedTuple):
    """What a law is told at a site when its gains are tuned: of each law the same.

    Attributes:
        role: "master" or "slave".
        gravity: share of the true gravity.
        estimate: first estimate of theta, shape (P,): gravity by that share, inertia unknown.
        box: lower and upper sides of a box around it, shape (P,) each.
        longest_ms: half of the longest mean round trip, ms.
    """

    role: str
    gravity: float
    estimate: list[float]
    box: tuple[list[float], list[float]]
    longest_ms: float


class LawSettings(Frozen, frozen=True):
    """The gains of a law, and what the law says of itself with these; a law has its own of
    these methods.
    """

    kind: ClassVar[Any] = None
    """The class of the law; of an imported one None."""
    linear_note: ClassVar[str] = ""
    """What its small motions leave out."""
    fixed_shares: ClassVar[bool] = False
    """True: it takes the dominance factors of the start alone."""
    has_functional: ClassVar[bool] = False
    """True: the paper's functional V belongs to it."""
    planar: ClassVar[bool] = False
    """True: it has the regressor of the planar arm, and is for no chain."""
    compares_positions: ClassVar[bool] = False
    """True: it compares where end effectors are, whatever the joints do."""

    @property
    def plugged(self) -> bool:
        """True if the core asks the law for its torque, and is no law of the kernel."""
        return hasattr(self.kind, "torque")

    @property
    def books_energy(self) -> bool:
        """True if it keeps account of energy together with the laws of its peers: then all
        sites have it.
        """
        return self.plugged and issubclass(self.kind, EnergyLaw)

    @property
    def tag(self) -> str:
        """What a scenario calls the law."""
        return str(self.__struct_config__.tag)

    def check(self, path: str, sites: int) -> None:
        """Refuses gains that contradict each other, and a number of sites; errors call the law
        `path`.

        Raises:
            ScenarioError: with the path of the key.
        """

    def find_problem(self, rates_hz: Mapping[str, int]) -> KeyProblem | None:  # noqa: ARG002
        """Returns what a site's law has against sites of such tick rates, or None."""
        return None

    def gains(self, theta: Array) -> Gains:  # noqa: ARG002 - as the laws of the kernel
        """Returns the gains for the core, for an arm of parameters theta."""
        return Gains(Law.OWN)

    def linear_gains(self, theta: Array) -> Gains | None:
        """Returns the law of known gravity, or the adaptive one, whose small motions are this
        law's.

        With those of `linear_form`, if it has any; None: there is none.
        """
        return self.gains(theta) if self.kind is not None and not self.plugged else None

    def linear_form(self, at: LinearSituation) -> LinearForm | None:  # noqa: ARG002
        """Returns its small motions beyond those of `linear_gains`."""
        return None

    def explain_no_linear_form(self) -> str:
        """Returns why it cannot be linearised, if `linear_gains` has nothing."""
        return ""

    def condition(self, situation: LawSituation) -> StabilityCondition | None:  # noqa: ARG002
        """Returns what the stability of the law at a site rests on; None if that is not known
        here.
        """
        return None

    def exchanges_positions(self) -> bool:
        """True if the law is a spring between poses, with known gravity: shares have to be
        reversible.
        """
        return False

    def resolve_shares(self, names: Sequence[str], alpha: Array) -> Any:  # noqa: ARG002
        """Returns the law with what it takes of the dominance factors at the start, alpha,
        shape (N, N).
        """
        return self

    def explain_idle_shares(self, at: LawSituation) -> str:  # noqa: ARG002
        """Returns why the dominance factors of a site have no effect; "": they have one."""
        return ""

    @property
    def sends(self) -> SentVectorSpecs:
        """What the law sends to its peers."""
        return convert_sends(getattr(self.kind, "sends", {}), self.kind.__name__, "control")

    def build_factory(self, sites: int, scheme: str) -> UserLawFactory | None:
        """Returns the factory of the law, for a site of an experiment of so many sites.

        None: the kernel computes it.
        """
        if not self.plugged:
            return None

        def make(context: LawContext) -> UserLaw:
            check_law_class(
                kind=self.kind, code=self.tag, context=context, sites=sites, scheme=scheme
            )
            law: UserLaw = make_instance(self.kind, self.tag, context, asdict(self))
            return law

        return make


def format_class_name(tag: str) -> str:
    """Returns the name of the class in the file of a law: FourChannel of four_channel."""
    return "".join(word.capitalize() for word in tag.split("_"))


class ControlLaw:
    """A built-in control law; what `LawSettings` has besides, a law may have of its own.

    Attributes:
        Settings: its gains as a scenario holds them. sends, remembers, schemes, sites,
        needs_theta, needs_model: as of any law, see docs/own-controller.md.
        tune: of the gains that are tuned their ranges, by name.
        known_facts: what it uses of what all laws are told, in words.
    """

    Settings: ClassVar[type[LawSettings]] = LawSettings
    remembers: ClassVar[tuple[str, ...]] = ()
    tune: ClassVar[Mapping[str, GainRange]] = {}
    known_facts: ClassVar[str] = "gravity"

    def __init_subclass__(cls) -> None:
        tag = cls.__module__.rpartition(".")[2]
        if cls.__name__ == format_class_name(tag):
            cls.Settings = _derive_settings(cls, tag)

    def __init__(self, facts: LawContext, **gains: Any) -> None:
        """Makes the law of a site with these gains; `facts` is what is known before the run."""
        for name, value in gains.items():
            if not isinstance(
                getattr(type(self), name, None), bool | float | int | str | tuple | dict
            ):
                raise TypeError(f"it has no gain {name!r}")
            setattr(self, name, value)
        self.begin(facts)

    def begin(self, facts: LawContext) -> None:
        """Makes what `torque` uses beside the gains."""

    @classmethod
    def explain_misfit(cls, roles: Sequence[str]) -> str:
        """Returns why the law is none for sites of such roles, or ""."""
        wanted = getattr(cls, "sites", None)
        if wanted in (None, len(roles)):
            return ""
        return f"is for {wanted} sites, and this has {len(roles)}: leave it out"

    @classmethod
    def write_control(cls, gains: Mapping[str, float], at: TuningSite) -> dict[str, Any]:
        """Returns the [control] of a site for tuned gains."""
        told = {"gravity": at.gravity} if "gravity" in cls.Settings.__struct_fields__ else {}
        return {**gains, **told}


class EnergyLaw(ControlLaw):
    """A law that keeps account of energy: what one end sends, the other books, so that all
    sites have it.
    """

    gravity: NotNegative = 1.0
    schemes: ClassVar[tuple[str, ...]] = ("digital",)


def _derive_settings(kind: type[ControlLaw], tag: str) -> type[LawSettings]:
    """Returns the gains of a law as a type of a scenario."""
    bases = [base for base in reversed(kind.__mro__) if issubclass(base, ControlLaw)][1:]
    hints = {
        name: hint
        for base in bases
        for name, hint in inspect.get_annotations(base).items()
        if not _is_class_variable(hint)
    }
    said = {
        name: value
        for base in bases
        for name, value in vars(base).items()
        if _speaks_of_gains(name, value)
    }
    made: Any = msgspec.defstruct(
        "Settings",
        [(name, hint, getattr(kind, name)) for name, hint in hints.items()],
        bases=(LawSettings,),
        namespace={**said, "kind": kind, "__doc__": kind.__doc__},
        module=kind.__module__,
        frozen=True,
        kw_only=True,
        forbid_unknown_fields=True,
        tag_field="law",
        tag=tag,
    )
    made.__qualname__ = f"{kind.__qualname__}.Settings"
    return cast(type[LawSettings], made)


def _is_class_variable(hint: Any) -> bool:
    origin: Any = get_origin(hint) or hint
    return origin is ClassVar


def _speaks_of_gains(name: str, value: Any) -> bool:
    if inspect.isfunction(value) or isinstance(value, property):
        return name not in ("begin", "torque", "energies") and not name.startswith("__")
    return name in LawSettings.__annotations__


def check_law_class(kind: Any, code: str, context: LawContext, sites: int, scheme: str) -> None:
    """Refuses a class that is no law, or none for such a site.

    A law may say what it is for: `sites = 2` or `sites = (2, 4)`, `schemes = ("digital",)`, and
    `needs_theta = True`.

    Raises:
        ScenarioError: with the path of the key.
    """
    path = f"sites.{context.site}.control.law"
    keeps = any(hasattr(kind, name) for name in ("memory", "recall")) and not hasattr(
        kind, "remembers"
    )
    methods = ("torque", "memory", "recall") if keeps else ("torque",)
    missing = [name for name in methods if not callable(getattr(kind, name, None))]
    if missing:
        raise ScenarioError(
            f"{code} has no {', '.join(missing)}; see {find_page('own-controller.md')}",
            path=path,
        )
    if not (keeps or hasattr(kind, "remembers")) and (written := _find_written(kind)):
        raise ScenarioError(
            f"{code} writes self.{written[0]}: where torque needs that at the next tick, its class has "
            f"remembers = ({written[0]!r},), else remembers = (); see {find_page('own-controller.md')}",
            path=path,
        )
    stated = getattr(kind, "sites", None)
    ends = (
        (2, sys.maxsize)
        if stated is None
        else (stated, stated)
        if isinstance(stated, int)
        else stated
    )
    if not (
        isinstance(ends, tuple | list)
        and len(ends) == 2
        and all(isinstance(n, int) for n in ends)
    ):
        raise ScenarioError(
            f"{code}: sites must be as in 2 or (2, 4), is {stated!r}", path=path
        )
    least, most = ends
    if not least <= sites <= most:
        wanted = f"{least}" if least == most else f"{least} to {most}"
        raise ScenarioError(f"{code} is for {wanted} sites, and here are {sites}", path=path)
    if scheme not in (schemes := getattr(kind, "schemes", None) or (scheme,)):
        wanted = " or ".join(map(repr, schemes))
        raise ScenarioError(
            f"{code} is for scheme = {wanted}, and here it is {scheme!r}", path=path
        )
    if getattr(kind, "needs_theta", False) and not context.theta:
        raise ScenarioError(
            f"{code} needs the arm's parameters, which are unknown (arm.known = false): identify the arm "
            "and leave known out, or choose a law that learns them",
            path=path,
        )


def _find_written(kind: Any) -> list[str]:
    """Returns what a class writes of itself after `__init__`, unless by calls, as of append."""
    methods = [
        one for base in kind.__mro__ for one in vars(base).values() if inspect.isfunction(one)
    ]
    sources = [
        textwrap.dedent(inspect.getsource(one)) for one in methods if one.__name__ != "__init__"
    ]
    nodes = (node for text in sources for node in ast.walk(ast.parse(text)))
    written = [
        ast.unparse(node) for node in nodes if isinstance(getattr(node, "ctx", None), ast.Store)
    ]
    return [found[1] for one in written if (found := re.match(r"self\.(\w+)", one))]


def make_instance(
    kind: Any, code: str, context: Any, settings: dict[str, Any], path: str = ""
) -> Any:
    """Returns a law, or what else a class makes of its context and settings; errors call the
    key `path`.

    Raises:
        ScenarioError: it raised.
    """
    try:
        return kind(context, **settings)
    except (Exception, SystemExit) as error:  # the user's code
        given = ", ".join(f"{key} = {value!r}" for key, value in settings.items())
        problem = (
            f"cannot be made with {given or 'no settings'}: {type(error).__name__}: {error}"
        )
        raise ScenarioError(
            f"{code} {problem}", path=path or f"sites.{context.site}.control"
        ) from None
