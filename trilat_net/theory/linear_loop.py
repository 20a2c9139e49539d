"""The closed loop of all sites, linearised at an equilibrium: a delay-differential equation.

    x'(t) = A x(t) + sum_k A_k x(t - T_k) + B u(t) + sum_k B_k u(t - T_k),    y(t) = C x(t)

Invariant: x are deviations from the equilibrium, in the order of the scenario's sites; u is the
torque ON the joints that an operator adds; y are the joint velocities. Sites that follow with
their end effectors are coupled through what they share of their poses, `SiteRates.x`, and
through its velocity.

A chain has ten estimates a link, of which a small motion moves, and the torque shows, no more
than one combination a joint: the gravity that was learnt. With the regressor Y_G at rest it is
z = Y_G theta_hat, N m, and z' = -Y_G Gamma Y' r. The loop of chains has z in place of the
estimates; all that is left out is constant or has no effect, each with a root at zero.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag, qr

from ..core.task_space import PLACE
from ..core.vectors import Array
from ..laws.conditions import LinearForm, Place
from . import site_dynamics
from .numeric_law import NumericLaw
from .operating_point import Equilibrium, OperatingConditions
from .textbook_arm import evaluate_reference

_DEPENDENT = 1e-9
"""Rows of a regressor that are dependent to this, relative to the largest, are."""


class SiteJacobian(NamedTuple):
    """The derivatives of one site's rates, by the states that the loop keeps.

    Attributes:
        at: layout of the columns; of a law that learns nothing it has no estimate.
        rates: the derivatives, see `differentiate_site_rates`.
        states: names of the states, as "q1", "qd2", "theta4"; "gravity2": the learnt gravity of
            joint 2.
        omitted_states: number of estimates that no small motion moves or shows.
    """

    at: site_dynamics.ArgumentLayout
    rates: site_dynamics.SiteRates
    states: tuple[str, ...]
    omitted_states: int = 0

    @property
    def sent(self) -> Array:
        """What peers get by the site's own states, shape (3 m, states): x, its velocity, the
        torque.
        """
        rates = self.rates
        return np.vstack([rates.x, rates.xd, rates.reflected])[:, : self.at.states]


class DelayedTerm(NamedTuple):
    """The part of the loop that acts after one delay.

    Attributes:
        delay_s: the delay in use, s.
        A: of the state, shape (n, n).
        B: of the operators' torque, where a law reflects it, shape (n, m).
    """

    delay_s: float
    A: Array
    B: Array


class LinearLoop(NamedTuple):
    """A linear loop with delays.

    Attributes:
        names: of the states, as "m1.q1", "s.qd2", "m1.theta4".
        inputs: of the torques ON the joints, "m1.tau1".
        outputs: of the joint velocities, "m1.qd1".
        A: shape (n, n).
        B: shape (n, m).
        C: shape (p, n).
        delayed: one entry per distinct delay above zero, by rising delay.
        omitted_states: number of states that no small motion moves or shows, each with a root at
            zero.
        E: 1 of each state that has a rate, 0 of one that the others give at once, as a wave: 0
            = A x + ...; None: all have one.
    """

    names: tuple[str, ...]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    A: Array
    B: Array
    C: Array
    delayed: tuple[DelayedTerm, ...]
    omitted_states: int = 0
    E: Array | None = None

    @property
    def static_matrix(self) -> Array:
        """A + sum_k A_k: the effect of a constant deviation."""
        return sum((term.A for term in self.delayed), self.A)


def gather_site_arguments(conditions: OperatingConditions, rest: Equilibrium) -> list[Array]:
    """Returns the arguments of every site's rates at an equilibrium, shape (arguments,) each."""
    layouts = list(map(site_dynamics.lay_out_arguments, conditions.sites))
    arguments = [np.zeros(at.arguments) for at in layouts]
    poses = zip(rest.q, rest.theta_hat, find_references(conditions, rest), strict=True)
    for at, x, (q, theta_hat, q_des) in zip(layouts, arguments, poses, strict=True):
        x[at.q] = q[: at.joints]
        x[at.estimate] = theta_hat[: at.parameters]
        x[at.q_des] = q_des
    reflected = [one.reflected for one in conditions.rates(arguments)]
    for i, (at, x, felt) in enumerate(
        zip(layouts, arguments, conditions.alpha @ reflected, strict=True)
    ):
        x[at.peer_torque] = felt
        others = [j for j in range(len(arguments)) if j != i]
        for place in range(at.peers):
            j = others[place]
            rest_qd = np.zeros(at.coordinates)
            x[at.of_peer(place)] = np.r_[rest.q[j][: at.coordinates], rest_qd, -reflected[j]]
    return arguments


