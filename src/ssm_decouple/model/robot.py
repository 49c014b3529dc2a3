"""The robot: a URDF on a free-flyer root, with names."""

from __future__ import annotations

import copy
import warnings
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray

from ssm_decouple.errors import (
    DecoupleWarning,
    InputError,
    ModelError,
    as_floats,
    as_kind,
    as_text,
    as_whole,
    shown,
)
from ssm_decouple.model.appendage import Appendage, Modes, checked_appendages, inspect_remaining_bus
from ssm_decouple.model.inspection import inspect_urdf, refuse_impossible
from ssm_decouple.model.locked import locked_urdf
from ssm_decouple.model.origin import from_base
from ssm_decouple.model.payload import loaded_urdf, payload_body
from ssm_decouple.model.plain import pinocchio_model, plain_urdf
from ssm_decouple.model.reading import UNLIMITED as UNLIMITED
from ssm_decouple.model.urdf import Finding, parse_urdf, root_link, tip_links
from ssm_decouple.model.verify import refuse_other_numbers
from ssm_decouple.model.wheels import Wheel, wheel_axes, wheeled_urdf
from ssm_decouple.settled import Settled, fixed_array

if TYPE_CHECKING:
    from ssm_decouple.model.report import Report
    from ssm_decouple.momentum.coupling import Coupling

Floats = NDArray[np.float64]
UNIT = 1e-6  # how far the length of a quaternion may be off, as in the law's kernel
FARTHEST = 4 * np.pi  # rad: beyond it the position of a joint looks like degrees
MANY_GIGABYTES, MOST_GIGABYTES = 1.0, 5.0  # from 309 and from 533 joints on

_MIMICS = "it has joints that mimic others"
_FRAMES = (pin.FrameType.BODY, pin.FrameType.OP_FRAME, pin.FrameType.JOINT, pin.FrameType.FIXED_JOINT)


