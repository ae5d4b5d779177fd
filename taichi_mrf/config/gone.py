"""Parameters of earlier versions, and what became of each."""

from typing import Any

_ALWAYS = "it is {} for all maps, the best value in tests"

GONE: dict[str, dict[str, tuple[Any, str]]] = {
    "InferenceConfig": {
        "method": ("sum-product", "MRFMap computes marginals; factor_graph() and laser have max-product"),
        "tolerance": (0.0, "MRFMap.infer takes it as an argument"),
        "damping": (0.0, "messages are not damped"),
        "likelihood": ("auto", "the likelihood is averaged over a segment where sigma is less than a voxel"),
        "tail_share": (0.0, "errors are normal; outlier_floor allows for others"),
        "tail_sigmas": (10.0, "errors are normal; outlier_floor allows for others"),
        "end_sigmas": (3.0, "a ray ends 3 sigma behind its measurement"),
        "segment_lengths": (True, "a voxel counts by the length of the ray in it"),
        "plane_window": (0.0, "predicted depth and the surface are finer than voxels without it"),
        "ray_choice": ("bundle", "pixels that agree share a ray"),
        "first_sweep_stride": (1, "every ray is followed; ray_density sets how many there are"),
        "free_space_stride": (1, "every ray is followed; ray_density sets how many there are"),
        "average": ("log_odds", "log-odds are averaged"),
        "ray_correlation": (1.0, "a keyframe counts once, as in the paper"),
        "min_length": (0.02, _ALWAYS.format("0.02")),
        "message_clamp": (6.9, _ALWAYS.format("6.9")),
        "cavity_clamp": (9.2, _ALWAYS.format("9.2")),
        "doubt_free": (0.01, _ALWAYS.format("0.01")),
        "doubt_occupied": (0.01, _ALWAYS.format("0.01")),
        "return_pass": ("replay", "rays are replayed from a trace"),
        "message_precision": ("float16", _ALWAYS.format("float16")),
    },
    "KeyframeConfig": {"against": ("last", "a frame is compared with the last keyframe, as in the paper")},
    "PoseConfig": {
        "rounds": (2, "keyframes are aligned with each other in at most 2 rounds"),
        "use_color": (True, "a camera is tracked by its colour images too, where it has any"),
        "carry_unnamed": (True, "frames without a pose move with the last one before them that has one"),
        "follow_budget_s": (0.2, "keyframes follow a file for about 0.2 s between two frames"),
        "follow_quiet_s": (10.0, "poses that follow a file are final after 10 s without a change"),
    },
    "RuntimeConfig": {"debug": (False, "taichi_mrf.init takes it as an argument")},
}
"""By the name of the dataclass that had it: a parameter's default, which needs no warning, and what became of
it."""


def note_gone(section: str, key: str, value: object) -> str | None:
    """Note on a removed parameter: "" if its value was the default; None if none ever had this name."""
    known = GONE.get(section, {}).get(key)
    if known is None:
        return None
    default, became = known
    return "" if value == default else f"{key} is no longer a parameter: {became}"