def share_poses(conditions: OperatingConditions, rest: Equilibrium) -> list[Array]:
    """Returns what each site shares of its pose at an equilibrium, shape (m,) each."""
    return [
        site_dynamics.share_own_pose(site, q[: site.layout.joints])
        for site, q in zip(conditions.sites, rest.q, strict=True)
    ]


def find_references(conditions: OperatingConditions, rest: Equilibrium) -> list[Array]:
    """Returns what each site follows at an equilibrium, shape (m,) each."""
    shared = share_poses(conditions, rest)
    if not conditions.sites[0].layout.task:
        return list(conditions.alpha @ np.array(shared))
    return [
        evaluate_reference(row, own, shared)
        for row, own in zip(conditions.alpha, shared, strict=True)
    ]


def differentiate_references(
    conditions: OperatingConditions, rest: Equilibrium
) -> dict[tuple[int, int], Array]:
    """Returns the derivative of what site i follows by what site j shares, shape (m, m), by (i,
    j).

    It is alpha_ij but for orientations that do not agree, which have one by the site's own pose
    as well.
    """
    found = {}
    shared = share_poses(conditions, rest)
    for i, row in enumerate(conditions.alpha):
        for j in np.flatnonzero(row):
            found[i, int(j)] = row[j] * np.eye(len(shared[i]))
        if len(shared[i]) > PLACE and conditions.sites[i].layout.task:
            for peer in {i, *np.flatnonzero(row).tolist()}:
                poses = [pose[:, np.newaxis] + np.zeros(len(pose)) for pose in shared]
                poses[peer] = poses[peer] + 1j * site_dynamics.COMPLEX_STEP * np.eye(
                    len(shared[peer])
                )
                moved = evaluate_reference(row, poses[i], poses).imag
                found[i, peer] = moved / site_dynamics.COMPLEX_STEP
    return found


def couple_sites(
    conditions: OperatingConditions, rest: Equilibrium, sites: list[SiteJacobian]
) -> dict[tuple[int, int], Array]:
    """Returns the effect of what j sent on what comes to i, shape (3 m, 3 m), by (i, j).

    To a law of one's own it comes once more, by itself.
    """
    references = differentiate_references(conditions, rest)
    coupling = {}
    for i, j in conditions.pairs:
        at = sites[i].at
        zero = np.zeros((sites[i].at.coordinates,) * 2)
        share = conditions.alpha[i, j] * np.eye(at.coordinates)
        whole = block_diag(references.get((i, j), zero), share, share)
        if at.peers:
            alone = np.zeros((at.peers, len(whole), len(whole)))
            # its tau_x is not ON its arm
            alone[j - (j > i)] = np.diag(np.repeat([1.0, 1.0, -1.0], at.coordinates))
            whole = np.vstack([whole, *alone])
        coupling[i, j] = whole
    return coupling


def find_loop_states(conditions: OperatingConditions) -> list[NDArray[np.bool_]]:
    """Returns which states of every site are in the loop, shape (states,) each: estimates if it
    learns.
    """
    masks = []
    for site in conditions.sites:
        at = site_dynamics.lay_out_arguments(site)
        mask = np.ones(at.states, dtype=bool)
        mask[at.estimate] = site_dynamics.has_estimate(site)
        masks.append(mask)
    return masks


def differentiate_rates(
    conditions: OperatingConditions, rest: Equilibrium, *, all_estimates: bool = False
) -> list[SiteJacobian]:
    """Returns the derivatives of the rates of every site by itself, see
    `differentiate_site_rates`.

    `all_estimates`: of chains too each estimate is a state, and not only what they say of
    gravity.
    """
    x = gather_site_arguments(conditions, rest)
    references = differentiate_references(conditions, rest)
    jacobians = []
    for i, (site, own) in enumerate(zip(conditions.sites, x, strict=True)):
        at = site_dynamics.lay_out_arguments(site)
        rates = site_dynamics.differentiate_site_rates(site, own)
        if conditions.has_forms:  # what such a law remembers holds the arm there
            left = site_dynamics.evaluate_site_rates(site, own).qdd
            own[at.external_torque] -= np.linalg.solve(rates.qdd[:, at.external_torque], left)
            rates = site_dynamics.differentiate_site_rates(site, own)
        if (i, i) in references:  # what it follows depends on its own orientation
            of_own = references[i, i] @ rates.x[:, : at.states]
            for by in rates:
                by[:, : at.states] += by[:, at.q_des] @ of_own
        learnt = tuple(f"theta{p + 1}" for p in range(at.parameters))
        if isinstance(site.own, NumericLaw):
            jacobian = SiteJacobian(at, rates, (*_name_motion(at.joints), *site.own.names))
        elif not site_dynamics.has_estimate(site):
            jacobian = _replace_estimate(at, rates, np.zeros((0, at.parameters)), ())
        elif site.chain is None or all_estimates:
            jacobian = SiteJacobian(at, rates, (*_name_motion(at.joints), *learnt))
        else:
            effect = rates.tau[:, at.estimate]
            _, R, order = qr(effect.T, mode="economic", pivoting=True)  # its independent rows
            sizes = np.abs(np.diag(R))
            joints = sorted(
                order[: int(np.sum(sizes > _DEPENDENT * max(1.0, sizes[0])))].tolist()
            )
            names = tuple(f"gravity{joint + 1}" for joint in joints)
            jacobian = _replace_estimate(at, rates, effect[joints], names)
            jacobian = jacobian._replace(omitted_states=at.parameters - len(joints))
        jacobians.append(jacobian)
    return jacobians


