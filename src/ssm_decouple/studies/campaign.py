"""Campaigns: cases crossed with protections and drawn many times over, each sample to be had again alone."""

from __future__ import annotations

import hashlib
import json
import tomllib
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import asdict, dataclass, field, replace
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from ssm_decouple.batch import Batch
from ssm_decouple.control.law import SelectiveLaw
from ssm_decouple.control.schedule import Schedule
from ssm_decouple.errors import (
    DecoupleError,
    DecoupleWarning,
    FileError,
    InputError,
    as_function,
    as_kind,
    as_path,
    as_seed,
    as_whole,
    unknown,
)
from ssm_decouple.model.appendage import Appendage
from ssm_decouple.model.perturb import Tolerances, perturbed
from ssm_decouple.model.robot import Robot
from ssm_decouple.momentum.protection import Protection
from ssm_decouple.settled import Settled, fixed
from ssm_decouple.simulation.dynamic import Dynamic
from ssm_decouple.studies.case import Case, case_of, cases, load_case
from ssm_decouple.studies.schema import LIST, NUMBER, TEXT, check_keys

if TYPE_CHECKING:
    import xarray as xr

Floats = NDArray[np.float64]
Rows = dict[str, NDArray[Any]]  # a column's name to its values, a row a sample

FAILED = "failed"  # the outcome of a sample that could not be computed
OWN = "case"  # the protection that is the case's own
CHUNK = 500  # samples, where a campaign does not say
MOST_SAMPLES = 10**10  # rows in all: years of computing
MOST_IN_CHUNK = 10**6  # samples, which take a gigabyte while they are computed
MOST_CHUNKS = 10**6  # each a few files

_NAMES = "a list of names, such as ['case1']"
_SPREAD = "a table of one entry, such as { uniform = .. }"
# Key, what it must be, and whether it has to be there; a distribution is looked at on its own.
_TOP: dict[str, tuple[str, bool]] = {
    "title": (TEXT, False),
    "seed": (NUMBER, True),
    "samples": (NUMBER, True),
    "chunk": (NUMBER, False),
}
_TOLERANCES = dict.fromkeys(("mass", "inertia", "centre_of_mass", "mount", "length"), (NUMBER, False))


@dataclass(frozen=True)
class _Quantity:
    """Something that can be drawn.

    Attributes:
        stream: Which of a sample's random streams it draws from; the numbers of one do not depend on the others.
        kinds: The distributions that it takes.
        per_axis: Whether widths may differ by axis: 3 numbers instead of one.
        least: The smallest value that makes sense, of a quantity drawn from a range.
    """

    stream: int
    kinds: tuple[str, ...]
    per_axis: bool = False
    least: float = 0.0


_ABOUT, _RANGE = ("uniform", "normal"), ("uniform", "log_uniform", "choice")
_QUANTITIES: dict[str, dict[str, _Quantity]] = {
    "start": {
        "joints_deg": _Quantity(0, _ABOUT),
        "base_rpy_deg": _Quantity(1, _ABOUT, per_axis=True),
    },
    "target": {"position": _Quantity(2, (*_ABOUT, "ball"), per_axis=True)},
    "law": {
        "gain": _Quantity(3, _RANGE, least=np.nextafter(0.0, 1.0)),
        "damping": _Quantity(4, _RANGE),
    },
    "dynamic": {"feedback_gain": _Quantity(5, _RANGE)},
}
_PLANT = 6  # the stream of the plants' seeds


@dataclass(frozen=True)
class Drawn:
    """What one sample of a case has drawn, or has of its case where nothing is drawn.

    Attributes:
        draw: The number of the sample; the same number draws the same under each protection and in each case.
        joints: Start joint positions (n,), rad or m.
        base_rpy: Start roll, pitch and yaw of the base (3,), rad.
        target: Position (3,), m, inertial axes; not numbers where the case has tasks with targets of their own.
        gain: k_p, 1/s; None is the case's own.
        damping: rho at a singularity, m2; None is the case's own.
        feedback_gain: K, 1/s; None is the case's own.
        plant_seed: Of `perturbed`; None where the plant is the model.
    """

    draw: int
    joints: Floats
    base_rpy: Floats
    target: Floats
    gain: float | None
    damping: float | None
    feedback_gain: float | None
    plant_seed: int | None

    @property
    def law(self) -> dict[str, float]:
        """What of the law is drawn."""
        return {name: value for name in ("gain", "damping") if (value := getattr(self, name)) is not None}


