"""The compiled momentum algebra for many configurations: LANES of them go through each operation together.

Every number of the algebra is a run of LANES values, one a configuration, and every operation a loop over them that
the compiler turns into vector instructions. In a row of a scratch array `x[c * LANES + lane]` is number c of a lane.

Everything stands in the axes and about the origin of the base frame. The joint axis is the z axis of its joint's
frame: `constants_of` turns the frames so.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ssm_decouple.compiled import compiled, inlined, unlocked

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]

LANES = 32  # loops of less than 16 are not vectorised where arrays might overlap

# The columns of `table`, one row a body, the base first.
ROTATION = 0  # 9: of the joint's frame at zero in that of the body that holds it, by rows
TRANSLATION = 9  # 3
SLIDES = 12  # 1.0 for a prismatic joint
CARRIES = 13  # 1.0 if the joint moves the end-effector
MASS = 14
CARRIED = 15  # mass of the body and of all that it carries
CENTRE = 16  # 3: centre of mass in the joint's frame
SECOND = 19  # 6: second moments of mass about it: xx, xy, xz, yy, yz, zz
TABLE_SIZE = 25

# A body in `frames`, a run each.
AXES = 0  # 9: rotation to base axes, by rows
ORIGIN = 9  # 3
FRAME_SIZE = 12

# A body in `whole`: what it and all that it carries add up to.
MOMENT = 0  # 3: mass times centre
SPREAD = 3  # 6: second moments about the base origin
WHOLE_SIZE = 9

# A joint in `columns`: per unit of its rate.
LINEAR = 0  # 3: velocity of the base origin at zero momentum
ANGULAR = 3  # 3: angular velocity of the base; with LINEAR a column of J_base
TOOL = 6  # 3: velocity of the end-effector, a column of J_gt
COUPLING = 9  # 3: angular momentum about the centre of mass on a held base, a column of H_wq
COLUMN_SIZE = 12

# What is there once in `totals`.
CENTRE_OF_MASS = 0  # 3
POSITION = 3  # 3: end-effector
INERTIA = 6  # 6: H_ww: xx, xy, xz, yy, yz, zz
INVERSE = 12  # 6: its inverse
BAD = 18  # 0.0, or NaN where the joints are not finite or H_ww is singular
TOTALS_SIZE = 19

# A row of `values`: J_base (6 n), J_gt (3 n), end-effector position (3), H_wq (3 n), H_ww (9), centre of mass (3).
SINGLES = 15  # numbers in it that are not one a joint

EPS = 2.220446049250313e-16
NOISE = 16.0 * EPS  # as in control/kernel.py: a row of J_sub below it constrains nothing

TINY = 1e-300
ROUNDING = 64.0 * EPS  # as in momentum/metrics.py: a semi-axis below this share of the largest is zero
SWEEPS = 7  # of plane rotations: 3 x 3 matrices need four or five


@compiled
def turn(joints: Floats, table: Floats, turns: Floats) -> None:
    """Fill sine, cosine and shift of each joint (n, 3) from its position (n,): it turns or it slides."""
    for j in range(table.shape[0] - 1):
        q, out, slides = joints[j], turns[j], table[1 + j, SLIDES] != 0.0
        for lane in range(LANES):
            angle = 0.0 if slides else q[lane]
            out[lane], out[LANES + lane], out[2 * LANES + lane] = np.sin(angle), np.cos(angle), q[lane] - angle


@compiled
def place_bodies(parents: Ints, table: Floats, turns: Floats, frames: Floats, whole: Floats) -> None:
    """Fill `frames`, and `whole` with what each body is by itself."""
    base = frames[0]
    for c in range(FRAME_SIZE):
        one = 1.0 if c in (0, 4, 8) else 0.0
        for lane in range(LANES):
            base[c * LANES + lane] = one
    place_mass(table[0], base, whole[0])
    for i in range(1, table.shape[0]):
        place_frame(table[i], turns[i - 1], frames[parents[i - 1]], frames[i])
        place_mass(table[i], frames[i], whole[i])


@compiled
def place_frame(own: Floats, turns: Floats, up: Floats, me: Floats) -> None:
    """Fill one body's frame from that of the body that holds it."""
    a, b, c, d, e, f, g, h, i = own[0], own[1], own[2], own[3], own[4], own[5], own[6], own[7], own[8]
    x, y, z = own[TRANSLATION], own[TRANSLATION + 1], own[TRANSLATION + 2]
    for r in range(3):
        row, place = 3 * r * LANES, (ORIGIN + r) * LANES
        for lane in range(LANES):
            u, v, w = up[row + lane], up[row + LANES + lane], up[row + 2 * LANES + lane]
            sine, cosine, shift = turns[lane], turns[LANES + lane], turns[2 * LANES + lane]
            first, second, third = u * a + v * d + w * g, u * b + v * e + w * h, u * c + v * f + w * i
            me[row + lane] = cosine * first + sine * second
            me[row + LANES + lane] = cosine * second - sine * first
            me[row + 2 * LANES + lane] = third
            me[place + lane] = up[place + lane] + u * x + v * y + w * z + shift * third


