"""Who computes a campaign: this process, several on this machine, or the workers of a Dask cluster.

Each gives chunks back in whatever order they are ready, and keeps in `lost` those that cost workers their lives: that a
process was killed says something of the machine, so that it never becomes a row.
"""

from __future__ import annotations

import json
import logging
import os
import signal
import threading
from collections import Counter, deque
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib import import_module
from multiprocessing import get_context, resource_tracker
from multiprocessing.connection import Connection, wait
from types import FrameType
from typing import Any, Protocol

from ssm_decouple.errors import DecoupleError, FileError, InputError, as_whole
from ssm_decouple.studies.campaign import Campaign, Rows, versions

MOST_WORKERS = 1024
ATTEMPTS = 3  # workers that a chunk may cost
AHEAD = 2  # chunks that a worker of this machine has at a time, so that it need not wait for the next
IN_FLIGHT = 4  # likewise, for each thread of a cluster
PATIENCE = 10.0  # s, for a scheduler to answer
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


class Pool(Protocol):
    """Who computes a campaign.

    Attributes:
        lost: Chunks that could not be computed, and why.
    """

    lost: dict[int, str]

    def results(self, chunks: Sequence[int]) -> Generator[tuple[int, Rows], None, None]:
        """Yield chunks as they are computed; closing it stops the work."""
        ...


Note = Callable[[str], object]


def pool_of(campaign: Campaign, workers: int, scheduler: str | None, note: Note) -> Pool:
    """Return who computes a campaign.

    Args:
        campaign: The campaign.
        workers: Processes; 1 is this one.
        scheduler: Address of a Dask scheduler; its workers compute instead.
        note: Called with lines that a user may want to read.

    Raises:
        InputError: no worker, the package for clusters is not installed, or workers with other versions.
        FileError: no scheduler answers, or it has no worker.
    """
    if scheduler is not None:
        cluster = Cluster(campaign, scheduler)
        note(f"dashboard: {cluster.dashboard}")
        return cluster
    if workers < 1:
        raise InputError(f"workers is {workers}; give at least 1")
    as_whole("workers", workers, 1, "", MOST_WORKERS)
    return Here(campaign) if workers == 1 else Processes(campaign, workers, note)


class Interrupts:
    """Ctrl-C, heeded where nothing is half done: not in the middle of a write, and not lost.

    Zarr writes through an event loop that an interrupt would leave running, and Python drops an interrupt that comes
    while it clears up an object. Where somebody else handles Ctrl-C, that stays so.
    """

    def __init__(self) -> None:
        self._asked, self._held = threading.Event(), False

    def __enter__(self) -> Interrupts:
        usual = signal.getsignal(signal.SIGINT) is signal.default_int_handler
        self._ours = usual and threading.current_thread() is threading.main_thread()
        if self._ours:
            signal.signal(signal.SIGINT, self._remember)
        return self

    def __exit__(self, *_: object) -> None:
        if self._ours:
            signal.signal(signal.SIGINT, signal.default_int_handler)

    @contextmanager
    def held(self) -> Iterator[None]:
        """Hold an interrupt back until the end of the block; raise there whatever came so far."""
        self._held = True
        try:
            yield
        finally:
            self._held = False
        if self._asked.is_set():
            raise KeyboardInterrupt

    def _remember(self, number: int, frame: FrameType | None) -> None:
        self._asked.set()
        if not self._held:
            signal.default_int_handler(number, frame)


class Here:
    """This process."""

    def __init__(self, campaign: Campaign) -> None:
        self.campaign = campaign
        self.lost: dict[int, str] = {}

    def results(self, chunks: Sequence[int]) -> Generator[tuple[int, Rows], None, None]:
        """Yield chunks one after another."""
        for chunk in chunks:
            yield chunk, self.campaign.rows(range(*self.campaign.span(chunk)))


