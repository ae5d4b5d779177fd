"""Another mapping method, as a newcomer would add it: this folder, and its name in the list of plugs."""

from dataclasses import dataclass

from taichi_mrf.config.method import Method
from taichi_mrf.config.sliders import Range, Slider
from taichi_mrf.config.values import check_field


@dataclass(frozen=True)
class ToyConfig:
    """The parameters of the toy."""

    boldness: float = 0.7
    """Probability of occupied that each measurement gives its voxel."""

    def __post_init__(self) -> None:
        check_field(0.5 < self.boldness < 1, "toy.boldness", "must lie between 0.5 and 1")


METHOD = Method(
    name="toy",
    summary="for a test",
    title="The toy",
    section="toy",
    section_class=ToyConfig,
    section_help="Parameters of the toy.",
    map_class="toy_method.map:ToyMap",
    sliders=(Slider("boldness", Range(0.6, 0.9, 0.1)),),
    prior_is_unknown=True,
)
