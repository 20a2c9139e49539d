"""Base classes of the built-in control laws, and the scenario tables that store their gains.

A law is a class whose annotated attributes, for example `Kd`, are its gains. A second class,
its `Settings`, is derived from it. `Settings` is the table of gains in a scenario and is
validated when the scenario is read. An instance of the law itself computes the torques of one
arm.

Invariant:
    - The annotations of the class are its gains, with ranges and defaults.
    - The `Settings` of a law inherit those methods of the class that depend on gains alone,
      such as the stability condition.
    - Laws computed by the compiled control loop itself have a method `gains` instead of
      `torque`.
"""

import ast
import inspect
import pkgutil
import re
import sys
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from importlib import import_module
from typing import Any, ClassVar, NamedTuple, cast, get_origin

import msgspec
from msgspec.structs import asdict

from ..core import (
    Array,
    Gains,
    Law,
    LawChannel,
    LawContext,
    SentVector,
    UserLaw,
    UserLawFactory,
)
from ..errors import ScenarioError, count_nouns
from ..fields import Frozen, KeyProblem, NotNegative
from ..files import find_page
from ..records import Layout
from .conditions import LawSituation, LinearForm, LinearSituation, StabilityCondition
from .sent_vectors import SentVectorSpecs, convert_sends

GainRange = tuple[float, float, str] | tuple[float, float, str, str]
"""Range of a tunable gain: lower bound, upper bound, unit and, optionally, the role of the
sites that have the gain.
"""
STIFFNESS = (1.0, 1000.0, "N m/rad")
DAMPING = (0.5, 200.0, "N m s/rad")
ERROR_DAMPING = (0.1, 50.0, "N m s/rad")
CONVERGENCE = (0.2, 20.0, "1/s")
ADAPTATION = (0.01, 10.0, "")
INERTIA = (0.1, 10.0, "kg m^2")


class TuningSite(NamedTuple):
    """Facts about one arm that a law needs to write its scenario table with tuned gains.

    Passed to the method `write_control` of a law.

    Attributes:
        role: "master" for an arm that an operator moves, "slave" for an arm that follows.
        gravity: Ratio of the compensated to the true gravity torque. 1 is exact.
        estimate: Initial estimate of the arm's P dynamic parameters theta, shape (P,). The
            gravity terms are the true ones times `gravity`, and the inertia terms are zero.
        box: Lower and upper bounds around the estimate, shape (P,) each.
        longest_ms: Half of the longest mean round trip between two sites, ms.
    """

    role: str
    gravity: float
    estimate: list[float]
    box: tuple[list[float], list[float]]
    longest_ms: float


class TuningRun(NamedTuple):
    """Motion of all arms in a tuning run, used by a law to compute the desired motion.

    Passed to the method `target_motion` of a law while gains are tuned. The run has N arms with
    n joints each, and K equally spaced times.

    Attributes:
        laws: Settings of the law of each arm.
        t_s: The times, shape (K,), in s.
        q: Joint angles, shape (N, K, n), in rad.
        outside_nm: Torques that operators and environments exert on the arms, shape (N, K, n),
            in N m.
        alpha: Dominance factors, shape (K, N, N). Row i contains the weights that site i gives
            to the other sites.
    """

    laws: "Sequence[LawSettings]"
    t_s: Array
    q: Array
    outside_nm: Array
    alpha: Array