class Robot(Settled):
    """A spacecraft with arms, free to float: URDF text read by Pinocchio with a free-flyer root.

    `model` is the Pinocchio model and every configuration q is an ordinary Pinocchio configuration, so that any
    Pinocchio function works on them. Velocities are v = [base linear; base angular; joint rates], the base twist in
    base axes.

    What is read of the URDF stays as it is. `model` is Pinocchio's own and can be changed, but the other attributes,
    the URDF and so the record of a motion would not follow: a law and a simulation refuse a model whose bodies or
    placements were changed, and limits changed in it do nothing. Change the URDF, or use `with_payload`, `with_locked`
    and the like.

    Args:
        urdf: URDF text.
        name: What the robot is called in messages and results.
        end_effector: The link or frame that the tasks move. None takes the link called "end_effector", else the only
            tip of the arm.
        appendages: Solar wings and the like, on the root link, whose mass and inertia the URDF's root link already
            holds. The robot itself stays rigid; `Plant.of(robot)` is the one that bends.

    Attributes:
        urdf: The URDF text; as given, or in plain form where other readers would read it otherwise or not at all.
        findings: All that is suspicious in it or worth a note.
        name: As given.
        model: The `pinocchio.Model`.
        n_joints: Number n of joints after the root.
        joint_names: Names of those joints, in the order of the joint rates.
        wheel_names: Which of them are reaction wheels, in the same order; see `with_wheels`.
        link_names: Names of the links, each of which is a frame.
        end_effector: Name of the end-effector's frame; the root link where there is no joint.
        end_effector_id: Its Pinocchio frame index.
        rate_limits: Joint rate limits (n,) from the URDF, rad/s or m/s; inf where it gives none.
        position_limits: Lower and upper joint limits (n, 2), rad or m; infinite where there is none.
        mass: Total mass, kg.
        appendages: As given, a tuple.

    Raises:
        ModelError: the text is no URDF, cannot be simulated, or the end-effector does not exist or is ambiguous; or an
            appendage outweighs the root link, leaves it no possible inertia or shares a name with the URDF.
        InputError: two appendages share a name.
    """

    def __init__(
        self, urdf: str, *, name: str, end_effector: str | None = None, appendages: Iterable[Appendage] = ()
    ) -> None:
        as_text("name", name)
        root = parse_urdf(as_text("urdf", urdf, "give the text of a URDF; load_robot(..) takes a path"), name)
        self.findings: tuple[Finding, ...] = tuple(inspect_urdf(root))
        refuse_impossible(name, self.findings)
        self._warn(name)
        self.name = name
        self.urdf, reading = plain_urdf(root, urdf)
        try:
            self.model: pin.Model = pinocchio_model(root)
            refuse_other_numbers(self.model, reading)
        except ModelError as error:
            raise ModelError(f"robot '{name}': {error}") from error
        self.model.gravity.setZero()  # Pinocchio's own default would be in whatever a user computes with the model
        _refuse_too_many_joints(self.model, name)
        self._data = pin.Data(self.model)
        self._neutral: Floats = pin.neutral(self.model)
        self.n_joints: int = self.model.nv - 6
        self.joint_names: tuple[str, ...] = tuple(self.model.names[2:])
        wheels = wheel_axes(root)
        self.wheel_names: tuple[str, ...] = tuple(name for name in self.joint_names if name in wheels)
        self.link_names: tuple[str, ...] = tuple(f.name for f in self.model.frames if f.type == pin.FrameType.BODY)
        self.mass: float = pin.computeTotalMass(self.model)
        self.end_effector = self._choose_end_effector(end_effector, tip_links(root), root_link(root))
        self.end_effector_id: int = self.frame_id(self.end_effector)
        rates = np.array(self.model.velocityLimit[6:])
        self.rate_limits: Floats = fixed_array(np.where((rates > 0) & (rates < UNLIMITED), rates, np.inf))
        self.position_limits: Floats = self._read_position_limits()
        self._refuse_singular_inertia()
        self._bodies = _bodies_of(self.model)
        self.appendages: tuple[Appendage, ...] = self._fitting(appendages)

    def _warn(self, name: str) -> None:
        """Warn of what probably is not as the file means it."""
        kinds = {"principal moment": "no solid body has such an inertia", "<mimic>": _MIMICS}
        for words, told in kinds.items():
            listed = "; ".join(str(finding) for finding in self.findings if words in finding.message)
            if listed:
                warnings.warn(f"robot '{name}': {told}: {listed}", DecoupleWarning, stacklevel=4)

    def with_appendages(self, appendages: Iterable[Appendage]) -> Robot:
        """Return this robot with these appendages on its root link, instead of any that it has.

        Args:
            appendages: Their mass and inertia are part of the root link's already: the whole at rest does not change.

        Raises:
            ModelError: one outweighs the root link, leaves it no possible inertia or shares a name with the URDF.
            InputError: two share a name.
        """
        robot = copy.copy(self)
        robot._data = pin.Data(self.model)  # the model is shared, what is computed on it is not
        robot.__dict__["appendages"] = robot._fitting(appendages)
        return robot

    def with_payload(
        self, mass: float, centre_of_mass: ArrayLike, inertia: ArrayLike, frame: str | None = None
    ) -> Robot:
        """Return this robot with a rigid body in its hand.

        The body is a link of the new robot's URDF, called "payload" (or "payload_2" and so on where that is taken), so
        that the law, the plant, the report and any other tool see it. The end-effector stays where it is.

        Args:
            mass: kg.
            centre_of_mass: (3,), m, in the frame's axes, from its origin.
            inertia: About the centre of mass (3, 3), kg m2, in the frame's axes.
            frame: The link, or the joint, that holds it; None is the end-effector.

        Raises:
            InputError: a mass that is not positive, numbers of the wrong shape, or no such frame.
            ModelError: no body has such an inertia; the message gives its principal moments.
        """
        body = payload_body(mass, centre_of_mass, inertia)
        if frame is not None:
            as_text("frame", frame, "it is the link, or the joint, that holds the payload")
        root = parse_urdf(self.urdf, self.name)
        try:
            whole, payload = loaded_urdf(root, body, self.end_effector if frame is None else frame)
        except InputError as error:
            raise InputError(f"robot '{self.name}': {error}") from error
        return self._rebuilt(whole, f"{self.name} + {payload}")

    def with_wheels(self, wheels: Iterable[Wheel]) -> Robot:
        """Return this robot with these reaction wheels on its root link, beside any that it has.

        Their mass and inertia are part of the root link's already: the whole at rest does not change. Each is a joint
        of the new robot, so that configurations and joint rates have an entry for it: build configurations by joint
        name. The law spins wheels as it moves any joint, by the smallest joint rates that do, within their limits.

        Args:
            wheels: At least one; any number in directions that differ by a degree or more.

        Raises:
            InputError: none, two of one name, or two about the same axis.
            ModelError: a name that the URDF has, or wheels that outweigh the root link or leave it no possible inertia.
        """
        try:
            whole = wheeled_urdf(parse_urdf(self.urdf, self.name), wheels)
        except (InputError, ModelError) as error:
            raise type(error)(f"robot '{self.name}': {error}") from error
        text, name = ET.tostring(whole, encoding="unicode"), f"{self.name} + wheels"
        with mimics_told():
            return Robot(text, name=name, end_effector=self.end_effector, appendages=self.appendages)

    def with_locked(self, joints: Mapping[str, float]) -> Robot:
        """Return this robot with joints fixed where they stand: failed, braked, or not to be used.

        They are fixed joints of the new robot's URDF, so that configurations and joint rates have no entry for them:
        build configurations by joint name. The others keep their order, and end-effector, limits, appendages and
        wheels stay. With every joint locked what is left is a rigid spacecraft; with none, the robot as it is.

        Args:
            joints: Joint name to position, rad or m; within its limits or not.

        Raises:
            InputError: an unknown joint (the nearest known one is named), or a position that is not finite.
        """
        try:
            whole = locked_urdf(parse_urdf(self.urdf, self.name), joints, self.joint_names)
        except InputError as error:
            raise InputError(f"robot '{self.name}': {error}") from error
        self._warn_of_degrees(joints)
        listed = ", ".join(joints) if len(joints) < 4 else f"{len(joints)} joints"
        return self._rebuilt(whole, f"{self.name}, {listed} locked" if joints else self.name)

    def _rebuilt(self, root: ET.Element, name: str) -> Robot:
        """Return a robot of a changed URDF, without telling once more of inertias that this one has told of."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DecoupleWarning)
            text = ET.tostring(root, encoding="unicode")
            return Robot(text, name=name, end_effector=self.end_effector, appendages=self.appendages)

    def _fitting(self, appendages: Iterable[Appendage]) -> tuple[Appendage, ...]:
        try:
            found = checked_appendages(appendages)
            if not found:
                return found
            strange = inspect_remaining_bus(parse_urdf(self.urdf, self.name), found)
        except (InputError, ModelError) as error:
            raise type(error)(f"robot '{self.name}': {error}") from error
        for finding in strange:
            message = f"robot '{self.name}': no solid body has such an inertia: {finding}"
            warnings.warn(message, DecoupleWarning, stacklevel=3)
        return found

    def modes(self, per_appendage: int = 1) -> Modes:
        """Return the clamped bending modes of the appendages: frequencies, shapes and how the base drives them.

        Args:
            per_appendage: How many of each appendage, the lowest first.

        Raises:
            InputError: no appendage, fewer than one mode, or more than an appendage has segments.
        """
        if not self.appendages:
            raise InputError(
                f"'{self.name}' has no appendage and so no modes; give it some with robot.with_appendages([..]), or "
                "load a TOML robot such as 'ets_vii_flexible'"
            )
        return Modes.of(self.appendages, as_whole("per_appendage", per_appendage))

    def _choose_end_effector(self, wanted: str | None, tips: list[str], root: str) -> str:
        frames = self.link_names
        left_out = "".join(f"; {finding}" for finding in self.findings if "left out" in finding.message)
        if wanted is None:
            if "end_effector" in frames:
                return "end_effector"
            if len(tips) > 1:
                raise ModelError(
                    f"robot '{self.name}' has {len(tips)} tips: name one as end_effector: {', '.join(tips)}{left_out}"
                )
            return tips[0] if tips else root
        if not self._has_frame(as_text("end_effector", wanted)):
            raise ModelError(
                f"robot '{self.name}' has no frame '{wanted}' for its end-effector; it has {', '.join(frames)}"
                f"{left_out}"
            )
        return wanted

    def _read_position_limits(self) -> Floats:
        limits = np.full((self.n_joints, 2), [-np.inf, np.inf])
        for i, joint in enumerate(self.model.joints[2:]):
            if joint.nq == 1:
                limits[i] = self.model.lowerPositionLimit[joint.idx_q], self.model.upperPositionLimit[joint.idx_q]
        return fixed_array(np.where(np.abs(limits) < UNLIMITED, limits, np.copysign(np.inf, limits)))

    def _has_frame(self, name: str) -> bool:
        try:
            return self.frame_id(name) > 0
        except InputError:
            return False

    def frame_id(self, name: str) -> int:
        """Return the index of a link's frame, else of any other; a joint and a link may share a name.

        Raises:
            InputError: no such frame.
        """
        as_text("frame", name, f"it is the name of a frame of '{self.name}'")
        for kinds in _FRAMES:
            index = int(self.model.getFrameId(name, kinds)) if self.model.existFrame(name, kinds) else 0
            if index:  # the first is Pinocchio's own world, which is no part of the robot
                return index
        raise InputError(f"'{self.name}' has no frame '{name}'; its links are {', '.join(self.link_names)}")

    def refuse_changed_model(self) -> None:
        """Look whether `model` still is what the URDF says.

        Raises:
            ModelError: an inertia or a placement was changed after the robot was made; the joint is named.
        """
        for joint, (now, then) in enumerate(zip(_bodies_of(self.model), self._bodies, strict=True)):
            if not np.array_equal(now, then):
                raise ModelError(
                    f"robot '{self.name}': the body or the placement of joint '{self.model.names[joint]}' in "
                    "robot.model was changed after the robot was made, so that its URDF and its records would tell of "
                    "another robot; change the URDF, or use with_payload(..), with_locked(..) or perturbed(..)"
                )

    def _warn_of_degrees(self, positions: Mapping[str, float]) -> None:
        sizes = np.zeros(self.n_joints)
        for name, position in positions.items():
            if name in self.joint_names:
                sizes[self.joint_index(name)] = abs(float(position))
        warn_of_degrees(self, "joint positions", sizes, FARTHEST, "rad")

    def _refuse_singular_inertia(self) -> None:
        pin.computeCentroidalMap(self.model, self._data, self._neutral)
        whole = np.array(self._data.Ag[3:, 3:6])
        if not np.all(np.isfinite(whole)):
            raise ModelError(f"robot '{self.name}': the whole has no finite inertia; its links' numbers are too large")
        smallest, *_, largest = np.linalg.eigvalsh(whole)
        if not smallest > 1e-12 * largest:
            raise ModelError(
                f"robot '{self.name}': the whole has no rotational inertia about some axis (principal moments "
                f"{smallest:.3g} to {largest:.3g} kg m2), so H_ww is singular; give its links inertias"
            )

    def __repr__(self) -> str:
        wings = f", {len(self.appendages)} appendages" if self.appendages else ""
        return (
            f"Robot({self.name!r}, {self.n_joints} joints{wings}, {self.mass:g} kg, end_effector={self.end_effector!r})"
        )

    def configuration(
        self, joints: ArrayLike | Mapping[str, float] | None = None, base_pose: pin.SE3 | ArrayLike | None = None
    ) -> Floats:
        """Build a Pinocchio configuration.

        Args:
            joints: Joint positions, rad or m: an array (n,) in the order of `joint_names`, or a mapping by joint name
                in which missing joints are zero. None is all zero.
            base_pose: Pose of the base frame in the inertial frame, a `pin.SE3` or a homogeneous matrix (4, 4).
                None is the identity.

        Returns:
            The configuration q (nq,). A continuous joint takes two entries of it, cosine and sine.

        Raises:
            InputError: wrong length, an unknown joint name, a value that is not finite, or no rigid pose.

        Warns:
            DecoupleWarning: a joint that turns is more than two turns from zero, which looks like degrees.
        """
        displacement = np.zeros(self.model.nv)
        if isinstance(joints, Mapping):
            for name, value in joints.items():
                position = as_floats(f"joint position {name}", value)
                if position.shape != ():
                    raise InputError(f"joint position {name} is {shown(value)}; it needs one number")
                displacement[6 + self.joint_index(name)] = position
        elif joints is not None:
            values = as_floats("joint positions", joints)
            if values.shape != (self.n_joints,):
                raise InputError(
                    f"joint positions have shape {values.shape}, '{self.name}' needs ({self.n_joints},): "
                    f"{', '.join(self.joint_names)}"
                )
            displacement[6:] = values
        if not np.all(np.isfinite(displacement)):
            bad = [self.joint_names[i] for i in np.flatnonzero(~np.isfinite(displacement[6:]))]
            raise InputError(f"joint positions are not finite at {', '.join(bad)}")
        warn_of_degrees(self, "joint positions", np.abs(displacement[6:]), FARTHEST, "rad")
        q: Floats = pin.integrate(self.model, self._neutral, displacement)
        if base_pose is not None:
            q[:7] = pin.SE3ToXYZQUAT(rigid_pose("base_pose", base_pose))
        return q

    def joint_index(self, name: str) -> int:
        """Return the place of a joint among the joint rates.

        Raises:
            InputError: no such joint.
        """
        if not isinstance(name, str) or name not in self.joint_names:
            raise InputError(f"'{self.name}' has no joint {shown(name)}; it has {', '.join(self.joint_names)}")
        return self.joint_names.index(name)

    def joint_positions(self, q: ArrayLike) -> Floats:
        """Return the joint positions (n,), rad or m, of a configuration; continuous joints within (-pi, pi]."""
        return pin.difference(self.model, self._neutral, self.checked(q))[6:]

    def checked(self, q: ArrayLike) -> Floats:
        """Return q as an array that Pinocchio takes.

        Raises:
            InputError: wrong length, not finite, or its quaternion q[3:7] is not of unit length.
        """
        values = as_floats("configuration", q)
        if values.shape != (self.model.nq,):
            raise InputError(
                f"configuration has shape {values.shape}, '{self.name}' needs ({self.model.nq},); "
                "build it with robot.configuration(..)"
            )
        if not np.all(np.isfinite(values)):
            raise InputError(
                f"configuration is not finite at q[{', '.join(map(str, np.flatnonzero(~np.isfinite(values))))}]"
            )
        length = float(np.linalg.norm(values[3:7]))
        if abs(length - 1.0) > UNIT:
            raise InputError(f"quaternion q[3:7] has length {length:.7g}, not 1; use pinocchio.normalize(model, q)")
        for joint in self.model.joints[2:]:
            if joint.nq == 2 and abs(float(np.hypot(*values[joint.idx_q : joint.idx_q + 2])) - 1.0) > UNIT:
                raise InputError(
                    f"continuous joint '{self.model.names[joint.id]}' takes cosine and sine, q[{joint.idx_q}:"
                    f"{joint.idx_q + 2}] is {values[joint.idx_q : joint.idx_q + 2].tolist()}; build q with "
                    "robot.configuration(..)"
                )
        return values

    def base_pose(self, q: ArrayLike) -> pin.SE3:
        """Return the pose of the base frame in the inertial frame."""
        return pin.XYZQUATToSE3(self.checked(q)[:7])

    def frame_pose(self, q: ArrayLike, frame: str | None = None) -> pin.SE3:
        """Return the pose of a frame, by default the end-effector's, in the inertial frame."""
        index = self.end_effector_id if frame is None else self.frame_id(frame)
        pin.framesForwardKinematics(self.model, self._data, self.checked(q))
        return self._data.oMf[index].copy()

    @property
    def reach(self) -> float:
        """Distance, m, from the arm's first joint to the end-effector if the arm could be pulled straight.

        It is infinite where a joint slides without limits.
        """
        frame = self.model.frames[self.end_effector_id]
        length = float(np.linalg.norm(frame.placement.translation))
        chain = [joint for joint in self.model.supports[frame.parentJoint] if joint > 1]
        for joint in chain[1:]:
            length += float(np.linalg.norm(self.model.jointPlacements[joint].translation))
        for joint in chain:
            if self.model.joints[joint].shortname().startswith("JointModelP"):
                length += float(np.abs(self.position_limits[joint - 2]).max())
        return length

    def shoulder_position(self, q: ArrayLike) -> Floats:
        """Return where the arm's first joint stands (3,), m, inertial axes."""
        chain = [
            joint for joint in self.model.supports[self.model.frames[self.end_effector_id].parentJoint] if joint > 1
        ]
        pin.forwardKinematics(self.model, self._data, self.checked(q))
        return self._data.oMi[chain[0] if chain else 1].translation.copy()

    def coupling(self, q: ArrayLike) -> Coupling:
        """Return the momentum matrices at q: H_ww, H_wq, J_rc, J_base, J_g and more.

        Raises:
            InputError: q has the wrong length or is not finite.
        """
        from ssm_decouple.momentum.coupling import Coupling  # the next room: this method only opens its door

        return Coupling.at(self, q)

    def momentum(self, q: ArrayLike, v: ArrayLike) -> Floats:
        """Return the momentum of a motion: [linear; angular about the system centre of mass], inertial axes.

        Args:
            q: Configuration (nq,).
            v: Velocity (6 + n,): base twist in base axes, then joint rates.

        Returns:
            Momentum (6,), kg m/s and kg m2/s.

        Raises:
            InputError: q or v has the wrong length or is not finite.
        """
        velocity = as_floats("velocity", v)
        if velocity.shape != (self.model.nv,) or not np.all(np.isfinite(velocity)):
            raise InputError(
                f"velocity needs {self.model.nv} finite numbers: base twist (6), joint rates ({self.n_joints})"
            )
        pin.computeCentroidalMomentum(self.model, self._data, from_base(self.checked(q)), velocity)
        momentum = np.array(self._data.hg.vector)
        if not np.all(np.isfinite(momentum)):
            raise InputError(f"velocity is {shown(velocity.tolist())}; its momentum is beyond the largest number")
        return momentum

    @property
    def wheel_inertias(self) -> Floats:
        """Inertia of each reaction wheel about its axis (wheels,), kg m2, in the order of `wheel_names`."""
        found = []
        for name in self.wheel_names:
            joint = self.model.joints[self.model.getJointId(name)]
            axis = np.ravel(joint.createData().S)[3:]
            found.append(float(axis @ self.model.inertias[joint.id].inertia @ axis))
        return np.array(found)

    @property
    def wheel_torques(self) -> Floats:
        """Largest torque of each reaction wheel's motor (wheels,), N m; infinite where it has no limit."""
        efforts = np.array([self.model.effortLimit[6 + self.joint_index(name)] for name in self.wheel_names])
        return np.where((efforts > 0) & (efforts < UNLIMITED), efforts, np.inf)

    @property
    def acceleration_limits(self) -> Floats:
        """Largest joint accelerations (n,), rad/s2: of a reaction wheel max_torque / spin_inertia, else infinite.

        A law keeps them if they are given as its `acceleration_limit`.
        """
        limits = np.full(self.n_joints, np.inf)
        limits[[self.joint_index(name) for name in self.wheel_names]] = self.wheel_torques / self.wheel_inertias
        return limits

    def report(self) -> Report:
        """Return what the robot is made of and what is suspicious in it; print it to read it."""
        from ssm_decouple.model.report import Report

        return Report.of_robot(self)


