"""The entry of the method mrf; its parameters are config/sections.py. No Taichi here: this is imported for a
--help."""

from taichi_mrf.config.method import Method, Range, Slider

METHOD = Method(
    name="mrf",
    summary="MRFMap, belief propagation on rays",
    title="Inference (mrf)",
    section="inference",
    map_class="taichi_mrf.methods.mrf.map:MRFMap",
    sliders=(
        Slider(
            "surface_density",
            Range(0.1, 12.0, 0.1),
            "per m",
            counts=lambda section: section.prior is None,
            by_factors=True,
            searched=True,
        ),
        Slider("prior", Range(0.005, 0.6, 0.005), counts=lambda section: section.prior is not None),
        Slider("sweeps", Range(1, 6, 1)),
        Slider(
            "outlier_floor",
            Range(-9.0, 0.0, 0.25),
            "per m",
            counts=lambda section: section.outlier_floor is not None,
            decades=True,
            searched=True,
        ),
        Slider(
            "pass_through", Range(0.0, 0.5, 0.01), counts=lambda section: section.pass_through is not None
        ),
        Slider("free_share", Range(0.0, 1.0, 0.01), searched=True),
        Slider("ray_density", Range(0.0, 10.0, 0.5), "per cm"),
    ),
    has_messages=True,
    can_freeze=True,
    can_refine_poses=True,
    has_layers=True,
    has_colors=True,
    measures_surface=True,
)