def _name_motion(joints: int) -> tuple[str, ...]:
    return tuple(f"{kind}{joint + 1}" for kind in ("q", "qd") for joint in range(joints))


def _replace_estimate(
    at: site_dynamics.ArgumentLayout,
    rates: site_dynamics.SiteRates,
    T: Array,
    names: tuple[str, ...],
) -> SiteJacobian:
    """Returns a site's derivatives with the states z = T theta_hat, shape (m, P), in place of
    theta_hat.

    All effects of the estimate must be combinations of z.
    """
    shown = np.linalg.pinv(T)

    def convert(by: Array) -> Array:
        """Returns derivatives by the new states."""
        return np.hstack(
            [by[:, : at.estimate.start], by[:, at.estimate] @ shown, by[:, at.estimate.stop :]]
        )

    converted = site_dynamics.SiteRates(*map(convert, rates))
    return SiteJacobian(
        site_dynamics.ArgumentLayout(at.joints, len(T), at.shared, at.peers),
        converted._replace(estimate=T @ converted.estimate),
        (*_name_motion(at.joints), *names),
    )


def linearise_loop(
    conditions: OperatingConditions, rest: Equilibrium, *, all_estimates: bool = False
) -> LinearLoop:
    """Returns the loop under given conditions, linearised at an equilibrium; see
    `differentiate_rates`.
    """
    sites = differentiate_rates(conditions, rest, all_estimates=all_estimates)
    own, ports = (
        [slice(a, b) for a, b in pairwise(np.cumsum([0, *lengths]).tolist())]
        for lengths in ([one.at.states for one in sites], [one.at.joints for one in sites])
    )
    size = own[-1].stop
    count = ports[-1].stop
    A = np.zeros((size, size))
    B = np.zeros((size, count))
    C = np.zeros((count, size))
    terms: dict[float, tuple[Array, Array]] = {}
    effects = []
    for i, (at, rates, _, _) in enumerate(sites):
        by = np.vstack(
            [np.eye(at.joints, at.arguments, at.qd.start), rates.qdd, rates.estimate]
        )
        A[own[i], own[i]] = by[:, : at.states]
        B[own[i], ports[i]] = by[:, at.external_torque]
        C[ports[i], own[i]] = np.eye(at.joints, at.states, at.qd.start)
        effects.append(by[:, at.inputs])
    for (i, j), coupling in couple_sites(conditions, rest, sites).items():
        delay_s = float(conditions.age_s[i, j])
        effect = effects[i] @ coupling
        late_A, late_B = terms.setdefault(delay_s, (np.zeros_like(A), np.zeros_like(B)))
        peer = sites[j]
        m = sites[j].at.coordinates
        late_A[own[i], own[j]] += effect @ peer.sent
        late_B[own[i], ports[j]] += (
            effect[:, 2 * m :] @ peer.rates.reflected[:, peer.at.external_torque]
        )
    names = [
        f"{name}.{state}"
        for name, one in zip(conditions.names, sites, strict=True)
        for state in one.states
    ]
    inputs, outputs = (
        tuple(
            f"{name}.{kind}{j + 1}"
            for name, one in zip(conditions.names, sites, strict=True)
            for j in range(one.at.joints)
        )
        for kind in ("tau", "qd")
    )
    delayed = tuple(DelayedTerm(delay_s, *terms[delay_s]) for delay_s in sorted(terms))
    omitted_states = sum(one.omitted_states for one in sites)
    loop = LinearLoop(
        names=tuple(names),
        inputs=inputs,
        outputs=outputs,
        A=A,
        B=B,
        C=C,
        delayed=delayed,
        omitted_states=omitted_states,
    )
    if all_estimates or not conditions.has_forms:
        return loop
    return add_law_forms(conditions, sites, loop)


