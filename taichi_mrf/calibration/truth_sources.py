"""The three kinds of ground truth, each from its files: recorded true depth, a chessboard, motion capture."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from taichi_mrf.calibration import chessboard, pairs
from taichi_mrf.calibration.chessboard import FoundBoards, find_boards, image_files
from taichi_mrf.calibration.motion_capture import BodyPair, align
from taichi_mrf.calibration.options import CalibrationConfig
from taichi_mrf.calibration.pairs import BoardPairs, DepthFiles, PairSource, RecordedPairs
from taichi_mrf.datasets.timed_poses import read_timed_poses
from taichi_mrf.errors import DatasetError
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.system.files import read_text

Progress = Callable[[int, int], None]
"""Called with the number of images done and their total."""

SUFFIXES = (*chessboard.FORMATS, *pairs.FORMATS)
"""Ends of a file's name that are no part of the image's."""


@dataclass(frozen=True)
class GroundTruth:
    """Pairs of measured and true depth, their origin, and remarks for the user."""

    source: PairSource
    facts: dict[str, Any]
    notes: list[str]


def from_true_depth(depth: DepthFiles, true_depth: DepthFiles, camera: PinholeCamera) -> GroundTruth:
    """True depth images of the same names. Raises DatasetError."""
    pairs = RecordedPairs(depth, true_depth, camera)
    notes = [f"{pairs.unpaired} depth images have no true depth of the same name"] if pairs.unpaired else []
    return GroundTruth(pairs, {"kind": "true depth", "folder": str(true_depth.path)}, notes)


def from_chessboard(
    depth: DepthFiles, images: Path, camera: PinholeCamera, options: CalibrationConfig, progress: Progress
) -> GroundTruth:
    """A chessboard found in the image of the same name as each depth image. Raises TaichiMRFError."""
    found, looked_at = _find_boards(depth, images, camera, options, progress)
    poses = {name: view.T_camera_board for name, view in found.views.items()}
    facts = {"kind": "chessboard", **_board_facts(found, looked_at)}
    return GroundTruth(BoardPairs(depth, poses, options.board, camera), facts, _board_notes(found))


def from_motion_capture(
    depth: DepthFiles,
    images: Path,
    camera_poses: Path,
    board_poses: Path,
    stamps: Path | None,
    camera: PinholeCamera,
    options: CalibrationConfig,
    progress: Progress,
) -> GroundTruth:
    """Motion capture of camera and board, put into the images' time and onto the chessboard by those images
    that show it. It then gives the board's pose for every depth image. Raises TaichiMRFError."""
    bodies = BodyPair(read_timed_poses(camera_poses), read_timed_poses(board_poses))
    stamp_of = stamps_of(depth.names, stamps)
    found, looked_at = _find_boards(depth, images, camera, options, progress)
    seen = sorted(found.views, key=lambda name: stamp_of[name])
    alignment = align(
        np.array([stamp_of[name] for name in seen]),
        [found.views[name] for name in seen],
        bodies,
        options.board,
        camera,
        options.motion_capture,
    )
    T_camera_board, known = alignment.T_camera_board(
        np.array([stamp_of[name] for name in depth.names]), bodies, options.motion_capture.largest_gap
    )
    poses = {name: T for name, T, has in zip(depth.names, T_camera_board, known, strict=True) if has}
    notes = _board_notes(found)
    if len(poses) < len(depth.names):
        notes.append(f"motion capture has no pose for {len(depth.names) - len(poses)} depth images")
    facts = {
        "kind": "motion capture",
        **_board_facts(found, looked_at),
        "lag_s": alignment.lag,
        "lag_standard_error_s": alignment.lag_error,
        "speed_correlation": alignment.correlation,
        "aligned_reprojection_px": alignment.reprojection,
        "T_camera_body": alignment.T_camera_body.tolist(),
        "T_body_board": alignment.T_body_board.tolist(),
    }
    return GroundTruth(BoardPairs(depth, poses, options.board, camera), facts, notes)


def _find_boards(
    depth: DepthFiles, folder: Path, camera: PinholeCamera, options: CalibrationConfig, progress: Progress
) -> tuple[FoundBoards, int]:
    files = image_files(folder)
    names = [name for name in depth.names if name in files]
    if not names:
        raise DatasetError(
            f"{folder}: has no image of the same name as one in {depth.path} "
            f"({next(iter(files))} against {depth.names[0]})"
        )
    found = find_boards(files, names, options.board, camera, lambda number: progress(number, len(names)))
    return found, len(names)


def _board_facts(found: FoundBoards, looked_at: int) -> dict[str, Any]:
    errors = [view.reprojection for view in found.views.values()]
    return {
        "images": looked_at,
        "boards_found": len(found.views),
        "not_found_in": found.not_found,
        "imprecise_in": found.imprecise,
        "median_reprojection_px": float(np.median(errors)),
    }


def _board_notes(found: FoundBoards) -> list[str]:
    notes = []
    if found.not_found:
        notes.append(f"no board found in {_some(found.not_found)}")
    if found.imprecise:
        notes.append(f"corners too far from a flat board in {_some(found.imprecise)}")
    return notes


def _some(names: list[str]) -> str:
    shown = ", ".join(names[:3]) + (", ..." if len(names) > 3 else "")
    return f"{len(names)} image{'s' if len(names) > 1 else ''} ({shown})"


def read_stamps(path: Path) -> dict[str, float]:
    """The stamps of images: lines of ``stamp file``, as in TUM RGB-D; name without suffix -> seconds.

    Raises DatasetError naming the file and the line.
    """
    lines = read_text(path, DatasetError).splitlines()
    stamps = {}
    for number, line in enumerate(lines, start=1):
        words = line.split("#")[0].replace(",", " ").split()
        if not words:
            continue
        try:
            stamp = float(words[0])
            if len(words) != 2 or not np.isfinite(stamp):
                raise ValueError
        except ValueError:
            raise DatasetError(
                f"{path} line {number}: expected a stamp in seconds and a file's name"
            ) from None
        stamps[Path(words[1]).stem if Path(words[1]).suffix in SUFFIXES else words[1]] = stamp
    if not stamps:
        raise DatasetError(f"{path}: contains no stamp")
    return stamps


def stamps_of(names: Sequence[str], file: Path | None) -> dict[str, float]:
    """The stamp of each image by its name: from a file, else the name itself, in seconds.

    Raises DatasetError for a name that has none.
    """
    if file is not None:
        known = read_stamps(file)
        missing = [name for name in names if name not in known]
        if missing:
            raise DatasetError(f"{file}: has no stamp for {missing[0]}")
        return {name: known[name] for name in names}
    stamps = {}
    for name in names:
        try:
            stamps[name] = float(name)
        except ValueError:
            raise DatasetError(
                f"image {name}: its name is not a stamp in seconds; pass --stamps FILE"
            ) from None
    return stamps
