"""Where a campaign's results are kept: a Zarr store, written chunk by chunk, each whole or not at all."""

from __future__ import annotations

import fcntl
import json
import os
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr
import zarr
from numpy.typing import NDArray

from ssm_decouple.errors import FileError
from ssm_decouple.studies.campaign import FAILED, Campaign, Rows, versions

if TYPE_CHECKING:
    from zarr import Group

FORMAT, FORMAT_VERSION = "ssm-decouple campaign", 1
DONE = "done"
_AT_A_TIME = 2**20  # samples that are read together where all are
_PARTIAL = "*.partial"  # what a write that is killed leaves behind


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
    """

    title: str
    samples: int
    done: int
    failed: int
    cases: tuple[str, ...]
    protections: tuple[str, ...]
    sha256: str
    versions: Mapping[str, str]

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


class Store:
    """A campaign's results on disk.

    Attributes:
        path: The folder.
    """

    def __init__(self, path: Path, group: Group) -> None:
        self.path = path
        self._group = group
        self._arrays: dict[str, zarr.Array[Any]] = {}

    @classmethod
    def open(cls, path: str | Path) -> Store:
        """Open a store to read it.

        Raises:
            FileError: there is none.
        """
        folder = Path(path)
        group = _group_at(folder)
        if group is None or not _complete(group):
            raise FileError(f"'{folder}' is no campaign's store; 'ssm-decouple campaign run FILE --output' makes one")
        return cls(folder, group)

    @classmethod
    @contextmanager
    def writing(cls, path: str | Path, campaign: Campaign, resume: bool = False) -> Iterator[Store]:
        """Open a store to write into it, made if it is not there; no other process may meanwhile.

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
                group = _group_at(folder)
                if group is None:
                    group = _made(folder, campaign)
                elif not resume and _complete(group) and cls(folder, group).finished().any():
                    raise FileError(_already(cls(folder, group)))
                else:
                    _refuse_another(cls(folder, group), campaign)
                    group = _completed(group, campaign)
                kept = cls(folder, group)
                vars(kept)["campaign"] = campaign
                for leftover in folder.rglob(_PARTIAL):
                    leftover.unlink()
                yield kept

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
        return str(self._group.attrs[name])

    @cached_property
    def _sizes(self) -> tuple[int, int]:
        """Rows, and rows of a chunk."""
        array = self._array("draw")
        return int(array.shape[0]), int(array.chunks[0])

    def _array(self, name: str) -> zarr.Array[Any]:
        if name not in self._arrays:
            found = self._group[name]
            assert isinstance(found, zarr.Array)
            self._arrays[name] = found
        return self._arrays[name]

    def finished(self) -> NDArray[np.bool_]:
        """Return which chunks are there (chunks,)."""
        size, chunk = self._sizes
        there = np.zeros(-(-size // chunk), dtype=bool)
        markers = self.path / DONE / "c"
        if markers.is_dir():  # to list them is quicker than to read a million files of one byte
            there[[int(entry.name) for entry in os.scandir(markers) if entry.name.isdigit()]] = True
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
        """Write a chunk, its marker last.

        Raises:
            FileError: it cannot be written; the store is as if the chunk had not been computed.
        """
        start, stop = self.campaign.span(chunk)
        with _telling(self.path, "what is finished is kept: make room, then --resume goes on"):
            for name, values in rows.items():
                self._array(name)[start:stop] = values
            self._array(DONE)[chunk : chunk + 1] = 1

    def row(self, number: int) -> dict[str, Any]:
        """Return what is stored of one sample.

        Raises:
            FileError: it has not been computed yet.
        """
        if not self.finished()[number // self._sizes[1]]:
            raise FileError(f"sample {number} is not in '{self.path}' yet; --resume goes on with the campaign")
        return {name: self._column(name, slice(number, number + 1))[0] for name in COLUMNS}

    def dataset(self) -> xr.Dataset:
        """Return the store as xarray reads it, lazily."""
        return xr.open_zarr(self.path)

    def status(self) -> Status:
        """Return how far the campaign has come."""
        record, there = self.record, self.rows_there()
        return Status(
            title=str(record["spec"].get("title", "without a title")),
            samples=len(there),
            done=int(there.sum()),
            failed=self._failed(len(there)),
            cases=tuple(case["name"] for case in record["cases"]),
            protections=tuple(record["spec"].get("protections", ("case",))),
            sha256=self._attribute("sha256"),
            versions=self.versions,
        )

    def tallies(self) -> list[Tally]:
        """Return the figures of each case under each protection, of the samples that are there."""
        record, there, found = self.record, self.rows_there(), []
        samples = int(record["spec"]["samples"])
        for start in range(0, len(there), samples):
            part = slice(start, start + samples)
            if there[part].any():
                found.append(self._tally(part, there[part]))
        return found

    def _failed(self, size: int) -> int:
        parts = (slice(start, start + _AT_A_TIME) for start in range(0, size, _AT_A_TIME))
        return sum(int(np.sum(self._column("outcome", part) == FAILED)) for part in parts)

    def _column(self, name: str, part: slice) -> NDArray[Any]:
        return np.asarray(self._array(name)[part])

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


def _group_at(folder: Path) -> Group | None:
    """Return the group of a campaign's store; None where there is nothing yet.

    Raises:
        FileError: there is something else.
    """
    _refuse_file(folder)
    if not folder.exists():
        return None
    if not (folder / "zarr.json").is_file():
        if all(entry.match(_PARTIAL) for entry in folder.iterdir()):
            return None
        raise FileError(f"'{folder}' holds something that is no campaign's store; choose another --output")
    try:
        group = zarr.open_group(folder, mode="r+" if os.access(folder, os.W_OK) else "r")
    except (ValueError, KeyError, TypeError) as error:
        raise FileError(f"'{folder}' is no campaign's store: {error}") from error
    told = group.attrs.get("format"), group.attrs.get("format_version")
    if told[0] != FORMAT:
        raise FileError(f"'{folder}' is a Zarr store but no campaign's; choose another --output")
    if told[1] != FORMAT_VERSION:
        raise FileError(f"'{folder}' has format version {told[1]}, this package reads {FORMAT_VERSION}")
    return group


def _refuse_file(folder: Path) -> None:
    if folder.exists() and not folder.is_dir():
        raise FileError(f"'{folder}' is a file; a campaign's store is a folder: choose another --output")


def _made(folder: Path, campaign: Campaign) -> Group:
    attributes = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "title": campaign.title,
        "spec": campaign.text,
        "sha256": campaign.sha256,
        "versions": json.dumps(versions()),
        "campaign": json.dumps(campaign.record),
    }
    return _completed(zarr.create_group(folder, zarr_format=3, attributes=attributes), campaign)


def _complete(group: Group) -> bool:
    return group.metadata.consolidated_metadata is not None


def _completed(group: Group, campaign: Campaign) -> Group:
    """Make what a store still lacks, its description as a whole last."""
    if _complete(group):
        return group
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
    with warnings.catch_warnings():
        # Not in the format's specification yet, and without it xarray warns whoever opens the store.
        warnings.simplefilter("ignore", UserWarning)
        return zarr.consolidate_metadata(group.store)


def _array_in(
    group: Group,
    name: str,
    shape: tuple[int, ...],
    chunks: tuple[int, ...],
    kind: str,
    dimensions: tuple[str, ...],
    attributes: dict[str, Any],
    fill: Any,
) -> zarr.Array[Any]:
    if name in group:
        found = group[name]
        assert isinstance(found, zarr.Array)
        return found
    return group.create_array(
        name,
        shape=shape,
        chunks=chunks,
        dtype=kind,
        dimension_names=dimensions,
        attributes=attributes,
        fill_value=fill,
        config={"write_empty_chunks": True},  # so that a chunk that is there can be seen to be
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
    status = kept.status()
    return (
        f"'{kept.path}' holds {status.done} of {status.samples} samples of the campaign '{status.title}'; --resume "
        "goes on with it, or choose another --output"
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