@dataclass
class Campaign(Settled):
    """Cases crossed with protections, each combination sampled many times.

    Rows are numbered case by case, protection by protection, sample by sample. All that a row rests on is the record:
    plain types that hold the specification, the case files and the robots, so that a store is all that is needed to
    compute one of its rows again.

    Attributes:
        record: {"spec": .., "cases": [{"name", "content", "robot"}, ..]}.
        text: The specification as it was written.
        cases: The cases, their robots loaded.

    Raises:
        InputError: a case cannot be run as the campaign wants it.
    """

    record: Mapping[str, Any]
    text: str = ""
    cases: tuple[Case, ...] = field(init=False)

    def __post_init__(self) -> None:
        self.record = fixed(as_kind("record", self.record, Mapping, "read a campaign with Campaign.load(..)"))  # type: ignore[type-abstract]
        self.cases = tuple(_rebuilt(told) for told in self.record["cases"])
        for case in self.cases:
            self._refuse_unfit(case)
        self._joints = {case.name: case.robot.joint_positions(case.start()) for case in self.cases}
        self._engines: dict[tuple[str, str], Batch | None] = {}

    @classmethod
    def load(cls, path: str | Path) -> Campaign:
        """Read a campaign from a TOML file.

        Args:
            path: The file. Case files named in it are taken relative to it.

        Raises:
            InputError: no such file, not TOML, an unknown key (the nearest known one is named), a missing key, a value
                that makes no sense, or a case that cannot be run.
        """
        source = as_path("campaign", path)
        try:
            text = source.read_text(encoding="utf-8")
            spec = tomllib.loads(text)
        except OSError as error:
            raise InputError(f"cannot read the campaign '{path}': {error.strerror or error}") from error
        except (ValueError, RecursionError) as error:  # not UTF-8, a number of thousands of digits, tables without end
            raise InputError(f"'{path}' is not TOML: {error}") from error
        try:
            _validate(spec)
            told = [_told(name, source.parent) for name in spec["cases"]]
            twice = {one["name"] for one in told if [other["name"] for other in told].count(one["name"]) > 1}
            if twice:
                raise InputError(f"two cases are called {', '.join(sorted(twice))}; rename one of the files")
            return cls({"spec": spec, "cases": told}, text)
        except DecoupleError as error:
            raise InputError(f"campaign '{path}': {error}") from error

    @property
    def spec(self) -> Mapping[str, Any]:
        """The specification, as TOML has it."""
        return self.record["spec"]

    @property
    def title(self) -> str:
        """One line for tables."""
        return str(self.spec.get("title", "without a title"))

    @property
    def protections(self) -> tuple[str, ...]:
        """The words of the protections."""
        return tuple(self.spec.get("protections", (OWN,)))

    @property
    def samples(self) -> int:
        """Samples of each combination of a case and a protection."""
        return int(self.spec["samples"])

    @property
    def size(self) -> int:
        """Number of rows in all."""
        return self.samples * len(self.cases) * len(self.protections)

    @property
    def most_joints(self) -> int:
        """Joints of the robot that has most."""
        return max(case.robot.n_joints for case in self.cases)

    @property
    def chunk(self) -> int:
        """Samples that are computed and written together."""
        return int(self.spec.get("chunk", CHUNK))

    @property
    def chunks(self) -> int:
        """Number of chunks."""
        return -(-self.size // self.chunk)

    def span(self, chunk: int) -> tuple[int, int]:
        """Return the first row of a chunk and the one after its last."""
        return chunk * self.chunk, min((chunk + 1) * self.chunk, self.size)

    @property
    def sha256(self) -> str:
        """Hash of the record: of all that the rows rest on, but for the versions of the packages."""
        return hashlib.sha256(json.dumps(self.record, sort_keys=True).encode()).hexdigest()

    def place(self, row: int) -> tuple[Case, str, int]:
        """Return case, protection and sample number of a row.

        Raises:
            InputError: no such row.
        """
        if as_whole("sample", row, -1) not in range(self.size):
            raise InputError(f"there is no sample {row}: they are numbered from 0 to {self.size - 1}")
        combination, draw = divmod(row, self.samples)
        case, protection = divmod(combination, len(self.protections))
        return self.cases[case], self.protections[protection], draw

    def drawn(self, case: Case, draw: int) -> Drawn:
        """Return what a sample draws."""

        def take(table: str, key: str, count: int = 0) -> Any:
            given = self.spec.get(table, {}).get(key)
            return None if given is None else _take(given, self._stream(draw, _QUANTITIES[table][key].stream), count)

        robot = case.robot
        joints = self._joints[case.name]
        turned = take("start", "joints_deg", robot.n_joints)
        if turned is not None:
            joints = joints + np.where(_sliding(robot), 0.0, np.deg2rad(turned))
        base_rpy, target = np.array(case.base_rpy), np.full(3, np.nan)
        tilted = take("start", "base_rpy_deg", 3)
        if tilted is not None:
            base_rpy = base_rpy + np.deg2rad(tilted)
        if not case.law.get("tasks"):
            moved = take("target", "position", 3)
            target = np.array(case.target, dtype=float) + (0.0 if moved is None else moved)
        seed = int(self._stream(draw, _PLANT).integers(2**32)) if self.spec.get("plant") else None
        scalars = (take("law", "gain"), take("law", "damping"), take("dynamic", "feedback_gain"))
        return Drawn(draw, joints, base_rpy, target, *scalars, seed)

    def variant(self, case: Case, drawn: Drawn) -> Case:
        """Return the case as a sample has it: `variant(..).run(protection)` is its motion."""
        simulation, method = dict(case.simulation), case.simulation.get("method")
        if isinstance(method, Dynamic):
            if drawn.feedback_gain is not None:
                method = replace(method, feedback_gain=drawn.feedback_gain)
            if drawn.plant_seed is not None:
                plant = perturbed(case.robot, Tolerances(**self.spec["plant"]), drawn.plant_seed)
                method = replace(method, plant=plant)
            simulation["method"] = method
        changed = replace(
            case,
            joints=drawn.joints,
            base_rpy=tuple(drawn.base_rpy.tolist()),
            target=case.target if case.law.get("tasks") else tuple(drawn.target.tolist()),
            law={**case.law, **drawn.law},
            simulation=simulation,
        )
        return _with_robot(changed, case.robot)

    def motion(self, row: int) -> xr.Dataset:
        """Return the whole motion of a sample, by `Case.run`.

        Raises:
            InputError: no such row.
            DecoupleError: the sample cannot be computed.
        """
        case, protection, draw = self.place(row)
        return self.variant(case, self.drawn(case, draw)).run(_protection(protection))

    def rows(self, numbers: Iterable[int]) -> Rows:
        """Compute samples. A row depends on its number alone, not on those that are computed beside it.

        Where the batch engine does what case and protection ask for, it computes all samples of one law together;
        the others go through `Case.run`.

        Args:
            numbers: Which.

        Returns:
            The columns of `store.COLUMNS`.
        """
        places = [self.place(number) for number in numbers]
        found = _blank(len(places), self.most_joints)
        groups: dict[tuple[str, str, float | None, float | None], list[tuple[int, Case, Drawn]]] = {}
        for at, (case, protection, draw) in enumerate(places):
            drawn = self.drawn(case, draw)
            groups.setdefault((case.name, protection, drawn.gain, drawn.damping), []).append((at, case, drawn))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DecoupleWarning)  # of a target out of reach, thousands of times
            for (_, protection, *_), members in groups.items():
                law, engine = self._law(members[0], protection), self._engine_of(members[0][1], protection)
                _fill(found, protection, members, law)
                if engine is None:
                    for at, case, drawn in members:
                        _run_alone(found, at, self.variant(case, drawn), protection)
                else:
                    _run_together(found, members, law, engine)
        return found

    def run(
        self,
        store: str | Path,
        *,
        workers: int = 1,
        scheduler: str | None = None,
        resume: bool = False,
        progress: Callable[[int, int], object] | None = None,
        note: Callable[[str], object] | None = None,
    ) -> xr.Dataset:
        """Compute every sample that a store does not hold yet, or not whole, chunk by chunk.

        Args:
            store: Folder of the Zarr store.
            workers: Processes; 1 computes in this one. With more, a script needs `if __name__ == "__main__":`.
            scheduler: Address of a Dask scheduler, whose workers compute instead.
            resume: Go on with a store that is there.
            progress: Called after each chunk with the number of samples that are there, and of all.
            note: Called with lines that a user may want to read: a cluster's dashboard, a worker that died, what of
                the store was damaged and is made again.

        Returns:
            The store, opened by xarray.

        Raises:
            FileError: the store cannot be written, is there already, is of another campaign or another version, or is
                in use; or samples are left because worker processes died over them, or the scheduler went away.
            InputError: no worker, or a worker with other versions of the packages.
            KeyboardInterrupt: Ctrl-C; chunks that were finished stay.
        """
        from ssm_decouple.studies.store import Store
        from ssm_decouple.studies.workers import Interrupts, pool_of

        as_function("progress", progress)
        as_function("note", note)
        with ExitStack() as open_things:
            interrupts = open_things.enter_context(Interrupts())
            with interrupts.held():
                kept = open_things.enter_context(Store.writing(store, self, resume))
                todo, there = kept.missing(), kept.samples_done
            note = note or (lambda _: None)
            for fault in kept.mended:
                note(f"damaged, and made again: {fault}")
            pool = pool_of(self, workers, scheduler, note)
            if progress is not None:
                progress(there, self.size)
            results = open_things.enter_context(closing(pool.results(todo)))
            for chunk, rows in results:
                with interrupts.held():
                    kept.write(chunk, rows)
                there += len(rows["draw"])
                if progress is not None:
                    progress(there, self.size)
            if pool.lost:
                raise FileError(_lost(self, pool.lost, kept.path))
        return Store.open(store).dataset()

    def differences(self, record: Mapping[str, Any]) -> list[str]:
        """Say in words how the record of another campaign, which "is there", differs from this one's."""
        there, here = _flat(record["spec"], ""), _flat(self.record["spec"], "")
        for told, flat in ((record, there), (self.record, here)):
            for case in told["cases"]:
                flat |= _flat(case["content"], f"{case['name']}: ")
                flat[f"{case['name']}: URDF"] = hashlib.sha256(json.dumps(case["robot"]).encode()).hexdigest()[:12]
        return [
            f"{key} is {there.get(key, 'not given')} there, {here.get(key, 'not given')} here"
            for key in sorted(there.keys() | here.keys())
            if there.get(key) != here.get(key)
        ]

    def _stream(self, draw: int, quantity: int) -> np.random.Generator:
        return np.random.default_rng(np.random.SeedSequence(int(self.spec["seed"]), spawn_key=(draw, quantity)))

    def _engine_of(self, case: Case, protection: str) -> Batch | None:
        """Return the batch engine of a case under a protection; None where it does not do what they ask for."""
        key = case.name, protection
        if key not in self._engines:
            self._engines[key] = _engine(case, _protection(protection))
        return self._engines[key]

    def _law(self, member: tuple[int, Case, Drawn], protection: str) -> SelectiveLaw:
        _, case, drawn = member
        return _with_robot(replace(case, law={**case.law, **drawn.law}), case.robot).make_law(_protection(protection))

    def _refuse_unfit(self, case: Case) -> None:
        """Refuse a case that the campaign's distributions do not fit, or that makes no law under a protection."""
        dynamic = isinstance(case.simulation.get("method"), Dynamic)
        for table in ("plant", "dynamic"):
            if self.spec.get(table) and not dynamic:
                raise InputError(
                    f"case '{case.name}' is kinematic, and [{table}] needs the equations of motion: copy its file, put "
                    'method = "dynamic" under [simulation] there, and name the copy in cases'
                )
        if self.spec.get("target") and case.law.get("tasks"):
            raise InputError(f"case '{case.name}' has tasks with targets of their own: [target] cannot move them")
        for word in self.protections:
            try:
                case.start()
                case.make_law(_protection(word))
            except InputError as error:
                raise InputError(f"case '{case.name}', protection '{word}': {error}") from error


