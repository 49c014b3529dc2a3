"""The law as functions of arrays, for programs that have matrices of their own: no robot, no task, no state.

    A_g = pin.computeCentroidalMap(model, data, q)
    J_base = base_twist_map(A_g)
    J = pin.getFrameJacobian(model, data, frame, pin.LOCAL_WORLD_ALIGNED)[:3]
    J_gt = J[:, 6:] + J[:, :6] @ J_base
    rates = selective_rates(U_c.T @ J_base[3:], J_gt, velocity, rate_limits=limits)

They are the compiled algebra of `SelectiveLaw` and give its numbers, to the order in which sums are rounded.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ssm_decouple.control import kernel
from ssm_decouple.errors import InputError, as_floats, as_number

Floats = NDArray[np.float64]


def base_twist_map(A_g: ArrayLike, out: Floats | None = None) -> Floats:
    """Return the base twist per joint rate at zero momentum, J_base (paper, eq. 3 is its angular half, J_rc).

    Args:
        A_g: Centroidal map (6, 6 + n), rows [linear; angular about the centre of mass], inertial axes; the base's
            columns come first and take its twist in base axes: what `pin.computeCentroidalMap` returns.
        out: Array (6, n) to write into; None makes one.

    Returns:
        J_base (6, n): rows [linear; angular] of the base origin, base axes.

    Raises:
        InputError: a wrong shape, or an inertia of the whole that is singular or not finite.
    """
    given = np.asfortranarray(as_floats("A_g", A_g))
    if not np.all(np.isfinite(given)):
        raise InputError("A_g is not finite")
    if given.ndim != 2 or given.shape[0] != 6 or given.shape[1] < 7:
        raise InputError(f"A_g has shape {given.shape}; it needs (6, 6 + n) with n joints, one or more")
    J_base = _output(out, (6, given.shape[1] - 6))
    if not kernel.base_twist_map(given, J_base) > 0.0:
        raise InputError("A_g has no finite, regular inertia of the whole in its base columns")
    return J_base


def selective_rates(
    J_sub: ArrayLike,
    J_task: ArrayLike,
    task_velocity: ArrayLike,
    protected_rate: ArrayLike | None = None,
    rate_limits: ArrayLike | None = None,
    joint_weights: ArrayLike | None = None,
    damping: float = 1e-4,
    damping_threshold: float = 0.02,
    out: Floats | None = None,
) -> Floats:
    """Return the joint rates q_dot = (J_task N_sub)^+ v of smallest norm with J_sub q_dot = b (paper, eqs. 9 and 11).

    As `SelectiveLaw` does, it damps near singularities of J_task N_sub and scales the whole vector to the rate limits,
    so that the rates lie in null(J_sub) to machine precision whatever happens. Rows of J_sub below 16 rounding errors
    of the others count as zero.

    Args:
        J_sub: Sub-coupling matrix (k, n), k from 0 to 6: U_c^T J_base or the like, or any other rows to keep still.
        J_task: Generalized Jacobian of the tasks (m, n).
        task_velocity: What the tasks ask for (m,).
        protected_rate: b (k,); None for zero.
        rate_limits: Of the joints (n,), or one number; None for none.
        joint_weights: Of the joints in the norm (n,); None for 1.
        damping: rho at a singularity; 0 gives the Moore-Penrose inverse everywhere.
        damping_threshold: Smallest singular value below which rho enters.
        out: Array (n,) to write into; None makes one.

    Returns:
        Joint rates (n,).

    Raises:
        InputError: shapes that do not fit, weights, limits or damping out of range, or numbers that are not finite.
    """
    rows, task = _matrix("J_sub", J_sub), _matrix("J_task", J_task)
    n = task.shape[1]
    if n == 0 or rows.shape[1] != n or rows.shape[0] > 6:
        raise InputError(
            f"J_sub has shape {rows.shape} and J_task {task.shape}; they need the same number of joints, one or more, "
            "and J_sub at most 6 rows"
        )
    velocity = _vector("task_velocity", task_velocity, task.shape[0])
    wanted = np.zeros(len(rows)) if protected_rate is None else _vector("protected_rate", protected_rate, len(rows))
    limits = np.full(n, np.inf) if rate_limits is None else _spread("rate_limits", rate_limits, n)
    weights = np.ones(n) if joint_weights is None else _spread("joint_weights", joint_weights, n)
    if not (np.all(limits > 0.0) and np.all(weights > 0.0) and np.all(np.isfinite(weights))):
        raise InputError(
            f"rate_limits are {limits.tolist()} and joint_weights {weights.tolist()}; all must be above zero, the "
            "weights finite"
        )
    damping, damping_threshold = as_number("damping", damping), as_number("damping_threshold", damping_threshold)
    if not (damping >= 0.0 and damping_threshold > 0.0):
        raise InputError(
            f"damping is {damping} and damping_threshold {damping_threshold}; the first must be zero or more and the "
            "second above zero"
        )
    rates = _output(out, (n,))
    scale = 1.0 / np.sqrt(weights)
    finite = np.isfinite(rows).all() and np.isfinite(wanted).all()  # rows that are not would protect nothing
    arguments = (rows, task, velocity, wanted, limits, scale, damping, damping_threshold, rates)
    if not finite or kernel.rates_of(*arguments) != kernel.OK:
        raise InputError("J_sub, J_task, task_velocity or protected_rate is not finite")
    return rates


def _matrix(name: str, values: ArrayLike) -> Floats:
    matrix = np.ascontiguousarray(as_floats(name, values))
    if matrix.ndim != 2:
        raise InputError(f"{name} has shape {matrix.shape}; it needs two dimensions, rows and joints")
    if not np.all(np.isfinite(matrix)):
        raise InputError(f"{name} is not finite")
    return matrix


def _vector(name: str, values: ArrayLike, size: int) -> Floats:
    vector = np.ascontiguousarray(as_floats(name, values))
    if vector.shape != (size,):
        raise InputError(f"{name} has shape {vector.shape}; it needs ({size},), a number a row")
    return vector


def _spread(name: str, values: ArrayLike, size: int) -> Floats:
    given = as_floats(name, values)
    return np.full(size, float(given)) if given.shape == () else _vector(name, given, size)


def _output(out: Floats | None, shape: tuple[int, ...]) -> Floats:
    if out is None:
        return np.empty(shape)
    fit = type(out) is np.ndarray and out.dtype == np.float64 and out.shape == shape
    if not (fit and out.flags.carray):
        raise InputError(f"out must be a writable, contiguous float64 array {shape}")
    return out
