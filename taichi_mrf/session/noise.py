"""Noise section of a run's report: whether held-out frames agree with it, and what was learnt of it."""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import yaml

from taichi_mrf.calibration.from_recording import NOISE, LearntSigma
from taichi_mrf.config.schema import SensorConfig
from taichi_mrf.evaluation.noise_fit import NoiseCheck, SigmaLaw

NO_NOISE = 8.0
"""No sensor's noise differs from a stated one by so large a factor: what is wrong is something else."""

HIDDEN, LEAST_HIDDEN_GAIN = 3.0, 0.005
"""A larger factor is told where it gains few nats a pixel, too, from so many on."""


def noise_report(
    sensor: SensorConfig, check: NoiseCheck | None, learnt: LearntSigma | None
) -> dict[str, Any]:
    """The entry ``noise`` of a report: ``factor`` is what sigma would have to be multiplied by, ``gain`` by
    how many nats each measurement would then be likelier; both None if nothing was held out."""
    report: dict[str, Any] = {
        "sigma_scale": sensor.sigma_scale,
        "sigma_added": sensor.sigma_added,
        "factor": None,
        "gain": None,
        "wrong": None,
        "frames": 0,
        "learnt": None,
    }
    if check is not None:
        report |= {"factor": round(check.factor, 3), "gain": round(check.gain, 3)}
        report |= {"wrong": check.wrong, "frames": check.frames}
    if learnt is not None:
        facts = asdict(learnt)
        del facts["law"], facts["seconds"]
        prior = facts.pop("prior")
        report["learnt"] = {name: round(value, 4) for name, value in facts.items()} | {"prior": prior}
    return report


def contradicts(check: NoiseCheck | LearntSigma | None) -> bool:
    """True if held-out frames contradict their map so much that no sensor's noise explains it."""
    return check is not None and check.factor > NO_NOISE


def noise_notes(
    sensor: SensorConfig,
    check: NoiseCheck | None,
    learnt: LearntSigma | None,
    mistakes: Sequence[str] = (),
    swept_m: float = 0.0,
) -> list[str]:
    """Notes on a run's noise; ``mistakes`` are those that a doctor finds if recording and map disagree, and
    ``swept_m`` is how far the sensor moves during an image (StatedSensor)."""
    notes = []
    if learnt is not None and learnt.law == SigmaLaw(1.0, 0.0):
        notes.append(f"The noise of depth stays as stated: {learnt.frames} held-out frames agree with it.")
    elif learnt is not None:
        notes.append(
            f"The noise of depth was learnt from {learnt.frames} held-out frames in {learnt.seconds:.1f} s, "
            f"and is in use: {_law_words(sensor.sigma_scale, sensor.sigma_added)}. There is nothing to do; "
            "--noise given takes it as stated."
        )
    if learnt is not None and learnt.prior:
        changed = ", ".join(f"inference.{name} is {value:g}" for name, value in learnt.prior.items())
        notes.append(f"Rays are long: {changed}, with which held-out measurements are likelier.")
    if check is not None and check.wrong and mistakes:
        by = f"{check.factor:.2g} times what {_noise_name(sensor)} allows"
        notes.append(f"{check.frames} held-out frames contradict the map, by {by}: {'; '.join(mistakes)}.")
    elif check is not None and check.wrong:
        notes.append(
            f"The measured depths of {check.frames} held-out frames differ from the map by "
            f"{check.factor:.2g} times what {_noise_name(sensor)} allows{_better(check.law)}. "
            f"{_advice(sensor, learnt, check)}{_sweep_words(swept_m)}"
        )
    elif check is not None and check.factor > HIDDEN and check.gain > LEAST_HIDDEN_GAIN:
        notes.append(
            f"The measured depths of {check.frames} held-out frames are likeliest with "
            f"{check.factor:.2g} times what {_noise_name(sensor)} allows, but by {check.gain:.3f} nats each "
            "only: voxels are so large that they hide the noise, and the map hardly depends on it. Smaller "
            "voxels tell more."
        )
    return notes


def _sweep_words(swept_m: float) -> str:
    if not swept_m:
        return ""
    return (
        f" Or scans were not deskewed: the lidar moves by {swept_m:.2g} m, turns counted at 10 m, in 0.1 s, "
        "the usual time of a scan, whose points have one pose here. Points with times in a bag are deskewed."
    )


def sensor_yaml(sensor: SensorConfig, source: str, learnt: LearntSigma) -> str:
    """The learnt noise as a file of parameters."""
    fields = {
        name: list(value) if isinstance(value := getattr(sensor, name), tuple) else value for name in NOISE
    }
    sections = {"sensor": fields} | ({"inference": learnt.prior} if learnt.prior else {})
    text = yaml.safe_dump(sections, sort_keys=False, default_flow_style=None)
    return (
        f"# Sigma as learnt from {learnt.frames} held-out frames of {source!r}.\n"
        "# Use it with: taichi-mrf map SOURCE --out DIR --config FILE\n" + text
    )


def _noise_name(sensor: SensorConfig) -> str:
    if sensor.sigma_table is not None:
        return f"the noise of {Path(sensor.sigma_table).name}"
    if sensor.sigma == SensorConfig().sigma:
        return "the noise of a Kinect 1 (the default of sensor.sigma)"
    return "sensor.sigma"


def _better(law: SigmaLaw | None) -> str:
    if law is None:
        return ""
    return f"; likeliest is {_law_words(law.scale, law.added_m)}"


def _law_words(scale: float, added_m: float) -> str:
    added = f" plus {100 * added_m:.2g} cm" if added_m else ""
    return f"{scale:.2g} times the stated sigma{added}"


def _advice(sensor: SensorConfig, learnt: LearntSigma | None, check: NoiseCheck) -> str:
    if learnt is not None or sensor.sigma_scale != 1 or sensor.sigma_added:
        return "It was learnt from other frames than these: poses or the scene differ along the recording."
    if check.factor < 1:
        return "The sensor is better than that; --noise auto learns its noise from the recording."
    if contradicts(check):
        return "Poses may be off, or the recording is not what it is taken for: see taichi-mrf doctor SOURCE."
    return "Poses may be off, or the noise is another sensor's; --noise auto learns it from the recording."