_RESULTS = (
    "outcome",
    "outcome_time",
    "final_error",
    "joint_travel",
    "peak_rate",
    "protected_rate",
    "base_rotation",
    "smallest_singular_value",
)
_NOT_FINITE = "the motion ends in numbers that are not finite"


def versions() -> dict[str, str]:
    """Return the versions of the packages whose arithmetic the results come from; llvmlite is the compiler."""
    return {name: metadata.version(name) for name in ("ssm-decouple", "pin", "numpy", "llvmlite")}


def results_of(motion: xr.Dataset) -> dict[str, Any]:
    """Return of a motion what a store keeps of it, by column."""
    rates, time = motion.joint_rates.values, motion.time.values
    protected = motion.protected_rate.values
    if "protection_share" in motion:  # of a schedule: while a direction is protected
        protected = np.where(motion.protection_share.values == 1.0, protected, 0.0)
    return {
        "outcome": motion.attrs["outcome"],
        "outcome_time": motion.attrs["outcome_time"],
        "final_error": motion.attrs["final_error"],
        "joint_travel": np.sum(np.linalg.norm(rates, axis=1)[:-1] * np.diff(time)),
        "peak_rate": np.abs(rates).max(),
        "protected_rate": np.abs(protected).max(initial=0.0),
        "base_rotation": np.ptp(motion.base_rpy.values, axis=0),
        "smallest_singular_value": motion.smallest_singular_value.values.min(),
    }


