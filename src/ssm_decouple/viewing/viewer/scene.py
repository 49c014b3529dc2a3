"""What is drawn of a motion, as plain arrays: nothing here knows of a browser."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pinocchio as pin
import xarray as xr
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ssm_decouple.errors import DecoupleError, InputError
from ssm_decouple.model.appendage import Appendage
from ssm_decouple.model.robot import Robot
from ssm_decouple.simulation.motion import error_of, robot_of, rotations_to
from ssm_decouple.studies.comparison import disturbance
from ssm_decouple.viewing.viewer.parts import Color, Part, spacecraft_parts

Floats = NDArray[np.float64]

LARGEST_BEND = 0.12  # rad: what the exaggeration makes of the largest hinge angle to begin with
NOTHING = 1e-9  # momentum below this share of what the whole carries at the joints' pace is rounding
PLATE, PANEL = 0.006, (0.03, 0.08, 0.3)  # an appendage that no box draws: its thickness, of its span, and its colour
_SAMPLES = 25  # at which the room that a motion takes is measured


@dataclass(frozen=True)
class Wing:
    """An appendage that bends: plates on hinges, fixed to the base.

    Attributes:
        appendage: The appendage.
        first: Its first hinge among those of the record.
        thickness: Of its plates, m.
        color: Of its plates.
    """

    appendage: Appendage
    first: int
    thickness: float
    color: Color

    @property
    def span(self) -> Floats:
        """From root to tip (3,), m, base axes."""
        return self.appendage.span * np.array(self.appendage.span_direction)

    @property
    def plate(self) -> Part:
        """The whole, straight, in base axes."""
        return self._box(1, np.array(self.appendage.mount))

    @property
    def segment(self) -> Part:
        """The shape of one segment, in axes parallel to the base's when nothing bends, from its hinge."""
        return self._box(self.appendage.segments, np.zeros(3))

    def _box(self, parts: int, root: Floats) -> Part:
        wing = self.appendage
        R = np.column_stack([wing.turned_normal, wing.span_direction, -wing.hinge_axis])
        size = (self.thickness, wing.span / parts, wing.chord)
        return Part(wing.name, "", 1, "box", size, pin.SE3(R, root + 0.5 * self.span / parts), self.color)

    def poses(self, angles: Floats) -> tuple[Floats, Floats]:
        """Return where the segments stand in base axes.

        Args:
            angles: Of all hinges (.., h), rad.

        Returns:
            Positions (.., segments, 3), m, and quaternions (.., segments, 4), w x y z.
        """
        segments, axis, root = self.appendage.segments, self.appendage.hinge_axis, np.array(self.appendage.mount)
        total = np.cumsum(angles[..., self.first : self.first + segments], axis=-1)
        half = 0.5 * total[..., None]
        wxyz = np.concatenate([np.cos(half), np.sin(half) * axis], axis=-1)
        step = self.span / segments
        lifted = np.cos(total)[..., None] * step + np.sin(total)[..., None] * np.cross(axis, step)
        ends = root + np.cumsum(lifted, axis=-2)
        starts = np.concatenate([np.broadcast_to(root, ends[..., :1, :].shape), ends[..., :-1, :]], axis=-2)
        return starts, wxyz


class Vectors(NamedTuple):
    """What the arrows on a base show, in inertial axes.

    Attributes:
        base: Where it is (3,), m.
        attitude: Its quaternion w x y z (4,).
        axes: Quaternion w x y z of the axes in which U_c is fixed (4,).
        shares: How far each column of U_c is protected (k,), 0 to 1.
        free: Base angular velocity but for its protected part (3,), rad/s.
        protected: Its protected part (3,), rad/s.
        momentum: Angular momentum about the centre of mass (3,), N m s; zero where there is nothing but rounding.
    """

    base: Floats
    attitude: Floats
    axes: Floats
    shares: Floats
    free: Floats
    protected: Floats
    momentum: Floats


class Frame(NamedTuple):
    """A motion at one time. Quaternions are w x y z.

    Attributes:
        sample: The sample at or before it.
        positions: Of the bodies (b, 3), m, inertial axes.
        quaternions: Of the bodies (b, 4), body to inertial.
        target: (3,), m, inertial axes; not numbers where there is none.
        vectors: What the arrows show.
    """

    sample: int
    positions: Floats
    quaternions: Floats
    target: Floats
    vectors: Vectors


