# SPDX-License-Identifier: Apache-2.0
"""Tasks on a Dask cluster: placed by what they take, run again where a worker died, ended where nobody waits."""

from __future__ import annotations

import contextlib
import dataclasses
import logging
import queue
import tempfile
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import dask
from distributed import Client, Future, KilledWorker, LocalCluster, get_worker
from distributed.system import MEMORY_LIMIT

from pipeprog_bringup.fleet.scratch import scratch_folder
from pipeprog_bringup.fleet.survey import survey
from pipeprog_bringup.fleet.task import Outcome, Runner, Task, Unwanted
from pipeprog_camera.errors import InputError

SLOT, MEMORY = "surveys", "MB"  # resources of a worker: surveys at once, and the memory that they have together
_TOPIC = "pipeprog-fleet"
_POLL_SECONDS = 0.5  # between two looks at how many workers there are
_CONNECT_SECONDS = 30.0  # for the first answer of a scheduler
_PATIENCE_SECONDS = 1800.0  # for one that was there to come back: a machine that starts again takes minutes
_BARE_SECONDS = 60.0  # without a worker on this machine, whose start takes 5 s: Dask has given up starting it
# Deaths of workers that ran a recording and no other before it is given up. Workers that are killed every other time,
# whatever they run, take a healthy one with them ten times in a row once in 1000.
_DEATHS_ALONE = 10
_SPARE = 0.9  # of a machine's memory; the rest is for its system and the worker itself

Tell = Callable[[dict[str, Any]], None]
Connect = Callable[[], AbstractContextManager[Client]]


