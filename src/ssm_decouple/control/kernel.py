"""The compiled algebra of the selective law: a few arrays in, a few arrays out.

Everything that one control step does after Pinocchio has filled its matrices stands in this file. Each function is
plain Python on NumPy arrays, compiled by Numba; `selective_command.py_func` is the same function uncompiled.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ssm_decouple.compiled import compiled, compiled_for, inlined, unlocked

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]


_MATRIX, _ROWS, _VECTOR = "float64[::1, :]", "float64[:, ::1]", "float64[::1]"
# Pinocchio's matrices are stored by columns, everything else by rows.
_FROM_PINOCCHIO = f"{_MATRIX}, {_MATRIX}, {_ROWS}"
_CONSTANTS = f"{_ROWS}, {_ROWS}, {_ROWS}, {_VECTOR}"
SELECTIVE_COMMAND = f"int64({_FROM_PINOCCHIO}, {_CONSTANTS}, {_VECTOR}, {_VECTOR}, {_VECTOR}, {_VECTOR}, {_VECTOR})"

# What selective_command returns.
OK = 0
NOT_FINITE = 1
NO_INERTIA = 2
NOT_UNIT = 3
WRONG_SIZE = 4
NOT_A_TARGET = 5
OTHER_MASS = 6
FAR_AWAY = 7  # the base stands farther than FAR from the inertial origin: nothing is computed

UNIT = 1e-6  # how far a length of 1 may be off

# Where the results stand in `out`: first Pinocchio's velocity v, base twist (6: linear, angular, base axes) and joint
# rates (n), then the following, counted from 6 + n.
PROTECTED_RATE = 0  # 6, the first k used
POSITION = 6  # 3: end-effector, inertial axes
RATE_SCALE = 9
RANK = 10  # of J_sub
RATE_BLEND = 11  # 1, or less where acceleration limits held the rates back
PLAN_CHANGE = 12  # relative change of the rates in the last pass of planning for a hold; 0 without a plan
EXCESS = 13  # how far acceleration limits were exceeded, relative to them
LIMITED = 14  # how many bounds the rates stand at, where each limit is kept by itself
LOST = 15  # largest difference between PROTECTED_RATE and what was asked for; 0 where it is rounding
LOST_TO = 16  # what it was lost to: a sum of the following
ERRORS = 17  # one a task row, then the smallest singular value of each level, then rho of each level

# What a protected rate is lost to.
TO_RANK = 1  # J_sub has not the rank for it
TO_RATES = 2  # the joint rates that it takes exceed their limits
TO_LIMITS = 4  # so it is where each limit is kept by itself: of position, rate or acceleration

# Where the scalars stand in `parameters`.
THRESHOLD = 0
DAMPING_LIMIT = 1
MASS = 2
LIMITS_STEPS = 3  # 1.0 if RATE_STEP limits anything
AXES_JOINT = 4  # the joint in whose axes U_c is fixed: 0 for inertial axes, -1 for base axes
TOOL_JOINT = 5  # the joint that holds the end-effector
TOOL = 6  # 3: the end-effector in its joint's frame
TASK_ROWS = 9  # of all tasks together
LEVELS = 10
TARGET_SIZE = 11  # length of the targets of all tasks
VELOCITY_SIZE = 12  # and of their velocities
PACE = 13  # in [0, 1]
WANTED_RATE = 14  # 6, the first k used: b, what the protected rate shall be
MOMENTUM = 20  # 6: linear, and angular about the centre of mass, inertial axes
PARAMETERS_SIZE = 26

# Where a task's numbers stand in its row of `tasks`; the tasks stand in the order of their levels.
KIND = 0
LEVEL = 1  # counted from 0
ROWS = 2
JOINT = 3  # the joint that holds the frame
GAIN = 4
ROOT_WEIGHT = 5  # square root of the weight
TARGET = 6  # where its target begins among the targets
STRIDE = 7  # from row to row of a target that is a matrix
VELOCITY = 8  # where its velocity begins
POINT = 9  # 3: the frame's origin in its joint's frame
AXES = 12  # 9: the frame's axes there, by rows; a boresight's third is the direction
REFERENCE = 21  # the joint that holds the frame in which the target stands; -1 for inertial axes
REFERENCE_POINT = 22  # 3: that frame's origin in its joint's frame
REFERENCE_AXES = 25  # 9: its axes there, by rows
TASK_SIZE = 34

# Kinds of tasks.
POINTS = 0  # position of the frame's origin
TURNS = 1  # rotation of the frame
LOOKS = 2  # direction of the frame's third axis
JOINTS = 3  # joint positions
CLIMBS = 4  # joint rates, given as velocities

# The rows of `columns`: one entry a joint.
RATE_LIMIT = 0
RATE_STEP = 1  # largest change of the rate from one command to the next; infinite where it is not limited
PLACE = 2  # where the joint stands in q
CONTINUOUS = 3  # 1.0 if it stands there as cosine and sine
JOINT_POSITION = 4  # filled only where a task needs it
SCALE = 5  # 1 / sqrt(w) of the joint's weight w in the norm of the rates
# A row a task: 1.0 where the joint carries its frame, -1.0 where its reference, 0.0 where neither or both; or which of
# its rows, from 1, the joint is.
MOVES = 6

# The rows of `matrices`, one column a joint.
J_BASE = 0  # 6: base twist per joint rate, base axes
J_PROTECTED = 6  # 6: base twist per joint rate, axes in which U_c is fixed; filled only where these are not base axes
J_TASK = 12  # a row a task row: its generalized Jacobian, inertial axes, times the root of its weight

EPS = 2.220446049250313e-16
# A row of J_sub below this many rounding errors of J_rc, a metre from the inertial origin, constrains nothing: noise.
# Of J_base where U_c has linear rows: the velocity of the base origin rounds as J_rc times some metres.
NOISE = 16.0 * EPS
# Task rows whose rest is below this share of all are left out of their manipulability: its slope would be rounding.
DEPENDENT = 1e-9
# m, along any inertial axis, as in model/origin.py: sums about an origin that far away have lost a digit.
FAR = 10.0
# A protected rate is lost where more than this share of what joints and momentum do along it is missing: far above
# rounding, far below what anyone would notice.
LOST_SHARE = 1e-9
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
def add_point(J: Floats, p: Floats, J_base: Floats, moves: Floats, weight: float, base: Floats, J_task: Floats) -> None:
    """Add to J_task (3, n) a weight times the velocity of the point p per joint rate, momentum conserved.

    J (6, 6 + n) is Pinocchio's Jacobian at the world origin: a joint that carries the point moves it by
    J_linear + J_angular x p, and every joint moves it through the base. `base` (3, 6) is scratch.
    """
    for c in range(6):
        base[0, c] = J[0, c] + J[4, c] * p[2] - J[5, c] * p[1]
        base[1, c] = J[1, c] + J[5, c] * p[0] - J[3, c] * p[2]
        base[2, c] = J[2, c] + J[3, c] * p[1] - J[4, c] * p[0]
    for j in range(J_task.shape[1]):
        c, m = 6 + j, moves[j]
        x = m * (J[0, c] + J[4, c] * p[2] - J[5, c] * p[1])
        y = m * (J[1, c] + J[5, c] * p[0] - J[3, c] * p[2])
        z = m * (J[2, c] + J[3, c] * p[1] - J[4, c] * p[0])
        for b in range(6):
            x += base[0, b] * J_base[b, j]
            y += base[1, b] * J_base[b, j]
            z += base[2, b] * J_base[b, j]
        J_task[0, j] += weight * x
        J_task[1, j] += weight * y
        J_task[2, j] += weight * z


@inlined
def add_turning(J: Floats, J_base: Floats, moves: Floats, weight: float, B: Floats, rows: int, J_task: Floats) -> None:
    """Add to J_task (rows, n) a weight times the angular velocity per joint rate, along the first columns of B (3, 3).

    A joint that carries the frame turns it, and every joint turns it through the base.
    """
    for j in range(J_task.shape[1]):
        x, y, z = moves[j] * J[3, 6 + j], moves[j] * J[4, 6 + j], moves[j] * J[5, 6 + j]
        for b in range(3, 6):
            x += J[3, b] * J_base[b, j]
            y += J[4, b] * J_base[b, j]
            z += J[5, b] * J_base[b, j]
        for r in range(rows):
            J_task[r, j] += weight * (B[0, r] * x + B[1, r] * y + B[2, r] * z)


@inlined
def add_relative(J: Floats, p: Floats, moves: Floats, weight: float, R: Floats, turning: bool, J_task: Floats) -> None:
    """Add to J_task (3, n) a weight times the relative motion per joint rate, in the axes R (3, 3) of the reference.

    That of the point p of a frame as seen from another frame, or of the frame's rotation. The base has no part in it.
    """
    for j in range(J_task.shape[1]):
        c, m = 6 + j, weight * moves[j]
        if turning:
            x, y, z = m * J[3, c], m * J[4, c], m * J[5, c]
        else:
            x = m * (J[0, c] + J[4, c] * p[2] - J[5, c] * p[1])
            y = m * (J[1, c] + J[5, c] * p[0] - J[3, c] * p[2])
            z = m * (J[2, c] + J[3, c] * p[1] - J[4, c] * p[0])
        for r in range(3):
            J_task[r, j] += R[0, r] * x + R[1, r] * y + R[2, r] * z


@inlined
def place_frame(held: Floats, task: Floats, first: int, p: Floats, B: Floats) -> None:
    """Fill origin p (3,) and axes B (3, 3), inertial, of the frame that stands in the task's row from `first` on."""
    for r in range(3):
        p[r] = held[9 + r]
        for c in range(3):
            p[r] += held[3 * c + r] * task[first + c]
            B[r, c] = 0.0
            for b in range(3):
                B[r, c] += held[3 * b + r] * task[first + 3 + 3 * b + c]


