"""Where a campaign's results are kept: a Zarr store, written chunk by chunk, each whole or not at all.

Each chunk comes with checksums of its files. They are looked at whenever a file is read, before anything decodes it.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import re
import shutil
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr
import zarr
from numpy.typing import NDArray
from zarr.codecs import Crc32cCodec, ZstdCodec
from zarr.core.buffer import default_buffer_prototype
from zarr.storage import LocalStore, MemoryStore, WrapperStore

from ssm_decouple.errors import DecoupleWarning, FileError
from ssm_decouple.files import PARTIAL, synced, write_all_whole
from ssm_decouple.studies.campaign import FAILED, Campaign, Rows, versions

if TYPE_CHECKING:
    from zarr import Group
    from zarr.abc.store import ByteRequest
    from zarr.core.buffer import Buffer, BufferPrototype

FORMAT, FORMAT_VERSION = "ssm-decouple campaign", 2
UNCHECKED = 1  # the version of the format that has no checksums
DONE = "done"
CHECKS = "checks"  # a group of its own, so that xarray does not take it for results
_AT_A_TIME = 2**20  # samples that are read together where all are
_ROOT = "zarr.json"  # the description of the whole
_CODECS = (ZstdCodec(level=0), Crc32cCodec())  # the second so that other readers notice a changed byte too


@dataclass(frozen=True)
class Column:
    """What a store keeps of each sample under one name.

    Attributes:
        kind: Of its numbers: "float64", "int64" or "string".
        dimensions: After the sample.
        unit: SI.
        meaning: In words.
    """

    kind: str
    dimensions: tuple[str, ...]
    unit: str
    meaning: str

    @property
    def unknown(self) -> Any:
        """What stands where nothing is known."""
        return {"float64": np.nan, "int64": -1, "string": ""}[self.kind]


_F, _I, _S = "float64", "int64", "string"
COLUMNS: dict[str, Column] = {
    "case": Column(_S, (), "", "name of the case"),
    "protection": Column(_S, (), "", "what is protected; 'case' is the case's own protection"),
    "k": Column(_I, (), "1", "number of protected directions"),
    "draw": Column(_I, (), "1", "number of the sample within its case and protection: the same number, the same draw"),
    "start_joints": Column(_F, ("joint",), "rad or m", "joint positions at the start, in the order of the robot's"),
    "start_rpy": Column(_F, ("angle",), "rad", "base attitude at the start, R = Rz(yaw) Ry(pitch) Rx(roll)"),
    "target": Column(_F, ("axis",), "m", "where the end-effector shall go, inertial axes; NaN of a case with tasks"),
    "gain": Column(_F, (), "1/s", "gain of the law"),
    "damping": Column(_F, (), "m2", "rho of the law at a singularity"),
    "feedback_gain": Column(_F, (), "1/s", "gain of the feedback on the protected axes"),
    "plant_seed": Column(_I, (), "1", "seed of the plant's deviations; -1 where the plant is the model"),
    "outcome": Column(_S, (), "", "converged, stalled, running, or failed: see error"),
    "outcome_time": Column(_F, (), "s", "when it arrived for good, or stopped making progress, or the end"),
    "final_error": Column(_F, (), "m", "distance to the target at the end; of tasks the norm of all errors of level 1"),
    "joint_travel": Column(_F, (), "rad", "norm of the joint rates integrated over time; with m of sliding joints"),
    "peak_rate": Column(_F, (), "rad/s", "largest rate of any joint, m/s of a sliding one"),
    "protected_rate": Column(_F, (), "rad/s", "largest rate along a protected direction; m/s of one that shifts"),
    "base_rotation": Column(_F, ("angle",), "rad", "base roll, pitch and yaw, peak to peak"),
    "smallest_singular_value": Column(_F, (), "m", "smallest singular value of J_gt N_sub on the way"),
    "error": Column(_S, (), "", "why the sample failed; empty where it did not"),
}
_CHECKED = (*COLUMNS, DONE)  # what of a chunk has a checksum, in this order
_LABELS = {"angle": ("roll", "pitch", "yaw"), "axis": ("x", "y", "z")}


@dataclass(frozen=True)
class Status:
    """How far a campaign has come.

    Attributes:
        title: Of the campaign.
        samples: In all.
        done: How many are there.
        failed: How many of those have an error instead of results.
        cases: Names.
        protections: Words.
        sha256: Hash of the campaign's record.
        versions: Of the packages that computed it.
        damaged: What is not as it was written, in words; samples in damaged chunks are not counted as done.
    """

    title: str
    samples: int
    done: int
    failed: int
    cases: tuple[str, ...]
    protections: tuple[str, ...]
    sha256: str
    versions: Mapping[str, str]
    damaged: tuple[str, ...] = ()

    @property
    def left(self) -> int:
        """How many samples are still to be computed."""
        return self.samples - self.done


@dataclass(frozen=True)
class Tally:
    """One case under one protection in figures; angles are degrees here, for people to read.

    Attributes:
        case: Name of the case.
        protection: What is protected.
        k: Protected directions.
        samples: That are there.
        arrived: Share of them that arrived; one that failed has not.
        arrived_low: Lower end of Wilson's 95 % interval of that share.
        arrived_high: Upper end.
        stalled: Number.
        running: Number that neither arrived nor stalled in the time.
        failed: Number that could not be computed.
        median_time_s: Median of the arrival times.
        median_left_m: Median of the distance to the target at the end.
        median_left_stalled_m: The same of those that did not arrive.
        roll_deg: Median of the base's roll, peak to peak.
        pitch_deg: Of its pitch.
        yaw_deg: Of its yaw.
        protected_rate_max: Largest rate along a protected direction in any sample, rad/s.
    """

    case: str
    protection: str
    k: int
    samples: int
    arrived: float
    arrived_low: float
    arrived_high: float
    stalled: int
    running: int
    failed: int
    median_time_s: float
    median_left_m: float
    median_left_stalled_m: float
    roll_deg: float
    pitch_deg: float
    yaw_deg: float
    protected_rate_max: float


@dataclass(frozen=True)
class _Seals:
    """Checksums of a store's files, by which they are known.

    A chunk's are of its bytes, its place, the campaign and the versions of the packages, so that a file of another
    place or of another campaign is noticed too. Zero stands for a file that is not there because it would hold nothing
    but what stands where nothing is known.

    Attributes:
        folder: The store's.
        salt: The campaign and the versions.
        files: Of the description by path; None where the store has no checksums.
    """

    folder: Path
    salt: str
    files: Mapping[str, str] | None

    def fault(self, key: str, content: bytes | None) -> str | None:
        """Return what is wrong with a file's content, None being that of a lost one; None if nothing is."""
        part = re.fullmatch(r"(\w+)/c/(\d+)(?:/0)*", key)
        if part is None or part[1] not in _CHECKED:
            wanted = None if self.files is None else self.files.get(key)
            return None if wanted is None else _told(key, content, f"{_digest(content, key):016x}" == wanted)
        chunk = int(part[2])
        if not (self.folder / DONE / "c" / part[2]).exists():
            return None  # not there yet, so that whatever it holds does not count
        if self.files is None:
            # Where there are no checksums, a column of nothing is not there.
            return None if content or part[1] in _MAY_BE_EMPTY else _told(key, content, False)
        sums = self.sums(chunk)
        if sums is None:
            return f"{_sums_key(chunk)} is lost or damaged"
        return _told(key, content, _digest(content, self.salt, key) == sums[_CHECKED.index(part[1])])

    def sums(self, chunk: int) -> list[int] | None:
        """Return a chunk's checksums, in the order of what has one."""
        try:
            content = (self.folder / _sums_key(chunk)).read_bytes()
        except OSError:
            return None
        count = len(_CHECKED)
        return np.frombuffer(content, "<u8", count).tolist() if len(content) >= 8 * count else None


