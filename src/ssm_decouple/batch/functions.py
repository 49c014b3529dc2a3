"""The batch algebra as pure functions of JAX arrays: the axes of components come first, those of the batch last.

Everything stands in the axes and about the origin of the base frame, as in `lanes`, whose constants and thresholds
these are. A robot's constants are compiled in; those of a law are arguments.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from numpy.typing import NDArray

from ssm_decouple.batch import lanes, rows
from ssm_decouple.control import kernel
from ssm_decouple.momentum import metrics

Floats = NDArray[np.float64]
Parts = tuple[Array, ...]  # the components of a vector, or xx, xy, xz, yy, yz and zz of a symmetric matrix
Vector = Sequence[Array] | Array

SWEEPS = 7  # of plane rotations: 3 x 3 matrices need four or five
LOST = 1e-16  # the square of a singular value below this share of the largest's is none


class Arm(NamedTuple):
    """A robot's constants, as `constants_of` returns them."""

    parents: NDArray[np.int64]
    table: Floats
    tool: Floats


class Matrices(NamedTuple):
    """Momentum matrices (rows, n, ..) and the like, base axes; `batch.Matrices` says what they are."""

    J_base: Array
    J_gt: Array
    end_effector_position: Array
    H_wq: Array
    H_ww: Array
    centre_of_mass: Array


def matrices(arm: Arm, joints: Array) -> Matrices:
    """Return the momentum matrices at joint positions (n, ..); of NaN where these are not finite.

    From joint to joint it goes by loops of the device's own: else XLA would fuse each joint's numbers into all that
    come after, and compute them over and over.
    """
    frames, whole = _placed(arm, joints)
    whole, momentum = _gathered(arm, frames, whole)
    mass = float(arm.table[0, lanes.CARRIED])
    centre, inertia = _totals(whole, mass)
    a, b, c, e, f, i = inertia
    square = a * a + e * e + i * i + 2.0 * (b * b + c * c + f * f)
    cofactors = _cofactors(inertia)
    determinant = a * cofactors[0] + b * cofactors[1] + c * cofactors[2]
    right = jnp.isfinite(jnp.sum(joints, axis=0)) & (determinant > lanes.NOISE * square * jnp.sqrt(square))
    bad = lax.stop_gradient(jnp.where(right, 0.0, jnp.nan))
    inverse = [part / determinant for part in cofactors]
    held = frames[int(arm.tool[0])]
    tip = tuple(held[9:] + arm.tool[1] * held[:3] + arm.tool[2] * held[3:6] + arm.tool[3] * held[6:9])

    def column(_: None, joint: Any) -> tuple[None, Array]:
        own, frame, moving = joint
        linear, angular = moving[:3], moving[3:]
        z, p = frame[6:9], frame[9:]
        coupling = _minus(angular, _cross(centre, linear))
        w = tuple(-part for part in _times(inverse, coupling))
        v = _minus([part * (-1.0 / mass) for part in linear], _cross(w, centre))
        turns, slides = own[lanes.CARRIES] * (1.0 - own[lanes.SLIDES]), own[lanes.CARRIES] * own[lanes.SLIDES]
        moved, swept = _cross(w, tip), _cross(z, _minus(tip, p))
        tool = [v[r] + moved[r] + turns * swept[r] + slides * z[r] for r in range(3)]
        return None, jnp.stack([*v, *w, *tool, *coupling]) + bad

    _, columns = lax.scan(column, None, (arm.table[1:], frames[1:], momentum))
    rows_ = jnp.moveaxis(columns, 0, 1)
    H = jnp.stack([jnp.stack([a, b, c]), jnp.stack([b, e, f]), jnp.stack([c, f, i])])
    return Matrices(rows_[:6], rows_[6:9], jnp.stack(tip) + bad, rows_[9:], H + bad, jnp.stack(centre) + bad)


def _beside(table: Floats, axes: int) -> Floats:
    """Return a table with axes of length one behind it, to stand beside batches."""
    return table.reshape(table.shape + (1,) * axes)


def _cross(a: Vector, b: Vector) -> Parts:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def _dot(a: Iterable[Array], b: Iterable[Array]) -> Array:
    first, *others = (x * y for x, y in zip(a, b, strict=True))
    return sum(others, first)


