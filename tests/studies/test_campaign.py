from __future__ import annotations

import json
import multiprocessing
import operator
import os
import shutil
import signal
import subprocess
import sys
import textwrap
import time
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from scipy.stats import kstest

import ssm_decouple as ssm
from ssm_decouple.studies import store as stores
from ssm_decouple.studies import workers
from ssm_decouple.studies.campaign import Campaign, results_of
from ssm_decouple.studies.store import COLUMNS, Store

SMALL = """
title = "Small"
seed = 3
samples = 8
chunk = 5
cases = ["short.toml"]
protections = ["none", "case", "all"]
"""
DRAWN = """
[start]
joints_deg = { uniform = 5 }
base_rpy_deg = { normal = [1, 2, 3] }

[target]
position = { ball = 0.2 }

[law]
gain = { log_uniform = [0.02, 0.2] }
damping = { choice = [0, 1e-4] }
"""
SHORT = ssm.cases()["case1"].read_text().replace("duration = 150", "duration = 2")
PLANTS = """
[plant]
mass = 0.05
inertia = 0.05
centre_of_mass = 0.005
mount = 0.005
"""


@pytest.fixture
def load(write):
    def loader(text: str = SMALL + DRAWN, case: str = SHORT, **files: str) -> Campaign:
        write(case, "short.toml")
        for name, content in files.items():
            write(content, f"{name}.toml")
        return Campaign.load(write(text, "campaign.toml"))

    return loader


@pytest.fixture
def dynamic_case() -> str:
    return SHORT.replace("dt = 0.1", 'dt = 0.1\nmethod = "dynamic"') + "[dynamic]\nstep = 0.02\n"