@compiled
def rotation_vector(R: Floats, vector: Floats) -> None:
    """Fill the rotation vector (3,), rad, of a rotation matrix R (3, 3), at angles from 0 to pi.

    By way of a unit quaternion, whose largest part comes first: no digit is lost near 0 or near pi.
    """
    trace = R[0, 0] + R[1, 1] + R[2, 2]
    largest, best = trace, 3
    for i in range(3):
        if R[i, i] > largest:
            largest, best = R[i, i], i
    if best == 3:
        w = 1.0 + trace
        vector[0], vector[1], vector[2] = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    else:
        i, j, k = best, (best + 1) % 3, (best + 2) % 3
        w = R[k, j] - R[j, k]
        vector[i] = 1.0 + R[i, i] - R[j, j] - R[k, k]
        vector[j] = R[j, i] + R[i, j]
        vector[k] = R[k, i] + R[i, k]
    sine = np.sqrt(vector[0] ** 2 + vector[1] ** 2 + vector[2] ** 2)
    scale = 0.0
    if sine > 0.0:
        scale = 2.0 * np.arctan2(sine, abs(w)) / (sine if w >= 0.0 else -sine)
    for r in range(3):
        vector[r] *= scale


@compiled
def turn_towards(target: Floats, B: Floats, error: Floats) -> bool:
    """Fill the rotation (2,), rad, about the first columns of B (3, 3) that takes the third one to target (3,).

    It is the shortest such rotation; opposite the target, where there are many, one about the first column. Return
    False if the target has no direction.
    """
    along, first, second = 0.0, 0.0, 0.0
    for r in range(3):
        along += B[r, 2] * target[r]
        first -= B[r, 1] * target[r]
        second += B[r, 0] * target[r]
    across = np.sqrt(first * first + second * second)
    if across > 0.0:
        scale = np.arctan2(across, along) / across
        error[0], error[1] = scale * first, scale * second
    else:
        error[0], error[1] = (np.pi if along < 0.0 else 0.0), 0.0
    return across * across + along * along > 0.0


@inlined
def turn_from(target: Floats, start: int, stride: int, B: Floats, E: Floats, error: Floats) -> bool:
    """Fill the rotation vector (3,) that takes axes B (3, 3) to the target's; return False if it is no rotation."""
    for r in range(3):
        for c in range(3):
            i = start + r * stride
            E[r, c] = target[i] * B[c, 0] + target[i + 1] * B[c, 1] + target[i + 2] * B[c, 2]
    rotation_vector(E, error)
    right = True
    for r in range(3):
        a, b = (r + 1) % 3, (r + 2) % 3
        for c in range(3):  # a rotation's third row is the cross product of the two before
            d, e = (c + 1) % 3, (c + 2) % 3
            right = right and abs(E[a, d] * E[b, e] - E[a, e] * E[b, d] - E[r, c]) < 1e-6
    square = E[0, 0] ** 2 + E[0, 1] ** 2 + E[0, 2] ** 2
    return right and abs(square - 1.0) < 1e-6


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


@inlined
def length_squared(B: Floats, row: int, size: int) -> float:
    """Return the square of the length of a row's first entries."""
    square = 0.0
    for r in range(size):
        square += B[row, r] ** 2
    return square


@inlined
def turn_columns(B: Floats, V: Floats, size: int, count: int) -> float:
    """Turn `count` columns of length `size` until they are orthogonal, V with them; return the shortest length.

    A column stands in a row of B and of V. One-sided Jacobi: B V0 = U S, so the column lengths are the singular values,
    small ones to full accuracy. What B and V hold on return solves any damped least-squares problem in B by a scalar
    division for each column.
    """
    for a in range(count):
        for b in range(count):
            V[a, b] = 1.0 if a == b else 0.0
    for _ in range(30):
        turned = False
        for a in range(count - 1):
            for b in range(a + 1, count):
                aa, bb, ab = 0.0, 0.0, 0.0
                for r in range(size):
                    aa += B[a, r] * B[a, r]
                    bb += B[b, r] * B[b, r]
                    ab += B[a, r] * B[b, r]
                if ab * ab <= EPS * EPS * aa * bb:
                    continue
                turned = True
                zeta = (bb - aa) / (2.0 * ab)
                t = 1.0 / (abs(zeta) + np.sqrt(1.0 + zeta * zeta))
                if zeta < 0.0:
                    t = -t
                cosine = 1.0 / np.sqrt(1.0 + t * t)
                sine = cosine * t
                for r in range(size):
                    B[a, r], B[b, r] = cosine * B[a, r] - sine * B[b, r], sine * B[a, r] + cosine * B[b, r]
                for r in range(count):
                    V[a, r], V[b, r] = cosine * V[a, r] - sine * V[b, r], sine * V[a, r] + cosine * V[b, r]
        if not turned:
            break
    shortest = np.inf if count > 0 else 0.0
    for a in range(count):
        shortest = min(shortest, length_squared(B, a, size))
    return np.sqrt(shortest)


