"""A pipeline names one estimator for each term of the light."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from typing import Any

from warp_gi import registry
from warp_gi.baking import Bake
from warp_gi.denoise import DENOISERS, Denoiser, denoiser_named
from warp_gi.errors import OptionError, unknown_name, whole_number
from warp_gi.estimator import Estimator
from warp_gi.frame import TERMS, FrameSettings
from warp_gi.plain import take_plain
from warp_gi.primary import CameraRays, Primary
from warp_gi.radiance_cache import RadianceCache
from warp_gi.scene.baked import BakedScene
from warp_gi.scene.scene import Scene
from warp_gi.sequence.state import Dependence
from warp_gi.stateful import Ahead, Service, Stateful

FILTERS = ("box", "tent")
MOST_SAMPLES = 1 << 24  # a pixel; random numbers count samples and pixels together in 32 bits
DEFAULT = "clean"
"""Preset of who names no pipeline. ``Pipeline()``, the preset "path", is the reference."""
NORMAL = "normal"
"""Quality of a preset as it is."""
SAMPLES = {"draft": 0.25, NORMAL: 1.0, "high": 4.0}
"""Qualities, and the factor of the samples of presets that say no more of them."""
DENOISER = "denoise"
"""Place of the denoiser among states."""


def _default(name: str) -> Any:
    """Return a dataclass field whose default is a class of the registry with its own defaults."""
    return field(default_factory=lambda: made(name))


@dataclass(frozen=True)
class Pipeline:
    """One estimator for each term, and how many samples they take. A term set to None is left out.

    Raises OptionError for settings that make no sense.
    """

    environment: Estimator | None = _default("TracedEnvironment")
    """Estimator of direct light from the sky."""
    emitters: Estimator | None = _default("LightHierarchy")
    """Estimator of direct light from emissive triangles and punctual lights."""
    indirect: Estimator | None = _default("BsdfPaths")
    """Estimator of light that arrives over other surfaces."""
    spp: int = 16
    """Number of samples a pixel."""
    camera_samples: int | None = None
    """Number of distinct jittered camera rays a pixel that the samples are spread over; None is 4, or spp if that is
    less. 1 gives pixel centres, spp one a sample as a reference wants."""
    filter: str = "box"
    """Pixel filter: "box" or "tent" (two pixels wide)."""
    background: bool = True
    """Whether the beauty shows the sky where the camera sees no surface. Without it, and with the channel A, a picture
    can be laid over another one; the sky lights surfaces all the same."""
    denoise: Denoiser | None = None
    """Denoiser that makes the beauty of the noisy terms, or its name: "spatiotemporal", "oidn". The terms stay
    noisy."""

    octree: Service = _default("SampleOctree")
    """Octree of regions shared by the techniques that learn (``VisibilityLightCache``, ``GuidedPaths``)."""

    def __post_init__(self) -> None:
        take_plain(self)
        for name in ("spp", "camera_samples"):
            if (count := getattr(self, name)) is not None:
                object.__setattr__(self, name, whole_number(name, count))
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
        if not isinstance(self.octree, Service) or self.octree.name != "octree":
            raise OptionError(f"octree must be a SampleOctree, got {self.octree!r:.80}")
        for term in TERMS:
            estimator = getattr(self, term)
            if estimator is not None and getattr(estimator, "term", None) != term:
                raise OptionError(f"{term} must be an estimator of that term or None, got {estimator!r}")
        self._check_alone()

    def _check_alone(self) -> None:
        whole = [estimator for _, estimator in self.estimators() if _is_whole(estimator)]
        if whole and (len(list(self.estimators())) > 1 or self.denoise is not None):
            raise OptionError(
                f"{type(whole[0]).__name__} finds primary hits itself, and holds all light that they send; leave the "
                'other terms and the denoiser out, as the preset "probe_view" does'
            )
        if whole and not self.background:
            raise OptionError(f"{type(whole[0]).__name__} always shows the sky of its bake; leave background=False out")

    # ---- parts ----

    def estimators(self) -> Iterator[tuple[str, Estimator]]:
        """Yield (term, estimator) of the terms that are not left out."""
        for term in TERMS:
            estimator = getattr(self, term)
            if estimator is not None:
                yield term, estimator

    def services(self) -> dict[str, Service]:
        """Return the services that estimators and radiance caches ask for, by name; those that they ask for come first.

        Raises OptionError where two ask for one with different settings, and no field here has its name.
        """
        found: dict[str, Service] = {}
        asked: dict[str, str] = {}

        def gather(place: str, part: Stateful) -> None:
            for service in part.services:
                service = self._settings_of(service)
                gather(service.name, service)
                other = asked.setdefault(service.name, place)
                if (known := found.setdefault(service.name, service)) != service:
                    raise OptionError(
                        f"{place} and {other} share the service {service.name!r}, which takes one value of each "
                        f"setting, got {_differing(service, known, place, other)}: make them equal"
                    )

        for place, part in (*self.radiance_caches(), *self.estimators()):
            gather(place, part)
        return found

    def _settings_of(self, service: Service) -> Service:
        """Return a service, with the settings that a field of its name has."""
        own = getattr(self, service.name) if service.name in {one.name for one in fields(self)} else service
        if not isinstance(own, Service):
            raise OptionError(f"a service cannot be named {service.name!r}: that is another setting of a pipeline")
        return own

    def radiance_caches(self) -> Iterator[tuple[str, RadianceCache]]:
        """Yield (place, cache) of the radiance caches in which paths end, for example ("indirect.ends_in", ...)."""
        for term, estimator in self.estimators():
            if estimator.radiance_cache is not None:
                yield f"{term}.ends_in", estimator.radiance_cache

    def primary(self) -> tuple[str, Primary]:
        """Return what finds the frame's primary hits, and whose state it reads: a term, or "" for none."""
        found = [(term, one.own_primary) for term, one in self.estimators() if one.own_primary is not None]
        if len(found) > 1:
            terms = " and ".join(term for term, _ in found)
            raise OptionError(f"the estimators of {terms} find primary hits; leave all but one of them out")
        return found[0] if found else ("", CameraRays())

    def parts(self) -> dict[str, Stateful]:
        """Return all that keeps a state over frames, by its place, in the order in which frames ask them."""
        parts: dict[str, Stateful] = {**self.services(), **dict(self.radiance_caches()), **dict(self.estimators())}
        return parts if self.denoise is None else parts | {DENOISER: self.denoise}

    def dependence(self, scene: Scene | BakedScene, ahead: Callable[[str], Ahead] | None = None) -> Dependence:
        """Return how frames of a scene depend on those before: not, on a state that can be saved, or on others.

        ``ahead`` returns what is known of the frames to come for the part in a place. None is what the scene says:
        whether it moves, and whether its sky does. A scheduler, which has states, may know that more is independent.
        """
        known = ahead or (lambda place: Ahead(None, (), scene.is_sky_animated))
        depends = {place: part for place, part in self.parts().items() if part.depends_on_past(scene, known(place))}
        unsaved = {place for place, part in depends.items() if not part.saves_state}
        shown = dict(depends)
        for place in depends:  # a service whose state can be saved is of use to those who ask, who are named
            for service in depends[place].services:
                if service.name in depends and service.name not in unsaved:
                    shown.pop(service.name, None)
        names = {place: "denoiser" if place == DENOISER else place for place in shown}
        return Dependence(tuple(names.values()), tuple(name for place, name in names.items() if place in unsaved))

    def fitting(self, bake: Bake) -> Pipeline:
        """Return the pipeline with its settings as those of a bake that is rendered without its scene.

        Raises OptionError for a pipeline that cannot show a bake alone, BakeError for another technique's bake.
        """
        term, primary = self.primary()
        if not primary.is_whole:
            raise OptionError(
                'a bake without its scene is rendered by the preset "probe_view"; give the scene for other pipelines'
            )
        return replace(self, **{term: getattr(self, term).fitting(bake)})

    # ---- settings ----

    @property
    def camera_sample_count(self) -> int:
        """Number of camera rays a pixel."""
        return min(4, self.spp) if self.camera_samples is None else self.camera_samples

    @property
    def frame_settings(self) -> FrameSettings:
        """Settings that decide how a frame is sampled."""
        denoise = self.denoise or Denoiser()
        wanted = denoise.wants_lobes, denoise.parts_lights
        return FrameSettings(self.spp, self.camera_sample_count, self.filter, self.background, *wanted)

    def describe(self) -> dict[str, Any]:
        """Return all settings by dotted name, e.g. {"indirect": "BsdfPaths", "indirect.max_depth": 64, ...}."""
        settings: dict[str, Any] = {}
        services = self.services()
        for one in fields(self):
            value = getattr(self, one.name)
            if not isinstance(value, Service) or value.name in services:
                settings |= _described(one.name, value)
        settings["camera_samples"] = self.camera_sample_count
        return settings

    @classmethod
    def presets(cls) -> tuple[str, ...]:
        """Return the names of all presets."""
        return tuple(registry.presets())

    @classmethod
    def preset(cls, name: str, *, quality: str = NORMAL, **settings: Any) -> Pipeline:
        """Return the pipeline of that name, with fields replaced by ``settings``.

        ``quality`` is "draft", "normal" or "high": the few settings that decide most. Presets that say nothing of it
        take a quarter of their samples, or four times as many. Raises OptionError for an unknown name, quality or
        setting.
        """
        known = registry.presets()
        if quality not in SAMPLES:
            raise unknown_name("quality", quality, SAMPLES)
        if name not in known:
            raise unknown_name("pipeline", name, known)
        names = {one.name for one in fields(cls)}
        for setting in settings:
            if setting not in names:
                raise unknown_name("pipeline setting", setting, names)
        chosen = dict(known[name])
        if quality != NORMAL:
            chosen |= registry.qualities(name).get(quality) or {
                "spp": max(1, round(SAMPLES[quality] * chosen.get("spp", cls.spp)))
            }
        fresh = {key: made(value) for key, value in chosen.items() if key not in settings}
        return cls(**fresh, **settings)