class _Worker:
    """A process and what it has been given."""

    def __init__(self, record: str) -> None:
        context = get_context("spawn")  # a fork would copy the locks of threads that it does not copy
        self.pipe, theirs = context.Pipe()
        self.process = context.Process(target=_serve, args=(theirs, record), daemon=True)
        # Ctrl-C goes to all processes; the first one ends the others, which are born deaf to it.
        resource_tracker.ensure_running()  # its own start would lift the block again
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            with _one_thread_each():
                self.process.start()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
        theirs.close()
        self.given: deque[int] = deque()

    def end(self) -> None:
        self.process.kill()
        self.process.join()
        self.pipe.close()


class Processes:
    """Processes on this machine.

    Args:
        campaign: The campaign.
        workers: How many.
        note: Called with a line for each that dies.
    """

    def __init__(self, campaign: Campaign, workers: int, note: Note) -> None:
        self.campaign, self.workers, self.note = campaign, workers, note
        self.lost: dict[int, str] = {}

    def results(self, chunks: Sequence[int]) -> Generator[tuple[int, Rows], None, None]:
        """Yield chunks as they are computed."""
        todo, attempts, record = deque(chunks), Counter[int](), json.dumps(self.campaign.record)
        workers = [_Worker(record) for _ in range(min(self.workers, len(todo)))]
        try:
            while True:
                for worker in workers:
                    self._feed(worker, todo)
                busy = [worker for worker in workers if worker.given]
                if not busy:
                    break
                ready = wait([worker.pipe for worker in busy])
                for worker in [worker for worker in busy if worker.pipe in ready]:
                    chunk, told = worker.given[0], _received(worker)
                    if isinstance(told, dict):
                        worker.given.popleft()
                        self._feed(worker, todo)
                        yield chunk, told
                        continue
                    # The first of those that it had was its end; the others were not begun.
                    self.note(f"{told}, over chunk {chunk}")
                    attempts[chunk] += 1
                    if attempts[chunk] == ATTEMPTS:
                        self.lost[worker.given.popleft()] = f"{ATTEMPTS} times {told}"
                    todo.extendleft(reversed(worker.given))
                    worker.end()
                    workers.remove(worker)
                    if todo:
                        workers.append(_Worker(record))
        finally:
            for worker in workers:
                worker.end()

    def _feed(self, worker: _Worker, todo: deque[int]) -> None:
        """Give a worker what it lacks."""
        while todo and len(worker.given) < AHEAD:
            worker.given.append(todo.popleft())
            try:
                worker.pipe.send(self.campaign.span(worker.given[-1]))
            except OSError:  # it is dead, which its end of the pipe will tell
                break


def _received(worker: _Worker) -> Rows | str:
    try:
        return worker.pipe.recv()
    except (EOFError, OSError):
        worker.process.join(1.0)
        code = worker.process.exitcode
        cause = f"by signal {-code}, as when memory runs out" if code and code < 0 else f"with status {code}"
        return f"the worker process ended {cause}"


def _serve(pipe: Connection, record: str) -> None:
    """Compute rows until nobody asks any more."""
    try:
        campaign = Campaign(json.loads(record))
        while True:
            pipe.send(campaign.rows(range(*pipe.recv())))
    except (EOFError, BrokenPipeError, ConnectionResetError):
        return
    except Exception as error:
        pipe.send(f"the worker process failed: {type(error).__name__}: {error}")


