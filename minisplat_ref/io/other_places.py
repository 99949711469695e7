"""Where other programs put a model or a scene: what a path means, or which export of which program it needs.

Opened are the output folder of 3DGS's own code (graphdeco), of which the newest iteration counts, and a SOG that is not
packed (a folder with ``meta.json``). What needs another program to be read (checkpoints, projects of photogrammetry) is
refused in a line that names that program and its export.
"""

import re
from collections.abc import Iterator
from pathlib import Path

from minisplat_ref.errors import InputError
from minisplat_ref.io.run_files import CONFIG, POINT_CLOUD

SOG_META, SOG_LEVELS = "meta.json", "lod-meta.json"
ITERATION = re.compile(r"iteration_(\d+)")
NERFSTUDIO = "config.yml"
SCENE_PARTS = ("images", "input", "sparse", "transforms.json", "transforms_train.json")
CHECKPOINTS = (".pt", ".pth", ".ckpt")
DEPTH_MAX = 4  # folders below a given one in which nerfstudio puts a run: outputs/SCENE/METHOD/TIME
HEAD = 4096  # bytes of a file that are looked at


def find_model_file(path: Path) -> Path:
    """Return the file of Gaussians that a path of another program means; the path itself where it means nothing else.

    Parameters
    ----------
    path : Path
        A file or folder that exists. Our own runs stay as they are.

    Raises
    ------
    InputError
        It is of a program whose models are not read; the message says how to export one.
    """
    if path.suffix.lower() in CHECKPOINTS and path.is_file():
        raise InputError(
            f"{path}: a checkpoint of PyTorch, which is not read: in gsplat train with --save_ply, or write a PLY by"
            " gsplat.export_splats; in nerfstudio run ns-export gaussian-splat"
        )
    if path.name == SOG_LEVELS or (path / SOG_LEVELS).is_file():
        raise InputError(
            f"{path}: levels of detail of SuperSplat, in many files: give the folder of one, which has its own"
            f" {SOG_META}, or convert the original to .ply or .sog with splat-transform"
        )
    is_scene = any((path / name).exists() for name in SCENE_PARTS)
    if not path.is_dir() or is_scene or (path / CONFIG).is_file():
        return path
    iterations = [*path.glob(f"point_cloud/iteration_*/{POINT_CLOUD}"), *path.glob(f"iteration_*/{POINT_CLOUD}")]
    numbered = [(int(match[1]), file) for file in iterations if (match := ITERATION.fullmatch(file.parent.name))]
    if numbered:
        return max(numbered)[1]
    for name in (SOG_META, POINT_CLOUD):
        if (path / name).is_file():
            return path / name
    if configs := sorted(_below(path, NERFSTUDIO), key=lambda file: file.stat().st_mtime):
        raise InputError(
            f"{path}: a training of nerfstudio, whose checkpoints are not read: run ns-export gaussian-splat"
            f" --load-config {configs[-1]} --output-dir DIR, and give its splat.ply"
        )
    if checkpoints := sorted(file for suffix in CHECKPOINTS for file in path.glob(f"*{suffix}")):
        return find_model_file(checkpoints[-1])
    if (path / "cfg_args").is_file():
        raise InputError(f"{path}: a training of 3DGS that has saved no point_cloud/iteration_N: train it to its end")
    return path


def _below(path: Path, name: str, depth: int = DEPTH_MAX) -> Iterator[Path]:
    """Yield the files of a name in a folder and a few folders below."""
    if (path / name).is_file():
        yield path / name
    elif depth > 1:
        for folder in path.iterdir():
            if folder.is_dir() and not folder.is_symlink():
                yield from _below(folder, name, depth - 1)


def refuse_other_scene(path: Path) -> None:
    """Refuse what other programs write of photographs and cameras, if it is that, with the export to use.

    Raises
    ------
    InputError
        It is.
    """
    files = [path] if path.is_file() else sorted(file for file in path.iterdir() if file.is_file())
    reason = next((reason for file in files if (reason := _project(file)) is not None), None)
    if reason is None and any((path / "keyframes" / name).is_dir() for name in ("corrected_cameras", "cameras")):
        reason = "a capture of Polycam: run ns-process-data polycam, or sfm on keyframes/images"
    if reason is None and path.is_dir() and ((path / "cfg_args").is_file() or (path / NERFSTUDIO).is_file()):
        reason = "the output of a training, not photographs with cameras: give the scene that it was trained on"
    if reason is not None:
        raise InputError(f"{path}: {reason}")


def _project(file: Path) -> str | None:
    """Return what a file of a program of photogrammetry is, and the way out; None for others."""
    suffix = file.suffix.lower()
    if suffix not in (".xml", ".psx", ".rcproj", ".rsproj", ".csv", ".out", ".nvm"):
        return None
    with file.open("rb") as opened:
        head = opened.read(HEAD).decode(errors="replace")
    if suffix == ".psx" or (suffix == ".xml" and "<document" in head and "<chunk" in head):
        return (
            f"{file.name} is of Metashape: export it as COLMAP there (since 2.2: File > Export > Export Cameras), or"
            " run ns-process-data metashape"
        )
    if suffix in (".rcproj", ".rsproj") or (suffix == ".csv" and head.startswith("#name")):
        return f"{file.name} is of RealityCapture: export it as COLMAP there (Alignment > Export Registration)"
    if suffix == ".out" and head.startswith("# Bundle file"):
        return f"{file.name} is of Bundler, which is not read: run sfm on its photographs, or export as COLMAP instead"
    if suffix == ".nvm" and head.startswith("NVM_"):
        return f"{file.name} is of VisualSFM, which is not read: run sfm on its photographs"
    return None
