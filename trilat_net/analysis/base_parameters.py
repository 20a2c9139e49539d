"""Finds the combinations of an arm's dynamic parameters that can be learnt from its torques.

A chain of joints has ten inertial parameters per link, but its torques depend only on certain
linear combinations of them, the base parameters. Estimation errors are expressed in these base
parameters. They are found with a QR decomposition: M. Gautier, "Numerical calculation of the
base inertial parameters of robots", J. Robotic Systems 8 (1991).

The pseudo-inertia of a link shows whether its parameters are physically possible: P. M.
Wensing, S. Kim, J.-J. Slotine, "Linear matrix inequalities for physically consistent inertial
parameter identification", IEEE Robotics and Automation Letters 3 (2018).
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core import LINK_PARAMETERS, Array, ChainSetup
from .arm_rows import ArmRows, ChainArmRows

DEPENDENT_SHARE = 1e-9
"""Largest part of a column that is independent of the columns before it for the column to count
as dependent on them, relative to the column.
"""


class _BaseParameters(NamedTuple):
    """Base parameters of an arm: combinations of masses and inertias that torques determine.

    No measurement of torque and motion can determine every single dynamic parameter in the
    vector theta of a chain. Such a measurement determines only the B linear combinations in the
    rows of `combination`, and the base parameters are combination @ theta.

    Attributes:
        kept: For each combination, the index of the parameter after which the combination is
            named, ascending, shape (B,).
        combination: Factors of all P parameters in each combination, shape (B, P). The factor
            of the parameter that gives the name is 1.
    """

    kept: NDArray[np.int64]
    combination: Array


def stack_regressors(arm: ChainArmRows, states: int) -> Array:
    """Returns the regressors of random motions, stacked into one matrix.

    A regressor maps the dynamic parameters to joint torques. The column space of the stacked
    matrix shows which combinations of parameters affect the torques.

    Args:
        arm: The chain with n joints.
        states: Number of random states, each with angles, velocities and accelerations.

    Returns:
        Matrix, shape (states n, 10 n).
    """
    random = np.random.default_rng(1)
    n = len(arm.chain.joints)
    parameters = len(arm.theta)
    q = random.uniform(-np.pi, np.pi, (states, n))
    qd, qdd = random.normal(size=(2, states, n))
    # column p of a regressor is the torque of a chain whose only nonzero parameter is p, 1
    state_of_row = np.repeat(np.arange(states), parameters)
    unit_parameters = np.tile(np.eye(parameters), (states, 1))
    links = arm.without_drives()
    torque = links.law_torque(
        theta_hat=unit_parameters,
        q=q[state_of_row],
        qd=qd[state_of_row],
        v=qd[state_of_row],
        a=qdd[state_of_row],
    )

    columns = torque.reshape(states, parameters, n)
    regressors = columns.transpose(0, 2, 1)
    return regressors.reshape(-1, parameters)


@lru_cache(maxsize=64)
def _find_chain_base(chain: ChainSetup, learnt: tuple[bool, ...]) -> _BaseParameters:
    """Finds the base parameters of a serial arm by a QR decomposition (Gautier 1991).

    Base parameters are the combinations of masses and inertias that joint torques determine. If
    a column of the stacked regressors depends linearly on the columns before it, torques do not
    determine the parameter of this column by itself.

    Args:
        chain: The chain.
        learnt: True for each parameter that the control law learns.
    """
    arm = ChainArmRows(np.zeros(len(learnt)), chain)
    # random motions excite every combination that has an effect on the torques
    regressors = stack_regressors(arm, 4 * LINK_PARAMETERS)
    learnt_columns = regressors[:, list(learnt)]
    learnt_indices = np.flatnonzero(learnt)

    matrix_norm = float(np.linalg.norm(learnt_columns))
    root_of_columns = np.sqrt(learnt_columns.shape[1])
    least_norm = DEPENDENT_SHARE * matrix_norm / root_of_columns

    basis = np.zeros((len(learnt_columns), 0))
    independent = []
    for column_index, column in enumerate(learnt_columns.T):
        # Gram-Schmidt, twice: the first pass leaves rounding errors of the size of the column
        remainder = column - basis @ (basis.T @ column)
        remainder -= basis @ (basis.T @ remainder)
        remainder_norm = float(np.linalg.norm(remainder))
        if remainder_norm > least_norm:
            basis = np.column_stack([basis, remainder / remainder_norm])
            independent.append(column_index)

    independent_columns = learnt_columns[:, independent]
    factors = np.linalg.lstsq(independent_columns, learnt_columns, rcond=None)[0]
    contributes = np.abs(factors) > DEPENDENT_SHARE

    parameter_indices = learnt_indices[independent]
    base_count = len(independent)
    combination = np.zeros((base_count, len(learnt)))
    combination[:, learnt_indices] = np.where(contributes, factors, 0.0)
    combination[:, parameter_indices] = np.eye(base_count)
    return _BaseParameters(parameter_indices, combination)


def find_base_parameters(arm: ArmRows, learnt: NDArray[np.bool_]) -> _BaseParameters:
    """Finds the combinations of dynamic parameters that can be learnt from an arm's torques.

    Torques do not determine every parameter of a chain, only certain linear combinations of
    them, called base parameters. For the planar arm, each of the five parameters is a base
    parameter.

    Args:
        arm: The arm, with P dynamic parameters.
        learnt: True for each parameter that the control law learns, shape (P,). The other
            parameters are excluded from all combinations.
    """
    if isinstance(arm, ChainArmRows):
        return _find_chain_base(arm.chain, tuple(learnt.tolist()))
    kept = np.flatnonzero(learnt)
    combination = np.eye(len(learnt))[kept]
    return _BaseParameters(kept, combination)


def find_pseudo_inertias(theta: Array) -> Array:
    """Returns the pseudo-inertia of every link, shape (n, 4, 4).

    This symmetric matrix combines the ten parameters of a link. It is positive definite if and
    only if the parameters belong to a possible rigid body. The matrix is [[S, m c], [m c', m]]
    with S = tr(I) / 2 - I, where m is the mass of the link, m c its first moment, I its
    inertia, and tr the trace.

    Args:
        theta: Parameters of the links, shape (10 n,).
    """
    links = theta.reshape(-1, LINK_PARAMETERS)
    mass = links[:, 0]
    moment = links[:, 1:4]
    inertias = links[:, 4:]
    xx, xy, yy, xz, yz, zz = inertias.T
    row_x = [xx, xy, xz]
    row_y = [xy, yy, yz]
    row_z = [xz, yz, zz]
    inertia = np.array([row_x, row_y, row_z])
    inertia_of_link = inertia.transpose(2, 0, 1)
    half_trace = 0.5 * (xx + yy + zz)
    half_trace_of_link = half_trace[:, np.newaxis, np.newaxis]
    S = half_trace_of_link * np.eye(3) - inertia_of_link

    count = len(links)
    pseudo_inertias = np.zeros((count, 4, 4))
    pseudo_inertias[:, :3, :3] = S
    pseudo_inertias[:, :3, 3] = moment
    pseudo_inertias[:, 3, :3] = moment
    pseudo_inertias[:, 3, 3] = mass
    return pseudo_inertias


def find_consistent_links(theta: Array) -> list[bool]:
    """Finds the links whose learnt masses and inertias are physically possible.

    A negative mass, for example, is impossible. The condition is that the pseudo-inertia of the
    link (see `find_pseudo_inertias`) is positive definite (Wensing et al. 2018).

    Args:
        theta: Parameters of the links, shape (10 n,).
    """
    pseudo_inertias = find_pseudo_inertias(theta)
    eigenvalues = np.linalg.eigvalsh(pseudo_inertias)
    least_eigenvalues = eigenvalues.min(axis=1)
    is_positive_definite = least_eigenvalues > 0.0
    consistent: list[bool] = is_positive_definite.tolist()
    return consistent
