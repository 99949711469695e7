"""Quality over the course of a training: ``curve.jsonl`` has a record of each evaluation on the test views.

Where the scene folder holds true depths, a record also has ``chamfer``: see
:mod:`minisplat_ref.datasets.synthetic.surface`.
"""

from pathlib import Path

from minisplat_ref.app.runs.progress import PSNR_MAX, append_log, read_log, write_log
from minisplat_ref.errors import InputError
from minisplat_ref.metrics import Evaluation
from minisplat_ref.types import Scene


def check_views(scene: Scene) -> None:
    """Refuse a scene that has nothing to measure.

    Raises
    ------
    InputError
        There are no test views.
    """
    if not scene.test_views:
        raise InputError(f"scene {scene.name} has no test views to measure: give --test-every above 0")


def keep_until(path: Path, step: int) -> None:
    """Make the file, or drop the records after ``step``: they are of a part of the training that was lost."""
    write_log(path, [record for record in read_log(path) if record["step"] <= step])


def append(
    path: Path, step: int, seconds: float, evaluation: Evaluation, n_gaussians: int, **further: float | None
) -> None:
    """Add a record; a step that is there already, where a training was interrupted, is not measured twice.

    Parameters
    ----------
    path : Path
        The file; see :func:`keep_until`.
    step : int
        Iterations done.
    seconds : float
        Training time until then, without that of measuring.
    evaluation : Evaluation
        Of at least one view.
    n_gaussians : int
    further : float or None
        What else was measured, by name.
    """
    assert evaluation.psnr is not None, "check_views has found views"
    if any(record["step"] == step for record in read_log(path)):
        return
    record = {
        "step": step,
        "seconds": seconds,
        "psnr": min(evaluation.psnr, PSNR_MAX),
        "ssim": evaluation.ssim,
        "n_gaussians": n_gaussians,
        **further,
    }
    append_log(path, record)