@contextmanager
def _one_thread_each() -> Iterator[None]:
    """Let processes that are started here use one thread for algebra: their matrices are small."""
    before = {name: os.environ.get(name) for name in _THREADS}
    os.environ.update(dict.fromkeys(_THREADS, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


class Cluster:
    """The workers of a Dask cluster, which need this package and no file of this machine.

    Args:
        campaign: The campaign.
        address: Of the scheduler, such as "tcp://10.0.0.1:8786".

    Attributes:
        dashboard: Address of the scheduler's dashboard.

    Raises:
        InputError: the extra [cluster] is not installed.
        FileError: no scheduler answers, or it has no worker.
    """

    def __init__(self, campaign: Campaign, address: str) -> None:
        try:
            self._distributed: Any = import_module("distributed")
        except ImportError:
            raise InputError("a scheduler needs Dask: pip install 'ssm-decouple[cluster]'") from None
        self.campaign, self.address = campaign, address
        self.lost: dict[int, str] = {}
        logging.getLogger("distributed.client").setLevel(logging.CRITICAL)  # what matters is told here, in one line
        try:
            self.client = self._distributed.Client(address, timeout=PATIENCE, set_as_default=False)
        except (OSError, ValueError, RuntimeError) as error:
            raise FileError(
                f"no scheduler answers at '{address}' within {PATIENCE:g} s ({_first_line(error)}): start one with "
                "'dask scheduler', give its address as tcp://HOST:PORT, and see that this machine may reach it"
            ) from None
        self.dashboard = str(self.client.dashboard_link)
        try:
            self.client.wait_for_workers(1, timeout=PATIENCE)
        except TimeoutError:
            self.client.close()
            raise FileError(
                f"the scheduler at '{address}' has no worker after {PATIENCE:g} s: start some with 'dask worker "
                f"{address}'"
            ) from None

    def results(self, chunks: Sequence[int]) -> Generator[tuple[int, Rows], None, None]:
        """Yield chunks as they are computed."""
        todo, record, flying = deque(chunks), json.dumps(self.campaign.record), dict[Any, int]()
        try:
            while todo or flying:
                room = IN_FLIGHT * max(1, self._threads())
                while todo and len(flying) < room:
                    chunk = todo.popleft()
                    flying[self._submit(chunk, record)] = chunk
                for future in self._finished(list(flying)):
                    chunk = flying.pop(future)
                    rows = self._rows(future, chunk)
                    if rows is not None:
                        yield chunk, rows
        finally:
            self._close(list(flying))

    def _submit(self, chunk: int, record: str) -> Any:
        return self.client.submit(compute, record, versions(), *self.campaign.span(chunk), pure=False)

    def _finished(self, flying: list[Any]) -> list[Any]:
        """Return which are finished, after a second at most."""
        try:
            with self.client.as_current():
                done = self._distributed.wait(flying, timeout=1.0, return_when="FIRST_COMPLETED").done
        except TimeoutError:
            done = []
        self._refuse_silence()
        return list(done)

    def _threads(self) -> int:
        return sum(self.client.nthreads().values())

    def _rows(self, future: Any, chunk: int) -> Rows | None:
        """Return what a worker has computed; None, and the chunk is lost, where workers died over it."""
        try:
            return future.result()
        except DecoupleError:  # the worker refuses
            raise
        except self._distributed.KilledWorker:
            self.lost[chunk] = "several workers died over it, as when memory runs out"
        except ModuleNotFoundError as error:
            raise InputError(f"a worker lacks a package ({error}): install ssm-decouple on all of them") from None
        except Exception as error:
            self._refuse_silence()
            self.lost[chunk] = f"{type(error).__name__}: {_first_line(error)}"
        return None

    def _refuse_silence(self) -> None:
        if self.client.status != "running":
            raise FileError(
                f"the scheduler at '{self.address}' is gone; what is finished is kept: start one again, then --resume "
                "goes on"
            )

    def _close(self, flying: list[Any]) -> None:
        if self.client.status == "running" and flying:
            self.client.cancel(flying)
        self.client.close(timeout=2.0)


_mine = threading.local()  # robots hold scratch memory, so that each thread of a worker has its own


def compute(record: str, wanted: Mapping[str, str], start: int, stop: int) -> Rows:
    """Compute rows on a worker of a cluster.

    Args:
        record: The campaign's, as JSON.
        wanted: Versions of the packages that the campaign is computed with.
        start: First row.
        stop: The one after the last.

    Raises:
        InputError: this worker has other versions.
    """
    here = versions()
    if here != wanted:
        told = [f"{name} {here[name]} instead of {wanted[name]}" for name in here if here[name] != wanted[name]]
        raise InputError(f"a worker has {', '.join(told)}: install the same on all")
    if getattr(_mine, "record", None) != record:
        _mine.campaign, _mine.record = Campaign(json.loads(record)), record
    return _mine.campaign.rows(range(start, stop))


def _first_line(error: BaseException) -> str:
    return (str(error) or type(error).__name__).splitlines()[0]
