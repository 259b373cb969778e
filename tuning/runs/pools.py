"""Pools that run tasks: this process, other processes of this machine, or a Dask cluster.

A task is a function of a module, called with one item; its result must depend on the item alone, so that place and
order of the tasks do not affect results. Every task outside this process carries the hash of our sources, and a worker
with other sources refuses it, also one that joined later. It also carries the content of the user's files
(`inputs.Input`): a worker opens none of its own.
"""

from __future__ import annotations

import hashlib
import logging
import multiprocessing
import os
import pickle
import re
import signal
import threading
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, TypeVar
from urllib.parse import parse_qsl

from tuning.runs import provenance
from tuning.runs.inputs import forget_copies

Say = Callable[[str], None]
Item = TypeVar("Item")
Result = TypeVar("Result")

AGAIN = "continue with --resume"
CONNECT_TIMEOUT = 10.0  # s, for a scheduler to answer
FIRST_RESULT = "waiting for the first result (a worker that runs for the first time compiles for half a minute)"
# Files of a tls:// address, and their names in Dask's security.
TLS_FILES = {"ca": "tls_ca_file", "cert": "tls_client_cert", "key": "tls_client_key"}
WORKERS_PERIOD = 3.0  # s, between two checks whether a cluster has workers

logger = logging.getLogger(__name__)


class PoolError(RuntimeError):
    """Work could not be done in a pool: one line with its remedy."""


def _silent(_what: str) -> None:
    pass


def _anything(_item: Any, _result: Any) -> bool:
    return True


class Pool:
    """A pool that runs tasks one after the other in this process."""

    width = 1  # approximate number of tasks that run at the same time
    shares_disk = True  # whether tasks can continue from files of this machine

    def unordered(
        self,
        function: Callable[[Item], Result],
        items: Sequence[Item],
        say: Say = _silent,
        fits: Callable[[Item, Result], bool] = _anything,
    ) -> Iterator[tuple[int, Result]]:
        """Yield the number of an item and its result when it is done.

        Args:
            function: Function of a module.
            items: Its arguments.
            say: Called, from any thread, with what the pool waits for; "" when the work continues.
            fits: Whether a result has the form that belongs to an item; other results from workers are refused.

        Raises:
            PoolError: If a worker is lost, or returns an invalid result; the message names the worker.
        """
        return self._unordered(function, items, say, fits)

    def _unordered(self, function: Any, items: Sequence[Any], say: Say, fits: Any) -> Iterator[tuple[int, Any]]:
        for k, item in enumerate(items):
            yield k, function(item)

    def differences(self) -> list[str]:
        """Return a line for each difference of the workers to this process that may change last digits."""
        return []


def in_order(pool: Pool, function: Callable[[Item], Result], items: Sequence[Item]) -> list[Result]:
    """Return the results of all items in their order."""
    found = dict(pool.unordered(function, items))
    return [found[k] for k in range(len(items))]


@contextmanager
def open_pool(workers: int | None = None, cluster: str | None = None, again: str = AGAIN) -> Iterator[Pool]:
    """Open a pool.

    Args:
        workers: Number of processes on this machine; None runs in this process.
        cluster: Address of the scheduler of a running Dask cluster, in the form of `parse_cluster`.
        again: The remedy if work is lost, for messages.

    Raises:
        ValueError: If both are given, for fewer than one worker, or if `distributed` is not installed for a cluster.
        PoolError: If the cluster cannot be reached.
    """
    if workers is not None and cluster is not None:
        raise ValueError("--workers and --cluster exclude each other; choose one")
    if cluster is not None:
        with _cluster(cluster, again) as pool:
            yield pool
    elif workers is not None:
        if workers < 1:
            raise ValueError(f"--workers {workers} is below 1; give the number of processes")
        # Spawned: after threads have run compiled code, a fork may hang.
        context = multiprocessing.get_context("spawn")
        executor = ProcessPoolExecutor(workers, mp_context=context, initializer=_as_worker)
        try:
            yield _Processes(executor, workers, again)
        finally:
            executor.shutdown(wait=True, cancel_futures=True)
    else:
        yield Pool()


class _Processes(Pool):
    def __init__(self, executor: ProcessPoolExecutor, width: int, again: str = AGAIN) -> None:
        self._executor = executor
        self.width = width
        self._again = again

    def _unordered(self, function: Any, items: Sequence[Any], say: Say, fits: Any) -> Iterator[tuple[int, Any]]:
        packed = [pickle.dumps((function, item)) for item in items]
        futures = {self._executor.submit(_checked, provenance.SOURCES, work): k for k, work in enumerate(packed)}
        say(FIRST_RESULT)
        try:
            for future in as_completed(futures):
                k = futures[future]
                result = _result_of(
                    future.result(), packed[k], partial(fits, items[k]), "a worker process", self._again
                )
                say("")
                yield k, result
        except BrokenProcessPool:
            raise PoolError(
                "a worker process ended unexpectedly, perhaps for lack of memory; take fewer --workers and "
                f"{self._again}"
            ) from None