@compiled
def orthogonalise_columns(B: Floats, V: Floats, size: int, count: int) -> float:
    """Call `turn_columns`, by loops of a length known to the compiler where that is the usual one."""
    if size == 3 and count == 3:
        return turn_columns(B, V, 3, 3)
    return turn_columns(B, V, size, count)


@compiled
def bring_within_limits(fixed: Floats, q_dot: Floats, columns: Floats, pace: float) -> float:
    """Scale what q_dot (n,) has beyond `fixed` (n,) to inside every joint's limit, in place; return the factor.

    It is scaled as a whole, 1 if it was inside: clipping joint by joint would leave null(J_sub). `fixed` must be within
    the limits itself. Their pace applies to what is left beside it.
    """
    factor = 1.0
    for j in range(q_dot.shape[0]):
        way = q_dot[j] - fixed[j]
        # Not a number for an infinite limit at pace 0: then it limits nothing.
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
def add_joints(
    target: Floats, start: int, columns: Floats, moves: Floats, weight: float, root: float, J: Floats, error: Floats
) -> None:
    """Add the rows of joints to J (rows, n) and to their error; a continuous joint takes the shorter way."""
    for j in range(moves.shape[0]):
        row = int(moves[j]) - 1
        if row >= 0:
            left = target[start + row] - columns[JOINT_POSITION, j]
            if columns[CONTINUOUS, j] > 0.0:
                left -= 2.0 * np.pi * np.rint(left / (2.0 * np.pi))
            J[row, j] += weight * root
            error[row] += weight * left


@inlined
def add_tasks(
    J: Floats,
    placements: Floats,
    J_base: Floats,
    tasks: Floats,
    columns: Floats,
    targets: Floats,
    velocities: Floats,
    weight: float,
    J_task: Floats,
    errors: Floats,
    rates: Floats,
    small: Floats,
) -> int:
    """Add the tasks' Jacobian (m, n) and errors (m,), times a weight; return OK or NOT_A_TARGET.

    Of a position only what is to be taken from the target is added: minus where the frame is. To `rates` (m,) the
    target's velocity is added where it has to be seen from the frame. `small` (11, 6) is overwritten.
    """
    base, p, B, E, e = small[0:3], small[3], small[4:7], small[7:10], small[10]
    row, status = 0, OK
    for i in range(tasks.shape[0]):
        task, moves = tasks[i], columns[MOVES + i]
        kind, rows, start = int(task[KIND]), int(task[ROWS]), int(task[TARGET])
        root, reference = weight * task[ROOT_WEIGHT], int(task[REFERENCE])
        J_rows, error = J_task[row : row + rows], errors[row : row + rows]
        row += rows
        if kind == CLIMBS:
            for j in range(moves.shape[0]):
                if moves[j] > 0.0:
                    J_rows[int(moves[j]) - 1, j] += root
            continue
        if kind == JOINTS:
            add_joints(targets, start, columns, moves, weight, task[ROOT_WEIGHT], J_rows, error)
            continue
        place_frame(placements[int(task[JOINT])], task, POINT, p, B)
        if reference >= 0:
            place_frame(placements[reference], task, REFERENCE_POINT, e, E)
            add_relative(J, p, moves, root, E, kind == TURNS, J_rows)
            if kind == POINTS:
                for r in range(3):
                    for c in range(3):
                        error[r] -= weight * E[c, r] * (p[c] - e[c])
                continue
            for c in range(3):
                for r in range(3):
                    e[r] = E[0, r] * B[0, c] + E[1, r] * B[1, c] + E[2, r] * B[2, c]
                for r in range(3):
                    B[r, c] = e[r]
        elif kind == POINTS:
            for r in range(3):
                error[r] -= weight * p[r]
            add_point(J, p, J_base, moves, root, base, J_rows)
            continue
        if kind == LOOKS:
            right, velocity = turn_towards(targets[start : start + 3], B, e), int(task[VELOCITY])
            for r in range(rows):
                for c in range(3):
                    rates[row - rows + r] += weight * B[c, r] * velocities[velocity + c]
        else:
            right = turn_from(targets, start, int(task[STRIDE]), B, E, e)
            for r in range(3):
                for c in range(3):
                    B[r, c] = 1.0 if r == c else 0.0
        if not right:
            status = NOT_A_TARGET
        for r in range(rows):
            error[r] += weight * e[r]
        if reference < 0:
            add_turning(J, J_base, moves, root, B, rows, J_rows)
    return status


@compiled
def add_matrices_at(
    A_g: Floats,
    J: Floats,
    placements: Floats,
    tasks: Floats,
    columns: Floats,
    parameters: Floats,
    targets: Floats,
    velocities: Floats,
    weight: float,
    matrices: Floats,
    position: Floats,
    errors: Floats,
    rates: Floats,
    J_base: Floats,
    small: Floats,
) -> int:
    """Add one configuration's matrices, end-effector position and errors, times a weight; return OK or what is wrong.

    `J_base` (6, n) and `small` (11, 6) are overwritten; the others are those of `add_tasks` and `selective_command`.
    """
    n = columns.shape[1]
    mass = parameters[MASS]
    m_squared = A_g[0, 0] ** 2 + A_g[1, 0] ** 2 + A_g[2, 0] ** 2
    if abs(m_squared - mass * mass) > 1e-5 * mass * mass:
        return OTHER_MASS
    if base_twist_map(A_g, J_base) == 0.0:
        return NO_INERTIA
    held = placements[int(parameters[TOOL_JOINT])]
    for r in range(3):
        at = held[9 + r]
        for c in range(3):
            at += held[3 * c + r] * parameters[TOOL + c]
        position[r] += weight * at
    for j in range(n):
        for b in range(6):
            matrices[J_BASE + b, j] += weight * J_base[b, j]
    if parameters[AXES_JOINT] >= 0.0:
        axes, C = placements[int(parameters[AXES_JOINT])], small[0:3]
        for r in range(3):
            for c in range(3):  # m R is the upper left block of A_g
                C[r, c] = (axes[3 * r] * A_g[0, c] + axes[3 * r + 1] * A_g[1, c] + axes[3 * r + 2] * A_g[2, c]) / mass
        for j in range(n):
            for b in range(0, 6, 3):
                for r in range(3):
                    turned = C[r, 0] * J_base[b, j] + C[r, 1] * J_base[b + 1, j] + C[r, 2] * J_base[b + 2, j]
                    matrices[J_PROTECTED + b + r, j] += weight * turned
    J_task = matrices[J_TASK:]
    return add_tasks(J, placements, J_base, tasks, columns, targets, velocities, weight, J_task, errors, rates, small)