def _run_together(found: Rows, members: Sequence[tuple[int, Case, Drawn]], law: SelectiveLaw, engine: Batch) -> None:
    """Have the batch engine move samples of one case under one law."""
    case, at = members[0][1], np.array([place for place, _, _ in members])
    base = np.array(case.base_position)
    starts = [
        case.robot.configuration(drawn.joints, pin.SE3(pin.rpy.rpyToMatrix(*drawn.base_rpy), base))
        for _, _, drawn in members
    ]
    targets = np.array([drawn.target for _, _, drawn in members])
    tolerance = case.simulation.get("arrival_tolerance", 0.01)
    motions = engine.motions(law, np.array(starts), targets, case.duration, case.dt, tolerance)
    for name in _RESULTS:
        found[name][at] = getattr(motions, name)
    lost = at[motions.outcome == "undefined"]
    found["outcome"][lost], found["error"][lost] = FAILED, _NOT_FINITE


def _run_alone(found: Rows, at: int, case: Case, protection: str) -> None:
    """Simulate a sample; where that cannot be done, its row tells why."""
    try:
        results = results_of(case.run(_protection(protection)))
        if not np.isfinite(results["final_error"]):
            raise ArithmeticError(_NOT_FINITE)
    except MemoryError:  # says something of the machine, not of the sample
        raise
    except Exception as error:
        told = str(error) if isinstance(error, DecoupleError) else f"{type(error).__name__}: {error}"
        found["outcome"][at], found["error"][at] = FAILED, " ".join(told.split())
        return
    for name, value in results.items():
        found[name][at] = value


