"""Pictures of a simulated campaign on disk: a pair per look, and board views for calibrating the cameras.

Spots are seen by the true cameras at the laser's wavelength, boards in visible light (focal scale 1). Light and sensors
are `Scene()` and `Sensor()`, the board is the paper's.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from os import cpu_count
from pathlib import Path

import numpy as np

from tvsbayes.files.disk import make_folder, write_atomically
from tvsbayes.files.images import png_bytes
from tvsbayes.instrument.campaign import CAMERAS, frame_name
from tvsbayes.progress import Job, Show
from tvsbayes.twin.board_pictures import Board, BoardPose, board_poses, render_board
from tvsbayes.twin.physics import CameraPair, Light, cameras_of
from tvsbayes.twin.simulated_campaign import SimulatedCampaign
from tvsbayes.twin.spot_pictures import Scene, Sensor, render_spots

BOARD_VIEWS = 20
"""Number of views of the checkerboard, as in the paper (section 2.3)."""
WORKERS_MAX = 8


def write_with_frames(
    folder: Path,
    simulated: SimulatedCampaign,
    seed: int,
    *,
    views: int | None = None,
    progress: Show | None = None,
) -> int:
    """Write a campaign and its pictures, campaign.toml last: a folder without it is not finished.

    In a folder that the same simulation began, existing pictures are kept and the others are added.

    Args:
        folder: new, empty, or begun by the same simulation.
        simulated: what the twin did.
        seed: seed of speckle, noise and board poses.
        views: number of board views, by default `BOARD_VIEWS`; 0 writes no `boards/`.
        progress: receives the progress.

    Returns:
        How many pictures lie there.

    Raises:
        InputError: the folder holds anything else, cannot be written, or the cameras see no board together.
    """
    # Scenes that cannot be rendered are refused before anything is written.
    views = BOARD_VIEWS if views is None else views
    poses = board_poses(cameras_of(simulated.truth.stereo_pair), Board(), views, seed) if views else []
    files = simulated.files()
    declaration = files.pop("campaign.toml")
    make_folder(folder, empty=not _begun(folder, files))
    for name, data in files.items():
        write_atomically(folder / name, data)
    written = write_frames(folder, simulated, seed, poses, progress=progress)
    write_atomically(folder / "campaign.toml", declaration)
    return written


def _begun(folder: Path, files: Mapping[str, bytes]) -> bool:
    """Whether a folder holds only files that this simulation wrote before it was interrupted."""
    if not folder.is_dir():
        return False
    # Hidden files are those that a killed process was writing.
    names = {path.name for path in folder.iterdir() if not path.name.startswith(".")}
    whole = names & set(files) if names <= {*files, "frames", "boards"} else set()
    same = all((folder / name).is_file() and (folder / name).read_bytes() == files[name] for name in whole)
    return bool(whole) and same and (whole == set(files) or names == whole)


def write_frames(
    folder: Path,
    simulated: SimulatedCampaign,
    seed: int,
    poses: Sequence[BoardPose] = (),
    *,
    progress: Show | None = None,
) -> int:
    """Write `frames/000000_left.png`, `_right.png` of every look and `boards/left01.png`, `right01.png` ...

    Existing pairs are kept: pictures are written whole or not at all.

    Args:
        folder: the campaign's folder, which exists.
        simulated: what the twin did.
        seed: seed of speckle and noise.
        poses: those of the board, view by view; without them no `boards/` are written.
        progress: receives the progress.

    Returns:
        How many pictures lie there.

    Raises:
        InputError: the folder cannot be written.
    """
    visible = cameras_of(simulated.truth.stereo_pair)
    make_folder(folder / "frames")
    if poses:
        make_folder(folder / "boards")
    infrared = cameras_of(simulated.truth.stereo_pair, simulated.truth.parameters["focal_scale"])
    jobs = [partial(_write_board, folder, visible, pose, number, seed) for number, pose in enumerate(poses)]
    jobs += [
        partial(_write_look, folder, infrared, simulated.light.of(row), spot.spot, seed)
        for row, spot in enumerate(simulated.campaign.spots)
    ]
    # NumPy's generators, OpenCV and file writing release Python's lock, so threads suffice.
    pool = ThreadPoolExecutor(min(WORKERS_MAX, cpu_count() or 1))
    try:
        with Job({"rendering": 1.0}, progress) as work:
            for count, _ in enumerate(pool.map(lambda job: job(), jobs), start=1):
                work.at(count / len(jobs), f"{count} of {len(jobs)} pairs")
    finally:
        pool.shutdown(cancel_futures=True)
    return 2 * len(jobs)


def _write_look(folder: Path, cameras: CameraPair, light: Light, number: int, seed: int) -> None:
    """Write both pictures of a look, if they do not exist."""
    paths = [folder / frame_name(number, camera) for camera in CAMERAS]
    if all(path.is_file() for path in paths):
        return
    made = render_spots(cameras, light, Scene(), Sensor(), seed, number)
    for path, picture in zip(paths, (made.left, made.right), strict=True):
        _write(path, picture)


def _write_board(folder: Path, cameras: CameraPair, pose: BoardPose, number: int, seed: int) -> None:
    """Write both pictures of a board in a pose, if they do not exist."""
    for side, (name, camera) in enumerate(zip(CAMERAS, (cameras.left, cameras.right), strict=True)):
        path = folder / "boards" / f"{name}{number + 1:02d}.png"
        if not path.is_file():
            _write(path, render_board(camera, pose, Board(), Sensor(), (seed, number, side)))


def _write(path: Path, picture: np.ndarray) -> None:
    write_atomically(path, png_bytes(picture))
