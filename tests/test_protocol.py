"""What keeps a state over frames: who is asked when, what frames depend on, and mistakes that are told."""

import gc
import weakref
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import pytest
from scene_tools import card

import warp_gi as gi
from warp_gi import registry
from warp_gi.cli.pipelines import pipeline_named
from warp_gi.errors import OptionError
from warp_gi.pipeline import estimator_named, made
from warp_gi.registry import Entry, Technique
from warp_gi.sequence.resume import shots_of
from warp_gi.techniques.reuse.sample_octree import Lesson

NOTHING = gi.Pipeline(environment=None, emitters=None, indirect=None, spp=1, camera_samples=1)


def room(sky=(1.0, 1.0, 1.0)):
    return gi.Scene([gi.Node("card", [card()])], environment=sky)


def path():
    return gi.CameraPath.from_cameras([still()], fps=1.0)


def still():
    return gi.Camera.look_at((0, 0, 3), (0, 0, 0), resolution=(8, 6))


@dataclass(frozen=True)
class Counts(gi.Estimator):
    """Its state is the sky's red under which it began, and the number of frames since."""

    term: ClassVar[str] = "environment"

    def start(self, scene, device, bake=None, seed=0):
        return float(scene.environment.mean_radiance[0]), 0

    def after(self, frame, state):
        return state[0], state[1] + 1

    def trace(self, frame, state):
        pass


@dataclass(frozen=True)
class Tally(gi.Service):
    """A service that learns, and says whether a file can keep that."""

    name: ClassVar[str] = "tally"
    saved: bool = True

    def start(self, scene, device, bake=None, seed=0):
        return 0

    def preprocess(self, frame, state):
        frame.offer(Count(state))
        return state

    def after(self, frame, state):
        return state + 1

    @property
    def saves_state(self):
        return self.saved


@dataclass(frozen=True)
class Sheet(gi.Service):
    """A service that needs another one."""

    name: ClassVar[str] = "sheet"

    @property
    def services(self):
        return (Tally(),)


@dataclass
class Count:
    value: int


@dataclass(frozen=True)
class Asks(Counts):
    """Needs a service, and remembers what it offered."""

    service: gi.Service = Tally()

    @property
    def services(self):
        return (self.service,)

    @property
    def saves_state(self):
        return True

    def after(self, frame, state):
        return state[0], frame.offered(Count).value


# ---- order and states ----


def test_services_come_first_and_offer_to_those_who_ask():
    pipeline = replace(NOTHING, environment=Asks(service=Sheet()))
    assert list(pipeline.parts()) == ["tally", "sheet", "environment"]
    scheduler = gi.FrameScheduler(room(), still(), pipeline)
    for index in range(3):
        scheduler.frame(index)
    assert scheduler.state("tally") == 3 and scheduler.state("environment")[1] == 2


def test_a_denoiser_is_asked_like_all_others():
    @dataclass(frozen=True)
    class Notes(gi.Denoiser):
        def preprocess(self, frame, state):
            return [*(state or []), "preprocess"]

        def after(self, frame, state):
            return [*state, "after"]

        def apply(self, frame, state):
            frame["beauty"].assign(frame["noisy"])
            return [*state, "apply"]

    scheduler = gi.FrameScheduler(room(), still(), replace(NOTHING, denoise=Notes()))
    scheduler.frame(0)
    assert scheduler.state("denoise") == ["preprocess", "after", "apply"]


def test_the_state_before_the_first_frame_is_under_the_sky_of_time_0_or_of_that_frame():
    """Whatever sky another scheduler of the scene shows, and whoever asks before the first frame."""
    sky = lambda seconds: gi.Environment(color=(1.0 + seconds, 0.0, 0.0))  # noqa: E731
    scene, pipeline = room(sky), replace(NOTHING, environment=Counts())
    one, other = (gi.FrameScheduler(scene, path(), pipeline) for _ in range(2))
    other.frame(5)
    assert other.state("environment") == (6.0, 1) and one.state("environment") == (1.0, 0)
    one.dependence()
    one.frame(3)
    assert one.state("environment") == (4.0, 1) and other.state("environment") == (6.0, 1)


