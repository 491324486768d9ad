"""A radiance cache on surfaces: paths end in cells of a hash grid that were filled before the first frame."""

from warp_gi.registry import Claim, Entry, Technique

TECHNIQUE = Technique(
    name="surface-cache",
    short="cache",
    caches={
        "SurfaceCache": Entry("cache", {"": Claim(unbiased=False, bound=0.03), "residual": Claim({"residual": 0.3})})
    },
    presets={
        "cache": {"indirect": ("BsdfPaths", {"ends_in": "SurfaceCache"})},
        "clean": {"indirect": ("BsdfPaths", {"ends_in": "SurfaceCache"}), "denoise": "SpatioTemporal", "spp": 1},
    },
    qualities={
        "clean": {
            "draft": {"denoise": ("SpatioTemporal", {"edge_samples": 2, "first_samples": 1})},
            "high": {
                "indirect": ("BsdfPaths", {"ends_in": ("SurfaceCache", {"paths": 200_000})}),
                "denoise": ("SpatioTemporal", {"edge_samples": 8, "first_samples": 16}),
                "spp": 4,
                "camera_samples": 1,
            },
        }
    },
    samplers=("surface_cache.SURFACE_CACHE",),
    bake_tool="bake_tool",
    suite="cache",
    page="techniques/surface_cache.md",
)