@compiled
def place_mass(own: Floats, me: Floats, out: Floats) -> None:
    """Fill moment and second moments of one body about the base origin."""
    m, x, y, z = own[MASS], own[CENTRE], own[CENTRE + 1], own[CENTRE + 2]
    xx, xy, xz = own[SECOND], own[SECOND + 1], own[SECOND + 2]
    yy, yz, zz = own[SECOND + 3], own[SECOND + 4], own[SECOND + 5]
    for lane in range(LANES):
        a, b, c = me[lane], me[LANES + lane], me[2 * LANES + lane]
        d, e, f = me[3 * LANES + lane], me[4 * LANES + lane], me[5 * LANES + lane]
        g, h, i = me[6 * LANES + lane], me[7 * LANES + lane], me[8 * LANES + lane]
        px = me[9 * LANES + lane] + a * x + b * y + c * z
        py = me[10 * LANES + lane] + d * x + e * y + f * z
        pz = me[11 * LANES + lane] + g * x + h * y + i * z
        mx, my, mz = m * px, m * py, m * pz
        out[lane] = mx
        out[LANES + lane] = my
        out[2 * LANES + lane] = mz
        u, v, w = a * xx + b * xy + c * xz, a * xy + b * yy + c * yz, a * xz + b * yz + c * zz
        out[3 * LANES + lane] = u * a + v * b + w * c + mx * px
        out[4 * LANES + lane] = u * d + v * e + w * f + mx * py
        out[5 * LANES + lane] = u * g + v * h + w * i + mx * pz
        u, v, w = d * xx + e * xy + f * xz, d * xy + e * yy + f * yz, d * xz + e * yz + f * zz
        out[6 * LANES + lane] = u * d + v * e + w * f + my * py
        out[7 * LANES + lane] = u * g + v * h + w * i + my * pz
        u, v, w = g * xx + h * xy + i * xz, g * xy + h * yy + i * yz, g * xz + h * yz + i * zz
        out[8 * LANES + lane] = u * g + v * h + w * i + mz * pz


@compiled
def gather(parents: Ints, table: Floats, frames: Floats, whole: Floats, columns: Floats) -> None:
    """Add each body to the one that holds it, tips first; fill each joint's momentum per unit rate into `columns`.

    The momentum of all that the joint carries, the base held, about the base origin: linear in LINEAR, angular in
    ANGULAR.
    """
    for i in range(table.shape[0] - 1, 0, -1):
        me, up = whole[i], whole[parents[i - 1]]
        if table[i, SLIDES] != 0.0:
            momentum_of_slide(table[i, CARRIED], frames[i], me, columns[i - 1])
        else:
            momentum_of_turn(table[i, CARRIED], frames[i], me, columns[i - 1])
        for c in range(WHOLE_SIZE * LANES):
            up[c] += me[c]