class _Dask(Pool):
    shares_disk = False

    def __init__(self, client: Any, width: int, address: str = "", again: str = AGAIN) -> None:
        self._client = client
        self.width = width
        self._address = address
        self._again = again
        self._told: set[str] = set()

    def _unordered(self, function: Any, items: Sequence[Any], say: Say, fits: Any) -> Iterator[tuple[int, Any]]:
        from concurrent.futures import CancelledError

        from distributed import as_completed as as_completed_there
        from distributed.scheduler import KilledWorker

        packed = [pickle.dumps((function, item)) for item in items]
        # Not pure: equal items of two runs on one cluster must be computed twice, not taken from its memory.
        futures = {
            self._client.submit(pickle.loads, _call(_checked, provenance.SOURCES, work), pure=False): k
            for k, work in enumerate(packed)
        }
        say(FIRST_RESULT)
        try:
            with self._told_of_no_workers(say):
                for future in as_completed_there(list(futures), loop=self._client.loop):
                    k, answer = futures[future], future.result()
                    who = self._holder(future)
                    result = _result_of(answer, packed[k], partial(fits, items[k]), who, self._again)
                    for line in self._unlike(who, answer.versions):
                        logger.warning(line)
                    say("")
                    yield k, result
                    future.release()
        except ImportError as error:
            raise self._without_package(error) from None
        except AttributeError as error:
            if "Can't get attribute" not in str(error):  # pickle's, for a name that its version of our packages lacks
                raise
            raise self._without_package(error) from None
        except KilledWorker as error:
            raise PoolError(f"workers of the cluster ended repeatedly: {error}; {self._again}") from None
        except (CancelledError, OSError) as error:
            raise PoolError(
                f"the connection to the Dask scheduler at {self._address} was lost: start it again, with its workers, "
                f"and {self._again}"
            ) from error

    def _without_package(self, error: Exception, worker: str = "a worker") -> PoolError:
        return PoolError(
            f"{worker} of the cluster at {self._address} cannot run this: {error}; install drive-env where it runs, "
            f"and {self._again}"
        )

    def _holder(self, future: Any) -> str:
        """Return the workers that have a result, according to the scheduler."""
        addresses = self._client.who_has([future]).get(future.key, ())
        return f"worker {', '.join(addresses)}" if addresses else "a worker"

    def _unlike(self, who: str, found: Mapping[str, Any]) -> list[str]:
        """Return a line for each version in which a worker differs from this process, each line only once."""
        here = provenance.versions()
        lines = [
            f"{who} has {name} {version}, here it is {here.get(name)}: last digits may differ"
            for name, version in found.items()
            if here.get(name) != version
        ]
        new = [line for line in lines if line not in self._told]
        self._told.update(new)
        return new

    @contextmanager
    def _told_of_no_workers(self, say: Say) -> Iterator[None]:
        """Report if no worker is left: the run waits for a new one without limit."""
        ended = threading.Event()

        def watch() -> None:
            told = False
            while not ended.wait(WORKERS_PERIOD):
                try:
                    there = self._client.nthreads()
                except Exception:  # the scheduler is gone, which the futures report
                    return
                if not there:
                    say(f"waiting for a worker: `dask worker {self._address}`")
                elif told:
                    say("")
                if not there and not told:
                    logger.warning(
                        "the cluster at %s has no workers left; waiting for one: `dask worker %s`", self._address,
                        self._address,
                    )  # fmt: skip
                told = not there

        thread = threading.Thread(target=watch, daemon=True)
        thread.start()
        try:
            yield
        finally:
            ended.set()

    def differences(self) -> list[str]:
        here, lines = provenance.versions(), []
        there: Mapping[str, Any] = self._client.run(pickle.loads, _call(_versions), on_error="return")
        for address, found in there.items():
            if isinstance(found, Exception):
                raise self._without_package(found, f"worker {address}")
            if not isinstance(found, Mapping) or found.get("sources") != here["sources"]:
                found = found if isinstance(found, Mapping) else {}
                raise PoolError(
                    f"worker {address} has sources {found.get('sources', 'unknown')}, here they are {here['sources']}, "
                    "and results are not mixed: install the same files there and start it again"
                )
            lines += self._unlike(f"worker {address}", found)
        return sorted(lines)


def parse_cluster(text: str) -> tuple[str, dict[str, Any]]:
    """Return the address of a scheduler, and for tls:// the files in `?ca=...&cert=...&key=...`.

    Without these, Dask's own configuration is used (distributed.comm.tls).

    Raises:
        ValueError: For an invalid address, or a missing file.
    """
    address, _, query = text.partition("?")
    if not re.fullmatch(r"[a-z]+://.+:\d+", address):
        raise ValueError(
            f"--cluster {text} must be the address of a Dask scheduler, as tcp://host:port, or "
            f"tls://host:port?{'&'.join(f'{name}=FILE' for name in TLS_FILES)}"
        )
    if not query:
        return address, {}
    given = dict(parse_qsl(query, keep_blank_values=True))
    if not address.startswith("tls://") or set(given) != set(TLS_FILES):
        raise ValueError(
            f"--cluster {text}: after the ? of tls:// stand the files {', '.join(TLS_FILES)}, each with its path, and "
            "of other protocols nothing"
        )
    for name, path in given.items():
        if not Path(path).is_file():
            raise ValueError(f"--cluster {text}: there is no file {path}, which {name} names")
    return address, {"require_encryption": True} | {TLS_FILES[name]: path for name, path in given.items()}