def _blank(count: int, joints: int) -> Rows:
    """Return rows in which nothing is known yet."""
    from ssm_decouple.studies.store import COLUMNS

    found: Rows = {}
    for name, column in COLUMNS.items():
        shape = (count, *(joints if dimension == "joint" else 3 for dimension in column.dimensions))
        found[name] = np.full(shape, column.unknown, dtype=object if column.kind == "string" else column.kind)
    return found


def _fill(found: Rows, protection: str, members: Sequence[tuple[int, Case, Drawn]], law: SelectiveLaw) -> None:
    """Write what samples of one law have drawn."""
    for at, case, drawn in members:
        found["case"][at], found["protection"][at], found["draw"][at] = case.name, protection, drawn.draw
        found["k"][at] = law.directions[0].shape[1]
        found["start_joints"][at, : len(drawn.joints)] = drawn.joints
        found["start_rpy"][at], found["target"][at] = drawn.base_rpy, drawn.target
        found["gain"][at], found["damping"][at] = law.gain, law.damping
        method = case.simulation.get("method")
        own = method.feedback_gain if isinstance(method, Dynamic) else 0.0
        found["feedback_gain"][at] = own if drawn.feedback_gain is None else drawn.feedback_gain
        found["plant_seed"][at] = -1 if drawn.plant_seed is None else drawn.plant_seed