@dataclass(frozen=True)
class Scene:
    """A motion ready to be drawn.

    Attributes:
        name: What it is called on the page, its law for example.
        motion: The record.
        robot: Its robot.
        parts: The shapes, without the wings that bend.
        wings: The wings that bend.
        joints: Pinocchio joint of each body; the first is the base.
        body_poses: Of the bodies, inertial axes (m, b, 7): position, then quaternion w x y z without jumps of sign.
        hinge_angles: (m, h), rad; h is 0 where nothing bends.
        axes: Quaternions w x y z of the axes in which U_c is fixed (m, 4).
        rates: Base angular velocity, inertial axes (2, m, 3): its free part, then its protected one, rad/s.
        shares: How far each column of U_c is protected (m, k), 0 to 1.
        protected_rate: Largest along the directions that the motion's case protects (m,), rad/s; None where there is
            none.
        angular_momentum: (m, 3), N m s, and nothing but rounding where `has_momentum` is false.
        has_momentum: Whether there is any.
    """

    name: str
    motion: xr.Dataset
    robot: Robot
    parts: tuple[Part, ...]
    wings: tuple[Wing, ...]
    joints: tuple[int, ...]
    body_poses: Floats
    hinge_angles: Floats
    axes: Floats
    rates: Floats
    shares: Floats
    protected_rate: Floats | None
    angular_momentum: Floats
    has_momentum: bool

    @classmethod
    def of(cls, name: str, motion: xr.Dataset, mesh_folders: Sequence[str | Path] = ()) -> Scene:
        """Prepare a motion.

        Raises:
            InputError: the record does not fit the robot that it holds.
        """
        robot = _checked_robot(name, motion)
        turned = json.loads(motion.attrs.get("turned", "{}"))
        parts = spacecraft_parts(robot, turned, mesh_folders)
        wings = wings_of(motion, parts)
        bending = {wing.appendage.name for wing in wings}
        rigid = tuple(part for part in parts if part.joint > 1 or part.name not in bending)
        joints = (1, *sorted({part.joint for part in rigid} - {1}))
        configurations = motion.configuration.values
        axes = _axes(robot, motion)
        momentum = motion.angular_momentum.values
        return cls(
            name=name,
            motion=motion,
            robot=robot,
            parts=rigid,
            wings=wings,
            joints=joints,
            body_poses=body_poses(robot, configurations, joints),
            hinge_angles=motion.hinge_angles.values if wings else np.zeros((len(configurations), 0)),
            axes=axes,
            rates=_split_rates(motion, axes),
            shares=_shares(motion),
            protected_rate=_protected_rate(motion),
            angular_momentum=momentum,
            has_momentum=bool(np.abs(momentum).max() > NOTHING * _usual_momentum(robot, motion)),
        )

    @cached_property
    def time(self) -> Floats:
        """Sample times (m,), s."""
        return self.motion.time.values.astype(float)

    @cached_property
    def targets(self) -> Floats:
        """Where the end-effector should be (m, 3), m; not numbers where no task says so."""
        return self.motion.target_position.values

    @cached_property
    def distance(self) -> Floats:
        """Distance to the target, or the norm of the errors of level 1 (m,), m."""
        return error_of(self.motion)

    @property
    def distance_unit(self) -> str:
        """In which unit a page tells the distance: mm, or of other tasks, whose errors mix them, m and rad."""
        return "m, rad" if "task_error" in self.motion else "mm"

    @property
    def distance_shown(self) -> Floats:
        """The distance (m,) in that unit."""
        return self.distance * (1e3 if self.distance_unit == "mm" else 1.0)

    @cached_property
    def turned_deg(self) -> Floats:
        """How far the base has turned from where it stood at the start (m,), deg."""
        attitude = Rotation.from_quat(self.motion.base_quaternion.values)
        return np.rad2deg((attitude[0].inv() * attitude).magnitude())

    @cached_property
    def box(self) -> Floats:
        """The room that the spacecraft, its path and its target take, lowest and highest corner (2, 3), m."""
        points = [self.motion.end_effector_position.values, self.motion.target_position.values]
        everything = [*self.parts, *(wing.plate for wing in self.wings)]
        which = {joint: place for place, joint in enumerate(self.joints)}
        for sample in np.unique(np.linspace(0, len(self.time) - 1, _SAMPLES).astype(int)):
            for part in everything:
                pose = self.body_poses[sample, which[part.joint]]
                R = Rotation.from_quat(pose[[4, 5, 6, 3]]).as_matrix()
                points.append(part.corners @ R.T + pose[:3])
        cloud = np.vstack(points)
        return np.array([np.nanmin(cloud, axis=0), np.nanmax(cloud, axis=0)])

    def at(self, time: float, exaggeration: float = 1.0) -> Frame:
        """Return the motion at a time, s; poses between samples are interpolated.

        The bodies of a frame are those of `joints`, then the segments of the wings, their bending exaggerated.
        """
        i = int(np.clip(np.searchsorted(self.time, time, side="right") - 1, 0, len(self.time) - 1))
        j = min(i + 1, len(self.time) - 1)
        share = 0.0 if i == j else float(np.clip((time - self.time[i]) / (self.time[j] - self.time[i]), 0.0, 1.0))

        def between(values: Floats) -> Floats:
            return values[i] if share == 0.0 else (1.0 - share) * values[i] + share * values[j]

        poses = between(self.body_poses)
        positions, quaternions = poses[:, :3], unit(poses[:, 3:])
        if self.wings:
            bent = self._segments(between(self.hinge_angles) * exaggeration, positions[0], quaternions[0])
            positions, quaternions = np.vstack([positions, bent[0]]), np.vstack([quaternions, bent[1]])
        return Frame(
            sample=i,
            positions=positions,
            quaternions=quaternions,
            target=between(self.targets),
            vectors=Vectors(
                base=positions[0],
                attitude=quaternions[0],
                axes=unit(between(self.axes)),
                shares=self.shares[i],
                free=self.rates[0, i],
                protected=self.rates[1, i],
                momentum=self.angular_momentum[i] * self.has_momentum,
            ),
        )

    def _segments(self, angles: Floats, base: Floats, attitude: Floats) -> tuple[Floats, Floats]:
        parts = [wing.poses(angles) for wing in self.wings]
        positions, quaternions = (np.vstack([part[i] for part in parts]) for i in (0, 1))
        turn = Rotation.from_quat(attitude[[1, 2, 3, 0]])
        turned = (turn * Rotation.from_quat(quaternions[:, [1, 2, 3, 0]])).as_quat()
        return base + turn.apply(positions), turned[:, [3, 0, 1, 2]]

    def riding(self, frame: Frame) -> tuple[Floats, Floats]:
        """Return position (3,) and quaternion (4,) of inertial axes as one who rides on the base sees them.

        At the start they are at rest where they are, so that both views begin alike.
        """
        start = _se3(self.body_poses[0, 0])
        now = _se3(np.r_[frame.positions[0], frame.quaternions[0]])
        seen = start * now.inverse()
        return seen.translation, _wxyz(seen.rotation)