class LawSettings(Frozen, frozen=True):
    """Gains of a control law as stored in a scenario, and properties derived from them.

    Every law has a subclass with its own gains, which is derived automatically from the class
    of the law. Methods defined by the class of the law override the methods defined here.
    """

    kind: ClassVar[Any] = None
    """Class of the law. None for a law that is imported from a user's file."""
    linear_note: ClassVar[str] = ""
    """Effect neglected by the law's linear form, as a sentence for the user."""
    fixed_shares: ClassVar[bool] = False
    """True if the law uses only the initial dominance factors of the session."""
    has_functional: ClassVar[bool] = False
    """True if the energy function V of the paper's stability proof applies to the law."""
    planar: ClassVar[bool] = False
    """True if the law uses the planar arm's regressor and therefore cannot control an arm from
    a URDF file.
    """
    needs_joint_space: ClassVar[bool] = False
    """True if the law combines values per joint with values per shared coordinate. Such a law
    cannot control arms that share end effector positions.
    """
    compares_positions: ClassVar[bool] = False
    """True if the law itself compares end effector positions rather than joint angles."""

    @property
    def plugged(self) -> bool:
        """True if the class of the law computes the torque itself, with a method `torque`.

        Otherwise the law is built into the compiled control loop (the simulation kernel).
        """
        return hasattr(self.kind, "torque")

    @property
    def books_energy(self) -> bool:
        """True if the law keeps an account of the energy exchanged between the arms.

        In this case, all sites must use the law: each site accumulates the energy that it
        sends, and the receiving site subtracts the energy that it uses.
        """
        return self.plugged and issubclass(self.kind, EnergyLaw)

    @property
    def tag(self) -> str:
        """Name by which a scenario selects the law, for example "p_d"."""
        return str(self.__struct_config__.tag)

    def check(self, path: str, sites: int) -> None:
        """Raises ScenarioError if gains contradict each other or the number of arms is wrong.

        Args:
            path: Path of the law's table in the scenario, for error messages.
            sites: Number of sites in the scenario.

        Raises:
            ScenarioError: A gain or the number of sites is invalid. The message contains the
                key.
        """

    def find_problem(self, rates_hz: Mapping[str, int]) -> KeyProblem | None:  # noqa: ARG002
        """Finds a setting of the law that is incompatible with the tick rates of the sites.

        For example, some laws require equal rates at all sites.

        Args:
            rates_hz: Mapping from site name to tick rate, in Hz.

        Returns:
            The key of the setting and the problem. None if all settings are compatible.
        """
        return None

    def gains(self, theta: Array) -> Gains:  # noqa: ARG002 - as the laws of the kernel
        """Converts the gains of the law to the form that the compiled control loop reads.

        The default result (`Law.USER`) indicates that the Python class of the law computes the
        torque.

        Args:
            theta: The P dynamic parameters of the arm, such as masses and inertias, shape (P,).

        Returns:
            The record that selects the torque formula and contains its gains.
        """
        return Gains(Law.USER)

    def linear_gains(self, theta: Array) -> Gains | None:
        """Returns the gains of a built-in law that has the same linear part as this law.

        The built-in law replaces this law in the linear analysis, which considers small motions
        about a resting pose. Terms missing from the built-in law are added by `linear_form`.

        Args:
            theta: The P dynamic parameters of the arm, such as masses and inertias, shape (P,).

        Returns:
            The gains. None if the law cannot be linearised.
        """
        if self.kind is None or self.plugged:
            return None
        return self.gains(theta)

    def linear_form(self, situation: LinearSituation) -> LinearForm | None:  # noqa: ARG002
        """Returns the terms of the linearised law that `linear_gains` cannot express.

        The terms are matrix blocks that describe the law for small motions about a resting
        pose. The linear analysis adds them to the spring and the dampers from `linear_gains`.

        Args:
            situation: This arm and its dominance factors.

        Returns:
            The terms. None if `linear_gains` describes the law completely.
        """
        return None

    def explain_no_linear_form(self) -> str:
        """Returns a sentence that tells the user why the law cannot be linearised.

        Shown if `linear_gains` returns None.
        """
        return ""

    def condition(self, situation: LawSituation) -> StabilityCondition | None:  # noqa: ARG002
        """Evaluates whether this control law is stable with the gains and delays of a scenario.

        Overridden by laws with a known stability condition.

        Args:
            situation: The site, its peers, their laws and the delays between them.

        Returns:
            The condition, and whether the scenario satisfies it. None if no condition is known
            for this law.
        """
        return None

    def exchanges_positions(self) -> bool:
        """Returns True if the law couples the arms like passive springs and dampers.

        This requires exact gravity compensation. Stability conditions for laws of this kind
        require reversible dominance factors alpha_ij: there must be positive weights D_i with
        D_i alpha_ij = D_j alpha_ji for all pairs of sites.
        """
        return False

    def target_motion(self, run: TuningRun) -> Array | None:  # noqa: ARG002
        """Computes the desired motion of the arms, which is the goal of the tuning.

        By default, gains are tuned for arms that move together and come to rest at the pose to
        which the operators pull them. A law with another desired motion overrides this method,
        and its gains are tuned for arms that follow that motion.

        Args:
            run: The motion of all arms in a tuning run.

        Returns:
            Joint angles of the desired motion, shape (N, K, n), in rad. None if the arms should
            move together.
        """
        return None

    def resolve_shares(self, names: Sequence[str], alpha: Array) -> Any:  # noqa: ARG002
        """Computes settings of the law that depend on the dominance factors of the scenario.

        An example is the wave impedance between two sites in the law `wave`. Most laws have no
        such settings and are returned unchanged.

        Args:
            names: Names of the N sites.
            alpha: Dominance factors at the start, shape (N, N). Row i contains the weights that
                site i gives to the other sites.

        Returns:
            The law with the computed settings.
        """
        return self

    def explain_idle_shares(self, situation: LawSituation) -> str:  # noqa: ARG002
        """Explains to the user why the dominance factors of an arm have no effect.

        Args:
            situation: This arm, and the laws of all arms.

        Returns:
            A sentence for the user. Empty if the dominance factors have an effect.
        """
        return ""

    @property
    def sends(self) -> SentVectorSpecs:
        """Vectors that the law sends in addition to the motion, such as waves, keyed by name.

        Empty for most laws.
        """
        if self.kind is None:
            return {}
        sends = getattr(self.kind, "sends", {})
        return convert_sends(sends, self.kind.__name__, "control")

    def build_channel(self, layout: Layout, peers: int) -> LawChannel:
        """Returns the vectors that the law sends from a site, with their lengths.

        The class of a law declares the vectors independently of any arm. Their lengths follow
        from the numbers of joints and coordinates.

        Args:
            layout: Numbers of the site's joints and coordinates.
            peers: Number of the site's peers.
        """
        counts = {"joints": layout.joints, "coordinates": layout.shared}
        vectors = []
        for name, spec in self.sends.items():
            length = spec.length
            if not isinstance(length, int):
                length = counts[length]
            vectors.append(SentVector(name, spec.unit, length, spec.per_peer))
        common_first = sorted(vectors, key=lambda vector: vector.per_peer)
        return LawChannel(tuple(common_first), peers)

    def find_uniform_spring(self) -> tuple[float, float] | None:
        """Returns the gains of this law, if it is only a spring and a damper.

        Returns:
            Stiffness K in N m/rad and damping d in N m s/rad, which are the same for all
            joints. None for any other law, and for gains that differ between joints.
        """
        return None

    def find_sampling_excess(self, g_m_s2: float, tick_s: float) -> float | None:  # noqa: ARG002
        """Returns by how much a gain exceeds the minimum that the tick rate requires.

        Overridden by laws that may be unstable because they act only once per tick.

        Args:
            g_m_s2: Gravitational acceleration, m/s^2.
            tick_s: Period of a tick, s.

        Returns:
            The excess, positive if the gain is sufficient. None if no rule is known.
        """
        return None

    @staticmethod
    def check_class(
        kind: Any,
        code: str,
        context: LawContext,
        sites: int,
        scheme: str,
    ) -> None:
        """Raises ScenarioError if a class is not a control law, or is unsuitable for the arm.

        A law may restrict its use with class attributes: `sites = 2` or `sites = (2, 4)` for
        the number of arms, `schemes = ("digital",)` for the integration scheme, and
        `needs_theta = True` to require known dynamic parameters.

        Args:
            kind: The class.
            code: Name of the law for error messages, for example "mylaws:Spring".
            context: Facts about the arm and its controller.
            sites: Number of arms (sites) in the scenario.
            scheme: Integration scheme of the scenario.

        Raises:
            ScenarioError: The class is unsuitable. The error contains the path of the key.
        """
        path = f"sites.{context.site}.control.law"
        _check_methods(kind, code, path)
        _check_site_count(kind, code, path, sites)

        schemes = getattr(kind, "schemes", None) or (scheme,)
        if scheme not in schemes:
            allowed = " or ".join(map(repr, schemes))
            problem = f"{code} is for scheme = {allowed}, but the scheme here is {scheme!r}"
            raise ScenarioError(problem, path=path)

        needs_theta = getattr(kind, "needs_theta", False)
        if needs_theta and not context.theta:
            problem = (
                f"{code} needs the arm's parameters, which are unknown (arm.known = false): "
                "identify the arm and leave known out, or choose a law that learns them"
            )
            raise ScenarioError(problem, path=path)

    def build_factory(self, sites: int, scheme: str) -> UserLawFactory | None:
        """Returns a function that creates the control law of one arm before a run.

        The function is called later, when the facts about the arm are known.

        Args:
            sites: Number of sites in the scenario.
            scheme: Integration scheme of the scenario, "second_order" or "digital".

        Returns:
            The function. None if the law is built into the compiled control loop (the
            simulation kernel), in which case no instance is needed.
        """
        if not self.plugged:
            return None

        def make_law(context: LawContext) -> UserLaw:
            """Creates the control law of one arm.

            Raises:
                ScenarioError: The class of the law is unsuitable for this arm.
            """
            self.check_class(
                kind=self.kind,
                code=self.tag,
                context=context,
                sites=sites,
                scheme=scheme,
            )
            law: UserLaw = self.kind(context, **asdict(self))
            return law

        return make_law