def _minus(a: Iterable[Array], b: Iterable[Array]) -> Parts:
    return tuple(x - y for x, y in zip(a, b, strict=True))


def _times(S: Vector, x: Vector) -> Parts:
    """Return the product of a symmetric matrix with a vector."""
    return _dot((S[0], S[1], S[2]), x), _dot((S[1], S[3], S[4]), x), _dot((S[2], S[4], S[5]), x)


def _cofactors(S: Sequence[Array]) -> Parts:
    a, b, c, e, f, i = S
    return e * i - f * f, c * f - b * i, b * f - c * e, a * i - c * c, b * c - a * f, a * e - b * b


def _placed(arm: Arm, joints: Array) -> tuple[Array, Array]:
    """Return the frames of all bodies (n + 1, 12, ..), and what each is by itself (n + 1, 9, ..).

    A frame is its axes x, y and z and its origin. A body is mass times centre, and second moments about the base
    origin.
    """
    batch, tiled = joints.shape[1:], (1,) * (joints.ndim - 1)
    base = np.concatenate([np.eye(3).ravel(), np.zeros(3)])
    frames = jnp.zeros((len(arm.table), 12, *batch)).at[0].set(base.reshape(12, *tiled))
    turned = jnp.sin(joints), jnp.cos(joints)

    def place(frames: Array, joint: Any) -> tuple[Array, Array]:
        body, parent, own, q, sine, cosine = joint
        up = lax.dynamic_index_in_dim(frames, parent, keepdims=False)
        X, Y, Z, P = up[:3], up[3:6], up[6:9], up[9:]
        x, y, z = (X * own[c] + Y * own[3 + c] + Z * own[6 + c] for c in range(3))
        sine, cosine = (1.0 - own[lanes.SLIDES]) * sine, own[lanes.SLIDES] + (1.0 - own[lanes.SLIDES]) * cosine
        shift = own[lanes.SLIDES] * q
        p = P + X * own[lanes.TRANSLATION] + Y * own[lanes.TRANSLATION + 1] + Z * own[lanes.TRANSLATION + 2] + shift * z
        frame = jnp.concatenate([cosine * x + sine * y, cosine * y - sine * x, z, p])
        return lax.dynamic_update_index_in_dim(frames, frame, body, 0), frame

    bodies = np.arange(1, len(arm.table))
    frames, _ = lax.scan(place, frames, (bodies, arm.parents, arm.table[1:], joints, *turned))
    _, whole = lax.scan(_mass_of, None, (arm.table, frames))
    return frames, whole


def _mass_of(_: None, body: Any) -> tuple[None, Array]:
    """Return mass times centre, and second moments about the base origin, of one body (9, ..)."""
    own, frame = body
    X, Y, Z, P = frame[:3], frame[3:6], frame[6:9], frame[9:]
    place = P + X * own[lanes.CENTRE] + Y * own[lanes.CENTRE + 1] + Z * own[lanes.CENTRE + 2]
    moment = own[lanes.MASS] * place
    xx, xy, xz, yy, yz, zz = (own[lanes.SECOND + i] for i in range(6))
    u, v, w = X * xx + Y * xy + Z * xz, X * xy + Y * yy + Z * yz, X * xz + Y * yz + Z * zz
    spread = [
        u[r] * X[c] + v[r] * Y[c] + w[r] * Z[c] + moment[r] * place[c] for r, c in zip(*np.triu_indices(3), strict=True)
    ]
    return None, jnp.stack([*moment, *spread])


def _gathered(arm: Arm, frames: Array, whole: Array) -> tuple[Array, Array]:
    """Add each body to the one that holds it, tips first; return what the base carries, and each joint's momentum.

    The momentum (n, 6, ..) is that of all that the joint carries at unit rate, about the base origin: linear, angular.
    """

    def gather(whole: Array, joint: Any) -> tuple[Array, Array]:
        body, parent, own, frame = joint
        me = lax.dynamic_index_in_dim(whole, body, keepdims=False)
        up = lax.dynamic_index_in_dim(whole, parent, keepdims=False)
        return lax.dynamic_update_index_in_dim(whole, up + me, parent, 0), _momentum(own, frame, me)

    bodies = np.arange(1, len(arm.table))
    whole, momentum = lax.scan(gather, whole, (bodies, arm.parents, arm.table[1:], frames[1:]), reverse=True)
    return whole[0], momentum