@compiled
def momentum_of_slide(m: float, frame: Floats, me: Floats, out: Floats) -> None:
    """Fill the momentum of a body that moves along its z axis at 1 m/s."""
    for lane in range(LANES):
        x, y, z = frame[2 * LANES + lane], frame[5 * LANES + lane], frame[8 * LANES + lane]
        hx, hy, hz = me[lane], me[LANES + lane], me[2 * LANES + lane]
        out[lane] = m * x
        out[LANES + lane] = m * y
        out[2 * LANES + lane] = m * z
        out[3 * LANES + lane] = hy * z - hz * y
        out[4 * LANES + lane] = hz * x - hx * z
        out[5 * LANES + lane] = hx * y - hy * x


@compiled
def momentum_of_turn(m: float, frame: Floats, me: Floats, out: Floats) -> None:
    """Fill the momentum of a body that turns about its z axis at 1 rad/s."""
    for lane in range(LANES):
        x, y, z = frame[2 * LANES + lane], frame[5 * LANES + lane], frame[8 * LANES + lane]
        px, py, pz = frame[9 * LANES + lane], frame[10 * LANES + lane], frame[11 * LANES + lane]
        hx, hy, hz = me[lane], me[LANES + lane], me[2 * LANES + lane]
        xx, xy, xz = me[3 * LANES + lane], me[4 * LANES + lane], me[5 * LANES + lane]
        yy, yz, zz = me[6 * LANES + lane], me[7 * LANES + lane], me[8 * LANES + lane]
        rx, ry, rz = hx - m * px, hy - m * py, hz - m * pz
        out[lane] = y * rz - z * ry
        out[LANES + lane] = z * rx - x * rz
        out[2 * LANES + lane] = x * ry - y * rx
        size, along = xx + yy + zz - (hx * px + hy * py + hz * pz), hx * x + hy * y + hz * z
        out[3 * LANES + lane] = size * x - (xx * x + xy * y + xz * z) + along * px
        out[4 * LANES + lane] = size * y - (xy * x + yy * y + yz * z) + along * py
        out[5 * LANES + lane] = size * z - (xz * x + yz * y + zz * z) + along * pz


@compiled
def close(mass: float, tool: Floats, held: Floats, whole: Floats, totals: Floats) -> None:
    """Fill `totals`, where BAD is set already; `held` is the frame of the body that holds the end-effector."""
    tx, ty, tz = tool[1], tool[2], tool[3]
    share = 1.0 / mass
    for lane in range(LANES):
        hx, hy, hz = whole[lane], whole[LANES + lane], whole[2 * LANES + lane]
        x, y, z = share * hx, share * hy, share * hz
        xx, yy, zz = (
            whole[3 * LANES + lane] - hx * x,
            whole[6 * LANES + lane] - hy * y,
            whole[8 * LANES + lane] - hz * z,
        )
        a, e, i = yy + zz, xx + zz, xx + yy
        b, c = hx * y - whole[4 * LANES + lane], hx * z - whole[5 * LANES + lane]
        f = hy * z - whole[7 * LANES + lane]
        bad = totals[BAD * LANES + lane]
        totals[lane] = x + bad
        totals[LANES + lane] = y + bad
        totals[2 * LANES + lane] = z + bad
        for r in range(3):
            place = held[(ORIGIN + r) * LANES + lane] + held[3 * r * LANES + lane] * tx
            place += held[(3 * r + 1) * LANES + lane] * ty + held[(3 * r + 2) * LANES + lane] * tz
            totals[(POSITION + r) * LANES + lane] = place + bad
        c0, c1, c2 = e * i - f * f, c * f - b * i, b * f - c * e
        determinant = a * c0 + b * c1 + c * c2
        square = a * a + e * e + i * i + 2.0 * (b * b + c * c + f * f)
        bad += 0.0 if determinant > NOISE * square * np.sqrt(square) else np.nan
        totals[BAD * LANES + lane] = bad
        totals[6 * LANES + lane] = a + bad
        totals[7 * LANES + lane] = b + bad
        totals[8 * LANES + lane] = c + bad
        totals[9 * LANES + lane] = e + bad
        totals[10 * LANES + lane] = f + bad
        totals[11 * LANES + lane] = i + bad
        s = 1.0 / determinant + bad
        totals[12 * LANES + lane] = s * c0
        totals[13 * LANES + lane] = s * c1
        totals[14 * LANES + lane] = s * c2
        totals[15 * LANES + lane] = s * (a * i - c * c)
        totals[16 * LANES + lane] = s * (b * c - a * f)
        totals[17 * LANES + lane] = s * (a * e - b * b)