def _format_class_name(tag: str) -> str:
    """Returns the required class name of a law, for example "FourChannel" for "four_channel".

    Laws are found by file name. This rule links the file, the class and the name used in a
    scenario.
    """
    return "".join(word.capitalize() for word in tag.split("_"))


class ControlLaw:
    """Base class of the built-in control laws, which compute the torque of an arm.

    A law may also define the methods of `LawSettings`. When the class of a law is created, a
    second class, `Settings`, is derived from it, with the gains and these methods. The other
    class variables of a law are described in docs/extend/law-interface.md.

    Attributes:
        Settings: Class that stores the gains of the law in a scenario.
        remembers: Names of the instance attributes that keep the state of the law between
            ticks.
        tune: Mapping from the name of each tunable gain to its range.
        known_facts: Phrase for the user that states which facts about the arm the law needs.
    """

    Settings: ClassVar[type[LawSettings]] = LawSettings
    remembers: ClassVar[tuple[str, ...]] = ()
    tune: ClassVar[Mapping[str, GainRange]] = {}
    known_facts: ClassVar[str] = "gravity"

    def __init_subclass__(cls) -> None:
        tag = cls.__module__.rpartition(".")[2]
        if cls.__name__ == _format_class_name(tag):
            cls.Settings = _derive_settings(cls, tag)

    @staticmethod
    def find_built_in() -> "Iterator[type[ControlLaw]]":
        """Yields the control law defined in each Python file of the package of laws, if any."""
        for file in pkgutil.iter_modules(import_module(__package__).__path__):
            module = import_module(f"{__package__}.{file.name}")
            kind = getattr(module, _format_class_name(file.name), None)
            if isinstance(kind, type) and issubclass(kind, ControlLaw):
                yield kind

    def __init__(self, facts: LawContext, **gains: Any) -> None:
        """Creates the control law of one arm, with its gains as attributes.

        Args:
            facts: Facts about the arm and the other arms that are known before the run.
            gains: Mapping from gain name to value. Omitted gains keep their defaults.

        Raises:
            TypeError: The law has no gain of that name.
        """
        for name, value in gains.items():
            default = getattr(type(self), name, None)
            is_gain = isinstance(default, bool | float | int | str | tuple | dict)
            if not is_gain:
                raise TypeError(f"this law has no gain {name!r}")
            setattr(self, name, value)
        self.begin(facts)

    def begin(self, facts: LawContext) -> None:
        """Prepares a law before the first tick by creating the attributes that `torque` uses.

        The gains are already set. A law that needs no other attributes does not override this
        method.

        Args:
            facts: Facts about the arm and the other arms that are known before the run.
        """

    @classmethod
    def explain_misfit(cls, roles: Sequence[str]) -> str:
        """Explains to the user why the law cannot couple the arms of a scenario.

        For example, some laws require exactly one master and one slave.

        Args:
            roles: Role of each site, "master" or "slave".

        Returns:
            A sentence for the user. Empty if the law is suitable.
        """
        required = getattr(cls, "sites", None)
        if required in (None, len(roles)):
            return ""
        sites = count_nouns(required, "site")
        return f"is for {sites}, but this scenario has {len(roles)}: leave the law out"

    @classmethod
    def write_control(cls, gains: Mapping[str, float], site: TuningSite) -> dict[str, Any]:
        """Returns the scenario table [control] of the law for one arm, with tuned gains.

        Besides the tuned gains, the table contains settings derived from the facts about the
        site.

        Args:
            gains: Mapping from gain name to tuned value.
            site: Facts about the arm for which the table is written.
        """
        compensates_gravity = "gravity" in cls.Settings.__struct_fields__
        if compensates_gravity:
            return {**gains, "gravity": site.gravity}
        return {**gains}


