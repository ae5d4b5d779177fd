"""A recording in files: the one reader behind every folder format.

A format only lists where each frame's files are; all checks on a frame are made here, when it is read.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from taichi_mrf.datasets.base import Dataset
from taichi_mrf.datasets.images import read_color, read_depth
from taichi_mrf.errors import DatasetError, FrameError, KeyframeError
from taichi_mrf.geometry.poses import Pose
from taichi_mrf.sensor.frame import Frame


@dataclass(frozen=True)
class RecordedFrame:
    """Where one frame's parts are.

    ``read_pose`` gives T_world_camera. It raises DatasetError, which names the file, or KeyframeError
    for a pose that is none; ``pose_source`` then says where that stands (a file, or a file and a line).
    """

    name: str
    stamp: float
    depth_file: Path
    read_pose: Callable[[], Pose]
    pose_source: str
    color_file: Path | None = None


@dataclass
class Recording(Dataset):
    """Frames in files, read when asked for.

    ``steps_per_metre`` is the scale of the depth images, ``sentinel`` a value of theirs that means no
    measurement (beside 0).
    """

    frames: Sequence[RecordedFrame] = ()
    steps_per_metre: float = 1000.0
    sentinel: int | None = None
    color: bool = True
    _names: list[str] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        self._names = [frame.name for frame in self.frames]

    @property
    def frame_names(self) -> Sequence[str]:
        """What errors and reports call the frames, in their order."""
        return self._names

    def read(self, index: int) -> Frame:
        """Read one frame from disk.

        Raises FrameError, which names the frame and the file, if the depth or colour image is missing,
        damaged, of the wrong type or of another size than the camera's, or if there is no pose, one
        with NaN, or one whose rotation is none. Raises IndexError outside 0 to len - 1.
        """
        if not 0 <= index < len(self.frames):
            raise IndexError(f"{self.name} has {len(self.frames)} frames, there is no frame {index}")
        recorded = self.frames[index]
        try:
            T_world_camera = recorded.read_pose()
        except KeyframeError as error:
            raise FrameError(f"frame {recorded.name}: {recorded.pose_source}: {error}") from error
        except DatasetError as error:
            raise FrameError(f"frame {recorded.name}: {error}") from error
        color = None
        try:
            depth_m = read_depth(recorded.depth_file, self.steps_per_metre, self.sentinel, self.camera)
            if self.color and recorded.color_file is not None:
                color = read_color(recorded.color_file, self.camera)
        except DatasetError as error:
            raise FrameError(f"frame {recorded.name}: {error}") from error
        return Frame(depth_m, T_world_camera, self.camera, recorded.stamp, recorded.name, color)
