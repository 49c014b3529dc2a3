"""The paper's law, equations 5 to 17, in plain NumPy: the file to read first.

`SelectiveLaw` computes the same faster and to the last digit, for other tasks and inside limits; it is tested against
this file and timed beside it. The symbols are those of Choi and Kim, AAS 26-723; J_rc (eq. 3) and J_gt come from
`robot.coupling(q)`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def task_velocity(x_dot_des: Floats, k_p: float, x_des: Floats, x_ee: Floats) -> Floats:
    """Return v_cmd (3,), m/s, inertial axes: what the task asks of the end-effector (eq. 9)."""
    return x_dot_des + k_p * (x_des - x_ee)


def selective_law(
    J_rc: Floats, J_gt: Floats, U_c: Floats, v_cmd: Floats, rho_max: float = 1e-4, s_0: float = 0.02
) -> Floats:
    """Return the joint rates q_dot_cmd (n,), rad/s or m/s, before limits (eq. 17).

    Args:
        J_rc: Rotational coupling Jacobian (3, n), omega = J_rc q_dot, base axes (eqs. 3 and 4).
        J_gt: Translational generalized Jacobian of the end-effector (3, n), inertial axes.
        U_c: Protected directions, orthonormal columns (3, k), base axes (eq. 5).
        v_cmd: Commanded end-effector velocity (3,), m/s, inertial axes.
        rho_max: rho at a singularity, m2; 0 gives the Moore-Penrose inverse everywhere.
        s_0: Smallest singular value, m, below which rho enters.
    """
    identity = np.eye(J_rc.shape[1])
    J_sub = U_c.T @ J_rc  # eq. 7; omega_sub = J_sub q_dot shall be zero (eqs. 6 and 8)
    N_sub = identity - np.linalg.pinv(J_sub) @ J_sub  # so q_dot = N_sub z, with any z
    A = J_gt @ N_sub  # J_gt q_dot = v_cmd is what the task wishes (eq. 10)
    s = np.linalg.svd(A, compute_uv=False)[-1]
    rho = rho_max * (1.0 - min(s / s_0, 1.0) ** 2) ** 2
    # Eq. 11, |A z - v_cmd|^2 + rho |z|^2 -> min, as one least-squares problem. For rho = 0 its smallest solution is
    # z = A^T (A A^T)^-1 v_cmd = A^+ v_cmd, to which the multipliers of eqs. 12 to 15 lead (eq. 16).
    z = np.linalg.lstsq(np.vstack([A, np.sqrt(rho) * identity]), np.append(v_cmd, 0.0 * identity[0]))[0]
    return N_sub @ z  # eq. 17, since N_sub A^+ = A^+


def scaled_to_limits(q_dot: Floats, limits: Floats) -> Floats:
    """Return joint rates (n,) scaled as a whole inside their limits (n,): joint by joint would leave null(J_sub)."""
    return q_dot / max(1.0, float(np.max(np.abs(q_dot) / limits)))
