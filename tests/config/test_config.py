"""Parameters: one definition, its text in YAML and back, and clear words for what is wrong."""

import dataclasses
import typing
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from taichi_mrf import MRFMap
from taichi_mrf.cli.main import main
from taichi_mrf.cli.parser import parse
from taichi_mrf.config.schema import (
    Config,
    EvaluationConfig,
    KeyframeConfig,
    PoseConfig,
    RuntimeConfig,
    SensorConfig,
    VolumeConfig,
    load,
    to_yaml,
)
from taichi_mrf.config.sections import (
    InferenceConfig,
    LogOddsConfig,
    TimeConfig,
    VisibilityConfig,
    WavemapConfig,
)
from taichi_mrf.config.text import commented_yaml, differences, field_help
from taichi_mrf.config.values import from_dict, is_in_files
from taichi_mrf.errors import ConfigError

SECTIONS = (
    Config,
    SensorConfig,
    KeyframeConfig,
    PoseConfig,
    TimeConfig,
    VolumeConfig,
    EvaluationConfig,
    RuntimeConfig,
    InferenceConfig,
    LogOddsConfig,
    VisibilityConfig,
    WavemapConfig,
)
Depths = NDArray[np.float64]
DEPTHS = np.linspace(0.4, 5.0, 50)


def numbers(least: float, most: float) -> st.SearchStrategy[float]:
    """Taichi, once started, rounds subnormal numbers to 0 in all of the process."""
    return st.floats(least, most, allow_subnormal=False)


configs = st.builds(
    Config,
    voxel_size=numbers(1e-4, 10),
    sensor=st.builds(
        SensorConfig,
        sigma=st.lists(numbers(-1e3, 1e3), min_size=1, max_size=4).map(tuple),
        patch=st.integers(1, 100),
        max_depth=numbers(1, 100),
    ),
    inference=st.builds(
        InferenceConfig,
        sweeps=st.integers(0, 10),
        renew_tolerance=numbers(0, 0.99),
        prior=st.none() | numbers(0.01, 0.99),
        outlier_floor=numbers(0, 1),
    ),
    keyframes=st.builds(KeyframeConfig, rotation=numbers(0, 4)),
    volume=st.just(VolumeConfig()) | st.just(VolumeConfig(lower=(-1.0, -2.0, -3.0), upper=(1.0, 2.0, 3.0))),
    runtime=st.builds(RuntimeConfig, threads=st.integers(0, 64)),
)