@compiled
def add_drift(
    A_g: Floats,
    J: Floats,
    placements: Floats,
    tasks: Floats,
    columns: Floats,
    parameters: Floats,
    targets: Floats,
    velocities: Floats,
    weight: float,
    drift: Floats,
) -> None:
    """Add to drift (J_TASK + m, 1), a weight times, what the momentum moves while the joints stand still.

    The rows are those of `matrices`. It is the column of a joint that carries nothing and turns at unit rate, whose
    momentum is that on board with the other sign.
    """
    moving = False
    for i in range(6):
        moving = moving or parameters[MOMENTUM + i] != 0.0
    if not moving:
        return
    m = int(parameters[TASK_ROWS])
    A, J_one = np.zeros((7, 6)).T, np.zeros((7, 6)).T
    for r in range(6):
        A[r, 6] = -parameters[MOMENTUM + r]
        for c in range(6):
            A[r, c], J_one[r, c] = A_g[r, c], J[r, c]
    place, errors, rates = np.zeros(3), np.zeros(m), np.zeros(m)
    add_matrices_at(
        A,
        J_one,
        placements,
        tasks,
        np.zeros((MOVES + tasks.shape[0], 1)),
        parameters,
        targets,
        velocities,
        weight,
        drift,
        place,
        errors,
        rates,
        np.empty((6, 1)),
        np.empty((11, 6)),
    )


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
def factor_level(
    rows: Floats, weights: Floats, starts: Floats, first: int, size: int, at: int, noise: float, L: Floats
) -> int:
    """Make a level's rows lower triangular past the coordinate `at`, L; return how many columns L has.

    L is stored by columns. A row whose rest is not above `noise` depends on those before and takes no coordinate.
    """
    n, count = rows.shape[1], 0
    for t in range(size):
        for s in range(count):
            L[s, t] = rows[first + t, at + s]
        starts[first + t] = -1.0
        if at + count == n:
            continue
        for s in range(t):
            L[count, s] = 0.0
        L[count, t] = reflect(rows, weights, first + t, at + count)
        if abs(L[count, t]) <= noise:
            continue
        starts[first + t] = at + count
        for i in range(first + t + 1, rows.shape[0]):
            apply_reflection(rows, weights, first + t, at + count, rows[i])
        count += 1
    return count


@inlined
def damped_solution(
    L: Floats, V: Floats, v: Floats, count: int, full: bool, parameters: Floats, told: Floats, y: Floats
) -> None:
    """Add the minimiser of |L y - v|^2 + rho |y|^2 to y; L and V are overwritten.

    rho is zero while the smallest singular value is above the threshold and rises smoothly below it. `full` says that
    L needs a column for each row to have a smallest singular value above zero. `told` (2, ) takes this and rho.
    """
    size = v.shape[0]
    smallest = orthogonalise_columns(L, V, size, count)
    if full and count < size:
        smallest = 0.0
    rho = 0.0
    if smallest < parameters[THRESHOLD]:
        ratio = smallest / parameters[THRESHOLD]
        rho = parameters[DAMPING_LIMIT] * (1.0 - ratio * ratio) ** 2
    largest_square = 0.0
    for c in range(count):
        largest_square = max(largest_square, length_squared(L, c, size))
    for c in range(count):
        square = length_squared(L, c, size)
        if rho == 0.0 and square <= EPS * EPS * 16.0 * largest_square:
            continue  # the Moore-Penrose inverse of a singular value that is zero
        part = 0.0
        for r in range(size):
            part += L[c, r] * v[r]
        part /= square + rho
        for s in range(count):
            y[s] += V[c, s] * part
    told[0] = smallest
    told[1] = rho


