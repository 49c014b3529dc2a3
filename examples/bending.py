"""Flexible solar arrays: what bends them, and what has to be protected so that they do not bend.

A wing's tip is driven by the base's rotation (the two wings bend against each other) and by its translation (they bend
together). Protecting the bending axis, as the paper does, removes the first and leaves the second. Protecting the rows
of the base twist that the bending modes take part in removes both.
"""

from __future__ import annotations

import sys
from pathlib import Path

import ssm_decouple as ssm
from ssm_decouple.studies.bending import bending, flexible
from ssm_decouple.viewing.figures import bending as draw
from ssm_decouple.viewing.style import save

case = flexible(ssm.load_case("case1"))
modes = case.robot.modes()
print("mode            frequency (Hz)   driven by base [vx vy vz wx wy wz]")
for name, frequency, rows in zip(modes.names, modes.frequencies, modes.participation.T, strict=True):
    print(f"{name:<15} {frequency:14.3f}   {' '.join(f'{x + 0.0:7.2f}' for x in rows)}")

motions = {}
for row, motion in bending(case):
    motions[row.protection] = motion
    print(
        f"protected: {row.protection:<15} tip {row.peak_mm:8.4f} mm (symmetric {row.symmetric_mm:.4f}, "
        f"antisymmetric {row.antisymmetric_mm:.4f}), {row.outcome}, {1e3 * row.final_error_m:.1f} mm left"
    )
folder = Path(sys.argv[1] if len(sys.argv) > 1 else "results/example_bending")
print(f"{len(save(draw((case, motions)), folder, 'bending'))} files in {folder}")