@compiled
def free_base(mass: float, own: Floats, frame: Floats, totals: Floats, out: Floats) -> None:
    """Turn one joint's momentum into its column of H_wq, J_base and J_gt: the base takes the opposite."""
    share, slides, carries = 1.0 / mass, own[SLIDES], own[CARRIES]
    turns = carries * (1.0 - slides)
    slides *= carries
    for lane in range(LANES):
        x, y, z = totals[lane], totals[LANES + lane], totals[2 * LANES + lane]
        ex, ey, ez = totals[3 * LANES + lane], totals[4 * LANES + lane], totals[5 * LANES + lane]
        bx, by, bz = out[lane], out[LANES + lane], out[2 * LANES + lane]
        hx = out[3 * LANES + lane] - (y * bz - z * by)
        hy = out[4 * LANES + lane] - (z * bx - x * bz)
        hz = out[5 * LANES + lane] - (x * by - y * bx)
        out[9 * LANES + lane] = hx
        out[10 * LANES + lane] = hy
        out[11 * LANES + lane] = hz
        wx = -(totals[12 * LANES + lane] * hx + totals[13 * LANES + lane] * hy + totals[14 * LANES + lane] * hz)
        wy = -(totals[13 * LANES + lane] * hx + totals[15 * LANES + lane] * hy + totals[16 * LANES + lane] * hz)
        wz = -(totals[14 * LANES + lane] * hx + totals[16 * LANES + lane] * hy + totals[17 * LANES + lane] * hz)
        vx = -share * bx - (wy * z - wz * y)
        vy = -share * by - (wz * x - wx * z)
        vz = -share * bz - (wx * y - wy * x)
        out[lane] = vx
        out[LANES + lane] = vy
        out[2 * LANES + lane] = vz
        out[3 * LANES + lane] = wx
        out[4 * LANES + lane] = wy
        out[5 * LANES + lane] = wz
        ax, ay, az = frame[2 * LANES + lane], frame[5 * LANES + lane], frame[8 * LANES + lane]
        dx, dy, dz = ex - frame[9 * LANES + lane], ey - frame[10 * LANES + lane], ez - frame[11 * LANES + lane]
        out[6 * LANES + lane] = vx + wy * ez - wz * ey + turns * (ay * dz - az * dy) + slides * ax
        out[7 * LANES + lane] = vy + wz * ex - wx * ez + turns * (az * dx - ax * dz) + slides * ay
        out[8 * LANES + lane] = vz + wx * ey - wy * ex + turns * (ax * dy - ay * dx) + slides * az


@compiled
def noise_of(first: int, columns: Floats, totals: Floats, noise: Floats) -> None:
    """Fill the square of the length below which a row of J_sub is rounding: of rows `first` to 6 of J_base."""
    for lane in range(LANES):
        noise[lane] = 0.0
    for j in range(columns.shape[0]):
        own = columns[j]
        for b in range(first, 6):
            for lane in range(LANES):
                noise[lane] += own[b * LANES + lane] * own[b * LANES + lane]
    for lane in range(LANES):
        x, y, z = totals[3 * LANES + lane], totals[4 * LANES + lane], totals[5 * LANES + lane]
        far = NOISE * (1.0 + abs(x) + abs(y) + abs(z))
        noise[lane] *= far * far


