"""Motion on the manifold of configurations, where the base has an attitude and not three angles."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def munthe_kaas(
    model: pin.Model, q: Floats, start: Floats, h: float, velocity: Callable[[Floats, float], Floats]
) -> tuple[Floats, Floats]:
    """Take a step of the classical fourth order in the coordinates u = difference(q, .) about the step's start.

    There u_dot = d(difference)/dq v, which carries the curvature of SE(3) exactly.

    Args:
        model: Pinocchio's.
        q: Configuration at the start (nq,).
        start: Velocity there (nv,).
        h: Length of the step, s.
        velocity: Of a configuration and the time since the start, s.

    Returns:
        The configuration at the end (nq,), and the integral of the base twist (6,), base axes.
    """

    def slope(u: Floats, ahead: float) -> tuple[Floats, Floats]:
        stage = pin.integrate(model, q, u)
        v = velocity(stage, ahead)
        return pin.dDifference(model, q, stage, pin.ARG1) @ v, v[:6]

    u1, t1 = start, start[:6]
    u2, t2 = slope(0.5 * h * u1, 0.5 * h)
    u3, t3 = slope(0.5 * h * u2, 0.5 * h)
    u4, t4 = slope(h * u3, h)
    moved = (h / 6.0) * (t1 + 2.0 * t2 + 2.0 * t3 + t4)
    return pin.integrate(model, q, (h / 6.0) * (u1 + 2.0 * u2 + 2.0 * u3 + u4)), moved
