"""The momentum matrices of one configuration."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Literal

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray

from ssm_decouple.errors import InputError, as_floats, as_text, shown
from ssm_decouple.model.robot import Robot, checked_robot
from ssm_decouple.momentum import metrics
from ssm_decouple.settled import FixedArrays

if TYPE_CHECKING:
    from ssm_decouple.momentum.protection import Protection

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Coupling(FixedArrays):
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
        J_arm: Jacobian of the end-effector with the base held (6, n), in the rows and axes of J_g.
        centre_of_mass: Of the whole (3,), m, inertial axes.
        base_position: Of the base origin (3,), m, inertial axes.
        base_rotation: Base axes to inertial axes (3, 3).
        mass: Of the whole, kg.
    """

    frame: Literal["base", "inertial"]
    H_ww: Floats
    H_wq: Floats
    J_rc: Floats
    J_base: Floats
    J_g: Floats
    J_arm: Floats
    centre_of_mass: Floats
    base_position: Floats
    base_rotation: Floats
    mass: float
    _placed: tuple[Robot, pin.Data] = field(repr=False, compare=False)

    @classmethod
    def at(cls, robot: Robot, q: ArrayLike) -> Coupling:
        """Compute the matrices at a configuration q (nq,), in base axes.

        Raises:
            InputError: q has the wrong length or is not finite.
        """
        model = checked_robot(robot).model
        data, configuration = pin.Data(model), robot.checked(q).copy()
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
            J_arm=_fixed(J_frame[:, 6:].copy()),
            centre_of_mass=_fixed(data.com[0] + position),
            base_position=_fixed(position),
            base_rotation=_fixed(R),
            mass=robot.mass,
            _placed=(robot, data),
        )

    @property
    def J_gt(self) -> Floats:
        """Translational generalized Jacobian (3, n), inertial axes: the paper's J_g,t (eq. 10)."""
        return self.J_g[:3]

    def rotation_of(self, frame: str) -> Floats:
        """Return the rotation (3, 3) from the axes of "base", "inertial" or a frame of the robot to those of `frame`.

        Raises:
            InputError: the robot has no such frame.
        """
        as_text("frame", frame, "it is 'base', 'inertial' or the name of a frame of the robot")
        robot, data = self._placed
        if frame in ("base", "inertial"):
            R = self.base_rotation if frame == "base" else np.eye(3)
        else:
            held = robot.model.frames[robot.frame_id(frame)]
            R = data.oMi[held.parentJoint].rotation @ held.placement.rotation
        return self.base_rotation.T @ R if self.frame == "base" else R

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
        """Return the base twist (6,) that joint rates (n,) cause: [linear; angular], m/s and rad/s, axes of `frame`.

        Raises:
            InputError: the rates have the wrong length or are not finite.
        """
        return self.J_base @ self.checked_rates(joint_rates)

    def checked_rates(self, joint_rates: ArrayLike) -> Floats:
        """Return joint rates (n,) as an array.

        Raises:
            InputError: they have the wrong length or are not finite.
        """
        rates, n = as_floats("joint_rates", joint_rates), self.J_rc.shape[1]
        if rates.shape != (n,) or not np.all(np.isfinite(rates)):
            raise InputError(f"joint_rates is {shown(rates.tolist())}; it needs {n} finite numbers, one a joint")
        return rates

    def manipulability(
        self, protection: Protection | None = None, characteristic_length: float | None = None
    ) -> metrics.Ellipsoid:
        """Return how fast the end-effector can go in each direction with |q_dot| <= 1 and the protected axes still.

        The ellipsoid of J_gt N_sub: `volume` is Yoshikawa's manipulability (1985), `smallest` the law's
        `smallest_singular_value`. With `Protection("all")` the joint rates are those of the reaction null space
        (Nenchev, Umetani and Yoshida, 1992). Directions are in inertial axes; the semi-axes depend on no frame, nor on
        the base pose.

        Args:
            protection: What the base must not do; None allows all joint rates.
            characteristic_length: Length L, m, that turns angular speeds into linear ones: the ellipsoid is then that
                of [J_gt; L J_gw] N_sub, rows [linear; angular times L]. None takes the translation alone.

        Returns:
            The ellipsoid, r = 3 or, with a characteristic length, 6; semi-axes in m (m/s per rad/s).

        Raises:
            InputError: the characteristic length is no positive number.
        """
        return metrics.manipulability(self, protection, characteristic_length)

    def directional_coupling(self) -> metrics.Ellipsoid:
        """Return about which axes the joints turn the base, and how much: the ellipsoid of J_rc.

        Its first direction is the axis about which joint rates with |q_dot| <= 1 turn the base most, at semi_axes[0]
        rad/s, its first column of joint rates is how; the last are those that turn it least. Disturbance maps
        (Vafa and Dubowsky, 1990; Torres and Dubowsky, 1992) are drawn from it. Directions are in the axes of `frame`.

        Returns:
            The ellipsoid, r = 3, semi-axes in rad/s per rad/s. Joint rates orthogonal to those of all semi-axes above
            zero leave the base's attitude alone.
        """
        return metrics.Ellipsoid.of(self.J_rc)

    def coupling_factor(self, protection: Protection | None = None) -> float:
        """Return the largest base angular speed, rad/s, per m/s of the end-effector: |J_rc (J_gt N_sub)^+|.

        In the manner of Xu's coupling factor (1993) between the motions of end-effector and base: the spectral norm,
        over the velocities that the end-effector can have, each made by the smallest joint rates. It grows without
        bound towards a singularity. 0 where nothing that is allowed turns the base: all three axes protected.

        Args:
            protection: What the base must not do; None allows all joint rates.
        """
        return metrics.coupling_factor(self, protection)

    def dynamic_singularity_margin(self, protection: Protection | None = None) -> float:
        """Return the smallest singular value of J_gt N_sub over that of J_arm, both of translations.

        Only directions in which the arm on a held base can go count, so that it says something of planar arms too. 0 is
        a dynamic singularity (Papadopoulos and Dubowsky, 1993): the arm on a held base can go in every such direction,
        on the free one it cannot, and where depends on masses. 1 is an arm that does not feel that its base is free, as
        on a very heavy one; above 1 the base's reaction helps. With a protection, what that takes comes on top. NaN
        where the arm cannot move its end-effector at all.

        Args:
            protection: What the base must not do; None allows all joint rates.
        """
        return metrics.dynamic_singularity_margin(self, protection)

    def protected_share(self, protection: Protection, joint_rates: ArrayLike) -> float:
        """Return which share of the momentum that joint rates give the base is about the protected directions.

        At zero total momentum the base takes h = -H_wq q_dot = H_ww omega. It has two parts, orthogonal in the
        rotational energy h^T H_ww^-1 h / 2: one along the protected directions, and one that turns the base about none
        of them. The share is that of the first in the energy. (The plain projection of h would not do: H_ww is not
        isotropic, so that a base which does not turn about an axis may well have momentum about it.) With six-row
        directions h is the whole momentum, linear and angular, and the energy that of the whole with its joints locked.

        Args:
            protection: The directions.
            joint_rates: (n,), rad/s or m/s; their size plays no part.

        Returns:
            Share from 0, the base does not move along the protected directions, to 1, all of its momentum is along
            them. 0 where the rates give the base no momentum. It depends on no frame, nor on the base pose.

        Raises:
            InputError: the rates have the wrong length or are not finite.
        """
        return metrics.protected_share(self, protection, joint_rates)


def _fixed(array: Floats) -> Floats:
    array.flags.writeable = False
    return array