def written(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "config.yaml"
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("inference: {damping: 0.3}", "inference: damping is no longer a parameter: messages are not damped"),
        ("poses: {rounds: 5}", "poses: rounds is no longer a parameter: keyframes are aligned"),
        ("keyframes: {against: all}", "keyframes: against is no longer a parameter: a frame is compared"),
        ("visibility: {q_max: .2}", "visibility: q_max is not read from files; "
         "set it in Python, VisibilityConfig(q_max=0.2)"),
        ("wavemap: {range_sigma: 0.1}", "wavemap: range_sigma is not read from files; set it in Python"),
        ("log_odds: {max_range: 5}", "log_odds: max_range is not read from files; set it in Python"),
        ("log_odds: {update: ray, hit: .8}", "LogOddsConfig(update='ray')"),
        ("volume: {min_evidence: 1}", "VolumeConfig(min_evidence=1.0)"),
        ("sensor: {max_depth: 5}\nsensor: {min_depth: 1}", "'sensor' stands twice"),
        ("inference: {sweeps: 5, sweeps: 2}", "'sweeps' stands twice"),
    ],
)  # fmt: skip
def test_what_a_file_sets_in_vain_is_an_error(
    tmp_path: Path, text: str, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path = written(tmp_path, text)
    assert main(["map", "coffin_world:frames=2", "--out", str(tmp_path / "o"), "--config", str(path)]) == 2
    assert f"{path}: " in (words := capsys.readouterr().err)
    assert said in words


def test_a_map_made_with_a_removed_parameter_is_read_with_a_warning() -> None:
    values = {"inference": {"damping": 0.3, "sweeps": 2}}
    with pytest.warns(UserWarning, match=r"a map: inference: damping is no longer a parameter: messages"):
        found = from_dict(Config, values, "a map", of_map=True)
    assert found == dataclasses.replace(Config(), inference=InferenceConfig(sweeps=2))


def test_its_former_default_needs_no_warning(tmp_path: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert load(written(tmp_path, "inference: {damping: 0.0, return_pass: replay}\n")) == Config()


def test_what_became_of_a_parameter_is_told_in_python_too() -> None:
    with pytest.raises(ConfigError, match="plane_window is no longer a parameter"):
        MRFMap(0.1, plane_window=2.0)


@pytest.mark.parametrize("to_text", [to_yaml, commented_yaml])
@given(config=configs)
def test_yaml_reads_back_unchanged(
    tmp_path_factory: pytest.TempPathFactory, to_text: Callable[[Config], str], config: Config
) -> None:
    assert load(written(tmp_path_factory.getbasetemp(), to_text(config))) == config


def test_the_default_file_is_the_defaults_with_every_field_and_its_help(repository: Path) -> None:
    text = (repository / "configs" / "default.yaml").read_text(encoding="utf-8")
    assert load(repository / "configs" / "default.yaml") == Config()
    assert text.endswith(commented_yaml(Config()))  # if not: python docs/make_default_yaml.py
    values = yaml.safe_load(text)
    assert set(values) == names_in_files(Config)
    for field in filter(is_in_files, dataclasses.fields(Config)):
        section = getattr(Config(), field.name)
        if dataclasses.is_dataclass(section):
            assert set(values[field.name]) == names_in_files(type(section))


def names_in_files(cls: type) -> set[str]:
    return {field.name for field in dataclasses.fields(cls) if is_in_files(field)}


def test_a_file_has_at_most_fifty_parameters() -> None:
    values = yaml.safe_load(commented_yaml(Config()))
    assert sum(len(value) if isinstance(value, dict) else 1 for value in values.values()) <= 50


def test_the_defaults_of_what_they_no_longer_set_need_no_warning(tmp_path: Path) -> None:
    old = "visibility: {q_max: 0.7}\nwavemap: {beams: neighbours, max_range: 0}\nruntime: {debug: false}\n"
    old += "poses: {rounds: 2, max_rotation: 0.1, follow_quiet_s: 10}\nvolume: {dense_bricks: 256}\n"
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert load(written(tmp_path, old)) == Config()


def test_map_files_hold_what_python_alone_sets() -> None:
    config = Config(0.1, "visibility", visibility=VisibilityConfig(q_max=0.8))
    assert from_dict(Config, yaml.safe_load(to_yaml(config)), "a map") == config


@pytest.mark.parametrize("cls", SECTIONS, ids=lambda cls: cls.__name__)
def test_every_field_has_a_help_text(cls: type) -> None:
    texts = field_help(cls)
    assert list(texts) == [field.name for field in dataclasses.fields(cls)]
    assert all(len(text) > 10 and "\n" not in text for text in texts.values())


def test_the_sections_above_are_all_there_are() -> None:
    nested = {hint for hint in typing.get_type_hints(Config).values() if dataclasses.is_dataclass(hint)}
    assert nested == set(SECTIONS) - {Config}


@pytest.mark.parametrize(
    ("name", "sigma"),
    [
        ("kinect1", lambda z: 0.0012 + 0.0019 * (z - 0.4) ** 2),
        ("kinect_one", lambda z: 1e-3 * (1.5 - 0.5 * z + 0.3 * z**2)),
        ("realsense_d435", lambda z: 0.08 * z**2 / (848 / 2 * 0.05)),
        ("stereo", lambda z: 0.286 * z**2 / (0.5372 * 707.1)),
    ],
)
def test_each_sensor_file_holds_the_formula_that_it_cites(
    repository: Path, name: str, sigma: Callable[[Depths], Depths]
) -> None:
    config = load(repository / "configs" / f"{name}.yaml")
    np.testing.assert_allclose(
        np.polynomial.Polynomial(config.sensor.sigma)(DEPTHS), sigma(DEPTHS), rtol=1e-4
    )
    assert (sigma(DEPTHS) > 0).all()


def test_every_file_in_configs_loads(repository: Path) -> None:
    files = sorted((repository / "configs").glob("*.yaml"))
    assert len(files) >= 5
    for path in files:
        load(path)


def test_the_default_sensor_is_the_kinect_1(repository: Path) -> None:
    assert load(repository / "configs" / "kinect1.yaml").sensor.sigma == SensorConfig().sigma


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("voxel_sise: 0.1", "unknown parameter 'voxel_sise'; did you mean 'voxel_size'"),
        ("inference: {sweps: 2}", "inference: unknown parameter 'sweps'; did you mean 'sweeps'"),
        ("zebra: 1", "known are: voxel_size"),
        ("voxel_size: 1.0e+10", "voxel_size must be at most 1000 metres"),
        ("voxel_size: 1.0e+300", "voxel_size is too large a number: 1e+300"),
        ("voxel_size: -0.05", "voxel_size must be a positive number of metres, not -0.05"),
        ("voxel_size: .nan", "voxel_size must be a positive"),
        ("voxel_size: five", "voxel_size must be a number, not 'five'"),
        ("voxel_size: [1]", "voxel_size must be of type float"),
        ("inference: {sweeps: 2.5}", "sweeps must be of type int"),
        ("inference: {sweeps: true}", "sweeps must be of type int"),
        ("inference: {free_share: 1.5}", "free_share must lie between 0 and 1"),
        ("inference: {prior: 1.5}", "prior must lie between 0 and 1"),
        ("sensor: {no_return: mean}", "no_return must be one of ignore, free, model, not 'mean'"),
        ("visibility: {q_mex: 0.5}", "visibility: unknown parameter 'q_mex'; did you mean 'q_max'"),
        ("volume: {min_evidence: much}", "volume: min_evidence must be a number, not 'much'"),
        ("inference: 3", "inference: expected a mapping"),
        ("sensor: {sigma: 0.1}", "sigma must be a list"),
        ("sensor: {sigma: []}", "sigma needs at least one coefficient"),
        ("sensor: {max_depth: 0.05}", "max_depth must be more than sensor.min_depth"),
        ("volume: {lower: [0, 0, 0]}", "volume.lower goes with volume.upper"),
        ("volume: {lower: [0, 0, 0], upper: [1, -1, 1]}", "must lie above volume.lower on every axis"),
        ("volume: {lower: [0, 0], upper: [1, 1]}", "lower must have 3 entries, not 2"),
        ("evaluation: {hold_out: 1}", "hold_out must be 0, or at least 2"),
        ("runtime: {arch: metal}", "arch must be one of auto, cuda, vulkan, cpu"),
        ("- 1\n- 2", "expected a mapping"),
        ("a: [1", "not valid YAML"),
    ],
)
def test_what_is_wrong_is_named_in_one_line(tmp_path: Path, text: str, words: str) -> None:
    path = written(tmp_path, text)
    with pytest.raises(ConfigError) as caught:
        load(path)
    message = str(caught.value)
    assert words in message
    assert message.startswith(str(path))
    assert "\n" not in message


