"""Sigma learnt from the mapped views of a scene, as ``map --noise auto`` learns it from a recording."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from taichi_mrf.calibration.from_recording import learn_sigma
from taichi_mrf.config.schema import SensorConfig
from taichi_mrf.datasets import Dataset
from taichi_mrf.evaluation.experiments.contenders import Contender
from taichi_mrf.evaluation.experiments.folds import Experiment
from taichi_mrf.evaluation.experiments.ledger import Result
from taichi_mrf.evaluation.experiments.scenes import Scene
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.sensor.noise import widened_noise


@dataclass
class SceneFrames(Dataset):
    """Views as a recording, each of which states the noise of its scene."""

    frames: Sequence[Frame] = ()

    @property
    def frame_names(self) -> Sequence[str]:
        """The views' names."""
        return [frame.name for frame in self.frames]

    def read(self, index: int) -> Frame:
        """A view."""
        return self.frames[index]


def frames_of(scene: Scene, indices: Sequence[int]) -> SceneFrames:
    """Some views of a scene as a recording."""
    frames = [
        Frame(
            view.measured_m, view.T_world_camera, view.camera or scene.camera, float(i), view.name,
            noise=scene.noise,
        )
        for i, view in ((i, scene.views[i]) for i in indices)
    ]  # fmt: skip
    return SceneFrames(scene.name, scene.camera, frames=frames)


def noise_key(scene: Scene, voxel_size: float) -> str:
    """Begin of the ledger's entries about a scene's noise."""
    return f"{scene.name} | {len(scene.views)} views | {voxel_size:g} m"


def learnt_law(
    experiment: Experiment, given: Contender, scene: Scene, voxel_size: float, keyframes: Sequence[int]
) -> Result:
    """Noise of a scene by its mapped views: ``scale`` and ``added_m`` of the law, the single
    ``factor``, and ``prior``, parameters of inference that come with it. Maps are those of ``given``."""

    def learn() -> Result:
        found = learn_sigma(frames_of(scene, keyframes), given.make(scene, voxel_size).config)
        law = {"scale": found.law.scale, "added_m": found.law.added_m, "factor": found.factor}
        return law | {"prior": found.prior}

    return experiment.ledger.result(f"{noise_key(scene, voxel_size)} | learnt", learn)


def with_law(scene: Scene, law: Result) -> Scene:
    """The scene with the learnt noise."""
    wider = SensorConfig(sigma_scale=law["scale"], sigma_added=law["added_m"])
    return replace(scene, noise=widened_noise(scene.noise, wider))
