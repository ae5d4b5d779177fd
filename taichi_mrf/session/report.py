"""The contents of ``report.json``: the facts of a mapping run as plain values."""

import dataclasses
import json
import math
from typing import Any

import taichi_mrf
from taichi_mrf.datasets import Dataset
from taichi_mrf.evaluation.held_out import HeldOutCheck
from taichi_mrf.mapping.onto import Placed
from taichi_mrf.mapping.refinement import PoseChange
from taichi_mrf.mapping.result import MappingResult
from taichi_mrf.mapping.step_check import StepCheck
from taichi_mrf.mapping.tracking import Track
from taichi_mrf.system import runtime
from taichi_mrf.system.memory import peak_memory_mb

_REFINED_NOTE = "Accuracy is that of the held-out frames at their recorded poses, which were not refined."
_TRACKED_NOTE = "Accuracy is that of the held-out frames where tracking found them: it does not show drift."


def run_report(
    result: MappingResult, dataset: Dataset | None, source: str, check: HeldOutCheck | None
) -> dict[str, Any]:
    """The facts of a run as plain values, lengths in metres. ``dataset`` is None for a saved map that was
    opened again; ``accuracy`` is None unless held-out frames were compared, ``did_not_fit`` unless memory
    ran out, ``refused`` unless the recording contradicts the map (folder.py)."""
    statistics = result.map.statistics()
    choice = runtime.choice()
    return {
        "source": source,
        "method": result.map.config.method,
        "version": taichi_mrf.__version__,
        "compiler": choice.compiler if choice else None,
        "backend": choice.name if choice else None,
        "device": choice.device if choice else None,
        "interrupted": result.interrupted or result.full is not None,
        "did_not_fit": result.full,
        "refused": None,
        "frames": result.frames,
        "keyframes": len(result.map.keyframes),
        "keyframes_before": result.before,
        "frozen": statistics.frozen,
        "rays": sum(keyframe.rays for keyframe in result.map.keyframes.values()),
        "voxel_size": result.map.voxel_size,
        "bricks": statistics.bricks,
        "voxels": statistics.voxels,
        "map_memory_mb": round(statistics.memory_mb, 3),
        "peak_memory_mb": peak_memory_mb(),
        "sweeps": result.sweeps,
        "residual": result.residual,
        "seconds": rounded(result.seconds),
        "accuracy": None if check is None else {"frames": check.frames, **dataclasses.asdict(check.error)},
        "free_space": None if result.map.promise is None else result.map.promise.to_json(),
        "noise": None,
        "located": dataset.located.to_json() if isinstance(dataset, Placed) else None,
        "tracking": None if result.track is None else _tracking(result.track, result.loops_closed),
        "followed": None if result.followed is None else dataclasses.asdict(result.followed),
        "steps": None if result.steps is None else _steps_report(result.steps),
        "poses": [_pose_report(change) for change in result.poses],
        "skipped_frames": result.skipped,
        "dropped_frames": 0 if dataset is None else dataset.dropped,
        "notes": [
            *([] if dataset is None else dataset.notes),
            *([result.doubt] if result.doubt else []),
            *_pose_notes(result, check is not None),
            *_lost_notes(result.track),
            *_step_notes(result.steps),
        ],
    }


def rounded(seconds: dict[str, float]) -> dict[str, float]:
    """The seconds of each stage, to milliseconds."""
    return {stage: round(value, 3) for stage, value in seconds.items()}


def _tracking(track: Track, loops_closed: int) -> dict[str, Any]:
    return {
        "frames": len(track.frames),
        "lost": track.lost,
        "found_again": track.found_again,
        "unsure": track.unsure,
        "loops_closed": loops_closed,
    }


def _lost_notes(track: Track | None) -> list[str]:
    if track is None or not track.lost:
        return []
    again = ", ".join(f"at {name} after {lost} lost frames" for name, lost in track.found_again.items())
    return [
        f"{track.lost} frames are not in the map, because the camera was lost. "
        + (f"It was found again {again}." if again else "It was not found again.")
    ]


def unfinished_report(
    result: MappingResult, dataset: Dataset | None, source: str, skipped: dict[str, str]
) -> dict[str, Any]:
    """The report of a run that is not finished, for the files that a crash would leave. ``skipped`` are the
    unreadable frames of the run that this one resumes."""
    report = run_report(result, dataset, source, None)
    return {**report, "interrupted": True, "skipped_frames": skipped | report["skipped_frames"]}


def _pose_report(change: PoseChange) -> dict[str, Any]:
    return {
        "keyframe": change.name,
        "moved_m": round(change.translation_m, 6),
        "turned_rad": round(change.rotation_rad, 6),
        "T_recorded": change.T_recorded.tolist(),
        "T_refined": change.T_refined.tolist(),
    }


def _pose_notes(result: MappingResult, checked: bool) -> list[str]:
    """Notes on what the accuracy means where poses are not the recorded ones."""
    if not checked:
        return []
    if result.track is not None:
        return [_TRACKED_NOTE]
    return [_REFINED_NOTE] if result.poses else []


def _steps_report(steps: StepCheck) -> dict[str, Any]:
    return {
        "aligned_over_recorded": round(steps.ratio, 4),
        "deviation": round(steps.deviation, 4),
        "pairs": steps.pairs,
        "disagree": steps.disagrees,
    }


def _step_notes(steps: StepCheck | None) -> list[str]:
    if steps is None or not steps.disagrees:
        return []
    return [
        "Depth and poses disagree, which smears the map: by its depth images the camera moves "
        f"{steps.ratio:.3f} times as far as by its poses (median of {steps.pairs} pairs of keyframes, "
        f"+-{steps.deviation:.3f}). Check the depth scale, the stereo baseline and the unit of the poses."
    ]


def report_json(report: dict[str, Any]) -> str:
    """The report as JSON text, in which numbers that are not finite are null."""
    return json.dumps(_finite(report), indent=2) + "\n"


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(each) for key, each in value.items()}
    if isinstance(value, list):
        return [_finite(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
