"""The console program as a person runs it: a process, its exit status, its files and its words."""

import importlib
import json
import os
import pty
import re
import signal
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
import tyro
from console import (
    COARSE,
    FAST,
    ROOM,
    as_process,
    assert_refused,
    complaints,
    mapped,
    report_of,
    signalled,
    taichi_mrf,
)
from full_disk import files_up_to
from new_interpreter import obey_hangups, output

from taichi_mrf.cli.commands import COMMANDS
from taichi_mrf.cli.main import main
from taichi_mrf.cli.parser import flags_of, parse, registry
from taichi_mrf.config.schema import load
from taichi_mrf.system import compiler
from taichi_mrf.system.compiler import COMPILERS

FILES = {"map.npz", "voxels.ply", "config.yaml", "report.json"}
PICTURES = {"surface.png", "top_view.png", "depth.png"}


def marginals(out: Path) -> dict[tuple[float, ...], float]:
    """Position -> probability of the occupied voxels that a run wrote."""
    cloud = trimesh.load(out / "voxels.ply")
    occupancy = cloud.metadata["_ply_raw"]["vertex"]["data"]["occupancy"]
    return {tuple(np.round(c, 3)): float(p) for c, p in zip(cloud.vertices, occupancy, strict=True)}


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """A run over the built-in room: its folder, and what it printed."""
    out = tmp_path_factory.mktemp("room") / "deep" / "out"
    return out, mapped(ROOM, "--out", out, *COARSE)


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """A folder of three frames in the 7-Scenes layout: a wall 1.5 m away."""
    folder = tmp_path / "recording"
    folder.mkdir()
    for index in range(3):
        stem = folder / f"frame-{index:06d}"
        cv2.imwrite(f"{stem}.depth.png", np.full((480, 640), 1500, np.uint16))
        np.savetxt(f"{stem}.pose.txt", np.eye(4))
    return folder


def test_help_is_printed_without_loading_taichi_or_numpy() -> None:
    done = taichi_mrf("--help", options=("-X", "importtime"))
    assert done.returncode == 0
    assert "map" in done.stdout
    assert "info" in done.stdout
    imported = {line.rpartition("|")[2].strip() for line in done.stderr.splitlines()}
    assert "taichi_mrf.cli.main" in imported
    assert not imported & {*COMPILERS, "numpy", "cv2", "viser", "matplotlib"}


def test_bench_without_a_viewer_loads_no_page() -> None:
    program = "import sys, taichi_mrf.cli.bench; print('viser' in sys.modules, 'matplotlib' in sys.modules)"
    assert output(program) == "False False"


def test_every_command_names_a_function_that_exists() -> None:
    for command in COMMANDS.values():
        module, _, name = command.function.partition(":")
        assert callable(getattr(importlib.import_module(module), name))


@pytest.mark.parametrize(
    ("word", "hint"), [("exprot", "did you mean 'export'?"), ("xyz", "known are: map, live")]
)
def test_an_unknown_command_gets_a_suggestion(word: str, hint: str) -> None:
    assert_refused(taichi_mrf(word, "map.npz"), f"unknown command '{word}'", hint)


@pytest.mark.parametrize("name", ["map", "live", "tune", "bench", "laser"])
def test_the_short_help_fits_a_screen(name: str) -> None:
    short, long = taichi_mrf(name, "--help").stdout, taichi_mrf(name, "--help-all").stdout
    assert len(short.splitlines()) < 60
    assert "--help-all" in short
    assert len(long.splitlines()) > 1.5 * len(short.splitlines())


