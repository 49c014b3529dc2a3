"""How long a new process takes: importing the package, and the first command of the law once compiled code is on disk.

Each figure is a whole Python process, the median of several; the bare interpreter with NumPy is the yardstick.

    python benchmarks/start_up.py
"""

from __future__ import annotations

import statistics
import subprocess
import sys
import time

ROUNDS = 7
PROCESSES = {
    "python with numpy": "import numpy",
    "import ssm_decouple": "import ssm_decouple",
    "import every public name": "import ssm_decouple as ssm; [getattr(ssm, name) for name in ssm.__all__]",
    "first command": (
        "import numpy as np, ssm_decouple as ssm; robot = ssm.load_robot('ets_vii');"
        "ssm.SelectiveLaw(robot, ssm.Protection('yaw'))(robot.configuration(), [1.0, 0.0, 2.0])"
    ),
    "first case": "import ssm_decouple as ssm; ssm.load_case('case1').run()",
}


def main() -> None:
    """Run every process in turn and print the medians."""
    times: dict[str, list[float]] = {name: [] for name in PROCESSES}
    for round_ in range(ROUNDS + 1):
        for name, code in PROCESSES.items():
            start = time.perf_counter()
            subprocess.run([sys.executable, "-c", code], check=True)
            if round_ > 0:  # the first round compiles and fills the disk cache
                times[name].append(time.perf_counter() - start)
    print(f"{'whole process, median of ' + str(ROUNDS):<32} {'s':>7}")
    for name, values in times.items():
        print(f"{name:<32} {statistics.median(values):7.2f}")


if __name__ == "__main__":
    main()
