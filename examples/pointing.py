"""An antenna's line of sight, in arcseconds, while joints driven by torques move the arm.

The protection keeps the line of sight, whatever it is: here the antenna's along y, and a star tracker's at an angle.
"""

from __future__ import annotations

import ssm_decouple as ssm
from ssm_decouple.studies.pointing import pointing

case = ssm.load_case("case3")
for boresight in ([0.0, 1.0, 0.0], [0.3, -0.8, 0.5]):
    print(f"line of sight along {boresight}")
    for row, _ in pointing(case, boresight, ssm.Dynamic(step=0.005)):
        print(
            f"    {row.law:<22} at most {row.peak_arcsec:9.4f} arcsec, {row.outcome}, "
            f"{1e3 * row.final_error_m:6.1f} mm left, energy {row.energy_error:.0e}, momentum {row.momentum_drift:.0e}"
        )