def add_law_forms(
    conditions: OperatingConditions, sites: Sequence[SiteJacobian], loop: LinearLoop
) -> LinearLoop:
    """Returns a loop with the states of laws that have their own, and with what they send.

    What is sent has no rate: a law gives it at once, and the peer gets it after the delay.
    """
    inertia = [np.linalg.inv(one.rates.qdd[:, one.at.external_torque]) for one in sites]
    forms = conditions.find_forms(inertia)
    at, names = _place_form_states(conditions, forms, loop)
    size = len(names)
    count = len(loop.inputs)
    terms = {0.0: (np.zeros((size, size)), np.zeros((size, count)))}
    for delay_s, A, B in (DelayedTerm(0.0, loop.A, loop.B), *loop.delayed):
        late_A, late_B = terms.setdefault(
            delay_s, (np.zeros((size, size)), np.zeros((size, count)))
        )
        late_A[: len(A), : len(A)] = A
        late_B[: len(B)] = B
    E = np.ones(size)
    for i, form in enumerate(forms):
        if form is not None:
            _add_form(
                conditions=conditions, sites=sites, places=at, i=i, form=form, terms=terms
            )
    for i, form in enumerate(forms):  # when all that accelerates an arm is there
        for j in form.list_receivers() if form is not None else ():
            channel = at[i, ("to", j)]
            E[channel] = 0.0
            if form is not None and form.sends_acceleration:
                for A, B in terms.values():
                    A[channel] = A[at[i, "qd"]]
                    B[channel] = B[at[i, "qd"]]
            terms[0.0][0][channel, channel] -= np.eye(len(sites[i].rates.qdd))
    A, B = terms.pop(0.0)
    C = np.hstack([loop.C, np.zeros((len(loop.C), size - loop.C.shape[1]))])
    delayed = tuple(DelayedTerm(delay_s, *terms[delay_s]) for delay_s in sorted(terms))
    return loop._replace(names=tuple(names), A=A, B=B, C=C, delayed=delayed, E=E)


_Places = dict[tuple[int, Place], slice]


def _place_form_states(
    conditions: OperatingConditions, forms: Sequence[LinearForm | None], loop: LinearLoop
) -> tuple[_Places, list[str]]:
    places: _Places = {}
    names = list(loop.names)
    for i, (name, form) in enumerate(zip(conditions.names, forms, strict=True)):
        n = conditions.sites[i].layout.joints
        for kind in ("q", "qd"):
            first = names.index(f"{name}.{kind}1")
            places[i, kind] = slice(first, first + n)
        more: list[tuple[Place, str]] = []
        if form is not None:
            more += [(state, state) for state in form.states]
            more += [(("to", j), f"to_{conditions.names[j]}_") for j in form.list_receivers()]
        for place, label in more:
            places[i, place] = slice(len(names), len(names) + n)
            names += [f"{name}.{label}{joint + 1}" for joint in range(n)]
    return places, names


def _add_form(
    conditions: OperatingConditions,
    sites: Sequence[SiteJacobian],
    places: _Places,
    i: int,
    form: LinearForm,
    terms: dict[float, tuple[Array, Array]],
) -> None:
    site = sites[i]
    ports = np.cumsum([0, *(one.at.joints for one in sites)])

    def late(j: int) -> tuple[Array, Array]:
        zeros = np.zeros_like(terms[0.0][0]), np.zeros_like(terms[0.0][1])
        return terms.setdefault(float(conditions.age_s[i, j]), zeros)

    for (row, column), gain in form.blocks.items():
        accelerates = row == "tau"
        rows = places[i, "qd" if accelerates else row]
        block = site.rates.qdd[:, site.at.external_torque] @ gain if accelerates else gain
        if column == "tau_h":
            own = slice(places[i, "q"].start, places[i, "qd"].stop)
            on_arm = site.rates.external + site.rates.held
            terms[0.0][0][rows, own] += block @ on_arm[:, : site.at.qd.stop]
            terms[0.0][1][rows, ports[i] : ports[i + 1]] += (
                block @ on_arm[:, site.at.external_torque]
            )
        elif column in ("q_des", "qd_des"):
            for j in np.flatnonzero(conditions.alpha[i]):
                sent = places[int(j), str(column).removesuffix("_des")]
                late(int(j))[0][rows, sent] += conditions.alpha[i, j] * block
        elif isinstance(column, tuple):
            if (column[1], ("to", i)) in places:
                late(column[1])[0][rows, places[column[1], ("to", i)]] += block
        else:
            terms[0.0][0][rows, places[i, column]] += block
