"""Progress of a running training, for a person and for programs: the progress bar and ``log.jsonl``."""

import json
import sys
import time
from collections import deque
from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
from tqdm import tqdm

from minisplat_ref.app.runs.outlook import Outlook
from minisplat_ref.errors import InputError
from minisplat_ref.interface.progress import LOG_SECONDS, Lines
from minisplat_ref.io.atomic import replacing, unwritable
from minisplat_ref.metrics import psnr
from minisplat_ref.training.state import StepReport

LOG_EVERY = 5  # iterations; a PSNR is measured as often
PSNR_WINDOW = 20  # measured views that the shown PSNR is the mean of: single views differ too much to show a trend
PSNR_MAX = 100.0  # dB; equal images have an infinite one, which JSON cannot hold
BAR_SECONDS = 0.3  # between redraws of the bar


class Clock(NamedTuple):
    """The time of a training, with the earlier parts of a continued run and without evaluation and output."""

    seconds: float
    """On the wall."""
    cpu_seconds: float | None
    """Of the processor, all threads together, which other programs lengthen but little; None where a part lacks it."""


class Progress(AbstractContextManager["Progress"]):
    """Bar and log of one training: a context manager that is called with every :class:`StepReport`."""

    def __init__(self, log_path: Path, first_step: int, last_step: int | None, outlook: Outlook | None = None) -> None:
        records = [record for record in read_log(log_path) if record["step"] <= first_step]
        self._log_path, self._old_records = log_path, records
        self._first_step, self._last_step, self._outlook = first_step, last_step, outlook
        self._before = Clock(records[-1]["seconds"], records[-1].get("cpu_seconds")) if records else Clock(0.0, 0.0)
        self._losses: list[float] = []
        self._psnrs: deque[float] = deque((record["psnr"] for record in records[-1:]), maxlen=PSNR_WINDOW)

    def __enter__(self) -> Self:
        """Start the clock; records after ``first_step``, of a part that was lost, leave the log."""
        write_log(self._log_path, self._old_records)
        self._bar = tqdm(
            total=self._last_step,
            initial=self._first_step,
            desc="compiling on first use",
            unit="it",
            dynamic_ncols=True,
            mininterval=BAR_SECONDS if sys.stderr.isatty() else LOG_SECONDS,
            file=None if sys.stderr.isatty() else Lines(),
        )
        self._start, self._cpu_start = time.perf_counter(), time.process_time()
        return self

    def __exit__(self, *_: object) -> None:
        """Close the bar."""
        self._bar.close()

    @property
    def clock(self) -> Clock:
        """Both times, as they are now."""
        seconds = self._before.seconds + time.perf_counter() - self._start
        if self._before.cpu_seconds is None:
            return Clock(seconds, None)
        return Clock(seconds, self._before.cpu_seconds + time.process_time() - self._cpu_start)

    @property
    def seconds(self) -> float:
        """Training time so far, with that of earlier parts of a continued run."""
        return self.clock.seconds

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Stop both clocks for work other than training."""
        start, cpu_start = time.perf_counter(), time.process_time()
        try:
            yield
        finally:
            self._start += time.perf_counter() - start
            self._cpu_start += time.process_time() - cpu_start

    def __call__(self, report: StepReport) -> None:
        """Move the bar; every LOG_EVERY iterations measure, show and write.

        ``model_mb`` of a record is the size of the Gaussians' arrays. During an iteration their gradients take as
        much again, and Adam's two moments twice as much all the time.
        """
        self._bar.total = report.last_step  # None while the recipe has not decided it
        if self._bar.n == self._first_step:
            self._bar.set_description_str("training", refresh=False)
            self._estimate_from_now()
        self._bar.update()
        if self._outlook is not None:
            self._outlook.observe(report, self.seconds)
        for note in report.notes:
            self._bar.write(f"minisplat-ref: {note}", file=sys.stderr)
        self._losses.append(report.loss)
        if report.step % LOG_EVERY and report.step != report.last_step:
            return
        image = np.clip(np.asarray(report.output.image), 0.0, 1.0)  # [H, W, 3]
        view_psnr = psnr(image, report.view.image, report.view.mask)
        self._psnrs.append(min(view_psnr, PSNR_MAX))
        loss, mean_psnr = float(np.mean(self._losses)), float(np.mean(self._psnrs))
        seconds, cpu_seconds = self.clock
        append_log(
            self._log_path,
            {
                "step": report.step,
                "loss": loss,
                "psnr": mean_psnr,
                "n_gaussians": report.n_gaussians,
                "model_mb": report.n_bytes / 1e6,
                "seconds": seconds,
                "cpu_seconds": cpu_seconds,
                "its/s": report.step / seconds,
            },
        )
        rest = "" if self._outlook is None else self._outlook.describe(report)
        line = f"loss {loss:.4f}, {mean_psnr:.2f} dB, {report.n_gaussians:,} Gaussians"
        self._bar.set_postfix_str(", ".join(filter(None, (line, rest))), refresh=False)
        self._losses.clear()

    def _estimate_from_now(self) -> None:
        """Leave the first iteration out of the bar's estimate: most of its time is compilation."""
        self._bar.start_t = self._bar.last_print_t = time.time()
        self._bar.initial = self._bar.last_print_n = self._bar.n + 1


def write_log(path: Path, records: Iterable[dict[str, Any]]) -> None:
    """Rewrite a log; a reader sees the old one or this."""
    with replacing(path) as temporary:
        temporary.write_text("".join(map(_line, records)), encoding="utf-8")


def append_log(path: Path, record: dict[str, Any]) -> None:
    """Add a record, which can be read at once.

    Raises
    ------
    InputError
        The file cannot be written.
    """
    try:
        with open(path, "a", encoding="utf-8") as file:
            file.write(_line(record))
    except OSError as error:
        raise unwritable(path, error) from error


def _line(record: dict[str, Any]) -> str:
    return json.dumps(record) + "\n"


def read_log(path: Path) -> list[dict[str, Any]]:
    """Read the records of a ``log.jsonl``; none where there is no file.

    A last line without an end was being written when the disk was full or the process was killed, and does not count.

    Raises
    ------
    InputError
        A line is not a record.
    """
    if not path.exists():
        return []
    records = []
    text = path.read_text(encoding="utf-8", errors="replace")
    for number, line in enumerate(text[: text.rfind("\n") + 1].splitlines(), start=1):
        try:
            record = json.loads(line)
            records.append({**record, "step": int(record["step"]), "seconds": float(record["seconds"])})
        except (ValueError, KeyError, TypeError) as error:
            raise InputError(
                f"{path}, line {number} is not a record of a training: remove it and what follows"
            ) from error
    return records