def test_what_depends_on_all_of_the_scene_stays_while_the_scene_does():
    """Another scheduler may show the night meanwhile."""
    sky = lambda seconds: gi.Environment(color=(1.0, 1.0, 1.0) if seconds < 10 else (0.1, 0.1, 0.1))  # noqa: E731
    scene, pipeline = room(sky), replace(NOTHING, environment=Counts())
    one, other = (gi.FrameScheduler(scene, path(), pipeline) for _ in range(2))
    one.frame(0)
    other.frame(20)
    one.frame(1)
    assert one.state("environment")[1] == 2
    one.frame(20)
    assert one.state("environment")[1] == 1  # by night it begins anew


def test_a_frame_is_freed_with_its_last_name():
    """Nothing of it waits for the garbage collector; nor do samples that were learnt from stay while it does."""
    scheduler = gi.FrameScheduler(room(), still(), gi.Pipeline.preset("reuse", spp=1))
    gc.collect()
    gc.disable()
    try:
        for index in range(2):
            frame = scheduler.frame(index)
            alive = weakref.ref(frame)
            assert frame.offered(Lesson) is None
            del frame
            assert alive() is None
    finally:
        gc.enable()


# ---- dependence ----


def test_dependence_is_what_the_scene_says():
    probes, field = gi.Pipeline.preset("probes"), gi.Pipeline.preset("dvf")
    assert probes.dependence(room()).kind == "independent"
    assert probes.dependence(room(gi.TurningSky(gi.Environment(color=(1, 1, 1)), 9.0))).kind == "unsaved"
    assert field.dependence(room()).kind == "saved"  # it may bake cells on the way
    assert gi.Pipeline.preset("reuse").dependence(room()).kind == "saved"
    assert gi.Pipeline.preset("path", denoise="spatiotemporal").dependence(room()).on_past == ("denoiser",)


def test_a_service_whose_state_no_file_keeps_makes_the_sequence_unsaved():
    for saved, kind, names in ((True, "saved", ("environment",)), (False, "unsaved", ("tally", "environment"))):
        found = replace(NOTHING, environment=Asks(service=Tally(saved))).dependence(room())
        assert found.kind == kind and found.on_past == names
        assert found.unsaved == (() if saved else ("tally",))


# ---- mistakes ----


def test_methods_of_an_earlier_protocol_are_refused():
    for name, words in (("learn", "after"), ("makes_primary", "own_primary"), ("trace_primary", "own_primary")):
        with pytest.raises(TypeError, match=f"Old.{name} is of an earlier version and never called: .*{words}"):
            type("Old", (gi.Estimator,), {name: lambda self: None})

    class Watches(gi.GuidedPaths):  # its class calls learn
        def learn(self, lesson, state):
            return super().learn(lesson, state)

    assert Watches().learns


def test_two_ways_to_sample_lights_are_one_too_many():
    @dataclass(frozen=True)
    class Greedy(gi.BsdfPaths):
        def preprocess(self, frame, state):
            frame.paths.use_lights(registry.samplers()["light_hierarchy.HIERARCHY_LIGHTS"], None)
            return state

    lamp = gi.Node("lamp", [card(4.0, 0.5, gi.Material("lamp", emission=(1, 1, 1)))])
    scene = gi.Scene([gi.Node("card", [card()]), lamp])
    with pytest.raises(OptionError, match="sample lights of paths, by 'alias' and by 'hierarchy': leave one"):
        gi.FrameScheduler(scene, still(), gi.Pipeline(indirect=Greedy(), spp=1)).frame(0)


def test_samplers_of_regions_need_a_service():
    @dataclass(frozen=True)
    class Alone(gi.GuidedPaths):
        @property
        def services(self):
            return ()

    with pytest.raises(OptionError, match=r"'alias' and 'guided' tell regions apart, .*SampleOctree"):
        gi.FrameScheduler(room(), still(), gi.Pipeline(indirect=Alone(), spp=1)).frame(0)


def test_services_and_primaries_contradict_each_other_in_one_line():
    with pytest.raises(OptionError, match=r"indirect and environment share the service 'tally', .* for indirect and "):
        two = type("Two", (Asks,), {"term": "indirect"})
        replace(NOTHING, environment=Asks(), indirect=two(service=Tally(False))).services()
    named = type("Named", (Tally,), {"name": "filter"})
    with pytest.raises(OptionError, match="a service cannot be named 'filter'"):
        replace(NOTHING, environment=Asks(service=named())).services()


def test_a_frame_is_asked_for_once():
    with pytest.raises(OptionError, match="frame 3 is asked for twice, and both would go to one file"):
        shots_of(still(), [2, 3, 3], "a.####.exr")