def tree(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def same(one, other) -> bool:
    return all(np.array_equal(one[name], other[name], equal_nan=COLUMNS[name].kind == "float64") for name in COLUMNS)


# What is drawn


def test_draws_have_the_distributions_that_were_asked_for(load):
    campaign = load(SMALL.replace("samples = 8", "samples = 600") + DRAWN)
    case = campaign.cases[0]
    draws = [campaign.drawn(case, i) for i in range(600)]
    joints = np.rad2deg([draw.joints for draw in draws]) - [150, -20, -10, 0, 0, 0]
    assert np.abs(joints).max() <= 5 + 1e-9
    tilts = np.rad2deg([draw.base_rpy for draw in draws]) / [1, 2, 3]
    away = np.linalg.norm(np.array([draw.target for draw in draws]) - [-1.8, -0.3, 1.2], axis=1) / 0.2
    gains = np.array([draw.gain for draw in draws])
    # Each is the same as one on (0, 1), or a normal one of unit width.
    for numbers in (*(joints.T / 10 + 0.5), away**3, np.log(gains / 0.02) / np.log(10)):
        assert kstest(numbers, "uniform").pvalue > 1e-3
    for numbers in tilts.T:
        assert kstest(numbers, "norm").pvalue > 1e-3
    zeros = sum(draw.damping == 0.0 for draw in draws)
    assert {draw.damping for draw in draws} == {0.0, 1e-4}
    assert 240 < zeros < 360
    assert np.abs(np.corrcoef(np.c_[joints, tilts, away, gains].T) - np.eye(11)).max() < 0.2


def test_a_draw_depends_on_seed_and_number_alone(load):
    first = load()
    row = 8 + 5  # draw 5 under the second protection
    more = load(
        SMALL.replace("chunk = 5", "chunk = 2")
        .replace('["short.toml"]', '["case3", "short.toml"]')
        .replace("samples = 8", "samples = 9")
        + DRAWN
        + "[dynamic]\n# nothing\n"
    )
    less = load(SMALL + DRAWN.replace("position = { ball = 0.2 }", "").replace("damping", "# damping"))
    for other, case in ((more, more.cases[1]), (less, less.cases[0])):
        mine, theirs = first.drawn(first.place(row)[0], 5), other.drawn(case, 5)
        assert np.array_equal(mine.joints, theirs.joints)
        assert np.array_equal(mine.base_rpy, theirs.base_rpy)
        assert mine.gain == theirs.gain
    seeded = load(SMALL.replace("seed = 3", "seed = 4") + DRAWN)
    assert not np.array_equal(seeded.drawn(seeded.cases[0], 5).joints, first.drawn(first.cases[0], 5).joints)


def test_protections_share_their_draws(load):
    campaign = load()
    rows = campaign.rows(range(campaign.size))
    for name in ("draw", "start_joints", "start_rpy", "target", "gain", "damping"):
        parts = rows[name].reshape(3, 8, -1)
        assert np.array_equal(parts[0], parts[1])
        assert np.array_equal(parts[0], parts[2])
        assert name == "damping" or len(np.unique(parts[0][:, 0])) == 8
    assert rows["k"].reshape(3, 8).tolist() == [[0] * 8, [1] * 8, [3] * 8]


def test_sliding_joints_are_not_turned(load, write):
    urdf = ssm.models()["ets_vii"].read_text().replace('"joint_6" type="revolute"', '"joint_6" type="prismatic"')
    assert "prismatic" in urdf
    write(urdf, "rail.urdf")
    campaign = load(case=SHORT.replace('robot = "ets_vii"', 'robot = "rail.urdf"'))
    moved = campaign.drawn(campaign.cases[0], 0).joints - campaign.cases[0].robot.joint_positions(
        campaign.cases[0].start()
    )
    assert moved[5] == 0.0
    assert np.all(moved[:5] != 0.0)


# What is computed


def test_the_engine_and_case_run_tell_the_same(load):
    campaign = load(SMALL + DRAWN, SHORT.replace("duration = 2 ", "duration = 20 "))
    rows = campaign.rows(range(8, 16))
    assert all(campaign._engine_of(campaign.cases[0], word) is not None for word in campaign.protections)
    for i in range(8):
        alone = results_of(campaign.motion(8 + i))
        assert rows["outcome"][i] == alone.pop("outcome")
        for name, value in alone.items():
            assert rows[name][i] == pytest.approx(value, rel=1e-9, abs=1e-13), name


@pytest.mark.parametrize("change", ["", "smooth_start = 1\n", 'method = "held"\n', "dynamic"])
def test_a_row_depends_on_its_number_alone(load, dynamic_case, change):
    case = dynamic_case if change == "dynamic" else SHORT + change
    campaign = load(SMALL + DRAWN + (PLANTS if change == "dynamic" else ""), case)
    together = campaign.rows([3, 2, 9, 20, 17])
    for at, number in enumerate([3, 2, 9, 20, 17]):
        alone = campaign.rows([number])
        for name in COLUMNS:
            assert np.array_equal(together[name][at], alone[name][0], equal_nan=name == "target"), name
        if change:
            told = results_of(campaign.motion(number))
            assert all(np.array_equal(together[name][at], value) for name, value in told.items())


def test_plants_are_off_and_the_law_is_not(load, dynamic_case):
    campaign = load(
        SMALL.replace('["none", "case", "all"]', '["case"]')
        + PLANTS
        + "[dynamic]\nfeedback_gain = { choice = [1.5] }\n",
        dynamic_case,
    )
    rows, case = campaign.rows([4, 5]), ssm.load_case("case1")
    assert rows["plant_seed"][0] != rows["plant_seed"][1]
    plant = ssm.perturbed(case.robot, ssm.Tolerances(0.05, 0.05, 0.005, 0.005), int(rows["plant_seed"][0]))
    physics = ssm.Dynamic(step=0.02, plant=plant, feedback_gain=1.5)
    motion = replace(case, duration=2.0, simulation={"method": physics}).run()
    assert rows["final_error"][0] == motion.attrs["final_error"]
    assert rows["protected_rate"][0] == np.abs(motion.protected_rate).max()
    assert rows["feedback_gain"][0] == 1.5


def test_a_case_with_tasks_is_run_as_it_is(load):
    task = SHORT.replace("[target]\nposition", '[[task]]\nkind = "boresight"\ndirection = [0, 0, 1]\ntoward').replace(
        "[protection]", "[protection]\nframe = 'inertial'"
    )
    campaign = load(SMALL + "[start]\njoints_deg = { normal = 2 }\n", task)
    rows = campaign.rows([1])
    assert rows["final_error"][0] == campaign.motion(1).attrs["final_error"]
    assert np.isnan(rows["target"]).all()


def test_a_sample_that_cannot_be_computed_is_a_row(load, dynamic_case, tmp_path):
    """A feedback that overshoots is refused, which only the samples that drew it feel."""
    text = SMALL + "[dynamic]\nfeedback_gain = { choice = [0, 20] }\n"
    campaign = load(text, dynamic_case)
    campaign.run(tmp_path / "s")
    found = Store.open(tmp_path / "s").dataset().load()
    lost = found.feedback_gain.values == 20
    assert 0 < lost.sum() < 24
    assert np.array_equal(found.outcome.values == "failed", lost)
    assert all("feedback_gain" in text for text in found.error.values[lost])
    assert (found.error.values[~lost] == "").all()
    for name in ("final_error", "base_rotation", "peak_rate", "outcome_time"):
        assert np.array_equal(np.isnan(found[name].values.reshape(24, -1)).all(axis=1), lost)
    tally = Store.open(tmp_path / "s").tallies()[1]
    assert tally.failed == lost[8:16].sum()
    assert tally.samples == 8


# The store


def test_the_store_is_what_the_rows_are(load, tmp_path):
    campaign = load()
    shown: list[tuple[int, int]] = []
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        campaign.run(tmp_path / "s", progress=lambda *at: shown.append(at))
        found = xr.open_zarr(tmp_path / "s").load()
    assert shown == [(0, 24), (5, 24), (10, 24), (15, 24), (20, 24), (24, 24)]
    assert same({name: found[name].values for name in COLUMNS}, campaign.rows(range(24)))
    assert found.sizes == {"sample": 24, "joint": 6, "angle": 3, "axis": 3, "chunk": 5}
    assert all(found[name].attrs["long_name"] for name in COLUMNS)
    assert found.final_error.attrs["units"] == "m"
    assert list(found.angle.values) == ["roll", "pitch", "yaw"]
    assert found.attrs["spec"] == campaign.text
    assert found.attrs["sha256"] == campaign.sha256
    assert json.loads(found.attrs["versions"])["ssm-decouple"] == ssm.__version__
    assert json.loads(found.attrs["campaign"]) == campaign.record


def test_figures_by_case_and_protection(load, tmp_path):
    campaign = load(SMALL.replace("samples = 8", "samples = 6") + DRAWN, SHORT.replace("= 2 ", "= 120 "))
    campaign.run(tmp_path / "s")
    free, own, rigid = Store.open(tmp_path / "s").tallies()
    rows = campaign.rows(range(6, 12))
    arrived = rows["outcome"] == "converged"
    assert (own.case, own.protection, own.k, own.samples) == ("short", "case", 1, 6)
    assert own.arrived == arrived.mean() > 0
    # Wilson's interval as he wrote it.
    z, n, p = 1.959963984540054, 6, own.arrived
    middle, half = p + z**2 / (2 * n), z * np.sqrt(p * (1 - p) / n + z**2 / (4 * n**2))
    assert own.arrived_low == pytest.approx((middle - half) / (1 + z**2 / n))
    assert own.arrived_high == pytest.approx((middle + half) / (1 + z**2 / n))
    assert own.median_time_s == np.median(rows["outcome_time"][arrived])
    assert own.yaw_deg == pytest.approx(np.rad2deg(np.median(rows["base_rotation"][:, 2])))
    assert own.protected_rate_max == rows["protected_rate"].max() < 1e-17
    assert free.arrived >= own.arrived > rigid.arrived
    assert rigid.stalled + rigid.running == 6


def test_an_unfinished_store_is_read_as_far_as_it_is(load, tmp_path):
    campaign = load()

    class Enough(Exception):  # noqa: N818
        pass

    def stop(done: int, size: int) -> None:
        if done == 10:
            raise Enough

    with pytest.raises(Enough):
        campaign.run(tmp_path / "s", progress=stop)
    kept = Store.open(tmp_path / "s")
    status = kept.status()
    assert (status.done, status.left, status.failed) == (10, 14, 0)
    assert [tally.samples for tally in kept.tallies()] == [8, 2]
    assert kept.row(9)["final_error"] == campaign.rows([9])["final_error"][0]
    with pytest.raises(ssm.FileError, match="sample 10 is not in"):
        kept.row(10)
    with pytest.raises(ssm.FileError, match="holds 10 of 24 samples of the campaign 'Small'; --resume goes on"):
        campaign.run(tmp_path / "s")
    campaign.run(tmp_path / "s", resume=True)
    campaign.run(tmp_path / "whole")
    assert tree(tmp_path / "s") == tree(tmp_path / "whole")


def killed(campaign: Campaign, folder: Path, files: int) -> None:
    """Run a campaign and kill it without warning when so many files are there."""
    process = multiprocessing.get_context("fork").Process(target=campaign.run, args=(folder,), kwargs={"resume": True})
    process.start()
    while process.is_alive() and sum(len(names) for *_, names in os.walk(folder)) < files:
        time.sleep(1e-4)
    process.kill()
    process.join()


def survives(campaign: Campaign, folder: Path, stores: int, kills: int) -> None:
    """Kill the run of each store so many times at random moments, then finish it and compare."""
    campaign.run(folder / "whole")
    whole, rng = tree(folder / "whole"), np.random.default_rng(5)
    for i in range(stores):
        for files in sorted(rng.integers(0, len(whole) - 5, kills)):
            killed(campaign, folder / f"cut{i}", files)
            assert tree(folder / f"cut{i}") != whole
        campaign.run(folder / f"cut{i}", resume=True)
        assert tree(folder / f"cut{i}") == whole


def test_what_is_killed_is_finished_bit_for_bit(load, tmp_path):
    survives(load(SMALL.replace("chunk = 5", "chunk = 3") + DRAWN), tmp_path, 1, 3)


@pytest.mark.slow
def test_twenty_kills(load, tmp_path):
    survives(load(SMALL.replace("chunk = 5", "chunk = 3") + DRAWN), tmp_path, 5, 4)


def test_what_a_killed_write_leaves_behind_is_swept_up(load, tmp_path):
    campaign = load()
    campaign.run(tmp_path / "whole")
    shutil.copytree(tmp_path / "whole", tmp_path / "s")
    (tmp_path / "s" / "gain" / "c" / "2.0123.partial").write_bytes(b"half")
    (tmp_path / "s" / "done" / "c" / "2").unlink()  # written, not marked
    (tmp_path / "s" / "draw" / "c" / "2").unlink()
    campaign.run(tmp_path / "s", resume=True)
    assert tree(tmp_path / "s") == tree(tmp_path / "whole")
    # Killed while the store was made: a description is there, not yet all of it.
    (tmp_path / "t").mkdir()
    (tmp_path / "t" / "zarr.0123.partial").write_bytes(b"half")
    campaign.run(tmp_path / "t")
    assert tree(tmp_path / "t") == tree(tmp_path / "whole")
    root = json.loads((tmp_path / "whole" / "zarr.json").read_text())
    del root["consolidated_metadata"]
    (tmp_path / "u" / "case").mkdir(parents=True)
    (tmp_path / "u" / "zarr.json").write_text(json.dumps(root))
    shutil.copy(tmp_path / "whole" / "case" / "zarr.json", tmp_path / "u" / "case")
    campaign.run(tmp_path / "u")
    assert tree(tmp_path / "u") == tree(tmp_path / "whole")


def test_another_campaign_or_version_is_refused(load, tmp_path, monkeypatch):
    load().run(tmp_path / "s")
    other = load(SMALL.replace("seed = 3", "seed = 4") + DRAWN, SHORT.replace("gain = 0.05", "gain = 0.06"))
    with pytest.raises(ssm.FileError, match=r"seed is 3 there, 4 here; short: law.gain is 0.05 there, 0.06 here\. "):
        other.run(tmp_path / "s", resume=True)
    with monkeypatch.context() as changed:
        now = stores.versions()
        changed.setattr(stores, "versions", lambda: now | {"numpy": "9.9"})
        with pytest.raises(ssm.FileError, match=r"other versions \(numpy .* there, 9.9 here\)"):
            load().run(tmp_path / "s", resume=True)
    # Another comment is no other campaign.
    load("# a remark\n" + SMALL + DRAWN).run(tmp_path / "s", resume=True)


def test_two_runs_at_once_are_refused(load, tmp_path):
    campaign = load()
    with Store.writing(tmp_path / "s", campaign), pytest.raises(ssm.FileError, match="being written by another run"):
        campaign.run(tmp_path / "s", resume=True)
    campaign.run(tmp_path / "s", resume=True)


def test_places_that_are_no_store_are_refused(load, tmp_path):
    campaign = load()
    (tmp_path / "file").write_text("")
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "thesis.tex").write_text("")
    xr.Dataset({"a": ("x", [1.0])}).to_zarr(tmp_path / "zarr", zarr_format=3, consolidated=False)
    for place, words in (
        ("file", "is a file"),
        ("file/s", "cannot write '.*file/s': Not a directory; make room or choose another"),
        ("folder", "holds something that is no campaign's store"),
        ("zarr", "is a Zarr store but no campaign's"),
    ):
        with pytest.raises(ssm.FileError, match=words):
            campaign.run(tmp_path / place, resume=True)
    for place in ("nothing", "folder"):
        with pytest.raises(ssm.FileError, match="no campaign's store"):
            Store.open(tmp_path / place)