class EnergyLaw(ControlLaw):
    """Base class of the laws that keep an account of the energy exchanged between the arms.

    The sender counts the energy that it sends, and the receiver the energy that it uses, so all
    sites must use the same law. These laws require the integration scheme `digital`, which
    holds each torque constant for one control period. Only then is the work of a torque known
    exactly: the torque times the motion of the joint.
    """

    gravity: NotNegative = 1.0
    schemes: ClassVar[tuple[str, ...]] = ("digital",)


def _derive_settings(kind: type[ControlLaw], tag: str) -> type[LawSettings]:
    """Creates the class that stores the gains of a law in a scenario.

    A law is written as one class, whose instances compute torques while an arm is controlled. A
    scenario needs only the gains of the law, which are read and validated without creating an
    instance. A second class, a frozen record (`msgspec.Struct`), is therefore derived, so that
    authors of laws need not declare the gains twice.

    Annotations of the law and its base classes become the fields of the record, with the values
    of the class attributes as defaults. Methods and class variables that depend only on the
    gains are copied (see `_depends_on_gains`), so that the stability condition, for example,
    can be evaluated from the record.

    Args:
        kind: The class of the law.
        tag: Name of the law in a scenario.
    """
    hints: dict[str, Any] = {}
    namespace: dict[str, Any] = {}
    # Base classes come first, so that attributes of the law itself replace theirs.
    for base in reversed(kind.__mro__):
        is_law_class = issubclass(base, ControlLaw) and base is not ControlLaw
        if not is_law_class:
            continue
        annotations = inspect.get_annotations(base).items()
        hints |= {name: hint for name, hint in annotations if not _is_class_variable(hint)}
        attributes = vars(base).items()
        namespace |= {
            name: value for name, value in attributes if _depends_on_gains(name, value)
        }
    namespace["kind"] = kind  # `LawSettings.kind` refers back to the class of the law
    namespace["__doc__"] = kind.__doc__
    fields = [(name, hint, getattr(kind, name)) for name, hint in hints.items()]
    settings: Any = msgspec.defstruct(
        "Settings",
        fields,
        bases=(LawSettings,),
        namespace=namespace,
        module=kind.__module__,
        frozen=True,
        kw_only=True,
        forbid_unknown_fields=True,
        tag_field="law",
        tag=tag,
    )
    settings.__qualname__ = f"{kind.__qualname__}.Settings"
    return cast(type[LawSettings], settings)