def _totals(whole: Array, mass: float) -> tuple[Parts, Parts]:
    """Return the centre of mass of the whole, and its inertia H_ww about that."""
    hx, hy, hz, *spread = whole
    x, y, z = hx / mass, hy / mass, hz / mass
    xx, yy, zz = spread[0] - hx * x, spread[3] - hy * y, spread[5] - hz * z
    return (x, y, z), (yy + zz, hx * y - spread[1], hx * z - spread[2], xx + zz, hy * z - spread[4], xx + yy)


def _momentum(own: Array, frame: Array, whole: Array) -> Array:
    """Return the momentum (6, ..) of what a joint carries, at unit rate."""
    z, p, moment, spread, mass = frame[6:9], frame[9:], whole[:3], whole[3:], own[lanes.CARRIED]
    slides = own[lanes.SLIDES]
    turned, pushed, swung = _cross(z, moment - mass * p), mass * z, _cross(moment, z)
    size, along = spread[0] + spread[3] + spread[5] - _dot(moment, p), _dot(moment, z)
    held = _times(spread, z)
    linear = [slides * pushed[r] + (1.0 - slides) * turned[r] for r in range(3)]
    angular = [slides * swung[r] + (1.0 - slides) * (size * z[r] - held[r] + along * p[r]) for r in range(3)]
    return jnp.stack([*linear, *angular])


class Basis(NamedTuple):
    """Orthonormal rows of the protected ones: Q = A J_sub, so that J_sub^+ = Q^T A.

    Attributes:
        Q: (k, n, ..); zero where a row constrains nothing.
        A: (k, k, ..).
        left: How many freedoms are left (..).
    """

    Q: Array
    A: Array
    left: Array


def basis_of(J_sub: Array, noise: Array) -> Basis:
    """Make J_sub (k, n, ..) orthonormal, the longest row first; rows whose square is below the noise are left out."""
    (k, n), batch = J_sub.shape[:2], J_sub.shape[2:]
    left = jnp.full(batch, float(n))
    identity = jnp.broadcast_to(_column(np.eye(k), len(batch)), (k, k, *batch))
    todo = jnp.concatenate([J_sub, identity], axis=1)  # what is done to J_sub is done to I
    done = todo[:0]
    for _ in range(k):
        longest = jnp.argmax(_squares(todo[:, :n]), axis=0)
        chosen = (_column(np.arange(len(todo)), len(batch)) == longest)[:, None]
        row = jnp.sum(jnp.where(chosen, todo, 0.0), axis=0)
        todo = jnp.where(chosen, todo[0], todo)[1:]
        row = row - _combination(_products(done[:, :n], row[:n]), done)
        square = _square(row[:n])
        counts = (square > noise) & (left > 0.0)
        row = row * jnp.where(counts, 1.0 / jnp.sqrt(jnp.where(counts, square, 1.0)), 0.0)
        left = left - counts
        done = jnp.concatenate([done, row[None]])
        todo = todo - _products(todo[:, :n], row[:n])[:, None] * row
    return Basis(done[:, :n], done[:, n:], left)


def _square(a: Array, b: Array | None = None) -> Array:
    """Return the product of two rows (n, ..)."""
    return jnp.sum(a * (a if b is None else b), axis=0)


def _squares(vectors: Array) -> Array:
    return jnp.sum(vectors * vectors, axis=1)


def _products(vectors: Array, x: Array) -> Array:
    """Return the products (m, ..) of vectors (m, n, ..) with x (n, ..)."""
    return jnp.sum(vectors * x, axis=1)


def _combination(weights: Array, vectors: Array) -> Array:
    """Return the sum of vectors (m, n, ..), each times its weight (m, ..)."""
    return jnp.sum(weights[:, None] * vectors, axis=0)


def _column(values: Array | NDArray[Any], axes: int) -> Array:
    return jnp.reshape(values, jnp.shape(values) + (1,) * axes)