def test_a_full_disk_stops_it_and_room_lets_it_go_on(load, tmp_path):
    """On a file system of its own, which is really full."""
    if subprocess.run(["unshare", "-rm", "true"], capture_output=True).returncode:
        pytest.skip("no file systems of one's own here")
    campaign = load(SMALL.replace("chunk = 5", "chunk = 1") + DRAWN)
    campaign.run(tmp_path / "whole")
    script = """
        import subprocess, ssm_decouple as ssm
        from ssm_decouple.studies.campaign import Campaign
        from ssm_decouple.studies.store import Store
        campaign = Campaign.load("campaign.toml")
        try:
            campaign.run("disk/s")
        except ssm.FileError as error:
            print(error)
        print(Store.open("disk/s").status().done)
        subprocess.run("mount -o remount,size=50M disk".split(), check=True)
        campaign.run("disk/s", resume=True)
        subprocess.run("cp -r disk/s again".split(), check=True)
    """
    (tmp_path / "disk").mkdir()
    mount = f'mount -t tmpfs -o size=800k none disk && exec {sys.executable} -c "$0"'
    done = subprocess.run(
        ["unshare", "-rm", "sh", "-c", mount, textwrap.dedent(script)],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    told, count = done.stdout.splitlines()
    assert told.endswith("No space left on device; what is finished is kept: make room, then --resume goes on")
    assert 0 < int(count) < 24
    assert tree(tmp_path / "again") == tree(tmp_path / "whole")


# Who computes it


@pytest.fixture
def interruptible():
    """Heed Ctrl-C, which a shell's background jobs ignore."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("interruptible")
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_an_interrupt_that_python_drops_is_heeded(load, tmp_path):
    """One that comes while an object is cleared up goes no further than a notice."""

    class Clearing:
        def __del__(self):
            signal.raise_signal(signal.SIGINT)

    def tell(done, size):
        if done == 5:
            Clearing()

    with pytest.raises(KeyboardInterrupt):
        load().run(tmp_path / "s", progress=tell)
    assert Store.open(tmp_path / "s").status().done == 10
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


@pytest.mark.usefixtures("interruptible")
def test_an_interrupt_waits_for_the_end_of_a_write(load, tmp_path, monkeypatch):
    write, seen = Store.write, []

    def interrupted(self, chunk, rows):
        signal.raise_signal(signal.SIGINT)
        seen.append(chunk)
        write(self, chunk, rows)

    monkeypatch.setattr(Store, "write", interrupted)
    with pytest.raises(KeyboardInterrupt):
        load().run(tmp_path / "s")
    assert seen == [0]
    assert Store.open(tmp_path / "s").status().done == 5


def test_processes_give_the_same_store_also_when_they_die(load, tmp_path):
    campaign = load(SMALL.replace("chunk = 5", "chunk = 2") + DRAWN)
    campaign.run(tmp_path / "one")
    told: list[str] = []

    def kill(done: int, size: int) -> None:
        if done == 2:
            for process in multiprocessing.active_children():
                process.kill()

    campaign.run(tmp_path / "two", workers=2, progress=kill, note=told.append)
    assert tree(tmp_path / "one") == tree(tmp_path / "two")
    assert len(told) == 2  # both had something to do
    assert all(line.startswith("the worker process ended by signal 9, as when memory runs out") for line in told)
    assert not multiprocessing.active_children()


def test_a_chunk_that_ends_its_workers_is_left_out(load, tmp_path, monkeypatch):
    campaign, told = load(SMALL.replace("chunk = 5", "chunk = 24") + DRAWN), []
    monkeypatch.setattr(workers, "ATTEMPTS", 2)
    monkeypatch.setattr(workers, "_serve", operator.add)  # which a pipe and a text end with an error
    with pytest.raises(ssm.FileError, match=r"chunk 0 \(samples 0 to 23\) could not be computed: 2 times the worker"):
        campaign.run(tmp_path / "s", workers=2, note=told.append)
    assert told == ["the worker process ended with status 1, over chunk 0"] * 2
    assert Store.open(tmp_path / "s").status().done == 0
    campaign.run(tmp_path / "s")
    assert Store.open(tmp_path / "s").status().left == 0


@pytest.fixture
def cluster():
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=False, protocol="tcp://", dashboard_address=":0"
    ) as found:
        yield found


def test_a_cluster_gives_the_same_store(load, tmp_path, cluster):
    campaign = load(SMALL.replace("chunk = 5", "chunk = 2") + DRAWN)
    campaign.run(tmp_path / "one")
    campaign.run(tmp_path / "two", scheduler=cluster.scheduler_address)
    assert tree(tmp_path / "one") == tree(tmp_path / "two")


def test_a_scheduler_that_is_not_there_or_has_no_workers(load, tmp_path, cluster, monkeypatch):
    monkeypatch.setattr(workers, "PATIENCE", 0.5)
    campaign = load()
    with pytest.raises(
        ssm.FileError, match=r"no scheduler answers at 'tcp://127.0.0.1:9' within 0.5 s .*dask scheduler"
    ):
        campaign.run(tmp_path / "s", scheduler="tcp://127.0.0.1:9")
    cluster.scale(0)
    with pytest.raises(ssm.FileError, match=r"has no worker after 0.5 s: start some with 'dask worker tcp://"):
        campaign.run(tmp_path / "s", scheduler=cluster.scheduler_address)
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(ssm.InputError, match=r"pip install 'ssm-decouple\[cluster\]'"):
        campaign.run(tmp_path / "s", scheduler=cluster.scheduler_address)


def test_a_worker_with_other_versions_refuses(load):
    campaign = load()
    with pytest.raises(ssm.InputError, match=f"a worker has ssm-decouple {ssm.__version__} instead of 0.0"):
        workers.compute(json.dumps(campaign.record), workers.versions() | {"ssm-decouple": "0.0"}, 0, 1)


# What a campaign file may say


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("seed = 3", "sed = 3", "unknown key 'sed'; did you mean 'seed'"),
        ("seed = 3", "", "seed is missing"),
        ("seed = 3", "seed = -1", "seed is -1"),
        ("samples = 8", "samples = 0", "samples is 0; it must be a whole number above 0"),
        ("chunk = 5", "chunk = 2.5", "chunk is 2.5; it must be a whole number above 0"),
        ('cases = ["short.toml"]', "", "cases is missing"),
        ('"short.toml"', "", r"cases is \[\]; it must be a list of names"),
        ('"short.toml"', '"shrt.toml"', "shrt.toml' is neither a file nor one of the cases"),
        ('"short.toml"', '"case1", "case1"', "name one twice"),
        ('"none"', '"yow"', "unknown protection 'yow'"),
        ("[start]", "[strat]", "unknown key 'strat'; did you mean 'start'"),
        ("joints_deg", "joint_deg", r"\[start\] unknown key 'joint_deg'; did you mean 'joints_deg'"),
        ("{ uniform = 5 }", "5", r"\[start\] joints_deg is 5; it must be a table of one entry"),
        ("uniform = 5", "unifrm = 5", "unknown distribution 'unifrm'; did you mean 'uniform'"),
        ("uniform = 5", "uniform = -5", "uniform is -5; it must be zero or a positive number"),
        ("uniform = 5", "uniform = [1, 2]", "must be a number"),
        ("normal = [1, 2, 3]", "normal = [1, 2]", "it must be zero or a positive number, or 3 of them"),
        ("ball = 0.2", "ball = inf", "ball is inf"),
        ("[0.02, 0.2]", "[0, 0.2]", r"log_uniform is \[0, 0.2\]; the numbers must be above zero"),
        ("[0.02, 0.2]", "[0.2, 0.02]", r"it must be \[lowest, highest\]"),
        ("[0, 1e-4]", "[]", "choice is empty"),
        ("[0, 1e-4]", "[-1]", "the numbers must be zero or above"),
        ("[law]", "[plant]\nmass = 2\n[law]", "tolerance of mass is 2"),
        ("[law]", "[plant]\nmas = 2\n[law]", r"\[plant\] unknown key 'mas'; did you mean 'mass'"),
        ("[law]", "[plant]\nmass = 0.1\n[law]", r"'short' is kinematic, and \[plant\] needs the equations of motion"),
        ("[law]", "[dynamic]\nfeedback_gain = { choice = [1] }\n[law]", r"and \[dynamic\] needs the equations"),
        ("[law]", "[law", "is not TOML"),
        ("[law]", "[[law]]", "'law' must be a table"),
    ],
)
def test_what_makes_no_campaign_is_refused(load, old, new, words):
    text = SMALL + DRAWN
    assert old in text
    with pytest.raises(ssm.InputError, match=words):
        load(text.replace(old, new, 1))


def test_more_that_makes_no_campaign(load, write, tmp_path):
    with pytest.raises(ssm.InputError, match=r"cannot read the campaign '.*': No such file"):
        Campaign.load(tmp_path / "nothing.toml")
    with pytest.raises(ssm.InputError, match=r"case 'short': unknown key 'gan'|\[law\] unknown key 'gan'"):
        load(case=SHORT.replace("gain", "gan"))
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "short.toml").write_text(SHORT)
    with pytest.raises(ssm.InputError, match="two cases are called short"):
        load(SMALL.replace('"short.toml"', '"short.toml", "other/short.toml"'))
    with pytest.raises(ssm.InputError, match="has tasks with targets of their own"):
        load(case=SHORT.replace("[target]", '[[task]]\nkind = "position"'))
    with pytest.raises(ssm.InputError, match=r"protection '@nose'|protection 'yaw@nose'"):
        load(SMALL.replace('"none"', '"yaw@nose"'))
    campaign = load()
    with pytest.raises(ssm.InputError, match="no sample 24: they are numbered from 0 to 23"):
        campaign.motion(24)
    with pytest.raises(ssm.InputError, match="workers is 0"):
        campaign.run(tmp_path / "s", workers=0)


def test_a_store_needs_no_file_but_itself(load, write, tmp_path):
    """Robots and case files by path travel with the campaign."""
    folder = tmp_path / "mine"
    folder.mkdir()
    (folder / "mine.urdf").write_text(ssm.models()["ets_vii"].read_text())
    (folder / "short.toml").write_text(SHORT.replace('"ets_vii"', '"mine.urdf"'))
    (folder / "c.toml").write_text(SMALL + DRAWN)
    Campaign.load(folder / "c.toml").run(tmp_path / "s")
    shutil.rmtree(folder)
    kept = Store.open(tmp_path / "s")
    again = kept.campaign.rows([11])
    assert all(np.array_equal(kept.row(11)[name], again[name][0]) for name in COLUMNS)
    assert kept.campaign.motion(11).attrs["robot"] == "mine"
