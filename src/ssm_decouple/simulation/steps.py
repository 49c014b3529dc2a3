"""From one sample to the next: how joints and base move under a command.

Each step returns the next configuration and the integral of the base twist over the step (2, 6): in base axes, and in
the axes in which the law's directions are fixed, as these turn along the motion that the step makes.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from ssm_decouple.control.law import GAUSS, SelectiveLaw
from ssm_decouple.errors import InputError, as_positive, refuse_more_than_fits
from ssm_decouple.momentum.flow import (
    gauss_points,
    magnus,
    munthe_kaas,
    places_on_hold,
    quadrature_along,
    ways_to_nodes,
)

Floats = NDArray[np.float64]
Reference = Callable[[float], tuple[Floats, Floats]]  # time to target position and velocity
Pace = Callable[[float], float]  # time to the share of the full pace
Wanted = Callable[[float], Floats | None]  # time to the protected rate that is asked for, None for zero


MOST_STEPS = 1e8  # even without a record
TIMES_BYTES = 32  # that the sample times take, each


class Demand(NamedTuple):
    """What is asked of the law, as functions of time, s."""

    reference: Reference
    pace: Pace
    protected_rate: Wanted


Step = Callable[[SelectiveLaw, Demand, Floats, Floats, float, float], tuple[Floats, Floats]]
Hold = Callable[[SelectiveLaw, Floats, Floats, float], tuple[Floats, Floats]]

# Of joints and base in one piece of a hold, rad (or m): there the sixth-order expansion is good to 1e-10 of an arm's
# length, and the fourth-order method that momentum on board takes is as good.
LONGEST, LONGEST_WITH_MOMENTUM = 0.25, 0.05
MOST_PIECES = 10_000  # of a hold: some seconds
JUDGING = 5  # Gauss points for integrals over a step, more than any law plans with, so that they judge it


def integrals(law: SelectiveLaw, places: Floats | None, twists: Floats, h: float) -> Floats:
    """Return the integral of the base twist over a step (2, 6), in base axes and in the law's.

    Args:
        law: Its directions name the axes.
        places: Configurations at Gauss nodes (m, nq); not needed where the law's axes are base axes.
        twists: Base twists there (m, 6), base axes.
        h: Length of the step, s.
    """
    moved = h * np.sum(gauss_points(len(twists))[1][:, None] * twists, axis=0)
    if places is None or law.directions[1] == "base":
        return np.array([moved, moved])
    return np.array([moved, quadrature_along(law.rotation_to_axes, places, twists, h)])


def hold_twist(law: SelectiveLaw, q: Floats, v: Floats, h: float) -> tuple[Floats, Floats]:
    """Hold joint rates and base twist, together v (6 + n,): one Euler step on SE(3), how we read the paper."""
    model, moved = law.robot.model, h * v[:6]
    if law.directions[1] == "base":
        return pin.integrate(model, q, h * v), np.array([moved, moved])
    places = np.array([pin.integrate(model, q, node * h * v) for node in gauss_points(JUDGING)[0].tolist()])
    along = quadrature_along(law.rotation_to_axes, places, np.tile(v[:6], (JUDGING, 1)), h)
    return pin.integrate(model, q, h * v), np.array([moved, along])


def hold_rates(law: SelectiveLaw, q: Floats, v: Floats, h: float) -> tuple[Floats, Floats]:
    """Hold the joint rates of v (6 + n,); the base follows piece by piece, which are short for what they turn.

    Raises:
        InputError: joints or base turn so far in the hold that it would take more than MOST_PIECES.
    """
    longest = LONGEST_WITH_MOMENTUM if law.momentum.any() else LONGEST
    robot = law.robot
    wheels = [6 + robot.joint_index(name) for name in robot.wheel_names]  # round about their axes: turning is nothing
    needed = h * float(np.abs(np.delete(v, wheels)[3:] if wheels else v[3:]).max()) / longest
    if needed > MOST_PIECES:
        raise InputError(
            f"joints or base turn by {needed * longest:.3g} rad in the {h:g} s for which a command is held; take a "
            "shorter dt"
        )
    if needed <= 1.0:
        return hold_piece(law, q, v, h)
    pieces, moved = int(np.ceil(needed)), np.zeros((2, 6))
    for _ in range(pieces):
        q, more = hold_piece(law, q, np.r_[law.base_twist(q, v[6:]), v[6:]], h / pieces)
        moved += more
    return q, moved


def hold_piece(law: SelectiveLaw, q: Floats, v: Floats, h: float) -> tuple[Floats, Floats]:
    """Hold joint rates for a short time: the base follows by a sixth-order Magnus expansion on three Gauss points.

    In base axes its twist depends on the joints alone, so the base pose at those points is not needed. The integrals of
    the twist are taken on JUDGING points; in other axes the base is led to each of them by collocation.

    With momentum on board the twist does depend on the attitude, and the fourth-order method leads to the end and to
    the JUDGING points.
    """
    model, rates = law.robot.model, v[6:]
    turning, nodes = np.r_[np.zeros(6), rates], gauss_points(JUDGING)[0].tolist()
    if law.momentum.any():

        def lead(time: float) -> Floats:
            return munthe_kaas(model, q, v, time, lambda x, _: np.r_[law.base_twist(x, rates), rates])[0]

        on_the_way = np.array([lead(node * h) for node in nodes])
        twists = np.array([law.base_twist(place, rates) for place in on_the_way])
        return lead(h), integrals(law, on_the_way, twists, h)

    def twist(node: float) -> Floats:
        return law.base_twist(pin.integrate(model, q, node * h * turning), rates)

    base = magnus(np.array([twist(node) for node, _ in GAUSS[3]]), h)
    twists = np.array([twist(node) for node in nodes])
    # In base axes it does not matter where the base is.
    places = None if law.directions[1] == "base" else places_on_hold(model, q, rates, h, twists)
    return pin.integrate(model, q, np.r_[base, h * rates]), integrals(law, places, twists, h)


HOLDS: dict[str, Hold] = {"explicit": hold_twist, "held": hold_rates}


def explicit(
    law: SelectiveLaw, demand: Demand, q: Floats, values: Floats, t: float, t_next: float
) -> tuple[Floats, Floats]:
    """Hold the command as it is."""
    return hold_twist(law, q, values[: law.robot.model.nv], t_next - t)


def held(
    law: SelectiveLaw, demand: Demand, q: Floats, values: Floats, t: float, t_next: float
) -> tuple[Floats, Floats]:
    """Hold the joint rates of the command."""
    return hold_rates(law, q, values[: law.robot.model.nv], t_next - t)


def runge_kutta(
    law: SelectiveLaw, demand: Demand, q: Floats, values: Floats, t: float, t_next: float
) -> tuple[Floats, Floats]:
    """Call the law within the step too, by the classical fourth-order method."""
    model, buffer, at_rest = law.robot.model, np.empty(law.size), np.zeros(law.robot.n_joints)

    def velocity(stage: Floats, ahead: float) -> Floats:
        now = t + ahead
        wanted = demand.protected_rate(now)
        law.evaluate(stage, *demand.reference(now), buffer, at_rest, wanted, demand.pace(now), now)
        return buffer[: model.nv].copy()

    return munthe_kaas(model, q, values[: model.nv], t_next - t, velocity, law.rotation_to_axes)


def after_jump(velocities: Floats, rates: Floats, moved: Floats, h: float) -> Floats:
    """Return velocities at start and end of a step (2, nv), that at its start after joint rates have jumped there.

    The base twist that follows from the jump is the one whose straight line to the end has the integral.

    Args:
        velocities: As recorded (2, nv): that at the start before the jump.
        rates: Joint rates (n,) after it.
        moved: Integral of the base twist (6,), base axes.
        h: Length of the step, s.
    """
    return np.array([np.r_[2.0 * moved / h - velocities[1, :6], rates], velocities[1]])


def between(law: SelectiveLaw, ends: Floats, velocities: Floats, moved: Floats, h: float) -> Floats:
    """Return the integral of the base twist (6,) in the law's axes over a step of which only the ends are known.

    The twist is the parabola that has its ends and its integral, and the joints take the cubic way that has theirs: of
    fourth order in the step.

    Args:
        law: Its directions name the axes.
        ends: Configurations at start and end (2, nq).
        velocities: Pinocchio velocities there (2, nv).
        moved: Integral of the base twist (6,), base axes.
        h: Length of the step, s.
    """
    if law.directions[1] == "base":
        return moved
    nodes, _ = gauss_points(JUDGING)
    x = nodes[:, None]
    first, last = velocities
    bulge = 6.0 * (moved / h - 0.5 * (first[:6] + last[:6]))
    twists = first[:6] + x * (last[:6] - first[:6]) + x * (1.0 - x) * bulge
    joints = pin.difference(law.robot.model, *ends)[6:]
    turns = x**2 * (3.0 - 2.0 * x) * joints + h * x * (1.0 - x) * ((1.0 - x) * first[6:] - x * last[6:])
    ways = zip(ways_to_nodes(twists, h), turns, strict=True)
    places = np.array([pin.integrate(law.robot.model, ends[0], np.r_[way, turn]) for way, turn in ways])
    return quadrature_along(law.rotation_to_axes, places, twists, h)


STEPS: dict[str, Step] = {"explicit": explicit, "held": held, "rk4": runge_kutta}


def sample_times(duration: float, dt: float, sample_bytes: int = 0) -> Floats:
    """Return the times of the samples, s; the last step is shorter where `duration` is no multiple of dt.

    Args:
        duration: s.
        dt: Time between samples, s.
        sample_bytes: Memory that a sample takes in the record.

    Raises:
        InputError: times that are not positive, or more steps than a record could hold.
    """
    needs = "it must be a positive time, s"
    dt, duration = as_positive("dt", dt, needs), as_positive("duration", duration, needs)
    if dt > duration:
        raise InputError(f"dt is {dt:g} s, longer than the duration of {duration:g} s")
    if duration / dt > MOST_STEPS:
        raise InputError(f"{duration:g} s in steps of {dt:g} s are more than {MOST_STEPS:g} steps; take a longer dt")
    size = duration / dt * (TIMES_BYTES + sample_bytes)
    refuse_more_than_fits(
        f"the record of {duration:g} s in steps of {dt:g} s", size, "take a longer dt, or shorter pieces"
    )
    steps = int(np.ceil(duration / dt * (1 - 1e-12)))
    time = dt * np.arange(steps + 1, dtype=np.float64)
    time[-1] = duration
    return time
