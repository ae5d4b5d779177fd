"""The source of a mapping run: a recording is opened, refused if it is surely not read as it was written, and
asked for its noise."""

from taichi_mrf.calibration.from_recording import LearntSigma, sigma_of_glance
from taichi_mrf.cli.map.task import MapTask
from taichi_mrf.cli.shared.interrupt import StopRequest
from taichi_mrf.cli.shared.learn_noise import learn_noise
from taichi_mrf.cli.shared.progress import ProgressBar
from taichi_mrf.config.registry import METHODS
from taichi_mrf.config.schema import Config
from taichi_mrf.datasets import Dataset
from taichi_mrf.datasets.doctor.diagnosis import doubtful_at_a_glance
from taichi_mrf.datasets.recorded_noise import with_recorded_noise
from taichi_mrf.datasets.registry import is_rendered
from taichi_mrf.datasets.summary import note_unused_color
from taichi_mrf.errors import ReadWrongError
from taichi_mrf.mapping.onto import freeze_all, placed_in
from taichi_mrf.mapping.tracking import wants_color
from taichi_mrf.methods.protocol import OccupancyMap
from taichi_mrf.methods.registry import load_map
from taichi_mrf.session.files import CONFIG_FILE
from taichi_mrf.session.noise import contradicts


def open_recording(task: MapTask) -> tuple[Dataset, Config]:
    """Open the sequence; returns it and the parameters, with what it says itself of its noise. Raises
    DatasetError, and ReadWrongError unless --force is given."""
    settings = task.settings
    dataset = task.open(wants_color(settings, task.source, task.options.poses.track_poses))
    if not settings.color and METHODS[settings.method].has_colors:
        note_unused_color(dataset, task.source, task.options.reading)
    if task.options.onto is None:
        settings = with_recorded_noise(settings, dataset)
    if not task.options.force:
        _refuse_what_is_read_wrong(task, dataset)
    return dataset, settings


def located_onto(task: MapTask, dataset: Dataset) -> tuple[Dataset, OccupancyMap | None]:
    """With ``--onto``, the recording where it lies in that map, and the map; else the recording, and None.
    Raises MapFileError, and DatasetError if it is not found."""
    options = task.options
    if options.onto is None:
        return dataset, None
    m = load_map(options.onto, task.settings.volume.memory_limit_gb)
    dataset = placed_in(m, str(options.onto), dataset)
    if options.frozen:
        freeze_all(m)
    return dataset, m


def learnt_from(
    task: MapTask, dataset: Dataset, settings: Config, progress: ProgressBar, request: StopRequest
) -> LearntSigma | None:
    """Noise learnt from the recording, if that was asked for, or if it contradicts the default. A resumed run
    has learnt it, and so has an earlier map."""
    if task.options.onto is not None or (task.options.resume and (task.out / CONFIG_FILE).is_file()):
        return None
    learnt = None
    if task.options.noise.is_learnt:
        learnt = learn_noise(dataset, settings, progress, request, task.options.every, task.options.limit)
    elif task.options.noise.is_checked and not task.options.poses.follow:
        learnt = sigma_of_glance(
            dataset, settings, every=task.options.every, limit=task.options.limit, should_stop=request
        )
    # No noise is learnt from a recording that is not what it is taken for. The check of the map says so, too.
    found = task.mistakes if contradicts(learnt) else []
    if found and not task.options.force:
        raise ReadWrongError(f"{task.source}: {'; '.join(found)}; --force maps it as it is read")
    if found and not settings.evaluation.hold_out:
        dataset.notes.append(f"frames contradict each other: {'; '.join(found)}")
    return None if found else learnt


def _refuse_what_is_read_wrong(task: MapTask, dataset: Dataset) -> None:
    """Raise ReadWrongError for a recording whose frames explain each other in another reading only. Built-in
    scenes are what they are."""
    if is_rendered(task.source) or task.options.poses.follow or not doubtful_at_a_glance(dataset):
        return
    found = task.mistakes
    if found:
        raise ReadWrongError(f"{task.source}: {'; '.join(found)}; --force maps it as it is read")
