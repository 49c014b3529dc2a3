"""What the momentum matrices say about a configuration in a few numbers: ellipsoids, factors, margins and shares."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ssm_decouple.errors import InputError, as_floats, as_positive
from ssm_decouple.momentum.protection import Protection, checked_protection
from ssm_decouple.settled import FixedArrays

if TYPE_CHECKING:
    from ssm_decouple.momentum.coupling import Coupling

Floats = NDArray[np.float64]

ROUNDING = 64 * np.finfo(float).eps  # a semi-axis below this share of the largest is zero


@dataclass(frozen=True)
class Ellipsoid(FixedArrays):
    """What a map makes of all joint rates with |q_dot| <= 1: an ellipsoid, by singular value decomposition.

    map @ joint_rates = directions * semi_axes. Where joints turn and slide both, |q_dot| mixes rad/s and m/s.

    Attributes:
        semi_axes: Singular values of the map (r,), falling, in the map's units. Zeros fill up where it has fewer.
        directions: Unit axes of the ellipsoid, a column each (r, r), in the axes of the map's rows.
        joint_rates: The rates that give each of them, a unit column each (n, r); a column of zeros where there is none.
    """

    semi_axes: Floats
    directions: Floats
    joint_rates: Floats

    @classmethod
    def of(cls, matrix: Floats, allowed: Floats | None = None) -> Ellipsoid:
        """Return the ellipsoid of a map (r, n), for joint rates in the span of orthonormal columns (n, m)."""
        matrix = as_floats("matrix", matrix)
        if matrix.ndim != 2 or not matrix.size or not np.all(np.isfinite(matrix)):
            raise InputError(f"matrix has shape {matrix.shape}; it needs rows and columns of finite numbers")
        basis = np.eye(matrix.shape[1]) if allowed is None else as_floats("allowed", allowed)
        if basis.ndim != 2 or len(basis) != matrix.shape[1] or not np.all(np.isfinite(basis)):
            raise InputError(f"allowed has shape {basis.shape}; it needs ({matrix.shape[1]}, m) finite numbers")
        rows = matrix.shape[0]
        directions, values, right = np.linalg.svd(matrix @ basis)
        semi_axes, rates = np.zeros(rows), np.zeros((matrix.shape[1], rows))
        semi_axes[: values.size] = values
        rates[:, : values.size] = basis @ right[: values.size].T
        for array in (semi_axes, directions, rates):
            array.flags.writeable = False
        return cls(semi_axes, directions, rates)

    @property
    def volume(self) -> float:
        """Product of the semi-axes, sqrt(det(A A^T)): Yoshikawa's manipulability, 1985; 0 where a direction is lost."""
        return float(np.prod(self.semi_axes))

    @property
    def largest(self) -> float:
        """Largest semi-axis."""
        return float(self.semi_axes[0])

    @property
    def smallest(self) -> float:
        """Smallest semi-axis; at a singularity rounding is left of it."""
        return float(self.semi_axes[-1])

    @property
    def rank(self) -> int:
        """How many semi-axes are more than rounding."""
        return int(np.sum(self.semi_axes > ROUNDING * self.semi_axes[0]))

    @property
    def condition(self) -> float:
        """Largest semi-axis over the smallest, from 1 (a ball) to infinity (a direction is lost)."""
        return self.largest / self.smallest if self.rank == self.semi_axes.size else np.inf

    @property
    def entropy(self) -> float:
        """Shannon entropy of the semi-axes' shares of their sum, over its maximum: 0 a needle, 1 a ball.

        Das, Choi and Kim, AAS 25-705, rate the coupling's directionality so. 0 where all semi-axes are zero.
        """
        shares = self.semi_axes[: self.rank] / max(float(self.semi_axes.sum()), np.finfo(float).tiny)
        return abs(float(shares @ np.log(shares))) / np.log(max(self.semi_axes.size, 2))


def manipulability(
    coupling: Coupling, protection: Protection | None = None, characteristic_length: float | None = None
) -> Ellipsoid:
    """Compute `Coupling.manipulability`."""
    allowed = _allowed(coupling, protection)
    if characteristic_length is None:
        return Ellipsoid.of(coupling.J_gt, allowed)
    length = as_positive("characteristic_length", characteristic_length, "it must be a positive length, m")
    return Ellipsoid.of(np.vstack([coupling.J_g[:3], length * coupling.J_g[3:]]), allowed)


def coupling_factor(coupling: Coupling, protection: Protection | None = None) -> float:
    """Compute `Coupling.coupling_factor`."""
    Z = _allowed(coupling, protection)
    disturbance = coupling.J_rc @ Z
    if np.linalg.norm(disturbance) <= ROUNDING * np.linalg.norm(coupling.J_rc):
        return 0.0
    return float(np.linalg.norm(disturbance @ np.linalg.pinv(coupling.J_gt @ Z, ROUNDING), 2))


def dynamic_singularity_margin(coupling: Coupling, protection: Protection | None = None) -> float:
    """Compute `Coupling.dynamic_singularity_margin`."""
    fixed = Ellipsoid.of(coupling.J_arm[:3])
    if fixed.rank == 0:
        return np.nan
    reachable = fixed.directions[:, : fixed.rank]
    free = Ellipsoid.of(reachable.T @ coupling.J_gt, _allowed(coupling, protection))
    return free.smallest / float(fixed.semi_axes[fixed.rank - 1])


def protected_share(coupling: Coupling, protection: Protection, joint_rates: ArrayLike) -> float:
    """Compute `Coupling.protected_share`."""
    rates = coupling.checked_rates(joint_rates)
    U, whole_twist = checked_protection(protection).U_c_in(coupling), len(protection.U_c) == 6
    inertia = _locked_inertia(coupling) if whole_twist else coupling.H_ww
    motion = (coupling.J_base if whole_twist else coupling.J_rc) @ rates
    total = float(motion @ inertia @ motion)
    if protection.k == 0 or not total > 0:
        return 0.0
    about = U.T @ motion
    return min(float(about @ np.linalg.solve(U.T @ np.linalg.solve(inertia, U), about)) / total, 1.0)


def _allowed(coupling: Coupling, protection: Protection | None) -> Floats:
    if protection is None:
        return np.eye(coupling.J_rc.shape[1])
    return checked_protection(protection).null_space_basis(coupling)


def _locked_inertia(coupling: Coupling) -> Floats:
    """Return the inertia of the whole, joints locked, about the base origin (6, 6): [linear; angular]."""
    arm = coupling.centre_of_mass - coupling.base_position
    x, y, z = arm if coupling.frame == "inertial" else coupling.base_rotation.T @ arm
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    m = coupling.mass
    return np.block([[m * np.eye(3), -m * cross], [m * cross, coupling.H_ww - m * cross @ cross]])
