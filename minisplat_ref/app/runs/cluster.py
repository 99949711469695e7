"""Many commands at once, by processes on this machine or by a Dask cluster: connect, check, hand out, wait.

``--workers N`` starts N processes here, ``--cluster ADDRESS`` connects to a scheduler that is already running; both
are ``dask.distributed``, of the extra ``cluster``. A job is a command that writes into a folder from which it can
continue. So nothing is lost when a worker is killed: the scheduler hands its job to another one.
"""

import contextlib
import re
import signal
import sys
import threading
import uuid
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from minisplat_ref.app.runs.run_folder import hold_folder
from minisplat_ref.app.runs.worker import (
    INTERRUPTED,
    Job,
    Outcome,
    Site,
    carry_out,
    compile_once,
    unseen,
    unseen_line,
    versions,
)
from minisplat_ref.errors import InputError

CONNECT_SECONDS = 10.0  # for the scheduler to answer
WORKER_SECONDS = 60.0  # for a first worker to come; of a batch system they come late
SAVING_SECONDS = 120.0  # after Ctrl-C, for the running commands to save
ADDRESS = re.compile(r"(?:(?:tcp|tls|wss?)://)?(?:\[[\da-fA-F:.]+\]|[^\s:/\[\]]+):(?P<port>\d{1,5})")
PORT_MAX = 65535
TOKEN = ".workers-"  # begins the name of a token
REPORTED_CODES = (2, INTERRUPTED)  # after which the command has printed its line of explanation


class Workers(NamedTuple):
    """The processes that carry jobs out; by default this one, one job after the other."""

    n: int = 0
    """Processes on this machine."""
    address: str | None = None
    """Of a Dask scheduler."""

    @property
    def is_used(self) -> bool:
        """Whether jobs go to other processes."""
        return self.n > 0 or self.address is not None


def carry_out_all(
    workers: Workers,
    jobs: Sequence[Job],
    folder: Path,
    inputs: Sequence[Path] = (),
    on_done: Callable[[Job], None] = lambda job: None,
) -> int:
    """Have all jobs carried out, in any order; when one fails, the others are still carried out.

    Parameters
    ----------
    workers : Workers
    jobs : sequence of Job
    folder : Path
        Of the results. It must be there, and all workers must see it.
    inputs : sequence of Path
        Files and folders that the jobs read, and all workers must see.
    on_done : callable
        Called with each job that has succeeded.

    Returns
    -------
    int
        Exit code of the first job that failed, in their order; 0 if none did.

    Raises
    ------
    InputError
        dask.distributed is not installed, no scheduler answers, there are no workers, one has another version or does
        not see a path, the scheduler is lost, or a job has cost the lives of several workers.
    RuntimeError
        A command has failed without its line of explanation: a programming error.
    KeyboardInterrupt
        After Ctrl-C, when the running commands have saved.
    """
    if not jobs:
        return 0
    with _client(workers) as client, _token(folder) as token:
        site = Site(token, Path.cwd(), tuple(path.resolve() for path in inputs))
        _check(client, site)
        _compile_kernels(client)
        outcomes = _outcomes(client, jobs, site, on_done)
    for job in jobs:
        code, said = outcomes[job.name]
        if code in REPORTED_CODES:
            print(f"{job.name}: {_last_line(said)}", file=sys.stderr)
        elif code != 0:
            raise RuntimeError(f"{job.name} ended with code {code}:\n{said}")
    return next((outcomes[job.name].code for job in jobs if outcomes[job.name].code), 0)


def _last_line(said: str) -> str:
    """Return the line in which a command gives the reason for its end."""
    lines = [line for line in said.splitlines() if line.strip()]
    return next((line for line in reversed(lines) if line.startswith("minisplat-ref: ")), "".join(lines[-1:]))


def _outcomes(client: Any, jobs: Sequence[Job], site: Site, on_done: Callable[[Job], None]) -> dict[str, Outcome]:
    from distributed import KilledWorker, as_completed, wait
    from distributed.client import FutureCancelledError
    from distributed.comm import CommClosedError

    futures = {client.submit(carry_out, job, site, pure=False): job for job in jobs}
    outcomes, killed = {}, []
    try:
        for future in as_completed(futures):
            job = futures[future]
            try:
                outcomes[job.name] = future.result()
            except KilledWorker:
                killed.append(job.name)
                continue
            if outcomes[job.name].code == 0:
                on_done(job)
    except (FutureCancelledError, CommClosedError, OSError) as error:
        raise InputError(
            "the connection to the scheduler is lost: what has been finished is kept; start a scheduler and continue"
        ) from error
    except KeyboardInterrupt:
        site.token.unlink(missing_ok=True)  # which notifies the workers
        with contextlib.suppress(Exception):  # a worker that is lost now loses its work since the last checkpoint
            wait(list(futures), timeout=SAVING_SECONDS)
        raise
    if killed:
        raise InputError(
            f"{killed[0]} has been given up, each worker that had it was killed: is there enough memory? What has been"
            " finished is kept; continue with fewer workers"
        )
    return outcomes


