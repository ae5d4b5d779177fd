"""Recordings of sensors that are no pinholes: what is passed on, and which options are refused."""

import json
from collections.abc import Sequence

import numpy as np
import pytest

from taichi_mrf.cli.main import main
from taichi_mrf.datasets import Dataset, open_dataset
from taichi_mrf.datasets.base import BuiltIn
from taichi_mrf.datasets.derived import resampled
from taichi_mrf.datasets.registry import BUILT_IN
from taichi_mrf.errors import DatasetError
from taichi_mrf.sensor.camera import PinholeCamera
from taichi_mrf.sensor.frame import Frame
from taichi_mrf.sensor.spherical import SphericalCamera

SCANNER = SphericalCamera(np.linspace(0.5, -0.5, 8), np.linspace(3.0, -3.0, 32))


class Scans(Dataset):
    """Three scans whose pixels count up."""

    @property
    def frame_names(self) -> Sequence[str]:
        return ["a", "b", "c"]

    def read(self, index: int) -> Frame:
        shape = self.camera.shape
        count = np.arange(1.0, 1.0 + shape[0] * shape[1], dtype=np.float32).reshape(shape)
        looked = {"sigma_m": 0.01 * count, "no_return": count % 2 == 0}
        return Frame(count, np.eye(4), self.camera, float(index), self.frame_names[index], **looked)


@pytest.fixture
def source(monkeypatch: pytest.MonkeyPatch) -> str:
    built_in = BuiltIn("synthetic:scans", lambda query, options: Scans("scans", SCANNER))
    monkeypatch.setitem(BUILT_IN, built_in.name, built_in)
    return built_in.name


def test_a_recording_has_any_camera(source: str) -> None:
    dataset = open_dataset(source)
    assert dataset.camera == dataset.read(0).camera == SCANNER


@pytest.mark.parametrize(
    ("option", "flag"),
    [
        ({"intrinsics": (10.0, 10.0, 4.0, 4.0)}, "--camera"),
        ({"undistort": (0.1, 0.0, 0.0, 0.0)}, "--undistort"),
        ({"image_scale": 0.5}, "--image-scale"),
    ],
)
def test_options_of_pinholes_are_refused(source: str, option: dict[str, object], flag: str) -> None:
    with pytest.raises(DatasetError, match=f"^scans: {flag} needs a pinhole camera, not a SphericalCamera$"):
        open_dataset(source, **option)  # type: ignore[arg-type]


@pytest.mark.parametrize("as_json", [False, True])
def test_info_names_the_kind_of_camera(
    source: str, as_json: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["info", source, *(["--json"] if as_json else [])]) == 0
    printed = capsys.readouterr().out
    if as_json:
        assert json.loads(printed)["camera"] == {"kind": "SphericalCamera", "width": 32, "height": 8}
    else:
        assert "SphericalCamera, 32 x 8 rays" in printed


def test_a_frame_without_more_says_nothing_of_its_pixels() -> None:
    frame = Frame(np.zeros((1, 1), np.float32), np.eye(4), PinholeCamera(1, 1, 1, 1, 0, 0), 0.0, "a")
    assert (frame.sigma_m, frame.noise, frame.no_return) == (None, None, None)


def test_what_belongs_to_pixels_is_picked_with_them() -> None:
    camera = PinholeCamera(8, 6, 9.0, 9.0, 3.5, 2.5)
    thin = resampled(Scans("scans", camera), (), 2).read(0)
    full = Scans("scans", camera).read(0)
    np.testing.assert_array_equal(thin.sigma_m, full.sigma_m[::2, ::2])
    np.testing.assert_array_equal(thin.no_return, full.no_return[::2, ::2])
    bent = resampled(Scans("scans", camera), (2.0, 0.0, 0.0, 0.0), 1).read(0)
    outside = bent.depth_m == 0
    assert outside.any()
    assert not bent.no_return[outside].any()
