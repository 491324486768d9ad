"""The baselines: path tracing, and emitters picked by a fixed distribution."""

from warp_gi.registry import Entry, Technique

TECHNIQUE = Technique(
    name="path-tracing",
    short="path",
    estimators={
        "TracedEnvironment": Entry("estimators"),
        "UniformLights": Entry("estimators"),
        "PowerLights": Entry("estimators"),
        "BsdfPaths": Entry("estimators"),
    },
    presets={"path": {}, "direct": {"indirect": None}},
    samplers=("path_samplers.ALIAS_LIGHTS", "path_samplers.BSDF_DIRECTIONS", "apart_lights.APART_LIGHTS"),
    suite="path",
    page="techniques/path_tracing.md",
)