# ---- the registry ----


def test_lights_by_weights_of_ones_own():
    @dataclass(frozen=True)
    class Second(gi.PowerLights):
        def weights(self, scene):
            return np.array([1e-3, 1.0])

    lamp = gi.Material("lamp", emission=(1, 1, 1))
    triangle = gi.Mesh(np.array([[-1, -1, 4], [1, 1, 4], [1, -1, 4]], np.float32), np.array([[0, 1, 2]]), lamp)
    lamps = [gi.Node(f"lamp{i}", [triangle]) for i in range(2)]
    frame = gi.FrameScheduler(
        gi.Scene([gi.Node("card", [card()]), *lamps]), still(), gi.Pipeline(emitters=Second())
    ).frame(0)
    np.testing.assert_allclose(frame.data.emitters.alias.numpy()["pdf"], [1e-3 / 1.001, 1 / 1.001], rtol=1e-5)


def test_values_of_presets_name_classes_to_any_depth(monkeypatch):
    assert made("BsdfPaths") == gi.BsdfPaths() and made("tent") == "tent" and made(None) is None
    ends = made(("BsdfPaths", {"max_depth": 4, "ends_in": ("LightFieldProbes", {"mode": "irradiance"})}))
    assert ends == gi.BsdfPaths(max_depth=4, ends_in=gi.LightFieldProbes(mode="irradiance"))
    preset = {
        "indirect": ("BsdfPaths", {"ends_in": "LightFieldProbes"}),
        "denoise": ("SpatioTemporal", {"lag": 0.0}),
    }
    known = registry.presets()
    monkeypatch.setattr(registry, "presets", lambda: known | {"tidy": {**preset, "filter": "tent"}})
    clean = gi.Pipeline.preset("tidy", spp=2)
    assert clean.indirect.ends_in == gi.LightFieldProbes() and clean.filter == "tent" and clean.spp == 2
    assert clean.denoise == gi.SpatioTemporal(lag=0.0)
    assert gi.Pipeline.preset("tidy", denoise=None).denoise is None


@dataclass(frozen=True)
class Transfers(gi.Estimator):
    """Serves two terms, and bakes the same for both."""

    term: str = "environment"
    bakes: ClassVar[list] = []

    def bake(self, scene, device, seed=0, progress=None, camera=None):
        self.bakes.append(self.term)
        return gi.Bake("Transfers", "", {}, {"one": np.ones(1)})

    def trace(self, frame, state):
        pass


@dataclass(frozen=True)
class Surfaces(gi.RadianceCache):
    """A radiance cache that is no estimator."""


@pytest.fixture
def transfer(monkeypatch):
    """A technique with a class for two terms, and a radiance cache."""
    technique = Technique("transfer", "tr", {"Transfers": Entry("x")}, caches={"Surfaces": Entry("x")})
    found, public, find = registry.techniques(), registry.public(), registry.find
    mine = {"Transfers": Transfers, "Surfaces": Surfaces}
    monkeypatch.setattr(registry, "techniques", lambda: {**found, "transfer": technique})
    monkeypatch.setattr(registry, "public", lambda: {**public, **dict.fromkeys(mine, "x")})
    monkeypatch.setattr(registry, "find", lambda name: mine.get(name) or find(name))


def test_one_class_serves_two_terms_by_name_and_bakes_once(transfer):
    pipeline = replace(pipeline_named("path,environment=Transfers,indirect=Transfers,emitters=none"), spp=1)
    assert (pipeline.environment.term, pipeline.indirect.term) == ("environment", "indirect")
    Transfers.bakes.clear()
    gi.FrameScheduler(room(), still(), pipeline).frame(0)
    assert Transfers.bakes == ["environment"]


def test_a_radiance_cache_need_not_be_an_estimator(transfer):
    assert pipeline_named("path,indirect.ends_in=Surfaces").indirect.ends_in == Surfaces()
    with pytest.raises(OptionError, match="unknown indirect estimator 'Surfaces'"):
        estimator_named("indirect", "Surfaces")
    with pytest.raises(OptionError, match="unknown environment estimator 'Transfer'; did you mean 'Transfers'"):
        estimator_named("environment", "Transfer")
    with pytest.raises(OptionError, match=r"BsdfPaths has nothing to bake, but the cache has .* bake its ends_in"):
        gi.bake(room(), gi.BsdfPaths(ends_in=gi.LightFieldProbes()))
