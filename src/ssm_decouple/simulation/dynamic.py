"""Dynamic simulation: torques drive the joints; the base and the hinges of its appendages move as physics has it."""

from __future__ import annotations

import json
import warnings
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
import pinocchio as pin
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from ssm_decouple.control.law import SelectiveLaw
from ssm_decouple.control.schedule import ScheduledLaw
from ssm_decouple.errors import (
    DecoupleWarning,
    InputError,
    as_floats,
    as_not_negative,
    as_positive,
    as_seed,
    as_switch,
    shown,
)
from ssm_decouple.model.massless import refuse_singular_mass_matrix
from ssm_decouple.model.plant import Plant
from ssm_decouple.model.robot import UNLIMITED, Robot
from ssm_decouple.model.tree import Tree
from ssm_decouple.simulation import physics
from ssm_decouple.simulation.motion import (
    build_motion,
    flagged_spans,
    joint_positions,
    rotations_to,
    twist_along,
    wheel_momenta,
)

Floats = NDArray[np.float64]

# Radians of the fastest motion in one physics step: there the integrator's own damping ratio is 2e-4.
COARSEST = 0.5
# Steps times the squared number of velocities that one compiled call does: some 0.2 s.
STEP_WORK = 2_000_000
# Of the servo's own time, 1 / (2 pi frequency), at most: so long a piece of a joint's path is a cubic to 1e-8 rad.
PIECE = 0.8
MOST_STEPS = 1e8  # of physics in a motion: some twenty minutes of a six-joint arm
NEXT_TO_NOTHING = 1e-8  # rad or m, of a protected direction: two thousandths of an arcsecond
TINY = 1e-300  # keeps a share of nothing from being NaN

# What a dynamic motion records beside the rest. name: (dimensions, unit, frame, meaning)
VARIABLES: dict[str, tuple[tuple[str, ...], str, str, str]] = {
    "joint_velocities": (("time", "joint"), "rad/s or m/s", "joint", "true joint rates"),
    "joint_torques": (("time", "joint"), "N m or N", "joint", "torques of the drives just before the sample"),
    "hinge_angles": (("time", "hinge"), "rad", "hinge", "bending of the appendages"),
    "tip_deflection": (("time", "appendage"), "m", "normal", "tip of each appendage out of its undeformed plane"),
    "kinetic_energy": (("time",), "J", "", "audit: kinetic energy of the plant"),
    "spring_energy": (("time",), "J", "", "audit: energy in the hinges' springs"),
    "drive_work": (("time",), "J", "", "audit: work of the joint drives so far"),
    "load_work": (("time",), "J", "", "audit: work of the external wrench so far"),
    "damping_loss": (("time",), "J", "", "audit: energy lost in the hinges' dampers so far"),
    "saturated_time": (("time",), "s", "", "time so far in which a drive stood at its torque limit"),
    "protected_angle_parts": (
        ("time", "cause", "protected"),
        "rad, or m and rad",
        "U_c",
        "what the protected angle is made of: the law's plan, the servo's errors, and what the model does not know",
    ),
}

# Whose part of the protected angle stands where: of the commands, done at once from each sample on, by the law's model;
# of the joints' motion beside them, by that model; of all that the model does not know. They add up to the truth.
CAUSES = ("plan", "servo", "model")


class DivergedError(FloatingPointError):
    """The equations of motion have run away; the message says when, s."""


