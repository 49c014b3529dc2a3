from __future__ import annotations

import csv
import json
from dataclasses import replace

import numpy as np
import pytest

import ssm_decouple as ssm
from ssm_decouple.studies.comparison import write_csv
from ssm_decouple.studies.sampling import PLANS, sampling
from ssm_decouple.viewing import figures
from ssm_decouple.viewing.table import drift_table, markdown, plain


@pytest.fixture(scope="module")
def rows():
    return list(sampling(replace(ssm.load_case("case1"), duration=30.0), (0.1, 0.5)))


def test_planning_for_the_hold_takes_the_drift_away(rows):
    drift = {(row.hold_nodes, row.sample_time_s): row.drift_deg for row in rows}
    assert drift.keys() == {(nodes, dt) for nodes in PLANS for dt in (0.1, 0.5)}
    assert drift[0, 0.1] > 1e-4
    assert drift[0, 0.1] / drift[1, 0.1] > 300
    assert drift[0, 0.5] / drift[1, 0.5] > 100
    assert drift[2, 0.1] < 1e-11
    assert drift[3, 0.1] < 1e-15


def test_orders(rows):
    orders = {row.hold_nodes: row.order for row in rows if row.sample_time_s == 0.1}
    assert orders[0] == pytest.approx(1, abs=0.2)
    assert orders[1] == pytest.approx(2, abs=0.2)
    assert orders[2] == pytest.approx(4, abs=0.3)
    assert all(row.order is None for row in rows if row.sample_time_s == 0.5)


def test_table_figure_and_csv(rows, tmp_path):
    lines = drift_table(rows)
    assert lines[0] == ["case", "law planned", "0.1 s", "0.5 s", "order"]
    assert len(lines) == 1 + len(PLANS)
    assert markdown(lines).count("\n") == len(PLANS) + 1
    assert plain(lines).row_count == len(PLANS)
    (axes,) = figures.sampling(rows).axes
    for line, nodes in zip(axes.lines, PLANS, strict=True):
        mine = sorted((row.sample_time_s, row.drift_deg) for row in rows if row.hold_nodes == nodes)
        np.testing.assert_array_equal(line.get_xydata(), mine)
    with write_csv(rows, tmp_path / "sampling.csv").open(newline="") as file:
        assert [float(row["drift_deg"]) for row in csv.DictReader(file)] == [row.drift_deg for row in rows]


def test_the_command(call, write, tmp_path):
    text = ssm.cases()["case3"].read_text().replace("duration = 150", "duration = 5")
    done = call("study", "sampling", write(text, "short.toml"), "-o", tmp_path, "--json")
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert len(found["rows"]) == 20
    assert {path.name for path in tmp_path.iterdir()} >= {"sampling.csv", "sampling.pdf", "sampling.png"}


def test_a_case_file_can_plan_for_the_hold_and_start_gently(write):
    text = ssm.cases()["case1"].read_text().replace("[law]", "[law]\nhold_nodes = 2\nacceleration_limit_deg = 1")
    text = text.replace("[simulation]", '[simulation]\nmethod = "held"')
    motion = ssm.load_case(write(text, "mine.toml")).run()
    law = json.loads(motion.attrs["law"])
    assert (law["hold_nodes"], law["sample_time"]) == (2, 0.1)
    np.testing.assert_allclose(law["acceleration_limits"], np.full(6, np.deg2rad(1)))
    assert motion.attrs["outcome"] == "converged"
    assert np.rad2deg(np.abs(motion.protected_angle.values).max()) < 1e-11