def _engine(case: Case, protection: Protection | Schedule | None) -> Batch | None:
    if case.simulation.get("method", "explicit") != "explicit" or case.simulation.get("smooth_start"):
        return None
    try:
        engine = Batch(case.robot, threads=1)
        engine.step(case.make_law(protection), case.start(), case.target)
    except InputError:  # the engine says what it does not do
        return None
    return engine


def _protection(word: str) -> Protection | None:
    return None if word == OWN else Protection.parse(word)


def _sliding(robot: Robot) -> NDArray[np.bool_]:
    return np.array([joint.shortname().startswith("JointModelP") for joint in list(robot.model.joints)[2:]])


def _with_robot(case: Case, robot: Robot) -> Case:
    vars(case)["robot"] = robot  # what `Case.robot` would load from a file that may not be here
    return case


def _told(name: str, folder: Path) -> dict[str, Any]:
    """Return a case and its robot in plain types."""
    path = cases().get(name, folder / Path(name).expanduser())
    case = load_case(path)
    robot = case.robot
    return {
        "name": case.name,
        "content": tomllib.loads(path.read_text(encoding="utf-8")),
        "robot": {
            "urdf": robot.urdf,
            "name": robot.name,
            "end_effector": robot.end_effector,
            "appendages": [asdict(appendage) for appendage in robot.appendages],
        },
    }


def _rebuilt(told: Mapping[str, Any]) -> Case:
    """Return the case that `_told` has told."""
    robot = dict(told["robot"])
    robot["appendages"] = [Appendage(**appendage) for appendage in robot["appendages"]]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DecoupleWarning)  # told when the case was read
        return _with_robot(case_of(dict(told["content"]), Path(f"{told['name']}.toml")), Robot(**robot))


def _take(given: Mapping[str, Any], rng: np.random.Generator, count: int) -> Any:
    """Draw from a distribution: `count` numbers about zero, or with 0 one number from a range."""
    ((kind, values),) = given.items()
    if count == 0:
        if kind == "choice":
            return float(values[int(rng.integers(len(values)))])
        low, high = np.log(values) if kind == "log_uniform" else values
        drawn = float(rng.uniform(low, high))
        return float(np.clip(np.exp(drawn), *values)) if kind == "log_uniform" else drawn
    if kind == "ball":
        direction = rng.standard_normal(3)
        return values * rng.uniform() ** (1 / 3) * direction / np.linalg.norm(direction)
    return np.array(values) * (rng.uniform(-1, 1, count) if kind == "uniform" else rng.standard_normal(count))


def _validate(spec: Mapping[str, Any]) -> None:
    known = [*_TOP, "cases", "protections", *_QUANTITIES, "plant"]
    for key, value in spec.items():
        if key not in known:
            raise InputError(unknown("key", key, known))
        if key in (*_QUANTITIES, "plant") and not isinstance(value, dict):
            raise InputError(f"'{key}' must be a table: write [{key}] on a line of its own")
    check_keys({key: spec[key] for key in _TOP if key in spec}, _TOP, "")
    as_seed("seed", spec["seed"])
    for key in spec.keys() & {"samples", "chunk"}:
        if not (isinstance(spec[key], int) and spec[key] > 0):
            raise InputError(f"{key} is {spec[key]!r}; it must be a whole number above 0")
    chunk = spec.get("chunk", CHUNK)
    if chunk > MOST_IN_CHUNK:
        raise InputError(f"chunk is {chunk}; a chunk is computed in memory, and holds {MOST_IN_CHUNK} samples at most")
    _check_names(spec, "cases")
    if "protections" in spec:
        _check_names(spec, "protections")
        for word in spec["protections"]:
            _protection(word)
    rows = spec["samples"] * len(spec["cases"]) * len(spec.get("protections", (OWN,)))
    if rows > MOST_SAMPLES:
        raise InputError(f"samples is {spec['samples']}: more than {MOST_SAMPLES:g} rows in all; take fewer")
    if rows > MOST_CHUNKS * chunk:
        raise InputError(f"samples is {spec['samples']}: {rows // chunk} chunks; give a chunk more than {chunk}")
    for table, quantities in _QUANTITIES.items():
        for key, given in spec.get(table, {}).items():
            if key not in quantities:
                raise InputError(f"[{table}] {unknown('key', key, list(quantities))}")
            _check_spread(f"[{table}] {key}", given, quantities[key])
    plant = spec.get("plant", {})
    check_keys(plant, _TOLERANCES, "[plant] ")
    Tolerances(**plant)


