"""Converts and combines rotation vectors (axis times angle, rad), identically on all machines.

The angular velocity of a changing rotation vector u is J(u) u', where J is the left Jacobian of
the rotation group (J. Sola, J. Deray and D. Atchuthan, "A micro Lie theory for state estimation
in robotics", arXiv 1812.01537, Eq. 145, 146). The arc tangent is from S. Moshier's Cephes
library.

Invariant:
    - The length of a rotation vector is at most pi.
    - `rotation_matrix` and `rotation_vector` are inverses of each other.
    - Only basic arithmetic and square roots are used, which all machines round identically.
"""

import math

from ..step.jit import leaf
from ..step.vectors import Array, choose
from .chain import Matrix, Three, add_vectors, cross_product, dot_product, scale_vector
from .elementary import sincos

_SMALL = 1e-8
"""Angle, rad, below which the sine equals the angle to the last bit."""
_SHORT = 0.02
"""Angle, rad, below which the first terms of a series are exact to the last bit, whereas closed
forms are not.
"""


@leaf
def arctan(x: float) -> float:
    """Returns the arc tangent of a number from 0 to 1, rad, bit-identical on every machine.

    The standard library is not used because its last bit differs between platforms. The method
    is from Cephes (`atan`): a rational function P / Q of x^2, with a range reduction for
    arguments above 0.66.
    """
    # arctan(x) = pi / 4 + arctan((x - 1) / (x + 1))
    is_large = x > 0.66
    offset = choose(is_large, 0.25 * math.pi, 0.0)
    x = choose(is_large, (x - 1.0) / (x + 1.0), x)
    z = x * x
    P = -8.750608600031904122785e-1
    P = P * z - 1.615753718733365076637e1
    P = P * z - 7.500855792314704667340e1
    P = P * z - 1.228866684490136173410e2
    P = P * z - 6.485021904942025371773e1
    Q = z + 2.485846490142306297962e1
    Q = Q * z + 1.650270098316988542046e2
    Q = Q * z + 4.328810604912902668951e2
    Q = Q * z + 4.853903996359136964868e2
    Q = Q * z + 1.945506571482613964425e2
    return offset + (x + x * (z * P / Q))


@leaf
def rotation_matrix(vector: Three) -> Matrix:
    """Returns the rotation matrix of a rotation vector, as three rows.

    The direction of a rotation vector is the rotation axis, and its length is the angle in rad.
    Rodrigues' formula is used. For small angles, its coefficients are replaced by their limits.
    """
    x, y, z = vector
    angle = math.sqrt(x * x + y * y + z * z)
    s, c = sincos(angle)
    # The quotients have limits for small angles.
    has_angle = angle > _SMALL
    divisor = choose(has_angle, angle, 1.0)
    by_sine = choose(has_angle, s / divisor, 1.0)
    by_cosine = choose(has_angle, (1.0 - c) / (divisor * divisor), 0.5)
    xx = by_cosine * x * x
    yy = by_cosine * y * y
    zz = by_cosine * z * z
    xy = by_cosine * x * y
    xz = by_cosine * x * z
    yz = by_cosine * y * z
    sx = by_sine * x
    sy = by_sine * y
    sz = by_sine * z
    row_x = (1.0 - yy - zz, xy - sz, xz + sy)
    row_y = (xy + sz, 1.0 - xx - zz, yz - sx)
    row_z = (xz - sy, yz + sx, 1.0 - xx - yy)
    return row_x, row_y, row_z


@leaf
def _choose_component(
    trace: float, xx: float, yy: float, zz: float, components: tuple[float, float, float, float]
) -> float:
    """Returns one of four values, depending on which quaternion component is largest.

    The components themselves are not yet known. The component with the largest magnitude is
    determined from the trace and the diagonal of the rotation matrix.

    Args:
        trace: Trace of the rotation matrix.
        xx: First diagonal element.
        yy: Second diagonal element.
        zz: Third diagonal element.
        components: Values to return if w, x, y or z is the largest component.
    """
    by_w, by_x, by_y, by_z = components
    by_others = choose(yy >= zz, by_y, by_z)
    by_axis = choose(xx >= yy, choose(xx >= zz, by_x, by_others), by_others)
    return choose(trace >= max(max(xx, yy), zz), by_w, by_axis)