@compiled
def take_out_leak(
    J_sub: Floats,
    rows: Floats,
    weights: Floats,
    diagonal: Floats,
    order: Floats,
    rank: int,
    wanted: Floats,
    scale: Floats,
    leak: Floats,
    x: Floats,
) -> None:
    """Bring x (n,) to J_sub x = wanted in place, x -= J_sub^+ (J_sub x - wanted), by what factored J_sub.

    The columns of J_sub were factored times `scale` (n,): from x = 0 this is the solution of minimum norm of x / scale.
    Only the first `rank` rows in order are looked at.
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
        x[j] -= scale[j] * leak[j]


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
) -> int:
    """Make q_dot (n,), zero on entry, the J_sub^+ b of minimum norm, and `wanted` (6,), b on entry, what it reaches.

    b gives way where J_sub has not the rank for it, to the nearest that there is, and where the rates would exceed
    their limits, as a whole. Return which of the two, as LOST_TO has it.
    """
    k, lost_to = J_sub.shape[0], 0
    if rank < k:
        before, whole, missing = wanted[:k].copy(), 0.0, 0.0
        nearest_attainable(rows, diagonal, order, k, rank, wanted)
        for i in range(k):
            whole, missing = max(whole, abs(before[i])), max(missing, abs(before[i] - wanted[i]))
        lost_to = TO_RANK if missing > LOST_SHARE * whole else 0
    for _ in range(2):  # the second time takes out the rounding of the first
        take_out_leak(J_sub, rows, weights, diagonal, order, rank, wanted, columns[SCALE], leak, q_dot)
    leak[:] = 0.0
    factor = bring_within_limits(leak, q_dot, columns, 1.0)
    for i in range(k):
        wanted[i] *= factor
    return lost_to + (TO_RATES if factor < 1.0 else 0)


@compiled
def tell_lost(
    J_sub: Floats, q_dot: Floats, protected_drift: Floats, parameters: Floats, lost_to: int, results: Floats
) -> None:
    """Write LOST and LOST_TO into a command's results, of a command whose protected rates stand there.

    `protected_drift` (k,) is what the momentum on board does along the protected directions.
    """
    lost, whole = 0.0, 0.0
    for i in range(J_sub.shape[0]):
        size = abs(parameters[WANTED_RATE + i]) + abs(protected_drift[i])
        for j in range(q_dot.shape[0]):
            size += abs(J_sub[i, j] * q_dot[j])
        whole = max(whole, size)
        lost = max(lost, abs(results[PROTECTED_RATE + i] - parameters[WANTED_RATE + i]))
    missing = lost > LOST_SHARE * whole
    results[LOST] = lost if missing else 0.0
    results[LOST_TO] = lost_to if missing else 0.0


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
def meet_tasks(
    matrices: Floats,
    tasks: Floats,
    parameters: Floats,
    targets: Floats,
    velocities: Floats,
    rates: Floats,
    results: Floats,
    fixed: Floats,
    drift: Floats,
    asked: bool,
    v: Floats,
) -> None:
    """Fill what the task rows shall do, v (m,), times the root of the weight, and complete the errors of positions.

    What the fixed rates and the momentum on board do already is taken off.
    """
    pace, row = parameters[PACE], 0
    for i in range(tasks.shape[0]):
        task = tasks[i]
        kind, start, velocity = int(task[KIND]), int(task[TARGET]), int(task[VELOCITY])
        for r in range(int(task[ROWS])):
            wanted = rates[row] if kind == LOOKS else velocities[velocity + r]
            if kind == POINTS:
                results[ERRORS + row] = targets[start + r * int(task[STRIDE])] + results[ERRORS + row]
            v[row] = task[ROOT_WEIGHT] * (pace * (wanted + task[GAIN] * results[ERRORS + row]))
            row += 1
    for r in range(v.shape[0]):
        v[r] -= drift[J_TASK + r, 0]
        if asked:
            for j in range(fixed.shape[0]):
                v[r] -= matrices[J_TASK + r, j] * fixed[j]


@compiled
def solve(
    matrices: Floats,
    drift: Floats,
    U_c: Floats,
    tasks: Floats,
    columns: Floats,
    parameters: Floats,
    targets: Floats,
    velocities: Floats,
    previous: Floats,
    out: Floats,
    rates: Floats,
    scratch: Floats,
    small: Floats,
) -> int:
    """Write the command that the matrices give into `out`; return OK or NOT_FINITE.

    The end-effector's position and the tasks' errors, positions' without their targets, stand in `out` already.
    `scratch` (16 + m, n) and `small` (2 m + 7, 6 + m) are overwritten, with m task rows.

    One Householder factorisation of [J_sub; J_1; J_2; ..]^T carries the whole law, J_l being the rows of the tasks of
    level l. With Q its reflections in order, J_sub is lower triangular in the first r = rank(J_sub) coordinates of
    Q^T q_dot, so a rate that is zero in those lies in null(J_sub) whatever the others are. In the next coordinates J_1
    is the lower triangular L, whose singular values are those of J_1 N_sub, and min |L y - v_cmd|^2 + rho |y|^2 is the
    paper's objective. What is left moves neither, and there J_2 is lower triangular, and so on.

    Where J_sub q_dot = b is asked for, all that stands beside a fixed part J_sub^+ b, which the tasks take as given.
    Momentum on board, which moves what `drift` (J_TASK + m, 1) says, asks for what takes this off.

    Weights of the joints scale the columns before the factorisation and the rates after it.
    """
    n, k, m, pace = columns.shape[1], U_c.shape[1], matrices.shape[0] - J_TASK, parameters[PACE]
    results = out[6 + n :]
    J_sub, rows, q_dot = scratch[0:k], scratch[k : 2 * k + m], scratch[2 * k + m]
    leak, slow, fixed = scratch[2 * k + m + 1], scratch[2 * k + m + 2], scratch[2 * k + m + 3]
    L, V, weights, starts = small[0:m], small[m : 2 * m], small[2 * m], small[2 * m + 1]
    diagonal, v, order = small[2 * m + 2], small[2 * m + 3, :m], small[2 * m + 4]
    wanted, part = small[2 * m + 5], small[2 * m + 6]
    first, asked, lost_to = 3, False, 0
    for i in range(k):
        order[i] = i
        wanted[i] = parameters[WANTED_RATE + i]
        if U_c[0, i] != 0.0 or U_c[1, i] != 0.0 or U_c[2, i] != 0.0:
            first = 0

    source = J_PROTECTED if parameters[AXES_JOINT] >= 0.0 else J_BASE
    for i in range(k):
        for b in range(first, 6):
            wanted[i] -= U_c[b, i] * drift[source + b, 0]
        asked = asked or wanted[i] != 0.0
    square = 0.0
    for j in range(n):
        scale = columns[SCALE, j]
        fixed[j], q_dot[j] = 0.0, 0.0
        for b in range(first, 6):
            square += (scale * matrices[source + b, j]) ** 2
        for i in range(k):
            J_sub[i, j] = 0.0
            for b in range(first, 6):
                J_sub[i, j] += U_c[b, i] * matrices[source + b, j]
            rows[i, j] = scale * J_sub[i, j]
        for r in range(m):
            rows[k + r, j] = scale * matrices[J_TASK + r, j]
    # The matrices are sums about the inertial origin, so that their rounding grows with the distance from it.
    far = 1.0 + abs(results[POSITION]) + abs(results[POSITION + 1]) + abs(results[POSITION + 2])
    rank = factor_protected_rows(rows, weights, diagonal, order, k, NOISE * far * np.sqrt(square))
    if asked:
        lost_to = fixed_part(J_sub, rows, weights, diagonal, order, rank, columns, wanted, leak, fixed)
    meet_tasks(matrices, tasks, parameters, targets, velocities, rates, results, fixed, drift, asked, v)

    levels, at, row, i = int(parameters[LEVELS]), rank, 0, 0
    for level in range(levels):
        size, square = 0, 0.0
        while i < tasks.shape[0] and int(tasks[i, LEVEL]) == level:
            size += int(tasks[i, ROWS])
            i += 1
        noise = -1.0  # nothing is below it: of the last level every row may take a coordinate
        if level < levels - 1:
            for r in range(row, row + size):
                for j in range(n):
                    square += (columns[SCALE, j] * matrices[J_TASK + r, j]) ** 2
            noise = NOISE * far * np.sqrt(square)
        count = factor_level(rows, weights, starts, k + row, size, at, noise, L)
        for t in range(size):
            part[t] = v[row + t]
            for s in range(rank, at):
                part[t] -= rows[k + row + t, s] * q_dot[s]
        told = results[ERRORS + m + 2 * level :]
        damped_solution(L, V, part[:size], count, level == 0, parameters, told, q_dot[at:])
        at += count
        row += size
    for t in range(m - 1, -1, -1):
        if starts[k + t] >= 0.0:
            apply_reflection(rows, weights, k + t, int(starts[k + t]), q_dot)
    for i in range(rank - 1, -1, -1):
        apply_reflection(rows, weights, i, i, q_dot)
    for j in range(n):
        q_dot[j] = columns[SCALE, j] * q_dot[j] + fixed[j]

    rate_scale = bring_within_limits(fixed, q_dot, columns, pace)
    blend = 1.0
    if parameters[LIMITS_STEPS] > 0.0:
        # Blend from the previous rates, brought to today's J_sub q_dot = b, to the wanted ones: so is all the line
        # between the two. From rest, with b = 0, this is time scaling.
        for j in range(n):
            slow[j] = previous[j]
        take_out_leak(J_sub, rows, weights, diagonal, order, rank, wanted, columns[SCALE], leak, slow)
        bring_within_limits(fixed, slow, columns, pace)
        blend = largest_blend(slow, q_dot, previous, columns)
        for j in range(n):
            q_dot[j] = slow[j] + blend * (q_dot[j] - slow[j])
    if rank > 0:  # what rounding has left in the protected rows
        take_out_leak(J_sub, rows, weights, diagonal, order, rank, wanted, columns[SCALE], leak, q_dot)
        # Where J_sub is ill-conditioned the correction can lift a rate above its limit by more than rounding.
        rate_scale *= bring_within_limits(fixed, q_dot, columns, pace)

    total = 0.0
    for r in range(m):
        total += v[r]
    for j in range(n):
        out[6 + j] = q_dot[j]
        total += q_dot[j]
    for b in range(6):
        out[b] = drift[J_BASE + b, 0]
        for j in range(n):
            out[b] += matrices[J_BASE + b, j] * q_dot[j]
    for i in range(6):
        results[PROTECTED_RATE + i] = 0.0
        if i < k:
            for b in range(first, 6):
                results[PROTECTED_RATE + i] += U_c[b, i] * drift[source + b, 0]
            for j in range(n):
                results[PROTECTED_RATE + i] += J_sub[i, j] * q_dot[j]
    results[EXCESS] = 0.0
    results[LIMITED] = 0.0
    results[LOST] = 0.0
    results[LOST_TO] = 0.0
    if asked:
        for i in range(k):
            part[i] = 0.0
            for b in range(first, 6):
                part[i] += U_c[b, i] * drift[source + b, 0]
        tell_lost(J_sub, q_dot, part, parameters, lost_to, results)
    results[RATE_SCALE] = rate_scale
    results[RATE_BLEND] = blend
    results[RANK] = rank
    results[PLAN_CHANGE] = 0.0
    return OK if np.isfinite(total) else NOT_FINITE


@compiled
def log_manipulability(matrices: Floats, U_c: Floats, columns: Floats, parameters: Floats, count: int) -> float:
    """Return log of the product of the singular values of J_1 N_sub, J_1 being the first `count` task rows.

    Rows that depend on those before are left out. Weights of the joints scale the columns, as they do in `solve`.
    """
    n, k = columns.shape[1], U_c.shape[1]
    rows, weights, diagonal, order = np.zeros((k + count, n)), np.empty(k + count), np.empty(k), np.zeros(k)
    source = J_PROTECTED if parameters[AXES_JOINT] >= 0.0 else J_BASE
    square, size, first = 0.0, 0.0, 3
    for i in range(k):
        if U_c[0, i] != 0.0 or U_c[1, i] != 0.0 or U_c[2, i] != 0.0:
            first = 0
    for j in range(n):
        for b in range(first, 6):
            square += (columns[SCALE, j] * matrices[source + b, j]) ** 2
        for i in range(k):
            for b in range(6):
                rows[i, j] += columns[SCALE, j] * U_c[b, i] * matrices[source + b, j]
        for r in range(count):
            rows[k + r, j] = columns[SCALE, j] * matrices[J_TASK + r, j]
            size += rows[k + r, j] ** 2
    at = factor_protected_rows(rows, weights, diagonal, order, k, NOISE * np.sqrt(square))
    total = 0.0
    for t in range(count):
        if at == n:
            break
        length = abs(reflect(rows, weights, k + t, at))
        if length <= DEPENDENT * np.sqrt(size):
            continue
        total += np.log(length)
        for i in range(k + t + 1, k + count):
            apply_reflection(rows, weights, k + t, at, rows[i])
        at += 1
    return total


@inlined
def wrong_size(n: int, parameters: Floats, targets: Floats, velocities: Floats, previous: Floats, out: Floats) -> bool:
    """Say whether an array has the wrong length: compiled code would read past its end."""
    size = 6 + n + ERRORS + int(parameters[TASK_ROWS]) + 2 * int(parameters[LEVELS])
    vectors = targets.shape[0] != int(parameters[TARGET_SIZE]) or velocities.shape[0] != int(parameters[VELOCITY_SIZE])
    return vectors or previous.shape[0] != n or out.shape[0] != size


@inlined
def off_unit(q: Floats) -> bool:
    """Say whether the quaternion of q is not of unit length."""
    square = q[3] * q[3] + q[4] * q[4] + q[5] * q[5] + q[6] * q[6]
    return not (1.0 - UNIT) ** 2 <= square <= (1.0 + UNIT) ** 2


@compiled
def off_circle(q: Floats, columns: Floats) -> bool:
    """Say whether the cosine and sine of a continuous joint are not of unit length."""
    for j in range(columns.shape[1]):
        if columns[CONTINUOUS, j] > 0.0:
            place = int(columns[PLACE, j])
            if not abs(np.sqrt(q[place] ** 2 + q[place + 1] ** 2) - 1.0) <= UNIT:
                return True
    return False


@inlined
def far_away(placements: Floats) -> bool:
    """Say whether the base, the first joint, is so far from the inertial origin that sums about it lose digits."""
    base = placements[1]
    return abs(base[9]) > FAR or abs(base[10]) > FAR or abs(base[11]) > FAR


@compiled_for("boolean(float64[::1], float64[:, ::1])")
def no_configuration(q: Floats, columns: Floats) -> bool:
    """Say whether q is not finite, or its quaternion or a joint's cosine and sine are not of unit length."""
    for i in range(q.shape[0]):
        if not abs(q[i]) < np.inf:
            return True
    return off_unit(q) or off_circle(q, columns)