def _is_class_variable(hint: Any) -> bool:
    """Returns True for the annotations `ClassVar` and `ClassVar[...]`, which are not gains.

    All other annotations of a law's class become keys of the scenario.
    """
    origin: Any = get_origin(hint) or hint
    return origin is ClassVar


def _depends_on_gains(name: str, value: Any) -> bool:
    """Returns True if an attribute of a law's class should be copied to its `Settings`.

    The record of gains, the class `Settings`, is derived from the class of a law (see
    `_derive_settings`). It contains the gains, but not the state of an instance that controls
    an arm.

    - Functions and properties are copied if they use only the gains. `begin`, `torque` and
      `energies` need the state, and special methods belong to the class itself.
    - Other attributes are copied if they are declared by `LawSettings`, the base class of all
      records, for example `planar`. All others are internal to the law.

    Args:
        name: Name of the attribute.
        value: The function, property or class variable.
    """
    is_method = inspect.isfunction(value) or isinstance(value, property)
    if is_method:
        is_special = name.startswith("__")
        needs_state = name in ("begin", "torque", "energies")
        return not (is_special or needs_state)
    # Other attributes: class variables that the base class of the records declares.
    return name in LawSettings.__annotations__


def _check_methods(kind: Any, code: str, path: str) -> None:
    """Raises ScenarioError if a class has no method `torque`, or has undeclared memory.

    The memory of a law is all state that it needs in the next tick. It is logged, so that a run
    can be verified from any tick. A class declares its memory with `remembers`, or with the
    methods `memory` and `recall`.

    Args:
        kind: The class.
        code: Name of the law for error messages.
        path: Path of the key for error messages.

    Raises:
        ScenarioError: The class has no such method, or does not declare its memory.
    """
    is_declared = hasattr(kind, "remembers")
    has_memory_methods = any(hasattr(kind, name) for name in ("memory", "recall"))
    required = ["torque"]
    if has_memory_methods and not is_declared:
        required += ["memory", "recall"]
    missing = [name for name in required if not callable(getattr(kind, name, None))]
    page = find_page("law-interface.md")
    if missing:
        raise ScenarioError(f"{code} has no {', '.join(missing)}; see {page}", path=path)

    if is_declared or has_memory_methods:
        return
    written = _find_written_attributes(kind)
    if written:
        name = written[0]
        problem = (
            f"{code} writes self.{name}: if torque needs this attribute at the next tick, the "
            f"class must have remembers = ({name!r},), otherwise remembers = (); see {page}"
        )
        raise ScenarioError(problem, path=path)