def test_the_short_help_of_map_fits_a_screen_and_the_long_one_shows_every_parameter() -> None:
    short, long = taichi_mrf("map", "--help"), taichi_mrf("map", "--help-all")
    assert short.returncode == long.returncode == 0
    assert len(short.stdout.splitlines()) < 60
    for flag in ("--out DIR", "--config", "--every", "--limit", "--resume", "--voxel-size", "--help-all"):
        assert flag in short.stdout
    assert "--inference.sweeps" in long.stdout
    assert "Number of sweeps over all keyframes." in long.stdout


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("map", "map: missing --out DIR, such as taichi-mrf map synthetic:room --out runs/room; "),
        ("map --out runs", "map needs a SOURCE: a recording, or a built-in one such as synthetic:room"),
        ("map a --out", "map: missing value for argument '--out'"),
        ("map a --out b --voxel-size c", "map: error parsing --voxel-size: could not convert string"),
        (
            "map a --out b --method c",
            "map: invalid choice 'c' for argument '--method'. Expected one of ('mrf', ",
        ),
        ("map a --out b --runtime.arch c", "map: invalid choice 'c' for argument '--runtime.arch'"),
        ("export", "export: missing MAP, --to FILE [FILE ...]; 'taichi-mrf export --help' explains"),
        ("info a b", "info: unrecognized options: b; "),
        ("bench --frames c", "bench: error parsing --frames: invalid literal for int()"),
        ("eval", "eval: missing EXPERIMENT; "),
    ],
)
def test_wrong_arguments_are_told_in_one_line(
    arguments: str, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(arguments.split()) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith(f"taichi-mrf: {words}")
    assert err.count("\n") == 1
    assert "─" not in err


def test_the_short_help_of_map_has_colour_and_noise() -> None:
    assert {"color", "noise"} <= set(COMMANDS["map"].brief)


@pytest.mark.parametrize("name", COMMANDS)
def test_the_list_of_flags_is_that_of_the_parser(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    command = COMMANDS[name]
    with pytest.raises(SystemExit):
        tyro.cli(command.options, args=["--help"], default=command.defaults([]), registry=registry)
    lines = _option_lines(capsys.readouterr().out)
    known = {word.rstrip(".") for word in re.findall(r"(?<!\S)--[a-z][a-z0-9._-]*", lines)}
    flags = list(flags_of(command.options))
    listed = {each for flag in flags for each in (flag.name, flag.negative) if each and each.startswith("--")}
    assert listed == known - {"--help"}
    assert {f"--{each}" for each in command.brief} <= listed


@pytest.mark.parametrize("name", COMMANDS)
def test_help_is_of_one_style_and_without_marks_of_code(
    name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    for word in ("--help", "--help-all"):
        with pytest.raises(SystemExit) as end:
            parse([name, word])
        assert end.value.code == 0
        text = capsys.readouterr().out
        assert text.startswith(f"usage: taichi-mrf {name} ")
        assert not re.search(r"`|│|--no-no-|usage:.*  ", text)
    for flag in flags_of(COMMANDS[name].options):
        assert not flag.help or flag.name in text
        if flag.default is True and flag.negative is None:  # what is on, and which flag ends it
            assert flag.name in flag.help


def _option_lines(text: str) -> str:
    """The lines of a help text that begin with a flag."""
    lines = (line.strip("│ ") for line in text.splitlines())
    return "\n".join(line for line in lines if line.startswith("-"))


def test_version_and_info() -> None:
    import taichi_mrf as package

    assert taichi_mrf("--version").stdout == f"taichi-mrf {package.__version__}\n"
    done = taichi_mrf("info", "--arch", "cpu")
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith("Runs on cpu")
    for word in ("cuda", "vulkan", f"{compiler.name()} 1.", "numpy", package.__version__):
        assert word in done.stdout


def test_the_shell_is_told_how_to_complete() -> None:
    done = as_process("--tyro-print-completion", "bash")
    assert done.returncode == 0
    for name in ("map", "tune", "export", "laser"):
        assert name in done.stdout


def test_a_run_writes_its_files_and_nothing_else(room: tuple[Path, str]) -> None:
    out, printed = room
    assert {path.name for path in out.iterdir()} == FILES | PICTURES
    for name in FILES | PICTURES:
        assert (out / name).stat().st_size > 0
        assert str(out / name) in printed
    assert "median error" in printed
    for picture in out.glob("*.png"):
        assert cv2.imread(str(picture)) is not None


def test_the_report_tells_what_was_done(room: tuple[Path, str]) -> None:
    report = report_of(room[0])
    assert report["source"] == ROOM
    assert report["backend"] == "cpu"
    assert report["interrupted"] is False
    assert (report["frames"], report["keyframes"]) == (12, 11)
    assert 0 < report["rays"] <= 11 * 160 * 120
    assert report["voxels"] == 512 * report["bricks"] > 0
    assert report["peak_memory_mb"] > report["map_memory_mb"] > 0
    assert {"opening", "reading", "adding", "inferring", "checking", "writing"} <= report["seconds"].keys()
    assert report["accuracy"]["frames"] == 1
    assert 0 < report["accuracy"]["median_abs"] < 0.1
    assert report["skipped_frames"] == {}


def test_the_files_of_a_run_open_elsewhere(room: tuple[Path, str]) -> None:
    out, _ = room
    occupied = marginals(out)
    assert len(occupied) > 100
    assert all(0.5 <= p <= 1 for p in occupied.values())
    config = load(out / "config.yaml")
    assert config.voxel_size == 0.1
    assert config.runtime.arch == "cpu"


def test_flags_come_before_the_file_and_the_file_before_the_defaults(tmp_path: Path) -> None:
    (tmp_path / "my.yaml").write_text("voxel_size: 0.2\ninference: {sweeps: 1, free_share: 0.1}\n")
    out = tmp_path / "out"
    arguments = ("--config", tmp_path / "my.yaml", "--inference.sweeps", "2")
    mapped(ROOM, "--out", out, "--limit", "2", "--no-pictures", *arguments)
    config = load(out / "config.yaml")
    assert (config.voxel_size, config.inference.sweeps, config.inference.free_share) == (0.2, 2, 0.1)
    assert config.inference.ray_density == 2.5


def test_a_run_of_other_parameters_is_replaced_only_if_asked(tmp_path: Path) -> None:
    mapped(ROOM, "--out", tmp_path, "--limit", "2", *FAST)
    before = (tmp_path / "report.json").read_bytes()
    other = ("map", ROOM, "--out", tmp_path, "--limit", "3", *FAST, "--voxel-size", "0.2")
    assert_refused(taichi_mrf(*other), "another limit, voxel_size", "--overwrite")
    batch = taichi_mrf("map", "synthetic:room?frames=3", *other[1:])
    assert_refused(batch, "config.yaml: made with another voxel_size", "--overwrite")
    assert (tmp_path / "report.json").read_bytes() == before
    assert f"{tmp_path} already holds this run" in mapped(ROOM, "--out", tmp_path, "--limit", "2", *FAST)
    assert (tmp_path / "report.json").read_bytes() == before
    for stale in ("surface.png", "perspective.png", "top_view.png", "depth.png", "trajectory.txt"):
        (tmp_path / stale).touch()
    mapped(*other[1:], "--overwrite")
    assert report_of(tmp_path)["keyframes"] == 3
    assert {path.name for path in tmp_path.iterdir()} == FILES


def test_a_run_without_a_voxel_size_takes_what_fits_and_is_the_same_run_again(
    recording: Path, tmp_path: Path
) -> None:
    for path in sorted(recording.glob("*.depth.png")):
        cv2.imwrite(str(path), np.full((480, 640), 8500, np.uint16))
    assert_refused(
        taichi_mrf("map", recording, "--out", tmp_path / "no", "--voxel-size", "5"), "was 5cm meant?"
    )
    words = ("--out", tmp_path / "out", "--no-pictures", "--runtime.arch", "cpu", "--image-scale", "0.25")
    said = mapped(recording, *words)
    assert "voxel_size is 0.1 m" in said
    assert load(tmp_path / "out" / "config.yaml").voxel_size == 0.1
    assert "already holds this run" in mapped(recording, *words)
    finer = taichi_mrf("map", recording, *words, "--voxel-size", "5cm")
    assert_refused(finer, "another voxel_size", "--overwrite")


def test_an_unfinished_run_is_resumed_or_replaced(tmp_path: Path) -> None:
    mapped(ROOM, "--out", tmp_path, "--limit", "2", *FAST)
    report = report_of(tmp_path) | {"interrupted": True}
    (tmp_path / "report.json").write_text(json.dumps(report))
    again = ("map", ROOM, "--out", tmp_path, "--limit", "2", *FAST)
    assert_refused(taichi_mrf(*again), "unfinished run", "--resume continues it", "--overwrite starts anew")
    (tmp_path / "report.json").unlink()
    assert_refused(taichi_mrf(*again), "holds files of another run", "--overwrite")
    mapped(*again[1:], "--overwrite")
    assert report_of(tmp_path)["interrupted"] is False


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["synthetic:romm"], ["did you mean 'synthetic:room'"]),
        (["no/such/folder"], ["no/such/folder", "no such folder"]),
        ([ROOM, "--voxel-size", "-0.05"], ["voxel_size must be a positive number of metres, not -0.05"]),
        ([ROOM, "--every", "0"], ["--every must be at least 1"]),
        ([ROOM, "--limit", "0"], ["--limit must be at least 1"]),
        ([ROOM, "--inference.free-share", "1.5"], ["inference.free_share must lie between 0 and 1"]),
        ([ROOM, "--inference.damping", "0.5"], ["damping is no longer a parameter: messages"]),
        ([ROOM, "--log-odds.hit", "0.8"], ["set log_odds.hit in the file of --config"]),
        ([ROOM, "--visibility.q-max", "0.8"], ["set in Python, VisibilityConfig(q_max=...)"]),
        ([ROOM, "--config", "no.yaml"], ["no.yaml", "no such file"]),
        ([ROOM, "--voxel-size", "0.00002", "--runtime.arch", "cpu"], ["GB"]),
    ],
)
def test_bad_input_is_one_line_and_leaves_nothing(
    tmp_path: Path, arguments: list[str], words: list[str]
) -> None:
    assert_refused(taichi_mrf("map", *arguments, "--out", tmp_path / "a" / "b"), *words)
    assert list(tmp_path.iterdir()) == []