@compiled_for(SELECTIVE_COMMAND)
def selective_command(
    A_g: Floats,
    J: Floats,
    placements: Floats,
    U_c: Floats,
    tasks: Floats,
    columns: Floats,
    parameters: Floats,
    targets: Floats,
    velocities: Floats,
    previous: Floats,
    out: Floats,
    q: Floats,
) -> int:
    """Write q_dot = (J_gt N_sub)^+ v_cmd, or what the tasks make of it, and what follows into `out`.

    Args:
        A_g: Centroidal map (6, 6 + n), `pin.Data.Ag` after `pin.computeCentroidalMap`.
        J: Joint Jacobians at the world origin (6, 6 + n), `pin.Data.J` after the same call.
        placements: Of all joints (joints, 12), `pin.Data.oMi`: rotation, joint to inertial, by columns, and
            position, m, inertial axes.
        U_c: Protected directions of the base twist (6, k), orthonormal columns, base or inertial axes as `parameters`
            says.
        tasks: (tasks, TASK_SIZE), by the indices above.
        columns: (MOVES + tasks, n), for each joint.
        parameters: (PARAMETERS_SIZE,), by the indices above.
        targets: Of all tasks; a position (3,), m, inertial axes, and the like.
        velocities: Theirs, m/s or rad/s, a number a task row, of a direction three.
        previous: The rates commanded before (n,); read only where RATE_STEP limits something.
        out: (6 + n + ERRORS + task rows + 2 levels,), overwritten.
        q: The configuration (nq,) that Pinocchio was given, whose length it has looked at.

    Returns:
        OK, NOT_FINITE (in the configuration or the targets), NO_INERTIA (H_ww is singular), NOT_UNIT (the quaternion;
        the cosine and sine of joints are for `off_circle`), WRONG_SIZE (of targets, of `previous` or of `out`),
        NOT_A_TARGET (no rotation or no direction), OTHER_MASS (A_g is not of the robot's mass) or FAR_AWAY.
    """
    n, m = columns.shape[1], int(parameters[TASK_ROWS])
    if wrong_size(n, parameters, targets, velocities, previous, out):
        return WRONG_SIZE
    if off_unit(q):
        return NOT_UNIT
    if far_away(placements):
        return FAR_AWAY
    # Two allocations for all scratch: each costs as much as a reflection.
    work, small = np.empty((J_TASK + 22 + 2 * m, n)), np.empty((max(2 * m + 7, 11) + 1, 6 + m))
    drift = np.zeros((J_TASK + m, 1))
    matrices, J_base, scratch = work[: J_TASK + m], work[J_TASK + m : J_TASK + m + 6], work[J_TASK + m + 6 :]
    results = out[6 + n :]
    position, errors = results[POSITION : POSITION + 3], results[ERRORS : ERRORS + m]
    rates = small[small.shape[0] - 1, :m]
    matrices[:] = 0.0
    position[:] = 0.0
    errors[:] = 0.0
    rates[:] = 0.0
    status = add_matrices_at(
        A_g,
        J,
        placements,
        tasks,
        columns,
        parameters,
        targets,
        velocities,
        1.0,
        matrices,
        position,
        errors,
        rates,
        J_base,
        small,
    )
    if status != OK:
        return status
    add_drift(A_g, J, placements, tasks, columns, parameters, targets, velocities, 1.0, drift)
    return solve(
        matrices, drift, U_c, tasks, columns, parameters, targets, velocities, previous, out, rates, scratch, small
    )