@contextmanager
def mimics_told() -> Iterator[None]:
    """Build a robot from another one, which has told of its mimic joints."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", f".*{_MIMICS}", DecoupleWarning)
        yield


def _refuse_too_many_joints(model: pin.Model, name: str) -> None:
    """Say what Pinocchio's four tensors of second derivatives take: each of its data holds them, used or not."""
    gigabytes = 4 * 8e-9 * model.nv**3
    needs = (
        f"robot '{name}' has {model.nv - 6} joints; Pinocchio's working memory grows with the cube of their number, "
        f"{gigabytes:.2g} GB for each robot and each law"
    )
    if gigabytes > MOST_GIGABYTES:
        raise ModelError(f"{needs}: lock joints that may stand, with their links merged")
    if gigabytes > MANY_GIGABYTES:
        warnings.warn(needs, DecoupleWarning, stacklevel=4)


def rigid_pose(name: str, pose: pin.SE3 | ArrayLike) -> pin.SE3:
    """Return a pose given as a `pin.SE3` or as a homogeneous matrix (4, 4).

    Raises:
        InputError: it is neither, not finite, or its rotation is none.
    """
    matrix = pose.homogeneous if isinstance(pose, pin.SE3) else as_floats(name, pose)
    if matrix.shape != (4, 4):
        raise InputError(f"{name} is a pinocchio.SE3 or a homogeneous matrix (4, 4), not shape {matrix.shape}")
    if not np.all(np.isfinite(matrix)):
        raise InputError(f"{name} is not finite: {matrix.tolist()}")
    rotation = matrix[:3, :3]
    proper = np.linalg.norm(rotation.T @ rotation - np.eye(3)) < 1e-6 and np.linalg.det(rotation) > 0
    if not proper or not np.array_equal(matrix[3], [0, 0, 0, 1]):
        raise InputError(
            f"{name} is no rigid pose: its rotation needs right-handed orthonormal columns, its last row 0 0 0 1"
        )
    return pin.SE3(rotation, matrix[:3, 3])