@contextmanager
def _cluster(address: str, again: str) -> Iterator[Pool]:
    try:
        from distributed import Client
    except ImportError:
        raise ValueError('--cluster needs dask.distributed; pip install "drive-env[cluster]"') from None
    address, certificates = parse_cluster(address)
    try:
        client = Client(address, security=certificates or None, timeout=CONNECT_TIMEOUT, set_as_default=False)
    except TypeError:  # Dask's error for tls:// without certificates
        files = "&".join(f"{name}=FILE" for name in TLS_FILES)
        raise PoolError(f"--cluster {address} needs certificates: {address}?{files}") from None
    except (OSError, TimeoutError, ValueError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise PoolError(
            f"no Dask scheduler answers at {address}: {reason}; start one with `dask scheduler`, and workers with "
            "`dask worker`"
        ) from None
    with _quiet_dask(), client:
        threads = client.nthreads()
        if not threads:
            raise PoolError(f"the cluster at {address} has no workers; start some with `dask worker {address}`")
        yield _Dask(client, sum(threads.values()), address, again)


@contextmanager
def _quiet_dask() -> Iterator[None]:
    """Suppress Dask's tracebacks of a lost connection, which PoolError reports in one line."""
    loggers = [logging.getLogger(name) for name in logging.root.manager.loggerDict if name.startswith("distributed")]
    levels = [each.level for each in loggers]
    for each in loggers:
        each.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        for each, level in zip(loggers, levels, strict=True):
            each.setLevel(level)


class _Call:
    """A call that is executed when it is unpickled."""

    def __init__(self, *call: Any) -> None:
        self._call = call

    def __reduce__(self) -> tuple[Any, tuple[Any, ...]]:
        function, *arguments = self._call
        return function, tuple(arguments)


def _call(function: Callable[..., Any], *arguments: Any) -> bytes:
    """Pickle a call so that `pickle.loads` executes it.

    Dask itself unpickles functions of tasks before they run, and a worker without our packages then ends repeatedly,
    without a message to the caller. This one is unpickled within the task, so that its failure is returned.
    """
    return pickle.dumps(_Call(function, *arguments))


class _Answer(NamedTuple):
    """A worker's answer to a task: hash of the work, versions, and the result with its hash."""

    work: str
    versions: Mapping[str, str]
    content: bytes
    hash: str


def _checked(sources: str, work: bytes) -> _Answer:
    """Run a task on a worker, if its sources are those of the process that gives the work.

    The work is unpickled after this check: other sources may not know its names.
    """
    try:
        provenance.check_sources(sources)
    except ValueError as error:
        raise PoolError(str(error)) from None
    try:
        function, item = pickle.loads(work)
    except OSError as error:  # a file of the user cannot be written there
        raise PoolError(f"a worker cannot keep the files of a task: {error}; make room there") from None
    content = pickle.dumps(function(item))
    return _Answer(_sha256(work), provenance.versions(), content, _sha256(content))


def _result_of(answer: Any, work: bytes, fits: Callable[[Any], bool], who: str, again: str) -> Any:
    """Return the result in an answer; PoolError, naming the worker, for an answer that does not fit this work."""
    wrong, result = _wrong_with(answer, work), None
    if not wrong:
        result = pickle.loads(answer.content)
        try:
            good = fits(result)
        except Exception:  # a foreign object may raise anything
            good = False
        wrong = "" if good else f"a result of another form ({type(result).__name__})"
    if wrong:
        raise PoolError(
            f"{who} gave back {wrong}, which is no result of its work and is not used: start it again with the same "
            f"files installed as here, and {again}"
        )
    return result


def _wrong_with(answer: Any, work: bytes) -> str:
    """Describe why an answer does not belong to this work; "" if it does."""
    if not isinstance(answer, _Answer):
        return "nothing" if answer is None else f"a value of type {type(answer).__name__}"
    if answer.versions.get("sources") != provenance.SOURCES:
        return f"a result of sources {answer.versions.get('sources', 'unknown')}"
    if answer.work != _sha256(work):
        return "a result of other work"
    return "" if answer.hash == _sha256(answer.content) else "a result whose content does not match its hash"


def _sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def _versions() -> dict[str, str]:
    """Return the versions of a worker, with the present hash of its sources if they were edited since it started."""
    found, now = provenance.versions(), provenance.hash_of_sources()
    return found if now == found["sources"] else found | {"sources": now}


def _as_worker() -> None:
    """Leave Ctrl-C and warnings to the parent process, and exit when the parent ends for any reason."""
    warnings.simplefilter("ignore")
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        forget_copies()
        # Immediate exit: a thread that waits for an abandoned queue would never end.
        os._exit(1)
