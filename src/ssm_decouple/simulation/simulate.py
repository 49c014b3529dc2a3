"""Kinematic simulation: the law closes the loop, the momentum law moves the base."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Literal

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike, NDArray

from ssm_decouple.control import kernel
from ssm_decouple.control.law import AT_REST, SelectiveLaw
from ssm_decouple.errors import DecoupleWarning, InputError, as_floats
from ssm_decouple.simulation.motion import build_motion, judge
from ssm_decouple.simulation.steps import STEPS, Reference

Floats = NDArray[np.float64]
Method = Literal["explicit", "held", "rk4"]
Target = Callable[[float], tuple[ArrayLike, ArrayLike]]
Progress = Callable[[float], object]


MOST_STEPS = 1e8  # a record of more would not fit into memory


class SimulationInterrupted(KeyboardInterrupt):
    """Ctrl-C during a simulation; `motion` holds what was computed until then."""

    def __init__(self, motion: xr.Dataset) -> None:
        super().__init__(f"interrupted at {float(motion.time[-1]):g} s")
        self.motion = motion


def simulate(
    law: SelectiveLaw,
    q: ArrayLike,
    target: ArrayLike | Target,
    duration: float,
    dt: float,
    method: Method = "explicit",
    arrival_tolerance: float = 0.01,
    stop_early: bool = False,
    progress: Progress | None = None,
) -> xr.Dataset:
    """Simulate the arm moving under a law while momentum turns and shifts the free base, from rest.

    Args:
        law: The law, called at every sample.
        q: Start configuration (nq,).
        target: Desired end-effector position (3,), m, inertial axes; or a function of time, s, that returns position
            and velocity.
        duration: Length of the motion, s.
        dt: Time between samples, s. A last shorter step is taken where `duration` is no multiple of it.
        method: "explicit" holds joint rates and base twist for one step, how we read the paper. "held" holds the joint
            rates, as a perfect servo does, and moves the base exactly in between, by a sixth-order Magnus expansion:
            the truth for a sampled law. "rk4" is a fourth-order Lie-group Runge-Kutta method that calls the law within
            the step too, and so integrates the law in continuous time.
        arrival_tolerance: Distance, m, within which the end-effector has arrived.
        stop_early: End when the end-effector has arrived or has stalled instead of after `duration`.
        progress: Called now and then with the share done, 0 to 1.

    Returns:
        The motion. Coordinates `time` (s), `joint`, `axis`, `protected`; each variable has `units`, `frame` and
        `long_name`. Variables: configuration, joint_positions, joint_rates, base_position, base_quaternion, base_rpy,
        base_linear_velocity, base_angular_velocity, base_rotation_integral, protected_rate, protected_angle,
        end_effector_position, target_position, end_effector_error, smallest_singular_value, rate_scale, rate_blend,
        plan_change, damping, linear_momentum, angular_momentum, centre_of_mass, U_c, robot_urdf. Attributes: `outcome`
        ("converged", "stalled" or "running"), `outcome_time` (s), `final_error` (m), the law's settings, the method
        and the versions.

    Raises:
        InputError: an argument makes no sense; the message names it.
        SimulationInterrupted: Ctrl-C; it is a KeyboardInterrupt and carries the motion so far.
    """
    time = _sample_times(duration, dt)
    if method not in STEPS:
        raise InputError(f"method '{method}' is unknown: use {', '.join(STEPS)}")
    _refuse_unfit_method(law, method, duration, dt)
    if not (np.isfinite(arrival_tolerance) and arrival_tolerance > 0):
        raise InputError(f"arrival_tolerance is {arrival_tolerance}; it must be a positive distance, m")
    robot = law.robot
    start = robot.checked(q).copy()
    reference = _reference(target)
    _warn_out_of_reach(law, start, reference(0.0)[0])

    samples = time.size
    configurations = np.empty((samples, robot.model.nq))
    configurations[0] = start
    turns = np.zeros((samples, 3))
    targets = np.empty((samples, 3))
    values = np.empty((samples, law.size))
    step = STEPS[method]
    rates = values[:, 6 : 6 + robot.n_joints]
    at_rest = np.zeros(robot.n_joints)
    error_column = slice(6 + robot.n_joints + kernel.ERROR, 6 + robot.n_joints + kernel.ERROR + 3)
    time_constant = 1.0 / law.gain
    tick = max(1, samples // 100)
    done = 0

    def record() -> xr.Dataset:
        motion = build_motion(law, time[:done], configurations[:done], values[:done], turns[:done], targets[:done])
        outcome = judge(time[:done], motion.end_effector_error.values, arrival_tolerance, time_constant)
        motion.attrs |= {
            "method": method,
            "arrival_tolerance": arrival_tolerance,
            "outcome": outcome.name,
            "outcome_time": outcome.time,
            "final_error": outcome.error,
        }
        return motion

    try:
        for i in range(samples):
            if i > 0:
                before = (configurations[i - 1], values[i - 1], time[i - 1], time[i])
                configurations[i], turned = step(law, reference, *before)
                turns[i] = turns[i - 1] + turned
            targets[i], velocity = reference(time[i])
            law.evaluate(configurations[i], targets[i], velocity, values[i], rates[i - 1] if i else at_rest)
            done = i + 1
            if progress is not None and i % tick == 0:
                progress(done / samples)
            if stop_early and i % tick == 0:
                error = np.linalg.norm(values[:done, error_column], axis=1)
                if judge(time[:done], error, arrival_tolerance, time_constant).name != "running":
                    break
    except KeyboardInterrupt:
        if done == 0:
            raise
        raise SimulationInterrupted(record()) from None
    if progress is not None:
        progress(1.0)
    return record()


def _refuse_unfit_method(law: SelectiveLaw, method: str, duration: float, dt: float) -> None:
    if law.sample_time is not None and abs(law.sample_time - dt) > 1e-9 * dt:
        raise InputError(f"the law's sample_time is {law.sample_time:g} s, dt is {dt:g} s; they must be the same")
    if law.sample_time is not None and abs(duration / dt - round(duration / dt)) > 1e-9 * duration / dt:
        raise InputError(
            f"duration {duration:g} s is no whole number of steps of {dt:g} s, for each of which the law plans"
        )
    if law.hold_nodes and method != "held":
        raise InputError(
            f"a law with hold_nodes plans for joint rates that are held: use method 'held', not '{method}'"
        )
    if law.acceleration_limits is not None and method == "rk4":
        raise InputError("acceleration limits hold from sample to sample: use method 'held' or 'explicit', not 'rk4'")


def _sample_times(duration: float, dt: float) -> Floats:
    for name, value in (("dt", dt), ("duration", duration)):
        if not (np.isfinite(value) and value > 0):
            raise InputError(f"{name} is {value}; it must be a positive time, s")
    if dt > duration:
        raise InputError(f"dt is {dt:g} s, longer than the duration of {duration:g} s")
    if duration / dt > MOST_STEPS:
        raise InputError(f"{duration:g} s in steps of {dt:g} s are more than {MOST_STEPS:g} steps; take a longer dt")
    steps = int(np.ceil(duration / dt * (1 - 1e-12)))
    time = float(dt) * np.arange(steps + 1, dtype=np.float64)
    time[-1] = duration
    return time


def _reference(target: ArrayLike | Target) -> Reference:
    if callable(target):

        def moving(time: float) -> tuple[Floats, Floats]:
            try:
                position, velocity = target(time)
            except (TypeError, ValueError):
                raise InputError("a target function returns two things: position (3,) and velocity (3,)") from None
            return _point(position, "target position"), _point(velocity, "target velocity")

        return moving
    fixed = _point(target, "target")
    return lambda _: (fixed, AT_REST)


def _point(value: ArrayLike, name: str) -> Floats:
    point = as_floats(name, value)
    if point.shape != (3,) or not np.all(np.isfinite(point)):
        raise InputError(f"{name} is {point.tolist()}; it needs 3 finite numbers, inertial axes")
    return point


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
