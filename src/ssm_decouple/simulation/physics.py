"""The compiled equations of motion of a free-floating tree, and their integration under a servo.

Everything stands in the axes and about the origin of the base frame, so that bodies add up without transforms. Without
gravity the equations do not contain the base's pose: it is integrated beside them.

Why one file: Numba keeps compiled code on disk and watches only the file that a function stands in.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ssm_decouple.compiled import compiled

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]

# The columns of `tree`, one row a body, the base first.
ROTATION = 0  # 9: of the joint frame in its parent's, by rows
TRANSLATION = 9  # 3
AXIS = 12  # 3: of the joint, in its own frame
PRISMATIC = 15  # 1.0, or 0.0 for a revolute joint
BODY_MASS = 16
CENTRE = 17  # 3: centre of mass in the joint frame
INERTIA = 20  # 6: about the centre of mass: xx, xy, xz, yy, yz, zz
TREE_SIZE = 26

# The columns of `bodies`, one row a body, the base first: where it is and how it moves, base axes and origin.
FRAME = 0  # 12: rotation of the joint frame by rows, position
WHOLE = 12  # 10: inertia, first the body's, then that of all that it carries; see `place_inertia`
SPEED = 22  # 6: its twist
DRIFT = 28  # 6: its acceleration when no coordinate accelerates: products of velocities
FORCE = 34  # 6: the wrench that this takes, first for the body, then for all that it carries
MOVED = 40  # 6: momentum, first of the body, then of what it carries under a unit rate of its joint
MOTION = 46  # 6: twist that a unit rate of its joint gives it
BODIES_SIZE = 52

# The rows of `joints`, one entry a joint of the plant.
STIFFNESS = 0
DAMPING = 1
JOINTS_SIZE = 2

# Where the scalars stand in `settings`.
STEP = 0
STEPS = 1
STEPS_PER_TORQUE = 2
FREQUENCY = 3  # of the servo, rad/s
RATIO = 4  # of its damping
PRESCRIBED = 5  # 1.0: the joints follow the commands whatever torque it takes
LOAD_FROM = 6  # the external wrench acts from this physics step, counted from the call,
LOAD_TO = 7  # up to before this one
LOAD = 8  # 6: force and torque on the base, at its origin, base axes
INERTIAL = 14  # 1.0 if the directions that the servo spares are fixed in inertial axes, 0.0 in base axes
SETTINGS_SIZE = 15

# Where the running sums stand in `totals`.
TWIST = 0  # 6: integral of the base twist, base axes
WORK = 6  # of the joint drives
LOAD_WORK = 7  # of the external wrench
LOSS = 8  # to the dampers
SATURATED = 9  # time, s, in which a torque stood at its limit
IMPULSE = 10  # 6: of the external wrench, inertial axes, about the inertial origin
TOTALS_SIZE = 16

OK = -1  # what `advance` returns unless it has stopped
SINGULAR = 1e-20  # square of what is left of a row, against the longest, below which the joints cannot serve it
DIVERGED = 1e4  # rad/s or m/s: no spacecraft moves so fast


@compiled
def place_bodies(parent: Ints, tree: Floats, q: Floats, bodies: Floats) -> None:
    """Fill FRAME and MOTION of `bodies` (N + 1, BODIES_SIZE)."""
    for c in range(12):
        bodies[0, c] = 0.0
    bodies[0, 0] = bodies[0, 4] = bodies[0, 8] = 1.0
    for i in range(1, tree.shape[0]):
        up, own, t, me = bodies[parent[i - 1]], tree[i], q[i - 1], bodies[i]
        x, y, z = own[AXIS], own[AXIS + 1], own[AXIS + 2]
        cosine, sine = 1.0, 0.0
        if own[PRISMATIC] == 0.0:
            cosine, sine = np.cos(t), np.sin(t)
        k = 1.0 - cosine
        r00, r01, r02 = cosine + k * x * x, k * x * y - sine * z, k * x * z + sine * y
        r10, r11, r12 = k * x * y + sine * z, cosine + k * y * y, k * y * z - sine * x
        r20, r21, r22 = k * x * z - sine * y, k * y * z + sine * x, cosine + k * z * z
        for r in range(3):
            a = up[3 * r] * own[0] + up[3 * r + 1] * own[3] + up[3 * r + 2] * own[6]
            b = up[3 * r] * own[1] + up[3 * r + 1] * own[4] + up[3 * r + 2] * own[7]
            c = up[3 * r] * own[2] + up[3 * r + 1] * own[5] + up[3 * r + 2] * own[8]
            me[3 * r] = a * r00 + b * r10 + c * r20
            me[3 * r + 1] = a * r01 + b * r11 + c * r21
            me[3 * r + 2] = a * r02 + b * r12 + c * r22
            me[9 + r] = up[9 + r] + up[3 * r] * own[9] + up[3 * r + 1] * own[10] + up[3 * r + 2] * own[11]
        ax = me[0] * x + me[1] * y + me[2] * z
        ay = me[3] * x + me[4] * y + me[5] * z
        az = me[6] * x + me[7] * y + me[8] * z
        s = me[MOTION:]
        if own[PRISMATIC] != 0.0:
            me[9] += ax * t
            me[10] += ay * t
            me[11] += az * t
            s[0], s[1], s[2] = ax, ay, az
            s[3] = s[4] = s[5] = 0.0
        else:
            s[0] = me[10] * az - me[11] * ay
            s[1] = me[11] * ax - me[9] * az
            s[2] = me[9] * ay - me[10] * ax
            s[3], s[4], s[5] = ax, ay, az


@compiled
def place_inertia(own: Floats, frame: Floats, inertia: Floats) -> None:
    """Fill `inertia` (10,) of one body about the base origin: mass, mass times centre (3), xx, xy, xz, yy, yz, zz."""
    m = own[BODY_MASS]
    cx, cy, cz = own[CENTRE], own[CENTRE + 1], own[CENTRE + 2]
    x = frame[9] + frame[0] * cx + frame[1] * cy + frame[2] * cz
    y = frame[10] + frame[3] * cx + frame[4] * cy + frame[5] * cz
    z = frame[11] + frame[6] * cx + frame[7] * cy + frame[8] * cz
    ixx, ixy, ixz = own[INERTIA], own[INERTIA + 1], own[INERTIA + 2]
    iyy, iyz, izz = own[INERTIA + 3], own[INERTIA + 4], own[INERTIA + 5]
    # R I, by rows, then its product with R^T.
    a0 = frame[0] * ixx + frame[1] * ixy + frame[2] * ixz
    a1 = frame[0] * ixy + frame[1] * iyy + frame[2] * iyz
    a2 = frame[0] * ixz + frame[1] * iyz + frame[2] * izz
    b0 = frame[3] * ixx + frame[4] * ixy + frame[5] * ixz
    b1 = frame[3] * ixy + frame[4] * iyy + frame[5] * iyz
    b2 = frame[3] * ixz + frame[4] * iyz + frame[5] * izz
    c0 = frame[6] * ixx + frame[7] * ixy + frame[8] * ixz
    c1 = frame[6] * ixy + frame[7] * iyy + frame[8] * iyz
    c2 = frame[6] * ixz + frame[7] * iyz + frame[8] * izz
    inertia[0] = m
    inertia[1], inertia[2], inertia[3] = m * x, m * y, m * z
    inertia[4] = a0 * frame[0] + a1 * frame[1] + a2 * frame[2] + m * (y * y + z * z)
    inertia[5] = a0 * frame[3] + a1 * frame[4] + a2 * frame[5] - m * x * y
    inertia[6] = a0 * frame[6] + a1 * frame[7] + a2 * frame[8] - m * x * z
    inertia[7] = b0 * frame[3] + b1 * frame[4] + b2 * frame[5] + m * (x * x + z * z)
    inertia[8] = b0 * frame[6] + b1 * frame[7] + b2 * frame[8] - m * y * z
    inertia[9] = c0 * frame[6] + c1 * frame[7] + c2 * frame[8] + m * (x * x + y * y)


@compiled
def momentum_of(I: Floats, V: Floats, out: Floats) -> None:  # noqa: E741
    """Fill `out` (6,) with the momentum of an inertia (10,) that moves with the twist V (6,): [linear; angular]."""
    out[0] = I[0] * V[0] + V[4] * I[3] - V[5] * I[2]
    out[1] = I[0] * V[1] + V[5] * I[1] - V[3] * I[3]
    out[2] = I[0] * V[2] + V[3] * I[2] - V[4] * I[1]
    out[3] = I[2] * V[2] - I[3] * V[1] + I[4] * V[3] + I[5] * V[4] + I[6] * V[5]
    out[4] = I[3] * V[0] - I[1] * V[2] + I[5] * V[3] + I[7] * V[4] + I[8] * V[5]
    out[5] = I[1] * V[1] - I[2] * V[0] + I[6] * V[3] + I[8] * V[4] + I[9] * V[5]


@compiled
def equations(parent: Ints, tree: Floats, q: Floats, v: Floats, bodies: Floats, M: Floats, bias: Floats) -> None:
    """Fill the mass matrix M (6 + N, 6 + N), lower triangle, and the forces `bias` (6 + N,) at zero acceleration.

    M v_dot + bias = forces, where v (6 + N,) is the base twist and the joint rates as in Pinocchio. Composite rigid
    bodies and recursive Newton-Euler in one pass out and one back. `bodies` (N + 1, BODIES_SIZE) is overwritten.
    """
    place_bodies(parent, tree, q, bodies)
    for i in range(tree.shape[0]):
        me = bodies[i]
        w, drift, f, p = me[SPEED:], me[DRIFT:], me[FORCE:], me[MOVED:]
        if i == 0:
            for c in range(6):
                w[c] = v[c]
                drift[c] = 0.0
        else:
            up, rate = bodies[parent[i - 1]], v[5 + i]
            for c in range(6):
                w[c] = up[SPEED + c] + me[MOTION + c] * rate
            x, y, z = me[MOTION] * rate, me[MOTION + 1] * rate, me[MOTION + 2] * rate
            a, b, c = me[MOTION + 3] * rate, me[MOTION + 4] * rate, me[MOTION + 5] * rate
            drift[0] = up[DRIFT] + w[4] * z - w[5] * y + w[1] * c - w[2] * b
            drift[1] = up[DRIFT + 1] + w[5] * x - w[3] * z + w[2] * a - w[0] * c
            drift[2] = up[DRIFT + 2] + w[3] * y - w[4] * x + w[0] * b - w[1] * a
            drift[3] = up[DRIFT + 3] + w[4] * c - w[5] * b
            drift[4] = up[DRIFT + 4] + w[5] * a - w[3] * c
            drift[5] = up[DRIFT + 5] + w[3] * b - w[4] * a
        place_inertia(tree[i], me, me[WHOLE:])
        momentum_of(me[WHOLE:], drift, f)
        momentum_of(me[WHOLE:], w, p)
        f[0] += w[4] * p[2] - w[5] * p[1]
        f[1] += w[5] * p[0] - w[3] * p[2]
        f[2] += w[3] * p[1] - w[4] * p[0]
        f[3] += w[4] * p[5] - w[5] * p[4] + w[1] * p[2] - w[2] * p[1]
        f[4] += w[5] * p[3] - w[3] * p[5] + w[2] * p[0] - w[0] * p[2]
        f[5] += w[3] * p[4] - w[4] * p[3] + w[0] * p[1] - w[1] * p[0]
    gather(parent, bodies, M, bias)


@compiled
def gather(parent: Ints, bodies: Floats, M: Floats, bias: Floats) -> None:
    """Fill M and `bias` from the tips to the base: the way back of `equations`."""
    for i in range(bodies.shape[0] - 1, 0, -1):
        me, up, row = bodies[i], bodies[parent[i - 1]], M[5 + i]
        f, total = me[MOVED:], 0.0
        for c in range(6):
            total += me[MOTION + c] * me[FORCE + c]
            up[FORCE + c] += me[FORCE + c]
        bias[5 + i] = total
        momentum_of(me[WHOLE:], me[MOTION:], f)
        for c in range(10):
            up[WHOLE + c] += me[WHOLE + c]
        for c in range(6):
            row[c] = f[c]
        for j in range(6, 5 + i):
            row[j] = 0.0
        j = i
        while j > 0:
            t = bodies[j, MOTION:]
            row[5 + j] = t[0] * f[0] + t[1] * f[1] + t[2] * f[2] + t[3] * f[3] + t[4] * f[4] + t[5] * f[5]
            j = parent[j - 1]
    for c in range(6):
        bias[c] = bodies[0, FORCE + c]
        for r in range(6):
            M[r, c] = 0.0
    whole = bodies[0, WHOLE:]
    M[0, 0] = M[1, 1] = M[2, 2] = whole[0]
    M[3, 1], M[3, 2], M[4, 0] = -whole[3], whole[2], whole[3]
    M[4, 2], M[5, 0], M[5, 1] = -whole[1], -whole[2], whole[1]
    M[3, 3], M[4, 3], M[4, 4] = whole[4], whole[5], whole[7]
    M[5, 3], M[5, 4], M[5, 5] = whole[6], whole[8], whole[9]


@compiled
def solve_positive(L: Floats, size: int, x: Floats) -> bool:
    """Solve for x (size,) in place by L^T D L, which overwrites L's lower triangle; False if it is not positive.

    From the last row up, so that zeros between branches stay zeros (Featherstone). The diagonal keeps 1 / D, the rows
    stay multiplied by D.
    """
    for k in range(size - 1, -1, -1):
        row = L[k]
        if not row[k] > 0.0:
            return False
        row[k] = 1.0 / row[k]
        for i in range(k):
            factor, other = row[i] * row[k], L[i]
            if factor != 0.0:
                x[i] -= factor * x[k]
                for j in range(i + 1):
                    other[j] -= factor * row[j]
    for k in range(size):
        row, total = L[k], x[k]
        for j in range(k):
            total -= row[j] * x[j]
        x[k] = total * row[k]
    return True


@compiled
def complete(M: Floats, free: Ints, given: Ints, forces: Floats, small: Floats, x: Floats, changes: Floats) -> bool:
    """Find the entries `free` of `changes` (6 + N,), those at `given` being known: M changes = forces at `free`.

    For accelerations and for jumps of velocity alike. `free` rises. `small` and x are overwritten.
    """
    size = free.shape[0]
    for a in range(size):
        i = free[a]
        x[a] = forces[i]
        for j in given:
            x[a] -= (M[i, j] if i > j else M[j, i]) * changes[j]
        for b in range(a + 1):
            small[a, b] = M[i, free[b]]
    if not solve_positive(small, size, x):
        return False
    for a in range(size):
        changes[free[a]] = x[a]
    return True


@compiled
def row_times(M: Floats, i: int, x: Floats) -> float:
    """Return row i of a symmetric matrix, of which the lower triangle is known, times x."""
    total = 0.0
    for j in range(i):
        total += M[i, j] * x[j]
    for j in range(i, x.shape[0]):
        total += M[j, i] * x[j]
    return total


@compiled
def turn(R: Floats, u: Floats, out: Floats) -> None:
    """Fill `out` (9,) with R exp(u), rotations by rows, u (3,) a rotation vector in the axes on the right of R."""
    x, y, z = u[0], u[1], u[2]
    square = x * x + y * y + z * z
    angle = np.sqrt(square)
    if square < 1e-6:
        s = 1.0 - square * (1.0 / 6.0 - square / 120.0)
        k = 0.5 - square * (1.0 / 24.0 - square / 720.0)
    else:
        s, k = np.sin(angle) / angle, (1.0 - np.cos(angle)) / square
    for r in range(3):
        a, b, c = R[3 * r], R[3 * r + 1], R[3 * r + 2]
        # a row times the skew matrix of u, once and twice
        a1, b1, c1 = b * z - c * y, c * x - a * z, a * y - b * x
        a2, b2, c2 = b1 * z - c1 * y, c1 * x - a1 * z, a1 * y - b1 * x
        out[3 * r] = a + s * a1 + k * a2
        out[3 * r + 1] = b + s * b1 + k * b2
        out[3 * r + 2] = c + s * c1 + k * c2


@compiled
def rotation_vector_rate(u: Floats, w: Floats, out: Floats) -> None:
    """Fill `out` (3,) with the rate of the rotation vector u that the body rates w cause, to third order.

    The inverse of the exponential's derivative, cut where a fourth-order method no longer sees it (Munthe-Kaas).
    """
    a, b, c = u[1] * w[2] - u[2] * w[1], u[2] * w[0] - u[0] * w[2], u[0] * w[1] - u[1] * w[0]
    out[0] = w[0] + 0.5 * a + (u[1] * c - u[2] * b) / 12.0
    out[1] = w[1] + 0.5 * b + (u[2] * a - u[0] * c) / 12.0
    out[2] = w[2] + 0.5 * c + (u[0] * b - u[1] * a) / 12.0


@compiled
def add_impulse(
    R: Floats, place: Floats, velocity: Floats, ahead: float, load: Floats, time: float, impulse: Floats
) -> None:
    """Add what a wrench `load` (6,) on the base does in some time to `impulse` (6,), inertial axes and origin.

    The base has the rotation R (9,) and has moved from `place` (3,) with `velocity` (3,) for the time `ahead`.
    """
    x, y, z = place[0] + ahead * velocity[0], place[1] + ahead * velocity[1], place[2] + ahead * velocity[2]
    force, torque = load[0:3], load[3:6]
    a = time * (R[0] * force[0] + R[1] * force[1] + R[2] * force[2])
    b = time * (R[3] * force[0] + R[4] * force[1] + R[5] * force[2])
    c = time * (R[6] * force[0] + R[7] * force[1] + R[8] * force[2])
    impulse[0] += a
    impulse[1] += b
    impulse[2] += c
    impulse[3] += y * c - z * b + time * (R[0] * torque[0] + R[1] * torque[1] + R[2] * torque[2])
    impulse[4] += z * a - x * c + time * (R[3] * torque[0] + R[4] * torque[1] + R[5] * torque[2])
    impulse[5] += x * b - y * a + time * (R[6] * torque[0] + R[7] * torque[1] + R[8] * torque[2])


@compiled
def spare_base(M: Floats, bias: Floats, U: Floats, asked: Floats, small: Floats, wanted: Floats) -> None:
    """Change the accelerations `wanted` (n,) by as little as gives the base U^T v_dot = `asked` (k,).

    With M_bb v_dot + M_bj q_ddot + bias_b = 0 the row U_i^T v_dot is -X_i . (bias_b + M_bj q_ddot), M_bb X_i = U_i.
    `small` (k, 6 + n) and more is overwritten.
    """
    k, n = U.shape[1], wanted.shape[0]
    lengths, shift = small[k], small[k + 1]
    largest = 0.0
    for i in range(k):
        row, X = small[i], small[k + 2]
        for c in range(6):
            X[c] = U[c, i]
            for d in range(c + 1):
                small[k + 3 + c, d] = M[c, d]
        solve_positive(small[k + 3 :], 6, X)
        shift[i] = asked[i]
        for c in range(6):
            shift[i] += X[c] * bias[c]
        for j in range(n):
            row[j] = 0.0
            for c in range(6):
                row[j] -= X[c] * M[6 + j, c]
        # Make it orthogonal to the rows before, twice, and its equation with it.
        whole = 0.0
        for j in range(n):
            whole += row[j] * row[j]
        largest = max(largest, whole)
        for _ in range(2):
            for b in range(i):
                if lengths[b] > 0.0:
                    product = 0.0
                    for j in range(n):
                        product += row[j] * small[b, j]
                    product /= lengths[b]
                    for j in range(n):
                        row[j] -= product * small[b, j]
                    shift[i] -= product * shift[b]
        lengths[i] = 0.0
        for j in range(n):
            lengths[i] += row[j] * row[j]
        if lengths[i] <= SINGULAR * largest:  # the joints cannot move the base so: nothing to keep
            lengths[i] = 0.0
    for i in range(k):
        if lengths[i] > 0.0:
            missing = shift[i]
            for j in range(n):
                missing -= small[i, j] * wanted[j]
            for j in range(n):
                wanted[j] += small[i, j] * missing / lengths[i]


@compiled
def servo_torque(
    parent: Ints,
    tree: Floats,
    q: Floats,
    v: Floats,
    wanted: Floats,
    U: Floats,
    asked: Floats,
    limits: Floats,
    work: Floats,
    torque: Floats,
) -> bool:
    """Fill `torque` (n,) with what gives the joints the accelerations `wanted` (n,) while the base floats.

    Computed torque by the controller's own model. With directions U (6, k) of the base twist the accelerations are
    changed, in place, so that the base accelerates along them as `asked` (k,). Return whether a limit (n,) cut a
    torque. `work`, as large as `scratch_of` says, is overwritten.
    """
    n = wanted.shape[0]
    bodies, M, small = work[: n + 1], work[n + 1 : 2 * n + 7], work[2 * n + 7 :]
    bias, change, x = small[20], small[21], small[22]
    equations(parent, tree, q, v, bodies, M, bias)
    if U.shape[1] > 0:
        spare_base(M, bias, U, asked, small, wanted)
    for i in range(6):
        x[i] = -bias[i]
        for j in range(n):
            x[i] -= M[6 + j, i] * wanted[j]
        for j in range(i + 1):
            small[i, j] = M[i, j]
    solve_positive(small, 6, x)
    for i in range(6):
        change[i] = x[i]
    for j in range(n):
        change[6 + j] = wanted[j]
    cut = False
    for j in range(n):
        torque[j] = bias[6 + j] + row_times(M, 6 + j, change[: 6 + n])
        if abs(torque[j]) > limits[j]:
            torque[j] = limits[j] if torque[j] > 0.0 else -limits[j]
            cut = True
    return cut


@compiled
def rows_in_base(U: Floats, pose: Floats, inertial: bool, out: Floats) -> None:
    """Fill `out` (6, k) with directions of the base twist (6, k) in base axes, given in base or inertial axes."""
    for i in range(U.shape[1]):
        for c in range(6):
            out[c, i] = U[c, i]
        if inertial:
            for c in range(3):
                out[c, i] = pose[c] * U[0, i] + pose[3 + c] * U[1, i] + pose[6 + c] * U[2, i]
                out[3 + c, i] = pose[c] * U[3, i] + pose[3 + c] * U[4, i] + pose[6 + c] * U[5, i]


@compiled
def scratch_of(n: int) -> Floats:
    """Return room for the equations of a tree of n joints and for solving them."""
    return np.empty((3 * n + 32, max(BODIES_SIZE, n + 6)))


@compiled
def motion_rates(
    parent: Ints,
    tree: Floats,
    joints: Floats,
    driven: Ints,
    free: Ints,
    given: Ints,
    torque: Floats,
    load: Floats,
    q: Floats,
    v: Floats,
    work: Floats,
    v_dot: Floats,
    power: Floats,
) -> bool:
    """Fill the accelerations v_dot (6 + N,), zero at `given`, and `power`: of drives, load and dampers.

    Where joints are given, `torque` (n,) is what it takes and is filled too. False if the equations have no solution.
    """
    N = q.shape[0]
    bodies, M, small = work[: N + 1], work[N + 1 : 2 * N + 7], work[2 * N + 7 :]
    bias, forces, x = small[N + 6], small[N + 7], small[N + 8]
    equations(parent, tree, q, v, bodies, M, bias)
    power[:] = 0.0
    for i in range(6):
        forces[i] = load[i] - bias[i]
        power[1] += load[i] * v[i]
    for i in range(N):
        lost = joints[DAMPING, i] * v[6 + i]
        forces[6 + i] = -bias[6 + i] - joints[STIFFNESS, i] * q[i] - lost
        power[2] += lost * v[6 + i]
    if given.shape[0] == 0:
        for j in range(driven.shape[0]):
            forces[6 + driven[j]] += torque[j]
    for i in given:
        v_dot[i] = 0.0
    if not complete(M, free, given, forces, small, x, v_dot):
        return False
    for j in range(driven.shape[0]):
        i = 6 + driven[j]
        if given.shape[0] > 0:
            torque[j] = row_times(M, i, v_dot) - forces[i]
        power[0] += torque[j] * v[i]
    return True


@compiled
def jump(
    parent: Ints,
    tree: Floats,
    free: Ints,
    given: Ints,
    driven: Ints,
    command: Floats,
    q: Floats,
    v: Floats,
    work: Floats,
    changes: Floats,
) -> float:
    """Bring the driven joints to the rates `command` (n,) at once and return the work that it takes.

    The impulses act between bodies, so that momentum and the hinges' generalised momenta stay.
    """
    N = q.shape[0]
    bodies, M, small = work[: N + 1], work[N + 1 : 2 * N + 7], work[2 * N + 7 :]
    nothing, x = small[N + 7], small[N + 8]
    equations(parent, tree, q, v, bodies, M, small[N + 6])
    nothing[:] = 0.0
    for j in range(driven.shape[0]):
        changes[6 + driven[j]] = command[j] - v[6 + driven[j]]
    complete(M, free, given, nothing, small, x, changes)
    spent = 0.0
    for i in given:
        spent += (v[i] + 0.5 * changes[i]) * row_times(M, i, changes)
    for i in range(6 + N):
        v[i] += changes[i]
    return spent


@compiled
def split(driven: Ints, size: int, prescribed: bool) -> tuple[Ints, Ints]:
    """Return which of the 6 + N velocities the equations decide and which the drives do."""
    if not prescribed:
        return np.arange(size), np.empty(0, dtype=np.int64)
    is_given = np.zeros(size, dtype=np.bool_)
    is_given[driven + 6] = True
    return np.flatnonzero(~is_given), np.flatnonzero(is_given)


@compiled  # when first called: who simulates without torques does not wait for it
def advance(
    parent: Ints,
    tree: Floats,
    joints: Floats,
    driven: Ints,
    own_parent: Ints,
    own_tree: Floats,
    limits: Floats,
    U: Floats,
    settings: Floats,
    command: Floats,
    reference: Floats,
    torques: Floats,
    spared_motion: Floats,
    q: Floats,
    v: Floats,
    pose: Floats,
    totals: Floats,
) -> int:
    """Move a plant through one hold of a command, in physics steps of the classical fourth-order Runge-Kutta method.

    The attitude is integrated on the rotation group (Munthe-Kaas), joints and velocities as the vectors that they are.

    Args:
        parent: For each joint of the plant, the row of `tree` that carries it (N,).
        tree: The plant's bodies (N + 1, TREE_SIZE).
        joints: (JOINTS_SIZE, N), STIFFNESS and DAMPING of each joint.
        driven: Places of the n commanded joints among the N.
        own_parent: As `parent`, of the controller's model (n,).
        own_tree: As `tree`, of the controller's model (n + 1, TREE_SIZE).
        limits: Torque limits (n,), infinite where there is none.
        U: Directions of the base twist that the servo spares (6, k), k may be 0.
        settings: (SETTINGS_SIZE,), by the indices above.
        command: Joint rates (n,), held.
        reference: Where the commands have led the joints so far (n,), overwritten.
        torques: (2, n): the torques that act at last, and the largest ones so far, overwritten.
        spared_motion: How far the base has moved along U so far (k,), overwritten.
        q: Joint positions (N,), overwritten.
        v: Base twist and joint rates (6 + N,), overwritten.
        pose: Base rotation by rows and position (12,), overwritten.
        totals: (TOTALS_SIZE,), added to.

    Returns:
        OK, or the physics step at which the motion has diverged.
    """
    N, n = q.shape[0], driven.shape[0]
    h, prescribed = settings[STEP], settings[PRESCRIBED] > 0.0
    free, given = split(driven, 6 + N, prescribed)
    work, own_work = scratch_of(N), scratch_of(n)
    slopes, sum_v, change = np.empty((4, 6 + N)), np.empty(6 + N), np.zeros(6 + N)
    q_stage, v_stage, sum_q = np.empty(N), np.empty(6 + N), np.empty(N)
    power, flows, load = np.empty(3), np.empty(3), np.zeros(6)
    u, k, sum_u, R, sum_p, p_dot = np.zeros(3), np.empty(3), np.empty(3), np.empty(9), np.empty(3), np.empty(3)
    own_q, own_v, wanted = np.empty(n), np.empty(6 + n), np.empty(n)
    spared = U.shape[1]
    U_base, asked, moved = np.empty((6, spared)), np.empty(spared), np.empty(6)
    if prescribed:
        totals[WORK] += jump(parent, tree, free, given, driven, command, q, v, work, change)
    cut = False
    for step in range(int(settings[STEPS])):
        if not prescribed and step % int(settings[STEPS_PER_TORQUE]) == 0:
            span = h * settings[STEPS_PER_TORQUE]
            for c in range(6):
                own_v[c] = v[c]
            for j in range(n):
                own_q[j], own_v[6 + j] = q[driven[j]], v[6 + driven[j]]
                wanted[j] = 2.0 * settings[RATIO] * settings[FREQUENCY] * (command[j] - own_v[6 + j])
                wanted[j] += settings[FREQUENCY] ** 2 * (reference[j] - own_q[j])
            rows_in_base(U, pose, settings[INERTIAL] > 0.0, U_base)
            for i in range(spared):
                asked[i] = -(settings[FREQUENCY] ** 2) * spared_motion[i]
                for c in range(6):
                    asked[i] -= 2.0 * settings[RATIO] * settings[FREQUENCY] * U_base[c, i] * v[c]
            cut = servo_torque(own_parent, own_tree, own_q, own_v, wanted, U_base, asked, limits, own_work, torques[0])
            for j in range(n):
                if not cut:  # while a drive stands at its limit the reference waits, or it would run away
                    reference[j] += span * command[j]
        if cut:
            totals[SATURATED] += h
        loaded = settings[LOAD_FROM] <= step < settings[LOAD_TO]
        for c in range(6):
            load[c] = settings[LOAD + c] if loaded else 0.0
        flows[:] = 0.0
        sum_q[:] = 0.0
        sum_v[:] = 0.0
        sum_u[:] = 0.0
        sum_p[:] = 0.0
        p_dot[:] = 0.0
        u[:] = 0.0
        for stage in range(4):
            ahead = 0.0 if stage == 0 else (h if stage == 3 else 0.5 * h)
            weight = h / 6.0 if stage in (0, 3) else h / 3.0
            for i in range(6 + N):
                v_stage[i] = v[i] + (ahead * slopes[stage - 1, i] if stage > 0 else 0.0)
            for i in range(N):
                # q moves with the velocity of the stage before, which stands in change
                q_stage[i] = q[i] + (ahead * change[6 + i] if stage > 0 else 0.0)
            for c in range(3):
                u[c] = ahead * k[c] if stage > 0 else 0.0
            solved = motion_rates(
                parent,
                tree,
                joints,
                driven,
                free,
                given,
                torques[0],
                load,
                q_stage,
                v_stage,
                work,
                slopes[stage],
                power,
            )
            if not solved:
                return step
            turn(pose[:9], u, R)
            if loaded:
                add_impulse(R, pose[9:], p_dot, ahead, load, weight, totals[IMPULSE:])
            rotation_vector_rate(u, v_stage[3:6], k)
            for r in range(3):
                p_dot[r] = R[3 * r] * v_stage[0] + R[3 * r + 1] * v_stage[1] + R[3 * r + 2] * v_stage[2]
                sum_u[r] += weight * k[r]
                sum_p[r] += weight * p_dot[r]
                flows[r] += weight * power[r]
            for j in range(n):
                torques[1, j] = max(torques[1, j], abs(torques[0, j]))
            for i in range(6 + N):
                change[i] = v_stage[i]
                sum_v[i] += weight * slopes[stage, i]
            for i in range(N):
                sum_q[i] += weight * v_stage[6 + i]
            for c in range(6):
                moved[c] = (moved[c] if stage > 0 else 0.0) + weight * v_stage[c]
        if spared > 0:
            rows_in_base(U, pose, settings[INERTIAL] > 0.0, U_base)
        for c in range(6):
            totals[TWIST + c] += moved[c]
            for i in range(spared):
                spared_motion[i] += U_base[c, i] * moved[c]
        turn(pose[:9], sum_u, R)
        for c in range(9):
            pose[c] = R[c]
        for r in range(3):
            pose[9 + r] += sum_p[r]
            totals[WORK + r] += flows[r]
        largest = 0.0
        for i in range(N):
            q[i] += sum_q[i]
        for i in range(6 + N):
            v[i] += sum_v[i]
            largest = max(largest, abs(v[i]))
            if not np.isfinite(v[i]):
                return step
        if largest > DIVERGED:
            return step
    if prescribed:
        for j in range(n):
            reference[j] = q[driven[j]]
    return OK
