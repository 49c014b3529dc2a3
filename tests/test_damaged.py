"""Files that are damaged, or hold what they should not: refused by name, or read as what they say.

`pytest -m slow -s tests/test_damaged.py` tries a thousand of each kind and prints what came of them.
"""

from __future__ import annotations

import datetime
import json
import os
import resource
import shutil
import tomllib
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ssm_decouple as ssm
from ssm_decouple.studies.campaign import Campaign
from ssm_decouple.studies.store import COLUMNS, Store

pytestmark = pytest.mark.filterwarnings("ignore::ssm_decouple.errors.DecoupleWarning")

EXAMPLES = Path(__file__).parents[1] / "examples"
FEW, MANY = 15, 1000
MOST_MEMORY = 2**20  # KiB more than before that reading files of some kilobytes may take
ODD: list[Any] = [
    True,
    -1,
    0,
    2.5,
    1e308,
    10**400,
    float("nan"),
    float("inf"),
    "",
    "text",
    "ü\u200b\n",
    [],
    [1],
    [[]],
    [1, "text", float("nan")],
    {},
    {"key": 1},
    [{}],
    datetime.date(1997, 11, 28),
]


# What can happen to a file.


def damaged(content: bytes, rng: np.random.Generator) -> bytes:
    """Return bytes of which something happened to one place."""
    found, at = bytearray(content), int(rng.integers(len(content)))
    other, length = int(rng.integers(len(content))), int(rng.integers(1, 200))
    match rng.integers(8):
        case 0:
            found[at] ^= 1 << int(rng.integers(8))
        case 1:
            found[at] = int(rng.integers(256))
        case 2:
            del found[at:]
        case 3:
            del found[at : at + length]
        case 4:
            found[at], found[other] = found[other], found[at]
        case 5:
            found[at : at + length] = bytes(len(found[at : at + length]))
        case 6:  # as a power cut leaves it: the length is right and the end was never written
            found[at:] = bytes(len(found) - at)
        case _:
            found[at:at] = found[other : other + length]
    return bytes(found)


def toml(value: Any) -> str:
    """Return a value as TOML has it, tables in one line."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{json.dumps(key)} = {toml(one)}" for key, one in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(toml, value)) + "]"
    return str(value) if isinstance(value, datetime.date | float) else json.dumps(value)


def leaves(content: Any) -> Iterator[tuple[Any, Any]]:
    """Yield each container and key in a document."""
    for key in list(content) if isinstance(content, dict) else range(len(content)):
        yield content, key
        if isinstance(content[key], dict | list):
            yield from leaves(content[key])


def retyped(text: bytes, rng: np.random.Generator) -> bytes:
    """Return a document in which one value is another, one key is missing, or stands somewhere else."""
    content = tomllib.loads(text.decode())
    places = list(leaves(content))
    holder, key = places[int(rng.integers(len(places)))]
    match rng.integers(4):
        case 0:
            del holder[key]
        case 1 if isinstance(holder, dict):
            holder[f"{key}_"] = holder.pop(key)
        case _:
            holder[key] = ODD[int(rng.integers(len(ODD)))]
    return "\n".join(f"{json.dumps(key)} = {toml(value)}" for key, value in content.items()).encode()


def written(text: bytes, rng: np.random.Generator) -> bytes:
    """Return a document that is damaged, or that somebody has written wrongly."""
    return retyped(text, rng) if rng.integers(2) else damaged(text, rng)


# What has to come of it.


def outcomes(
    place: Path,
    change: Callable[[bytes, np.random.Generator], bytes],
    read: Callable[[], Any],
    same: Callable[[Any], bool],
    count: int,
) -> Counter[str]:
    """Change a file in so many ways and read it: refused, the same, or as the text now says; nothing else."""
    assert same(read())
    whole, found = place.read_bytes(), Counter[str]()
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for seed in range(count):
        rng = np.random.default_rng((seed, len(whole)))
        changed = change(whole, rng)
        place.write_bytes(changed)
        try:
            got = read()
        except ssm.DecoupleError:
            found["refused"] += 1
        except Exception as error:
            raise AssertionError(f"{place.name}, seed {seed}: {type(error).__name__}: {error}\n{changed!r}") from error
        else:
            assert same(got), (place.name, seed)
            found["equal"] += 1
    place.write_bytes(whole)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < MOST_MEMORY
    print(f"\n{place.name}: {dict(found)} of {count}")
    return found


counts = pytest.mark.parametrize("count", [FEW, pytest.param(MANY, marks=pytest.mark.slow)])


@counts
def test_cases(tmp_path, count):
    place = tmp_path / "case.toml"
    place.write_text(
        ssm.cases()["case1"].read_text() + "[limits]\nbraking = 0.8\n[spacecraft]\nturned_deg = { wing_left = 10 }\n"
    )

    def read():
        case = ssm.load_case(place)
        case.make_law()
        return case, case.start()

    def same(got):
        """A number that is another is no damage that can be seen: it has to be the text's."""
        case, q = got
        content = tomllib.loads(place.read_text())
        return case.duration == content["simulation"]["duration"] and np.isfinite(q).all()

    assert outcomes(place, written, read, same, count)["refused"] > count / 4