def _check_names(spec: Mapping[str, Any], key: str) -> None:
    given = spec.get(key)
    if given is None:
        raise InputError(f"{key} is missing")
    if not isinstance(given, list) or not given or not all(isinstance(word, str) for word in given):
        raise InputError(f"{key} is {given!r}; it must be {_NAMES}")
    if len(set(given)) < len(given):
        raise InputError(f"{key} {given} name one twice")


def _check_spread(place: str, given: Any, quantity: _Quantity) -> None:
    if not isinstance(given, dict) or len(given) != 1:
        raise InputError(f"{place} is {given!r}; it must be {_SPREAD}")
    ((kind, values),) = given.items()
    if kind not in quantity.kinds:
        raise InputError(f"{place}: {unknown('distribution', kind, list(quantity.kinds))}")
    if quantity.kinds is _RANGE:
        _check_range(place, kind, values, quantity.least)
        return
    wanted = NUMBER if isinstance(values, int | float) or not quantity.per_axis or kind == "ball" else LIST
    check_keys({kind: values}, {kind: (wanted, True)}, f"{place}: ")
    widths = np.array(values, dtype=float)
    if widths.shape not in ((), (3,)) or not np.all(np.isfinite(widths) & (widths >= 0)):
        three = ", or 3 of them" if quantity.per_axis and kind != "ball" else ""
        raise InputError(f"{place}: {kind} is {values!r}; it must be zero or a positive number{three}")


def _check_range(place: str, kind: str, values: Any, least: float) -> None:
    check_keys({kind: values}, {kind: (LIST, True)}, f"{place}: ")
    numbers = np.array(values, dtype=float)
    sign = "above zero" if least > 0 or kind == "log_uniform" else "zero or above"
    floor = np.nextafter(0.0, 1.0) if kind == "log_uniform" else least
    if kind == "choice" and not numbers.size:
        raise InputError(f"{place}: choice is empty; give the numbers to choose from")
    if kind != "choice" and (numbers.shape != (2,) or numbers[0] > numbers[1]):
        raise InputError(f"{place}: {kind} is {values!r}; it must be [lowest, highest]")
    if not np.all(np.isfinite(numbers) & (numbers >= floor)):
        raise InputError(f"{place}: {kind} is {values!r}; the numbers must be {sign}")


def _flat(content: Any, place: str) -> dict[str, Any]:
    """Return a nested table as one of dotted keys."""
    if not isinstance(content, dict):
        return {place: content}
    flat: dict[str, Any] = {}
    for key, value in content.items():
        joined = f"{place}.{key}" if place and not place.endswith(" ") else f"{place}{key}"
        flat |= _flat(value, joined)
    return flat


def _lost(campaign: Campaign, lost: Mapping[int, str], path: Path) -> str:
    first = min(lost)
    start, stop = campaign.span(first)
    more = f" and {len(lost) - 1} more chunks" if lost.keys() - {first} else ""
    return (
        f"chunk {first} (samples {start} to {stop - 1}){more} could not be computed: {lost[first]}. All others are in "
        f"'{path}'; with less at a time (--workers) or more memory, --resume tries again, and 'ssm-decouple campaign "
        f"rerun {path} SAMPLE' computes one alone"
    )