@dataclass(frozen=True)
class Servo:
    """The joint drives: computed torque, by the model that the law has, with a loop on position and rate.

    Each joint answers to the commanded rates like the same second-order system, so that the joint rates stay weighted
    means of commands: what the drives' lag costs the protection falls with about the square of the frequency.

    Attributes:
        frequency: Natural frequency, Hz.
        damping_ratio: 1 is critical.
        period: Longest time between two torques, s; it is shortened to divide the time between samples. None makes a
            new one in each physics step.
        torque_limits: Largest torques (n,), N m, or one number; None takes the URDF's efforts.
        protects: Whether each torque also holds the base along the protected directions, by what base sensors tell at
            the drives' own pace: the least change of the joint accelerations that gives the base, along them, the
            acceleration of a loop with the same frequency and damping. Commands alone protect at the law's pace.
    """

    frequency: float = 2.0
    damping_ratio: float = 1.0
    period: float | None = None
    torque_limits: ArrayLike | None = None
    protects: bool = False

    def __post_init__(self) -> None:
        for name in ("frequency", "damping_ratio", "period"):
            if name != "period" or self.period is not None:
                object.__setattr__(self, name, as_positive(f"servo {name}", getattr(self, name)))
        object.__setattr__(self, "protects", as_switch("servo protects", self.protects))
        if self.torque_limits is not None:
            limits = as_floats("torque_limits", self.torque_limits)
            if limits.ndim > 1 or np.any(np.isnan(limits)):  # whether they fit the joints is for the robot to say
                raise InputError(
                    f"torque_limits is {shown(self.torque_limits)}; give one positive number or one for each joint, N m"
                )
            object.__setattr__(self, "torque_limits", tuple(limits.tolist()) if limits.ndim else float(limits))


@dataclass(frozen=True)
class Sensors:
    """What the law and its feedback see instead of the truth; the drives have sensors of their own.

    Attributes:
        encoder_noise: Standard deviation of each joint position at each sample, rad or m.
        encoder_resolution: Joint positions are rounded to multiples of it, rad or m.
        gyro_noise: Standard deviation of each component of the base angular velocity, a mean over a sample, rad/s.
        seed: Of the noise.
    """

    encoder_noise: float = 0.0
    encoder_resolution: float = 0.0
    gyro_noise: float = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("encoder_noise", "encoder_resolution", "gyro_noise"):
            object.__setattr__(self, name, as_not_negative(name, getattr(self, name)))
        object.__setattr__(self, "seed", as_seed("seed of the sensors", self.seed))


@dataclass(frozen=True)
class Load:
    """A force and torque from outside that acts on the base for a while.

    Attributes:
        torque: N m (3,), base axes.
        force: N (3,), at the base origin, base axes.
        start: When it begins, s.
        duration: How long it acts, s. Both times are rounded to physics steps.
    """

    torque: tuple[float, float, float] = (0.0, 0.0, 0.0)
    force: tuple[float, float, float] = (0.0, 0.0, 0.0)
    start: float = 0.0
    duration: float = np.inf

    def __post_init__(self) -> None:
        wrench = as_floats("load force", self.force), as_floats("load torque", self.torque)
        if any(part.shape != (3,) or not np.all(np.isfinite(part)) for part in wrench):
            raise InputError(f"load is {shown(self)}; force and torque need 3 finite numbers each")
        object.__setattr__(self, "start", as_not_negative("start of the load", self.start))
        duration = as_floats("duration of the load", self.duration)
        if duration.shape != () or not duration > 0:
            raise InputError(f"duration of the load is {shown(self.duration)}; it must be above zero, s, or infinite")
        object.__setattr__(self, "duration", float(duration))
        for name, part in zip(("force", "torque"), wrench, strict=True):
            object.__setattr__(self, name, tuple(part.tolist()))