def triangle(J: Array, basis: Basis) -> tuple[Array, Array]:
    """Return orthonormal rows (3, n, ..) and a lower triangular L (3, 3, ..): their product is J N_sub, J (3, n, ..).

    Each row is made square to those before twice, which leaves nothing but rounding.
    """
    k, units, lines = len(basis.Q), basis.Q, list[Array]()
    for t in range(3):
        first = _products(units, J[t])
        row = J[t] - _combination(first, units)
        second = _products(units, row)
        row = row - _combination(second, units)
        square = _square(row)
        counts = (square > 0.0) & (basis.left > t)
        length = jnp.sqrt(jnp.where(counts, square, 1.0))
        units = jnp.concatenate([units, (row * jnp.where(counts, 1.0 / length, 0.0))[None]])
        diagonal = jnp.where(counts, length, 0.0 * square)
        zeros = jnp.zeros((2 - t, *square.shape))
        lines.append(jnp.concatenate([(first + second)[k:], diagonal[None], zeros]))
    return units[k:], jnp.stack(lines)


def smallest_of(L: Array) -> tuple[Array, Array]:
    """Return the smallest singular value of a lower triangle (3, 3, ..), and the product of all three."""
    a, b, c, d, e, f = (L[r, s] for r, s in zip(*np.tril_indices(3), strict=True))
    product = a * c * f
    largest = _largest_root(
        [
            [c * f, jnp.zeros_like(a), jnp.zeros_like(a)],
            [-b * f, a * f, jnp.zeros_like(a)],
            [b * e - c * d, -a * e, a * c],
        ]
    )
    some = largest > 0.0
    return jnp.where(some, product / jnp.where(some, largest, 1.0), 0.0 * largest), product


def _largest_root(M: Sequence[Sequence[Array]]) -> Array:
    """Return the largest singular value of a 3 x 3 matrix, by the cubic's angle as `lanes.smallest_of` has it."""
    columns = list(zip(*M, strict=True))
    xx, xy, xz, yy, yz, zz = (_dot(columns[r], columns[c]) for r, c in zip(*np.triu_indices(3), strict=True))
    trace = xx + yy + zz
    scale = 1.0 / (trace + lanes.TINY)
    xx, yy, zz = scale * xx - 1.0 / 3.0, scale * yy - 1.0 / 3.0, scale * zz - 1.0 / 3.0
    xy, xz, yz = scale * xy, scale * xz, scale * yz
    xxs, yys, zzs = xx * xx + xy * xy + xz * xz, xy * xy + yy * yy + yz * yz, xz * xz + yz * yz + zz * zz
    square = xxs + yys + zzs
    half = 0.5 * (xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz))
    mean, along = square / 3.0, 6.0 * half / (square + lanes.TINY)
    k0, k1, k2 = xxs - mean - along * xx, yys - mean - along * yy, zzs - mean - along * zz
    k3 = xx * xy + xy * yy + xz * yz - along * xy
    k4 = xx * xz + xy * yz + xz * zz - along * xz
    k5 = xy * xz + yy * yz + yz * zz - along * yz
    sine = jnp.sqrt(square * (k0 * k0 + k1 * k1 + k2 * k2 + 2.0 * (k3 * k3 + k4 * k4 + k5 * k5))) / 6.0
    norm = 1.0 / (jnp.sqrt(half * half + sine * sine) + lanes.TINY)
    C, S = norm * half, norm * sine
    u, v = jnp.sqrt(0.5 + 0.5 * C), jnp.sqrt(jnp.maximum(0.5 - 0.5 * C, 0.0))
    x = (u + 2.0 * jnp.sqrt(0.5 + 0.5 * u)) / 3.0
    y = (v + 2.0 * jnp.sqrt(jnp.maximum(0.5 - 0.5 * u, 0.0))) / 3.0
    for _ in range(4):
        p, q = x * x - y * y, -2.0 * x * y
        weight = 1.0 / (3.0 * (p * p + q * q))
        x, y = 2.0 / 3.0 * x + weight * (C * p - S * q), 2.0 / 3.0 * y + weight * (C * q + S * p)
    return jnp.sqrt(trace * (1.0 / 3.0 + 2.0 * jnp.sqrt(square / 6.0) * x))


