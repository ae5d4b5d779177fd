"""What a live run maps: a source of frames with a new map, or a map from a file."""

import dataclasses
from functools import partial
from pathlib import Path

from taichi_mrf.config.schema import Config
from taichi_mrf.datasets import open_dataset
from taichi_mrf.datasets.formats import frames_npz
from taichi_mrf.datasets.source_flags import SourceFlags
from taichi_mrf.live.replay import Replay
from taichi_mrf.live.run import Source, saved_unsettled
from taichi_mrf.methods.map_file import open_map_file, read_header
from taichi_mrf.methods.registry import create_map, load_map
from taichi_mrf.system import runtime
from taichi_mrf.system.files import is_file


def open_source(
    name: str,
    config: Config,
    *,
    every: int,
    limit: int | None,
    speed: float,
    loop: bool,
    reading: SourceFlags | None = None,
    track: bool = False,
) -> tuple[Source, list[str]]:
    """Start Taichi and open a source, read as ``reading`` says; returns it with sentences that the user
    should see. With ``track`` the poses of its frames are to be found.

    Raises TaichiMRFError: DatasetError, MapFileError, BackendError, ConfigError.
    """
    runtime.init(config.runtime.arch, config.runtime.threads, config.runtime.debug)
    path = Path(name)
    if path.suffix == ".npz" and is_file(path) and not frames_npz.FORMAT.recognises(path):
        with open_map_file(path) as file:
            header = read_header(path, file)
        parameters = dataclasses.replace(header.config, runtime=config.runtime)
        notes = [f"{path.name} is a saved map: its own parameters are in force."]
        if not header.settled:
            notes.append(saved_unsettled(path.name))
        return Source(path.name, parameters, lambda: load_map(path)), notes
    dataset = open_dataset(name, color=False, track=track, **(reading or SourceFlags()).keywords())

    def new_replay() -> Replay:
        hold_out = config.evaluation.hold_out
        return Replay(dataset, every=every, limit=limit, loop=loop, hold_out=hold_out, speed=speed)

    new_map = partial(create_map, config, dataset.camera)
    return Source(name, config, new_map, new_replay, dataset.tracked), dataset.notes