def test_one_file_of_a_recording_names_its_folder(recording: Path, tmp_path: Path) -> None:
    done = taichi_mrf("map", recording / "frame-000000.depth.png", "--out", tmp_path / "out")
    assert_refused(done, f"is one file of a recording (7-Scenes): pass its folder, {recording}")


def test_an_unknown_key_names_the_nearest(tmp_path: Path) -> None:
    (tmp_path / "my.yaml").write_text("inference: {sweps: 1}\n")
    done = taichi_mrf("map", ROOM, "--out", tmp_path / "out", "--config", tmp_path / "my.yaml")
    assert_refused(done, "my.yaml", "sweps", "did you mean 'sweeps'")


def test_an_unknown_flag_is_a_usage_error_that_names_the_nearest(tmp_path: Path) -> None:
    done = taichi_mrf("map", ROOM, "--out", tmp_path / "out", "--inference.sweps", "1")
    assert_refused(done, "map: unknown flag --inference.sweps; did you mean --inference.sweeps?")


def test_an_empty_folder(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    done = taichi_mrf("map", tmp_path / "empty", "--out", tmp_path / "out", *FAST)
    assert_refused(done, str(tmp_path / "empty"), "empty")
    assert not (tmp_path / "out").exists()


def damage_image(folder: Path) -> None:
    (folder / "frame-000001.depth.png").write_bytes(b"no image")


def wrong_type(folder: Path) -> None:
    cv2.imwrite(str(folder / "frame-000001.depth.png"), np.full((480, 640, 3), 150, np.uint8))


def no_pose(folder: Path) -> None:
    (folder / "frame-000001.pose.txt").unlink()


@pytest.mark.parametrize("damage", [damage_image, wrong_type, no_pose])
def test_a_broken_frame_is_named_or_skipped(
    tmp_path: Path, recording: Path, damage: Callable[[Path], None]
) -> None:
    damage(recording)
    out = tmp_path / "out"
    assert_refused(taichi_mrf("map", recording, "--out", out, *FAST), "frame-000001")
    assert not out.exists()
    printed = mapped(recording, "--out", out, "--skip-bad-frames", *FAST)
    report = report_of(out)
    assert list(report["skipped_frames"]) == ["frame-000001"]
    assert report["skipped_frames"]["frame-000001"].split()[0] in printed
    assert report["keyframes"] == 2


def test_a_recording_of_broken_frames_only_is_an_error(tmp_path: Path, recording: Path) -> None:
    for path in recording.glob("*.depth.png"):
        path.write_bytes(b"")
    done = taichi_mrf("map", recording, "--out", tmp_path / "out", "--skip-bad-frames", *FAST)
    assert_refused(done, "3 could not be used")


def test_an_output_that_cannot_be_written_is_found_before_mapping(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    assert_refused(taichi_mrf("map", ROOM, "--out", tmp_path / "file", *FAST), str(tmp_path / "file"))
    assert_refused(taichi_mrf("map", ROOM, "--out", tmp_path / "file" / "out", *FAST), "cannot be made")
    if os.geteuid() != 0:
        (tmp_path / "closed").mkdir(mode=0o500)
        done = taichi_mrf("map", ROOM, "--out", tmp_path / "closed" / "out", *FAST)
        assert_refused(done, str(tmp_path / "closed"), "Permission denied")


# The kernels of the first run are compiled: files of their cache would meet the limit first.
@pytest.mark.usefixtures("room")
def test_a_full_disk_names_the_file_and_leaves_no_half(tmp_path: Path) -> None:
    out = tmp_path / "out"
    with files_up_to(20_000):
        done = taichi_mrf("map", ROOM, "--out", out, *FAST, "--quiet")
    assert_refused(done, str(out / "map.npz"), "cannot be written")
    assert not out.exists()


LONG = "synthetic:room?frames=300&width=80&height=60"
"""A recording that is stopped long before its end."""


def assert_stopped(out: Path) -> None:
    """A run was stopped early and left its map, and nothing that takes long."""
    report = report_of(out)
    assert report["interrupted"] is True
    assert 0 < report["keyframes"] < 270
    assert {path.name for path in out.iterdir()} == FILES - {"voxels.ply"}
    assert report["accuracy"] is report["free_space"] is None
    assert any(
        note.startswith("Left out, because the run was stopped: voxels.ply") for note in report["notes"]
    )


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_stopped_run_saves_the_map_and_leaves_out_what_takes_long(
    tmp_path: Path, number: signal.Signals
) -> None:
    with signalled(number, "Adding", step=3):
        done = taichi_mrf("map", LONG, "--out", tmp_path / "out", *COARSE)
    assert done.returncode == 128 + number, done.stderr
    assert_stopped(tmp_path / "out")
    assert "voxels.ply, the check against held-out frames, the pictures; --resume makes it" in done.stdout
    assert report_of(tmp_path / "out")["sweeps"] == 1


@pytest.mark.parametrize(
    ("stage", "missing"), [("Writing", "voxels.ply, the check"), ("Drawing", "the pictures")]
)
def test_what_a_stop_at_the_end_leaves_out_is_made_by_resume(
    tmp_path: Path, stage: str, missing: str
) -> None:
    with signalled(signal.SIGINT, stage, step=0):
        done = taichi_mrf("map", ROOM, "--out", tmp_path, *COARSE)
    assert done.returncode == 130, done.stderr
    assert f"Left out, because the run was stopped: {missing}" in done.stdout
    assert report_of(tmp_path)["interrupted"] is True
    mapped(ROOM, "--out", tmp_path, "--resume")
    assert report_of(tmp_path)["interrupted"] is False
    assert report_of(tmp_path)["accuracy"] is not None
    assert {path.name for path in tmp_path.iterdir()} == FILES | PICTURES


@pytest.mark.parametrize(("number", "flags"), [(signal.SIGINT, FAST), (signal.SIGHUP, COARSE)])
def test_a_process_on_a_terminal_keeps_what_is_mapped(
    tmp_path: Path, number: signal.Signals, flags: tuple[str, ...]
) -> None:
    """Ctrl-C, and SIGHUP, which comes with the end of the terminal, as when a connection breaks."""
    main_end, program_end = pty.openpty()
    with subprocess.Popen(
        [sys.executable, "-m", "taichi_mrf", "map", LONG, "--out", tmp_path / "out", *flags],
        stdin=program_end,
        stdout=program_end,
        stderr=program_end,
        preexec_fn=obey_hangups,
    ) as process:
        os.close(program_end)
        shown = b""
        while b"Adding" not in shown:
            shown += os.read(main_end, 4096)
        process.send_signal(number)
        if number == signal.SIGINT:
            with suppress(OSError):  # the other end is closed: the program has ended
                while os.read(main_end, 4096):
                    pass
        os.close(main_end)
    assert process.returncode == {signal.SIGINT: 130}.get(number, 128 + number)
    assert_stopped(tmp_path / "out")


def test_ctrl_c_twice_aborts_and_leaves_nothing(tmp_path: Path) -> None:
    with signalled(signal.SIGINT, "Adding", step=3, times=2):
        done = taichi_mrf("map", LONG, "--out", tmp_path / "out", *FAST)
    assert (done.returncode, complaints(done.stderr)) == (130, "taichi-mrf: aborted\n")
    assert not (tmp_path / "out").exists()


def test_resume_ends_in_the_map_of_one_run(tmp_path: Path, room: tuple[Path, str]) -> None:
    mapped(ROOM, "--out", tmp_path, "--limit", "5", *FAST)
    mapped(ROOM, "--out", tmp_path, "--resume", "--no-pictures")
    whole, resumed = report_of(room[0]), report_of(tmp_path)
    assert resumed["keyframes"] == whole["keyframes"]
    assert resumed["rays"] == whole["rays"]
    expected, got = marginals(room[0]), marginals(tmp_path)
    common = expected.keys() & got.keys()
    assert len(common) > 0.999 * max(len(expected), len(got))
    close = sum(abs(expected[key] - got[key]) < 0.01 for key in common)
    assert close > 0.999 * len(common)


def test_resume_with_other_parameters_is_refused(tmp_path: Path) -> None:
    mapped(ROOM, "--out", tmp_path, "--limit", "2", *FAST)
    done = taichi_mrf("map", ROOM, "--out", tmp_path, "--resume", "--voxel-size", "0.2")
    assert_refused(done, "config.yaml", "voxel_size")


def test_resume_without_an_earlier_run_starts_one(tmp_path: Path) -> None:
    mapped(ROOM, "--out", tmp_path, "--limit", "2", "--resume", *FAST)
    assert report_of(tmp_path)["keyframes"] == 2


@pytest.mark.shared_data
def test_real_frames(tmp_path: Path, shared_data: Path) -> None:
    source = shared_data / "seven_scenes_redkitchen"
    mapped(source, "--out", tmp_path, "--limit", "12", "--runtime.arch", "cpu", "--no-pictures")
    report = report_of(tmp_path)
    assert report["keyframes"] == 11
    assert report["accuracy"]["median_abs"] < 0.05
