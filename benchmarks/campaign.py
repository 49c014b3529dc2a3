"""What a campaign costs: a motion on each path, a chunk's way through processes, Dask and the store, bytes a sample.

Times of single motions are processor time, so that they hold whatever else the machine does; the rest is by the clock.

    python benchmarks/campaign.py [motions of the whole run, 2000 by default]
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")  # threads for 6 x 6 matrices would only hurt
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

import ssm_decouple as ssm
from ssm_decouple.studies.campaign import Campaign, Rows
from ssm_decouple.studies.store import Store
from ssm_decouple.studies.workers import Cluster, Pool, Processes

CHUNKS = (1, 10, 100, 1000)  # samples
MOST_CHUNKS, MOST_SAMPLES = 300, 6000  # of a turn
WORKERS = os.cpu_count() or 1

SPEC = """
seed = 1
samples = {samples}
chunk = {chunk}
cases = ["case.toml"]
[start]
joints_deg = {{ uniform = 5 }}
[target]
position = {{ ball = 0.2 }}
"""
CASE = ssm.cases()["case1"].read_text()
GAIN = "[law]\ngain = { uniform = [0.03, 0.08] }\n"
PLANT = "[plant]\nmass = 0.05\ninertia = 0.05\ncentre_of_mass = 0.005\nmount = 0.005\n"


@dataclass
class Line:
    """How many chunks a second one of the ways took, by the clock."""

    chunks: float
    samples: float

    def __str__(self) -> str:
        return f"{self.chunks:9.1f} {self.samples:10.0f}"


def campaign(samples: int, chunk: int = 500, case: str = CASE, more: str = "") -> Campaign:
    """Return a campaign of so many samples."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "campaign.toml"
        path.with_name("case.toml").write_text(case)
        path.write_text(SPEC.format(samples=samples, chunk=chunk) + more)
        return Campaign.load(path)


def motions() -> None:
    """Print what a motion costs on each path."""
    dynamic = CASE.replace("dt = 0.1", 'dt = 0.1\nmethod = "dynamic"')
    print(f"{'150 s, 1500 steps':<58} {'ms of a processor':>18}")
    for name, count, case, more in (
        ("batch engine, 1 at a time", 1, CASE, ""),
        ("batch engine, 10 together", 10, CASE, ""),
        ("batch engine, 100 together", 100, CASE, ""),
        ("batch engine, 500 together", 500, CASE, ""),
        ("batch engine, each its own gain", 10, CASE, GAIN),
        ("Case.run, explicit, with a smooth start", 10, CASE.replace("dt = 0.1", "dt = 0.1\nsmooth_start = 8"), ""),
        ("Case.run, commands held", 5, CASE.replace("dt = 0.1", 'dt = 0.1\nmethod = "held"'), ""),
        ("Case.run, torques, 20 ms, plant 5 % off", 3, dynamic + "[dynamic]\nstep = 0.02\n", PLANT),
        ("Case.run, torques, 1 ms, plant 5 % off", 2, dynamic, PLANT),
    ):
        found = campaign(1000, case=case, more=more)
        found.rows([count])  # compiles
        start = time.process_time()
        found.rows(range(count))
        print(f"{name:<58} {1e3 * (time.process_time() - start) / count:18.2f}")
    print()


def through(make: Callable[[Campaign], Pool], chunk: int, case: str) -> Line:
    """Return how quickly a pool takes chunks of motions of one step, once it has begun."""
    samples = min(MOST_CHUNKS * chunk, MOST_SAMPLES)
    found = campaign(samples, chunk, case)
    with closing(make(found).results(range(found.chunks))) as results:
        for _ in range(min(2 * WORKERS, found.chunks // 2)):  # until the workers have imported and compiled
            next(results)
        start, taken, rows = time.perf_counter(), 0, 0
        for _, part in results:
            taken, rows = taken + 1, rows + len(part["draw"])
    seconds = time.perf_counter() - start
    return Line(taken / seconds, rows / seconds)


def into_store(chunk: int, few: Rows) -> tuple[Line, float, float]:
    """Return how quickly a store takes chunks, made of a few rows, and how many bytes and files a sample costs."""
    found = campaign(20 * chunk, chunk)
    rows = {name: np.resize(values, (chunk, *values.shape[1:])) for name, values in few.items()}
    with tempfile.TemporaryDirectory() as folder:
        with Store.writing(folder, found) as kept:
            empty = sum(path.stat().st_size for path in Path(folder).rglob("*") if path.is_file())
            start = time.perf_counter()
            for i in range(found.chunks):
                kept.write(i, rows)
            seconds = time.perf_counter() - start
        files = [path for path in Path(folder).rglob("*") if path.is_file()]
        size = sum(path.stat().st_size for path in files) - empty
    return Line(found.chunks / seconds, found.size / seconds), size / found.size, len(files) / found.size


def overheads() -> None:
    """Print what a chunk costs beside its motions."""
    case = CASE.replace("duration = 150", "duration = 0.1")
    ways: dict[str, Callable[[Campaign], Pool]] = {f"{WORKERS} processes": lambda it: Processes(it, WORKERS, print)}
    distributed: Any = import_module("distributed")
    few = campaign(1000).rows(range(1000))
    with distributed.LocalCluster(n_workers=WORKERS, threads_per_worker=1, dashboard_address=":0") as cluster:
        ways[f"Dask, {WORKERS} workers"] = lambda it: Cluster(it, cluster.scheduler_address)
        head = "".join(f"  {name:>20}" for name in (*ways, "store"))
        print(
            f"motions of one step   {head}\n{'samples a chunk':<22}"
            + 3 * "  chunks/s  samples/s"
            + "   bytes, files a sample"
        )
        for chunk in CHUNKS:
            lines = [through(make, chunk, case) for make in ways.values()]
            stored, size, files = into_store(chunk, few)
            print(f"{chunk:<22}" + "".join(f" {line}" for line in (*lines, stored)) + f"   {size:.0f}, {files:.2f}")
    print()


def whole(samples: int) -> None:
    """Print how long a whole campaign takes, start of the processes and store included."""
    found = campaign(samples)
    with tempfile.TemporaryDirectory() as folder:
        start = time.perf_counter()
        found.run(folder, workers=WORKERS)
        seconds = time.perf_counter() - start
    print(f"{samples} motions of 150 s on {WORKERS} processes: {seconds:.1f} s, {samples / seconds:.0f} a second")


def main(samples: int) -> None:
    """Print all tables."""
    print(f"load of the machine before: {os.getloadavg()[0]:.1f} on {WORKERS} processors\n")
    motions()
    overheads()
    whole(samples)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 2000)
