"""What moves in a dynamic simulation: the robot with its appendages free to bend."""

from __future__ import annotations

import warnings
import xml.etree.ElementTree as ET
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pinocchio as pin
import scipy.linalg
from numpy.typing import ArrayLike, NDArray

from ssm_decouple.errors import DecoupleWarning, InputError, as_floats
from ssm_decouple.model.appendage import Appendage, flexible_urdf
from ssm_decouple.model.robot import Robot, checked_robot
from ssm_decouple.model.urdf import parse_urdf
from ssm_decouple.settled import FixedArrays, fixed_array

Floats = NDArray[np.float64]
Integers = NDArray[np.intp]


@dataclass(frozen=True)
class Plant(FixedArrays):
    """A robot whose appendages bend, beside the rigid robot that the control law sees.

    Attributes:
        robot: Its joints are the driven joints and the hinges of the appendages; the rigid robot itself where there is
            no appendage. Any Pinocchio function works on `robot.model`.
        rigid: The robot as the law sees it. With all hinges at zero the two are the same body.
        driven: Place of each joint of the rigid robot among the plant's joint rates (n,).
        hinges: Place of each hinge among them (h,), ordered by appendage, then from root to tip.
        stiffness: Of every joint of the plant, in the order of its joint rates (n + h,), N m/rad; zero where driven.
        damping: The same, N m s/rad.
        appendages: Those of the rigid robot.
    """

    robot: Robot
    rigid: Robot
    driven: Integers
    hinges: Integers
    stiffness: Floats
    damping: Floats
    appendages: tuple[Appendage, ...]

    @classmethod
    def of(cls, robot: Robot) -> Plant:
        """Return the plant of a robot.

        Raises:
            ModelError: the appendages do not fit the robot, as `Robot` says when it is given them.
        """
        whole, appendages = robot, checked_robot(robot).appendages
        if appendages:
            root = flexible_urdf(parse_urdf(robot.urdf, robot.name), appendages)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", DecoupleWarning)  # the rigid robot has told of its inertias
                whole = Robot(
                    ET.tostring(root, encoding="unicode"),
                    name=f"{robot.name} (flexible)",
                    end_effector=robot.end_effector,
                )
        hinges = [whole.joint_index(f"{a.name}_hinge_{i}") for a in appendages for i in range(a.segments)]
        stiffness, damping = np.zeros(whole.n_joints), np.zeros(whole.n_joints)
        for values, kind in ((stiffness, "stiffness"), (damping, "damping")):
            values[hinges] = [value for appendage in appendages for value in getattr(appendage, kind)]
        return cls(
            robot=whole,
            rigid=robot,
            driven=fixed_array(np.array([whole.joint_index(name) for name in robot.joint_names], dtype=np.intp)),
            hinges=fixed_array(np.array(hinges, dtype=np.intp)),
            stiffness=fixed_array(stiffness),
            damping=fixed_array(damping),
            appendages=appendages,
        )

    @cached_property
    def _places(self) -> tuple[Integers, Integers]:
        """Return where the rigid robot's q (nq,) and the hinge angles (h,) stand in the plant's q."""
        plant, rigid = self.robot.model, self.rigid.model
        places = list(range(7))
        for joint in rigid.joints[2:]:
            start = plant.joints[plant.getJointId(rigid.names[joint.id])].idx_q
            places += range(start, start + joint.nq)
        hinges = [plant.joints[2 + int(place)].idx_q for place in self.hinges]
        return np.array(places, dtype=np.intp), np.array(hinges, dtype=np.intp)

    def configuration(self, q_rigid: ArrayLike, hinge_angles: ArrayLike | None = None) -> Floats:
        """Return the plant's configuration.

        Args:
            q_rigid: Configuration of the rigid robot (nq,).
            hinge_angles: (h,), rad, in the order of `hinges`; None is nothing bent.

        Returns:
            Configuration of `robot` (nq,).

        Raises:
            InputError: a wrong length, or not finite.
        """
        places, hinges = self._places
        q = np.empty(self.robot.model.nq)
        q[places] = self.rigid.checked(q_rigid)
        q[hinges] = 0.0 if hinge_angles is None else self._checked_angles(hinge_angles, (hinges.size,))
        return q

    def rigid_configuration(self, q_plant: ArrayLike) -> Floats:
        """Return the configuration of the rigid robot (nq,): that of the plant (nq,) without its hinges.

        Raises:
            InputError: q has the wrong length or is not finite.
        """
        return self.robot.checked(q_plant)[self._places[0]]

    def _checked_angles(self, angles: ArrayLike, shape: tuple[int, ...]) -> Floats:
        values = as_floats("hinge angles", angles)
        if values.shape != shape or not np.all(np.isfinite(values)):
            names = ", ".join(self.robot.joint_names[place] for place in self.hinges) or "it has no hinge"
            raise InputError(
                f"hinge angles of shape {values.shape}; '{self.robot.name}' needs {self.hinges.size} finite numbers: "
                f"{names}"
            )
        return values

    def tip_deflections(self, hinge_angles: ArrayLike) -> Floats:
        """Return how far each appendage's tip stands out of its undeformed plane, along its normal.

        Args:
            hinge_angles: (..., h), rad, in the order of `hinges`.

        Returns:
            (..., a), m, in the order of `appendages`, for any size of angles.

        Raises:
            InputError: a wrong length, or not finite.
        """
        values = as_floats("hinge angles", hinge_angles)
        values = self._checked_angles(values, (*values.shape[:-1], self.hinges.size))
        tips, start = np.empty((*values.shape[:-1], len(self.appendages))), 0
        for i, appendage in enumerate(self.appendages):
            tips[..., i] = appendage.tip_deflection(values[..., start : start + appendage.segments])
            start += appendage.segments
        return tips

    def frequencies(self, q: ArrayLike | None = None) -> Floats:
        """Return the frequencies at which the appendages bend while the base floats free and the joints are held.

        Args:
            q: Configuration of the plant (nq,); None is all joints at zero, nothing bent.

        Returns:
            (h,), Hz, rising.

        Raises:
            InputError: q has the wrong length or is not finite.
        """
        if self.hinges.size == 0:
            return np.empty(0)
        model = self.robot.model
        at = self.robot.configuration() if q is None else self.robot.checked(q)
        upper = np.triu(pin.crba(model, pin.Data(model), at))
        M = upper + np.triu(upper, 1).T
        places = 6 + self.hinges
        M_bb, M_bh = M[:6, :6], M[:6, places]
        reduced = M[np.ix_(places, places)] - M_bh.T @ np.linalg.solve(M_bb, M_bh)
        squares = scipy.linalg.eigh(np.diag(self.stiffness[self.hinges]), reduced, eigvals_only=True)
        return np.sqrt(squares) / (2 * np.pi)

    def stiffest_frequency(self, q: ArrayLike | None = None) -> float:
        """Return the highest of `frequencies(q)`, Hz: what a time step has to resolve; 0 without appendages."""
        return float(self.frequencies(q).max(initial=0.0))