@compiled
def add_matrices(
    A_g: Floats,
    J: Floats,
    placements: Floats,
    U_c: Floats,
    tasks: Floats,
    columns: Floats,
    parameters: Floats,
    targets: Floats,
    velocities: Floats,
    weight: float,
    matrices: Floats,
    drift: Floats,
    rates: Floats,
    out: Floats,
) -> int:
    """Add one configuration's matrices (J_TASK + m, n), drift (J_TASK + m, 1), rates (m,) and what `out` has, weighted.

    With m task rows; in `out` position and errors. The other arguments and the value returned are those of
    `selective_command`, the sizes of targets and velocities as `parameters` says.
    """
    n, m = columns.shape[1], int(parameters[TASK_ROWS])
    J_base, small, results = np.empty((6, n)), np.empty((11, 6)), out[6 + n :]
    add_drift(A_g, J, placements, tasks, columns, parameters, targets, velocities, weight, drift)
    return add_matrices_at(
        A_g,
        J,
        placements,
        tasks,
        columns,
        parameters,
        targets,
        velocities,
        weight,
        matrices,
        results[POSITION : POSITION + 3],
        results[ERRORS : ERRORS + m],
        rates,
        J_base,
        small,
    )


@compiled
def advance_targets(tasks: Floats, targets: Floats, velocities: Floats, time: float, later: Floats) -> None:
    """Fill where targets will be after a time, s, at their velocities; turns are exact."""
    for i in range(targets.shape[0]):
        later[i] = targets[i]
    for i in range(tasks.shape[0]):
        kind, rows = int(tasks[i, KIND]), int(tasks[i, ROWS])
        start, stride, velocity = int(tasks[i, TARGET]), int(tasks[i, STRIDE]), int(tasks[i, VELOCITY])
        if kind == CLIMBS:
            continue
        if kind in (POINTS, JOINTS):
            for r in range(rows):
                later[start + r * stride] = targets[start + r * stride] + time * velocities[velocity + r]
            continue
        w = velocities[velocity : velocity + 3] * time
        angle = np.sqrt(w[0] ** 2 + w[1] ** 2 + w[2] ** 2)
        if angle == 0.0:
            continue
        w /= angle
        for c in range(3 if kind == TURNS else 1):  # Rodrigues' formula on each column
            x, y, z = targets[start + c], targets[start + stride + c], targets[start + 2 * stride + c]
            along = (w[0] * x + w[1] * y + w[2] * z) * (1.0 - np.cos(angle))
            later[start + c] = np.cos(angle) * x + np.sin(angle) * (w[1] * z - w[2] * y) + along * w[0]
            later[start + stride + c] = np.cos(angle) * y + np.sin(angle) * (w[2] * x - w[0] * z) + along * w[1]
            later[start + 2 * stride + c] = np.cos(angle) * z + np.sin(angle) * (w[0] * y - w[1] * x) + along * w[2]


@compiled_for("void(float64[::1], float64[:, ::1])")
def read_joints(q: Floats, columns: Floats) -> None:
    """Write the joint positions of a configuration into `columns`; those of continuous joints within (-pi, pi]."""
    for j in range(columns.shape[1]):
        place = int(columns[PLACE, j])
        columns[JOINT_POSITION, j] = q[place]
        if columns[CONTINUOUS, j] > 0.0:
            columns[JOINT_POSITION, j] = np.arctan2(q[place + 1], q[place])


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
    drift: Floats,
    U_c: Floats,
    tasks: Floats,
    columns: Floats,
    parameters: Floats,
    targets: Floats,
    velocities: Floats,
    previous: Floats,
    rates: Floats,
    out: Floats,
) -> int:
    """Write the command of averaged matrices and rates into `out`, the arguments being those of `selective_command`.

    The averaged end-effector position and errors stand in `out` already.
    """
    n, m = columns.shape[1], int(parameters[TASK_ROWS])
    if wrong_size(n, parameters, targets, velocities, previous, out):
        return WRONG_SIZE
    scratch, small = np.empty((16 + m, n)), np.empty((max(2 * m + 7, 11) + 1, 6 + m))
    return solve(
        matrices, drift, U_c, tasks, columns, parameters, targets, velocities, previous, out, rates, scratch, small
    )


@compiled
def pose_rows(
    matrices: Floats,
    drift: Floats,
    U_c: Floats,
    tasks: Floats,
    columns: Floats,
    parameters: Floats,
    velocities: Floats,
    rates: Floats,
    results: Floats,
    rows: Floats,
    sides: Floats,
) -> None:
    """Write the linear equations of the law, for who solves them beside inequalities.

    `rows` (k + m, n) becomes [J_sub; J_1; J_2; ..], each column times SCALE, and `sides` (k + m + 1,) what they shall
    give, and at the end the length below which a row of J_sub is noise. The tasks' errors stand in `results`.
    """
    n, k, m = columns.shape[1], U_c.shape[1], matrices.shape[0] - J_TASK
    source = J_PROTECTED if parameters[AXES_JOINT] >= 0.0 else J_BASE
    square, row = 0.0, k
    for b in range(6):
        for j in range(n):
            square += (columns[SCALE, j] * matrices[source + b, j]) ** 2
    far = 1.0 + abs(results[POSITION]) + abs(results[POSITION + 1]) + abs(results[POSITION + 2])
    sides[k + m] = NOISE * far * np.sqrt(square)
    for i in range(k):
        sides[i] = parameters[WANTED_RATE + i]
        for b in range(6):
            sides[i] -= U_c[b, i] * drift[source + b, 0]
        for j in range(n):
            rows[i, j] = 0.0
            for b in range(6):
                rows[i, j] += columns[SCALE, j] * U_c[b, i] * matrices[source + b, j]
    for i in range(tasks.shape[0]):
        task = tasks[i]
        for r in range(int(task[ROWS])):
            t = row - k
            wanted = rates[t] if int(task[KIND]) == LOOKS else velocities[int(task[VELOCITY]) + r]
            v = parameters[PACE] * (wanted + task[GAIN] * results[ERRORS + t])
            sides[row] = task[ROOT_WEIGHT] * v - drift[J_TASK + t, 0]
            for j in range(n):
                rows[row, j] = columns[SCALE, j] * matrices[J_TASK + t, j]
            row += 1


@compiled_for(
    f"int64({_FROM_PINOCCHIO}, {_CONSTANTS}, {_VECTOR}, {_VECTOR}, {_VECTOR}, {_VECTOR}, {_VECTOR}, {_ROWS}, {_ROWS}, "
    f"{_VECTOR}, {_ROWS}, {_VECTOR})"
)
def pose_command(
    A_g: Floats,
    J: Floats,
    placements: Floats,
    U_c: Floats,
    tasks: Floats,
    columns: Floats,
    parameters: Floats,
    targets: Floats,
    velocities: Floats,
    previous: Floats,
    out: Floats,
    q: Floats,
    matrices: Floats,
    drift: Floats,
    rates: Floats,
    rows: Floats,
    sides: Floats,
) -> int:
    """Do what `selective_command` does, and write what it has solved into the other arrays, by `pose_rows`."""
    if wrong_size(columns.shape[1], parameters, targets, velocities, previous, out):
        return WRONG_SIZE
    if off_unit(q) or off_circle(q, columns):
        return NOT_UNIT
    if far_away(placements):
        return FAR_AWAY
    read_joints(q, columns)
    matrices[:] = 0.0
    drift[:] = 0.0
    rates[:] = 0.0
    out[:] = 0.0
    status = add_matrices(
        A_g,
        J,
        placements,
        U_c,
        tasks,
        columns,
        parameters,
        targets,
        velocities,
        1.0,
        matrices,
        drift,
        rates,
        out,
    )
    if status != OK:
        return status
    status = held_command(matrices, drift, U_c, tasks, columns, parameters, targets, velocities, previous, rates, out)
    results = out[6 + columns.shape[1] :]
    pose_rows(matrices, drift, U_c, tasks, columns, parameters, velocities, rates, results, rows, sides)
    return status


