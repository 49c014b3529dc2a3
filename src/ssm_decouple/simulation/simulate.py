"""Simulation: the law closes the loop; the momentum law, or the equations of motion under torques, move the base."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable
from functools import partial
from typing import Any, Literal

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from ssm_decouple.control import kernel
from ssm_decouple.control.law import SelectiveLaw
from ssm_decouple.control.schedule import ScheduledLaw
from ssm_decouple.errors import (
    DecoupleError,
    DecoupleWarning,
    InputError,
    as_floats,
    as_function,
    as_kind,
    as_not_negative,
    as_positive,
    as_switch,
    as_triple,
    is_function,
    shown,
)
from ssm_decouple.model.origin import far_origin
from ssm_decouple.simulation.dynamic import DivergedError, Dynamic, DynamicMotion, refuse_endless, warn_of_limits
from ssm_decouple.simulation.motion import Outcome, build_motion, error_of, judge, record_bytes
from ssm_decouple.simulation.steps import STEPS, Demand, Pace, Reference, Wanted, sample_times
from ssm_decouple.simulation.telling import sentences, tell

Floats = NDArray[np.float64]
Method = Literal["explicit", "held", "rk4"]
Target = Callable[[float], tuple[Any, Any]]
Progress = Callable[[float], object]


class SimulationInterrupted(KeyboardInterrupt):
    """Ctrl-C during a simulation; `motion` holds what was computed until then."""

    def __init__(self, motion: xr.Dataset) -> None:
        super().__init__(f"interrupted at {float(motion.time[-1]):g} s")
        self.motion = motion


class DivergenceError(DecoupleError, ArithmeticError):
    """A dynamic simulation whose numbers have run away; `motion` holds the samples before."""

    def __init__(self, message: str, motion: xr.Dataset) -> None:
        super().__init__(message)
        self.motion = motion


def simulate(
    law: SelectiveLaw,
    q: ArrayLike,
    target: Any | Target,
    duration: float,
    dt: float,
    method: Method | Dynamic = "explicit",
    arrival_tolerance: float = 0.01,
    stop_early: bool = False,
    progress: Progress | None = None,
    smooth_start: float = 0.0,
    protected_rate: ArrayLike | Callable[[float], ArrayLike] | None = None,
) -> xr.Dataset:
    """Simulate the arm moving under a law while momentum turns and shifts the free base.

    Joints start at rest; the base too, unless the law has momentum on board: that is then the truth.

    Args:
        law: The law, called at every sample.
        q: Start configuration (nq,).
        target: Desired end-effector position (3,), m, inertial axes, or what the law's tasks take; or a function of
            time, s, that returns this and its velocity.
        duration: Length of the motion, s.
        dt: Time between samples, s. A last shorter step is taken where `duration` is no multiple of it.
        method: "explicit" holds joint rates and base twist for one step, how we read the paper. "held" holds the joint
            rates, as a perfect servo does, and moves the base exactly in between, by a sixth-order Magnus expansion:
            the truth for a sampled law. "rk4" is a fourth-order Lie-group Runge-Kutta method that calls the law within
            the step too, and so integrates the law in continuous time. A `Dynamic` solves the equations of motion:
            joints driven by torques, appendages that bend, a plant that differs from the model.
        arrival_tolerance: Distance, m, within which the end-effector has arrived. Of other tasks the norm of all errors
            of level 1, m and rad.
        stop_early: End when the end-effector has arrived or has stalled instead of after `duration`.
        progress: Called now and then with the share done, 0 to 1.
        smooth_start: Time, s, over which the law's pace rises from 0 to 1 as 10 x^3 - 15 x^4 + 6 x^5, so that rates and
            accelerations start from zero without a jump. Held commands take the pace of the middle of their hold.
        protected_rate: b (k,), or a function of time, s, that returns it: what the protected rate shall be, so that the
            arm turns the base about a protected axis while it works; None for zero. Held commands take that of the
            middle of their hold. The record's `protected_angle` tells what came of it.

    Returns:
        The motion. Coordinates `time` (s), `joint`, `axis`, `twist`, `protected`; each variable has `units`, `frame`
        and `long_name`. Variables: configuration, joint_positions, joint_rates, base_position, base_quaternion,
        base_rpy, base_linear_velocity, base_angular_velocity, base_twist_integral, protected_rate, protected_angle,
        end_effector_position, target_position, end_effector_error, smallest_singular_value, rate_scale, rate_blend,
        plan_change, damping, linear_momentum, angular_momentum, centre_of_mass, U_c, robot_urdf. Attributes: `outcome`
        ("converged", "stalled" or "running"), `outcome_time` (s), `final_error` (m), the law's settings, the method
        and the versions. What was promised and not kept is told by attributes (JSON) that are there only then, and by a
        warning each: `protection_lost` (the protected rate is not what was asked for: from when to when, how much,
        why), `plan_unsettled` (planning for the hold has not settled), `rate_reversals` (joints whose commanded rates
        alternate from sample to sample), `acceleration_exceeded` (joints whose commanded rates change faster than the
        law's acceleration limits, for what comes before these) and, of kinematic motions, `wheel_torque_exceeded`
        (wheels that would need more torque than their motors have). Of a stalled motion
        `lost_direction` (JSON) says in which direction the tasks of level 1 could
        move least at its end, and how much better that would be without each protected row. With other tasks
        than the end-effector's position there is also `task_error` (time, task_row), m or rad, as the law sees
        it, each row with its name and `task_level`; where no task asks for a position of the end-effector, its
        target and error are not numbers. A dynamic motion has also joint_velocities, joint_torques,
        hinge_angles, tip_deflection, kinetic_energy, spring_energy, drive_work, load_work, damping_loss,
        saturated_time, protected_angle_parts (time, cause, protected), and the attributes `physics`, `appendages`
        (JSON: what `Appendage` is made of), `energy_error`, `momentum_drift` (both relative), `largest_torques`,
        `saturated`: from when to when a drive stood at its torque limit, and `saturated_joints` (JSON): which ones, and
        for which share of the time.

    Raises:
        InputError: an argument makes no sense; the message names it.
        DivergenceError: the numbers of a dynamic simulation run away; it carries the motion until then.
        SimulationInterrupted: Ctrl-C; it is a KeyboardInterrupt and carries the motion so far.
        Exception: whatever a function of yours raises (target, protected_rate, progress, that of a schedule) comes
            through as it is. An error in the middle of the motion carries the motion so far as its attribute `motion`.

    Warns:
        DecoupleWarning: the target is out of reach, or a promise was not kept.
    """
    as_kind("law", law, SelectiveLaw, "give a law, such as SelectiveLaw(robot, Protection('yaw'))")
    time = sample_times(duration, dt, record_bytes(law, isinstance(method, Dynamic)))
    duration, dt = float(time[-1]), as_positive("dt", dt)
    if not (isinstance(method, Dynamic) or (isinstance(method, str) and method in STEPS)):
        raise InputError(f"method {shown(method)} is unknown: use {', '.join(STEPS)} or a Dynamic")
    law.robot.refuse_changed_model()
    as_function("progress", progress)
    stop_early = as_switch("stop_early", stop_early)
    smooth_start = as_not_negative("smooth_start", smooth_start)
    _refuse_unfit_method(law, method, duration, dt)
    tolerance = as_positive("arrival_tolerance", arrival_tolerance, "it must be a positive distance, m")
    reference = _reference(law, target)
    demand = Demand(reference, _smooth_pace(smooth_start), _wanted(law, protected_rate, method))
    if isinstance(method, Dynamic):
        refuse_endless(method, duration, dt)
    run = _Run(law, law.robot.checked(q).copy(), time, demand, method)
    law, reference = run.law, run.demand.reference
    if law.layout.tool_target is not None:
        _warn_out_of_reach(law, run.configurations[0], reference(0.0)[0][law.layout.tool_target])
    law.check_start(run.configurations[0])
    run.settings = {"arrival_tolerance": tolerance, "smooth_start": smooth_start}
    tick = max(1, time.size // 100)
    try:
        for i in range(time.size):
            run.step()
            if i % tick == 0:
                if progress is not None:
                    progress(run.done / time.size)
                # Slow on purpose is not stalled.
                if stop_early and time[i] >= smooth_start and run.ended(tolerance):
                    break
        if progress is not None:
            progress(1.0)
    except KeyboardInterrupt:
        if run.done == 0:
            raise
        raise SimulationInterrupted(run.record()) from None
    except DivergedError as when:
        raise DivergenceError(
            f"the simulation has diverged at {when} s: the equations of motion run away or have no solution there; try "
            "a shorter physics step or a softer servo",
            run.record(),
        ) from None
    except BaseException as error:  # sys.exit in a user's function and the like among them
        if run.done:
            _give_motion(error, run)
        raise
    motion = run.record()
    for sentence in sentences(motion):
        warnings.warn(sentence, DecoupleWarning, stacklevel=2)
    if isinstance(method, Dynamic):
        warn_of_limits(motion)
    return motion


class _Run:
    """A simulation on its way: what has been computed so far, and how to go on by one sample."""

    def __init__(
        self, law: SelectiveLaw, start: Floats, time: Floats, demand: Demand, method: Method | Dynamic
    ) -> None:
        # Where the base starts far away, all is computed from there, and the record is moved back.
        self.origin = far_origin(start[:3])
        if self.origin is not None:
            law, demand = law.seen_from(self.origin), _seen_from(self.origin, law, demand)
            start[:3] = 0.0
        self.law, self.time, self.demand, self.method = law, time, demand, method
        self.dynamic = DynamicMotion(method, law, start, time[1] - time[0]) if isinstance(method, Dynamic) else None
        # A command that is held speaks for the middle of its hold, one of the continuous law for its own time.
        holds = np.diff(time, append=2 * time[-1] - time[-2])
        self.leads = np.zeros(time.size) if method == "rk4" else 0.5 * holds
        samples, n = time.size, law.robot.n_joints
        self.configurations = np.empty((samples, start.size))
        self.configurations[0] = start
        self.twists = np.zeros((2, samples, 6))  # integrals, in base axes and in those of the law's directions
        self.targets = np.empty((samples, law.layout.target_sizes[0]))
        self.values = np.empty((samples, law.size))
        self.rates = self.values[:, 6 : 6 + n]
        self.errors = self.values[:, 6 + n + kernel.ERRORS :][:, law.layout.level_rows[0]]
        self.at_rest = np.zeros(n)
        self.done = 0
        self.settings: dict[str, float] = {}

    def step(self) -> None:
        """Move to the next sample and ask the law there."""
        i, time = self.done, self.time
        if i > 0:
            self.configurations[i], moved = self._move(i)
            self.twists[:, i] = self.twists[:, i - 1] + moved
        self.targets[i], velocity = self.demand.reference(time[i])
        middle = time[i] + self.leads[i]
        previous, pace = self.rates[i - 1] if i else self.at_rest, self.demand.pace(middle)
        seen, wanted = self.configurations[i], self.demand.protected_rate(middle)
        if self.dynamic is not None:
            self.dynamic.sample()
            seen, correction = self.dynamic.seen(), self.dynamic.correction()
            wanted = wanted if correction is None else correction
        self.law.evaluate(seen, self.targets[i], velocity, self.values[i], previous, wanted, pace, time[i])
        self.done = i + 1

    def _move(self, i: int) -> tuple[Floats, Floats]:
        span = (self.time[i - 1], self.time[i])
        if self.dynamic is not None:
            return self.dynamic.move(self.rates[i - 1], *span)
        step = STEPS[str(self.method)]
        return step(self.law, self.demand, self.configurations[i - 1], self.values[i - 1], *span)

    def ended(self, tolerance: float) -> bool:
        """Say whether the end-effector has arrived or has stalled."""
        error = np.linalg.norm(self.errors[: self.done], axis=1)
        return self._judged(error, tolerance).name != "running"

    def _judged(self, error: Floats, tolerance: float) -> Outcome:
        way = np.linalg.norm(np.diff(self.targets[: self.done], axis=0), axis=1)
        target_way = np.r_[0.0, np.cumsum(way)] if way.any() else None
        return judge(self.time[: self.done], error, tolerance, 1.0 / self.law.layout.slowest_gain, target_way)

    def record(self) -> xr.Dataset:
        """Return the motion so far."""
        law, done, time = self.law, self.done, self.time[: self.done]
        record = partial(build_motion, law) if self.dynamic is None else self.dynamic.record
        motion = record(
            time, self.configurations[:done], self.values[:done], self.twists[:, :done], self.targets[:done]
        )
        motion.attrs |= tell(motion, law, self.values[:done], self.configurations[0], self.dynamic is not None)
        if self.origin is not None:
            _move_back(motion, self.origin)
        outcome = self._judged(error_of(motion), self.settings["arrival_tolerance"])
        motion.attrs |= {
            "method": "dynamic" if self.dynamic is not None else self.method,
            **self.settings,
            "outcome": outcome.name,
            "outcome_time": outcome.time,
            "final_error": outcome.error,
        }
        if outcome.name == "stalled" and not isinstance(law, ScheduledLaw):
            motion.attrs["lost_direction"] = json.dumps(law.lost_direction(self.configurations[done - 1]).told(law))
        return motion


def _give_motion(error: BaseException, run: _Run) -> None:
    """Attach the motion so far to an error, the user's or ours, that ends it."""
    try:
        error.motion = run.record()  # type: ignore[attr-defined]
    except Exception:  # it takes no attribute, or a function of the user's fails once more: the first error counts
        return
    error.add_note(f"the motion until {run.time[run.done - 1]:g} s is this error's attribute 'motion'")


def _refuse_unfit_method(law: SelectiveLaw, method: Method | Dynamic, duration: float, dt: float) -> None:
    if law.sample_time is not None and abs(law.sample_time - dt) > 1e-9 * dt:
        raise InputError(f"the law's sample_time is {law.sample_time:g} s, dt is {dt:g} s; they must be the same")
    if law.sample_time is not None and abs(duration / dt - round(duration / dt)) > 1e-9 * duration / dt:
        raise InputError(
            f"duration {duration:g} s is no whole number of steps of {dt:g} s, for each of which the law plans"
        )
    if law.hold_nodes and method in ("explicit", "rk4"):
        raise InputError(
            f"a law with hold_nodes plans for joint rates that are held: use method 'held' or a Dynamic, not '{method}'"
        )
    if law.acceleration_limits is not None and method == "rk4":
        raise InputError("acceleration limits hold from sample to sample: use method 'held' or 'explicit', not 'rk4'")


def _seen_from(origin: Floats, law: SelectiveLaw, demand: Demand) -> Demand:
    """Return what is asked of the law, positions in inertial axes counted from another origin (3,), m."""

    def reference(time: float) -> tuple[Floats, Floats]:
        targets, velocities = demand.reference(time)
        return law.layout.targets_from(origin, targets), velocities

    return demand._replace(reference=reference)


def _move_back(motion: xr.Dataset, origin: Floats) -> None:
    """Count the positions of a record from the inertial origin again, of which `origin` (3,), m, was the start."""
    for name in ("base_position", "end_effector_position", "target_position", "centre_of_mass"):
        motion[name].values = motion[name].values + origin
    configurations = motion.configuration.values.copy()
    configurations[:, :3] += origin
    motion["configuration"].values = configurations


def _smooth_pace(duration: float) -> Pace:
    def pace(time: float) -> float:
        if time >= duration:
            return 1.0
        x = time / duration
        return float(x**3 * (10.0 - 15.0 * x + 6.0 * x**2))

    return pace


def _reference(law: SelectiveLaw, target: Any | Target) -> Reference:
    """Return the flat targets and velocities as a function of time."""
    at_rest = law.layout.flat_velocities(None)
    if is_function(target):

        def moving(time: float) -> tuple[Floats, Floats]:
            told = target(time)
            if not isinstance(told, tuple | list | np.ndarray) or len(told) != 2:
                raise InputError(
                    "a target function returns two things: position (3,) and velocity (3,), or what the tasks take and "
                    f"its velocity; at {time:g} s it has returned {shown(told)}"
                )
            position, velocity = told
            if law.layout.plain:
                return (
                    as_triple("target position", position, "inertial axes"),
                    as_triple("target velocity", velocity, "inertial axes"),
                )
            velocities = _finite(law.layout.flat_velocities(velocity), "target velocity")
            return _finite(law.layout.flat_targets(position), "target"), velocities

        return moving
    fixed = (
        as_triple("target", target, "inertial axes")  # type: ignore[arg-type]
        if law.layout.plain
        else _finite(law.layout.flat_targets(target), "target")
    )
    return lambda _: (fixed, at_rest)


def _wanted(
    law: SelectiveLaw, given: ArrayLike | Callable[[float], ArrayLike] | None, method: Method | Dynamic
) -> Wanted:
    """Return the protected rate that is asked for as a function of time."""
    if given is None:
        return lambda _: None
    if isinstance(method, Dynamic) and (method.feedback_gain or (method.servo is not None and method.servo.protects)):
        raise InputError(
            "feedback_gain and a servo that protects hold the base still along the protected directions; leave them "
            "out where a protected_rate is asked for"
        )
    if isinstance(given, type) or not callable(given):
        constant = as_floats("protected_rate", given)  # type: ignore[arg-type]
        return lambda _: constant
    function = given

    def wanted(time: float) -> Floats:
        return as_floats("protected_rate", function(time))

    return wanted


def _finite(values: Floats, name: str) -> Floats:
    if not np.all(np.isfinite(values)):
        raise InputError(f"{name} is not finite: {shown(values.tolist())}")
    return values


def _warn_out_of_reach(law: SelectiveLaw, q: Floats, target: Floats) -> None:
    beyond = float(np.linalg.norm(target - law.robot.shoulder_position(q))) - law.robot.reach
    if beyond > 0:
        listed = ", ".join(f"{x:g}" for x in target)
        warnings.warn(
            f"the target ({listed}) m is {beyond:.3g} m beyond the arm's reach of {law.robot.reach:.3g} m "
            "from its first joint",
            DecoupleWarning,
            stacklevel=3,
        )
