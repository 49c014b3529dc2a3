"""The momentum matrices of one configuration."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray

if TYPE_CHECKING:
    from ssm_decouple.model.robot import Robot

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Coupling:
    """How joint rates and base motion share momentum at one configuration, at zero total momentum.

    Immutable: every array is read-only. The paper is Choi and Kim, AAS 26-723.

    Attributes:
        frame: Axes of H_ww, H_wq, J_rc and J_base: "base" (the paper's unmarked symbols) or "inertial" (its
            superscript N).
        H_ww: Inertia matrix of the whole about its centre of mass (3, 3), kg m2 (paper, eq. 1).
        H_wq: Coupling matrix (3, n), kg m2 for revolute joints (paper, eq. 1): the angular momentum about the centre
            of mass is H_ww omega + H_wq q_dot.
        J_rc: Rotational coupling Jacobian (3, n), -H_ww^-1 H_wq: base angular velocity per joint rate (paper, eq. 3).
        J_base: Base twist per joint rate (6, n): rows [linear; angular], the velocity of the base origin first.
        J_g: Generalized Jacobian of the end-effector (6, n): rows [linear; angular], always inertial axes, because
            targets are.
        centre_of_mass: Of the whole (3,), m, inertial axes.
        base_rotation: Base axes to inertial axes (3, 3).
        mass: Of the whole, kg.
    """

    frame: Literal["base", "inertial"]
    H_ww: Floats
    H_wq: Floats
    J_rc: Floats
    J_base: Floats
    J_g: Floats
    centre_of_mass: Floats
    base_rotation: Floats
    mass: float

    @classmethod
    def at(cls, robot: Robot, q: ArrayLike) -> Coupling:
        """Compute the matrices at a configuration q (nq,), in base axes.

        Raises:
            InputError: q has the wrong length or is not finite.
        """
        model, data, configuration = robot.model, robot.model.createData(), robot.checked(q).copy()
        # No matrix depends on where the base is, but sums about a far origin would round more.
        position = configuration[:3].copy()
        configuration[:3] = 0.0
        pin.computeCentroidalMap(model, data, configuration)
        pin.updateFramePlacement(model, data, robot.end_effector_id)
        J_frame = pin.getFrameJacobian(model, data, robot.end_effector_id, pin.LOCAL_WORLD_ALIGNED)
        A_g, R = np.array(data.Ag), np.array(data.oMi[1].rotation)
        # Zero momentum, A_base (base twist) + A_joints q_dot = 0: the 6 x 6 solve gives the whole base twist at once.
        J_base = -np.linalg.solve(A_g[:, :6], A_g[:, 6:])
        return cls(
            frame="base",
            H_ww=_fixed(R.T @ A_g[3:, 3:6]),
            H_wq=_fixed(R.T @ A_g[3:, 6:]),
            J_rc=_fixed(J_base[3:].copy()),
            J_base=_fixed(J_base),
            J_g=_fixed(J_frame[:, 6:] + J_frame[:, :6] @ J_base),
            centre_of_mass=_fixed(data.com[0] + position),
            base_rotation=_fixed(R),
            mass=robot.mass,
        )

    @property
    def J_gt(self) -> Floats:
        """Translational generalized Jacobian (3, n), inertial axes: the paper's J_g,t (eq. 10)."""
        return self.J_g[:3]

    def inertial(self) -> Coupling:
        """Return the same matrices in inertial axes: N_H_ww = R H_ww R^T, N_H_wq = R H_wq, N_J_rc = R J_rc."""
        if self.frame == "inertial":
            return self
        R = self.base_rotation
        return replace(
            self,
            frame="inertial",
            H_ww=_fixed(R @ self.H_ww @ R.T),
            H_wq=_fixed(R @ self.H_wq),
            J_rc=_fixed(R @ self.J_rc),
            J_base=_fixed(np.vstack([R @ self.J_base[:3], R @ self.J_base[3:]])),
        )

    def base_twist(self, joint_rates: ArrayLike) -> Floats:
        """Return the base twist (6,) that joint rates (n,) cause: [linear; angular], m/s and rad/s, axes of `frame`."""
        return self.J_base @ np.asarray(joint_rates, dtype=float)


def _fixed(array: Floats) -> Floats:
    array.flags.writeable = False
    return array
