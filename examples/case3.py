"""Case 3: protect an antenna's line of sight, and compare with no protection and with reactionless control.

The boresight is y: pitch turns the dish about its own axis, roll and yaw would move the beam.
"""

from __future__ import annotations

import sys
from pathlib import Path

import ssm_decouple as ssm
from ssm_decouple.viewing.figures import comparison, save_figures
from ssm_decouple.viewing.style import save
from ssm_decouple.viewing.table import cells, explain

case = ssm.load_case("case3")
compared = ssm.compare(case)
for row in compared.summaries():
    print(*cells(row), sep=" | ")
    if reason := explain(row):
        print("   ", reason)

folder = Path(sys.argv[1] if len(sys.argv) > 1 else "results/example_case3")
written = save_figures(compared.motions["selective"], folder, "selective")
written += save(comparison(compared.motions), folder, "comparison")
for law, motion in compared.motions.items():
    written.append(ssm.save_motion(motion, folder / f"{law.replace(', ', '_')}.nc"))
print(f"{len(written)} files in {folder}")