class _Verified(WrapperStore[LocalStore]):
    """The files of a store, each looked at before anything decodes it; its description as it was when it was opened."""

    def __init__(self, store: LocalStore, seals: _Seals, root: bytes) -> None:
        super().__init__(store)
        self._seals, self._root = seals, root

    def _with_store(self, store: LocalStore) -> _Verified:
        return _Verified(store, self._seals, self._root)

    async def get(self, key: str, prototype: BufferPrototype, byte_range: ByteRequest | None = None) -> Buffer | None:
        """Return what a file holds.

        Raises:
            FileError: it is damaged or lost.
        """
        if key == _ROOT:
            return prototype.buffer.from_bytes(self._root)
        folder = self._seals.folder
        try:
            found = await self._store.get(key, prototype)
        except OSError as error:
            raise FileError(_damaged(folder, f"{key} cannot be read: {error.strerror or error}")) from error
        fault = self._seals.fault(key, None if found is None else found.to_bytes())
        if fault is not None:
            raise FileError(_damaged(folder, fault))
        return found if byte_range is None else await self._store.get(key, prototype, byte_range)


class Store:
    """A campaign's results on disk.

    Attributes:
        path: The folder.
        mended: What of it was damaged when it was opened to be written, in words.
    """

    def __init__(self, path: Path, description: Mapping[str, Any]) -> None:
        self.path = path
        self.mended: tuple[str, ...] = ()
        self._description = description
        told = description["attributes"]
        files = None if told["format_version"] == UNCHECKED else told["files"]
        self._seals = _Seals(path, _salt(told["sha256"], told["versions"]), files)
        self._arrays: dict[str, zarr.Array[Any]] = {}

    @classmethod
    def open(cls, path: str | Path) -> Store:
        """Open a store to read it. What is read is verified; where a store has no checksums, a warning says so.

        Raises:
            FileError: there is none, or its description is damaged.
        """
        folder = Path(path)
        description = _described_at(folder)
        if description is None:
            raise FileError(f"'{folder}' is no campaign's store; 'ssm-decouple campaign run FILE --output' makes one")
        kept = cls(folder, description)
        if not kept.checked:
            warnings.warn(
                f"'{folder}' was written without checksums: lost files are noticed, changed ones may not be",
                DecoupleWarning,
                stacklevel=2,
            )
        return kept

    @classmethod
    @contextmanager
    def writing(cls, path: str | Path, campaign: Campaign, resume: bool = False) -> Iterator[Store]:
        """Open a store to write into it, made if it is not there; no other process may meanwhile.

        What is damaged is mended first: the description is written again, and chunks count as not there.

        Args:
            path: The folder.
            campaign: What it is of.
            resume: Go on with what is there.

        Raises:
            FileError: it cannot be written, is in use, is there and `resume` is not asked for, or is of another
                campaign or other versions of the packages.
        """
        folder = Path(path)
        _refuse_file(folder)
        with _telling(folder, "make room or choose another --output"):
            folder.mkdir(parents=True, exist_ok=True)
            with _locked(folder):
                kept = cls._ready(folder, campaign, resume)
                vars(kept)["campaign"] = campaign
                for leftover in folder.rglob(f"*{PARTIAL}"):
                    leftover.unlink()
                yield kept

    @classmethod
    def _ready(cls, folder: Path, campaign: Campaign, resume: bool) -> Store:
        """Return the store in a folder, made or mended as far as it has to be."""
        try:
            description = _described_at(folder)
        except _BrokenError as broken:
            made = cls(folder, json.loads(_described(campaign)[_ROOT]))
            if made.finished().any() and not resume:
                raise
            if made.finished().any() and all(map(made._fault_of, np.flatnonzero(made.finished()).tolist())):
                raise FileError(
                    f"'{folder}' is damaged: {broken.fault}, and no chunk in it is whole and of this campaign. Choose "
                    "another --output"
                ) from None
            made._describe(campaign)
            made._mend([broken.fault])
            return made
        if description is None:
            made = cls(folder, json.loads(_described(campaign)[_ROOT]))
            made._describe(campaign)
            return made
        kept = cls(folder, description)
        if not resume and kept.finished().any():
            raise FileError(_already(kept))
        _refuse_another(kept, campaign)
        faults = kept._faults_of_description()
        if faults:
            kept._describe(campaign)
            kept = cls(folder, json.loads(_described(campaign)[_ROOT]))
        kept._mend(faults)
        return kept

    def _describe(self, campaign: Campaign) -> None:
        """Write the description, that of the whole last."""
        files = _described(campaign)
        for key in files:
            _clear_way(self.path, key)
        root = files.pop(_ROOT)
        write_all_whole({self.path / key: content for key, content in files.items()})
        write_all_whole({self.path / _ROOT: root})
        synced(self.path.absolute().parent)

    def _mend(self, faults: list[str]) -> None:
        """Have damaged chunks count as not there."""
        for chunk, fault in self._faulty_chunks():
            faults.append(f"{self._named(chunk)}: {fault}")
            for key in (*map(partial(_key, chunk), _CHECKED), _sums_key(chunk)):
                _clear_way(self.path, key)
            (self.path / _key(chunk, DONE)).unlink(missing_ok=True)
        if faults and (self.path / DONE / "c").is_dir():
            synced(self.path / DONE / "c")
        self.mended = tuple(faults)

    @property
    def checked(self) -> bool:
        """Whether it has checksums; those of the format's first version have none."""
        return self._seals.files is not None

    def damage(self) -> tuple[str, ...]:
        """Read all files and return in words which are damaged, lost or unreadable, chunk by chunk."""
        named = (f"{self._named(chunk)}: {fault}" for chunk, fault in self._faulty_chunks())
        return (*self._faults_of_description(), *named)

    def fault_of(self, number: int) -> str | None:
        """Return in words what is wrong with the chunk that holds a sample; None if nothing is, or it is not there."""
        chunk = number // self._sizes[1]
        return self._fault_of(chunk) if self.finished()[chunk] else None

    def _named(self, chunk: int) -> str:
        size, length = self._sizes
        return f"chunk {chunk} (samples {chunk * length} to {min((chunk + 1) * length, size) - 1})"

    def _faults_of_description(self) -> list[str]:
        faults = (self._fault_at(key) for key in self._seals.files or ())
        return [fault for fault in faults if fault is not None]

    def _faulty_chunks(self) -> Iterator[tuple[int, str]]:
        for chunk in np.flatnonzero(self.finished()).tolist():
            fault = self._fault_of(chunk)
            # What another process computes again meanwhile is not damaged.
            if fault is not None and (self.path / _key(chunk, DONE)).exists():
                yield chunk, fault

    def _fault_of(self, chunk: int) -> str | None:
        found = [self._fault_at(_key(chunk, name)) for name in _CHECKED]
        faults = list(dict.fromkeys(fault for fault in found if fault is not None))
        if not faults and not self.checked:
            try:  # without checksums it is at least to be had
                start = chunk * self._sizes[1]
                for name in COLUMNS:
                    self._column(name, slice(start, start + self._sizes[1]))
            except FileError as error:
                faults.append(str(error))
        more = f", and {len(faults) - 1} more files are damaged or lost" if faults[1:] else ""
        return faults[0] + more if faults else None

    def _fault_at(self, key: str) -> str | None:
        try:
            content = (self.path / key).read_bytes()
        except (FileNotFoundError, NotADirectoryError, IsADirectoryError):
            content = None
        except OSError as error:
            return f"{key} cannot be read: {error.strerror or error}"
        return self._seals.fault(key, content)

    @cached_property
    def campaign(self) -> Campaign:
        """The campaign as the store has it."""
        return Campaign(json.loads(self._attribute("campaign")), self._attribute("spec"))

    @property
    def record(self) -> dict[str, Any]:
        """The campaign's record, without its robots built."""
        return json.loads(self._attribute("campaign"))

    @property
    def versions(self) -> dict[str, str]:
        """The versions of the packages that computed it."""
        return json.loads(self._attribute("versions"))

    def _attribute(self, name: str) -> str:
        return str(self._description["attributes"][name])

    @cached_property
    def _verified(self) -> _Verified:
        """The files, to be read."""
        return _Verified(LocalStore(self.path, read_only=True), self._seals, self._root)

    @property
    def _root(self) -> bytes:
        return json.dumps(self._description).encode()

    @cached_property
    def _group(self) -> Group:
        """The arrays, to be read."""
        with _decoding(self.path):
            return zarr.open_group(self._verified, mode="r", use_consolidated=True)

    @cached_property
    def _desk(self) -> tuple[dict[str, Buffer], Group]:
        """Where chunks are encoded, in memory, so that nothing is written to the disk but what is whole."""
        files = {_ROOT: default_buffer_prototype().buffer.from_bytes(self._root)}
        return files, zarr.open_group(MemoryStore(files), mode="r+", use_consolidated=True)

    @cached_property
    def _sizes(self) -> tuple[int, int]:
        """Rows, and rows of a chunk."""
        array = self._array("draw")
        return int(array.shape[0]), int(array.chunks[0])

    def _array(self, name: str) -> zarr.Array[Any]:
        if name not in self._arrays:
            with _decoding(self.path):
                self._arrays[name] = _array_of(self._group, name)
        return self._arrays[name]

    def finished(self) -> NDArray[np.bool_]:
        """Return which chunks are there (chunks,)."""
        size, chunk = self._sizes
        there = np.zeros(-(-size // chunk), dtype=bool)
        markers = self.path / DONE / "c"
        if markers.is_dir():  # to list them is quicker than to read a million files of one byte
            names = [entry.name for entry in os.scandir(markers) if re.fullmatch("0|[1-9][0-9]{0,15}", entry.name)]
            there[[number for number in map(int, names) if number < len(there)]] = True
        return there

    def missing(self) -> list[int]:
        """Return the chunks that are not there yet."""
        return [int(chunk) for chunk in np.flatnonzero(~self.finished())]

    def rows_there(self) -> NDArray[np.bool_]:
        """Return which samples are there (samples,)."""
        size, chunk = self._sizes
        return np.repeat(self.finished(), chunk)[:size]

    @property
    def samples_done(self) -> int:
        """How many samples are there."""
        return int(self.rows_there().sum())

    def write(self, chunk: int, rows: Rows) -> None:
        """Write a chunk, then its checksums, then its marker, each on the disk before the next.

        Raises:
            FileError: it cannot be written; the store is as if the chunk had not been computed.
        """
        span = slice(*self.campaign.span(chunk))
        mark = {DONE: (slice(chunk, chunk + 1), 1)}
        files = self._encoded({name: (span, values) for name, values in rows.items()} | mark)
        marker = {_key(chunk, DONE): files.pop(_key(chunk, DONE))}
        sums = [_digest(files.get(key, marker.get(key)), self._seals.salt, key) for key in self._keys(chunk)]
        seals = (
            self._encoded({f"{CHECKS}/files": (slice(chunk, chunk + 1), np.array([sums], np.uint64))})
            if self.checked
            else {}
        )
        with _telling(self.path, "what is finished is kept: make room, then --resume goes on"):
            for step in (files, seals, marker):
                write_all_whole({self.path / key: content for key, content in step.items()})
            for key in set(self._keys(chunk)) - files.keys() - marker.keys():  # nothing is known in this column
                (self.path / key).unlink(missing_ok=True)

    def row(self, number: int, though_damaged: bool = False) -> dict[str, Any]:
        """Return what is stored of one sample.

        Args:
            number: The row.
            though_damaged: Return what is there, even if it is not as it was written.

        Raises:
            FileError: it has not been computed yet, or is damaged.
        """
        if not self.finished()[number // self._sizes[1]]:
            raise FileError(f"sample {number} is not in '{self.path}' yet; --resume goes on with the campaign")
        if not though_damaged:
            return {name: self._column(name, slice(number, number + 1))[0] for name in COLUMNS}
        with _decoding(self.path):
            group = zarr.open_group(LocalStore(self.path, read_only=True), mode="r", use_consolidated=True)
            return {name: np.asarray(_array_of(group, name)[number : number + 1])[0] for name in COLUMNS}

    def dataset(self) -> xr.Dataset:
        """Return the store as xarray reads it, lazily; what is damaged raises a FileError when it is read."""
        with _decoding(self.path):
            return xr.open_zarr(self._verified, consolidated=True)

    def status(self) -> Status:
        """Return how far the campaign has come; all files are read to see whether they are whole."""
        record, there = self.record, self.rows_there()
        faults = dict(self._faulty_chunks())
        for chunk in faults:
            there[chunk * self._sizes[1] : (chunk + 1) * self._sizes[1]] = False
        named = (f"{self._named(chunk)}: {fault}" for chunk, fault in faults.items())
        return Status(
            title=str(record["spec"].get("title", "without a title")),
            samples=len(there),
            done=int(there.sum()),
            failed=self._failed(there, bool(faults)),
            cases=tuple(case["name"] for case in record["cases"]),
            protections=tuple(record["spec"].get("protections", ("case",))),
            sha256=self._attribute("sha256"),
            versions=self.versions,
            damaged=(*self._faults_of_description(), *named),
        )

    def tallies(self) -> list[Tally]:
        """Return the figures of each case under each protection, of the samples that are there.

        Raises:
            FileError: what they need is damaged.
        """
        record, there, found = self.record, self.rows_there(), []
        samples = int(record["spec"]["samples"])
        for start in range(0, len(there), samples):
            part = slice(start, start + samples)
            if there[part].any():
                found.append(self._tally(part, there[part]))
        return found

    def _failed(self, there: NDArray[np.bool_], damaged: bool) -> int:
        step = self._sizes[1] if damaged else _AT_A_TIME  # around what is damaged, chunk by chunk
        parts = [slice(start, start + step) for start in range(0, len(there), step)]
        return sum(
            int(np.sum(self._column("outcome", part)[there[part]] == FAILED)) for part in parts if there[part].any()
        )

    def _column(self, name: str, part: slice) -> NDArray[Any]:
        with _decoding(self.path):
            return np.asarray(self._array(name)[part])

    def _keys(self, chunk: int) -> list[str]:
        return [_key(chunk, name) for name in _CHECKED]

    def _encoded(self, values: Mapping[str, tuple[slice, Any]]) -> dict[str, bytes]:
        """Return files by their keys that hold values, each given by its array and place; none where all is unknown."""
        files, group = self._desk
        for name, (place, part) in values.items():
            _array_of(group, name)[place] = part
        return {key: files.pop(key).to_bytes() for key in files.keys() - {_ROOT}}

    def _tally(self, part: slice, there: NDArray[np.bool_]) -> Tally:
        from ssm_decouple.studies.shares import wilson

        kept = {name: self._column(name, part)[there] for name in _TALLIED}
        outcomes, left = kept["outcome"], kept["final_error"]
        arrived, failed = outcomes == "converged", outcomes == FAILED
        low, high = wilson(int(arrived.sum()), len(arrived))
        turned = [_median(np.rad2deg(kept["base_rotation"][:, axis])) for axis in range(3)]
        return Tally(
            case=str(kept["case"][0]),
            protection=str(kept["protection"][0]),
            k=int(kept["k"][0]),
            samples=len(arrived),
            arrived=float(arrived.mean()),
            arrived_low=low,
            arrived_high=high,
            stalled=int(np.sum(outcomes == "stalled")),
            running=int(np.sum(outcomes == "running")),
            failed=int(failed.sum()),
            median_time_s=_median(kept["outcome_time"][arrived]),
            median_left_m=_median(left),
            median_left_stalled_m=_median(left[~arrived]),
            roll_deg=turned[0],
            pitch_deg=turned[1],
            yaw_deg=turned[2],
            protected_rate_max=float(kept["protected_rate"][~failed].max(initial=0.0)),
        )


_TALLIED = ("case", "protection", "k", "outcome", "outcome_time", "final_error", "base_rotation", "protected_rate")


def _median(values: NDArray[Any]) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if known.size else float("nan")


# Columns of which a chunk may hold nothing, so that Zarr writes no file: no sample failed, no plant is off, no target.
_MAY_BE_EMPTY = ("target", "plant_seed", "error", *(name for name, one in COLUMNS.items() if one.kind == "float64"))


class _BrokenError(FileError):
    """A campaign's store whose description is lost, damaged or not complete.

    Attributes:
        fault: What it is, without what can be done.
    """

    def __init__(self, folder: Path, fault: str) -> None:
        super().__init__(
            f"'{folder}' is damaged, or its run was stopped right at the start: {fault}. 'ssm-decouple campaign verify "
            f"{folder}' can list nothing else until 'ssm-decouple campaign run FILE --output {folder} --resume' "
            f"computes it again"
        )
        self.fault = fault


def _described_at(folder: Path) -> dict[str, Any] | None:
    """Return the description of a campaign's store; None where there is nothing yet.

    Raises:
        FileError: there is something else, or the description is not as it was written.
    """
    _refuse_file(folder)
    try:
        names = [entry.name for entry in folder.iterdir() if not entry.match(f"*{PARTIAL}")] if folder.exists() else []
        if not names:
            return None
        content = (folder / _ROOT).read_bytes() if _ROOT in names else None
    except OSError as error:
        raise FileError(f"'{folder}' cannot be read: {error.strerror or error}") from error
    ours = set(names) <= {*_CHECKED, *_LABELS, CHECKS, _ROOT}
    if content is None and not ours:
        raise FileError(f"'{folder}' holds something that is no campaign's store; choose another --output")
    broken = _BrokenError(folder, f"its description {_ROOT} is {'lost' if content is None else 'damaged'}")
    try:
        found = json.loads(content or b"")
        told = found["attributes"]
        marks = told.get("format"), told.get("format_version")
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        if not ours:
            raise FileError(f"'{folder}' is no campaign's store: {_ROOT} cannot be read") from None
        raise broken from None
    if marks[0] != FORMAT:
        if ours and (folder / DONE / "c").is_dir():
            raise broken
        raise FileError(f"'{folder}' is a Zarr store but no campaign's; choose another --output")
    if not _whole(found):
        raise broken
    if marks[1] not in (UNCHECKED, FORMAT_VERSION):
        raise FileError(f"'{folder}' has format version {marks[1]}, this package reads {FORMAT_VERSION}")
    return found


def _whole(description: Mapping[str, Any]) -> bool:
    """Say whether a description is complete and, as far as it has checksums, as it was written."""
    told = description["attributes"]
    if not isinstance(description.get("consolidated_metadata"), dict):
        return False
    if told.get("format_version") != UNCHECKED:
        return told.get("check") == _check(description)
    try:
        record = json.loads(told["campaign"])
        hashed = hashlib.sha256(json.dumps(record, sort_keys=True).encode()).hexdigest()
        return isinstance(json.loads(told["versions"]), dict) and hashed == told["sha256"] and "spec" in told
    except (ValueError, KeyError, TypeError):
        return False


def _check(description: Mapping[str, Any]) -> str:
    """Return the checksum of a description of which it is itself a part."""
    told = {key: value for key, value in description["attributes"].items() if key != "check"}
    return f"{_digest(json.dumps({**description, 'attributes': told}, sort_keys=True).encode()):016x}"


def _digest(content: bytes | None, *about: str) -> int:
    """Return a checksum of 64 bits, of content and what it is; 0 of none."""
    if content is None:
        return 0
    return int.from_bytes(hashlib.blake2b("\0".join((*about, "")).encode() + content, digest_size=8).digest(), "little")


def _told(key: str, content: bytes | None, right: bool) -> str | None:
    return None if right else f"{key} is {'lost' if content is None else 'damaged'}"


def _damaged(folder: Path, fault: str) -> str:
    return (
        f"'{folder}' is damaged: {fault}. 'ssm-decouple campaign verify {folder}' lists all that is, and 'ssm-decouple "
        f"campaign run FILE --output {folder} --resume' computes it again"
    )


def _salt(sha256: str, versions: str) -> str:
    return f"{sha256} {versions}"


def _key(chunk: int, name: str) -> str:
    """Return the path of a chunk of an array in the store."""
    return f"{name}/c/{chunk}" + "/0" * len(COLUMNS[name].dimensions if name in COLUMNS else ())


def _sums_key(chunk: int) -> str:
    return f"{CHECKS}/files/c/{chunk}/0"


def _array_of(group: Group, name: str) -> zarr.Array[Any]:
    found = group[name]
    if not isinstance(found, zarr.Array):
        raise KeyError(f"{name} is no array")
    return found


def _clear_way(folder: Path, key: str) -> None:
    """Remove what keeps a file from being written: a file where a folder has to be, or the other way round."""
    parts = Path(key).parts
    for i in range(1, len(parts)):
        above = folder.joinpath(*parts[:i])
        if above.exists() and not above.is_dir():
            above.unlink()
    if (folder / key).is_dir():
        shutil.rmtree(folder / key)


@contextmanager
def _decoding(folder: Path) -> Iterator[None]:
    """Turn what Zarr and its codecs say of damaged bytes, which may be anything, into a FileError."""
    try:
        yield
    except (FileError, MemoryError):
        raise
    except Exception as error:
        told = " ".join(str(error).split())
        raise FileError(_damaged(folder, f"{type(error).__name__}: {told}")) from error


def _refuse_file(folder: Path) -> None:
    if folder.exists() and not folder.is_dir():
        raise FileError(f"'{folder}' is a file; a campaign's store is a folder: choose another --output")


def _described(campaign: Campaign) -> dict[str, bytes]:
    """Return the files that describe the store of a campaign, by their paths in it."""
    attributes = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "title": campaign.title,
        "spec": campaign.text,
        "sha256": campaign.sha256,
        "versions": json.dumps(versions()),
        "campaign": json.dumps(campaign.record),
    }
    files: dict[str, Buffer] = {}
    group = zarr.create_group(MemoryStore(files), zarr_format=3, attributes=attributes)
    sizes = {"joint": campaign.most_joints, **{name: len(labels) for name, labels in _LABELS.items()}}
    for name, column in COLUMNS.items():
        dimensions = ("sample", *column.dimensions)
        lengths = tuple(sizes[dimension] for dimension in column.dimensions)
        shape, chunks = (campaign.size, *lengths), (campaign.chunk, *lengths)
        about = {"long_name": column.meaning} | ({"units": column.unit} if column.unit else {})
        _array_in(group, name, shape, chunks, column.kind, dimensions, about, column.unknown)
    about = {"long_name": "1 where the chunk is there; written after all else of it"}
    _array_in(group, DONE, (campaign.chunks,), (1,), "uint8", ("chunk",), about, 0)
    for name, labels in _LABELS.items():
        array = _array_in(group, name, (len(labels),), (len(labels),), "string", (name,), {}, "")
        array[:] = np.array(labels, dtype=object)
    count = len(_CHECKED)
    about = {"long_name": f"BLAKE2b, 64 bits, of the chunk's files: {', '.join(_CHECKED)}; 0 where there is none"}
    _array_in(
        group, f"{CHECKS}/files", (campaign.chunks, count), (1, count), "uint64", ("chunk", "file"), about, 0, False
    )
    with warnings.catch_warnings():
        # Not in the format's specification yet, and without it xarray warns whoever opens the store.
        warnings.simplefilter("ignore", UserWarning)
        zarr.consolidate_metadata(group.store)
    found = {key: buffer.to_bytes() for key, buffer in files.items()}
    description = json.loads(found[_ROOT])
    told = description["attributes"]
    told["files"] = {key: f"{_digest(found[key], key):016x}" for key in sorted(found.keys() - {_ROOT})}
    told["check"] = _check(description)
    return {**found, _ROOT: json.dumps(description, indent=2).encode()}


def _array_in(
    group: Group,
    name: str,
    shape: tuple[int, ...],
    chunks: tuple[int, ...],
    kind: str,
    dimensions: tuple[str, ...],
    attributes: dict[str, Any],
    fill: Any,
    compressed: bool = True,
) -> zarr.Array[Any]:
    return group.create_array(
        name,
        shape=shape,
        chunks=chunks,
        dtype=kind,
        compressors=_CODECS if compressed else _CODECS[1:],
        dimension_names=dimensions,
        attributes=attributes,
        fill_value=fill,
    )


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Keep others from writing: a lock on the folder itself, which ends with the process and leaves no file."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise FileError(f"'{folder}' is being written by another run of its campaign") from None
        except OSError:  # a file system without locks
            pass
        yield
    finally:
        os.close(handle)


@contextmanager
def _telling(folder: Path, mend: str) -> Iterator[None]:
    """Turn what the operating system says of a write into a FileError that says what to do."""
    try:
        yield
    except FileError:
        raise
    except OSError as error:
        raise FileError(f"cannot write '{folder}': {error.strerror or error}; {mend}") from error


def _already(kept: Store) -> str:
    title, there = kept.record["spec"].get("title", "without a title"), kept.rows_there()
    return (
        f"'{kept.path}' holds {there.sum()} of {len(there)} samples of the campaign '{title}'; --resume goes on with "
        "it, or choose another --output"
    )


def _refuse_another(kept: Store, campaign: Campaign) -> None:
    here, there = versions(), kept.versions
    if here != there:
        told = [f"{name} {there.get(name)} there, {here[name]} here" for name in here if here[name] != there.get(name)]
        raise FileError(
            f"'{kept.path}' was computed with other versions ({'; '.join(told)}), which may differ in the last bits; "
            "install those, or choose another --output"
        )
    if campaign.sha256 != kept._attribute("sha256"):
        told = campaign.differences(kept.record)
        listed = "; ".join(told[:5]) + (f"; and {len(told) - 5} more" if told[5:] else "")
        raise FileError(f"'{kept.path}' is of another campaign: {listed}. Choose another --output")
