"""The photographs of the measured pages: their sources, their licences, and the commands that make scenes of them.

Each set lies in a public repository and is named by its commit, so that its files never change; ``catalogue.sha256``
has the hash of every file at that commit. One scene of the measured pages is missing, banana_blender, which was cut out
of banana with hand-made masks; of buddha there are the 13 photographs that were measured.

*lego* and *fern* are scenes already, with the cameras with which others have published their figures
(``docs/measured/published.md``).

Other photographs become scenes by ``sfm`` with the options given here: of those that are trained, photographs three
times as large as the measured ones, which ``train --downscale 3`` then brings to their size, less the edge that is lost
where a lens is straightened. The measured scenes were made in the same way from photographs of up to 1,600 pixels, so
that cameras, and with them the figures, differ a little. The photographs of lund and buddha were compressed once more
before they were measured.
"""

from importlib.resources import files
from pathlib import PurePosixPath
from typing import NamedTuple

from minisplat_ref.errors import InputError
from minisplat_ref.interface.arguments import did_you_mean

HOST, PAGES = "https://raw.githubusercontent.com", "https://github.com"
PHOTOS = "photos"  # folder of the photographs, where ``sfm`` finds them
AS_MEASURED = ("--features", "standard")  # dense ones were not tried where a photograph found no place
OPENCV = ("--camera-model", "OPENCV")


class File(NamedTuple):
    """A file of a set."""

    url: str
    path: str
    """Its path in the folder of the set."""
    n_bytes: int
    sha256: str


class DataSet(NamedTuple):
    """Photographs, or other data, at a commit of a public repository."""

    what: str
    """Its subject, in a line."""
    repository: str
    commit: str
    licence: str
    licence_file: str
    """In the repository; it is fetched as well. Empty where there is none, and the licence is stated elsewhere."""
    next_command: tuple[str, ...]
    """The command that makes the measured scene of it; ``{}`` is the folder of the set."""
    folder: str = PHOTOS
    """The folder of its other files."""
    root: str = ""
    """Folder of the repository whose folders are kept; empty: all files come to lie in one."""

    @property
    def page(self) -> str:
        """Address of its web page."""
        return f"{PAGES}/{self.repository}/tree/{self.commit[:7]}"


def _sfm(long_side: int, *options: str) -> tuple[str, ...]:
    return ("sfm", f"{{}}/{PHOTOS}", "--out", "{}/scene", "--long-side", str(long_side), *options)


def _published(*options: str) -> tuple[str, ...]:
    return ("train", "{}", "--recipe", "3dgs", *options, "--out", "{}/run")


CATALOGUE = {
    "fox": DataSet(
        "50 photographs of a fox before flowered wallpaper, 1080 x 1920",
        "NVlabs/instant-ngp",
        "abe236ee00cf90cfca6e36e65c00435d5b21f50a",
        "NVIDIA Source Code License: for research and evaluation, not for commerce",
        "LICENSE.txt",
        _sfm(1440, *AS_MEASURED, *OPENCV),
    ),
    "banana": DataSet(
        "16 photographs of bananas on a carpet, 3008 x 2000",
        "pierotofy/dataset_banana",
        "2778294e4a73aec8f37747e0d2edfc4cb38b23a6",
        "MIT",
        "LICENSE",
        _sfm(1536, *AS_MEASURED),
    ),
    "brighton_beach": DataSet(
        "18 photographs of trees and a shore from straight above, 4000 x 2250",
        "pierotofy/drone_dataset_brighton_beach",
        "9506a9bf09c9678b7d0b80b014af5b606c8a7255",
        "BSD-2-Clause",
        "LICENSE",
        _sfm(1536, *AS_MEASURED, *OPENCV),
    ),
    "snowmiku": DataSet(
        "97 photographs of a plush figure on a bed, 4032 x 3024",
        "noname0310/snowmiku2023plush-splat",
        "70fedae4fe163642ef71489e7e445f21ec0783e2",
        "MIT, of the photographs; the figure shows a character of others",
        "LICENSE",
        _sfm(1536, *AS_MEASURED, *OPENCV),
    ),
    "lund": DataSet(
        "29 photographs of a street, walked along, 1024 x 768",
        "mapillary/OpenSfM",
        "238744cdf3b5d50149c50d136a87f7fea25ad5cd",
        "BSD-2-Clause",
        "LICENSE",
        _sfm(1024),
    ),
    "buddha": DataSet(
        "13 of 67 photographs of a stone head on a table, 2736 x 1540",
        "alicevision/dataset_buddha",
        "9067f679eb5a772c3e818b7a12dc35882c071858",
        "CC BY 4.0; cite doi:10.5281/zenodo.1203283",
        "LICENSE.md",
        _sfm(1368),
    ),
    "garden": DataSet(
        "138,766 points and 3 cameras of a garden, for bench; no photographs",
        "nerfstudio-project/gsplat",
        "90d7b4b349e379ccf9ee6a8cef76aa40f48bb32e",
        "Apache-2.0; the points are of the Mip-NeRF 360 data, which state no licence",
        "LICENSE",
        ("bench", "--data", "{}/test_garden.npz", "--repeats", "7", "--out", "bench"),
        folder="",
    ),
    "lego": DataSet(
        "300 images of a rendered model of NeRF-Synthetic, 800 x 800, 200 of them for tests",
        "luo-ziyuan/CopyRNeRF-code",
        "454f028b606be4eb69c629aa4019b501504fb12b",
        "CC BY-NC, of the model by Heinzelnisse, Blend Swap 11490: for measuring, not for commerce",
        "",
        _published("--background", "255,255,255"),
        folder="",
        root="data/nerf_synthetic/lego",
    ),
    "fern": DataSet(
        "20 photographs of a fern, 1008 x 756, with the poses of LLFF",
        "luo-ziyuan/CopyRNeRF-code",
        "454f028b606be4eb69c629aa4019b501504fb12b",
        "none stated; published for research with LLFF and NeRF",
        "",
        _published(),
        folder="",
        root="data/nerf_llff_data/fern",
    ),
}


def find(name: str) -> DataSet:
    """Return a set by its name.

    Raises
    ------
    InputError
        There is none of that name.
    """
    if name not in CATALOGUE:
        meant = did_you_mean(name, CATALOGUE)
        raise InputError(f"there is no data set {name!r}{meant}; minisplat-ref data lists what there is")
    return CATALOGUE[name]


def scene_files(name: str) -> list[File]:
    """Return the files of a set, its licence first."""
    data_set = find(name)
    listed = (files(__package__) / "catalogue.sha256").read_text(encoding="utf-8")
    found = []
    for line in listed.splitlines()[1:]:
        sha256, n_bytes, owner, path = line.split(" ")
        if owner == name:
            url = f"{HOST}/{data_set.repository}/{data_set.commit}/{path}"
            found.append(File(url, _place(data_set, path), int(n_bytes), sha256))
    return found


def _place(data_set: DataSet, path: str) -> str:
    """Return where a file of the repository comes to lie: inside the folder of the set, whatever its path is."""
    given = PurePosixPath(path)
    if path == data_set.licence_file:
        return given.name
    if data_set.root and given.is_relative_to(data_set.root) and ".." not in given.parts:
        return str(PurePosixPath(data_set.folder, given.relative_to(data_set.root)))
    return str(PurePosixPath(data_set.folder, given.name))
