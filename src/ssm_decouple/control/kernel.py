"""The compiled algebra of the selective law: a few arrays in, a few arrays out.

Everything that one control step does after Pinocchio has filled its matrices stands in this file. Each function is
plain Python on NumPy arrays, compiled by Numba; `selective_command.py_func` is the same function uncompiled.

Why one file: Numba keeps compiled code on disk and watches only the file that a function stands in, so a compiled
function must not call one that stands in another file.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TypeVar, cast

import numba
import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

F = TypeVar("F", bound=Callable[..., Any])


def compiled_for(*signature: str) -> Callable[[F], F]:
    """Compile with Numba and keep the machine code on disk.

    With a signature it is compiled for that one only: an array of another layout must not start a second compilation.
    """

    def decorate(function: F) -> F:
        njit: Any = numba.njit
        try:
            return cast(F, njit(*signature, cache=True, error_model="numpy")(function))
        except RuntimeError:  # no folder can be written: compile anew in each process
            return cast(F, njit(*signature, error_model="numpy")(function))

    return decorate


compiled = compiled_for()


_MATRIX, _ROWS, _VECTOR = "float64[::1, :]", "float64[:, ::1]", "float64[::1]"
# Pinocchio's matrices are stored by columns, everything else by rows.
SELECTIVE_COMMAND = (
    f"int64({_MATRIX}, {_MATRIX}, {_MATRIX}, {_VECTOR}, "  # from Pinocchio
    f"{_ROWS}, boolean, {_ROWS}, {_VECTOR}, "  # constants
    f"{_VECTOR}, {_VECTOR}, {_VECTOR})"
)


# What selective_command returns.
OK = 0
NOT_FINITE = 1
NO_INERTIA = 2
NOT_UNIT_QUATERNION = 3
WRONG_SIZE = 4

# Where the results stand in `out`: first Pinocchio's velocity v, base twist (6: linear, angular, base axes) and joint
# rates (n), then the following, counted from 6 + n.
PROTECTED_RATE = 0  # 3, the first k used
POSITION = 3  # 3: end-effector, inertial axes
ERROR = 6  # 3: target minus end-effector, inertial axes
SMALLEST_SINGULAR_VALUE = 9  # of J_g N_sub
RATE_SCALE = 10
DAMPING = 11  # rho
RANK = 12  # of J_sub
RESULTS_SIZE = 13

# Where the scalars stand in `parameters`.
GAIN = 0
THRESHOLD = 1
DAMPING_LIMIT = 2
MASS = 3
TOOL = 4  # 3: the end-effector in its joint's frame
PARAMETERS_SIZE = 7

# The rows of `columns`: one entry a joint.
MOVES_TOOL = 0  # 1.0 where the joint carries the end-effector, else 0.0
RATE_LIMIT = 1

EPS = 2.220446049250313e-16
# A row of J_sub below this many rounding errors of J_rc constrains nothing: it is noise.
NOISE = 16.0 * EPS
# Rates are scaled to just inside the limit, so that no later rounding lifts one above it.
INSIDE = 1.0 - 8.0 * EPS


@compiled
def base_twist_map(A_g: Floats, J_base: Floats) -> float:
    """Fill J_base (6, n), the base twist in base axes per joint rate at zero momentum; return det(H_ww), 0 if singular.

    A_g is Pinocchio's centroidal map (6, 6 + n). Its angular rows are zero in the base's linear columns and its
    upper left block is m R, so that the 6 x 6 system solves in two steps: the angular rows give J_rc = -H_ww^-1 H_wq,
    the linear rows then give the velocity of the base origin.
    """
    a, b, c = A_g[3, 3], A_g[3, 4], A_g[3, 5]
    d, e, f = A_g[4, 3], A_g[4, 4], A_g[4, 5]
    g, h, i = A_g[5, 3], A_g[5, 4], A_g[5, 5]
    c0, c1, c2 = e * i - f * h, f * g - d * i, d * h - e * g
    determinant = a * c0 + b * c1 + c * c2
    square = a * a + b * b + c * c + d * d + e * e + f * f + g * g + h * h + i * i
    if determinant <= NOISE * square * np.sqrt(square):
        return 0.0
    s = -1.0 / determinant
    i00, i01, i02 = s * c0, s * (c * h - b * i), s * (b * f - c * e)
    i10, i11, i12 = s * c1, s * (a * i - c * g), s * (c * d - a * f)
    i20, i21, i22 = s * c2, s * (b * g - a * h), s * (a * e - b * d)
    m_squared = A_g[0, 0] ** 2 + A_g[1, 0] ** 2 + A_g[2, 0] ** 2
    t = -1.0 / m_squared
    for j in range(J_base.shape[1]):
        x, y, z = A_g[3, 6 + j], A_g[4, 6 + j], A_g[5, 6 + j]
        u = i00 * x + i01 * y + i02 * z
        v = i10 * x + i11 * y + i12 * z
        w = i20 * x + i21 * y + i22 * z
        px = t * (A_g[0, 6 + j] + A_g[0, 3] * u + A_g[0, 4] * v + A_g[0, 5] * w)
        py = t * (A_g[1, 6 + j] + A_g[1, 3] * u + A_g[1, 4] * v + A_g[1, 5] * w)
        pz = t * (A_g[2, 6 + j] + A_g[2, 3] * u + A_g[2, 4] * v + A_g[2, 5] * w)
        J_base[0, j] = A_g[0, 0] * px + A_g[1, 0] * py + A_g[2, 0] * pz
        J_base[1, j] = A_g[0, 1] * px + A_g[1, 1] * py + A_g[2, 1] * pz
        J_base[2, j] = A_g[0, 2] * px + A_g[1, 2] * py + A_g[2, 2] * pz
        J_base[3, j] = u
        J_base[4, j] = v
        J_base[5, j] = w
    return determinant


@compiled
def point_velocity_map(J: Floats, p: Floats, J_base: Floats, columns: Floats, base: Floats, J_g: Floats) -> None:
    """Fill J_g (3, n), the velocity of the point p per joint rate while momentum is conserved, inertial axes.

    J (6, 6 + n) is Pinocchio's Jacobian at the world origin: a joint that carries the point moves it by
    J_linear + J_angular x p, and every joint moves it through the base. `base` (3, 6) is scratch.
    """
    for c in range(6):
        base[0, c] = J[0, c] + J[4, c] * p[2] - J[5, c] * p[1]
        base[1, c] = J[1, c] + J[5, c] * p[0] - J[3, c] * p[2]
        base[2, c] = J[2, c] + J[3, c] * p[1] - J[4, c] * p[0]
    for j in range(J_g.shape[1]):
        c = 6 + j
        moves = columns[MOVES_TOOL, j]
        J_g[0, j] = moves * (J[0, c] + J[4, c] * p[2] - J[5, c] * p[1])
        J_g[1, j] = moves * (J[1, c] + J[5, c] * p[0] - J[3, c] * p[2])
        J_g[2, j] = moves * (J[2, c] + J[3, c] * p[1] - J[4, c] * p[0])
        for r in range(3):
            for b in range(6):
                J_g[r, j] += base[r, b] * J_base[b, j]


@compiled
def reflect(rows: Floats, weights: Floats, i: int, start: int) -> float:
    """Make rows[i, start:] a Householder vector that maps that row on its first entry; return the new entry."""
    n = rows.shape[1]
    square = 0.0
    for j in range(start, n):
        square += rows[i, j] * rows[i, j]
    norm = np.sqrt(square)
    if norm == 0.0:
        weights[i] = 0.0
        return 0.0
    head = rows[i, start]
    weights[i] = 1.0 / (norm * (norm + abs(head)))
    if head > 0.0:
        rows[i, start] = head + norm
        return -norm
    rows[i, start] = head - norm
    return norm


@compiled
def apply_reflection(rows: Floats, weights: Floats, i: int, start: int, x: Floats) -> None:
    """Apply the reflection that rows[i, start:] holds to the vector x (n,), in place."""
    product = 0.0
    for j in range(start, x.shape[0]):
        product += rows[i, j] * x[j]
    product *= weights[i]
    for j in range(start, x.shape[0]):
        x[j] -= product * rows[i, j]


@compiled
def orthogonalise_columns(B: Floats, V: Floats) -> float:
    """Turn the columns of B (3, 3) until they are orthogonal, V (3, 3) with them; return the shortest length.

    One-sided Jacobi: B V0 = U S, so the column lengths are the singular values, small ones to full accuracy. What
    B and V hold on return solves any damped least-squares problem in B by three scalar divisions.
    """
    for a in range(3):
        for b in range(3):
            V[a, b] = 1.0 if a == b else 0.0
    for _ in range(30):
        turned = False
        for a in range(2):
            for b in range(a + 1, 3):
                aa = B[0, a] * B[0, a] + B[1, a] * B[1, a] + B[2, a] * B[2, a]
                bb = B[0, b] * B[0, b] + B[1, b] * B[1, b] + B[2, b] * B[2, b]
                ab = B[0, a] * B[0, b] + B[1, a] * B[1, b] + B[2, a] * B[2, b]
                if ab * ab <= EPS * EPS * aa * bb:
                    continue
                turned = True
                zeta = (bb - aa) / (2.0 * ab)
                t = 1.0 / (abs(zeta) + np.sqrt(1.0 + zeta * zeta))
                if zeta < 0.0:
                    t = -t
                cosine = 1.0 / np.sqrt(1.0 + t * t)
                sine = cosine * t
                for r in range(3):
                    B[r, a], B[r, b] = cosine * B[r, a] - sine * B[r, b], sine * B[r, a] + cosine * B[r, b]
                    V[r, a], V[r, b] = cosine * V[r, a] - sine * V[r, b], sine * V[r, a] + cosine * V[r, b]
        if not turned:
            break
    shortest = np.inf
    for a in range(3):
        shortest = min(shortest, B[0, a] ** 2 + B[1, a] ** 2 + B[2, a] ** 2)
    return np.sqrt(shortest)


@compiled
def scale_to_limits(q_dot: Floats, columns: Floats) -> float:
    """Scale q_dot (n,) as a whole, in place, to inside every joint's limit; return the factor, 1 if it was inside.

    Clipping joint by joint would leave null(J_sub).
    """
    factor = 1.0
    for j in range(q_dot.shape[0]):
        size = abs(q_dot[j])
        if size * factor > columns[RATE_LIMIT, j]:
            factor = INSIDE * columns[RATE_LIMIT, j] / size
    if factor < 1.0:
        for j in range(q_dot.shape[0]):
            q_dot[j] *= factor
    return factor


@compiled_for(SELECTIVE_COMMAND)
def selective_command(
    A_g: Floats,
    J: Floats,
    joint_rotation: Floats,
    joint_translation: Floats,
    U_c: Floats,
    inertial: bool,
    columns: Floats,
    parameters: Floats,
    target: Floats,
    target_velocity: Floats,
    out: Floats,
) -> int:
    """Write q_dot = (J_g N_sub)^+ v_cmd and what follows from it into `out`; return OK or what is wrong.

    One Householder factorisation of [J_sub; J_g]^T carries the whole law. With Q its reflections in order, J_sub is
    lower triangular in the first r = rank(J_sub) coordinates of Q^T q_dot, so a rate that is zero in those lies in
    null(J_sub) whatever the others are. In the next three coordinates J_g is the lower triangular L (3, 3), whose
    singular values are those of J_g N_sub, and min |L y - v_cmd|^2 + rho |y|^2 is the paper's objective.

    Args:
        A_g: Centroidal map (6, 6 + n), `pin.Data.Ag` after `pin.computeCentroidalMap`.
        J: Joint Jacobians at the world origin (6, 6 + n), `pin.Data.J` after the same call.
        joint_rotation: Rotation (3, 3) of the joint that holds the end-effector, joint to inertial.
        joint_translation: Its position (3,), m, inertial axes.
        U_c: Protected directions (3, k), orthonormal columns.
        inertial: Whether U_c is in inertial axes instead of base axes.
        columns: (2, n), MOVES_TOOL and RATE_LIMIT for each joint.
        parameters: (PARAMETERS_SIZE,), by the indices above.
        target: Desired end-effector position (3,), m, inertial axes.
        target_velocity: Its velocity (3,), m/s.
        out: (6 + n + RESULTS_SIZE,), overwritten.

    Returns:
        OK, NOT_FINITE (in the configuration or the target), NO_INERTIA (H_ww is singular), NOT_UNIT_QUATERNION or
        WRONG_SIZE (of a target or of `out`).
    """
    n = columns.shape[1]
    k = U_c.shape[1]
    if target.shape[0] != 3 or target_velocity.shape[0] != 3 or out.shape[0] != 6 + n + RESULTS_SIZE:
        return WRONG_SIZE
    results = out[6 + n :]
    mass = parameters[MASS]
    m_squared = A_g[0, 0] ** 2 + A_g[1, 0] ** 2 + A_g[2, 0] ** 2
    if abs(m_squared - mass * mass) > 1e-6 * mass * mass:
        return NOT_UNIT_QUATERNION

    # Two allocations for all scratch: each would cost as much as a reflection.
    scratch = np.empty((2 * k + 14, n))
    J_base, J_g, J_sub = scratch[0:6], scratch[6:9], scratch[9 : 9 + k]
    rows, q_dot, leak = scratch[9 + k : 12 + 2 * k], scratch[12 + 2 * k], scratch[13 + 2 * k]
    small = np.empty((11, 6))
    L, V, base = small[0:3], small[3:6], small[6:9]
    weights, diagonal = small[9], small[10]

    # The momentum law: base twist and end-effector velocity per joint rate.
    determinant = base_twist_map(A_g, J_base)
    if determinant == 0.0:
        return NO_INERTIA
    p = results[POSITION : POSITION + 3]
    for r in range(3):
        p[r] = joint_translation[r]
        for c in range(3):
            p[r] += joint_rotation[r, c] * parameters[TOOL + c]
    point_velocity_map(J, p, J_base, columns, base, J_g)

    # Rows of J_sub and their scale, |J_rc|.
    scale = 0.0
    for j in range(n):
        x, y, z = J_base[3, j], J_base[4, j], J_base[5, j]
        scale += x * x + y * y + z * z
        if inertial:
            x, y, z = (
                (A_g[0, 0] * x + A_g[0, 1] * y + A_g[0, 2] * z) / mass,
                (A_g[1, 0] * x + A_g[1, 1] * y + A_g[1, 2] * z) / mass,
                (A_g[2, 0] * x + A_g[2, 1] * y + A_g[2, 2] * z) / mass,
            )
        for i in range(k):
            J_sub[i, j] = U_c[0, i] * x + U_c[1, i] * y + U_c[2, i] * z
    noise = NOISE * np.sqrt(scale)

    # Factor the protected rows first, largest first, then the task rows.
    for j in range(n):
        for i in range(k):
            rows[i, j] = J_sub[i, j]
        for r in range(3):
            rows[k + r, j] = J_g[r, j]
    order = np.arange(k)
    rank = 0
    while rank < min(k, n):
        best, largest = rank, -1.0
        for i in range(rank, k):
            square = 0.0
            for j in range(rank, n):
                square += rows[i, j] * rows[i, j]
            if square > largest:
                best, largest = i, square
        if not largest > noise * noise:
            break
        if best != rank:
            order[rank], order[best] = order[best], order[rank]
            for j in range(n):
                rows[rank, j], rows[best, j] = rows[best, j], rows[rank, j]
        diagonal[rank] = reflect(rows, weights, rank, rank)
        for i in range(rank + 1, k + 3):
            apply_reflection(rows, weights, rank, rank, rows[i])
        rank += 1
    L[:, :] = 0.0
    free = min(3, n - rank)
    for t in range(free):
        for s in range(t):
            L[t, s] = rows[k + t, rank + s]
        L[t, t] = reflect(rows, weights, k + t, rank + t)
        for i in range(t + 1, 3):
            apply_reflection(rows, weights, k + t, rank + t, rows[k + i])
    for t in range(free, 3):
        for s in range(free):
            L[t, s] = rows[k + t, rank + s]

    # v_cmd, and the damped least-squares answer in the three free coordinates.
    smallest = orthogonalise_columns(L, V)
    rho = 0.0
    if smallest < parameters[THRESHOLD]:
        ratio = smallest / parameters[THRESHOLD]
        rho = parameters[DAMPING_LIMIT] * (1.0 - ratio * ratio) ** 2
    largest_square = 0.0
    for c in range(3):
        largest_square = max(largest_square, L[0, c] ** 2 + L[1, c] ** 2 + L[2, c] ** 2)
    v = base[0]
    for r in range(3):
        results[ERROR + r] = target[r] - p[r]
        v[r] = target_velocity[r] + parameters[GAIN] * results[ERROR + r]
    q_dot[:] = 0.0
    for c in range(3):
        square = L[0, c] ** 2 + L[1, c] ** 2 + L[2, c] ** 2
        if rho == 0.0 and square <= EPS * EPS * 16.0 * largest_square:
            continue  # the Moore-Penrose inverse of a singular value that is zero
        y = (L[0, c] * v[0] + L[1, c] * v[1] + L[2, c] * v[2]) / (square + rho)
        for s in range(free):
            q_dot[rank + s] += V[s, c] * y
    for t in range(free - 1, -1, -1):
        apply_reflection(rows, weights, k + t, rank + t, q_dot)
    for i in range(rank - 1, -1, -1):
        apply_reflection(rows, weights, i, i, q_dot)

    rate_scale = scale_to_limits(q_dot, columns)

    # What rounding has left in the protected rows goes, by the same reflections: q_dot -= J_sub^+ J_sub q_dot.
    if rank > 0:
        leak[:] = 0.0
        for i in range(rank):
            residual = 0.0
            for j in range(n):
                residual += J_sub[order[i], j] * q_dot[j]
            for s in range(i):
                residual -= rows[i, s] * leak[s]
            leak[i] = residual / diagonal[i]
        for i in range(rank - 1, -1, -1):
            apply_reflection(rows, weights, i, i, leak)
        for j in range(n):
            q_dot[j] -= leak[j]
        # Where J_sub is ill-conditioned the correction can lift a rate above its limit by more than rounding.
        rate_scale *= scale_to_limits(q_dot, columns)

    total = 0.0
    for j in range(n):
        out[6 + j] = q_dot[j]
        total += q_dot[j]
    for b in range(6):
        twist = 0.0
        for j in range(n):
            twist += J_base[b, j] * q_dot[j]
        out[b] = twist
    for i in range(3):
        rate = 0.0
        if i < k:
            for j in range(n):
                rate += J_sub[i, j] * q_dot[j]
        results[PROTECTED_RATE + i] = rate
    results[SMALLEST_SINGULAR_VALUE] = smallest
    results[RATE_SCALE] = rate_scale
    results[DAMPING] = rho
    results[RANK] = rank
    if not np.isfinite(total + v[0] + v[1] + v[2]):
        return NOT_FINITE
    return OK