@counts
def test_robots(tmp_path, count):
    place = tmp_path / "robot.toml"
    place.write_text(ssm.models()["ets_vii_flexible"].read_text().replace('"ets_vii.urdf"', '"ets_vii"'))

    def same(robot):
        numbers = [x for one in robot.appendages for x in np.ravel([one.span_direction, one.normal])]
        return np.isfinite([robot.mass, *numbers]).all()

    assert outcomes(place, written, lambda: ssm.load_robot(place), same, count)["refused"] > count / 4


@counts
def test_campaigns(tmp_path, count):
    place = tmp_path / "campaign.toml"
    shutil.copy(EXAMPLES / "campaign.toml", place)

    def read():
        campaign = Campaign.load(place)
        return [campaign.drawn(case, 0) for case in campaign.cases]

    def same(draws):
        return all(np.isfinite([*one.joints, *one.base_rpy, *one.target]).all() for one in draws)

    assert outcomes(place, written, read, same, count)["refused"] > count / 4


@pytest.fixture(scope="module")
def motion():
    return replace(ssm.load_case("case1"), duration=5.0).run()


@counts
def test_motions(motion, tmp_path, count):
    place = ssm.save_motion(motion, tmp_path / "motion.nc")
    found = outcomes(place, damaged, lambda: ssm.load_motion(place), motion.identical, count)
    assert found["refused"] > 3 * found["equal"]


@pytest.fixture(scope="module")
def campaign(tmp_path_factory):
    folder = tmp_path_factory.mktemp("campaign")
    (folder / "short.toml").write_text(ssm.cases()["case1"].read_text().replace("duration = 150", "duration = 1"))
    (folder / "campaign.toml").write_text(
        'seed = 3\nsamples = 4\nchunk = 3\ncases = ["short.toml"]\nprotections = ["none", "case"]\n'
        "[target]\nposition = { ball = 0.2 }\n"
    )
    return Campaign.load(folder / "campaign.toml")


@pytest.fixture(scope="module")
def whole(campaign, tmp_path_factory):
    """A finished store and what it holds."""
    folder = tmp_path_factory.mktemp("whole") / "s"
    return folder, campaign.run(folder).load()