@compiled
def take_rates(
    matrices: Floats,
    drift: Floats,
    U_c: Floats,
    columns: Floats,
    parameters: Floats,
    found: Floats,
    limited: bool,
    out: Floats,
) -> None:
    """Write other joint rates (n,), over SCALE, into a command, and the base twist and protected rate that follow.

    `limited` says that what is wanted of the protected rate has yielded to limits.
    """
    n, k, results = columns.shape[1], U_c.shape[1], out[6 + columns.shape[1] :]
    rows, moved = np.empty((k, n)), np.empty(k)
    source = J_PROTECTED if parameters[AXES_JOINT] >= 0.0 else J_BASE
    for j in range(n):
        out[6 + j] = columns[SCALE, j] * found[j]
    for b in range(6):
        out[b] = drift[J_BASE + b, 0]
        for j in range(n):
            out[b] += matrices[J_BASE + b, j] * out[6 + j]
    for i in range(k):
        moved[i] = 0.0
        for b in range(6):
            moved[i] += U_c[b, i] * drift[source + b, 0]
        rate = moved[i]
        for j in range(n):
            rows[i, j] = 0.0
            for b in range(6):
                rows[i, j] += U_c[b, i] * matrices[source + b, j]
            rate += rows[i, j] * out[6 + j]
        results[PROTECTED_RATE + i] = rate
    lost_to = int(results[LOST_TO]) | (TO_LIMITS if limited else 0)
    tell_lost(rows, out[6 : 6 + n], moved, parameters, lost_to, results)


@compiled_for(f"float64[:, ::1]({_ROWS}, {_ROWS}, float64)")
def past_protected(J_sub: Floats, J_task: Floats, noise: float) -> Floats:
    """Return J_task N_sub (m, n), N_sub being the null space that the law finds: rows of J_sub below `noise` are none.

    The columns of both are over SCALE.
    """
    (k, n), m = J_sub.shape, J_task.shape[0]
    rows, weights, diagonal, order = np.zeros((k + m, n)), np.empty(k + m), np.empty(k), np.zeros(k)
    for j in range(n):
        for i in range(k):
            rows[i, j] = J_sub[i, j]
        for r in range(m):
            rows[k + r, j] = J_task[r, j]
    rank = factor_protected_rows(rows, weights, diagonal, order, k, noise)
    left = rows[k:].copy()
    for r in range(m):
        left[r, :rank] = 0.0
        for i in range(rank - 1, -1, -1):
            apply_reflection(rows, weights, i, i, left[r])
    return left


@compiled_for(f"int64({_ROWS}, {_ROWS}, {_VECTOR}, {_VECTOR}, {_VECTOR}, {_VECTOR}, float64, float64, {_VECTOR})")
def rates_of(
    J_sub: Floats,
    J_task: Floats,
    velocity: Floats,
    wanted: Floats,
    rate_limits: Floats,
    scale: Floats,
    damping: float,
    threshold: float,
    q_dot: Floats,
) -> int:
    """Write the rates (n,) of one level of tasks into q_dot from its Jacobian (m, n) and J_sub (k, n), k up to 6.

    `wanted` (k,) is what J_sub q_dot shall be; the others are those of `columns` and `parameters`. Return OK or
    NOT_FINITE.
    """
    (k, n), m = J_sub.shape, J_task.shape[0]
    matrices, drift, U_c = np.zeros((J_TASK + m, n)), np.zeros((J_TASK + m, 1)), np.zeros((6, k))
    tasks, columns, parameters = np.zeros((1, TASK_SIZE)), np.zeros((MOVES + 1, n)), np.zeros(PARAMETERS_SIZE)
    for j in range(n):
        columns[RATE_LIMIT, j], columns[SCALE, j] = rate_limits[j], scale[j]
        for i in range(k):
            matrices[J_PROTECTED + i, j] = J_sub[i, j]
        for r in range(m):
            matrices[J_TASK + r, j] = J_task[r, j]
    for i in range(k):
        U_c[i, i], parameters[WANTED_RATE + i] = 1.0, wanted[i]
    tasks[0, KIND], tasks[0, ROWS], tasks[0, ROOT_WEIGHT] = CLIMBS, m, 1.0
    parameters[THRESHOLD], parameters[DAMPING_LIMIT] = threshold, damping
    parameters[LEVELS], parameters[PACE] = 1.0, 1.0
    out, scratch = np.zeros(6 + n + ERRORS + m + 2), np.empty((16 + m, n))
    small = np.empty((max(2 * m + 7, 11), 6 + m))
    nothing, rates = np.zeros(n), np.zeros(m)
    status = solve(
        matrices, drift, U_c, tasks, columns, parameters, rates, velocity, nothing, out, rates, scratch, small
    )
    for j in range(n):
        q_dot[j] = out[6 + j]
    return status


# For many configurations at once: the same law, row by row.


@unlocked
def solve_rows(
    values: Floats,
    U_c: Floats,
    tasks: Floats,
    columns: Floats,
    parameters: Floats,
    targets: Floats,
    out: Floats,
) -> None:
    """Write the command of one task of position, at each row's matrices, into the rows of `out` (rows, law.size).

    Everything stands in base axes. A row of `values` begins with J_base (6 n), J_gt (3 n) and the position of the
    task's point (3); `targets` (rows, 3). What is not finite gives a row of NaN. The rest as for `selective_command`,
    without momentum on board.
    """
    n = columns.shape[1]
    matrices, drift, scratch, small = (
        np.zeros((J_TASK + 3, n)),
        np.zeros((J_TASK + 3, 1)),
        np.empty((19, n)),
        np.empty((14, 9)),
    )
    still, nothing, rates = np.zeros(3), np.zeros(n), np.zeros(3)
    for row in range(values.shape[0]):
        own, results = values[row], out[row, 6 + n :]
        for b in range(6):
            for j in range(n):
                matrices[J_BASE + b, j] = own[b * n + j]
        for r in range(3):
            for j in range(n):
                matrices[J_TASK + r, j] = tasks[0, ROOT_WEIGHT] * own[(6 + r) * n + j]
            results[POSITION + r] = own[9 * n + r]
            results[ERRORS + r] = -own[9 * n + r]
        status = solve(
            matrices,
            drift,
            U_c,
            tasks,
            columns,
            parameters,
            targets[row],
            still,
            nothing,
            out[row],
            rates,
            scratch,
            small,
        )
        if status != OK:
            out[row, :] = np.nan
