"""A map in submaps has the layers of all images beside depth, as the map of a single machine has them."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from in_process import InProcess
from label_layer import ENTRY, LABELS
from label_recording import write_scene

from taichi_mrf.cluster.submaps.plan import PLAN_FILE, Job, SourceFrames
from taichi_mrf.cluster.submaps.rounds import SubmapsResult, map_in_submaps
from taichi_mrf.config.schema import Config, EvaluationConfig
from taichi_mrf.config.sections import InferenceConfig
from taichi_mrf.datasets.source_flags import SourceFlags
from taichi_mrf.mapping.pipeline import map_sequence
from taichi_mrf.methods.chunked import ChunkedMap
from taichi_mrf.voxels.layers import FIRST, LAYERS, LOG_ODDS, SURFACE

pytest.importorskip("zarr", reason="maps in chunks need the extra store")
pytestmark = pytest.mark.usefixtures("one_backend")

CONFIG = Config(0.05, inference=InferenceConfig(outlier_floor=1e-6), evaluation=EvaluationConfig(hold_out=0))


@pytest.fixture(autouse=True)
def label_entry(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(LAYERS, LABELS, ENTRY)


def walk(folder: Path) -> SourceFrames:
    write_scene(folder / "walk")
    return SourceFrames(str(folder / "walk"), SourceFlags(depth_scale=1000.0).keywords())


def mapped(sequence: SourceFrames, config: Config, folder: Path, rounds: int) -> SubmapsResult:
    return map_in_submaps(
        sequence, config, 1.0, folder / "submaps", folder / "map.zarr", InProcess(),
        rounds=rounds, settled=-1.0, resume=True,
    )  # fmt: skip


def test_the_layer_is_that_of_a_single_machine(tmp_path: Path) -> None:
    sequence = walk(tmp_path)
    m = map_sequence(sequence.open(), CONFIG).map
    centres = m.voxels(0.5)[0]
    whole = m.pixel_layers[LABELS].at(centres).astype(int)
    seen = whole.any(axis=1)
    assert seen.mean() > 0.9
    for rounds in (0, 2):  # the second goes on with the first
        result = mapped(sequence, CONFIG, tmp_path, rounds)
        assert len(result.job.plan.submaps) == 4
        found = ChunkedMap.open(tmp_path / "map.zarr")
        assert found.store.layers == (LOG_ODDS, LABELS)
        parts = found.pixel_layers[LABELS].at(centres).astype(int)
        assert (np.abs(parts - whole)[seen].max(axis=1) <= 8).mean() > 0.99  # of a pixel
        assert (parts.argmax(axis=1) == whole.argmax(axis=1))[seen].mean() > 0.99


def test_the_plan_keeps_the_names_of_the_images(tmp_path: Path) -> None:
    config = replace(CONFIG, keep_surface=True)
    mapped(walk(tmp_path), config, tmp_path, 0)
    job = Job.read(tmp_path / "submaps")
    assert job.images == (LABELS,)
    assert job.layers == (LABELS, SURFACE, FIRST)
    assert set(ChunkedMap.open(tmp_path / "map.zarr").store.layers) == {LOG_ODDS, *job.layers}
    plan = json.loads((tmp_path / "submaps" / PLAN_FILE).read_text())
    del plan["images"]  # as in plans of earlier versions
    (tmp_path / "submaps" / PLAN_FILE).write_text(json.dumps(plan))
    assert Job.read(tmp_path / "submaps").layers == (SURFACE, FIRST)


def test_a_recording_without_such_images_has_no_layer(tmp_path: Path) -> None:
    sequence = walk(tmp_path)
    (tmp_path / "walk" / LABELS).rename(tmp_path / "aside")
    mapped(sequence, CONFIG, tmp_path, 0)
    assert ChunkedMap.open(tmp_path / "map.zarr").store.layers == (LOG_ODDS,)