def tree(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@counts
def test_stores(campaign, whole, tmp_path, count):
    """Damage one file of a store: nothing is read that was not written, and verify and --resume see the file."""
    original, held = whole
    shutil.copytree(original, tmp_path / "s")
    files, found, rng = tree(original), Counter[str](), np.random.default_rng(count)
    for number in range(count):
        name = sorted(files)[int(rng.integers(len(files)))]
        place = tmp_path / "s" / name
        if rng.integers(5):
            place.write_bytes(damaged(files[name], rng) if files[name] else b"x")
        else:
            place.unlink()
        changed = not place.exists() or place.read_bytes() != files[name]
        try:
            kept = Store.open(tmp_path / "s")
            told, there = kept.damage(), kept.rows_there()
            got = kept.dataset().load()
            for variable in (*COLUMNS, "angle", "axis"):
                assert np.array_equal(
                    got[variable].values[there] if variable in COLUMNS else got[variable].values,
                    held[variable].values[there] if variable in COLUMNS else held[variable].values,
                    equal_nan=variable in COLUMNS and COLUMNS[variable].kind == "float64",
                ), name
            found["equal"] += 1
            assert told or not changed or not there.all() or name == "zarr.json", name
        except ssm.FileError:
            found["refused"] += 1
        if number % 20 == 0:
            campaign.run(tmp_path / "s", resume=True)
        if tree(tmp_path / "s") != files:
            assert number % 20 or (name == "zarr.json" and found["equal"]), name  # a description of the same meaning
            place.parent.mkdir(parents=True, exist_ok=True)
            place.write_bytes(files[name])
    print(f"\nstore: {dict(found)} of {count}")
    assert found["refused"] > found["equal"] / 2


@pytest.mark.parametrize(
    "harm",
    [
        "lost",
        "empty",
        "of another chunk",
        "of another column",
        "of another campaign",
        "a folder",
        "no checksums",
        "checksums of another chunk",
        "a damaged marker",
        "no columns",
        "no description",
        "half a description",
    ],
)
def test_what_happens_to_a_store_is_noticed_and_mended(campaign, whole, tmp_path, harm):
    original, _ = whole
    store = tmp_path / "s"
    shutil.copytree(original, store)
    place, other = store / "final_error" / "c" / "1", store / "final_error" / "c" / "0"
    match harm:
        case "lost":
            place.unlink()
        case "empty":
            place.write_bytes(b"")
        case "of another chunk":
            shutil.copy(other, place)
        case "of another column":
            shutil.copy(store / "outcome_time" / "c" / "1", place)
        case "of another campaign":
            spec = {**campaign.spec, "seed": 4}
            Campaign({**campaign.record, "spec": spec}, campaign.text).run(tmp_path / "t")
            shutil.copytree(tmp_path / "t" / "final_error", store / "final_error", dirs_exist_ok=True)
        case "a folder":
            place.unlink()
            place.mkdir()
        case "no checksums":
            shutil.rmtree(store / "checks" / "files" / "c" / "1")
        case "checksums of another chunk":
            shutil.copytree(store / "checks/files/c/0", store / "checks/files/c/1", dirs_exist_ok=True)
        case "a damaged marker":
            (store / "done" / "c" / "1").write_bytes(b"")
        case "no columns":
            shutil.rmtree(store / "final_error")
        case "no description":
            (store / "zarr.json").unlink()
        case _:
            text = (store / "zarr.json").read_text()
            (store / "zarr.json").write_text(text[: len(text) // 2])
    with pytest.raises(ssm.FileError, match=r"'ssm-decouple campaign verify .*--resume' computes it again"):
        Store.open(store).dataset().load()
    if "description" in harm:
        with pytest.raises(ssm.FileError, match="can list nothing else until"):
            Store.open(store)
    if "description" not in harm:
        kept = Store.open(store)
        assert any("chunk 1 (samples 3 to 5): " in fault for fault in kept.damage())
        assert kept.status().done < 8
        with pytest.raises(ssm.FileError, match="is damaged"):
            kept.row(3) if harm != "a damaged marker" else kept.dataset().done.load()
    with pytest.raises(ssm.FileError):
        campaign.run(store)
    told: list[str] = []
    campaign.run(store, resume=True, note=told.append)
    assert all(line.startswith("damaged, and made again: ") for line in told)
    assert told
    assert tree(store) == tree(original)


def test_a_store_of_another_campaign_is_not_written_over_when_its_description_is_lost(campaign, whole, tmp_path):
    shutil.copytree(whole[0], tmp_path / "s")
    (tmp_path / "s" / "zarr.json").unlink()
    other = Campaign({**campaign.record, "spec": {**campaign.spec, "seed": 4}}, campaign.text)
    before = tree(tmp_path / "s")
    with pytest.raises(ssm.FileError, match="no chunk in it is whole and of this campaign"):
        other.run(tmp_path / "s", resume=True)
    assert tree(tmp_path / "s") == before


def test_a_store_without_checksums_is_read_and_told(campaign, whole, tmp_path):
    """As the first version of the format has it."""
    shutil.copytree(whole[0], tmp_path / "s")
    shutil.rmtree(tmp_path / "s" / "checks")
    root = json.loads((tmp_path / "s" / "zarr.json").read_text())
    del root["attributes"]["check"], root["attributes"]["files"]
    root["attributes"]["format_version"] = 1
    for name in ("checks", "checks/files"):
        del root["consolidated_metadata"]["metadata"][name]
    (tmp_path / "s" / "zarr.json").write_text(json.dumps(root))
    with pytest.warns(ssm.DecoupleWarning, match="was written without checksums"):
        kept = Store.open(tmp_path / "s")
    assert kept.damage() == ()
    assert np.array_equal(kept.dataset().final_error.values, whole[1].final_error.values)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        (tmp_path / "s" / "outcome" / "c" / "1").unlink()
        assert "outcome/c/1 is lost" in Store.open(tmp_path / "s").damage()[0]
        with pytest.raises(ssm.FileError, match="outcome/c/1 is lost"):
            Store.open(tmp_path / "s").tallies()
        campaign.run(tmp_path / "s", resume=True)
        assert repr(Store.open(tmp_path / "s").tallies()) == repr(Store.open(whole[0]).tallies())  # NaN and all


def test_the_order_of_writing_outlasts_a_power_cut(campaign, tmp_path, monkeypatch):
    """What a marker vouches for is on the disk before the marker is: each file, and the folder that names it."""
    from ssm_decouple import files

    on_disk: set[Path] = set()
    monkeypatch.setattr(files.os, "fsync", lambda handle: on_disk.add(Path(f"/proc/self/fd/{handle}").resolve()))
    move = files.os.replace

    def moved(source, target):
        assert Path(source) in on_disk
        if Path(target).parent == tmp_path / "s" / "done" / "c":
            chunk = Path(target).name
            assert {tmp_path / "s" / "outcome" / "c", tmp_path / "s" / "checks" / "files" / "c" / chunk} <= on_disk
        move(source, target)

    monkeypatch.setattr(files.os, "replace", moved)
    campaign.run(tmp_path / "s")


# Motions.


@pytest.mark.parametrize("harm", ["a byte", "the end"])
def test_a_damaged_motion_is_refused_with_what_mends_it(tmp_path, motion, harm):
    path = tmp_path / "motion.nc"
    ssm.save_motion(motion, path)
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content if harm == "a byte" else content[: len(content) // 2])
    with pytest.raises(ssm.FileError, match=r"is damaged: .*; compute the motion again, or take an undamaged copy"):
        ssm.load_motion(path)


@pytest.mark.parametrize("name", ["folder", "empty", "text", "loop", "nothing", "n" * 300, "nul\0"])
def test_what_is_no_file_of_a_motion_is_refused(tmp_path, name):
    (tmp_path / "folder").mkdir()
    (tmp_path / "empty").write_bytes(b"")
    (tmp_path / "text").write_text("text")
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    with pytest.raises(ssm.FileError):
        ssm.load_motion(tmp_path / name)


def test_a_motion_is_a_netcdf_file_with_checksums(motion, tmp_path):
    import h5py
    import xarray as xr

    path = ssm.save_motion(motion, tmp_path / "motion.nc")
    with xr.open_dataset(path) as opened:
        assert opened.identical(motion)
    with h5py.File(path) as file:
        assert all(
            file[name].fletcher32 for name in motion.variables if motion[name].dtype.kind == "f" and motion[name].ndim
        )
    again = ssm.save_motion(ssm.load_motion(path), tmp_path / "again.nc")
    assert again.read_bytes() == path.read_bytes()


def test_a_motion_of_another_program_is_read_and_told(motion, tmp_path):
    motion.to_netcdf(tmp_path / "motion.nc", engine="h5netcdf")
    with pytest.warns(ssm.DecoupleWarning, match="has no checksum"):
        assert ssm.load_motion(tmp_path / "motion.nc").identical(motion)


def test_a_place_that_is_no_file_is_not_written_over(motion, tmp_path):
    os.mkfifo(tmp_path / "pipe.nc")
    for place in (tmp_path / "pipe.nc", tmp_path / ("n" * 300), tmp_path / "nul\0.nc"):
        with pytest.raises(ssm.FileError, match=r"cannot write|NUL character"):
            ssm.save_motion(motion, place)
    with pytest.raises(ssm.InputError, match="path is ''; give a path"):
        ssm.save_motion(motion, "")
    assert (tmp_path / "pipe.nc").is_fifo()