def _check_site_count(kind: Any, code: str, path: str, sites: int) -> None:
    """Raises ScenarioError if a law does not support the number of arms in the scenario.

    The class of a law may specify a number or a range in its attribute `sites`, for example
    `sites = 2` or `sites = (2, 4)`.

    Args:
        kind: The class.
        code: Name of the law for error messages.
        path: Path of the key for error messages.
        sites: Number of sites in the scenario.

    Raises:
        ScenarioError: The law does not support this number, or its `sites` is not a number or a
            pair of numbers.
    """
    declared = getattr(kind, "sites", None)
    bounds: Any = declared
    if declared is None:
        bounds = (2, sys.maxsize)
    elif isinstance(declared, int):
        bounds = (declared, declared)

    is_sequence = isinstance(bounds, tuple | list)
    is_range = is_sequence and len(bounds) == 2 and all(isinstance(n, int) for n in bounds)
    if not is_range:
        problem = (
            f"{code}: sites must be a number as in 2 or a range as in (2, 4), not {declared!r}"
        )
        raise ScenarioError(problem, path=path)

    least, most = bounds
    if not least <= sites <= most:
        numbers = f"{least}" if least == most else f"{least} to {most}"
        allowed = count_nouns(numbers, "site")
        problem = f"{code} is for {allowed}, but the scenario has {sites}"
        raise ScenarioError(problem, path=path)


def _find_written_attributes(kind: Any) -> list[str]:
    """Returns the names of attributes of `self` that a class assigns outside `__init__`.

    An attribute that changes during a run is memory, which a control law must declare so that
    runs can be repeated from the log. The source of each method is searched for assignments to
    `self`. Changes made by method calls, such as `append` on a list, are not detected.

    Args:
        kind: The class of a law.
    """
    attributes = [value for base in kind.__mro__ for value in vars(base).values()]
    functions = [value for value in attributes if inspect.isfunction(value)]
    written = []
    for function in functions:
        if function.__name__ == "__init__":
            continue
        source = textwrap.dedent(inspect.getsource(function))
        for node in ast.walk(ast.parse(source)):
            is_assigned = isinstance(getattr(node, "ctx", None), ast.Store)
            if not is_assigned:
                continue
            target = ast.unparse(node)
            match = re.match(r"self\.(\w+)", target)
            if match:
                written.append(match[1])
    return written