@leaf
def _quaternion(R: Array | Matrix) -> tuple[float, Three]:
    """Converts a rotation matrix to a quaternion (w, v), with the scalar part w >= 0.

    The method starts from the largest component (Shepperd, 1978), which avoids division by a
    small number.
    """
    xx, xy, xz = R[0]
    yx, yy, yz = R[1]
    zx, zy, zz = R[2]
    trace = xx + yy + zz
    x_difference = zy - yz
    y_difference = xz - zx
    z_difference = yx - xy
    xy_sum = xy + yx
    xz_sum = xz + zx
    yz_sum = yz + zy
    all_w = (1.0 + trace, x_difference, y_difference, z_difference)
    all_x = (x_difference, 1.0 + xx - yy - zz, xy_sum, xz_sum)
    all_y = (y_difference, xy_sum, 1.0 + yy - xx - zz, yz_sum)
    all_z = (z_difference, xz_sum, yz_sum, 1.0 + zz - xx - yy)
    w = _choose_component(trace, xx, yy, zz, all_w)
    x = _choose_component(trace, xx, yy, zz, all_x)
    y = _choose_component(trace, xx, yy, zz, all_y)
    z = _choose_component(trace, xx, yy, zz, all_z)
    length = math.sqrt(w * w + x * x + y * y + z * z)
    length = choose(w < 0.0, -length, length)
    return w / length, scale_vector(1.0 / length, (x, y, z))


@leaf
def rotation_vector(R: Array | Matrix) -> Three:
    """Returns the rotation vector (axis times angle, rad) of a rotation matrix.

    Args:
        R: The rotation matrix, three rows.
    """
    # w is the cosine of half the angle. v is the axis times the sine of half the angle.
    w, v = _quaternion(R)
    x, y, z = v
    square = x * x + y * y + z * z
    n = math.sqrt(square)
    # `arctan` takes arguments up to 1.
    is_flat = n <= w
    part = arctan(choose(is_flat, n, w) / choose(is_flat, w, n))
    half_angle = choose(is_flat, part, 0.5 * math.pi - part)
    angle = 2.0 * half_angle
    is_small = n < _SMALL
    factor = choose(is_small, 2.0, angle) / choose(is_small, w, n)
    return scale_vector(factor, v)


@leaf
def relative_rotation(R: Array | Matrix, other: Array | Matrix) -> Three:
    """Returns the rotation that takes the orientation `other` to the orientation R.

    For an arm that should reach `other`, this is the orientation error.

    Args:
        R: Rotation matrix of the first orientation, three rows.
        other: Rotation matrix of the second orientation, three rows.

    Returns:
        The rotation vector of R other' in base axes. Its direction is the rotation axis, and
        its length is the angle in rad.
    """
    row_1 = other[0]
    row_2 = other[1]
    row_3 = other[2]
    first = _times_rows(R[0], row_1, row_2, row_3)
    second = _times_rows(R[1], row_1, row_2, row_3)
    third = _times_rows(R[2], row_1, row_2, row_3)
    return rotation_vector((first, second, third))


@leaf
def _times_rows(row: Three, a: Three, b: Three, c: Three) -> Three:
    """Returns the scalar products of the vector `row` with the three vectors a, b and c.

    The result is one row of the matrix product P Q', where `row` is a row of P, and a, b and c
    are the rows of Q.
    """
    x = row[0]
    y = row[1]
    z = row[2]
    with_a = x * a[0] + y * a[1] + z * a[2]
    with_b = x * b[0] + y * b[1] + z * b[2]
    with_c = x * c[0] + y * c[1] + z * c[2]
    return with_a, with_b, with_c