def usual_exaggeration(scenes: Sequence[Scene]) -> float:
    """Return by what factor the largest bending of several motions is well seen: 1, 2 or 5 times a power of ten."""
    largest = max(float(np.abs(scene.hinge_angles).max(initial=0.0)) for scene in scenes)
    if largest == 0.0 or largest > LARGEST_BEND:
        return 1.0
    power = 10.0 ** np.floor(np.log10(LARGEST_BEND / largest))
    return float(power * max(step for step in (1, 2, 5) if step * power <= LARGEST_BEND / largest))


def body_poses(robot: Robot, configurations: Floats, joints: Sequence[int]) -> Floats:
    """Return the poses of joints (m, b, 7), inertial axes: position, quaternion w x y z without jumps of sign."""
    data, poses = robot.model.createData(), np.empty((len(configurations), len(joints), 7))
    for i, q in enumerate(configurations):
        pin.forwardKinematics(robot.model, data, q)
        for b, joint in enumerate(joints):
            x, y, z, *turn = pin.SE3ToXYZQUAT(data.oMi[joint])
            poses[i, b] = x, y, z, turn[3], turn[0], turn[1], turn[2]
    poses[..., 3:] = without_jumps(poses[..., 3:])
    return poses


def without_jumps(quaternions: Floats) -> Floats:
    """Return quaternions (m, .., 4), the same rotations, whose sign never jumps from one to the next."""
    dots = np.sum(quaternions[1:] * quaternions[:-1], axis=-1)
    signs = np.cumprod(np.where(dots < 0, -1.0, 1.0), axis=0)
    return np.concatenate([quaternions[:1], quaternions[1:] * signs[..., None]])


def unit(quaternions: Floats) -> Floats:
    """Return quaternions (.., 4) of length one."""
    return quaternions / np.linalg.norm(quaternions, axis=-1, keepdims=True)


def rotated(wxyz: Floats, vector: Floats) -> Floats:
    """Return a vector (3,) turned by a quaternion (4,)."""
    return pin.Quaternion(*map(float, wxyz)).toRotationMatrix() @ vector


def _se3(pose: Floats) -> pin.SE3:
    return pin.XYZQUATToSE3(np.r_[pose[:3], pose[4:7], pose[3]])


def _wxyz(R: Floats) -> Floats:
    return Rotation.from_matrix(R).as_quat()[[3, 0, 1, 2]]


