"""The compiled algebra of the selective law: a few arrays in, a few arrays out.

Everything that one control step does after Pinocchio has filled its matrices stands in this file. Each function is
plain Python on NumPy arrays, compiled by Numba; `selective_command.py_func` is the same function uncompiled.

Why one file: Numba keeps compiled code on disk and watches only the file that a function stands in, so a compiled
function must not call one that stands in another file.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any, TypeVar, cast

import numba
import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

F = TypeVar("F", bound=Callable[..., Any])


def compiled_for(*signature: str, inline: str = "never") -> Callable[[F], F]:
    """Compile with Numba and keep the machine code on disk.

    With a signature it is compiled for that one only: an array of another layout must not start a second compilation.
    """

    def decorate(function: F) -> F:
        njit: Any = partial(numba.njit, *signature, inline=inline, error_model="numpy")
        try:
            return cast(F, njit(cache=True)(function))
        except RuntimeError:  # no folder can be written: compile anew in each process
            return cast(F, njit()(function))

    return decorate


compiled = compiled_for()
# Compiled into the caller: for what is called in one or two places, where a call would cost as much as the work.
inlined = compiled_for(inline="always")

_MATRIX, _ROWS, _VECTOR = "float64[::1, :]", "float64[:, ::1]", "float64[::1]"
# Pinocchio's matrices are stored by columns, everything else by rows.
_FROM_PINOCCHIO = f"{_MATRIX}, {_MATRIX}, {_MATRIX}, {_VECTOR}"
_CONSTANTS = f"{_ROWS}, {_ROWS}, {_VECTOR}"
SELECTIVE_COMMAND = f"int64({_FROM_PINOCCHIO}, {_CONSTANTS}, {_VECTOR}, {_VECTOR}, {_VECTOR}, {_VECTOR})"

# What selective_command returns.
OK = 0
NOT_FINITE = 1
NO_INERTIA = 2
NOT_UNIT_QUATERNION = 3
WRONG_SIZE = 4

# Where the results stand in `out`: first Pinocchio's velocity v, base twist (6: linear, angular, base axes) and joint
# rates (n), then the following, counted from 6 + n.
PROTECTED_RATE = 0  # 6, the first k used
POSITION = 6  # 3: end-effector, inertial axes
ERROR = 9  # 3: target minus end-effector, inertial axes
SMALLEST_SINGULAR_VALUE = 12  # of J_gt N_sub
RATE_SCALE = 13
DAMPING = 14  # rho
RANK = 15  # of J_sub
RATE_BLEND = 16  # 1, or less where acceleration limits held the rates back
PLAN_CHANGE = 17  # relative change of the rates in the last pass of planning for a hold; 0 without a plan
RESULTS_SIZE = 18

# Where the scalars stand in `parameters`.
GAIN = 0
THRESHOLD = 1
DAMPING_LIMIT = 2
MASS = 3
LIMITS_STEPS = 4  # 1.0 if RATE_STEP limits anything
INERTIAL = 5  # 1.0 if U_c is fixed in inertial axes, 0.0 in base axes
TOOL = 6  # 3: the end-effector in its joint's frame
PACE = 9  # in [0, 1]
WANTED_RATE = 10  # 6, the first k used: b, what J_sub q_dot shall be
PARAMETERS_SIZE = 16

# The rows of `columns`: one entry a joint.
MOVES_TOOL = 0  # 1.0 where the joint carries the end-effector, else 0.0
RATE_LIMIT = 1
RATE_STEP = 2  # largest change of the rate from one command to the next; infinite where it is not limited

# The rows of `matrices`, one column a joint.
J_BASE = 0  # 6: base twist per joint rate, base axes
J_TASK = 6  # 3: translational generalized Jacobian, inertial axes
J_PROTECTED = 9  # 6: base twist per joint rate, inertial axes; filled only where U_c is fixed in these
MATRICES_SIZE = 15
SOLVE_ROWS = 2 * 6 + 7  # rows of scratch that `solve` needs
WORK_SIZE = MATRICES_SIZE + 9 + SOLVE_ROWS  # and that a whole command needs
SMALL = 9  # length of the rows of small scratch: k + 3

EPS = 2.220446049250313e-16
# A row of J_sub below this many rounding errors of J_rc, a metre from the inertial origin, constrains nothing: noise.
# Of J_base where U_c has linear rows: the velocity of the base origin rounds as J_rc times some metres.
NOISE = 16.0 * EPS
# Rates are scaled to just inside the limit, so that no later rounding lifts one above it.
INSIDE = 1.0 - 8.0 * EPS
# The same for the change of a rate, which is a difference and so rounds more.
STEP_INSIDE = 1.0 - 1e-12


@inlined
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


@inlined
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
def bring_within_limits(fixed: Floats, q_dot: Floats, columns: Floats, pace: float) -> float:
    """Scale what q_dot (n,) has beyond `fixed` (n,) to inside every joint's limit, in place; return the factor.

    It is scaled as a whole, 1 if it was inside: clipping joint by joint would leave null(J_sub). `fixed` must be within
    the limits itself. Their pace applies to what is left beside it.
    """
    factor = 1.0
    for j in range(q_dot.shape[0]):
        way = q_dot[j] - fixed[j]
        # Not a number for an infinite limit at pace 0: then it limits nothing, and nothing moves.
        limit = pace * columns[RATE_LIMIT, j] + (1.0 - pace) * abs(fixed[j])
        if abs(fixed[j] + factor * way) > limit:
            toward = fixed[j] if way > 0.0 else -fixed[j]
            factor = min(factor, (INSIDE * limit - toward) / abs(way))
    factor = max(factor, 0.0)
    if factor < 1.0:
        for j in range(q_dot.shape[0]):
            q_dot[j] = fixed[j] + factor * (q_dot[j] - fixed[j])
    return factor


@inlined
def add_matrices_at(
    A_g: Floats,
    J: Floats,
    joint_rotation: Floats,
    joint_translation: Floats,
    columns: Floats,
    parameters: Floats,
    weight: float,
    matrices: Floats,
    position: Floats,
    scratch: Floats,
    small: Floats,
) -> int:
    """Add one configuration's matrices and end-effector position, times a weight; return OK or what is wrong.

    `scratch` (9, n) and `small` (4, 6) are overwritten.
    """
    n = columns.shape[1]
    mass = parameters[MASS]
    m_squared = A_g[0, 0] ** 2 + A_g[1, 0] ** 2 + A_g[2, 0] ** 2
    if abs(m_squared - mass * mass) > 1e-6 * mass * mass:
        return NOT_UNIT_QUATERNION
    J_base, J_g, p = scratch[0:6], scratch[6:9], small[3]
    if base_twist_map(A_g, J_base) == 0.0:
        return NO_INERTIA
    for r in range(3):
        p[r] = joint_translation[r]
        for c in range(3):
            p[r] += joint_rotation[r, c] * parameters[TOOL + c]
        position[r] += weight * p[r]
    point_velocity_map(J, p, J_base, columns, small[0:3], J_g)
    for j in range(n):
        for b in range(6):
            matrices[J_BASE + b, j] += weight * J_base[b, j]
        for r in range(3):
            matrices[J_TASK + r, j] += weight * J_g[r, j]
    if parameters[INERTIAL] > 0.0:
        for j in range(n):
            for b in range(0, 6, 3):
                x, y, z = J_base[b, j], J_base[b + 1, j], J_base[b + 2, j]
                for r in range(3):
                    turned = (A_g[r, 0] * x + A_g[r, 1] * y + A_g[r, 2] * z) / mass
                    matrices[J_PROTECTED + b + r, j] += weight * turned
    return OK


@inlined
def factor_protected_rows(rows: Floats, weights: Floats, diagonal: Floats, order: Floats, k: int, noise: float) -> int:
    """Make the first k rows lower triangular by reflections of all rows, largest row first; return their rank.

    Rows that are below `noise` when their turn comes are left out: they constrain nothing.
    """
    n = rows.shape[1]
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
        for i in range(rank + 1, rows.shape[0]):
            apply_reflection(rows, weights, rank, rank, rows[i])
        rank += 1
    return rank


@inlined
def factor_task_rows(rows: Floats, weights: Floats, k: int, rank: int, L: Floats) -> int:
    """Make the task rows, after the first k, lower triangular L (3, 3) past `rank`; return how many columns L has."""
    free = min(3, rows.shape[1] - rank)
    L[:, :] = 0.0
    for t in range(free):
        for s in range(t):
            L[t, s] = rows[k + t, rank + s]
        L[t, t] = reflect(rows, weights, k + t, rank + t)
        for i in range(t + 1, 3):
            apply_reflection(rows, weights, k + t, rank + t, rows[k + i])
    for t in range(free, 3):
        for s in range(free):
            L[t, s] = rows[k + t, rank + s]
    return free


@inlined
def damped_solution(L: Floats, V: Floats, v: Floats, free: int, parameters: Floats, results: Floats, y: Floats) -> None:
    """Add the minimiser of |L y - v|^2 + rho |y|^2 to y; L and V are overwritten.

    rho is zero while the smallest singular value is above the threshold and rises smoothly below it.
    """
    smallest = orthogonalise_columns(L, V)
    rho = 0.0
    if smallest < parameters[THRESHOLD]:
        ratio = smallest / parameters[THRESHOLD]
        rho = parameters[DAMPING_LIMIT] * (1.0 - ratio * ratio) ** 2
    largest_square = 0.0
    for c in range(3):
        largest_square = max(largest_square, L[0, c] ** 2 + L[1, c] ** 2 + L[2, c] ** 2)
    for c in range(3):
        square = L[0, c] ** 2 + L[1, c] ** 2 + L[2, c] ** 2
        if rho == 0.0 and square <= EPS * EPS * 16.0 * largest_square:
            continue  # the Moore-Penrose inverse of a singular value that is zero
        part = (L[0, c] * v[0] + L[1, c] * v[1] + L[2, c] * v[2]) / (square + rho)
        for s in range(free):
            y[s] += V[s, c] * part
    results[SMALLEST_SINGULAR_VALUE] = smallest
    results[DAMPING] = rho


@compiled
def take_out_leak(
    J_sub: Floats,
    rows: Floats,
    weights: Floats,
    diagonal: Floats,
    order: Floats,
    rank: int,
    wanted: Floats,
    leak: Floats,
    x: Floats,
) -> None:
    """Bring x (n,) to J_sub x = wanted in place, x -= J_sub^+ (J_sub x - wanted), by what factored J_sub.

    From x = 0 this is the solution of minimum norm. Only the first `rank` rows in order are looked at.
    """
    n = x.shape[0]
    leak[:] = 0.0
    for i in range(rank):
        residual = -wanted[int(order[i])]
        for j in range(n):
            residual += J_sub[int(order[i]), j] * x[j]
        for s in range(i):
            residual -= rows[i, s] * leak[s]
        leak[i] = residual / diagonal[i]
    for i in range(rank - 1, -1, -1):
        apply_reflection(rows, weights, i, i, leak)
    for j in range(n):
        x[j] -= leak[j]


@compiled
def nearest_attainable(rows: Floats, diagonal: Floats, order: Floats, k: int, rank: int, wanted: Floats) -> None:
    """Replace `wanted` (6,) by the nearest vector in the range of J_sub, of k rows and a smaller rank, in place.

    In their order the factored rows are [L1; L2], L1 lower triangular. Plane rotations from the left, from the last
    column to the first, put L2 to zero and leave a triangular system for the coordinates of the nearest vector.
    """
    work, y = np.empty((k, rank + 1)), np.empty(rank)  # b and, behind it, [L1; L2]
    for i in range(k):
        work[i, 0] = wanted[int(order[i])]
        for s in range(rank):
            work[i, 1 + s] = rows[i, s] if s < i else (diagonal[i] if s == i else 0.0)
    for c in range(rank - 1, -1, -1):
        for i in range(rank, k):
            length = np.sqrt(work[c, 1 + c] ** 2 + work[i, 1 + c] ** 2)
            cosine, sine = work[c, 1 + c] / length, work[i, 1 + c] / length
            for s in range(c + 2):
                upper, lower = work[c, s], work[i, s]
                work[c, s], work[i, s] = cosine * upper + sine * lower, cosine * lower - sine * upper
    for i in range(rank):
        y[i] = work[i, 0]
        for s in range(i):
            y[i] -= work[i, 1 + s] * y[s]
        y[i] /= work[i, 1 + i]
    for i in range(k):
        value = 0.0
        for s in range(min(i + 1, rank)):
            value += (rows[i, s] if s < i else diagonal[i]) * y[s]
        wanted[int(order[i])] = value


@compiled
def fixed_part(
    J_sub: Floats,
    rows: Floats,
    weights: Floats,
    diagonal: Floats,
    order: Floats,
    rank: int,
    columns: Floats,
    wanted: Floats,
    leak: Floats,
    q_dot: Floats,
) -> None:
    """Make q_dot (n,), zero on entry, the J_sub^+ b of minimum norm, and `wanted` (6,), b on entry, what it reaches.

    b gives way where J_sub has not the rank for it, to the nearest that there is, and where the rates would exceed
    their limits, as a whole.
    """
    k = J_sub.shape[0]
    if rank < k:
        nearest_attainable(rows, diagonal, order, k, rank, wanted)
    for _ in range(2):  # the second time takes out the rounding of the first
        take_out_leak(J_sub, rows, weights, diagonal, order, rank, wanted, leak, q_dot)
    leak[:] = 0.0
    factor = bring_within_limits(leak, q_dot, columns, 1.0)
    for i in range(k):
        wanted[i] *= factor


@compiled
def largest_blend(start: Floats, end: Floats, previous: Floats, columns: Floats) -> float:
    """Return the largest share in [0, 1] of the way from start to end that stays within RATE_STEP of previous.

    Zero where `start` itself is further away than that.
    """
    share = 1.0
    for j in range(start.shape[0]):
        step, way = STEP_INSIDE * columns[RATE_STEP, j], end[j] - start[j]
        if way > 0.0:
            share = min(share, (previous[j] + step - start[j]) / way)
        elif way < 0.0:
            share = min(share, (previous[j] - step - start[j]) / way)
    return max(share, 0.0)


@inlined
def solve(
    matrices: Floats,
    U_c: Floats,
    columns: Floats,
    parameters: Floats,
    target: Floats,
    target_velocity: Floats,
    previous: Floats,
    out: Floats,
    scratch: Floats,
    small: Floats,
) -> int:
    """Write the command that the matrices give into `out`; return OK or NOT_FINITE.

    The end-effector's position stands in `out` already. `scratch` (SOLVE_ROWS, n) and `small` (11, SMALL) are
    overwritten.

    One Householder factorisation of [J_sub; J_g]^T carries the whole law. With Q its reflections in order, J_sub is
    lower triangular in the first r = rank(J_sub) coordinates of Q^T q_dot, so a rate that is zero in those lies in
    null(J_sub) whatever the others are. In the next three coordinates J_g is the lower triangular L (3, 3), whose
    singular values are those of J_gt N_sub, and min |L y - v_cmd|^2 + rho |y|^2 is the paper's objective.

    Where J_sub q_dot = b is asked for, all that stands beside a fixed part J_sub^+ b, which the task takes as given.
    """
    n, k, pace = columns.shape[1], U_c.shape[1], parameters[PACE]
    results = out[6 + n :]
    J_sub, rows, q_dot = scratch[0:k], scratch[k : 2 * k + 3], scratch[2 * k + 3]
    leak, slow, fixed = scratch[2 * k + 4], scratch[2 * k + 5], scratch[2 * k + 6]
    L, V, weights = small[0:3], small[3:6], small[6]
    diagonal, v, order, wanted = small[7], small[8], small[9], small[10]
    first, asked = 3, False
    for i in range(k):
        order[i] = i
        wanted[i] = parameters[WANTED_RATE + i]
        asked = asked or wanted[i] != 0.0
        if U_c[0, i] != 0.0 or U_c[1, i] != 0.0 or U_c[2, i] != 0.0:
            first = 0

    source = J_PROTECTED if parameters[INERTIAL] > 0.0 else J_BASE
    scale = 0.0
    for j in range(n):
        fixed[j], q_dot[j] = 0.0, 0.0
        for b in range(first, 6):
            scale += matrices[source + b, j] ** 2
        for i in range(k):
            J_sub[i, j] = 0.0
            for b in range(first, 6):
                J_sub[i, j] += U_c[b, i] * matrices[source + b, j]
            rows[i, j] = J_sub[i, j]
        for r in range(3):
            rows[k + r, j] = matrices[J_TASK + r, j]
    # The matrices are sums about the inertial origin, so that their rounding grows with the distance from it.
    far = 1.0 + abs(results[POSITION]) + abs(results[POSITION + 1]) + abs(results[POSITION + 2])
    rank = factor_protected_rows(rows, weights, diagonal, order, k, NOISE * far * np.sqrt(scale))
    free = factor_task_rows(rows, weights, k, rank, L)

    for r in range(3):
        results[ERROR + r] = target[r] - results[POSITION + r]
        v[r] = pace * (target_velocity[r] + parameters[GAIN] * results[ERROR + r])
    if asked:
        fixed_part(J_sub, rows, weights, diagonal, order, rank, columns, wanted, leak, fixed)
        for r in range(3):
            for j in range(n):
                v[r] -= matrices[J_TASK + r, j] * fixed[j]
    damped_solution(L, V, v, free, parameters, results, q_dot[rank:])
    for t in range(free - 1, -1, -1):
        apply_reflection(rows, weights, k + t, rank + t, q_dot)
    for i in range(rank - 1, -1, -1):
        apply_reflection(rows, weights, i, i, q_dot)
    if asked:
        for j in range(n):
            q_dot[j] += fixed[j]

    rate_scale = bring_within_limits(fixed, q_dot, columns, pace)
    blend = 1.0
    if parameters[LIMITS_STEPS] > 0.0:
        # Blend from the previous rates, brought to today's J_sub q_dot = b, to the wanted ones: so is all the line
        # between the two. From rest, with b = 0, this is time scaling.
        for j in range(n):
            slow[j] = previous[j]
        take_out_leak(J_sub, rows, weights, diagonal, order, rank, wanted, leak, slow)
        bring_within_limits(fixed, slow, columns, pace)
        blend = largest_blend(slow, q_dot, previous, columns)
        for j in range(n):
            q_dot[j] = slow[j] + blend * (q_dot[j] - slow[j])
    if rank > 0:  # what rounding has left in the protected rows
        take_out_leak(J_sub, rows, weights, diagonal, order, rank, wanted, leak, q_dot)
        # Where J_sub is ill-conditioned the correction can lift a rate above its limit by more than rounding.
        rate_scale *= bring_within_limits(fixed, q_dot, columns, pace)

    total = v[0] + v[1] + v[2]
    for j in range(n):
        out[6 + j] = q_dot[j]
        total += q_dot[j]
    for b in range(6):
        out[b] = 0.0
        for j in range(n):
            out[b] += matrices[J_BASE + b, j] * q_dot[j]
    for i in range(6):
        results[PROTECTED_RATE + i] = 0.0
        if i < k:
            for j in range(n):
                results[PROTECTED_RATE + i] += J_sub[i, j] * q_dot[j]
    results[RATE_SCALE] = rate_scale
    results[RATE_BLEND] = blend
    results[RANK] = rank
    results[PLAN_CHANGE] = 0.0
    return OK if np.isfinite(total) else NOT_FINITE


@inlined
def wrong_size(n: int, target: Floats, target_velocity: Floats, previous: Floats, out: Floats) -> bool:
    """Say whether an array has the wrong length: compiled code would read past its end."""
    vectors = target.shape[0] != 3 or target_velocity.shape[0] != 3
    return vectors or previous.shape[0] != n or out.shape[0] != 6 + n + RESULTS_SIZE


@compiled_for(SELECTIVE_COMMAND)
def selective_command(
    A_g: Floats,
    J: Floats,
    joint_rotation: Floats,
    joint_translation: Floats,
    U_c: Floats,
    columns: Floats,
    parameters: Floats,
    target: Floats,
    target_velocity: Floats,
    previous: Floats,
    out: Floats,
) -> int:
    """Write q_dot = (J_gt N_sub)^+ v_cmd and what follows from it into `out`; return OK or what is wrong.

    Args:
        A_g: Centroidal map (6, 6 + n), `pin.Data.Ag` after `pin.computeCentroidalMap`.
        J: Joint Jacobians at the world origin (6, 6 + n), `pin.Data.J` after the same call.
        joint_rotation: Rotation (3, 3) of the joint that holds the end-effector, joint to inertial.
        joint_translation: Its position (3,), m, inertial axes.
        U_c: Protected directions of the base twist (6, k), orthonormal columns, base or inertial axes as `parameters`
            says.
        columns: (3, n), MOVES_TOOL, RATE_LIMIT and RATE_STEP for each joint.
        parameters: (PARAMETERS_SIZE,), by the indices above.
        target: Desired end-effector position (3,), m, inertial axes.
        target_velocity: Its velocity (3,), m/s.
        previous: The rates commanded before (n,); read only where RATE_STEP limits something.
        out: (6 + n + RESULTS_SIZE,), overwritten.

    Returns:
        OK, NOT_FINITE (in the configuration or the target), NO_INERTIA (H_ww is singular), NOT_UNIT_QUATERNION or
        WRONG_SIZE (of a target, of `previous` or of `out`).
    """
    n = columns.shape[1]
    if wrong_size(n, target, target_velocity, previous, out):
        return WRONG_SIZE
    # Two allocations for all scratch: each costs as much as a reflection.
    work, small = np.empty((WORK_SIZE, n)), np.empty((11, SMALL))
    matrices, scratch = work[:MATRICES_SIZE], work[MATRICES_SIZE:]
    position = out[6 + n + POSITION : 9 + n + POSITION]
    matrices[:] = 0.0
    position[:] = 0.0
    status = add_matrices_at(
        A_g,
        J,
        joint_rotation,
        joint_translation,
        columns,
        parameters,
        1.0,
        matrices,
        position,
        scratch,
        small,
    )
    if status != OK:
        return status
    return solve(matrices, U_c, columns, parameters, target, target_velocity, previous, out, scratch[9:], small)


@compiled
def add_matrices(
    A_g: Floats,
    J: Floats,
    joint_rotation: Floats,
    joint_translation: Floats,
    U_c: Floats,
    columns: Floats,
    parameters: Floats,
    weight: float,
    matrices: Floats,
    position: Floats,
) -> int:
    """Add one configuration's matrices (MATRICES_SIZE, n) and end-effector position (3,), times a weight.

    The other arguments and the value returned are those of `selective_command`.
    """
    scratch, small = np.empty((9, columns.shape[1])), np.empty((4, 6))
    return add_matrices_at(
        A_g,
        J,
        joint_rotation,
        joint_translation,
        columns,
        parameters,
        weight,
        matrices,
        position,
        scratch,
        small,
    )


@compiled_for("boolean(float64[::1], int64[::1])")
def off_circle(q: Floats, starts: Floats) -> bool:
    """Say whether a cosine and sine in q, at one of the given places, are not of unit length."""
    for i in range(starts.shape[0]):
        start = starts[i]
        square = q[start] ** 2 + q[start + 1] ** 2
        if not abs(square - 1.0) < 1e-6:
            return True
    return False


@compiled
def change_of(rates: Floats, before: Floats) -> float:
    """Return how far rates (n,) differ from those before, relative to the largest, and remember them there."""
    change, largest = 0.0, 0.0
    for j in range(rates.shape[0]):
        change = max(change, abs(rates[j] - before[j]))
        largest = max(largest, abs(rates[j]))
        before[j] = rates[j]
    return change / largest if largest > 0.0 else change


@compiled
def held_command(
    matrices: Floats,
    U_c: Floats,
    columns: Floats,
    parameters: Floats,
    target: Floats,
    target_velocity: Floats,
    previous: Floats,
    out: Floats,
) -> int:
    """Write the command of averaged matrices into `out`, the arguments being those of `selective_command`.

    The averaged end-effector position stands in `out` already.
    """
    n = columns.shape[1]
    if wrong_size(n, target, target_velocity, previous, out):
        return WRONG_SIZE
    scratch, small = np.empty((SOLVE_ROWS, n)), np.empty((11, SMALL))
    return solve(matrices, U_c, columns, parameters, target, target_velocity, previous, out, scratch, small)
