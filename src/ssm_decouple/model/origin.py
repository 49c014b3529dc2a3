"""Far from the inertial origin: matrices are computed where the base is at the origin, as none depends on its place.

Pinocchio's sums stand about the inertial origin, so that their rounding grows with the distance from it: in an orbit,
7e6 m or 4.2e7 m from the Earth's centre, they keep nine digits or less.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]

FAR = 10.0  # m, along any inertial axis, as in control/kernel.py


def far_origin(position: ArrayLike) -> Floats | None:
    """Return a base position (3,), m, as a new origin where it is far from the inertial one; None where it is near."""
    x, y, z = np.asarray(position, dtype=float).tolist()
    if -FAR <= x <= FAR and -FAR <= y <= FAR and -FAR <= z <= FAR:
        return None
    return np.array([x, y, z])


def from_base(q: Floats) -> Floats:
    """Return a configuration (nq,) with its base at the origin if it is far from there, else the same."""
    if far_origin(q[:3]) is None:
        return q
    near = q.copy()
    near[:3] = 0.0
    return near
