"""From one sample to the next: how joints and base move under a command.

Each step returns the next configuration and the integral of the base twist (6,) over the step, base axes.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from ssm_decouple.control.law import GAUSS, SelectiveLaw
from ssm_decouple.errors import InputError, as_positive, refuse_more_than_fits
from ssm_decouple.momentum.flow import munthe_kaas

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

_SQRT_15 = 15.0**0.5
_JUDGE = [(0.5 + 0.5 * node, 0.5 * weight) for node, weight in zip(*np.polynomial.legendre.leggauss(5), strict=True)]


def explicit(
    law: SelectiveLaw, demand: Demand, q: Floats, values: Floats, t: float, t_next: float
) -> tuple[Floats, Floats]:
    """Hold joint rates and base twist: one Euler step on SE(3), how we read the paper."""
    model, h = law.robot.model, t_next - t
    return pin.integrate(model, q, h * values[: model.nv]), h * values[:6]


def held(
    law: SelectiveLaw, demand: Demand, q: Floats, values: Floats, t: float, t_next: float
) -> tuple[Floats, Floats]:
    """Hold the joint rates; the base follows by a sixth-order Magnus expansion on three Gauss points.

    In base axes its twist depends on the joints alone, so the base pose at those points is not needed. The
    coefficients are those of Blanes, Casas and Ros; the brackets change sign because the twist stands on the right.
    The integral of the twist is taken on five points, more than any law plans with, so that it judges them.

    With momentum on board the twist does depend on the attitude, and the fourth-order method takes its place.
    """
    model, h = law.robot.model, t_next - t
    rates = values[6 : model.nv]
    if law.momentum.any():
        return munthe_kaas(model, q, values[: model.nv], h, lambda x, _: np.r_[law.base_twist(x, rates), rates])
    turning = np.r_[np.zeros(6), rates]

    def twist(node: float) -> Floats:
        return law.base_twist(pin.integrate(model, q, node * h * turning), rates)

    first, middle, last = (pin.Motion(twist(node)) for node, _ in GAUSS[3])
    one, two = middle * h, (last - first) * (_SQRT_15 / 3 * h)
    three = (last - middle * 2.0 + first) * (10 / 3 * h)
    fourth = two.cross(one)
    fifth = one.cross(three * 2.0 + fourth) * (1 / 60)
    base = one + three * (1 / 12) + (two + fifth).cross(fourth - one * 20.0 - three) * (1 / 240)
    moved = h * np.sum([weight * twist(node) for node, weight in _JUDGE], axis=0)
    return pin.integrate(model, q, np.r_[base.vector, h * rates]), moved


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

    return munthe_kaas(model, q, values[: model.nv], t_next - t, velocity)


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
