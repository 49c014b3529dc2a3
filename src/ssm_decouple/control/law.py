"""The selective decoupling law: joint rates that move the end-effector and leave the protected directions still."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray

from ssm_decouple.compiled import NumbaError
from ssm_decouple.control import kernel
from ssm_decouple.control.task import Layout, PositionTask, Task, checked_tasks
from ssm_decouple.errors import (
    DecoupleWarning,
    InputError,
    as_floats,
    as_kind,
    as_not_negative,
    as_number,
    as_positive,
    as_whole,
    shown,
)
from ssm_decouple.model.origin import from_base
from ssm_decouple.model.robot import Robot, checked_robot, per_joint, warn_of_degrees
from ssm_decouple.momentum.flow import munthe_kaas, places_on_hold, quadrature_along, ways_to_nodes
from ssm_decouple.momentum.protection import Protection, checked_protection
from ssm_decouple.settled import Settled, fixed_array

if TYPE_CHECKING:
    from ssm_decouple.control.limits import LimitedRates, LimitedStep, Limits

Floats = NDArray[np.float64]

# Nodes and weights on [0, 1]; with m nodes the mean is exact to order 2 m.
GAUSS: dict[int, tuple[tuple[float, float], ...]] = {
    0: (),
    1: ((0.5, 1.0),),
    2: ((0.5 - np.sqrt(3) / 6, 0.5), (0.5 + np.sqrt(3) / 6, 0.5)),
    3: ((0.5 - np.sqrt(15) / 10, 5 / 18), (0.5, 4 / 9), (0.5 + np.sqrt(15) / 10, 5 / 18)),
}
# One look-up instead of two, in every step.
centroidal_map, selective_command, array = pin.computeCentroidalMap, kernel.selective_command, np.ndarray
new, FLOATS = object.__new__, np.dtype(np.float64)

FASTEST, BEYOND = 4 * np.pi, 20.0  # rad/s, and times the URDF's: above it a joint's rate limit looks like degrees

FULL = 1.0  # the pace of a command that is asked for nothing else

CLIMB_STEP = 1e-6  # rad or m, of the finite differences
CLIMB_SHARE = 0.25  # of the rate limits

PASSES = 12  # at most; away from singularities each gains a factor of about sample time x joint rate
CONVERGED = 1e-13  # relative change of the rates from pass to pass

# What a protected rate is lost to, in words.
LOST_TO = {
    kernel.TO_RANK: "no joint rates give it: J_sub has lost rank",
    kernel.TO_RATES: "the joint rates that it takes exceed the rate limits",
    kernel.TO_LIMITS: "the joint rates that it takes exceed position, rate or acceleration limits",
}


def lost_to(code: float) -> tuple[str, ...]:
    """Return in words what a protected rate was lost to, by the kernel's number."""
    return tuple(words for bit, words in LOST_TO.items() if int(code) & bit)


class CommandedMotion:
    """What one command and the commands of a batch, a row each, have in common: views of their numbers."""

    __slots__ = ("k", "n", "values")
    values: Floats
    n: int
    k: int

    @property
    def velocity(self) -> Floats:
        """Pinocchio velocity v (.., 6 + n): base twist in base axes, then joint rates."""
        return self.values[..., : 6 + self.n]

    @property
    def joint_rates(self) -> Floats:
        """Commanded joint rates q_dot (.., n), rad/s or m/s (paper, eq. 17)."""
        return self.values[..., 6 : 6 + self.n]

    @property
    def base_twist(self) -> Floats:
        """Base twist (.., 6) that the rates cause: [linear; angular], m/s and rad/s, base axes."""
        return self.values[..., :6]

    @property
    def base_angular_velocity_body(self) -> Floats:
        """Base angular velocity (.., 3), rad/s, base axes: J_rc q_dot (paper, eq. 4)."""
        return self.values[..., 3:6]

    @property
    def protected_rate(self) -> Floats:
        """Constrained disturbance angular velocity w_sub = J_sub q_dot (.., k), rad/s (paper, eq. 6): rounding.

        Of a law with hold nodes, its mean over the hold, on these nodes. Where a rate was asked for it is that rate, or
        what of it the arm and its rate limits can give; so it is with zero where there is momentum on board. With
        directions of the whole twist it mixes m/s and rad/s.
        """
        return self._results(kernel.PROTECTED_RATE, self.k)

    @property
    def end_effector_position(self) -> Floats:
        """End-effector position (.., 3), m, inertial axes."""
        return self._results(kernel.POSITION, 3)

    def _results(self, index: int, count: int = 1) -> Floats:
        start = 6 + self.n + index
        return self.values[..., start : start + count]


