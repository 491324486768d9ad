"""A pipeline names one estimator for each term of the light."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass, fields
from numbers import Integral
from typing import Any

from warp_gi.denoise import Denoiser, Oidn, SpatioTemporal, denoiser_named
from warp_gi.errors import OptionError, unknown_name
from warp_gi.estimator import Estimator
from warp_gi.techniques.light_field.estimator import LightFieldProbes
from warp_gi.techniques.light_hierarchy.estimator import LightHierarchy
from warp_gi.techniques.paths.estimators import BsdfPaths, PowerLights, TracedEnvironment, UniformLights
from warp_gi.techniques.reuse.guided_paths import GuidedPaths
from warp_gi.techniques.reuse.light_cache import VisibilityLightCache
from warp_gi.techniques.reuse.sample_octree import SampleOctree
from warp_gi.techniques.visibility_field.estimator import VisibilityField

__all__ = ["PRESETS", "TERMS", "Estimator", "Pipeline"]

TERMS = ("environment", "emitters", "indirect")
FILTERS = ("box", "tent")
MOST_SAMPLES = 1 << 24  # a pixel; random numbers count samples and pixels together in 32 bits


@dataclass(frozen=True)
class Pipeline:
    """One estimator for each term, and how many samples they take. A term set to None is left out.

    Raises OptionError for settings that make no sense.
    """

    environment: TracedEnvironment | VisibilityField | None = TracedEnvironment()
    """Direct light from the sky."""
    emitters: PowerLights | UniformLights | LightHierarchy | VisibilityLightCache | None = PowerLights()
    """Direct light from emissive triangles and punctual lights."""
    indirect: BsdfPaths | GuidedPaths | LightFieldProbes | None = BsdfPaths()
    """Light that arrives over other surfaces."""
    spp: int = 16
    """Samples a pixel."""
    camera_samples: int | None = None
    """Distinct jittered camera rays a pixel that the samples are spread over; None is 4, or spp if that is
    less. 1 gives pixel centres, spp one a sample as a reference wants."""
    filter: str = "box"
    """Pixel filter: "box" or "tent" (two pixels wide)."""
    denoise: SpatioTemporal | Oidn | None = None
    """What makes the beauty of the noisy terms, or its name: "spatiotemporal", "oidn". The terms stay noisy."""

    octree: SampleOctree = SampleOctree()
    """Where the techniques that learn from samples learn: VisibilityLightCache and GuidedPaths share it."""

    def __post_init__(self) -> None:
        for name in ("spp", "camera_samples"):
            count = getattr(self, name)
            if count is not None and (isinstance(count, bool) or not isinstance(count, Integral)):
                raise OptionError(f"{name} must be a whole number, got {count!r}")
        if self.spp < 1:
            raise OptionError(f"spp must be at least 1, got {self.spp}")
        if self.spp > MOST_SAMPLES:
            raise OptionError(f"spp must be at most {MOST_SAMPLES}, got {self.spp}; average frames of other seeds")
        if self.camera_samples is not None and not 1 <= self.camera_samples <= self.spp:
            raise OptionError(f"camera_samples must be between 1 and spp ({self.spp}), got {self.camera_samples}")
        if self.filter not in FILTERS:
            raise unknown_name("pixel filter", self.filter, FILTERS)
        if isinstance(self.denoise, str):
            object.__setattr__(self, "denoise", denoiser_named(self.denoise))
        if not isinstance(self.denoise, Denoiser | None):
            raise OptionError(f"denoise must be a Denoiser, the name of one, or None, got {self.denoise!r:.80}")
        if not isinstance(self.octree, SampleOctree):
            raise OptionError(f"octree must be a SampleOctree, got {self.octree!r:.80}")
        for term, estimator in zip(TERMS, (self.environment, self.emitters, self.indirect), strict=True):
            if estimator is not None and getattr(estimator, "term", None) != term:
                raise OptionError(f"{term} must be an estimator of that term or None, got {estimator!r}")
        alone = [estimator for _, estimator in self.estimators() if estimator.makes_primary]
        if alone and (len(list(self.estimators())) > 1 or self.denoise is not None):
            raise OptionError(
                f"{type(alone[0]).__name__} finds primary hits itself, and holds all light that they send; leave the "
                'other terms and the denoiser out, as the preset "probe_view" does'
            )

    @property
    def camera_sample_count(self) -> int:
        """Camera rays a pixel."""
        return min(4, self.spp) if self.camera_samples is None else self.camera_samples

    def estimators(self) -> Iterator[tuple[str, Estimator]]:
        """Yield (term, estimator) of the terms that are not left out."""
        for term in TERMS:
            estimator = getattr(self, term)
            if estimator is not None:
                yield term, estimator

    def describe(self) -> dict[str, Any]:
        """Return all settings by dotted name, e.g. {"indirect": "BsdfPaths", "indirect.max_depth": 64, ...}."""
        settings: dict[str, Any] = {}
        for field in fields(self):
            value = getattr(self, field.name)
            if field.name == "octree" and not any(estimator.learns for _, estimator in self.estimators()):
                continue
            if isinstance(value, Estimator | Denoiser | SampleOctree):
                settings[field.name] = type(value).__name__
                settings.update({f"{field.name}.{name}": setting for name, setting in asdict(value).items()})
            else:
                settings[field.name] = value
        settings["camera_samples"] = self.camera_sample_count
        return settings

    @classmethod
    def preset(cls, name: str, **settings: Any) -> Pipeline:
        """Return the pipeline of that name, with fields replaced by ``settings``.

        Raises OptionError for an unknown name or setting.
        """
        if name not in PRESETS:
            raise unknown_name("pipeline", name, PRESETS)
        known = {field.name for field in fields(cls)}
        for setting in settings:
            if setting not in known:
                raise unknown_name("pipeline setting", setting, known)
        return cls(**{**PRESETS[name], **settings})


PRESETS: dict[str, dict[str, Any]] = {
    "path": {},
    "direct": {"indirect": None},
    "dvf": {"environment": VisibilityField()},
    "reuse": {"emitters": VisibilityLightCache(), "indirect": GuidedPaths()},
    "hybrid": {"environment": VisibilityField(), "emitters": VisibilityLightCache(), "indirect": GuidedPaths()},
    "probes": {"indirect": LightFieldProbes()},
    "probe_view": {"environment": None, "emitters": None, "indirect": LightFieldProbes(primary="probes")},
}
"""Fields of each named pipeline, where they differ from the defaults."""
