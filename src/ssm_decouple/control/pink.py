"""The protection for programs that use Pink: two hard constraints for `pink.solve_ik(.., constraints=[..])`.

Pink solves for the velocity of the whole robot, base and joints. That the base is free, and what of it must stay still,
are then linear equations between them. Needs the extra `[pink]`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from ssm_decouple.errors import InputError
from ssm_decouple.model.origin import from_base
from ssm_decouple.momentum.protection import Protection, checked_protection

try:
    from pink.tasks import Task
except ImportError:
    raise ImportError("Pink is not installed: pip install 'ssm-decouple[pink]'") from None

Floats = NDArray[np.float64]


class ConservedMomentum(Task):  # type: ignore[misc]
    """No momentum: A_g v = 0, six rows. Without it Pink moves the base as if it had thrusters."""

    def __init__(self) -> None:
        super().__init__(cost=np.ones(6))

    def compute_error(self, configuration: Any) -> Floats:
        """Return zeros (6,): the spacecraft starts from rest and stays so."""
        return np.zeros(6)

    def compute_jacobian(self, configuration: Any) -> Floats:
        """Return the centroidal map A_g (6, nv): [linear; angular] about the centre of mass, inertial axes."""
        model = configuration.model
        return np.array(pin.computeCentroidalMap(model, model.createData(), from_base(configuration.q)))

    def __repr__(self) -> str:
        return "ConservedMomentum()"


class ProtectedRate(Task):  # type: ignore[misc]
    """No base motion along the protected directions: U_c^T (base twist) = 0, k rows (paper, eq. 6).

    Args:
        protection: What is protected.

    Raises:
        InputError: nothing is.
    """

    def __init__(self, protection: Protection) -> None:
        if checked_protection(protection).k == 0:
            raise InputError("the protection has no direction, which is no constraint: leave it out")
        super().__init__(cost=np.ones(protection.k))
        self.protection = protection

    def compute_error(self, configuration: Any) -> Floats:
        """Return zeros (k,)."""
        return np.zeros(self.protection.k)

    def compute_jacobian(self, configuration: Any) -> Floats:
        """Return the rows (k, nv) that take the protected components of the base twist out of v."""
        rows = np.zeros((self.protection.k, configuration.model.nv))
        U = self.protection.U_twist
        if self.protection.frame != "base":
            R = pin.Quaternion(np.array(configuration.q[3:7])).matrix().T
            if self.protection.frame != "inertial":
                R = R @ configuration.get_transform_frame_to_world(self.protection.frame).rotation
            U = np.vstack([R @ U[:3], R @ U[3:]])
        rows[:, :6] = U.T
        return rows

    def __repr__(self) -> str:
        return f"ProtectedRate({self.protection!r})"