def past_protected(found: Matrices, U: Array, scale: Array | None = None) -> tuple[Array, Array, Basis]:
    """Return J_sub = U^T J_base, J_gt and the basis of J_sub, with the axis of U (P, 6, k) before those of the batch.

    The columns are times `scale` (n,).
    """
    J_base, J_gt = found.J_base, found.J_gt
    axes = J_base.ndim - 2
    if scale is not None:
        J_base, J_gt = _column(scale, axes) * J_base, _column(scale, axes) * J_gt
    directions = _column(jnp.moveaxis(U, 0, 2), axes)  # (6, k, P, 1 ..)
    J_sub = jnp.zeros((U.shape[2], J_gt.shape[1], len(U), *J_gt.shape[2:]))
    for b in range(6):
        J_sub = J_sub + directions[b][:, None] * J_base[b][None, :, None]
    squares = _squares(J_base)
    shifts = _column(jnp.any(U[:, :3] != 0.0, axis=(1, 2)), axes)
    square = jnp.where(shifts, jnp.sum(squares, axis=0), jnp.sum(squares[3:], axis=0))
    far = lanes.NOISE * (1.0 + jnp.sum(jnp.abs(found.end_effector_position), axis=0))
    basis = basis_of(*lax.stop_gradient((J_sub, square * far * far)))
    return J_sub, jnp.broadcast_to(J_gt[:, :, None], (*J_gt.shape[:2], len(U), *J_gt.shape[2:])), basis


def singular_values(found: Matrices, groups: Sequence[Array]) -> tuple[Array, Array]:
    """Return smallest singular values of J_gt N_sub, and the products of all three, (P, ..) each.

    A group (P, 6, k) holds the directions, as columns, of those protections that have k of them.
    """
    each = [triangle(J_gt, basis)[1] for _, J_gt, basis in (past_protected(found, U) for U in groups)]
    return smallest_of(jnp.concatenate(each, axis=2))


def coupling_factors(found: Matrices, groups: Sequence[Array]) -> Array:
    """Return |J_rc (J_gt N_sub)^+| (P, ..), the largest singular value; as for `singular_values`."""
    each = [triangle(J_gt, basis) for _, J_gt, basis in (past_protected(found, U) for U in groups)]
    units, L = (jnp.concatenate(parts, axis=2) for parts in zip(*each, strict=True))
    J_rc = found.J_base[3:]
    turned = [_products(units, row[:, None]) for row in J_rc]  # of J_rc units^T, (3, P, ..) each
    B, V = turn_columns(L)
    squares = _squares(B)
    counts = squares > metrics.ROUNDING**2 * jnp.max(squares, axis=0)
    scale = jnp.where(counts, 1.0 / jnp.sqrt(jnp.where(counts, squares, 1.0)), 0.0)
    K = [[scale[c] * _dot(row, V[c]) for c in range(3)] for row in turned]
    none = sum(_square(row) for row in turned) <= metrics.ROUNDING**2 * jnp.sum(_squares(J_rc), axis=0)
    return jnp.where(none, 0.0, _largest_root(K))


def turn_columns(L: Array) -> tuple[Array, Array]:
    """Turn the columns of L (3, 3, ..) until they are square to each other; return B and V, a column in each row.

    One-sided Jacobi, as in the law's kernel: B^T = L V^T, so that the lengths of B's rows are the singular values.
    """

    def sweep(_: int, both: tuple[Array, Array]) -> tuple[Array, Array]:
        B, V = (list(M) for M in both)
        for a, b in ((0, 1), (0, 2), (1, 2)):
            aa, bb, ab = _square(B[a]), _square(B[b]), _square(B[a], B[b])
            needed = ab * ab > kernel.EPS**2 * aa * bb
            zeta = (bb - aa) / jnp.where(needed, 2.0 * ab, 1.0)
            t = jnp.where(zeta < 0.0, -1.0, 1.0) / (jnp.abs(zeta) + jnp.sqrt(1.0 + zeta * zeta))
            t = jnp.where(needed, t, 0.0)
            cosine = 1.0 / jnp.sqrt(1.0 + t * t)
            sine = cosine * t
            for M in (B, V):
                M[a], M[b] = cosine * M[a] - sine * M[b], sine * M[a] + cosine * M[b]
        return jnp.stack(B), jnp.stack(V)

    identity = jnp.broadcast_to(_column(np.eye(3), L.ndim - 2), L.shape)
    B, V = lax.fori_loop(0, SWEEPS, sweep, (jnp.swapaxes(L, 0, 1), identity))
    return B, V