def made(value: Any) -> Any:
    """Return what a value of the registry stands for.

    The name of a technique's class, or of a denoiser's, is that class with its defaults; a pair of the name and
    settings is the class with these, whose values may be names and pairs again. Any other value is itself.
    """
    name, settings = value if isinstance(value, tuple) and len(value) == 2 else (value, {})
    kinds = {kind.__name__: kind for kind in DENOISERS.values()}
    if not isinstance(name, str) or not isinstance(settings, Mapping):
        return value
    kind = kinds.get(name) or (registry.find(name) if name in registry.public() else None)
    if not isinstance(kind, type):
        return value
    return kind(**{key: made(setting) for key, setting in settings.items()})


def estimator_named(term: str, name: str) -> Estimator:
    """Return the estimator of a class name with its defaults, for a term.

    Raises OptionError if there is none, with the names of those of the term.
    """
    classes = {known: registry.find(known) for one in registry.techniques().values() for known in one.estimators}
    if name not in classes:
        of_term = [known for known, kind in classes.items() if getattr(kind, "term", term) == term]
        raise unknown_name(f"{term} estimator", name, of_term)
    takes_term = any(one.name == "term" for one in fields(classes[name]))  # one that serves several
    return classes[name](term=term) if takes_term else classes[name]()


def _differing(one: Any, other: Any, here: str, there: str) -> str:
    """Return the settings in which two dataclasses in two places differ, those within settings by their own names."""
    found = []
    for name in (each.name for each in fields(one)):
        mine, theirs = getattr(one, name), getattr(other, name, None)
        if mine != theirs:
            both = is_dataclass(mine) and type(mine) is type(theirs)
            text = f"{name} {mine!r} for {here} and {theirs!r} for {there}"
            found.append(_differing(mine, theirs, here, there) if both else text)
    return "; ".join(found) or f"{type(one).__name__} for {here} and {type(other).__name__} for {there}"


def _is_whole(estimator: Estimator) -> bool:
    return estimator.own_primary is not None and estimator.own_primary.is_whole


def _described(name: str, value: Any) -> dict[str, Any]:
    """Return a setting, and those within it, by dotted name."""
    if not isinstance(value, Stateful):
        return {name: value}
    settings: dict[str, Any] = {name: type(value).__name__}
    for one in fields(value):
        inner = getattr(value, one.name)
        if isinstance(inner, Stateful):
            settings |= _described(f"{name}.{one.name}", inner)
        elif not (inner is None and one.name == "ends_in"):
            settings[f"{name}.{one.name}"] = inner
    return settings