@compiled
def lay_rows(U: Floats, k: int, first: int, columns: Floats, rows: Floats) -> None:
    """Fill rows (k + 3, n) with [J_sub; J_gt], J_sub = U^T J_base; U (6, 6) has zeros in its rows before `first`."""
    for j in range(columns.shape[0]):
        own, at = columns[j], j * LANES
        for i in range(k):
            new = rows[i]
            for lane in range(LANES):
                new[at + lane] = 0.0
            for b in range(first, 6):
                u, place = U[b, i], b * LANES
                if u != 0.0:
                    for lane in range(LANES):
                        new[at + lane] += u * own[place + lane]
        for r in range(3):
            new, place = rows[k + r], (TOOL + r) * LANES
            for lane in range(LANES):
                new[at + lane] = own[place + lane]


@compiled
def square_of(row: Floats, n: int, out: Floats) -> None:
    """Fill the square of a row's length."""
    # As many as there are LANES: the compiler must not know it, or it unrolls where it could vectorise.
    many = out.shape[0]
    for lane in range(many):
        out[lane] = 0.0
    for j in range(n):
        for lane in range(many):
            out[lane] += row[j * many + lane] * row[j * many + lane]


@compiled
def take_out(unit: Floats, row: Floats, n: int, product: Floats) -> None:
    """Take the part along a unit row out of a row; fill its length."""
    many = product.shape[0]
    for lane in range(many):
        product[lane] = 0.0
    for j in range(n):
        for lane in range(many):
            product[lane] += unit[j * many + lane] * row[j * many + lane]
    for j in range(n):
        for lane in range(many):
            row[j * many + lane] -= product[lane] * unit[j * many + lane]


@compiled
def order_rows(n: int, t: int, k: int, rows: Floats, here: Floats, there: Floats) -> None:
    """Bring the longest of the rows t to k to place t, lane by lane, and the square of its length to `here`."""
    mine = rows[t]
    square_of(mine, n, here)
    for i in range(t + 1, k):
        other = rows[i]
        square_of(other, n, there)
        for j in range(n):
            for lane in range(LANES):
                x, y = mine[j * LANES + lane], other[j * LANES + lane]
                longer = there[lane] > here[lane]
                mine[j * LANES + lane] = y if longer else x
                other[j * LANES + lane] = x if longer else y
        for lane in range(LANES):
            here[lane] = max(here[lane], there[lane])


@compiled
def scale_row(row: Floats, n: int, scale: Floats) -> None:
    """Multiply a row by a number a lane."""
    many = scale.shape[0]
    for j in range(n):
        for lane in range(many):
            row[j * many + lane] *= scale[lane]