@jax.custom_jvp
def damped_rates(
    J_sub: Array, J: Array, v: Array, basis: Basis, threshold: Array, damping: Array
) -> tuple[Array, Array, Array]:
    """Return the q_dot (n, ..) in null(J_sub) with the least |J q_dot - v|^2 + rho |q_dot|^2.

    And the smallest singular value of J N_sub, for J (3, n, ..), and rho, zero where that is above the threshold. What
    follows of a change in J_sub, J and v is computed in closed form, finite where the decompositions' slopes are not.
    """
    rates, smallest, rho, _ = _solved(J, v, basis, threshold, damping)
    return rates, smallest, rho


def _solved(
    J: Array, v: Array, basis: Basis, threshold: Array, damping: Array
) -> tuple[Array, Array, Array, tuple[Array, Array, Array, Array]]:
    """Solve `damped_rates`; return units and L of J N_sub as well, and what `turn_columns` makes of L."""
    units, L = triangle(J, basis)
    B, V = turn_columns(L)
    squares = _squares(B)
    smallest = jnp.sqrt(jnp.min(squares, axis=0))
    short = jnp.maximum(1.0 - (smallest / threshold) ** 2, 0.0)
    rho = damping * short * short
    kept = (rho > 0.0) | (squares > (4.0 * kernel.EPS) ** 2 * jnp.max(squares, axis=0))
    along = jnp.where(kept, _products(B, v) / jnp.where(kept, squares + rho, 1.0), 0.0)
    return _combination(_combination(along, V), units), smallest, rho, (units, L, B, V)


@damped_rates.defjvp
def _damped_rates_jvp(primals: tuple[Any, ...], tangents: tuple[Any, ...]) -> tuple[Any, Any]:
    """Differentiate q_dot = Y^T mu, mu = (Y Y^T + rho)^-1 v, Y = J N_sub.

    With D = dJ - J J_sub^+ dJ_sub, Y Y^T changes by D Y^T + Y D^T, and Y^T mu, mu being held, by
    N_sub D^T mu - J_sub^+ dJ_sub q_dot.
    """
    J_sub, J, v, basis, threshold, damping = primals
    D, (dJ_sub, dv) = tangents[1], (tangents[0], tangents[2])
    rates, smallest, rho, (units, L, B, V) = _solved(J, v, basis, threshold, damping)
    Y = jnp.stack([_combination(L[r], units) for r in range(3)])
    leak = jnp.zeros_like(rates)
    if len(J_sub):
        lost = [_combination(_products(basis.Q, J[r]), basis.A) for r in range(3)]  # J J_sub^+
        D = D - jnp.stack([_combination(row, dJ_sub) for row in lost])
        leak = _combination(_products(basis.A, _products(dJ_sub, rates)), basis.Q)

    squares = _squares(B)
    kept = squares > LOST * jnp.max(squares, axis=0)
    U = B * jnp.where(kept, 1.0 / jnp.sqrt(jnp.where(kept, squares, 1.0)), 0.0)[:, None]
    rest = jnp.where((rho > 0.0) & ~jnp.all(kept, axis=0), 1.0 / jnp.where(rho > 0.0, rho, 1.0), 0.0)

    def inverse(x: Array) -> Array:
        """Return (Y Y^T + rho)^-1 x; without damping what Y does not reach counts nothing."""
        along = _products(U, x)
        return _combination(along / jnp.where(kept, squares + rho, 1.0), U) + rest * (x - _combination(along, U))

    last = jnp.argmin(squares, axis=0)[None, None]
    left = jnp.take_along_axis(U, last, axis=0)[0]
    right = _combination(jnp.take_along_axis(V, last, axis=0)[0], units)
    d_smallest = jnp.sum(_combination(left, D) * right, axis=0)
    ratio = smallest / threshold
    slope = jnp.where(ratio < 1.0, -4.0 * damping * (1.0 - ratio * ratio) * ratio / threshold, 0.0)
    d_rho = slope * d_smallest
    mu = inverse(v)
    back = _combination(mu, D)
    d_mu = inverse(dv - _products(D, rates) - _products(Y, back) - d_rho * mu)
    across = back - _combination(_products(basis.Q, back), basis.Q) if len(J_sub) else back
    return (rates, smallest, rho), (across - leak + _combination(d_mu, Y), d_smallest, d_rho)