class Command(CommandedMotion):
    """What the law commands at one configuration, and what follows from it.

    The numbers stand in one array, `values`, and the attributes are views of it. What belongs to a task comes in the
    order in which the tasks were given to the law, what belongs to a level in the order of the levels.
    """

    __slots__ = ("layout",)

    def __init__(self, values: Floats, n: int, k: int, layout: Layout) -> None:
        self.values = values
        self.n = n
        self.k = k
        self.layout = layout

    @property
    def end_effector_error(self) -> Floats:
        """Target minus end-effector position (3,), m, inertial axes; not numbers where no task asks for a position."""
        rows = self.layout.tool_position
        return np.full(3, np.nan) if rows is None else self.values[6 + self.n + kernel.ERRORS :][rows]

    @property
    def errors(self) -> tuple[Floats, ...]:
        """Each task's error, m and rad, as the task's class defines it."""
        errors = self.values[6 + self.n + kernel.ERRORS :]
        return tuple(errors[rows] for rows in self.layout.rows)

    @property
    def smallest_singular_value(self) -> float:
        """Smallest singular value of J_gt N_sub: m/s of end-effector per rad/s in the hardest direction.

        With joint weights w the columns are divided by sqrt(w), as they are where the rates are found.

        Of other tasks, that of J_1 N_sub, J_1 being the rows of the first level, each times the root of its weight.
        """
        return float(self.smallest_singular_values[0])

    @property
    def smallest_singular_values(self) -> Floats:
        """Of each level, that of its rows in what the protection and the levels before it leave (levels,).

        The first is 0 where fewer freedoms are left than it has rows. Of the others, to which it is natural to get less
        than they ask for, it is the smallest of as many as there are freedoms.
        """
        return self._results(kernel.ERRORS + self.layout.size, 2 * len(self.layout.level_rows))[::2]

    @property
    def rate_scale(self) -> float:
        """Factor in (0, 1] that brought the whole rate vector inside the limits.

        Where a protected rate was asked for, the factor in [0, 1] on what stands beside the rates that give it.
        """
        return float(self._results(kernel.RATE_SCALE)[0])

    @property
    def damping(self) -> float:
        """The regularising scalar rho of the first level (paper, eq. 11), m2; 0 away from singularities."""
        return float(self.dampings[0])

    @property
    def dampings(self) -> Floats:
        """The regularising scalar rho of each level (levels,)."""
        return self._results(kernel.ERRORS + self.layout.size, 2 * len(self.layout.level_rows))[1::2]

    @property
    def rate_blend(self) -> float:
        """Share in [0, 1] of the way from the previous rates to the wanted ones that acceleration limits allowed."""
        return float(self._results(kernel.RATE_BLEND)[0])

    @property
    def acceleration_excess(self) -> float:
        """Of a law with `limits`: how far acceleration limits are exceeded, relative to them; 0 where they are kept."""
        return float(self._results(kernel.EXCESS)[0])

    @property
    def active_limits(self) -> int:
        """Of a law with `limits`: how many joints stand at one of their bounds; `law.limited` names them."""
        return int(self._results(kernel.LIMITED)[0])

    @property
    def protection_lost(self) -> float:
        """Largest difference between the protected rate and what was asked for, rad/s (or m/s); 0 where it is kept.

        Kept to rounding, that is: to 1e-9 of what joints and momentum do along the protected directions.
        """
        return float(self._results(kernel.LOST)[0])

    @property
    def protection_lost_to(self) -> tuple[str, ...]:
        """Why the protected rate is not what was asked for, in words; nothing where it is."""
        return lost_to(float(self._results(kernel.LOST_TO)[0]))

    @property
    def plan_change(self) -> float:
        """Relative change of the rates in the last pass of planning for the hold: above 1e-13 it has not settled."""
        return float(self._results(kernel.PLAN_CHANGE)[0])

    @property
    def regularised(self) -> bool:
        """Whether rho entered on some level, so that its tasks do not get exactly the velocity asked for."""
        return bool(np.any(self.dampings > 0.0))

    @property
    def rank(self) -> int:
        """Rank of J_sub: how many joint freedoms the protection takes."""
        return int(self._results(kernel.RANK)[0])

    def _told_errors(self) -> str:
        if self.layout.plain:
            return f"{np.linalg.norm(self.errors[0]):.6g} m"
        return ", ".join(f"{np.linalg.norm(e):.6g}" for e in self.errors)

    def __repr__(self) -> str:
        rates = ", ".join(f"{x:.6g}" for x in self.joint_rates)
        return (
            f"Command(joint_rates=[{rates}] rad/s, |protected_rate|={np.linalg.norm(self.protected_rate):.2g} rad/s, "
            f"error={self._told_errors()}, rate_scale={self.rate_scale:.4g}, "
            f"smallest_singular_value={self.smallest_singular_value:.4g}, damping={self.damping:.3g})"
        )


@dataclass(frozen=True)
class LostDirection:
    """What the tasks of level 1 can do least, and why.

    Attributes:
        direction: Unit vector (rows of level 1,), in the order and the units of their errors.
        singular_value: How much of it a unit of joint rates gives at most; 0 at a singularity.
        without: The same for this direction if one protected direction were given up (k,). The largest belongs to
            the protected row that takes it; where none is above `singular_value`, the arm itself is singular.
    """

    direction: Floats
    singular_value: float
    without: Floats

    def told(self, law: SelectiveLaw) -> dict[str, Any]:
        """Return it in plain types, for a record, with the names of the rows."""
        return {
            "rows": list(law.layout.row_names[law.layout.level_rows[0]]),
            "direction": self.direction.tolist(),
            "singular_value": self.singular_value,
            "without": self.without.tolist(),
        }


