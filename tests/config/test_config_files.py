"""Parameter files: the shipped ones by name, and YAML that is read without trust."""

from pathlib import Path

import pytest

from taichi_mrf.config.files import find_config, parse_yaml, read_yaml, shipped_configs
from taichi_mrf.config.schema import Config, load
from taichi_mrf.config.values import from_dict
from taichi_mrf.errors import ConfigError

BOMB = "a: &a [x, x, x, x, x, x, x, x, x]\n" + "\n".join(
    f"{b}: &{b} [{', '.join([f'*{a}'] * 9)}]" for a, b in zip("abcdefghijklm", "bcdefghijklmn", strict=True)
)
"""Under a kilobyte, which stands for 9^14 words."""


def test_every_shipped_configuration_is_found_by_its_name(repository: Path) -> None:
    shipped = shipped_configs()
    assert sorted(shipped) == sorted(path.stem for path in (repository / "configs").glob("*.yaml"))
    assert {"default", "kinect1"} <= shipped.keys()
    for name, path in shipped.items():
        assert find_config(name) == find_config(f"{name}.yaml") == path
    assert load("kinect1") == load(repository / "configs" / "kinect1.yaml")


def test_a_file_of_ones_own_comes_before_the_shipped_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "kinect1.yaml").write_text("voxel_size: 0.5")
    assert load("kinect1.yaml").voxel_size == 0.5
    (tmp_path / "kinect1").mkdir()
    assert find_config("kinect1") == shipped_configs()["kinect1"]


def test_a_name_that_does_not_exist_is_an_error_that_lists_those_that_do(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"kinetc: no such file.*default, kinect1"):
        load("kinetc")
    with pytest.raises(ConfigError, match="kinect1: no such file"):
        load(tmp_path / "kinect1")


def test_aliases_of_aliases_are_refused_at_once(tmp_path: Path) -> None:
    assert len(BOMB) < 1000
    path = tmp_path / "bomb.yaml"
    path.write_text(BOMB)
    with pytest.raises(ConfigError, match=r"bomb\.yaml: not valid YAML: aliases \(\*name\) are not"):
        load(path)
    for text in ("a: &a 1\nb: *a", "a: &a [*a]", "a: &a {b: 1}\nc: {<<: *a}"):
        with pytest.raises(ValueError, match="aliases"):
            parse_yaml(text)


def test_a_file_is_no_larger_than_parameters_are(tmp_path: Path) -> None:
    path = tmp_path / "large.yaml"
    path.write_text("# " + 2_000_000 * "x")
    with pytest.raises(ConfigError, match=r"large\.yaml: has 2,000,002 bytes; at most 1,000,000"):
        read_yaml(path)


def test_an_error_shows_neither_all_of_a_value_nor_its_control_characters(tmp_path: Path) -> None:
    path = tmp_path / "a.yaml"
    path.write_text('"\\e[2J": 1')
    with pytest.raises(ConfigError) as caught:
        load(path)
    assert "\x1b" not in str(caught.value)
    assert "x1b[2J" in str(caught.value)
    with pytest.raises(ConfigError) as caught:
        from_dict(Config, [list(range(100))] * 100, "a.yaml")
    assert len(str(caught.value)) < 300