def checked_robot(robot: Robot) -> Robot:
    """Return a robot.

    Raises:
        InputError: it is none; the message says how one is loaded.
    """
    mend = f"load it with load_robot({shown(robot)})" if isinstance(robot, str) else "load one with load_robot(..)"
    return as_kind("robot", robot, Robot, mend)


def warn_of_degrees(robot: Robot, name: str, sizes: Floats, largest: Floats | float, unit: str) -> None:
    """Warn where a joint that turns, other than a wheel, has a number above what radians would come to.

    Args:
        robot: The robot.
        name: What the numbers are called.
        sizes: (n,); infinite ones are no numbers.
        largest: Above it a number is looked at as degrees; one, or one a joint.
        unit: Of the numbers.

    Warns:
        DecoupleWarning: the message names the joint.
    """
    for joint in np.flatnonzero((sizes > largest) & np.isfinite(sizes)):
        kind, called = robot.model.joints[int(joint) + 2].shortname(), robot.joint_names[joint]
        if not kind.startswith("JointModelP") and called not in robot.wheel_names:
            warnings.warn(
                f"{name} of '{robot.name}': {sizes[joint]:g} {unit} at '{called}' looks like degrees; use "
                f"numpy.deg2rad(..)",
                DecoupleWarning,
                stacklevel=4,
            )
            return


def _bodies_of(model: pin.Model) -> Floats:
    """Return what a model's bodies and joints are made of (joints, 22): inertias and placements."""
    inertias = [inertia.toDynamicParameters() for inertia in model.inertias]
    placements = [placement.homogeneous[:3].ravel() for placement in model.jointPlacements]
    return np.hstack([inertias, placements])


def per_joint(robot: Robot, name: str, given: ArrayLike, infinity: str = "infinity for no limit") -> Floats:
    """Return numbers above zero (n,), read-only, from one for all joints or one for each.

    Raises:
        InputError: they do not fit; the message calls them `name`. `infinity` says what infinity means, "finite" that
            it is none of them.
    """
    values = as_floats(name, given)
    if values.shape not in ((), (robot.n_joints,)):
        raise InputError(f"{name} has shape {values.shape}; give one number or one for each of {robot.n_joints} joints")
    if not np.all(values > 0) or (infinity == "finite" and not np.all(np.isfinite(values))):
        raise InputError(f"{name} is {shown(given)}; every joint's must be above zero ({infinity})")
    return fixed_array(np.broadcast_to(values, (robot.n_joints,)))
