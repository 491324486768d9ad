"""Paths that end in a radiance cache: who it is, where its bake and state are kept, and that it lowers the noise."""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import pytest
import statistics_tools as st

import warp_gi as gi
from warp_gi.cli.main import main
from warp_gi.errors import BakeError, OptionError
from warp_gi.estimator import Estimator
from warp_gi.sequence.frames import read_frame

PROBES = gi.LightFieldProbes(counts=(4, 4, 4), resolution=32, irradiance_resolution=16, visibility="exact")
ENDS = gi.Pipeline(emitters=None, environment=None, indirect=gi.BsdfPaths(ends_in=PROBES), spp=8)


def room():
    return gi.builtin_scene("cornell_box"), gi.builtin_camera_path("cornell_box").at_resolution(48, 32)


def test_paths_of_one_bounce_that_end_in_probes():
    """The light of long paths, at a fraction of its variance; direct light at the last vertex is sampled as ever."""
    scene, path = room()
    bake = gi.bake(scene, PROBES, st.device().alias, camera_path=path)
    whole = replace(ENDS, indirect=gi.BsdfPaths(), spp=1024)
    reference = next(gi.render(scene, path, whole, [0], st.device().alias, seed=7)).numpy("indirect")
    errors = {}
    for name, indirect in (("paths", gi.BsdfPaths()), ("ends", gi.BsdfPaths(ends_in=PROBES))):
        bakes = [bake] if name == "ends" else []
        frames = gi.render(scene, gi.CameraPath.still(path.camera(0)), replace(ENDS, indirect=indirect), range(8),
                           st.device().alias, bakes=bakes)  # fmt: skip
        pictures = np.array([frame.numpy("indirect") for frame in frames])
        errors[name] = np.var(pictures, axis=0, ddof=1).mean()
        assert pictures.mean() == pytest.approx(reference.mean(), rel=0.06), name
    assert errors["ends"] < 0.6 * errors["paths"]


def test_a_cache_has_a_place_a_state_and_a_past_of_its_own():
    scene, path = room()
    scheduler = gi.FrameScheduler(scene, path, ENDS, st.device().alias)
    assert "indirect.ends_in" in ENDS.parts() and ENDS.parts()["indirect.ends_in"] is PROBES
    assert scheduler.state("indirect.ends_in").field is not None and scheduler.state("indirect") is None
    assert scheduler.metadata()["bake.indirect.ends_in"] and "bake.indirect" not in scheduler.metadata()
    assert scheduler.metadata()["pipeline.indirect.ends_in.resolution"] == 32
    assert ENDS.dependence(scene).kind == scheduler.dependence().kind == "independent"  # nothing moves
    scene.environment = gi.TurningSky(gi.Environment(color=(1.0, 1.0, 1.0)), 9.0)
    assert ENDS.dependence(scene).kind == "unsaved" and ENDS.dependence(scene).on_past == ("indirect.ends_in",)
    assert gi.Pipeline().dependence(scene).kind == "independent"
    assert not any("ends_in" in name for name in gi.Pipeline().describe())


def test_what_ends_paths_is_a_radiance_cache():
    with pytest.raises(OptionError, match="ends_in must be a radiance cache or None, got PowerLights"):
        gi.BsdfPaths(ends_in=gi.PowerLights())


def test_the_command_line_names_a_cache_and_its_settings(tmp_path, capsys):
    command = ["render", "cornell_box", "--spp=1", "--resolution=24x16", "--frames=0", "--quiet", "-o"]
    command += [str(tmp_path / "a.####.exr"), "--pipeline"]
    flags = ["--indirect.ends-in.counts", "2", "2", "2", "--indirect.ends-in.resolution=16"]
    assert main([*command, "path,indirect.ends_in=LightFieldProbes", *flags]) == 0
    metadata = read_frame(tmp_path / "a.0000.exr").metadata
    assert metadata["pipeline.indirect.ends_in"] == "LightFieldProbes"
    assert metadata["pipeline.indirect.ends_in.resolution"] == 16
    for pipeline, told in {
        "path,indirect.ends_in=PowerLights": "unknown radiance cache 'PowerLights' (known: LightFieldProbes, Radiance",
        "direct,indirect.ends_in=LightFieldProbes": "got indirect=none",
        "path,emitters.ends_in=LightFieldProbes": "got emitters=LightHierarchy",
        "path,indirect.ends=LightFieldProbes": "did you mean 'indirect.ends_in'",
    }.items():
        assert main([*command, pipeline]) == 2
        assert told in capsys.readouterr().err


@dataclass(frozen=True)
class Marked(Estimator):
    """Serves a term of choice; its bake holds a number."""

    term: str = "environment"
    mark: int = 0
    needs: ClassVar = "a frame"

    def bake_settings(self, scene):
        return {"mark": self.mark}

    def bake(self, scene, device, seed=0, progress=None, camera=None):
        return gi.Bake("Marked", "", self.bake_settings(scene), {"mark": np.array([self.mark])})

    def start(self, scene, device, bake=None, seed=0):
        return int(bake.arrays["mark"][0])

    def trace(self, frame, state):
        assert state == self.mark


def test_one_class_serves_two_terms_with_a_bake_each():
    scene, path = room()
    pipeline = gi.Pipeline(Marked("environment", 3), None, Marked("indirect", 5), spp=1)
    bakes = [gi.bake(scene, one) for one in (pipeline.indirect, pipeline.environment)]
    for given in ([], bakes, bakes[::-1]):
        scheduler = gi.FrameScheduler(scene, path, pipeline, bakes=given)
        scheduler.frame(0)
        assert (scheduler.state("environment"), scheduler.state("indirect")) == (3, 5)
        digests = {scheduler.metadata()[f"bake.{term}"] for term in ("environment", "indirect")}
        assert digests == {bake.digest[:16] for bake in bakes}
    scheduler = gi.FrameScheduler(scene, path, pipeline, bakes=bakes[:1])  # the other one is baked
    assert (scheduler.state("environment"), scheduler.state("indirect")) == (3, 5)
    with pytest.raises(BakeError, match="other settings"):
        gi.FrameScheduler(scene, path, pipeline, bakes=[gi.bake(scene, Marked(mark=4))]).bake()