class SelectiveLaw(Settled):
    """The paper's law: q_dot = (J_gt N_sub)^+ (x_dot_des + k_p (x_des - x)), scaled as a whole to the rate limits.

    Equations 9 and 17; the paper gives the limits and leaves open how they are kept.

    The rates lie in null(J_sub) to machine precision, whatever the damping and the scaling do: the command is made
    inside that null space, and the whole vector is scaled instead of joint by joint.

    Near a singularity of J_gt N_sub the plain inverse would ask for unbounded rates. Where the smallest singular value
    s falls below `damping_threshold`, rho = `damping` (1 - (s / threshold)^2)^2 enters the paper's objective (eq. 11)
    smoothly; above it the answer is the exact minimum-norm one.

    A command that is held until the next sample keeps the joints turning while J_sub moves on, so that a base which is
    still at the sample turns a little in between. With `hold_nodes` the law is posed on matrices averaged over the
    coming hold instead: at the middle (1), or at 2 or 3 Gauss points, along the motion that the command itself causes.
    Then the *rotation* about a direction is zero over the hold, to the quadrature's order, in whatever axes it is
    fixed.

    Other tasks than the end-effector's position take its place in the same formula: J_1, the rows of all tasks of level
    1, each times the root of its task's weight, stands for J_gt. A second level acts in what the protection and J_1
    leave, and so on; no level disturbs those before it. rho is found for each level.

    Momentum on board, such as what a push or spinning wheels have left, moves the base even while the joints stand
    still. The law takes that off what it asks of the joints: the protected rate stays zero as long as the joints can
    take the momentum up, and the tasks are met beside it. A command tells by `protection_lost` where they cannot.

    Where the base is far from the inertial origin the law computes in axes through the base.

    A law holds Pinocchio's scratch memory: use one law in one thread. Its settings are read when it is made and cannot
    be assigned afterwards, but for `momentum`, which acts.

    Args:
        robot: The robot.
        protection: The directions about which the base must not turn.
        gain: Tracking gain k_p, 1/s, of the tasks that name none.
        rate_limit: Largest joint rates, rad/s or m/s: one number, an array (n,), or None for the URDF's.
        damping: rho at a singularity, m2; 0 gives the Moore-Penrose inverse everywhere. For commands that are held it
            should be above the sample time times the speed asked for times the arm's length, or rates may reverse from
            sample to sample there.
        damping_threshold: Smallest singular value, m, below which rho enters.
        sample_time: How long a command is held, s; needed for the two that follow and for `limits`.
        hold_nodes: 0 poses the law at the sample, 1 to 3 on matrices averaged over the hold.
        acceleration_limit: Largest joint accelerations, rad/s2 or m/s2, from one command to the next: one number, an
            array (n,), or None; `robot.acceleration_limits` is what the motors of reaction wheels can do. The rates are
            blended from the previous ones within null(J_sub). The protection comes
            first, then the rate limits: where they take more than the acceleration limit allows, it is exceeded and
            the command's `rate_blend` is 0. Without `limits` the law does not brake ahead.
        tasks: What the arm shall do: one task or several; None is the end-effector's position, `PositionTask()`.
        joint_weights: w of the joints (n,) in the norm sum w_j q_dot_j^2 that the rates minimise, and that damping
            and its threshold act in. None is 1 for all but reaction wheels, which have (r / max_speed)^2, r being the
            largest rate limit of the other joints: a wheel's full speed counts as much as theirs.
        momentum: On board (6,), [linear; angular about the centre of mass], kg m/s and kg m2/s, inertial axes; None
            for none. It may be assigned later as `law.momentum`, for example when thrusters have changed it.
        limits: How limits are kept. None scales the command as a whole, which brakes all joints for one that is at its
            rate limit, knows no position limits and does not brake ahead. `Limits()` keeps position, rate and
            acceleration limits and clearances joint by joint, inside null(J_sub), by quadratic programs: the tasks get
            what is possible beside them, and the arm can always be braked in time.

    Attributes:
        size: Length of the array that `evaluate` fills.
        joint_weights: (n,), as given or by default.
        tasks: The tasks, a tuple.
        layout: Where their rows and targets stand.

    Raises:
        InputError: a number that is not positive (damping may be 0), a wrong shape, a missing sample time, a robot
            without joints, a task that the robot cannot do, or a protection that takes all freedoms of the tasks.
        ModelError: `robot.model` was changed after the robot was made.

    Warns:
        DecoupleWarning: a rate limit that looks like degrees.
    """

    def __init__(
        self,
        robot: Robot,
        protection: Protection,
        gain: float = 0.05,
        rate_limit: ArrayLike | None = None,
        damping: float = 1e-4,
        damping_threshold: float = 0.02,
        sample_time: float | None = None,
        hold_nodes: int = 0,
        acceleration_limit: ArrayLike | None = None,
        tasks: Task | Sequence[Task] | None = None,
        joint_weights: ArrayLike | None = None,
        momentum: ArrayLike | None = None,
        limits: Limits | None = None,
    ) -> None:
        n = checked_robot(robot).n_joints
        if n == 0:
            raise InputError(f"'{robot.name}' has no joints to command; put an arm on it with compose(..)")
        robot.refuse_changed_model()
        hold_nodes = as_whole("hold_nodes", hold_nodes, 0, "it is 0 (at the sample), 1, 2 or 3")
        if hold_nodes not in GAUSS:
            raise InputError(f"hold_nodes is {hold_nodes}; it is 0 (at the sample), 1, 2 or 3")
        if sample_time is None and (hold_nodes or acceleration_limit is not None or limits is not None):
            raise InputError(
                "hold_nodes, acceleration_limit and limits need the sample_time, s, for which a command is held"
            )
        self.robot = robot
        self.protection = checked_protection(protection)
        self.gain = as_positive("gain", gain)
        self.damping = as_not_negative("damping", damping)
        self.damping_threshold = as_positive("damping_threshold", damping_threshold)
        self.sample_time = None if sample_time is None else as_positive("sample_time", sample_time)
        self.hold_nodes = hold_nodes
        self.rate_limits: Floats = per_joint(
            robot, "rate_limit", robot.rate_limits if rate_limit is None else rate_limit
        )
        if rate_limit is not None:
            warn_of_degrees(
                robot, "rate_limit", self.rate_limits, np.minimum(FASTEST, BEYOND * robot.rate_limits), "rad/s"
            )
        self.acceleration_limits: Floats | None = None
        if acceleration_limit is not None:
            self.acceleration_limits = per_joint(robot, "acceleration_limit", acceleration_limit)
        self.joint_weights: Floats = (
            fixed_array(_default_weights(robot, self.rate_limits))
            if joint_weights is None
            else per_joint(robot, "joint_weights", joint_weights, "finite")
        )
        self.tasks = (PositionTask(),) if tasks is None else checked_tasks(robot, tasks)
        self.layout = Layout(robot, self.tasks, self.gain)
        self.size: int = 6 + n + kernel.ERRORS + self.layout.size + 2 * len(self.layout.level_rows)
        self.limits = None if limits is None else _checked_limits(limits)
        self._limited: LimitedRates | None = None
        self._step: LimitedStep | None = None
        self._prepare()
        self._set_momentum(momentum)
        if limits is not None:
            self._prepare_limits(limits)
        if tasks is not None:
            self._refuse_what_nothing_is_left_for()
        # Whether a call can go round `evaluate`, which would tell it nothing more.
        plain = self._quick and self.acceleration_limits is None
        self._direct = plain and type(self).evaluate is SelectiveLaw.evaluate

    @property
    def limited(self) -> LimitedRates | None:
        """Of a law with `limits`, what they did to the last command."""
        return self._limited

    @property
    def directions(self) -> tuple[Floats, str]:
        """The protected directions of the base twist, columns (6, k), and the axes in which they are fixed."""
        return self.protection.U_twist, self.protection.frame

    def shares(self, time: Floats, configurations: Floats) -> Floats | None:
        """Return how far each of `directions` is protected (m, k), 0 to 1; None where that never changes.

        Args:
            time: Sample times (m,), s.
            configurations: (m, nq).
        """
        return None

    @property
    def momentum(self) -> Floats:
        """Momentum on board (6,): [linear; angular about the centre of mass], kg m/s and kg m2/s, inertial axes."""
        momentum: Floats = self._prepared[3][3][kernel.MOMENTUM :].copy()
        momentum.flags.writeable = False
        return momentum

    @momentum.setter
    def momentum(self, momentum: ArrayLike | None) -> None:
        self._set_momentum(momentum)

    def seen_from(self, origin: Floats) -> SelectiveLaw:
        """Return the law for configurations whose base position is counted from another origin (3,), m.

        It is this one: nothing in it depends on where the base is.
        """
        return self

    def _set_momentum(self, momentum: ArrayLike | None) -> None:
        values = np.zeros(6) if momentum is None else as_floats("momentum", momentum)
        if values.shape != (6,) or not np.all(np.isfinite(values)):
            raise InputError(
                f"momentum is {shown(values.tolist())}; it needs 6 finite numbers, linear and angular about the centre "
                "of mass, inertial axes"
            )
        self._prepared[3][3][kernel.MOMENTUM :] = values

    @property
    def _turning(self) -> bool:
        """Whether the plan for a hold needs the base's attitude on the way, and can have it without momentum."""
        return self.protection.frame == "inertial" and not self._prepared[3][3][kernel.MOMENTUM :].any()

    def _refuse_what_nothing_is_left_for(self) -> None:
        """Count freedoms where the arm stands nowhere special."""
        n = self.robot.n_joints
        q = self.robot.configuration(np.linspace(0.3, 1.1, n))
        Z, J = self.protection.null_space_basis(self.robot.coupling(q)), self._task_jacobian(q)
        left = Z.shape[1]
        if left == 0:
            raise InputError(
                f"the protection takes {n} of the {n} freedoms of '{self.robot.name}' and leaves 0 to the tasks, which "
                f"have {self.layout.size} rows; protect fewer directions"
            )
        for number, rows in enumerate(self.layout.level_rows, 1):
            if Z.shape[1] == 0:
                warnings.warn(
                    f"nothing is left for the tasks from level {number} on: of the {n} freedoms of '{self.robot.name}' "
                    f"the protection takes {n - left} and the levels before {left}",
                    DecoupleWarning,
                    stacklevel=3,
                )
                break
            _, singular, right = np.linalg.svd(J[rows] @ Z)
            Z = Z @ right[int(np.sum(singular > 1e-9 * np.linalg.norm(J[rows]))) :].T

    def _matrices_at(self, q: Floats) -> Floats:
        """Return the kernel's matrices (J_TASK + m, n) at q; they depend on no target."""
        model, data, _, (_, _, columns, _), fixed = self._prepared
        pin.computeCentroidalMap(model, data, from_base(q))
        if self._reads_joints:
            kernel.read_joints(q, columns)
        matrices, drift, rates = np.zeros_like(self._matrices), np.zeros_like(self._drift), np.zeros(self.layout.size)
        out = np.zeros(self.size)
        kernel.add_matrices(*fixed, self._any_target, self._at_rest, 1.0, matrices, drift, rates, out)
        return matrices

    def _task_jacobian(self, q: Floats) -> Floats:
        """Return the generalized Jacobian of the task rows (m, n) at q, each times the root of its task's weight."""
        return self._matrices_at(q)[kernel.J_TASK :]

    def _rates_that_climb(self, q: ArrayLike, gain: float) -> Floats:
        """Return gain times the gradient of log w (n,), w the manipulability of level 1, by finite differences."""
        model, _, _, (U_c, _, columns, parameters), _ = self._prepared
        start, count = self.robot.checked(q), self.layout.level_rows[0].stop
        turn, slopes = np.zeros(model.nv), np.zeros(self._n)

        def log_manipulability(at: Floats) -> float:
            return kernel.log_manipulability(self._matrices_at(at), U_c, columns, parameters, count)

        here = log_manipulability(start)
        for j in range(self._n):
            turn[:] = 0.0
            turn[6 + j] = CLIMB_STEP
            slopes[j] = gain * (log_manipulability(pin.integrate(model, start, turn)) - here) / CLIMB_STEP
        if not np.all(np.isfinite(slopes)):  # at a singularity all ways lead up
            return np.zeros(self._n)
        return slopes / max(1.0, float(np.max(np.abs(slopes) / (CLIMB_SHARE * self.rate_limits))))

    def _prepare(self) -> None:
        """Lay out what the kernel reads: views of Pinocchio's data and constant arrays."""
        robot, n, model, layout = self.robot, self.robot.n_joints, self.robot.model, self.layout
        frame, limited = model.frames[robot.end_effector_id], self.acceleration_limits is not None
        steps = np.full(n, np.inf)
        if self.acceleration_limits is not None and self.sample_time is not None:
            steps = self.acceleration_limits * self.sample_time
        axes_joint, U_c = self._protected_axes()
        scalars = [self.damping_threshold, self.damping, robot.mass, float(limited), axes_joint]
        tool = [frame.parentJoint, *frame.placement.translation]
        counts = [layout.size, len(layout.level_rows), *layout.target_sizes]
        parameters = np.array([*scalars, *tool, *counts, 1.0, *np.zeros(12)])
        joints = list(model.joints)[2:]
        places, continuous = [float(joint.idx_q) for joint in joints], [float(joint.nq == 2) for joint in joints]
        scale = 1.0 / np.sqrt(self.joint_weights)
        columns = np.vstack([self.rate_limits, steps, places, continuous, np.zeros(n), scale, layout.moves])
        data = pin.Data(model)
        # Live views into the Pinocchio data, fetched once: each fetch would cost as much as a tenth of the step.
        views = (data.Ag, data.J, _placements(data, model.njoints))
        constants = (U_c, layout.table.copy(), columns, parameters)
        self._prepared = (model, data, views, constants, (*views, *constants))
        self._hot = (model, data, *views, *constants)  # of it what every step needs
        self._reads_joints = bool(np.any(layout.table[:, kernel.KIND] == kernel.JOINTS))
        self._flat, self._climbs = layout.plain, layout.climbs
        # What has to look at joints or plans goes another way, as do limits.
        looks = self._reads_joints or self._climbs is not None or bool(columns[kernel.CONTINUOUS].any())
        self._quick = not (looks or self.hold_nodes)
        self._at_rest: Floats = np.zeros(layout.target_sizes[1])  # writable, as the kernel wants it; never written
        self._n, self._k = n, self.protection.k
        self._no_rates: Floats = np.zeros(n)
        self._any_target: Floats = layout.any_target()
        self._J_base: Floats = np.zeros((6, n))
        self._J_here: Floats = np.zeros((6, n))
        self._J_nodes: Floats = np.zeros((self.hold_nodes, 6, n))
        self._matrices: Floats = np.zeros((kernel.J_TASK + layout.size, n))
        self._drift: Floats = np.zeros((kernel.J_TASK + layout.size, 1))
        self._later: Floats = np.zeros(layout.target_sizes[0])
        self._rates: Floats = np.zeros(layout.size)

    def _prepare_limits(self, limits: Limits) -> None:
        """Let the kernel give rates without limits, to be brought inside them afterwards."""
        # Who has no such limits does not wait for the solver and the collision library.
        from ssm_decouple.control.collision import Distances
        from ssm_decouple.control.limits import LimitedStep

        layout, scale = self.layout, 1.0 / np.sqrt(self.joint_weights)
        _, _, _, (_, _, columns, parameters), _ = self._prepared
        columns[kernel.RATE_LIMIT], parameters[kernel.LIMITS_STEPS] = np.inf, 0.0
        self._quick = False
        accelerations = self.acceleration_limits
        self._step = LimitedStep(
            self.robot,
            replace(limits, position=limits.positions(self.robot) / scale[:, None]),
            self.rate_limits / scale,
            None if accelerations is None else accelerations / scale,
            float(self.sample_time or 0.0),
        )
        self._distances = None if limits.clearance is None else Distances(self.robot, limits.clearance)
        self._scale: Floats | None = None if np.all(scale == 1.0) else scale
        self._positions: Floats = np.zeros(self._n)
        self._rows: Floats = np.zeros((self._k + layout.size, self._n))
        self._sides: Floats = np.zeros(self._k + layout.size + 1)
        self._places = [slice(self._k + rows.start, self._k + rows.stop) for rows in layout.level_rows]
        self._rhos = [kernel.ERRORS + layout.size + 2 * level + 1 for level in range(len(layout.level_rows))]

    def constants(self) -> tuple[Floats, Floats, Floats, Floats]:
        """Return copies of what the kernel reads of the law: U_c, tasks, columns and parameters."""
        U_c, tasks, columns, parameters = self._prepared[3]
        return U_c.copy(), tasks.copy(), columns.copy(), parameters.copy()

    def _protected_axes(self) -> tuple[float, Floats]:
        """Return the joint in whose axes the protected directions are fixed, by the kernel's numbers, and U_c there."""
        robot, U_c = self.robot, self.protection.U_twist.copy()
        if self.protection.frame in ("base", "inertial"):
            return (-1.0 if self.protection.frame == "base" else 0.0), U_c
        frame = robot.model.frames[robot.frame_id(self.protection.frame)]
        R = frame.placement.rotation
        return float(frame.parentJoint), np.vstack([R @ U_c[:3], R @ U_c[3:]])

    def __call__(
        self,
        q: ArrayLike,
        target: Any,
        target_velocity: Any = None,
        previous_rates: ArrayLike | None = None,
        protected_rate: ArrayLike | None = None,
        pace: float = FULL,
        time: float = 0.0,
    ) -> Command:
        """Return the command at a configuration.

        Args:
            q: Configuration (nq,).
            target: Desired end-effector position x_des (3,), m, inertial axes; or what the law's only task takes; or,
                of several tasks, a sequence of what each takes, in their order.
            target_velocity: Its velocity (3,), m/s, inertial axes, or those of the tasks likewise; None for at rest.
            previous_rates: The joint rates commanded before (n,), rad/s or m/s; needed with an acceleration limit,
                zeros from rest.
            protected_rate: b (k,), what the protected rate shall be, rad/s, or m/s and rad/s; None for zero. The arm
                makes it with the smallest rates J_sub^+ b; the task uses null(J_sub), and yields first at the rate
                limits. Where J_sub^+ b alone exceeds them it is scaled to them as a whole, and where J_sub has not the
                rank for b, the nearest b that there is takes its place: the command's `protected_rate` tells.
            pace: In [0, 1], scales the time of the command but not b: gain, target velocity and rate limits times
                pace, so that with b = 0 the command is pace times the plain one (damped as that is). Beside rates
                J_sub^+ b the limits move from these, at pace 0, to the full ones, at pace 1. With `limits` it leaves
                the joints' limits as they are: then acceleration limits make a start smooth.
            time: s; only a `ScheduledLaw` looks at it.

        Returns:
            The command; its numbers are its own and stay as they are.

        Raises:
            InputError: an argument has the wrong shape or is not finite, a target is no rotation or no direction, q's
                quaternion is not of unit length, the pace is not in [0, 1], or previous rates are missing.
        """
        if not self._flat:
            target = self.layout.flat_targets(target)
            if target_velocity is not None:
                target_velocity = self.layout.flat_velocities(target_velocity)
        if target_velocity is None:
            target_velocity = self._at_rest
        values = np.empty(self.size)
        if self._direct and previous_rates is None and protected_rate is None and pace is FULL:
            self._fill(q, target, target_velocity, self._no_rates, values)
        else:
            self.evaluate(q, target, target_velocity, values, previous_rates, protected_rate, pace, time)
        command = new(Command)  # a call of the class would cost twice as much
        command.values, command.n, command.k, command.layout = values, self._n, self._k, self.layout
        return command

    def evaluate(
        self,
        q: ArrayLike,
        target: ArrayLike,
        target_velocity: ArrayLike,
        out: Floats,
        previous_rates: ArrayLike | None = None,
        protected_rate: ArrayLike | None = None,
        pace: float = FULL,
        time: float = 0.0,
    ) -> None:
        """Compute a command into an array: the same as calling the law, without the result object.

        Args:
            q: Configuration (nq,).
            target: Desired end-effector position (3,), m, inertial axes; of other tasks what `layout.flat_targets`
                makes of their targets.
            target_velocity: Its velocity (3,), m/s, inertial axes; of other tasks from `layout.flat_velocities`.
            out: Array (law.size,), overwritten: the velocity v (6 + n) and the results that `Command` names.
            previous_rates: The joint rates commanded before (n,).
            protected_rate: b (k,), what the protected rate shall be, as for the call.
            pace: In [0, 1], as for the call.
            time: s; only a `ScheduledLaw` looks at it.

        Raises:
            InputError: as for the call.
        """
        if protected_rate is not None or not (pace is FULL or (type(pace) is float and pace == 1.0)):
            _, _, _, (*_, parameters), _ = self._prepared
            usual = parameters.copy()
            parameters[kernel.PACE : kernel.MOMENTUM] = self._asked(protected_rate, pace)
            try:
                self.evaluate(q, target, target_velocity, out, previous_rates)
            finally:
                parameters[:] = usual
            return
        if previous_rates is None:
            if self.acceleration_limits is not None:
                raise InputError("an acceleration limit needs previous_rates: those commanded before, zeros from rest")
            previous_rates = self._no_rates
        elif not (type(previous_rates) is array and previous_rates.dtype is FLOATS):
            previous_rates = self._checked_rates(previous_rates)
        if not (type(out) is array and out.dtype is FLOATS):
            self._checked_out(out)
        self._fill(q, target, target_velocity, previous_rates, out)

    def _fill(
        self, q: ArrayLike, target: ArrayLike, target_velocity: ArrayLike, previous_rates: ArrayLike, out: Floats
    ) -> None:
        """Compute a command at full pace into an array, from arguments of which rates and array are looked at."""
        model, data, A_g, J, placements, U_c, tasks, columns, parameters = self._hot
        try:
            # Pinocchio and Numba may read arrays of another byte order as they lie, and masked ones without their mask.
            if not (
                q.__class__ is target.__class__ is target_velocity.__class__ is array
                and q.dtype is target.dtype is target_velocity.dtype is FLOATS
            ):
                raise TypeError
            if self._quick:
                centroidal_map(model, data, q)
                status = selective_command(  # unpacking its arguments from a tuple would take a hundredth of the step
                    A_g, J, placements, U_c, tasks, columns, parameters, target, target_velocity, previous_rates, out, q
                )
            else:
                status = self._other_command(q, target, target_velocity, previous_rates, out)
        except (TypeError, ValueError, NumbaError):  # a list, another layout, read-only, a wrong length
            q = self.robot.checked(q)
            target, target_velocity = self._flat_vectors(target, target_velocity)
            previous_rates = self._checked_rates(previous_rates)
            out = self._checked_out(out)
            status = self._other_command(q, target, target_velocity, previous_rates, out)
        if status:
            if status == kernel.FAR_AWAY:
                self._evaluate_from_base(q, target, target_velocity, out, previous_rates)
            else:
                self._refuse(q, target, target_velocity, previous_rates, out, status)

    def _evaluate_from_base(
        self, q: ArrayLike, target: ArrayLike, target_velocity: ArrayLike, out: Floats, previous: ArrayLike
    ) -> None:
        """Compute a command in inertial axes through the base origin, which is far from the inertial one."""
        near = self.robot.checked(q).copy()
        origin = near[:3].copy()
        near[:3] = 0.0
        targets, velocities = self._flat_vectors(target, target_velocity)
        self.evaluate(near, self.layout.targets_from(origin, targets), velocities, out, previous)
        out[6 + self._n + kernel.POSITION :][:3] += origin

    def _other_command(self, q: Floats, target: Floats, velocity: Floats, previous: Floats, out: Floats) -> int:
        """Do what `selective_command` does, also where joint positions are read or have limits, or the law plans."""
        model, data, _, (_, _, columns, _), fixed = self._prepared
        pin.computeCentroidalMap(model, data, q)
        if kernel.no_configuration(q, columns):
            return kernel.NOT_UNIT
        if self._climbs is not None:
            place, gain = self._climbs
            velocity = self._flat_vectors(target, velocity)[1].copy()
            velocity[place] = self._rates_that_climb(q, gain)
            pin.computeCentroidalMap(model, data, q)
        if self._step is not None:
            status = self._limited_command(q, target, velocity, previous, out)
        else:
            kernel.read_joints(q, columns)
            status = selective_command(*fixed, target, velocity, previous, out, q)
        return self._hold(q, target, velocity, previous, out) if self.hold_nodes and status == kernel.OK else status

    def _limited_command(
        self, q: ArrayLike, target: ArrayLike, target_velocity: ArrayLike, previous: ArrayLike, out: Floats
    ) -> int:
        """Do what `selective_command` does, and bring the rates inside the limits."""
        fixed, made = self._prepared[4], (self._matrices, self._drift, self._rates, self._rows, self._sides)
        status = kernel.pose_command(*fixed, target, target_velocity, previous, out, q, *made)  # type: ignore[arg-type]
        self._positions[:] = self._prepared[3][2][kernel.JOINT_POSITION]
        if status == kernel.OK and not self.hold_nodes:
            self._bring_inside(q, previous, out)  # type: ignore[arg-type]
        return status

    def _bring_inside(self, q: ArrayLike, previous: Floats, out: Floats, goal: Floats | None = None) -> None:
        """Bring the rates in `out` inside the limits, on the matrices that they were made with.

        The tasks are done as well as they can be, or the rates are as near to the goal (n,) as they can be.
        """
        assert self._step is not None
        _, _, _, (U_c, _, columns, parameters), _ = self._prepared
        n, k, rows, sides, scale = self._n, self._k, self._rows, self._sides, self._scale
        results, positions = out[6 + n :], self._positions
        apart, distances = (None, None) if self._distances is None else self._distances(np.asarray(q))[:2]
        plain = out[6 : 6 + n]
        if scale is not None:
            positions, previous, plain = positions / scale, previous / scale, plain / scale
            apart = None if apart is None else apart * scale
        levels = [
            (rows[place], sides[place], float(results[rho]))
            for place, rho in zip(self._places, self._rhos, strict=True)
        ]
        if goal is not None:
            levels = [(np.eye(n), goal if scale is None else goal / scale, 0.0)]
        self._limited = self._step(
            positions, previous, plain, rows[:k], sides[:k], levels, apart, distances, float(sides[-1])
        )
        found = self._limited.joint_rates
        if found is plain:
            return
        if scale is not None:
            self._step.take_out_rounding(rows[:k], scale, self._limited)
        limited = self._limited.share < 1.0 - kernel.LOST_SHARE
        kernel.take_rates(self._matrices, self._drift, U_c, columns, parameters, found, limited, out)
        results[kernel.EXCESS], results[kernel.LIMITED] = self._limited.excess, self._limited.count

    def check_start(self, q: ArrayLike) -> None:
        """Look at a start configuration before a motion; a law without `limits` has nothing to say.

        Raises:
            InputError: two bodies that shall stay apart are in each other.

        Warns:
            DecoupleWarning: joints are outside their position limits: the law brings them back first.
        """
        if self._step is None or self.limits is None:
            return
        if self._distances is not None:
            self._distances.refuse_overlaps(self.robot.checked(q))
        positions, limits = self.robot.joint_positions(q), self.limits.positions(self.robot)
        outside = np.flatnonzero((positions < limits[:, 0]) | (positions > limits[:, 1]))
        if outside.size:
            told = [
                f"{self.robot.joint_names[j]} at {positions[j]:.4g} ({limits[j, 0]:.4g} to {limits[j, 1]:.4g})"
                for j in outside
            ]
            warnings.warn(
                f"outside their position limits at the start, and brought back first: {', '.join(told)}",
                DecoupleWarning,
                stacklevel=3,
            )

    def base_twist(self, q: Floats, joint_rates: Floats) -> Floats:
        """Return the base twist (6,), base axes, that joint rates (n,) and the momentum on board cause at q.

        Without momentum it is `Coupling.base_twist`, but quick.

        Raises:
            InputError: as for the call.
        """
        model, data, (A_g, *_), (_, _, columns, parameters), _ = self._prepared
        plain = type(q) is array and q.dtype == np.float64 and q.shape == (model.nq,) and q.flags.carray
        if not plain or kernel.no_configuration(q, columns):
            q = self.robot.checked(q)
        plain = type(joint_rates) is array and joint_rates.dtype == np.float64 and joint_rates.shape == (self._n,)
        if not (plain and joint_rates.flags.c_contiguous):
            joint_rates = self._checked_rates(joint_rates)
        pin.computeCentroidalMap(model, data, from_base(q))
        kernel.base_twist_map(A_g, self._J_base)
        twist = self._J_base @ joint_rates
        momentum = parameters[kernel.MOMENTUM :]
        return twist + np.linalg.solve(A_g[:, :6], momentum) if momentum.any() else twist

    def rotation_to_axes(self, q: Floats) -> Floats | None:
        """Return the rotation (3, 3) at q from base axes to those in which `directions` are fixed.

        None where those are base axes.
        """
        frame = self.directions[1]
        if frame == "base":
            return None
        model, data, *_ = self._prepared
        pin.forwardKinematics(model, data, q)
        R: Floats = data.oMi[1].rotation
        if frame == "inertial":
            return R.copy()
        held = model.frames[self.robot.frame_id(frame)]
        return (data.oMi[held.parentJoint].rotation @ held.placement.rotation).T @ R

    def mean_twist(self, q: Floats, joint_rates: Floats) -> Floats:
        """Return the mean base twist (6,) over the hold of joint rates (n,) from q, in the axes of `directions`.

        It is taken on the law's own Gauss points, as the law plans; without hold nodes it is the twist at q.
        """
        model, hold, nodes = self.robot.model, float(self.sample_time or 0.0), GAUSS[self.hold_nodes]
        drifting, velocity = bool(self.momentum.any()), np.r_[np.zeros(6), joint_rates]
        if not nodes:
            places = q[None]
        elif drifting:
            places = np.array([self._after(q, velocity, i) for i in range(len(nodes))])
        else:
            places = np.array([pin.integrate(model, q, node * hold * velocity) for node, _ in nodes])
        twists = np.array([self.base_twist(place, joint_rates) for place in places])
        if nodes and not drifting:
            places = places_on_hold(model, q, joint_rates, hold, twists)
        return quadrature_along(self.rotation_to_axes, places, twists, 1.0)

    def lost_direction(self, q: ArrayLike) -> LostDirection:
        """Return the direction that the tasks of level 1 can move in least at q, and which protected row takes it.

        It is the left singular vector of the smallest singular value of J_1 N_sub, one of them where there are several.

        Raises:
            InputError: q has the wrong length or is not finite.
        """
        checked, scale = from_base(self.robot.checked(q)), 1.0 / np.sqrt(self.joint_weights)
        J = scale * self._task_jacobian(checked)[self.layout.level_rows[0]]
        coupling = self.robot.coupling(checked)
        J_sub = scale * self.protection.J_sub(coupling)
        first = 0 if self.protection.U_twist[:3].any() else 3
        far = 1.0 + float(np.abs(self.robot.frame_pose(checked).translation).sum())
        noise = kernel.NOISE * far * float(np.linalg.norm(scale * coupling.J_base[first:]))

        def left_by(rows: Floats) -> Floats:
            return kernel.past_protected(np.ascontiguousarray(rows), np.ascontiguousarray(J), noise)

        direction = np.linalg.svd(left_by(J_sub))[0][:, -1]
        without = [float(np.linalg.norm(direction @ left_by(np.delete(J_sub, i, axis=0)))) for i in range(self._k)]
        return LostDirection(direction, float(np.linalg.norm(direction @ left_by(J_sub))), np.array(without))

    def _hold(self, q: ArrayLike, target: Floats, target_velocity: Floats, previous: Floats, out: Floats) -> int:
        """Replace the command at the sample in `out` by the one for the hold.

        Mean matrices and command are found together by fixed-point iteration. Near a singularity the command answers so
        strongly to the matrices that this need not settle; then the task is given up for this hold, and the last rates
        are only projected on the null space of the mean J_sub, again and again, which settles.
        """
        model, _, views, (_, tasks, columns, parameters), _ = self._prepared
        velocity, results = out[: model.nv], out[model.nv :]
        kernel.base_twist_map(views[0], self._J_here)  # at the sample, as is the base twist that the command tells
        errors = results[kernel.ERRORS :][: self.layout.size]
        self._base_drift = out[:6] - self._J_here @ velocity[6:]
        kept_position, kept_errors = results[kernel.POSITION :][:3].copy(), errors.copy()
        kernel.advance_targets(tasks, target, target_velocity, 0.5 * float(self.sample_time or 0.0), self._later)
        status, change = self._plan(q, (columns, parameters), target_velocity, previous, out)
        if status == kernel.OK and change > CONVERGED:
            # A blend of nothing with the given rates, in the kernel's words: their projection.
            columns, parameters, kept = columns.copy(), parameters.copy(), results.copy()
            columns[kernel.RATE_STEP], parameters[kernel.LIMITS_STEPS] = 0.0, 1.0
            settings, last = (columns, parameters), velocity[6:].copy()
            status, change = self._plan(q, settings, target_velocity, last, out, previous)
            told = (*range(kernel.POSITION), kernel.LOST, kernel.LOST_TO)
            kept[[*told]] = results[[*told]]
            results[:] = kept
        results[kernel.POSITION :][:3], errors[:] = kept_position, kept_errors  # as the base twist
        results[kernel.PLAN_CHANGE] = change
        return status

    def _plan(
        self,
        q: ArrayLike,
        settings: tuple[Floats, Floats],
        velocities: Floats,
        previous: Floats,
        out: Floats,
        commanded: Floats | None = None,
    ) -> tuple[int, float]:
        """Iterate on mean matrices and command; return the status and the last relative change of the rates.

        Where `previous` are rates to be projected, `commanded` are those that were commanded before.
        """
        model, data, views, (U_c, tasks, columns, _), fixed = self._prepared
        hold, matrices, drift, rates = float(self.sample_time or 0.0), self._matrices, self._drift, self._rates
        targets = self._later
        velocity, results = out[: model.nv], out[model.nv :]
        position, errors = results[kernel.POSITION :][:3], results[kernel.ERRORS :][: self.layout.size]
        status, change, before = kernel.OK, np.inf, velocity[6:].copy()
        nodes, turning = GAUSS[self.hold_nodes], self._turning
        if turning:
            self._ways = hold * np.outer([node for node, _ in nodes], velocity[:6])
        for _ in range(PASSES):
            for total in (matrices, drift, rates, position, errors):
                total[:] = 0.0
            for i, (_, weight) in enumerate(nodes):
                moved = self._after(q, velocity, i)
                pin.computeCentroidalMap(model, data, moved)
                if turning:
                    kernel.base_twist_map(views[0], self._J_nodes[i])
                if self._reads_joints:
                    kernel.read_joints(moved, columns)
                status = status or kernel.add_matrices(*fixed, targets, velocities, weight, matrices, drift, rates, out)
            status = status or kernel.held_command(
                matrices, drift, U_c, tasks, *settings, targets, velocities, previous, rates, out
            )
            if self._step is not None and status == kernel.OK:
                kernel.pose_rows(
                    matrices, drift, U_c, tasks, *settings, velocities, rates, results, self._rows, self._sides
                )
                if commanded is None:
                    self._bring_inside(q, previous, out)
                else:
                    self._bring_inside(q, commanded, out, goal=previous)
            velocity[:6] = self._J_here @ velocity[6:] + self._base_drift
            if turning:
                self._ways = ways_to_nodes(self._J_nodes @ velocity[6:], hold)
            change = kernel.change_of(velocity[6:], before)
            if status != kernel.OK or change <= CONVERGED:
                break
        return status, change

    def _after(self, q: ArrayLike, velocity: Floats, node: int) -> Floats:
        """Return where joint rates that are held lead until a Gauss node of the hold.

        Directions fixed in inertial axes need the attitude there: it comes from the twists at all nodes in the pass
        before, so that it settles with the rates. Of directions fixed in base axes or those of a link no matrix depends
        on where the base is, so that its first twist will do. With momentum on board the base is led there step by
        step.
        """
        time, rates = GAUSS[self.hold_nodes][node][0] * float(self.sample_time or 0.0), velocity[6:]
        if self._turning:
            return pin.integrate(self.robot.model, q, np.r_[self._ways[node], time * rates])
        if not self._prepared[3][3][kernel.MOMENTUM :].any():
            return pin.integrate(self.robot.model, q, time * velocity)
        start = np.asarray(q)

        def drifting(at: Floats, _: float) -> Floats:
            return np.r_[self.base_twist(at, rates), rates]

        return munthe_kaas(self.robot.model, start, drifting(start, 0.0), time, drifting)[0]

    def _flat_vectors(self, target: ArrayLike, velocity: ArrayLike) -> tuple[Floats, Floats]:
        if self._flat:
            return _vector("target", target), _vector("target_velocity", velocity)
        flat = as_floats("target", target), as_floats("target_velocity", velocity)
        for name, values, size in zip(("target", "target_velocity"), flat, self.layout.target_sizes, strict=True):
            if values.shape != (size,):
                raise InputError(
                    f"{name} has shape {values.shape}; it needs the {size} numbers of law.layout.flat_..(..)"
                )
        return flat

    def _asked(self, protected_rate: ArrayLike | None, pace: float) -> Floats:
        """Return pace and protected rate as they stand in the kernel's parameters."""
        asked = np.zeros(kernel.MOMENTUM - kernel.PACE)
        asked[0] = as_number("pace", pace)
        if not 0.0 <= asked[0] <= 1.0:
            raise InputError(f"pace is {pace}; it is between 0 (at rest) and 1 (full)")
        if protected_rate is not None:
            rate = as_floats("protected_rate", protected_rate)
            if rate.shape != (self._k,) or not np.all(np.isfinite(rate)):
                raise InputError(
                    f"protected_rate is {shown(rate.tolist())}; it needs {self._k} finite numbers, one a column of U_c"
                )
            asked[1 : 1 + self._k] = rate
        return asked

    def _checked_rates(self, rates: ArrayLike) -> Floats:
        values = as_floats("previous_rates", rates)
        if values.shape != (self.robot.n_joints,) or not np.all(np.isfinite(values)):
            raise InputError(f"previous_rates needs {self.robot.n_joints} finite joint rates, not shape {values.shape}")
        return values

    def _checked_out(self, out: Floats) -> Floats:
        fit = type(out) is np.ndarray and out.dtype == np.float64 and out.shape == (self.size,)
        if not (fit and out.flags.carray):
            raise InputError(f"out must be a writable, contiguous float64 array ({self.size},), law.size long")
        return out

    def _refuse(
        self, q: ArrayLike, target: ArrayLike, target_velocity: ArrayLike, rates: ArrayLike, out: Floats, status: int
    ) -> None:
        self.robot.checked(q)
        self._checked_rates(rates)
        vectors = self._flat_vectors(target, target_velocity)
        for name, value in zip(("target", "target_velocity"), vectors, strict=True):
            if not np.all(np.isfinite(value)):
                raise InputError(f"{name} is not finite: {shown(value.tolist())}")
        self._checked_out(out)
        if status == kernel.NOT_A_TARGET:
            raise InputError(self.layout.strange_target(np.asarray(target)))
        why = {
            kernel.NO_INERTIA: "the whole robot's inertia H_ww is singular",
            kernel.OTHER_MASS: f"robot.model does not weigh {self.robot.mass:g} kg: it was changed after it was loaded",
        }.get(status, "its numbers overflow")
        raise InputError(f"no command at this configuration of '{self.robot.name}': {why}")

    def describe(self) -> dict[str, Any]:
        """Return the law's settings in plain types, for a record."""
        limits = self.acceleration_limits
        return {
            "law": "selective",
            "U_c": self.protection.U_c.tolist(),
            "frame": self.protection.frame,
            "k": self.protection.k,
            "tasks": [task.describe() for task in self.tasks],
            "gain": self.gain,
            "rate_limits": self.rate_limits.tolist(),
            "joint_weights": self.joint_weights.tolist(),
            "momentum": self.momentum.tolist(),
            "damping": self.damping,
            "damping_threshold": self.damping_threshold,
            "sample_time": self.sample_time,
            "hold_nodes": self.hold_nodes,
            "acceleration_limits": None if limits is None else limits.tolist(),
            "limits": None if self.limits is None else self.limits.describe(self.robot),
        }