@contextmanager
def _client(workers: Workers) -> Iterator[Any]:
    """Give a client of a scheduler that has workers."""
    try:
        import distributed
    except ImportError:
        raise InputError("workers need dask.distributed: pip install 'minisplat_ref[cluster]'") from None
    with contextlib.ExitStack() as stack:
        stack.enter_context(warnings.catch_warnings())
        warnings.filterwarnings("ignore", module="distributed")  # of ports in use, and of other versions of Dask
        if workers.address is None:
            with _deaf_to_ctrl_c():  # a terminal's Ctrl-C reaches all processes; here the token stops the workers
                cluster = distributed.LocalCluster(
                    n_workers=workers.n,
                    threads_per_worker=1,
                    dashboard_address=None,
                    memory_limit=0,  # the commands are other processes, which check their memory beforehand
                    silence_logs="CRITICAL",
                )
            stack.enter_context(cluster)
            yield stack.enter_context(distributed.Client(cluster))
            return
        client = stack.enter_context(_connect(workers.address))
        stack.enter_context(client.as_current())  # for as_completed and wait, which take no client
        yield client


def _connect(address: str) -> Any:
    import logging

    import distributed

    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # ours replace its messages of lost connections
    _check_address(address)
    try:
        client = distributed.Client(address, timeout=CONNECT_SECONDS, set_as_default=False)
    except (OSError, TimeoutError, ValueError) as error:
        raise InputError(
            f"no scheduler answers at {address}: start one with dask scheduler, and give the address that it prints"
        ) from error
    try:
        if not client.scheduler_info()["workers"]:
            print(
                f"minisplat-ref: the scheduler at {address} has no workers yet: waiting for one, at most"
                f" {WORKER_SECONDS:.0f} seconds",
                file=sys.stderr,
                flush=True,
            )
        client.wait_for_workers(1, timeout=WORKER_SECONDS)
    except (OSError, TimeoutError) as error:
        client.close()
        raise InputError(f"the scheduler at {address} has no workers: start some with dask worker {address}") from error
    return client


def _check_address(address: str) -> None:
    """Refuse what is no address; Dask's client would leave threads behind that wait for it.

    Raises
    ------
    InputError
        It lacks its port, or has a protocol that is not spoken.
    """
    if (found := ADDRESS.fullmatch(address)) is None or int(found["port"]) > PORT_MAX:
        raise InputError(
            f"--cluster {address}: no address of a scheduler, which has a port: give one like tcp://localhost:8786, as"
            " dask scheduler prints it"
        )
    from distributed.security import Security

    if address.startswith(("tls:", "wss:")) and Security().get_connection_args("client").get("ssl_context") is None:
        raise InputError(
            f"--cluster {address}: it is encrypted, but Dask's configuration names no certificate: set"
            " distributed.comm.tls, as for dask worker"
        )


@contextmanager
def _deaf_to_ctrl_c() -> Iterator[None]:
    """Have processes that are started ignore Ctrl-C."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    previous = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, previous)


@contextmanager
def _token(folder: Path) -> Iterator[Path]:
    """Make the file that marks results in a folder as awaited; remove those that killed programs left."""
    folder = folder.resolve()
    with hold_folder(folder):  # another program that waits for results here
        for left in folder.glob(f"{TOKEN}*"):
            left.unlink(missing_ok=True)
        token = folder / f"{TOKEN}{uuid.uuid4().hex}"
        token.touch()
        try:
            yield token
        finally:
            token.unlink(missing_ok=True)


def _check(client: Any, site: Site) -> None:
    """Refuse workers of another version, and those that do not see a path."""
    ours = versions()
    for worker, theirs in client.run(versions, on_error="return").items():
        if isinstance(theirs, Exception):
            raise InputError(f"worker {worker} cannot run minisplat_ref of this version ({theirs}): install it there")
        for name, version in ours.items():
            if theirs.get(name) != version:
                raise InputError(
                    f"worker {worker} has {name} {theirs.get(name)} and not {version}: install the same there"
                )
    for worker, path in client.run(unseen, site).items():
        if path is not None:
            raise InputError(unseen_line(worker, path))


def _compile_kernels(client: Any) -> None:
    """Have the kernels compiled by one worker of each machine: several at once would all compile everything."""
    by_host = {worker["host"]: address for address, worker in client.scheduler_info(n_workers=-1)["workers"].items()}
    client.gather([client.submit(compile_once, workers=[address], pure=False) for address in by_host.values()])