@contextlib.contextmanager
def local_cluster(cores: int, cores_each: int) -> Iterator[Client]:
    """A cluster on this machine for as long as the context lasts: one worker, with a slot for each `cores_each`.

    Its processes talk over TLS with a key of their own: who reaches a scheduler can run programs as its user.
    """
    slots = max(1, cores // cores_each)
    with (
        scratch_folder() as scratch,
        dask.config.set({"temporary-directory": str(scratch), "distributed.admin.low-level-log-length": 100}),
        _started(slots, scratch) as cluster,
        Client(cluster, set_as_default=False) as client,
    ):
        yield client


def _started(slots: int, scratch: Path) -> LocalCluster:
    """A local cluster whose worker has come up; one that is killed while it starts is started again."""
    for is_last in (False, False, True):
        try:
            return LocalCluster(
                n_workers=1,
                threads_per_worker=slots,
                processes=True,
                resources={SLOT: slots, MEMORY: int(_SPARE * MEMORY_LIMIT / 1e6)},
                memory_limit=0,
                local_directory=str(scratch),
                dashboard_address="127.0.0.1:0",  # without one, Dask serves its state on every interface
                worker_dashboard_address="127.0.0.1:0",
                security=True,
                silence_logs=logging.CRITICAL,
            )
        except RuntimeError as error:
            if is_last:
                raise InputError(f"Dask starts no worker on this machine ({error}): look at its memory") from None
    raise AssertionError("the last try returns or raises")


class RemoteCluster:
    """Contexts of a Dask cluster at an address: the first fails soon, a later one waits for its scheduler to return."""

    def __init__(self, address: str) -> None:
        self._address = address
        self._was_there = False

    @contextlib.contextmanager
    def __call__(self) -> Iterator[Client]:
        """A client; raises InputError where no scheduler answers."""
        for name in ("distributed", "distributed.client"):
            logging.getLogger(name).setLevel(logging.CRITICAL)  # it prints a traceback at each try to connect
        deadline = time.monotonic() + (_PATIENCE_SECONDS if self._was_there else 0.0)
        while True:
            try:
                client = Client(self._address, timeout=_CONNECT_SECONDS, set_as_default=False)
                break
            except (OSError, ValueError) as error:
                if time.monotonic() > deadline or isinstance(error, ValueError):
                    raise InputError(
                        f"--scheduler {self._address}: no Dask scheduler answers ({error}): start one with "
                        "`dask scheduler`, and workers as docs/fleet.md says"
                    ) from None
        self._was_there = True
        with contextlib.closing(client):
            yield client


def run(tasks: Sequence[Task], connect: Connect, runner: Runner, tell: Tell) -> Iterator[Outcome]:
    """The outcome of each task, as they come; `tell` gets the states of the surveys that run.

    A task whose worker died runs again; where that has happened as often as Dask allows (`allowed-failures`, 3), it
    runs at the end with no other beside it. Only the deaths of workers that ran it alone are held against it, and of
    _DEATHS_ALONE it is given up. One that failed otherwise is tried twice. A cluster whose scheduler is lost is
    connected to again, and what is left given to it.
    Raises InputError where the cluster cannot be used.
    """
    left = {task.name: task for task in tasks}
    while left:
        with connect() as client:
            for outcome in _Session(client, list(left.values()), runner, tell).outcomes():
                del left[outcome.name]
                yield outcome
        if left:
            tell({"lost": "the cluster is gone; connecting again"})


class _Session:
    """The tasks on one cluster, until they are done or its scheduler is lost."""

    def __init__(self, client: Client, tasks: Sequence[Task], runner: Runner, tell: Tell) -> None:
        self._client, self._runner, self._tell = client, runner, tell
        self._waiting = deque(tasks)
        self._running: dict[Future, Task] = {}
        self._ended: queue.SimpleQueue[Future] = queue.SimpleQueue()
        self._suspects: deque[Task] = deque()  # their workers have died too often; each is to run alone
        self._deaths: dict[str, int] = {}  # of workers that ran one of them alone
        self._logs: dict[str, str] = {}
        self._staffed = time.monotonic()  # when there was a worker

    def outcomes(self) -> Iterator[Outcome]:
        """Outcomes as they come. No more tasks are with the scheduler than it has slots for.

        With all of them there, those that only wait on a worker would be counted as killed with it.
        """
        self._client.subscribe_topic(_TOPIC, lambda event: self._hear(event[1]))
        try:
            while self._waiting or self._running or self._suspects:
                self._submit(self._offers())
                try:
                    future = self._ended.get(timeout=_POLL_SECONDS)
                except queue.Empty:
                    if self._is_lost():
                        return
                    continue
                task = self._running.pop(future)
                if future.status == "cancelled":  # with the scheduler
                    return
                outcome = self._outcome(future, task)
                future.release()
                if outcome is not None:
                    yield outcome
        finally:
            with contextlib.suppress(OSError, RuntimeError, TimeoutError):
                self._client.cancel(list(self._running))

    def _offers(self) -> list[dict[str, float]]:
        """Resources of each worker."""
        try:
            offers = [worker["resources"] for worker in self._client.scheduler_info()["workers"].values()]
        except (OSError, RuntimeError):  # the connection is just being lost
            return []
        if offers:
            self._staffed = time.monotonic()
        return offers

    def _is_lost(self) -> bool:
        """Whether the cluster will not come back: workers elsewhere may start at any time."""
        is_bare = self._client.cluster is not None and time.monotonic() > self._staffed + _BARE_SECONDS
        return is_bare or self._client.status == "closed"

    def _submit(self, offers: Sequence[dict[str, float]]) -> None:
        """Give the cluster what it has room for."""
        slots = [int(offer.get(SLOT, 0)) for offer in offers]
        if offers and not any(slots):
            raise InputError(
                f"the workers of this cluster offer no '{SLOT}': start them with --resources \"{SLOT}=1 {MEMORY}=8000\""
            )
        room = max((offer[MEMORY] for offer in offers if MEMORY in offer), default=None)
        if self._suspects and not self._waiting and not self._running:
            self._waiting.append(self._suspects.popleft())
            self._deaths.setdefault(self._waiting[0].name, 0)
        while self._waiting and len(self._running) < max(1, sum(slots)):
            task = self._waiting.popleft()
            needed: dict[str, float] = {SLOT: 1}
            if room is not None:
                needed[MEMORY] = min(task.memory, room)  # of a worker that is too small for it, it gets all
            key = f"survey-{task.name}-{time.monotonic_ns()}"  # never that of an earlier try, which may be cancelled
            future = self._client.submit(_on_worker, task, self._runner, key=key, resources=needed, retries=1)
            self._running[future] = task
            future.add_done_callback(self._ended.put)

    def _outcome(self, future: Future, task: Task) -> Outcome | None:
        """What a future came to; None where its task goes back to wait."""
        if future.status == "finished":
            outcome: Outcome | None = future.result()
            if outcome is None:  # unwanted: its worker was closing
                self._waiting.append(task)
            return outcome
        error = future.exception()
        if not isinstance(error, KilledWorker):
            reason, log = getattr(error, "reason", f"{type(error).__name__}: {error}"), getattr(error, "log", "")
            return Outcome(task.name, "failed", reason, log)
        log = self._logs.get(task.name, "")
        if task.name in self._deaths:
            self._deaths[task.name] += error.allowed_failures + 1
        if self._deaths.get(task.name, 0) < _DEATHS_ALONE:
            self._suspects.append(task)
            return None
        reason = f"its worker died {self._deaths[task.name]} times while no other survey ran: does it need more memory?"
        return Outcome(task.name, "failed", reason, log)

    def _hear(self, state: dict[str, Any]) -> None:
        if "log" in state:
            self._logs[state["name"]] = state.pop("log")
        self._tell(state)


@dataclasses.dataclass(frozen=True)
class _OnWorker:
    """Who waits for a survey on a worker of Dask: the client, as long as the task is not cancelled."""

    worker: Any
    key: str
    name: str

    def is_wanted(self) -> bool:
        """False once the task is cancelled, by the client or because that is gone, and where the worker closes."""
        state = self.worker.state.tasks.get(self.key)
        return state is not None and state.state != "cancelled" and self.worker.status.name == "running"

    def tell(self, state: dict[str, Any]) -> None:
        """To the client, by way of the scheduler."""
        self.worker.loop.add_callback(self.worker.log_event, _TOPIC, {"name": self.name, **state})


def _on_worker(task: Task, runner: Runner) -> Outcome | None:
    """A task as a worker runs it: in a folder of the worker's scratch, which Dask removes should the worker die."""
    worker = get_worker()
    watcher = _OnWorker(worker, worker.get_current_task(), task.name)
    with tempfile.TemporaryDirectory(
        prefix="survey-", dir=worker.local_directory, ignore_cleanup_errors=True
    ) as scratch:
        try:
            return survey(task, Path(scratch), runner, watcher)
        except Unwanted:
            return None
        finally:
            watcher.tell({"stage": ""})
