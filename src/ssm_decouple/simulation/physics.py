"""The compiled equations of motion of a free-floating tree, and their integration under a servo.

Everything stands in the axes and about the origin of the base frame, so that bodies add up without transforms. Without
gravity the equations do not contain the base's pose: it is integrated beside them.
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
PROTECTS = 14  # 1.0: the servo holds the directions, too
AXES = 15  # the body of the plant in whose axes the directions are fixed, 0.0 for the base; below 0 in inertial axes
OWN_AXES = 16  # the same body in the controller's model
FIRST = 17  # the physics steps that one call does: from this one,
LAST = 18  # up to before this one; a hold may take several calls
STEPS_PER_PIECE = 19  # how many of them what the model makes of the motion is integrated over at a time
DIFFERS = 20  # 1.0: the plant moves otherwise than the controller's model, or something acts from outside
MOMENTUM = 21  # 6: on board, linear and angular about the centre of mass, inertial axes
SETTINGS_SIZE = 27

# The rows of `drives`, one entry a commanded joint.
TORQUE = 0  # that acts at last
LARGEST = 1  # so far
LIMITED_TIME = 2  # s, so far in which it stood at its limit
AT_LIMIT = 3  # 1.0 while it does
DRIVES_SIZE = 4

# The rows of `parts`, one entry a direction: how far the base has moved along it so far.
TRUTH = 0
MODEL = 1  # as the controller's model makes it of the joints' true motion
PLAN = 2  # as the controller's model makes it of the commands, done at once from each sample on
PARTS_SIZE = 3

# Where the running sums stand in `totals`.
TWIST = 0  # 6: integral of the base twist, base axes
WORK = 6  # of the joint drives
LOAD_WORK = 7  # of the external wrench
LOSS = 8  # to the dampers
SATURATED = 9  # time, s, in which the torque of any drive stood at its limit
IMPULSE = 10  # 6: of the external wrench, inertial axes, about the inertial origin
TOTALS_SIZE = 16

OK = -1  # what `advance` returns unless it has stopped
SINGULAR = 1e-20  # square of what is left of a row, against the longest, below which the joints cannot serve it
DIVERGED = 1e4  # rad/s or m/s: no spacecraft moves so fast
ENOUGH = 0.02  # of what plain scaling would leave of the wanted accelerations
AT = 1.0 - 1e-9  # of its limit, from where on a torque stands at it
# Nodes and weights of Gauss's quadrature on [0, 1]: one node more than any law plans with.
_ROOTS, _WEIGHTS = np.polynomial.legendre.leggauss(4)
NODES, WEIGHTS = 0.5 + 0.5 * _ROOTS, 0.5 * _WEIGHTS

# Where vectors stand in the last rows of a scratch matrix of the servo.
BIAS = 20
CHANGE = 21
SOLUTION = 22
NEEDED = 23  # torques
BASIS = 24  # accelerations
ZEROS = 25
SHARE = 26  # one number
COPY = 27  # 6 + n rows


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
def place_whole(whole: Floats, M: Floats) -> None:
    """Fill the base's part of the mass matrix, lower triangle, with the inertia (10,) of all that it carries."""
    for r in range(6):
        for c in range(r + 1):
            M[r, c] = 0.0
    M[0, 0] = M[1, 1] = M[2, 2] = whole[0]
    M[3, 1], M[3, 2], M[4, 0] = -whole[3], whole[2], whole[3]
    M[4, 2], M[5, 0], M[5, 1] = -whole[1], -whole[2], whole[1]
    M[3, 3], M[4, 3], M[4, 4] = whole[4], whole[5], whole[7]
    M[5, 3], M[5, 4], M[5, 5] = whole[6], whole[8], whole[9]


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
    place_whole(bodies[0, WHOLE:], M)


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
def torques_for(M: Floats, bias: Floats, accelerations: Floats, small: Floats, torque: Floats) -> None:
    """Fill `torque` (n,) with what gives the joints these accelerations (n,) while the base floats."""
    n = torque.shape[0]
    change, x = small[CHANGE], small[SOLUTION]
    for i in range(6):
        x[i] = -bias[i]
        for j in range(n):
            x[i] -= M[6 + j, i] * accelerations[j]
        for j in range(i + 1):
            small[i, j] = M[i, j]
    solve_positive(small, 6, x)
    for i in range(6):
        change[i] = x[i]
    for j in range(n):
        change[6 + j] = accelerations[j]
    for j in range(n):
        torque[j] = bias[6 + j] + row_times(M, 6 + j, change[: 6 + n])