def test_a_file_that_is_not_there_or_not_text(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no such file"):
        load(tmp_path / "missing.yaml")
    (tmp_path / "binary.yaml").write_bytes(b"\x00\xff\xfe\x81")
    with pytest.raises(ConfigError, match="not a text file"):
        load(tmp_path / "binary.yaml")


def test_an_empty_file_is_the_defaults(tmp_path: Path) -> None:
    assert load(written(tmp_path, "")) == Config()


def test_numbers_as_yaml_writes_them(tmp_path: Path) -> None:
    config = load(written(tmp_path, "voxel_size: 1\ninference: {outlier_floor: 1e-6}"))
    assert config.voxel_size == 1.0
    assert config.inference.outlier_floor == 1e-6


@pytest.mark.parametrize(
    ("length", "size_m"), [("5cm", 0.05), ("50 mm", 0.05), ("0.2m", 0.2), ("1e1cm", 0.1), ("0.05", 0.05)]
)
def test_a_voxel_size_may_have_its_unit(tmp_path: Path, length: str, size_m: float) -> None:
    assert load(written(tmp_path, f"voxel_size: {length}")).voxel_size == size_m
    for words in (
        ["--voxel-size", length],
        [f"--voxel_size={length}"],
        ["--voxel-size=1cm", "--voxel-size", length],
    ):
        _, options = parse(["map", "x", "--out", "y", *words])
        assert options.settings.voxel_size == size_m
    assert parse(["bench", "--voxel-sizes", length, "2cm", "--frames", "3"])[1].voxel_sizes == (size_m, 0.02)


@pytest.mark.parametrize("length", ["5c", "cm", "5 ccm", "5mcm", "5km", "five cm"])
def test_what_is_no_length_is_an_error(tmp_path: Path, length: str) -> None:
    with pytest.raises(ConfigError, match="voxel_size must be a number"):
        load(written(tmp_path, f"voxel_size: {length}"))
    with pytest.raises(ConfigError, match="parsing --voxel-size"):
        parse(["map", "x", "--out", "y", "--voxel-size", length])


@pytest.mark.parametrize("command", ["map", "live", "tune"])
def test_a_voxel_size_that_nothing_gives_is_to_fit(tmp_path: Path, command: str) -> None:
    words = [command, "x", "--out", str(tmp_path / "run")]
    other, sized = tmp_path / "other.yaml", written(tmp_path, "voxel_size: 0.05")
    other.write_text("inference: {sweeps: 2}", encoding="utf-8")
    for more, fits in ([], True), (["--config", str(other)], True), (["--config", str(sized)], False):
        assert parse([*words, *more])[1].settings.fit_voxel_size == fits
        assert not parse([*words, *more, "--voxel-size", "0.05"])[1].settings.fit_voxel_size


def test_tables_are_found_from_the_files_folder(tmp_path: Path) -> None:
    config = load(written(tmp_path, "sensor: {sigma_table: tables/sigma.npy, bias_table: /abs/bias.npy}"))
    assert config.sensor.sigma_table == str((tmp_path / "tables" / "sigma.npy").resolve())
    assert config.sensor.bias_table == "/abs/bias.npy"


def test_differences_names_the_fields() -> None:
    other = dataclasses.replace(Config(), voxel_size=0.1, keyframes=KeyframeConfig(rotation=0.5))
    assert differences(Config(), other) == ["voxel_size", "keyframes.rotation"]
    assert differences(other, other) == []


@pytest.mark.parametrize("value", ["inf", "1e300", "nan", "-1", "9" * 5000])
def test_a_memory_limit_is_a_number_of_gigabytes(value: str) -> None:
    with pytest.raises(ConfigError, match="memory_limit_gb"):
        from_dict(Config, {"volume": {"memory_limit_gb": value}}, "config")