@leaf
def compose_rotations(turn: Three, vector: Three) -> Three:
    """Returns the rotation `vector` followed by the rotation `turn` about base axes.

    Arguments and result are rotation vectors (axis times angle, rad). If T and R are the
    rotation matrices of `turn` and `vector`, the result is the rotation vector of T R.

    Args:
        turn: Rotation vector of the second rotation, rad.
        vector: Rotation vector of the first rotation, rad.
    """
    second_matrix = rotation_matrix(turn)
    inverse_vector = scale_vector(-1.0, vector)
    first_matrix_inverse = rotation_matrix(inverse_vector)
    # `relative_rotation` transposes its second matrix, and the transpose of R' is R.
    return relative_rotation(second_matrix, first_matrix_inverse)


@leaf
def rotate_by_vector(turn: Three, vector: Three) -> Three:
    """Rotates a 3D vector by the rotation given as a rotation vector.

    For example, the rotation vector (0, 0, pi/2) turns the x axis into the y axis.

    Args:
        turn: Rotation vector. Its direction is the rotation axis, and its length is the angle
            in rad.
        vector: The vector to rotate.
    """
    x, y, z = rotation_matrix(turn)
    return _times_rows(vector, x, y, z)


@leaf
def length(vector: Three) -> float:
    """Returns the Euclidean length of a 3D vector, in the same unit as its components."""
    return math.sqrt(dot_product(vector, vector))


@leaf
def angular_velocity(turn: Three, rate: Three) -> Three:
    """Returns the angular velocity of a body with a changing rotation vector, rad/s.

    The angular velocity equals the derivative of the rotation vector only while the axis is
    fixed. In general, for a rotation vector u with length a (the angle) and derivative u', the
    angular velocity is the left Jacobian times u':

        w = u' + (1 - cos a) / a^2  u x u' + (a - sin a) / a^3  u x (u x u')

    Args:
        turn: The rotation vector u, rad.
        rate: The derivative u' of the rotation vector, rad/s.
    """
    angle = length(turn)
    a2 = angle * angle
    if angle < _SHORT:
        # Series, because the differences would lose digits.
        a4 = a2 * a2
        once_gain = 0.5 - a2 / 24.0 + a4 / 720.0
        twice_gain = 1.0 / 6.0 - a2 / 120.0 + a4 / 5040.0
    else:
        s, c = sincos(angle)
        once_gain = (1.0 - c) / a2
        twice_gain = (angle - s) / (a2 * angle)
    crossed_once = cross_product(turn, rate)
    crossed_twice = cross_product(turn, crossed_once)
    once_part = scale_vector(once_gain, crossed_once)
    twice_part = scale_vector(twice_gain, crossed_twice)
    correction = add_vectors(once_part, twice_part)
    return add_vectors(rate, correction)


@leaf
def rotation_vector_rate(turn: Three, velocity: Three) -> Three:
    """Returns the derivative of a rotation vector for a given angular velocity, rad/s.

    This is the inverse of `angular_velocity`. For a rotation vector u with length a (the angle)
    and the angular velocity w about base axes, the derivative is the inverse of the left
    Jacobian times w:

        u' = w - 1/2 u x w + c u x (u x w),    c = (1 - (a / 2) cos(a / 2) / sin(a / 2)) / a^2

    For small angles, c is evaluated as the series 1/12 + a^2 / 720 + a^4 / 30240.

    Args:
        turn: The rotation vector u, rad.
        velocity: The angular velocity w, rad/s.
    """
    angle = length(turn)
    a2 = angle * angle
    if angle < _SHORT:
        a4 = a2 * a2
        c = 1.0 / 12.0 + a2 / 720.0 + a4 / 30240.0
    else:
        half_angle = 0.5 * angle
        sine, cosine = sincos(half_angle)
        c = (1.0 - half_angle * cosine / sine) / a2
    u_x_w = cross_product(turn, velocity)
    u_x_u_x_w = cross_product(turn, u_x_w)
    first_order_part = scale_vector(-0.5, u_x_w)
    second_order_part = scale_vector(c, u_x_u_x_w)
    correction = add_vectors(first_order_part, second_order_part)
    return add_vectors(velocity, correction)