@dataclass(frozen=True)
class Dynamic:
    """The physics of a dynamic simulation.

    Attributes:
        step: Longest physics step, s; it is shortened to divide the time between samples.
        servo: The drives; None prescribes the joint rates: they follow each command at once, whatever torque it takes,
            and joint_torques tell it, but for the impulses at the jumps.
        plant: What really moves, where it differs from the law's robot; its appendages bend. None is the law's robot
            with its own appendages.
        sensors: What the law sees; None is the truth.
        load: What acts from outside; None is nothing, so that momentum is conserved.
        feedback_gain: K, 1/s, of J_sub q_dot = -K theta, with theta the rotation about the protected axes as the
            gyros tell it; 0 for no feedback. K times the time between samples has to stay below 1, or it overshoots.
    """

    step: float = 1e-3
    servo: Servo | None = field(default_factory=Servo)
    plant: Robot | None = None
    sensors: Sensors | None = None
    load: Load | None = None
    feedback_gain: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "step", as_positive("physics step", self.step))
        object.__setattr__(self, "feedback_gain", as_not_negative("feedback_gain", self.feedback_gain))
        kinds = {"servo": Servo, "plant": Robot, "sensors": Sensors, "load": Load}
        for name, kind in kinds.items():
            value = getattr(self, name)
            if value is not None and not isinstance(value, kind):
                raise InputError(f"{name} is {shown(value)}; give a {kind.__name__}, or None")
        if self.servo is not None and self.servo.protects and self.feedback_gain:
            raise InputError(
                "feedback_gain and a servo that protects would both hold the protected directions; use one"
            )

    def describe(self) -> dict[str, Any]:
        """Return the settings in plain types, for a record."""
        plain: dict[str, Any] = {"step": self.step, "feedback_gain": self.feedback_gain}
        plain["plant"] = None if self.plant is None else self.plant.name
        for name in ("servo", "sensors", "load"):
            part = getattr(self, name)
            plain[name] = None if part is None else asdict(part)
        if self.servo is not None and self.servo.torque_limits is not None:
            plain["servo"]["torque_limits"] = np.asarray(self.servo.torque_limits).tolist()
        return plain


def tree_of(model: pin.Model) -> tuple[NDArray[np.int64], Floats]:
    """Return what `physics` needs of a Pinocchio model: the parent of each joint (N,) and the bodies (N + 1, ..).

    Raises:
        InputError: a joint with more than one degree of freedom, which URDFs do not have.
    """
    read = Tree.of(model)
    tree = np.zeros((len(read.masses), physics.TREE_SIZE))
    tree[0, [0, 4, 8]] = 1.0
    tree[1:, : physics.TRANSLATION] = read.rotations.reshape(-1, 9)
    tree[1:, physics.TRANSLATION : physics.AXIS] = read.translations
    tree[1:, physics.AXIS : physics.PRISMATIC] = read.axes
    tree[1:, physics.PRISMATIC] = read.slides
    tree[:, physics.BODY_MASS] = read.masses
    tree[:, physics.CENTRE : physics.INERTIA] = read.centres
    rows, columns = np.triu_indices(3)
    tree[:, physics.INERTIA :] = read.inertias[:, rows, columns]
    return read.parents, tree


