"""Motion on the manifold of configurations, where the base has an attitude and not three angles."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Axes = Callable[[Floats], Floats | None]  # configuration to the rotation from base axes to others; None: none

_SQRT_15 = 15.0**0.5


@cache
def gauss_points(count: int) -> tuple[Floats, Floats]:
    """Return nodes and weights (count,) of Gauss quadrature on [0, 1]."""
    nodes, weights = np.polynomial.legendre.leggauss(count)
    return 0.5 + 0.5 * nodes, 0.5 * weights


@cache
def _on_the_way(count: int) -> Floats:
    """Return (count, 3, count): of values at Gauss nodes, those at three Gauss points of the way to each node.

    They are taken from the polynomial through all values.
    """
    nodes, _ = gauss_points(count)
    places = np.outer(nodes, gauss_points(3)[0])
    shares = np.ones((count, 3, count))
    for j in range(count):
        for k in range(count):
            if k != j:
                shares[..., j] *= (places - nodes[k]) / (nodes[j] - nodes[k])
    return shares


def magnus(twists: Floats, h: float) -> Floats:
    """Return by which twist (6,), held for a second, a body moves whose twist changes, by a sixth-order expansion.

    The coefficients are those of Blanes, Casas and Ros; the brackets change sign because the twist stands on the right.

    Args:
        twists: At three Gauss points (3, 6), body axes.
        h: Length of the motion, s.
    """
    a, b, c = (pin.Motion(twist) for twist in twists)
    one, two = b * h, (c - a) * (_SQRT_15 / 3 * h)
    three = (c - b * 2.0 + a) * (10 / 3 * h)
    fourth = two.cross(one)
    fifth = one.cross(three * 2.0 + fourth) * (1 / 60)
    whole: Floats = (one + three * (1 / 12) + (two + fifth).cross(fourth - one * 20.0 - three) * (1 / 240)).vector
    return whole


def ways_to_nodes(twists: Floats, h: float) -> Floats:
    """Return how a body has moved at each Gauss node (m, 6), from its twists at all of them: collocation.

    A way is the twist that leads there if it is held for a second. Quadrature over the nodes, of what depends on where
    the body is, so keeps the order 2 m of its weights, up to the sixth.

    Args:
        twists: At the nodes (m, 6), body axes.
        h: Length of the motion, s.
    """
    nodes, _ = gauss_points(len(twists))
    on_the_way = _on_the_way(len(twists)) @ twists
    return np.array([magnus(points, node * h) for points, node in zip(on_the_way, nodes.tolist(), strict=True)])


def places_on_hold(model: pin.Model, q: Floats, rates: Floats, h: float, twists: Floats) -> Floats:
    """Return the configurations (m, nq) at the Gauss nodes of a hold of joint rates.

    Args:
        model: Pinocchio's.
        q: Configuration at the start (nq,).
        rates: Joint rates (n,), held.
        h: Length of the hold, s.
        twists: Base twists at the nodes (m, 6), base axes.
    """
    nodes, _ = gauss_points(len(twists))
    ways = zip(ways_to_nodes(twists, h), nodes.tolist(), strict=True)
    return np.array([pin.integrate(model, q, np.r_[way, node * h * rates]) for way, node in ways])


def turned(R: Floats, twist: Floats) -> Floats:
    """Return a twist (6,), or a sum of twists, in other axes: both of its parts turned by R (3, 3)."""
    return np.r_[R @ twist[:3], R @ twist[3:]]


def quadrature_along(axes: Axes, configurations: Floats, twists: Floats, h: float) -> Floats:
    """Return the integral of the base twist (6,) in axes that turn against the base, m and rad.

    Args:
        axes: Rotation from base axes to those at a configuration.
        configurations: At Gauss nodes (m, nq).
        twists: Base twists there, base axes (m, 6).
        h: Length of the motion, s.
    """
    whole = np.zeros(6)
    _, weights = gauss_points(len(twists))
    for q, twist, weight in zip(configurations, twists, weights.tolist(), strict=True):
        R = axes(q)
        whole += h * weight * (twist if R is None else turned(R, twist))
    return whole


def munthe_kaas(
    model: pin.Model,
    q: Floats,
    start: Floats,
    h: float,
    velocity: Callable[[Floats, float], Floats],
    axes: Axes | None = None,
) -> tuple[Floats, Floats]:
    """Take a step of the classical fourth order in the coordinates u = difference(q, .) about the step's start.

    There u_dot = d(difference)/dq v, which carries the curvature of SE(3) exactly.

    Args:
        model: Pinocchio's.
        q: Configuration at the start (nq,).
        start: Velocity there (nv,).
        h: Length of the step, s.
        velocity: Of a configuration and the time since the start, s.
        axes: Rotation from base axes to others at a configuration; None for base axes.

    Returns:
        The configuration at the end (nq,), and the integral of the base twist in base axes and in the others (2, 6).
    """

    def slope(u: Floats, ahead: float) -> tuple[Floats, Floats]:
        stage = pin.integrate(model, q, u)
        v = velocity(stage, ahead)
        return pin.dDifference(model, q, stage, pin.ARG1) @ v, seen(stage, v[:6])

    def seen(stage: Floats, twist: Floats) -> Floats:
        R = None if axes is None else axes(stage)
        return np.array([twist, twist if R is None else turned(R, twist)])

    u1, t1 = start, seen(q, start[:6])
    u2, t2 = slope(0.5 * h * u1, 0.5 * h)
    u3, t3 = slope(0.5 * h * u2, 0.5 * h)
    u4, t4 = slope(h * u3, h)
    moved = (h / 6.0) * (t1 + 2.0 * t2 + 2.0 * t3 + t4)
    return pin.integrate(model, q, (h / 6.0) * (u1 + 2.0 * u2 + 2.0 * u3 + u4)), moved
