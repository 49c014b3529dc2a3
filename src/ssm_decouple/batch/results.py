"""What the batch engine returns: arrays with a row for each configuration or motion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ssm_decouple.control import kernel
from ssm_decouple.control.law import CommandedMotion

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Matrices:
    """Momentum matrices of many configurations, a row each.

    All in base axes, which are the inertial axes where the base pose is the identity; positions from the base origin.
    A row of joints that is not finite has rows of NaN. All but the last two are views of `values`.

    Attributes:
        values: All numbers (N, 12 n + 15).
        n: Number of joints.
        smallest_singular_values: Of J_gt N_sub, for each protection asked for (N, P), m.
        manipulability: Product of its three singular values (N, P), m3.
    """

    values: Floats
    n: int
    smallest_singular_values: Floats
    manipulability: Floats

    @property
    def J_base(self) -> Floats:
        """Base twist per joint rate (N, 6, n): rows [linear; angular] of the base origin."""
        return self._rows(0, 6)

    @property
    def J_rc(self) -> Floats:
        """Rotational coupling Jacobian (N, 3, n): base angular velocity per joint rate (paper, eq. 3)."""
        return self._rows(3, 3)

    @property
    def J_gt(self) -> Floats:
        """Translational generalized Jacobian of the end-effector (N, 3, n) (paper, eq. 10)."""
        return self._rows(6, 3)

    @property
    def end_effector_position(self) -> Floats:
        """End-effector position (N, 3), m."""
        return self.values[:, 9 * self.n : 9 * self.n + 3]

    @property
    def H_wq(self) -> Floats:
        """Coupling matrix (N, 3, n), kg m2 for revolute joints (paper, eq. 1)."""
        return self.values[:, 9 * self.n + 3 : 12 * self.n + 3].reshape(-1, 3, self.n)

    @property
    def H_ww(self) -> Floats:
        """Inertia matrix of the whole about its centre of mass (N, 3, 3), kg m2 (paper, eq. 1)."""
        return self.values[:, 12 * self.n + 3 : 12 * self.n + 12].reshape(-1, 3, 3)

    @property
    def centre_of_mass(self) -> Floats:
        """Centre of mass of the whole (N, 3), m."""
        return self.values[:, 12 * self.n + 12 :]

    def _rows(self, first: int, count: int) -> Floats:
        n = self.n
        return self.values[:, first * n : (first + count) * n].reshape(-1, count, n)


@dataclass(frozen=True)
class Commands(CommandedMotion):
    """What the law commands at many configurations, a row each, as `Command` has it for one.

    Attributes:
        values: All numbers (N, law.size), of which the others are views.
        n: Number of joints.
        k: Number of protected directions.
    """

    values: Floats
    n: int
    k: int

    @property
    def end_effector_error(self) -> Floats:
        """Targets minus end-effector positions (N, 3), m, inertial axes."""
        return self._results(kernel.ERRORS, 3)

    @property
    def smallest_singular_value(self) -> Floats:
        """Smallest singular value of J_gt N_sub (N,), m, in the law's joint weights."""
        return self._results(kernel.ERRORS + 3)[:, 0]

    @property
    def damping(self) -> Floats:
        """The regularising scalar rho (N,), m2 (paper, eq. 11); 0 away from singularities."""
        return self._results(kernel.ERRORS + 4)[:, 0]

    @property
    def rate_scale(self) -> Floats:
        """Factor in (0, 1] that brought the whole rate vector inside the limits (N,)."""
        return self._results(kernel.RATE_SCALE)[:, 0]


@dataclass(frozen=True)
class Motions:
    """How many motions went, a row each.

    Attributes:
        outcome: "converged", "stalled" or "running", as of `simulate`; "undefined" where start or target is not
            finite (N,). The numbers of such a motion are NaN.
        outcome_time: When it came within the tolerance for good, or stopped making progress, or the end (N,), s.
        final_error: Distance to the target at the end (N,), m.
        joint_travel: Norm of the joint rates integrated over time (N,), rad (and m, of sliding joints).
        peak_rate: Largest rate of any joint (N,), rad/s or m/s.
        protected_rate: Largest rate along a protected direction of the law at a sample, abs(J_sub q_dot) (N,), rad/s
            (m/s of directions that shift): rounding.
        base_rotation: Base roll, pitch and yaw, R = Rz(yaw) Ry(pitch) Rx(roll), peak to peak (N, 3), rad; each is
            counted on beyond half a turn.
        smallest_singular_value: Of J_gt N_sub, the smallest on the way (N,), m.
        rate_reversals: How often the rate of a joint reverses from sample to sample, of the joint that does it most
            (N,): hundreds where the command chatters at a singularity.
        configuration: Pinocchio configuration at the end (N, nq).
    """

    outcome: NDArray[np.str_]
    outcome_time: Floats
    final_error: Floats
    joint_travel: Floats
    peak_rate: Floats
    protected_rate: Floats
    base_rotation: Floats
    smallest_singular_value: Floats
    rate_reversals: Floats
    configuration: Floats