class Law(NamedTuple):
    """What the command needs of a law.

    Attributes:
        U: Protected directions of the base twist (6, k), base axes.
        gain: 1/s.
        weight: Root of the task's weight.
        limits: Rate limits (n,), rad/s or m/s.
        scale: 1 / sqrt(w) of the joint weights w (n,).
        threshold: Smallest singular value above which rho is zero, m.
        damping: Largest rho, m2.
    """

    U: Any
    gain: Any
    weight: Any
    limits: Any
    scale: Any
    threshold: Any
    damping: Any


class Command(NamedTuple):
    """What the law commands, axes of components first; as `ssm_decouple.Command` has it, but all in base axes."""

    joint_rates: Array
    base_twist: Array
    protected_rate: Array
    end_effector_position: Array
    end_effector_error: Array
    smallest_singular_value: Array
    damping: Array
    rate_scale: Array
    rank: Array


def command(arm: Arm, law: Law, joints: Array, seen: Array) -> Command:
    """Return what the law commands at joint positions (n, ..), its target (3, ..) being seen from the base."""
    found, axes = matrices(arm, joints), joints.ndim - 1
    J_sub, J, basis = past_protected(found, law.U[None], law.scale)
    J_sub, J, basis = J_sub[:, :, 0], law.weight * J[:, :, 0], Basis(basis.Q[:, :, 0], basis.A[:, :, 0], basis.left[0])
    error = seen - found.end_effector_position
    v = law.weight * law.gain * error
    rates, smallest, rho = damped_rates(J_sub, J, v, basis, law.threshold, law.damping)
    scale, limits = _column(law.scale, axes), _column(law.limits, axes)
    factor = _inside(scale * rates, limits)
    rates = factor * rates
    if len(J_sub):
        # What rounding has left in the protected rows: it has no slope of its own.
        leak = _combination(_products(basis.A, _products(J_sub, rates)), basis.Q)
        rates = rates - lax.stop_gradient(leak)
        again = _inside(scale * rates, limits)
        rates, factor = again * rates, again * factor
    return Command(
        joint_rates=scale * rates,
        base_twist=_products(found.J_base, scale * rates),
        protected_rate=_products(J_sub, rates),
        end_effector_position=found.end_effector_position,
        end_effector_error=error,
        smallest_singular_value=smallest,
        damping=rho,
        rate_scale=factor,
        rank=len(joints) - basis.left,
    )


def _inside(rates: Array, limits: Array) -> Array:
    """Return the factor (..) that brings rates (n, ..) as a whole to just inside their limits, 1 if they are."""
    beyond = jnp.abs(rates) > limits
    factors = kernel.INSIDE * jnp.where(beyond, limits, 1.0) / jnp.where(beyond, jnp.abs(rates), 1.0)
    return jnp.min(jnp.where(beyond, factors, 1.0), axis=0)


def seen_from(pose: Array, point: Array) -> Array:
    """Return a point (3, ..), inertial axes, as seen from a pose (7, ..): position, x y z w."""
    return jnp.stack(_rotated(tuple(-pose[3:6]), pose[6], tuple(point - pose[:3])))


def _rotated(x: Sequence[Array], w: Array, v: Sequence[Array]) -> Parts:
    """Return a vector turned by the unit quaternion x, w."""
    t = tuple(2.0 * part for part in _cross(x, v))
    across = _cross(x, t)
    return tuple(v[r] + w * t[r] + across[r] for r in range(3))


