"""A Python process that makes one call after the other. If it dies, only its call is lost."""

import os
import pickle
import queue
import subprocess
import sys
import threading
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from time import sleep
from typing import IO, Any, TypeVar

from torchdeform.errors import ComputationError

T = TypeVar("T")

_STARTS = 3  # attempts to start a process
_OOM_SCORE = 500  # of 1000: with it Linux kills a worker before other processes when memory runs out
_READY = "ready"


class EngineError(ComputationError):
    """No pair can run here, whatever the pair."""


class WorkerLost(ComputationError):
    """The process of a call ended before it had an answer."""


class TimeLimit(ComputationError):
    """A call took too long and its process was killed."""


class Worker:
    """A process that makes calls. It starts with the first call, and again after it was lost.

    Args:
        environment: variables set for it before anything is imported.

    Notes:
        It is no process of `multiprocessing`: it does not import the caller's main module, so scripts need no guard,
        and libraries that read the environment when they are imported find it set.
        It ends by itself, even in the middle of a call, as soon as the caller's process is gone.
    """

    def __init__(self, environment: Mapping[str, str] | None = None) -> None:
        self._environment = dict(environment or {})
        self._process: subprocess.Popen[bytes] | None = None
        self._stopped = False

    def call(self, function: Callable[..., T], *args: object, timeout: float | None = None) -> T:
        """Return ``function(*args)``; function, arguments and answer must allow pickling.

        Args:
            function: of a module that can be imported.
            args: its arguments.
            timeout: seconds after which the process is killed, without its start.

        Raises:
            WorkerLost: the process ended.
            TimeLimit: the call took too long.
            EngineError: no process can be started.
            Exception: what the function raised.
        """
        process = self._running()
        expired, timer = self._limit(process, timeout)
        try:
            answer = _exchange(process, (function, args))
        except (EOFError, OSError, pickle.UnpicklingError) as error:
            raise self._loss(process, timeout if expired.is_set() else None) from error
        finally:
            timer.cancel()
            timer.join()
            if expired.is_set():  # the answer may have come just before
                self._process = None
        value, raised = answer
        if raised is not None:
            raise raised
        return value

    def stop(self) -> None:
        """Kill the process and start no other."""
        self._stopped = True
        if self._process is not None:
            self._process.kill()
            self._reap(self._process)

    def _running(self) -> subprocess.Popen[bytes]:
        if self._process is None or self._process.poll() is not None:
            self._process = self._start()
        return self._process

    def _start(self) -> subprocess.Popen[bytes]:
        for attempt in range(_STARTS):
            sleep(attempt)
            if self._stopped:
                break
            process = _launch(self._environment)
            with suppress(EOFError, OSError, pickle.UnpicklingError):
                if _receive(process) == _READY:
                    return process
            process.kill()
            self._reap(process)
        raise EngineError("worker processes do not start here; see their messages above or in the worker's log")

    @staticmethod
    def _limit(process: subprocess.Popen[bytes], timeout: float | None) -> tuple[threading.Event, threading.Timer]:
        """Return an event that is set when the time is over, and the running timer that sets it and kills."""
        expired = threading.Event()

        def expire() -> None:
            expired.set()
            process.kill()

        timer = threading.Timer(threading.TIMEOUT_MAX if timeout is None else timeout, expire)
        timer.daemon = True
        timer.start()
        return expired, timer

    def _loss(self, process: subprocess.Popen[bytes], timeout: float | None) -> ComputationError:
        process.kill()
        self._reap(process)
        self._process = None
        if timeout is not None:
            return TimeLimit(f"it was stopped after {timeout:g} seconds; raise engine.timeout if it needs more")
        return WorkerLost(_exit_reason(process.returncode))

    @staticmethod
    def _reap(process: subprocess.Popen[bytes]) -> None:
        process.wait()
        for pipe in (process.stdin, process.stdout):
            with suppress(OSError):
                if pipe is not None:
                    pipe.close()


def _exit_reason(code: int) -> str:
    """Return why a process ended, as far as its exit code says."""
    if code == -9:
        return (
            "its process was killed from outside, most likely because memory ran out; "
            "set memory, or fewer workers, and retry"
        )
    if code < 0:
        return f"its process crashed with signal {-code}; see its log, and report it"
    return f"its process ended with exit code {code} during the call; see its log, and report it"


def _launch(environment: Mapping[str, str]) -> subprocess.Popen[bytes]:
    """Start a process with the same import path, in its own session so that Ctrl-C reaches only the caller."""
    code = f"import sys; sys.path[:] = {sys.path!r}; from {__name__} import serve; serve()"
    return subprocess.Popen(
        [sys.executable, "-c", code],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env={**os.environ, **environment},
        start_new_session=True,
    )


def _exchange(process: subprocess.Popen[bytes], message: object) -> Any:
    if process.stdin is None:
        raise EOFError
    pickle.dump(message, process.stdin)
    process.stdin.flush()
    return _receive(process)


def _receive(process: subprocess.Popen[bytes]) -> Any:
    if process.stdout is None:
        raise EOFError
    return pickle.load(process.stdout)


def serve() -> None:
    """Make the calls read from stdin and answer on stdout until stdin ends. Everything printed goes to stderr."""
    calls: queue.SimpleQueue[tuple[Callable[..., object], tuple[object, ...]]] = queue.SimpleQueue()
    with os.fdopen(os.dup(0), "rb") as source, os.fdopen(os.dup(1), "wb") as sink:
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        os.dup2(2, 1)
        _raise_oom_score()
        threading.Thread(target=_listen, args=(source, calls), daemon=True).start()
        _answer(sink, _READY)
        while True:
            function, args = calls.get()
            _answer(sink, _attempt(function, args))


def _listen(source: IO[bytes], calls: queue.SimpleQueue[Any]) -> None:
    """Pass calls on. When stdin ends, the caller is gone: end the process at once."""
    try:
        while True:
            calls.put(pickle.load(source))
    except EOFError:
        os._exit(0)
    except BaseException as error:  # noqa: BLE001 - a call that cannot be read ends the process, which its caller notices
        sys.excepthook(type(error), error, error.__traceback__)
        os._exit(1)


def _attempt(function: Callable[..., object], args: tuple[object, ...]) -> tuple[object, Exception | None]:
    try:
        return function(*args), None
    except Exception as error:  # noqa: BLE001 - raised again by the caller
        return None, error


def _answer(sink: IO[bytes], answer: object) -> None:
    try:
        message = pickle.dumps(answer)
    except Exception as error:  # noqa: BLE001 - the caller waits for an answer
        message = pickle.dumps((None, ComputationError(f"the answer cannot be sent: {error}")))
    sink.write(message)
    sink.flush()


def _raise_oom_score() -> None:
    """Ask Linux to kill this process rather than the one that runs the cohort."""
    with suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text(str(_OOM_SCORE), encoding="ascii")