class DynamicMotion:
    """A plant in motion: its state, its running sums and what of them is recorded at each sample.

    Args:
        settings: The physics.
        law: The law that commands it.
        q: Start configuration of the law's robot (nq,); joints are at rest, appendages straight, and base and all move
            as the law's momentum on board makes them.
        dt: Time between samples, s.

    Raises:
        InputError: a number that makes no sense, another robot's joints, or a physics step that is too long.
    """

    def __init__(self, settings: Dynamic, law: SelectiveLaw, q: Floats, dt: float = 0.0) -> None:
        _refuse_unfit_feedback(settings, law, dt)
        self.settings, self.law = settings, law
        robot = law.robot
        self.plant = Plant.of(settings.plant or robot)
        _refuse_other_joints(robot, self.plant.rigid)
        # The law's joints by name among the plant's.
        order = [self.plant.rigid.joint_names.index(name) for name in robot.joint_names]
        self.driven = np.ascontiguousarray(self.plant.driven[order], dtype=np.int64)
        there = dict(zip(robot.joint_names, robot.joint_positions(q), strict=True))
        self.start = self.plant.configuration(self.plant.rigid.configuration(there, robot.base_pose(q)))
        # Joints that follow their commands whatever torque it takes need no inertia: only what is left free does.
        free, _ = physics.split(self.driven, self.plant.robot.model.nv, settings.servo is None)
        refuse_singular_mass_matrix(self.plant.robot.model, self.start, self.plant.robot.name, free)
        self.q = self._positions(self.start)
        self.v: Floats = np.zeros(self.plant.robot.model.nv)
        model = self.plant.robot.model
        A_g = pin.computeCentroidalMap(model, pin.Data(model), self.start)
        self.v[:6] = np.linalg.solve(A_g[:, :6], law.momentum)
        attitude = pin.Quaternion(q[3:7]).matrix()
        self._plant_moved: Floats = np.zeros(self.plant.robot.model.nv)
        self._law_moved: Floats = np.zeros(robot.model.nv)
        self.pose: Floats = np.r_[attitude.ravel(), q[:3]]
        self.reference: Floats = self.q[self.driven].copy()
        self.drives: Floats = np.zeros((physics.DRIVES_SIZE, robot.n_joints))
        self.torques: Floats = self.drives[: physics.LIMITED_TIME]
        self.totals: Floats = np.zeros(physics.TOTALS_SIZE)
        self.directions, self.axes = law.directions
        k = self.directions.shape[1]
        self.parts: Floats = np.zeros((physics.PARTS_SIZE, k))
        self.measured: Floats = np.zeros(k)
        self._piece: Floats = np.zeros((5, robot.n_joints))
        self._samples: list[tuple[Floats, ...]] = []
        self._noise = np.random.default_rng(settings.sensors.seed if settings.sensors else 0)
        self._limits = _torque_limits(robot, settings.servo)
        joints = np.vstack([self.plant.stiffness, self.plant.damping])
        protects = settings.servo is not None and settings.servo.protects
        if protects and (self.axes not in ("base", "inertial") or isinstance(law, ScheduledLaw)):
            raise InputError(
                "a servo that protects holds one protection, fixed in base or inertial axes: no schedule and no axes "
                f"of '{self.axes}'"
            )
        plant, own = tree_of(self.plant.robot.model), tree_of(robot.model)
        self._on_board = law.momentum
        self._differs = settings.load is not None or any(map(_differ, plant, own))
        self._bodies, U = self._axes_of_directions()
        self._constants = (*plant, joints, self.driven, *own, self._limits, U)
        self._steps_at_once = max(1, STEP_WORK // (6 + self.q.size) ** 2)
        _refuse_coarse_step(settings, self.plant, self.start)

    def _axes_of_directions(self) -> tuple[tuple[int, int], Floats]:
        """Return the bodies, of plant and model, in whose axes the protected directions are, and those (6, k) there."""
        if self.axes in ("base", "inertial"):
            body = -1 if self.axes == "inertial" else 0
            return (body, body), self.directions.copy()
        model = self.law.robot.model
        held = model.frames[self.law.robot.frame_id(self.axes)]
        R = held.placement.rotation
        turned = np.vstack([R @ self.directions[:3], R @ self.directions[3:]])
        if held.parentJoint == 1:
            return (0, 0), turned
        return (self.plant.robot.model.getJointId(model.names[held.parentJoint]) - 1, held.parentJoint - 1), turned

    def _positions(self, q: Floats) -> Floats:
        return pin.difference(self.plant.robot.model, pin.neutral(self.plant.robot.model), q)[6:]

    def configuration(self) -> Floats:
        """Return the plant's configuration (nq,), Pinocchio's."""
        return self._with_base(self.plant.robot.model, self._plant_moved, self.q)

    def _with_base(self, model: pin.Model, moved: Floats, positions: Floats) -> Floats:
        """Return a configuration of a model with the base where it is; `moved` is a buffer, its base part zero."""
        moved[6:] = positions
        q: Floats = pin.integrate(model, pin.neutral(model), moved)
        q[:3] = self.pose[9:]
        q[3:7] = pin.Quaternion(self.pose[:9].reshape(3, 3)).normalized().coeffs()
        return q

    def seen(self) -> Floats:
        """Return the configuration of the law's robot (nq,) as the sensors tell it."""
        positions, sensors = self.q[self.driven], self.settings.sensors
        if sensors is not None:
            positions = positions + sensors.encoder_noise * self._noise.standard_normal(positions.size)
            if sensors.encoder_resolution > 0:
                positions = np.round(positions / sensors.encoder_resolution) * sensors.encoder_resolution
        return self._law_configuration(positions)

    def _law_configuration(self, positions: Floats) -> Floats:
        return self._with_base(self.law.robot.model, self._law_moved, positions)

    def correction(self) -> Floats | None:
        """Return the rate b (k,) about the protected directions that takes back what the gyros have told."""
        return -self.settings.feedback_gain * self.measured if self.settings.feedback_gain else None

    def move(self, rates: Floats, t: float, t_next: float) -> tuple[Floats, Floats]:
        """Hold commanded joint rates (n,) from t to t_next.

        Returns:
            The configuration of the law's robot (nq,) then, and the integral of the base twist (6,), base axes, twice.

        Raises:
            DivergedError: the motion has run away; the message says when.
        """
        held, before = _holding(self.settings, t, t_next), self.totals[:6].copy()
        held[physics.AXES], held[physics.OWN_AXES] = self._bodies
        held[physics.MOMENTUM :] = on_board = self.law.momentum
        held[physics.DIFFERS] = float(self._differs or not np.array_equal(on_board, self._on_board))
        told = self.parts[physics.TRUTH].copy()
        # Calls that take no more than a moment: in between Python hears Ctrl-C. They do whole pieces.
        steps, piece = int(held[physics.STEPS]), min(int(held[physics.STEPS_PER_PIECE]), self._steps_at_once)
        held[physics.STEPS_PER_PIECE], at_once = piece, self._steps_at_once // piece * piece
        rates = np.ascontiguousarray(rates)
        for first in range(0, steps, at_once):
            held[physics.FIRST], held[physics.LAST] = first, min(first + at_once, steps)
            bad = physics.advance(
                *self._constants,
                held,
                rates,
                self.reference,
                self.drives,
                self.parts,
                self._piece,
                self.q,
                self.v,
                self.pose,
                self.totals,
            )
            if bad != physics.OK:
                raise DivergedError(f"{t + bad * held[physics.STEP]:.6g}")
        self._measure(self.parts[physics.TRUTH] - told, t_next - t)
        twist = self.totals[:6] - before
        # The record takes what is along the directions from `parts`, summed at each step of the physics.
        return self._law_configuration(self.q[self.driven]), np.array([twist, twist])

    def sample(self) -> None:
        """Remember the state for the record."""
        kept = (self.v, self.drives[physics.TORQUE], self.totals, self.parts)
        self._samples.append((self.configuration(), *(part.copy() for part in kept)))

    def _measure(self, turned: Floats, dt: float) -> None:
        """Add to what the gyros have told: how far the base has moved along the protected directions (k,), and noise.

        The gyros' rates are turned into the axes of the directions as they are measured, not at the sample.
        """
        told, sensors = turned.copy(), self.settings.sensors
        if sensors is not None:
            noise = sensors.gyro_noise * dt * self._noise.standard_normal(3)
            axes = rotations_to(self.law.robot, self.axes, self._law_configuration(self.q[self.driven])[None])
            told += self.directions[3:].T @ (noise if axes is None else axes[0] @ noise)
        self.measured += told

    def record(self, time: Floats, seen: Floats, values: Floats, twists: Floats, targets: Floats) -> xr.Dataset:
        """Return what `build_motion` makes of the law's robot and commands, with the truth about the plant in it.

        Velocities, momentum and end-effector are the plant's, and the drives, the appendages and the energy are further
        variables. The arguments are those of `build_motion`.
        """
        configurations, velocities, torques, totals, parts = (
            np.array(part) for part in zip(*self._samples[: len(time)], strict=True)
        )
        momenta, centres, points, energies, carried = self._audit(configurations, velocities)
        motion = build_motion(self.law, time, seen, values, twists, targets, (momenta, centres))
        hinges = np.array([self._positions(q) for q in configurations])[:, self.plant.hinges]
        spring = 0.5 * hinges**2 @ self.plant.stiffness[self.plant.hinges]
        replaced = {
            "protected_angle": parts[:, physics.TRUTH],
            "protected_rate": twist_along(
                self.directions, self.axes, velocities[:, :6], motion.configuration.values, self.law.robot
            ),
            "base_linear_velocity": velocities[:, :3],
            "base_angular_velocity": velocities[:, 3:6],
            "end_effector_position": points,
            "end_effector_error": np.linalg.norm(motion.target_position.values - points, axis=1),
        }
        own = np.hstack([velocities[:, :6], velocities[:, 6 + self.driven]])
        moved = 0.5 * np.diff(time)[:, None] * (own[1:, 6:] + own[:-1, 6:])
        replaced["joint_positions"] = joint_positions(self.law.robot.model, seen, moved)
        if self.law.robot.wheel_names:
            replaced["wheel_momentum"] = wheel_momenta(self.plant.robot.model, self.law.robot.wheel_names, velocities)
        for name, values in replaced.items():
            motion[name].values = values
        motion["protected_rate"].attrs["long_name"] = "U_c^T (base twist): the truth at the sample"
        names = self.plant.robot.joint_names
        motion = motion.assign_coords(
            hinge=[names[place] for place in self.plant.hinges],
            appendage=[appendage.name for appendage in self.plant.appendages],
            cause=list(CAUSES),
        )
        plan, model = parts[:, physics.PLAN], parts[:, physics.MODEL]
        added = {
            "protected_angle_parts": np.stack([plan, model - plan, parts[:, physics.TRUTH] - model], axis=1),
            "joint_velocities": velocities[:, 6 + self.driven],
            "joint_torques": torques,
            "hinge_angles": hinges,
            "tip_deflection": self.plant.tip_deflections(hinges),
            "kinetic_energy": energies,
            "spring_energy": spring,
            "drive_work": totals[:, physics.WORK],
            "load_work": totals[:, physics.LOAD_WORK],
            "damping_loss": totals[:, physics.LOSS],
            "saturated_time": totals[:, physics.SATURATED],
        }
        for name, values in added.items():
            dimensions, unit, frame, meaning = VARIABLES[name]
            motion[name] = (dimensions, values, {"units": unit, "frame": frame, "long_name": meaning})
        work = totals[:, physics.WORK] + totals[:, physics.LOAD_WORK] - totals[:, physics.LOSS]
        energy = energies + spring
        # About the inertial origin, where the impulse of a wrench does not need the centre of mass.
        change = momenta - totals[:, physics.IMPULSE :]
        change[:, 3:] += np.cross(centres, momenta[:, :3])
        drift = np.abs(change - change[0]).reshape(-1, 2, 3).max((0, 2))
        motion.attrs |= {
            "physics": json.dumps(self.settings.describe()),
            "appendages": json.dumps([asdict(appendage) for appendage in self.plant.appendages]),
            "energy_error": float(np.abs(energy - energy[0] - work).max() / max(energy.max(), TINY)),
            "momentum_drift": float(np.max(drift / carried)),
            "largest_torques": json.dumps(self.torques[1].tolist()),
            "saturated": json.dumps(flagged_spans(motion.time.values, np.diff(totals[:, physics.SATURATED]) > 0)),
            "saturated_joints": json.dumps(self._saturated_joints(float(time[-1] - time[0]))),
        }
        return motion

    def _saturated_joints(self, duration: float) -> dict[str, float]:
        """Return for each joint whose drive was at its torque limit the share of the time in which it was."""
        times = self.drives[physics.LIMITED_TIME] / max(duration, TINY)
        return {name: float(share) for name, share in zip(self.law.robot.joint_names, times, strict=True) if share > 0}

    def _audit(self, configurations: Floats, velocities: Floats) -> tuple[Floats, Floats, Floats, Floats, Floats]:
        """Return momenta (m, 6), centres of mass, end-effector (m, 3) and kinetic energy (m,) by Pinocchio.

        The last are the largest sums of linear and angular momenta (2,) that base and joints carry one by one.
        """
        model = self.plant.robot.model
        data, m = pin.Data(model), len(configurations)
        frame = model.getFrameId(self.law.robot.end_effector)
        momenta, centres, points, energies = np.empty((m, 6)), np.empty((m, 3)), np.empty((m, 3)), np.empty(m)
        carried = np.full(2, TINY)
        for i, (q, v) in enumerate(zip(configurations, velocities, strict=True)):
            pin.ccrba(model, data, q, v)
            momenta[i], centres[i] = data.hg.vector, data.com[0]
            carried = np.maximum(carried, (np.abs(data.Ag) @ np.abs(v)).reshape(2, 3).max(axis=1))
            points[i] = pin.updateFramePlacement(model, data, frame).translation
            energies[i] = pin.computeKineticEnergy(model, data, q, v)
        return momenta, centres, points, energies, carried


def drives_at_limits(motion: xr.Dataset) -> str:
    """Return in words which drives stood at their torque limits and what the servo made of the protection meanwhile.

    Nothing where none did, or the motion has no drives.
    """
    joints: dict[str, float] = json.loads(motion.attrs.get("saturated_joints", "{}"))
    if not joints:
        return ""
    named = ", ".join(f"{name} for {100 * share:.2g} %" for name, share in joints.items())
    cost = _cost_of_limits(motion).max(initial=0.0)
    unit = " (m count as rad)" if np.any(motion.U_c.values[:3]) else ""
    moved = f"the servo has moved the protected directions by {np.rad2deg(cost):.2g} deg{unit}"
    return f"{named} of the time; meanwhile {moved}"


def warn_of_limits(motion: xr.Dataset) -> None:
    """Warn where torque limits have made a good part of what the protected directions have moved.

    Warns:
        DecoupleWarning: it is a quarter or more, and not next to nothing.
    """
    largest = np.abs(motion.protected_angle.values).max(initial=0.0)
    if np.any(_cost_of_limits(motion) > max(0.25 * largest, NEXT_TO_NOTHING)):
        warnings.warn(
            f"drives at their torque limits have cost protection: {drives_at_limits(motion)}, of "
            f"{np.rad2deg(largest):.2g} deg in all; larger torques help, lower rate or acceleration limits, "
            "a smooth_start, or a servo that protects",
            DecoupleWarning,
            stacklevel=3,
        )


def _cost_of_limits(motion: xr.Dataset) -> Floats:
    """Return how far the servo has moved each protected direction (k,), m or rad, in holds with a drive at its limit.

    What it has moved that does not show in the truth, because it takes out what the plan has left, does not count.
    """
    flagged = np.diff(motion.saturated_time.values) > 0
    counted = flagged[:, None] * np.ones(motion.sizes["protected"])
    if "protection_share" in motion:
        counted = counted * motion.protection_share.values[:-1]
    parts = (motion.protected_angle_parts.sel(cause="servo"), motion.protected_angle)
    sums = [np.abs(np.cumsum(counted * np.diff(part.values, axis=0), axis=0)).max(0, initial=0.0) for part in parts]
    return np.minimum(*sums)


def refuse_endless(settings: Dynamic, duration: float, dt: float) -> None:
    """Refuse a motion of more physics steps than MOST_STEPS.

    Args:
        settings: The physics.
        duration: Of the motion, s.
        dt: Time between samples, s.

    Raises:
        InputError: it has more; the message says how many, and which step would do.
    """
    times = {"physics step": settings.step}
    if settings.servo is not None and settings.servo.period is not None:
        times["servo period"] = settings.servo.period
    for name, time in times.items():
        if duration / min(time, dt) > MOST_STEPS:
            raise InputError(
                f"a {name} of {time:g} s makes {duration / time:.3g} physics steps of {duration:g} s, {MOST_STEPS:g} "
                f"at most: use {duration / MOST_STEPS:.3g} s or more, or a shorter duration"
            )


def _holding(settings: Dynamic, t: float, t_next: float) -> Floats:
    """Return the numbers that `physics.advance` needs for one hold."""
    dt, servo = t_next - t, settings.servo
    period = dt if servo is None or servo.period is None else servo.period
    periods = max(1, int(np.ceil(dt / period * (1 - 1e-9))))
    each = max(1, int(np.ceil(dt / periods / settings.step * (1 - 1e-9))))
    steps = periods * each
    held = np.zeros(physics.SETTINGS_SIZE)
    held[physics.STEP], held[physics.STEPS] = dt / steps, steps
    held[physics.STEPS_PER_TORQUE] = 1 if servo is None or servo.period is None else each
    held[physics.STEPS_PER_PIECE] = steps
    if servo is None:
        held[physics.PRESCRIBED] = 1.0
    else:
        held[physics.PROTECTS] = float(servo.protects)
        longest = PIECE / (2 * np.pi * servo.frequency)
        held[physics.STEPS_PER_PIECE] = max(1, min(steps, int(longest / dt * steps)))
        held[physics.FREQUENCY], held[physics.RATIO] = 2 * np.pi * servo.frequency, servo.damping_ratio
    if settings.load is not None:
        ends = np.array([settings.load.start, settings.load.start + settings.load.duration])
        held[physics.LOAD_FROM : physics.LOAD_TO + 1] = np.clip(np.round((ends - t) / dt * steps), 0, steps)
        held[physics.LOAD : physics.PROTECTS] = *settings.load.force, *settings.load.torque
    return held


def _differ(one: NDArray[Any], other: NDArray[Any]) -> bool:
    return not np.array_equal(one, other)


def _torque_limits(robot: Robot, servo: Servo | None) -> Floats:
    if servo is None or servo.torque_limits is None:
        efforts = np.array(robot.model.effortLimit[6:])
        return np.where((efforts > 0) & (efforts < UNLIMITED), efforts, np.inf)
    limits = as_floats("torque_limits", servo.torque_limits)
    if limits.shape not in ((), (robot.n_joints,)) or not np.all(limits > 0):
        raise InputError(f"torque_limits is {shown(limits.tolist())}; give one positive number or {robot.n_joints}")
    return np.broadcast_to(limits, (robot.n_joints,)).copy()


def _refuse_other_joints(robot: Robot, rigid: Robot) -> None:
    if not rigid.model.existFrame(robot.end_effector):
        raise InputError(f"the plant '{rigid.name}' has no frame '{robot.end_effector}', the law's end-effector")
    if set(robot.joint_names) != set(rigid.joint_names):
        raise InputError(
            f"the law commands the joints {', '.join(robot.joint_names)} of '{robot.name}', the plant '{rigid.name}' "
            f"has {', '.join(rigid.joint_names)}; they must be the same"
        )


def _refuse_unfit_feedback(settings: Dynamic, law: SelectiveLaw, dt: float) -> None:
    if settings.feedback_gain * dt > 1:
        raise InputError(
            f"feedback_gain is {settings.feedback_gain:g} 1/s, with {dt:g} s between samples it overshoots: use "
            f"{1 / dt:.3g} 1/s or less"
        )
    if settings.feedback_gain and isinstance(law, ScheduledLaw):
        raise InputError("feedback_gain takes back what one protection has lost; a schedule has several: leave it out")
    if settings.feedback_gain and np.any(law.protection.U_twist[:3]):
        raise InputError(
            "feedback_gain takes back what gyros tell, and the protection has rows of translation, which they do not; "
            "use a servo that protects, or protect rotation alone"
        )


def _refuse_coarse_step(settings: Dynamic, plant: Plant, q: Floats) -> None:
    times: list[tuple[str, float, str, float]] = []
    if plant.hinges.size:
        stiffest = plant.stiffest_frequency(q)
        times.append(("physics step", settings.step, "the stiffest mode of the appendages", stiffest))
    if settings.servo is not None:
        times.append(("physics step", settings.step, "the servo", settings.servo.frequency))
        if settings.servo.period is not None:
            times[-1] = ("servo period", settings.servo.period, "the servo", settings.servo.frequency)
    for name, time, what, frequency in times:
        largest = COARSEST / (2 * np.pi * frequency)
        if time > largest * (1 + 1e-9):
            digit = 10.0 ** (np.floor(np.log10(largest)) - 1)
            raise InputError(
                f"a {name} of {time:g} s is too coarse for {what} at {frequency:.4g} Hz: use "
                f"{np.floor(largest / digit) * digit:.2g} s or less"
            )
