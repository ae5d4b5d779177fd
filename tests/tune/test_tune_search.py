"""The automatic search: where it looks, that it can be repeated, and what it is compared with."""

import dataclasses
import math
import sys

import pytest
from tune_scene import CONFIG, working_set

from taichi_mrf.config.schema import Config, SensorConfig
from taichi_mrf.config.sections import InferenceConfig
from taichi_mrf.config.text import differences
from taichi_mrf.errors import ConfigError
from taichi_mrf.tune.search import DEFAULT_SEARCH, SIGMA_SCALE, Search, dimensions
from taichi_mrf.tune.trial import FOUND, SHIPPED, STARTED, contenders, judge_unseen, verdict_lines
from taichi_mrf.viewer.tune.knobs import KNOBS
from taichi_mrf.viewer.tune.messages import Verdict

pytest.importorskip("optuna", reason="the search needs Optuna (extra: auto)")


def asked(seed: int, tries: int = 8) -> list[Config]:
    search = Search(CONFIG, ("inference.surface_density", "inference.sweeps"), tries, seed)
    found = []
    while not search.done:
        found.append(search.ask())
        assert search.ask() is found[-1]
        search.tell(-abs(found[-1].inference.surface_density - 5.0))
    return found


def test_the_first_try_is_where_the_search_begins() -> None:
    search = Search(CONFIG, DEFAULT_SEARCH, 2, seed=0)
    assert search.ask() == CONFIG
    search.tell(1.0)
    second = search.ask()
    assert set(differences(CONFIG, second)) == {
        "inference.surface_density",
        "inference.outlier_floor",
        "inference.free_share",
        "sensor.sigma_scale",
    }
    assert search.best == CONFIG


def test_a_search_can_be_repeated_by_its_seed() -> None:
    assert asked(1) == asked(1)
    assert asked(1) != asked(2)


def test_it_comes_nearer_to_what_is_likeliest() -> None:
    best = max(asked(0, tries=40), key=lambda config: -abs(config.inference.surface_density - 5.0))
    assert abs(best.inference.surface_density - 5.0) < 0.5


def test_the_smallest_depth_error_can_be_the_objective() -> None:
    search = Search(CONFIG, (), 3, seed=0, objective="depth-error")
    tried = []
    for error_m in (0.02, 0.01, 0.03):
        tried.append(search.ask())
        search.tell(error_m)
    assert search.best == tried[1]


def test_a_failed_try_counts_but_is_never_the_best() -> None:
    search = Search(CONFIG, ("inference.free_share",), 2, seed=0)
    search.ask()
    search.tell(math.nan)
    assert (search.told, search.best) == (1, None)
    only = search.ask()
    search.tell(-3.0)
    assert search.best == only
    assert search.done


def test_the_scale_of_sigma_is_searched_from_where_it_is() -> None:
    start = dataclasses.replace(CONFIG, sensor=SensorConfig(sigma_scale=2.0))
    search = Search(start, (SIGMA_SCALE,), 2, seed=0)
    assert search.ask() == start
    search.tell(0.0)
    assert differences(start, search.ask()) == [SIGMA_SCALE]


@pytest.mark.parametrize("name", [knob.name for knob in KNOBS if knob.applies(CONFIG)])
def test_everything_that_applies_can_be_searched(name: str) -> None:
    search = Search(CONFIG, (name,), 5, seed=0)
    for number in range(5):
        config = search.ask()
        field = name.partition("[")[0]
        assert set(differences(CONFIG, config)) <= {field}
        search.tell(float(number))


def test_what_cannot_be_searched_is_told_in_one_line() -> None:
    with pytest.raises(ConfigError, match=r"--search inference.swep: cannot be searched"):
        dimensions(("inference.swep",), CONFIG)
    with pytest.raises(ConfigError, match="changes nothing"):
        dimensions(("log_odds.hit",), CONFIG)


def test_a_search_of_voxel_sizes_aims_at_centimetres() -> None:
    assert Search(CONFIG, ("inference.sweeps",), 3, 0, objective="right").objective.name == "accuracy_sigma"
    of_sizes = Search(CONFIG, ("voxel_size", "inference.sweeps"), 3, 0, objective="right")
    assert of_sizes.objective.name == "accuracy_5cm"


def test_without_optuna_one_line_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "optuna", None)
    with pytest.raises(ConfigError, match=r"--auto needs optuna, .*: pip install 'taichi-mrf\[auto\]'"):
        Search(CONFIG, DEFAULT_SEARCH, 3, 0)


def test_what_was_found_is_compared_with_the_shipped_defaults_and_the_start() -> None:
    found = dataclasses.replace(CONFIG, inference=InferenceConfig(sweeps=5))
    shipped = Config(CONFIG.voxel_size)
    assert contenders(shipped, found) == [(SHIPPED, shipped), (FOUND, found)]
    start = dataclasses.replace(CONFIG, inference=InferenceConfig(sweeps=1))
    assert contenders(start, found) == [(SHIPPED, shipped), (STARTED, start), (FOUND, found)]


def test_the_verdict_is_that_of_the_unseen_views() -> None:
    frames = working_set()
    judged = judge_unseen(frames, [(SHIPPED, CONFIG)], lambda activity, share: True)
    swapped = dataclasses.replace(frames, held_out=frames.unseen, unseen=frames.held_out)
    other = judge_unseen(swapped, [(SHIPPED, CONFIG)], lambda activity, share: True)
    assert judged is not None
    assert other is not None
    assert judged.scores[SHIPPED].log_likelihood != other.scores[SHIPPED].log_likelihood
    assert judge_unseen(frames, [(SHIPPED, CONFIG)], lambda activity, share: False) is None
    better = dataclasses.replace(
        judged.scores[SHIPPED], log_likelihood=judged.scores[SHIPPED].log_likelihood + 0.25
    )
    assert judged.one_size
    coarse = dataclasses.replace(CONFIG, voxel_size=2 * CONFIG.voxel_size)
    two_sizes = judge_unseen(frames, [(SHIPPED, CONFIG), (FOUND, coarse)], lambda activity, share: True)
    assert two_sizes is not None
    of_voxels = [line for line in verdict_lines(two_sizes) if line.strip().startswith("right, 1.5 voxels")]
    assert of_voxels[0].endswith("other voxels")
    lines = verdict_lines(Verdict(1, judged.scores | {FOUND: better}))
    assert any(line.strip().startswith("fit, log-likelihood") and line.endswith("+0.250") for line in lines)