def _checked_robot(name: str, motion: xr.Dataset) -> Robot:
    try:
        robot = robot_of(motion)
    except KeyError as error:
        raise InputError(f"motion '{name}' lacks the attribute {error}; make it with simulate(..)") from None
    except DecoupleError as error:
        raise InputError(f"motion '{name}' holds a robot that cannot be read: {error}") from error
    if motion.configuration.shape[1:] != (robot.model.nq,):
        raise InputError(
            f"motion '{name}' has configurations of {motion.sizes['q']} numbers and holds the URDF of "
            f"'{robot.name}', which needs {robot.model.nq}: it is the motion of another robot"
        )
    lost = int(np.sum(~np.isfinite(motion.configuration.values).all(axis=1)))
    if lost:
        raise InputError(
            f"motion '{name}' has {lost} of {motion.sizes['time']} samples whose configuration is not finite; show "
            "those before them: motion.isel(time=slice(0, ..))"
        )
    if tuple(motion.joint.values) != robot.joint_names:
        raise InputError(
            f"motion '{name}' moves the joints {', '.join(map(str, motion.joint.values))} and holds the URDF of "
            f"'{robot.name}', which has {', '.join(robot.joint_names)}: it is the motion of another robot"
        )
    return robot


def _law(motion: xr.Dataset) -> dict[str, object]:
    return dict(json.loads(motion.attrs.get("law", "{}")))


def _axes(robot: Robot, motion: xr.Dataset) -> Floats:
    """Return the quaternions w x y z (m, 4) of the axes in which U_c is fixed, to inertial axes."""
    configurations = motion.configuration.values
    base = Rotation.from_quat(np.ascontiguousarray(configurations[:, 3:7]))
    turned = rotations_to(robot, str(_law(motion).get("frame", "base")), configurations)
    axes = base if turned is None else base * Rotation.from_matrix(turned).inv()
    return without_jumps(axes.as_quat()[:, [3, 0, 1, 2]])


def _shares(motion: xr.Dataset) -> Floats:
    if "protection_share" in motion:
        return np.asarray(motion.protection_share.values, dtype=float)
    return np.ones((motion.sizes["time"], motion.sizes["protected"]))


def _split_rates(motion: xr.Dataset, axes: Floats) -> Floats:
    """Return the base angular velocity in inertial axes (2, m, 3): its free part, then its protected one."""
    rates = Rotation.from_quat(motion.base_quaternion.values).apply(motion.base_angular_velocity.values)
    U_c, active = motion.U_c.values, _shares(motion) > 0
    split = np.empty((2, *rates.shape))
    for kind in np.unique(active, axis=0):
        which = np.all(active == kind, axis=1)
        split[:, which] = split_rate(rates[which], U_c[:, kind], axes[which])
    return split


def split_rate(rates: Floats, U_twist: Floats, axes: Floats) -> Floats:
    """Return the free and the protected part (2, m, 3) of angular velocities.

    Where protected directions have linear parts no part of the angular velocity alone is protected, and all is free.

    Args:
        rates: (m, 3), rad/s, inertial axes.
        U_twist: Protected directions, twists (6, k).
        axes: Quaternions w x y z (m, 4) of the axes in which these are fixed.
    """
    held = np.zeros_like(rates)
    if U_twist.size and not np.any(U_twist[:3]):
        turn, basis = Rotation.from_quat(axes[:, [1, 2, 3, 0]]), np.linalg.qr(U_twist[3:])[0]
        held = turn.apply(turn.inv().apply(rates) @ basis @ basis.T)
    return np.array([rates - held, held])


def _protected_rate(motion: xr.Dataset) -> Floats | None:
    rate = disturbance(motion)[0] if "case_U_c" in motion.attrs else motion.protected_rate.values
    return np.abs(rate).max(axis=1) if rate.shape[1] else None


def _usual_momentum(robot: Robot, motion: xr.Dataset) -> float:
    return robot.mass * max(float(np.abs(motion.joint_rates.values).max(initial=0.0)), 1e-3)


def wings_of(motion: xr.Dataset, parts: Sequence[Part]) -> tuple[Wing, ...]:
    """Return the appendages that bend. The box on the base that has the name of one is what draws it straight."""
    wings: list[Wing] = []
    first = 0
    for entry in json.loads(motion.attrs.get("appendages", "[]")):
        appendage = Appendage(**entry)
        box = next((part for part in parts if (part.name, part.kind, part.joint) == (appendage.name, "box", 1)), None)
        thickness, color = (PLATE * appendage.span, PANEL) if box is None else (min(box.size), box.color)
        wings.append(Wing(appendage, first, thickness, color))
        first += appendage.segments
    return tuple(wings)