@compiled
def free_accelerations(M: Floats, bias: Floats, small: Floats, accelerations: Floats) -> None:
    """Fill `accelerations` (n,) with those of the joints without torques."""
    n = accelerations.shape[0]
    copy, x = small[COPY:], small[SOLUTION]
    for i in range(6 + n):
        x[i] = -bias[i]
        for j in range(i + 1):
            copy[i, j] = M[i, j]
    solve_positive(copy, 6 + n, x)
    for j in range(n):
        accelerations[j] = x[6 + j]


@compiled
def fitting_share(fixed: Floats, torque: Floats, limits: Floats) -> float:
    """Return the largest s in [0, 1] for which fixed + s (torque - fixed) keeps the limits, as `fixed` does."""
    share = 1.0
    for j in range(torque.shape[0]):
        if torque[j] > limits[j]:
            share = min(share, (limits[j] - fixed[j]) / (torque[j] - fixed[j]))
        elif torque[j] < -limits[j]:
            share = min(share, (limits[j] + fixed[j]) / (fixed[j] - torque[j]))
    return max(share, 0.0)


@compiled
def rows_in_base(U: Floats, axes: int, body: Floats, R: Floats, out: Floats) -> None:
    """Fill `out` (6, k) with directions of the base twist (6, k) in base axes.

    They are given in the axes of a body, whose FRAME says how they stand in base axes, or with `axes` below 0 in
    inertial axes, which the base's rotation R (9,), by rows, leads to.
    """
    for i in range(U.shape[1]):
        for c in range(6):
            out[c, i] = U[c, i]
        for c in range(3):
            if axes > 0:
                out[c, i] = body[3 * c] * U[0, i] + body[3 * c + 1] * U[1, i] + body[3 * c + 2] * U[2, i]
                out[3 + c, i] = body[3 * c] * U[3, i] + body[3 * c + 1] * U[4, i] + body[3 * c + 2] * U[5, i]
            elif axes < 0:
                out[c, i] = R[c] * U[0, i] + R[3 + c] * U[1, i] + R[6 + c] * U[2, i]
                out[3 + c, i] = R[c] * U[3, i] + R[3 + c] * U[4, i] + R[6 + c] * U[5, i]


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
    changed, in place, so that the base accelerates along them as `asked` (k,). `work`, as large as `scratch_of` says,
    is overwritten.

    Returns:
        Whether a limit (n,) has cut the torques; the first number of the row SHARE of the scratch matrix tells which
        share of the wanted accelerations is left.
    """
    n = wanted.shape[0]
    bodies, M, small = work[: n + 1], work[n + 1 : 2 * n + 7], work[2 * n + 7 :]
    bias = small[BIAS]
    equations(parent, tree, q, v, bodies, M, bias)
    if U.shape[1] > 0:
        spare_base(M, bias, U, asked, small, wanted)
    torques_for(M, bias, wanted, small, torque)
    return keep_limits(M, bias, U, asked, limits, small, torque)


@compiled
def driven_torque(
    parent: Ints,
    tree: Floats,
    q: Floats,
    v: Floats,
    wanted: Floats,
    braking: Floats,
    U: Floats,
    axes: int,
    R: Floats,
    limits: Floats,
    work: Floats,
    torque: Floats,
) -> bool:
    """Do what `servo_torque` does for drives that know of no directions but at their limits.

    There the base is to accelerate along U (6, k), in the axes that `axes` and R tell, as it would under the servo's
    loop on the rates alone, which asks for the accelerations `braking` (n,): it takes J_sub q_dot to what the command
    makes of it.
    """
    n, k = wanted.shape[0], U.shape[1]
    bodies, M, small = work[: n + 1], work[n + 1 : 2 * n + 7], work[2 * n + 7 :]
    bias, zeros, needed = small[BIAS], small[ZEROS][:n], small[NEEDED][:n]
    equations(parent, tree, q, v, bodies, M, bias)
    torques_for(M, bias, wanted, small, torque)
    zeros[:] = 0.0
    if fitting_share(zeros, torque, limits) == 1.0:
        return False
    U_base, asked = np.empty((6, k)), np.empty(k)
    rows_in_base(U, axes, bodies[max(axes, 0)], R, U_base)
    torques_for(M, bias, braking, small, needed)
    for i in range(k):
        asked[i] = 0.0
        for c in range(6):
            asked[i] += U_base[c, i] * small[CHANGE, c]
    return keep_limits(M, bias, U_base, asked, limits, small, torque)


@compiled
def keep_limits(
    M: Floats, bias: Floats, U: Floats, asked: Floats, limits: Floats, small: Floats, torque: Floats
) -> bool:
    """Bring all torques (n,) inside their limits together where one is above its own, as rates are.

    One joint cut by itself would leave the null space of J_sub; together they come to the commanded rates later. First
    come the torques that give the base the acceleration `asked` (k,) along U (6, k) with the least change of the
    joints' free motion; of what the servo wants beside it the share is taken that the limits allow. Where this is next
    to nothing, plain scaling takes over, so that no drive at its limit can lock the others.
    """
    n = torque.shape[0]
    needed, zeros, shares = small[NEEDED][:n], small[ZEROS][:n], small[SHARE]
    zeros[:] = 0.0
    plain = fitting_share(zeros, torque, limits)
    shares[0] = plain
    if plain == 1.0:
        return False
    if U.shape[1] > 0:
        basis = small[BASIS][:n]
        free_accelerations(M, bias, small, basis)
        spare_base(M, bias, U, asked, small, basis)
        torques_for(M, bias, basis, small, needed)
        share = 0.0
        if fitting_share(zeros, needed, limits) == 1.0:
            share = fitting_share(needed, torque, limits)
        trust = min(1.0, share / (ENOUGH * plain))
        for j in range(n):
            torque[j] = trust * (needed[j] + share * (torque[j] - needed[j])) + (1.0 - trust) * plain * torque[j]
        shares[0] = trust * share + (1.0 - trust) * plain
    else:
        for j in range(n):
            torque[j] *= plain
    for j in range(n):
        torque[j] = min(max(torque[j], -limits[j]), limits[j])  # rounding
    return True


@compiled
def base_twist_of(parent: Ints, tree: Floats, q: Floats, rates: Floats, on_board: Floats, work: Floats) -> Floats:
    """Return the base twist (6,), base axes, that joint rates (n,) cause with a momentum on board (6,), base axes.

    H twist + (momentum of the joints' motion) = momentum about the base origin. The first rows of `work` hold the
    bodies afterwards.
    """
    n = q.shape[0]
    bodies, small, whole, own, x = work[: n + 1], work[n + 1 :], np.zeros(10), np.zeros(6), on_board.copy()
    place_bodies(parent, tree, q, bodies)
    for i in range(n + 1):
        me = bodies[i]
        for c in range(6):
            me[SPEED + c] = 0.0 if i == 0 else bodies[parent[i - 1], SPEED + c] + me[MOTION + c] * rates[i - 1]
        place_inertia(tree[i], me, me[WHOLE:])
        momentum_of(me[WHOLE:], me[SPEED:], own)
        for c in range(6):
            x[c] -= own[c]
        for c in range(10):
            whole[c] += me[WHOLE + c]
    a, b, c = whole[1] / whole[0], whole[2] / whole[0], whole[3] / whole[0]
    x[3] += b * on_board[2] - c * on_board[1]
    x[4] += c * on_board[0] - a * on_board[2]
    x[5] += a * on_board[1] - b * on_board[0]
    place_whole(whole, small)
    solve_positive(small, 6, x)
    return x


@compiled
def cubic(x: float, way: float, first: float, last: float) -> float:
    """Return how much of a way is done at a share x in [0, 1] of its time.

    Beside the straight way stands how far it would go at the first rate beyond it, and how far it would fall short of
    it at the last one.
    """
    return x * way + x * (1.0 - x) * ((1.0 - x) * first + x * last)


@compiled
def add_motion_of_path(
    parent: Ints,
    tree: Floats,
    U: Floats,
    settings: Floats,
    start: Floats,
    end: Floats,
    time: float,
    R: Floats,
    turning: Floats,
    work: Floats,
    moved: Floats,
) -> None:
    """Add how far joints on a cubic path move the base along directions U, by the controller's model, to `moved` (k,).

    Args:
        parent: Of the controller's model (n,).
        tree: Of the controller's model (n + 1, TREE_SIZE).
        U: Directions (6, k), in the axes that OWN_AXES names.
        settings: (SETTINGS_SIZE,).
        start: Joint positions and rates at the start (2, n).
        end: The same at the end (2, n).
        time: In between.
        R: Rotation of the base at the start (9,).
        turning: Its rotation vector from there to the end, and its rates at both ends (3, 3), base axes.
        work: As large as `scratch_of` says, overwritten.
        moved: (k,), added to.
    """
    n = start.shape[1]
    q, rates, on_board, part = np.empty(n), np.empty(n), np.empty(6), np.empty(3)
    now, U_base, axes = np.empty(9), np.empty((6, U.shape[1])), int(settings[OWN_AXES])
    for node in range(NODES.shape[0]):
        x = NODES[node]
        for j in range(n):
            way = end[0, j] - start[0, j]
            first, last = start[1, j] * time - way, way - end[1, j] * time
            q[j] = start[0, j] + cubic(x, way, first, last)
            rates[j] = way + (1.0 - x) * (1.0 - 3.0 * x) * first + x * (2.0 - 3.0 * x) * last
            rates[j] /= time
        for c in range(3):
            first, last = turning[1, c] * time - turning[0, c], turning[0, c] - turning[2, c] * time
            part[c] = cubic(x, turning[0, c], first, last)
        turn(R, part, now)
        for c in range(3):
            on_board[c] = on_board[3 + c] = 0.0
            for r in range(3):
                on_board[c] += now[3 * r + c] * settings[MOMENTUM + r]
                on_board[3 + c] += now[3 * r + c] * settings[MOMENTUM + 3 + r]
        twist = base_twist_of(parent, tree, q, rates, on_board, work)
        rows_in_base(U, axes, work[max(axes, 0)], now, U_base)
        for i in range(U.shape[1]):
            for c in range(6):
                moved[i] += WEIGHTS[node] * time * U_base[c, i] * twist[c]


@compiled
def scratch_of(n: int) -> Floats:
    """Return room for the equations of a tree of n joints and for solving them."""
    return np.empty((3 * n + COPY + 16, max(BODIES_SIZE, n + 6)))


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


@compiled
def start_piece(driven: Ints, q: Floats, v: Floats, first: bool, piece: Floats) -> None:
    """Remember where a piece of the motion begins, and with `first` where the hold does: rows of `piece` (5, n)."""
    for j in range(driven.shape[0]):
        piece[0, j], piece[1, j] = q[driven[j]], v[6 + driven[j]]
        if first:
            piece[4, j] = piece[0, j]


@compiled
def end_piece(driven: Ints, q: Floats, v: Floats, piece: Floats) -> None:
    """Remember where a piece of the motion ends."""
    for j in range(driven.shape[0]):
        piece[2, j], piece[3, j] = q[driven[j]], v[6 + driven[j]]


@compiled
def plan_piece(command: Floats, begins: float, ends: float, piece: Floats) -> None:
    """Replace a piece of the motion by what it is where the command is done at once from the hold's start on."""
    for j in range(command.shape[0]):
        piece[0, j], piece[2, j] = piece[4, j] + begins * command[j], piece[4, j] + ends * command[j]
        piece[1, j] = piece[3, j] = command[j]


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
    drives: Floats,
    parts: Floats,
    piece: Floats,
    q: Floats,
    v: Floats,
    pose: Floats,
    totals: Floats,
) -> int:
    """Move a plant through a hold of a command, or some of it, in physics steps of the classical Runge-Kutta method.

    It is of fourth order. The attitude is integrated on the rotation group (Munthe-Kaas), joints and velocities as the
    vectors that they are.

    A servo's reference moves on with the command, and as far as the limits take its accelerations away, with the joint
    instead, so that its lead does not wind up.

    Args:
        parent: For each joint of the plant, the row of `tree` that carries it (N,).
        tree: The plant's bodies (N + 1, TREE_SIZE).
        joints: (JOINTS_SIZE, N), STIFFNESS and DAMPING of each joint.
        driven: Places of the n commanded joints among the N.
        own_parent: As `parent`, of the controller's model (n,).
        own_tree: As `tree`, of the controller's model (n + 1, TREE_SIZE).
        limits: Torque limits (n,), infinite where there is none.
        U: Protected directions of the base twist (6, k), k may be 0, in the axes that AXES names.
        settings: (SETTINGS_SIZE,), by the indices above.
        command: Joint rates (n,), held.
        reference: Where the commands have led the joints so far (n,), overwritten.
        drives: (DRIVES_SIZE, n), overwritten.
        parts: (PARTS_SIZE, k), added to; the servo that protects brings TRUTH back to zero.
        piece: (5, n): joint positions and rates at both ends of a piece of the motion, and the positions at the hold's
            start, overwritten.
        q: Joint positions (N,), overwritten.
        v: Base twist and joint rates (6 + N,), overwritten.
        pose: Base rotation by rows and position (12,), overwritten.
        totals: (TOTALS_SIZE,), added to.

    Returns:
        OK, or the physics step at which the motion has diverged.
    """
    N, n, k = q.shape[0], driven.shape[0], U.shape[1]
    h, prescribed, first = settings[STEP], settings[PRESCRIBED] > 0.0, int(settings[FIRST])
    free, given = split(driven, 6 + N, prescribed)
    work, own_work = scratch_of(N), scratch_of(n)
    slopes, sum_v, change = np.empty((4, 6 + N)), np.empty(6 + N), np.zeros(6 + N)
    q_stage, v_stage, sum_q = np.empty(N), np.empty(6 + N), np.empty(N)
    power, flows, load = np.empty(3), np.empty(3), np.zeros(6)
    u, w, sum_u, R, sum_p, p_dot = np.zeros(3), np.empty(3), np.empty(3), np.empty(9), np.empty(3), np.empty(3)
    own_q, own_v, wanted, braking = np.empty(n), np.empty(6 + n), np.empty(n), np.empty(n)
    axes, own_axes = int(settings[AXES]), int(settings[OWN_AXES])
    protects = settings[PROTECTS] > 0.0
    U_base, asked, moved = np.empty((6, k)), np.empty(k), np.empty(6)
    torque, share = drives[TORQUE], own_work[2 * n + 7 + SHARE]
    turning, R_piece, per_piece = np.zeros((3, 3)), np.empty(9), int(settings[STEPS_PER_PIECE])
    if prescribed and first == 0:
        totals[WORK] += jump(parent, tree, free, given, driven, command, q, v, work, change)
    cut = False
    for j in range(n):
        cut = cut or drives[AT_LIMIT, j] > 0.0
    for step in range(first, int(settings[LAST])):
        if k > 0 and step % per_piece == 0:
            start_piece(driven, q, v, step == 0, piece)
            R_piece[:] = pose[:9]
            turning[0] = 0.0
            turning[1] = v[3:6]
        if not prescribed and step % int(settings[STEPS_PER_TORQUE]) == 0:
            span = h * settings[STEPS_PER_TORQUE]
            for c in range(6):
                own_v[c] = v[c]
            for j in range(n):
                own_q[j], own_v[6 + j] = q[driven[j]], v[6 + driven[j]]
                braking[j] = 2.0 * settings[RATIO] * settings[FREQUENCY] * (command[j] - own_v[6 + j])
                wanted[j] = braking[j] + settings[FREQUENCY] ** 2 * (reference[j] - own_q[j])
            if protects:
                rows_in_base(U, axes, work[0], pose, U_base)
                for i in range(k):
                    asked[i] = -(settings[FREQUENCY] ** 2) * parts[TRUTH, i]
                    for c in range(6):
                        asked[i] -= 2.0 * settings[RATIO] * settings[FREQUENCY] * U_base[c, i] * v[c]
                cut = servo_torque(own_parent, own_tree, own_q, own_v, wanted, U_base, asked, limits, own_work, torque)
            else:
                cut = driven_torque(
                    own_parent,
                    own_tree,
                    own_q,
                    own_v,
                    wanted,
                    braking,
                    U,
                    own_axes,
                    pose,
                    limits,
                    own_work,
                    torque,
                )
            for j in range(n):
                reference[j] += span * command[j]
                if cut:
                    reference[j] += span * (1.0 - share[0]) * (own_v[6 + j] - command[j])
                drives[AT_LIMIT, j] = 1.0 if cut and abs(torque[j]) >= AT * limits[j] else 0.0
        if cut:
            totals[SATURATED] += h
            for j in range(n):
                drives[LIMITED_TIME, j] += h * drives[AT_LIMIT, j]
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
                u[c] = ahead * w[c] if stage > 0 else 0.0
            solved = motion_rates(
                parent,
                tree,
                joints,
                driven,
                free,
                given,
                torque,
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
            if k > 0:
                rows_in_base(U, axes, work[max(axes, 0)], R, U_base)
                for i in range(k):
                    for c in range(6):
                        parts[TRUTH, i] += weight * U_base[c, i] * v_stage[c]
            rotation_vector_rate(u, v_stage[3:6], w)
            for r in range(3):
                p_dot[r] = R[3 * r] * v_stage[0] + R[3 * r + 1] * v_stage[1] + R[3 * r + 2] * v_stage[2]
                sum_u[r] += weight * w[r]
                sum_p[r] += weight * p_dot[r]
                flows[r] += weight * power[r]
            for j in range(n):
                drives[LARGEST, j] = max(drives[LARGEST, j], abs(torque[j]))
            for i in range(6 + N):
                change[i] = v_stage[i]
                sum_v[i] += weight * slopes[stage, i]
            for i in range(N):
                sum_q[i] += weight * v_stage[6 + i]
            for c in range(6):
                moved[c] = (moved[c] if stage > 0 else 0.0) + weight * v_stage[c]
        for c in range(6):
            totals[TWIST + c] += moved[c]
        for c in range(3):
            turning[0, c] += moved[3 + c]
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
        if k > 0 and ((step + 1) % per_piece == 0 or step + 1 == int(settings[STEPS])):
            span = h * (step % per_piece + 1)
            end_piece(driven, q, v, piece)
            turning[2] = v[3:6]
            if settings[DIFFERS] > 0.0:
                start, end = piece[0:2], piece[2:4]
                model = parts[MODEL]
                add_motion_of_path(
                    own_parent, own_tree, U, settings, start, end, span, R_piece, turning, own_work, model
                )
            else:
                parts[MODEL] = parts[TRUTH]
            plan_piece(command, h * (step + 1) - span, h * (step + 1), piece)
            start, end = piece[0:2], piece[2:4]
            add_motion_of_path(
                own_parent, own_tree, U, settings, start, end, span, R_piece, turning, own_work, parts[PLAN]
            )
    if prescribed:
        for j in range(n):
            reference[j] = q[driven[j]]
    return OK
