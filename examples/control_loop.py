"""The law in a loop at 1 kHz: how long a step takes, how punctual the loop is, and that it allocates nothing lasting.

The loop drives a simulated spacecraft, asks the law in its array form and sleeps until the next tick; the last tenth
of a millisecond is spent waiting awake, as sleep wakes up late.

    python examples/control_loop.py [seconds]
"""

from __future__ import annotations

import gc
import sys
import time
import tracemalloc

import numpy as np
import pinocchio as pin

import ssm_decouple as ssm

PERIOD = 1e-3  # s
seconds = float(sys.argv[1]) if len(sys.argv) > 1 else 5.0

robot = ssm.load_robot("ets_vii")
q = robot.configuration(np.deg2rad([150, -20, -10, 0, 0, 0]))
law = ssm.SelectiveLaw(robot, ssm.Protection("yaw"), sample_time=PERIOD, acceleration_limit=np.deg2rad(20.0))
target, still = np.array([-1.8, -0.3, 1.2]), np.zeros(3)
out, previous = np.empty(law.size), np.zeros(robot.n_joints)
velocity, rates = out[: robot.model.nv], out[6 : robot.model.nv]  # views: nothing is copied in the loop
law.evaluate(q, target, still, out, previous)  # the first call may compile

ticks = int(seconds / PERIOD)
late, took = np.empty(ticks), np.empty(ticks)
worst = 0.0
gc.collect()
gc.disable()  # a collection may take a millisecond
tracemalloc.start()
law.evaluate(q, target, still, out, previous)
held_before = tracemalloc.get_traced_memory()[0]
for _ in range(1000):
    law.evaluate(q, target, still, out, previous)
held = (tracemalloc.get_traced_memory()[0] - held_before) / 1000
tracemalloc.stop()

start = time.perf_counter()
for i in range(ticks):
    due = start + i * PERIOD
    if (ahead := due - time.perf_counter()) > 2e-4:
        time.sleep(ahead - 1e-4)
    while (now := time.perf_counter()) < due:
        pass
    late[i] = now - due
    law.evaluate(q, target, still, out, previous)
    took[i] = time.perf_counter() - now
    worst = max(worst, abs(float(velocity[5])))
    previous[:] = rates
    q = pin.integrate(robot.model, q, PERIOD * velocity)
gc.enable()

percentiles = (50, 99, 99.9, 100)
print(f"{ticks} ticks of {1e3 * PERIOD:g} ms    median     99 %   99.9 %  largest (us)")
for name, times in (("law.evaluate took", took), ("tick was late by", late)):
    print(f"{name:<24}" + "".join(f"{1e6 * x:9.1f}" for x in np.percentile(times, percentiles)))
print(f"{100 * np.mean(late > PERIOD / 10):.2f} % of the ticks were late by more than a tenth of a period")
print(f"memory held after a step: {held:.0f} bytes more than before")
print(f"largest protected rate: {worst:.1e} rad/s")