def moved(pose: Array, twist: Array, time: Array) -> Array:
    """Return a pose (7, ..) moved by a twist (6, ..) in its own axes, held for a time, s; as `rows.move_pose` does."""
    v, w = tuple(time * twist[:3]), tuple(time * twist[3:])
    square = _dot(w, w)
    large = square > 0.01
    far, near = jnp.where(large, square, 1.0), jnp.where(large, 0.0, square)  # what is not chosen needs a finite slope
    angle, q = jnp.sqrt(far), 0.25 * near
    sinc = 1.0 - q / 6.0 * (1.0 - q / 20.0 * (1.0 - q / 42.0 * (1.0 - q / 72.0)))
    sinc = jnp.where(large, jnp.sin(0.5 * angle) / (0.5 * angle), sinc)
    cosine = 1.0 - q / 2.0 * (1.0 - q / 12.0 * (1.0 - q / 30.0 * (1.0 - q / 56.0 * (1.0 - q / 90.0))))
    cosine = jnp.where(large, jnp.cos(0.5 * angle), cosine)
    second = (1.0 - near / 20.0 * (1.0 - near / 42.0 * (1.0 - near / 72.0))) / 6.0
    second = jnp.where(large, (1.0 - jnp.sin(angle) / angle) / far, second)
    first, across, along = 0.5 * sinc * sinc, _cross(w, v), _dot(w, v)
    shift = tuple(v[r] + first * across[r] + second * (w[r] * along - v[r] * square) for r in range(3))
    x, c, turn = tuple(pose[3:6]), pose[6], tuple(0.5 * sinc * part for part in w)
    between = _cross(x, turn)
    turned = [c * turn[r] + x[r] * cosine + between[r] for r in range(3)]
    quaternion = jnp.stack([*turned, c * cosine - _dot(x, turn)])
    # Of the two signs the one nearer to the quaternion before, as Pinocchio has it.
    size = jnp.where(cosine >= 0.0, 1.0, -1.0) / jnp.sqrt(jnp.sum(quaternion * quaternion, axis=0))
    return jnp.concatenate([pose[:3] + jnp.stack(_rotated(x, c, shift)), size * quaternion])


def start_record(joints: Array, pose: Array) -> tuple[Array, Array]:
    """Return what is kept of a motion (rows.RECORD_SIZE, ..) before its first sample, and its trail."""
    empty = np.zeros(rows.RECORD_SIZE)
    empty[rows.SMALLEST : rows.HIGHEST], empty[rows.HIGHEST : rows.LATEST] = np.inf, -np.inf
    trail = jnp.zeros((rows.TRAIL_SIZE, *joints.shape)).at[rows.BEFORE].set(jnp.nan)
    return jnp.broadcast_to(_column(empty, pose.ndim - 1), (rows.RECORD_SIZE, *pose.shape[1:])), trail


def kept(before: tuple[Array, Array], told: Command, pose: Array, time: Array) -> tuple[Array, Array]:
    """Return record and trail brought up to date at a sample, whose command is held for a time, s.

    As `rows.advance`.
    """
    (record, trail), (x, y, z, w) = before, pose[3:]
    within = jnp.stack(
        [
            jnp.arctan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y)),
            jnp.arcsin(jnp.clip(2.0 * (w * y - z * x), -1.0, 1.0)),
            jnp.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)),
        ]
    )
    attitude = within + 2.0 * np.pi * jnp.rint((record[rows.LATEST : rows.REVERSALS] - within) / (2.0 * np.pi))
    rates, leaks = told.joint_rates, jnp.abs(told.protected_rate)
    peak = jnp.maximum(record[rows.PEAK], jnp.max(jnp.abs(rates), axis=0))
    change, own = rates - trail[rows.BEFORE], jnp.maximum(trail[rows.OWN_PEAK], jnp.abs(rates))
    large = jnp.abs(change) > jnp.maximum(rows.REVERSAL_SHARE * own, rows.NOTHING * peak)
    turn = jnp.where(large & (change * trail[rows.CHANGE] < 0.0), 1.0, 0.0)
    count = trail[rows.COUNT] + turn * trail[rows.TURN]
    record = jnp.concatenate(
        [
            (record[rows.TRAVEL] + time * jnp.sqrt(_square(rates)))[None],
            peak[None],
            jnp.maximum(record[rows.LEAK], jnp.max(leaks, axis=0, initial=0.0))[None],
            jnp.minimum(record[rows.SMALLEST], told.smallest_singular_value)[None],
            jnp.minimum(record[rows.LOWEST : rows.HIGHEST], attitude),
            jnp.maximum(record[rows.HIGHEST : rows.LATEST], attitude),
            attitude,
            jnp.max(count, axis=0)[None],
        ]
    )
    return record, jnp.stack([rates, jnp.where(large, change, 0.0), turn, own, count])