@compiled
def factor(n: int, k: int, rows: Floats, noise: Floats, lengths: Floats, L: Floats) -> None:
    """Fill L (6,), the lower triangle, by rows, that J_gt is past J_sub: its singular values are those of J_gt N_sub.

    Gram and Schmidt on `rows` (k + 3, n), one row after the other from all that follow: the triangle is as accurate as
    that of reflections. A row of J_sub below the noise is left out. `lengths` (3,) is scratch.
    """
    scale, other, left = lengths[0], lengths[1], lengths[2]
    for lane in range(LANES):
        left[lane] = n
    for t in range(k):
        order_rows(n, t, k, rows, scale, other)
        for lane in range(LANES):
            kept = scale[lane] > noise[lane] and left[lane] > 0.0
            scale[lane] = 1.0 / np.sqrt(scale[lane]) if kept else 0.0
            left[lane] -= 1.0 if kept else 0.0
        scale_row(rows[t], n, scale)
        for i in range(t + 1, k + 3):
            take_out(rows[t], rows[i], n, other)
    for t in range(3):
        unit, diagonal = rows[k + t], L[(t * (t + 3)) // 2]
        square_of(unit, n, scale)
        for lane in range(LANES):
            length = np.sqrt(scale[lane]) if left[lane] > t else 0.0 * scale[lane]
            diagonal[lane] = length
            scale[lane] = 1.0 / length if length > 0.0 else 0.0
        scale_row(unit, n, scale)
        for i in range(t + 1, 3):
            take_out(unit, rows[k + i], n, L[(i * (i + 1)) // 2 + t])


@inlined
def largest_eigenvalue(xx: float, xy: float, xz: float, yy: float, yz: float, zz: float) -> float:
    """Return the largest eigenvalue of a symmetric matrix with none below zero.

    It is scaled to trace 1, and the cubic's angle gives it. Of that both cosine and sine are found without
    cancellation, the sine from the part of B^2 that stands across I and B, B being the matrix less its mean.
    """
    trace = xx + yy + zz
    scale = 1.0 / (trace + TINY)
    xx, yy, zz = scale * xx - 1.0 / 3.0, scale * yy - 1.0 / 3.0, scale * zz - 1.0 / 3.0
    xy, xz, yz = scale * xy, scale * xz, scale * yz
    xxs, yys, zzs = xx * xx + xy * xy + xz * xz, xy * xy + yy * yy + yz * yz, xz * xz + yz * yz + zz * zz
    square = xxs + yys + zzs
    half = 0.5 * (xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz))
    mean, along = square / 3.0, 6.0 * half / (square + TINY)
    k0, k1, k2 = xxs - mean - along * xx, yys - mean - along * yy, zzs - mean - along * zz
    k3 = xx * xy + xy * yy + xz * yz - along * xy
    k4 = xx * xz + xy * yz + xz * zz - along * xz
    k5 = xy * xz + yy * yz + yz * zz - along * yz
    sine = np.sqrt(square * (k0 * k0 + k1 * k1 + k2 * k2 + 2.0 * (k3 * k3 + k4 * k4 + k5 * k5))) / 6.0
    norm = 1.0 / (np.sqrt(half * half + sine * sine) + TINY)
    C, S = norm * half, norm * sine
    # The cube root of C + i S, by Newton's method from between a half and a quarter of the angle.
    u, v = np.sqrt(0.5 + 0.5 * C), np.sqrt(max(0.5 - 0.5 * C, 0.0))
    x = (u + 2.0 * np.sqrt(0.5 + 0.5 * u)) / 3.0
    y = (v + 2.0 * np.sqrt(max(0.5 - 0.5 * u, 0.0))) / 3.0
    for _ in range(4):
        p, q = x * x - y * y, -2.0 * x * y
        weight = 1.0 / (3.0 * (p * p + q * q))
        x, y = 2.0 / 3.0 * x + weight * (C * p - S * q), 2.0 / 3.0 * y + weight * (C * q + S * p)
    return trace * (1.0 / 3.0 + 2.0 * np.sqrt(square / 6.0) * x)


@compiled
def smallest_of(L: Floats, totals: Floats, smallest: Floats, volume: Floats) -> None:
    """Fill the smallest singular value of a lower triangle L (6,), and the product of all three.

    The product is that of the diagonal, the two larger ones' is the largest singular value of the cofactors.
    """
    for lane in range(LANES):
        a, b, c, d, e, f = L[0, lane], L[1, lane], L[2, lane], L[3, lane], L[4, lane], L[5, lane]
        product = a * c * f
        cf, bf, across = c * f, b * f, b * e - c * d
        af, ae, ac = a * f, a * e, a * c
        largest = np.sqrt(
            largest_eigenvalue(
                cf * cf + bf * bf + across * across,
                -(bf * af + across * ae),
                across * ac,
                af * af + ae * ae,
                -ae * ac,
                ac * ac,
            )
        )
        bad = totals[BAD * LANES + lane]
        smallest[lane] = (product / largest if largest > 0.0 else 0.0) + bad
        volume[lane] = product + bad


@compiled
def turn_columns(B: Floats, V: Floats) -> None:
    """Turn the columns of B (9,) until they are square to each other, V, the identity at first, with them.

    Column c is numbers 3 c to 3 c + 2. One-sided Jacobi, as in the law's kernel.
    """
    for i in range(9):
        for lane in range(LANES):
            V[i, lane] = 1.0 if i % 4 == 0 else 0.0
    for _ in range(SWEEPS):
        for a, b in ((0, 3), (0, 6), (3, 6)):
            for lane in range(LANES):
                aa, bb, ab = 0.0, 0.0, 0.0
                for r in range(3):
                    aa += B[a + r, lane] * B[a + r, lane]
                    bb += B[b + r, lane] * B[b + r, lane]
                    ab += B[a + r, lane] * B[b + r, lane]
                needed = ab * ab > EPS * EPS * aa * bb
                zeta = (bb - aa) / (2.0 * ab if needed else 1.0)
                t = 1.0 / (abs(zeta) + np.sqrt(1.0 + zeta * zeta))
                t = (-t if zeta < 0.0 else t) if needed else 0.0
                cosine = 1.0 / np.sqrt(1.0 + t * t)
                sine = cosine * t
                for r in range(3):
                    x, y = B[a + r, lane], B[b + r, lane]
                    B[a + r, lane], B[b + r, lane] = cosine * x - sine * y, sine * x + cosine * y
                    x, y = V[a + r, lane], V[b + r, lane]
                    V[a + r, lane], V[b + r, lane] = cosine * x - sine * y, sine * x + cosine * y


@compiled
def couple(
    n: int, k: int, columns: Floats, rows: Floats, L: Floats, totals: Floats, scratch: Floats, factor: Floats
) -> None:
    """Fill the largest singular value of J_rc (J_gt N_sub)^+ from what `factor` made of rows (k + 3, n) and L (6,).

    With L V = U S it is that of J_rc units^T V S^-1. Singular values that are rounding are left out. `scratch`
    (29, LANES) is overwritten.
    """
    B, V, turned, other, square = scratch[:9], scratch[9:18], scratch[18:27], scratch[27], scratch[28]
    for t in range(3):
        for i in range(k):  # the triangle bears what rounding has left along J_sub, the protected rate does not
            take_out(rows[i], rows[k + t], n, other)
    for lane in range(LANES):
        square[lane] = 0.0
        for i in range(9):
            B[i, lane], turned[i, lane] = 0.0, 0.0
    for j in range(n):
        own = columns[j]
        for r in range(3):
            for lane in range(LANES):
                rate = own[(ANGULAR + r) * LANES + lane]
                square[lane] += rate * rate
                for t in range(3):
                    turned[3 * r + t, lane] += rate * rows[k + t, j * LANES + lane]
    for r in range(3):
        for c in range(r + 1):
            for lane in range(LANES):
                B[3 * c + r, lane] = L[(r * (r + 1)) // 2 + c, lane]
    turn_columns(B, V)
    for lane in range(LANES):
        size, largest = 0.0, 0.0
        for c in range(3):
            length = B[3 * c, lane] ** 2 + B[3 * c + 1, lane] ** 2 + B[3 * c + 2, lane] ** 2
            largest = max(largest, length)
        for i in range(9):
            size += turned[i, lane] ** 2
        for c in range(3):
            length = B[3 * c, lane] ** 2 + B[3 * c + 1, lane] ** 2 + B[3 * c + 2, lane] ** 2
            scale = 1.0 / np.sqrt(length) if length > ROUNDING * ROUNDING * largest else 0.0
            for r in range(3):
                B[3 * c + r, lane] = 0.0
                for t in range(3):
                    B[3 * c + r, lane] += scale * turned[3 * r + t, lane] * V[3 * c + t, lane]
        if size <= ROUNDING * ROUNDING * square[lane]:
            for i in range(9):
                B[i, lane] = 0.0
    for lane in range(LANES):
        a, b, c, d, e, f = B[0, lane], B[1, lane], B[2, lane], B[3, lane], B[4, lane], B[5, lane]
        g, h, i = B[6, lane], B[7, lane], B[8, lane]
        factor[lane] = totals[BAD * LANES + lane] + np.sqrt(
            largest_eigenvalue(
                a * a + b * b + c * c,
                a * d + b * e + c * f,
                a * g + b * h + c * i,
                d * d + e * e + f * f,
                d * g + e * h + f * i,
                g * g + h * h + i * i,
            )
        )


@compiled
def write_values(start: int, columns: Floats, totals: Floats, values: Floats) -> None:
    """Write LANES rows of `values` from `start` on, as many as there are."""
    n = columns.shape[0]
    for lane in range(min(LANES, values.shape[0] - start)):
        row = values[start + lane]
        for j in range(n):
            own = columns[j]
            for b in range(9):
                row[b * n + j] = own[b * LANES + lane]
            for b in range(3):
                row[9 * n + 3 + b * n + j] = own[(COUPLING + b) * LANES + lane]
        inertia = row[12 * n + 3 :]
        for r in range(3):
            row[9 * n + r] = totals[(POSITION + r) * LANES + lane]
            row[12 * n + 12 + r] = totals[(CENTRE_OF_MASS + r) * LANES + lane]
            for c in range(3):
                place = r + c + (1 if r > 0 and c > 0 else 0)  # of row r, column c in xx, xy, xz, yy, yz, zz
                inertia[3 * r + c] = totals[(INERTIA + place) * LANES + lane]


@unlocked
def evaluate(
    parents: Ints,
    table: Floats,
    tool: Floats,
    joints: Floats,
    directions: Floats,
    counts: Ints,
    firsts: Ints,
    values: Floats,
    smallest: Floats,
    volumes: Floats,
    factors: Floats,
) -> None:
    """Compute the momentum matrices of many configurations, and what each protection leaves of J_gt.

    Args:
        parents: The body that holds each joint (n,).
        table: Constants (n + 1, TABLE_SIZE).
        tool: Which body holds the end-effector, and where, in its joint's frame (4,).
        joints: Joint positions (rows, n), rad or m.
        directions: Protected directions of the base twist, base axes, as first columns (protections, 6, 6).
        counts: How many they are (protections,).
        firsts: The first of their rows that is not zero, 0 or 3 (protections,).
        values: (rows, 12 n + SINGLES), overwritten; of no rows if not wanted.
        smallest: Smallest singular value of J_gt N_sub (rows, protections), likewise.
        volumes: Product of its singular values (rows, protections), likewise.
        factors: Largest singular value of J_rc (J_gt N_sub)^+ (rows, protections), likewise.
    """
    n, mass, holder = joints.shape[1], table[0, CARRIED], int(tool[0])
    q, turns = np.empty((n, LANES)), np.empty((n, 3 * LANES))
    frames, whole = np.empty((n + 1, FRAME_SIZE * LANES)), np.empty((n + 1, WHOLE_SIZE * LANES))
    columns, totals = np.empty((n, COLUMN_SIZE * LANES)), np.empty(TOTALS_SIZE * LANES)
    rows, small = np.empty((9, n * LANES)), np.empty((12, LANES))
    noise, least, volume, lengths, L = small[0], small[1], small[2], small[3:6], small[6:]
    scratch, largest = np.empty((29, LANES)), np.empty(LANES)
    for start in range(0, joints.shape[0], LANES):
        there = min(LANES, joints.shape[0] - start)
        for lane in range(LANES):
            bad, row = 0.0, joints[start + min(lane, there - 1)]
            for j in range(n):
                q[j, lane] = row[j]
                bad += 0.0 * row[j]
            totals[BAD * LANES + lane] = bad
        turn(q, table, turns)
        place_bodies(parents, table, turns, frames, whole)
        gather(parents, table, frames, whole, columns)
        close(mass, tool, frames[holder], whole[0], totals)
        for j in range(n):
            free_base(mass, table[1 + j], frames[j + 1], totals, columns[j])
        if values.shape[0] > 0:
            write_values(start, columns, totals, values)
        for p in range(firsts.shape[0]):
            k, first = counts[p], firsts[p]
            if k > 0:
                noise_of(first, columns, totals, noise)
            lay_rows(directions[p], k, first, columns, rows)
            factor(n, k, rows, noise, lengths, L)
            if smallest.shape[0] > 0:
                smallest_of(L, totals, least, volume)
                for lane in range(there):
                    smallest[start + lane, p] = least[lane]
                    if volumes.shape[0] > 0:
                        volumes[start + lane, p] = volume[lane]
            if factors.shape[0] > 0:
                couple(n, k, columns, rows, L, totals, scratch, largest)
                for lane in range(there):
                    factors[start + lane, p] = largest[lane]