def _placements(data: pin.Data, joints: int) -> Floats:
    """Return one live view (joints, 12) of all of `data.oMi`: rotations by columns, translations."""
    first = data.oMi[0].rotation
    start, width = first.__array_interface__["data"][0], 12 * first.itemsize
    for i in range(joints):
        addresses = [part.__array_interface__["data"][0] for part in (data.oMi[i].rotation, data.oMi[i].translation)]
        if addresses != [start + i * width, start + i * width + 9 * first.itemsize]:
            raise RuntimeError("this Pinocchio does not keep its placements one after the other")
    return np.lib.stride_tricks.as_strided(first, (joints, 12), (width, first.itemsize))


def _checked_limits(limits: Limits) -> Limits:
    from ssm_decouple.control.limits import Limits

    return as_kind("limits", limits, Limits, "give Limits, such as Limits(braking=0.8), or None")


def _vector(name: str, value: ArrayLike) -> Floats:
    vector = as_floats(name, value)
    if vector.shape != (3,):
        raise InputError(f"{name} has shape {vector.shape}; it needs 3 numbers, m or m/s in inertial axes")
    return vector


def _default_weights(robot: Robot, rate_limits: Floats) -> Floats:
    weights, wheels = np.ones(robot.n_joints), [robot.joint_index(name) for name in robot.wheel_names]
    others = np.delete(rate_limits, wheels)
    if wheels and others.size and np.all(np.isfinite([*rate_limits[wheels], others.max()])):
        weights[wheels] = (others.max() / rate_limits[wheels]) ** 2
    return fixed_array(weights)
