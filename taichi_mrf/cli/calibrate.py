"""Command ``taichi-mrf calibrate``: find the ground truth, learn, write the files, print the report."""

import json
from pathlib import Path
from typing import Any

from rich.table import Table

from taichi_mrf.calibration.coverage import Coverage
from taichi_mrf.calibration.fit import calibrate
from taichi_mrf.calibration.no_return import learn_no_return
from taichi_mrf.calibration.pairs import DepthFiles
from taichi_mrf.calibration.report import (
    CONFIG_FILE,
    calibration_report,
    remarks,
    write_noise,
    write_pictures,
)
from taichi_mrf.calibration.truth_sources import (
    GroundTruth,
    from_chessboard,
    from_motion_capture,
    from_true_depth,
)
from taichi_mrf.cli.options.calibrate import Calibrate
from taichi_mrf.cli.shared.output import output_folder
from taichi_mrf.cli.shared.print_table import print_facts
from taichi_mrf.cli.shared.progress import ProgressBar, open_terminal
from taichi_mrf.cli.shared.terminal import Terminal
from taichi_mrf.datasets.intrinsics import CAMERA_FILES, find_camera
from taichi_mrf.datasets.options import PRIMESENSE, ReadOptions
from taichi_mrf.errors import DatasetError
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.system.atomic import write_text
from taichi_mrf.system.files import is_folder

REPORT_FILE = "report.json"
_MM = 1e3


def run_calibrate(options: Calibrate) -> int:
    """Carry out the command; returns the exit status. Raises TaichiMRFError."""
    console = open_terminal(options.printing)
    with output_folder(options.out):
        depth = DepthFiles(options.depth, options.depth_scale)
        camera, notes = _camera(options, depth)
        with ProgressBar(console, options.printing) as bar:
            truth = _ground_truth(options, depth, camera, bar)
            total = 2 * len(truth.source.names)
            calibration = calibrate(
                truth.source, camera, options.settings, lambda done: bar.advance("Learning", done, total)
            )
            coverage = Coverage(calibration.noise.cells, calibration.noise.covered)
            no_return = learn_no_return(truth.source) if options.no_returns else None
            written = write_noise(options.out, calibration.noise, no_return)
            if options.pictures:
                bar.advance("Drawing", 0, 1)
                written += write_pictures(options.out, calibration.noise, coverage)
        report = {
            "depth": str(options.depth),
            "ground_truth": truth.facts,
            **calibration_report(calibration, coverage),
            **({} if no_return is None else no_return.fields()),
            "notes": [*notes, *truth.notes, *remarks(calibration)],
        }
        write_text(options.out / REPORT_FILE, json.dumps(report, indent=2, allow_nan=False) + "\n")
        _print_report(console, report, [*written, options.out / REPORT_FILE])
        console.print_line(
            f"Map with it: taichi-mrf map SOURCE --out DIR --config {options.out / CONFIG_FILE}"
        )
    return 0


def _camera(options: Calibrate, depth: DepthFiles) -> tuple[PinholeCamera, list[str]]:
    """The depth camera, and a note if its intrinsics were assumed, which only --true-depth allows for."""
    given = None
    if options.camera is not None:
        width, height, *intrinsics = options.camera
        if not (width.is_integer() and height.is_integer()):
            raise DatasetError(f"--camera: the image size {width} x {height} is not a whole number of pixels")
        given = PinholeCamera(int(width), int(height), *intrinsics)
    height_px, width_px = depth.read(depth.names[0]).shape
    scale = width_px / PRIMESENSE.width
    default = PinholeCamera(
        width_px,
        height_px,
        PRIMESENSE.fx * scale,
        PRIMESENSE.fy * scale,
        (width_px - 1) / 2,
        (height_px - 1) / 2,
    )
    folder = options.depth if is_folder(options.depth) else options.depth.parent
    files = (depth.file(name) for name in depth.names)
    camera, notes = find_camera(folder, ReadOptions(camera=given), default, "a PrimeSense camera", files)
    if notes and options.images is not None:
        raise DatasetError(
            f"{folder}: a chessboard needs the camera's intrinsics: give --camera, or one of "
            f"{', '.join(CAMERA_FILES)} beside the depth images"
        )
    return camera, [f"{note}; it matters for the pictures only" for note in notes]


def _ground_truth(
    options: Calibrate, depth: DepthFiles, camera: PinholeCamera, bar: ProgressBar
) -> GroundTruth:
    if options.true_depth is not None:
        steps = options.true_depth_scale or options.depth_scale
        return from_true_depth(depth, DepthFiles(options.true_depth, steps), camera)
    assert options.images is not None

    def progress(done: int, total: int) -> None:
        bar.advance("Finding boards", done, total)

    if options.camera_poses is None or options.board_poses is None:
        return from_chessboard(depth, options.images, camera, options.settings, progress)
    return from_motion_capture(
        depth,
        options.images,
        options.camera_poses,
        options.board_poses,
        options.stamps,
        camera,
        options.settings,
        progress,
    )


def _print_report(console: Terminal, report: dict[str, Any], written: list[Path]) -> None:
    print_facts(console, f"Noise learnt from {report['depth']}", _rows(report))
    console.print(_noise_table(report["noise"]))
    for sentence in report["not_covered"]:
        console.print_line(sentence)
    for note in report["notes"]:
        console.print_line(f"Note: {note}")
    for path in written:
        console.print_line(str(path))


def _rows(report: dict[str, Any]) -> list[tuple[str, str]]:
    truth = report["ground_truth"]
    rows = [("ground truth", truth["kind"])]
    if "boards_found" in truth:
        found = f"{truth['boards_found']} of {truth['images']} images"
        rows.append(("boards", f"{found}, corners {truth['median_reprojection_px']:.2f} pixels off (median)"))
    if "lag_s" in truth:
        lag = f"{_MM * truth['lag_s']:.1f} ± {_MM * truth['lag_standard_error_s']:.1f} ms after the images"
        rows.append(("time lag", f"{lag}, speeds correlate by {truth['speed_correlation']:.2f}"))
        rows.append(("alignment", f"{truth['aligned_reprojection_px']:.2f} pixels (RMS)"))
    share = report["outliers"] / max(report["samples"], 1)
    borrowed, patches = report["patches_that_borrowed"], report["patches"]
    depths = f"{report['covered_from']:.2f} to {report['covered_to']:.2f} m"
    rows += [
        ("samples", f"{report['samples']:,} in {report['images']} images, {share:.2%} outliers"),
        ("patches", f"{patches}, {borrowed} of them with too little data of their own"),
        ("covered", f"{depths}; {report['covered_cells']:.0%} of all cells"),
    ]
    if "no_return_share" in report:
        law = f"{report['no_return_share']:.1%} near, half at {report['no_return_depth']:.1f} m"
        rows.append(("no return", f"{law}, width {report['no_return_width']:.1f} m"))
    if report["misfit"] is not None:
        rows.append(("misfit", f"{report['misfit']:.2f} (1 if independent samples follow the polynomials)"))
    return rows


def _noise_table(noise: list[dict[str, float]]) -> Table:
    table = Table(title="Median patch, and mean of the image's centre, in mm", title_justify="left")
    for name in ("depth", "bias", "centre", "sigma", "centre"):
        table.add_column(name, justify="right")
    for row in noise:
        values = [row[f"{name}_{which}"] for name in ("bias", "sigma") for which in ("median", "centre")]
        table.add_row(f"{row['depth']:.2f} m", *(f"{_MM * value:.2f}" for value in values))
    return table
