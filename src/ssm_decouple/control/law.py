"""The selective decoupling law: joint rates that move the end-effector and leave the protected directions still."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray

from ssm_decouple.control import kernel
from ssm_decouple.errors import InputError
from ssm_decouple.model.robot import Robot
from ssm_decouple.momentum.protection import Protection

Floats = NDArray[np.float64]

AT_REST: Floats = np.zeros(3)  # writable, as the kernel wants its vectors; never written


class Command:
    """What the law commands at one configuration, and what follows from it.

    The numbers stand in one array, `values`, and the attributes are views of it.
    """

    __slots__ = ("k", "n", "values")

    def __init__(self, values: Floats, n: int, k: int) -> None:
        self.values = values
        self.n = n
        self.k = k

    @property
    def velocity(self) -> Floats:
        """Pinocchio velocity v (6 + n,): base twist in base axes, then joint rates."""
        return self.values[: 6 + self.n]

    @property
    def joint_rates(self) -> Floats:
        """Commanded joint rates q_dot (n,), rad/s or m/s (paper, eq. 17)."""
        return self.values[6 : 6 + self.n]

    @property
    def base_twist(self) -> Floats:
        """Base twist (6,) that the rates cause: [linear; angular], m/s and rad/s, base axes."""
        return self.values[:6]

    @property
    def base_angular_velocity_body(self) -> Floats:
        """Base angular velocity (3,), rad/s, base axes: J_rc q_dot (paper, eq. 4)."""
        return self.values[3:6]

    @property
    def protected_rate(self) -> Floats:
        """Constrained disturbance angular velocity w_sub = J_sub q_dot (k,), rad/s (paper, eq. 6): rounding."""
        return self._results(kernel.PROTECTED_RATE, self.k)

    @property
    def end_effector_position(self) -> Floats:
        """End-effector position (3,), m, inertial axes."""
        return self._results(kernel.POSITION, 3)

    @property
    def end_effector_error(self) -> Floats:
        """Target minus end-effector position (3,), m, inertial axes."""
        return self._results(kernel.ERROR, 3)

    @property
    def smallest_singular_value(self) -> float:
        """Smallest singular value of J_g N_sub: m/s of end-effector per rad/s in the hardest direction."""
        return float(self._results(kernel.SMALLEST_SINGULAR_VALUE)[0])

    @property
    def rate_scale(self) -> float:
        """Factor in (0, 1] that brought the whole rate vector inside the limits."""
        return float(self._results(kernel.RATE_SCALE)[0])

    @property
    def damping(self) -> float:
        """The regularising scalar rho that was used (paper, eq. 11), m2; 0 away from singularities."""
        return float(self._results(kernel.DAMPING)[0])

    @property
    def regularised(self) -> bool:
        """Whether rho entered, so that the end-effector does not get exactly the velocity asked for."""
        return self.damping > 0.0

    @property
    def rank(self) -> int:
        """Rank of J_sub: how many joint freedoms the protection takes."""
        return int(self._results(kernel.RANK)[0])

    def _results(self, index: int, count: int = 1) -> Floats:
        start = 6 + self.n + index
        return self.values[start : start + count]

    def __repr__(self) -> str:
        rates = ", ".join(f"{x:.6g}" for x in self.joint_rates)
        return (
            f"Command(joint_rates=[{rates}] rad/s, |protected_rate|={np.linalg.norm(self.protected_rate):.2g} rad/s, "
            f"error={np.linalg.norm(self.end_effector_error):.6g} m, rate_scale={self.rate_scale:.4g}, "
            f"smallest_singular_value={self.smallest_singular_value:.4g}, damping={self.damping:.3g})"
        )


class SelectiveLaw:
    """The paper's law: q_dot = (J_g N_sub)^+ (x_dot_des + k_p (x_des - x)), scaled to the rate limits (eq. 9, 17).

    The rates lie in null(J_sub) to machine precision, whatever the damping and the scaling do: the command is made
    inside that null space, and the whole vector is scaled instead of joint by joint.

    Near a singularity of J_g N_sub the plain inverse would ask for unbounded rates. Where the smallest singular value
    s falls below `damping_threshold`, rho = `damping` (1 - (s / threshold)^2)^2 enters the paper's objective (eq. 11)
    smoothly; above it the answer is the exact minimum-norm one.

    A law holds Pinocchio's scratch memory: use one law in one thread.

    Args:
        robot: The robot.
        protection: The directions about which the base must not turn.
        gain: Tracking gain k_p, 1/s.
        rate_limit: Largest joint rates, rad/s or m/s: one number, an array (n,), or None for the URDF's.
        damping: rho at a singularity, m2; 0 gives the Moore-Penrose inverse everywhere.
        damping_threshold: Smallest singular value, m, below which rho enters.

    Raises:
        InputError: a number that is not positive (damping may be 0), a wrong shape, or a robot without joints.
    """

    def __init__(
        self,
        robot: Robot,
        protection: Protection,
        gain: float = 0.05,
        rate_limit: ArrayLike | None = None,
        damping: float = 1e-4,
        damping_threshold: float = 0.02,
    ) -> None:
        n = robot.n_joints
        if n == 0:
            raise InputError(f"'{robot.name}' has no joints to command; put an arm on it with compose(..)")
        for name, value in (("gain", gain), ("damping_threshold", damping_threshold)):
            if not (np.isfinite(value) and value > 0):
                raise InputError(f"{name} is {value}; it must be a positive number")
        if not (np.isfinite(damping) and damping >= 0):
            raise InputError(f"damping is {damping}; it must be zero or a positive number")
        self.robot = robot
        self.protection = protection
        self.gain = float(gain)
        self.rate_limits: Floats = _rate_limits(robot, rate_limit)
        self.damping = float(damping)
        self.damping_threshold = float(damping_threshold)

        frame = robot.model.frames[robot.end_effector_id]
        moves_tool = np.zeros(n)
        moves_tool[[robot.model.joints[j].idx_v - 6 for j in robot.model.supports[frame.parentJoint] if j > 1]] = 1.0
        scalars = [self.gain, self.damping_threshold, self.damping, robot.mass]
        parameters = np.array([*scalars, *frame.placement.translation])
        columns = np.vstack([moves_tool, self.rate_limits])
        data = robot.model.createData()
        # Live views into the Pinocchio data, fetched once: each fetch would cost as much as a tenth of the step.
        placement = data.oMi[frame.parentJoint]
        views = (data.Ag, data.J, placement.rotation, placement.translation)
        constants = (protection.U_c.copy(), protection.frame == "inertial", columns, parameters)
        self._prepared = (robot.model, data, (*views, *constants))
        self.size: int = 6 + n + kernel.RESULTS_SIZE

    def __call__(self, q: ArrayLike, target: ArrayLike, target_velocity: ArrayLike = AT_REST) -> Command:
        """Return the command at a configuration.

        Args:
            q: Configuration (nq,).
            target: Desired end-effector position x_des (3,), m, inertial axes.
            target_velocity: Its velocity (3,), m/s, inertial axes.

        Returns:
            The command; its numbers are its own and stay as they are.

        Raises:
            InputError: an argument has the wrong shape or is not finite, or q's quaternion is not of unit length.
        """
        values = np.empty(self.size)
        self.evaluate(q, target, target_velocity, values)
        return Command(values, self.robot.n_joints, self.protection.k)

    def evaluate(self, q: ArrayLike, target: ArrayLike, target_velocity: ArrayLike, out: Floats) -> None:
        """Compute a command into an array: the same as calling the law, without the result object.

        Args:
            q: Configuration (nq,).
            target: Desired end-effector position (3,), m, inertial axes.
            target_velocity: Its velocity (3,), m/s, inertial axes.
            out: Array (law.size,), overwritten: the velocity v (6 + n) and the results that `Command` names.

        Raises:
            InputError: as for the call.
        """
        model, data, fixed = self._prepared
        try:  # arrays of the right kind are not looked at twice
            pin.computeCentroidalMap(model, data, q)
            status = kernel.selective_command(*fixed, target, target_velocity, out)  # type: ignore[arg-type]
        except (TypeError, ValueError):  # a list, another layout, a read-only array or a wrong length
            pin.computeCentroidalMap(model, data, self.robot.checked(q))
            vectors = _vector("target", target), _vector("target_velocity", target_velocity)
            status = kernel.selective_command(*fixed, *vectors, self._checked_out(out))
        if status != kernel.OK:
            self._refuse(q, target, target_velocity, out, status)

    def _checked_out(self, out: Floats) -> Floats:
        fit = isinstance(out, np.ndarray) and out.dtype == np.float64 and out.shape == (self.size,)
        if not (fit and out.flags.c_contiguous and out.flags.writeable):
            raise InputError(f"out must be a writable, contiguous float64 array ({self.size},), law.size long")
        return out

    def _refuse(self, q: ArrayLike, target: ArrayLike, target_velocity: ArrayLike, out: Floats, status: int) -> None:
        self.robot.checked(q)
        for name, value in (("target", target), ("target_velocity", target_velocity)):
            if not np.all(np.isfinite(_vector(name, value))):
                raise InputError(f"{name} is not finite: {np.asarray(value).tolist()}")
        self._checked_out(out)
        why = {
            kernel.NO_INERTIA: "the whole robot's inertia H_ww is singular",
            kernel.NOT_UNIT_QUATERNION: "the base quaternion is not of unit length",
        }.get(status, "its numbers overflow")
        raise InputError(f"no command at this configuration of '{self.robot.name}': {why}")

    def describe(self) -> dict[str, float | int | str | list[float] | list[list[float]]]:
        """Return the law's settings in plain types, for a record."""
        return {
            "law": "selective",
            "U_c": self.protection.U_c.tolist(),
            "frame": self.protection.frame,
            "k": self.protection.k,
            "gain": self.gain,
            "rate_limits": self.rate_limits.tolist(),
            "damping": self.damping,
            "damping_threshold": self.damping_threshold,
        }


def _vector(name: str, value: ArrayLike) -> Floats:
    vector = np.array(value, dtype=float)
    if vector.shape != (3,):
        raise InputError(f"{name} has shape {vector.shape}; it needs 3 numbers, m or m/s in inertial axes")
    return vector


def _rate_limits(robot: Robot, given: ArrayLike | None) -> Floats:
    if given is None:
        return robot.rate_limits.copy()
    limits = np.array(given, dtype=float)
    if limits.shape not in ((), (robot.n_joints,)):
        raise InputError(
            f"rate_limit has shape {limits.shape}; give one number or one for each of {robot.n_joints} joints"
        )
    limits = np.broadcast_to(limits, (robot.n_joints,)).copy()
    if not np.all(limits > 0):
        raise InputError(f"rate_limit is {given}; every joint's must be above zero (infinity for no limit)")
    return limits
