"""Bakes kept in a folder: found for the same bits alone, removed by age, made anew where damaged, left out if asked."""

import logging
import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import warp as wp

import warp_gi as gi
from warp_gi import kept
from warp_gi.baking import Bake
from warp_gi.cli.main import main
from warp_gi.scene.camera import views_hash
from warp_gi.techniques.surface_cache.cache import SurfaceCache

CPU = wp.get_device("cpu")
CACHE = SurfaceCache(paths=1000)


@pytest.fixture
def keeps_all(monkeypatch):
    monkeypatch.setattr(kept, "LEAST_SECONDS", 0.0)


def box(size=(16, 12)):
    scene = gi.builtin_scene("cornell_box")
    return scene, scene.cameras["main"].at_resolution(*size)


def rendered(cache):
    scene, camera = box()
    pipeline = gi.Pipeline(indirect=gi.BsdfPaths(ends_in=CACHE), spp=1)
    frame = next(gi.render(scene, camera, pipeline, seed=1, cache=cache))
    return {name: frame.numpy(name).tobytes() for name in frame.names} | frame.metadata


def made(value=1.0, size=1000):
    return Bake("SurfaceCache", "key", {}, {"values": np.full(size, value)})


def test_frames_with_a_kept_bake_are_those_with_a_fresh_one(keeps_all, monkeypatch, tmp_path):
    fresh, first = rendered(None), rendered(tmp_path)
    assert len(list(tmp_path.glob("SurfaceCache-*.safetensors"))) == 1
    monkeypatch.setattr(SurfaceCache, "bake", lambda *_: pytest.fail("the kept bake was not used"))
    assert fresh == first == rendered(str(tmp_path)) == rendered(gi.BakeFolder(tmp_path))


def test_a_file_is_for_all_that_decides_a_bake(tmp_path):
    scene, camera = box()
    folder = kept.BakeFolder(tmp_path)

    def path(part=CACHE, camera=camera, seed=1):
        return folder.path(part, scene, camera, CPU, seed)

    assert path() == path() and path().parent == tmp_path
    others = [path(replace(CACHE, paths=2000)), path(seed=2), path(camera=camera.at_resolution(16, 10))]
    assert len({path(), *others}) == 4


def test_a_field_is_found_under_every_sky_and_if_it_is_whole_for_every_camera(tmp_path):
    scene, camera = box()
    other = gi.Camera.look_at((0, 1, 2), (0, 1, 0))

    def path(camera=camera, **settings):
        return kept.BakeFolder(tmp_path).path(gi.VisibilityField(**settings), scene, camera, CPU, 1)

    seen, whole = path(lazy=True), path(lazy=False)
    assert path(other, lazy=True) != seen != whole == path(other, lazy=False)
    assert path(lazy=False, cell_size=0.5) != whole
    scene.environment = (0.5, 0.5, 0.5)
    assert (path(lazy=True), path(lazy=False)) == (seen, whole)


def test_another_sky_other_code_and_another_view_are_other_files(monkeypatch, tmp_path):
    scene, camera = box()
    folder = kept.BakeFolder(tmp_path)
    before = folder.path(CACHE, scene, camera, CPU, 1)
    with monkeypatch.context() as patch:
        patch.setattr(kept, "code_hash", lambda: "other code")
        assert folder.path(CACHE, scene, camera, CPU, 1) != before
    scene.environment = (0.5, 0.5, 0.5)
    assert folder.path(CACHE, scene, camera, CPU, 1) != before
    path = gi.CameraPath.still(camera)
    assert len({views_hash(one) for one in (None, camera, path, gi.CameraPath.orbit((0, 1, 0), 2.0))}) == 3
    lenses = [camera, replace(camera, lens_shift=(0.1, 0.0)), replace(camera, pixel_aspect=2.0)]
    assert len({views_hash(lens) for lens in lenses}) == 3
    before = folder.path(CACHE, scene, camera, CPU, 1)
    scene.offset = np.array([1.0, 0.0, 0.0])  # of a recentred scene: its bake says so
    assert folder.path(CACHE, scene, camera, CPU, 1) != before


def test_a_damaged_file_is_made_anew_with_one_line(keeps_all, tmp_path, caplog):
    scene, camera = box()
    folder, wanted = kept.BakeFolder(tmp_path), made()
    where = CACHE, scene, camera, CPU, 1
    folder.bake(*where, lambda: wanted)
    file = folder.path(*where)
    whole = file.read_bytes()
    for damaged in (whole[:-100], whole[:-1] + bytes([whole[-1] ^ 1]), b""):
        file.write_bytes(damaged)
        caplog.clear()
        with caplog.at_level(logging.INFO, "warp_gi"):
            assert folder.bake(*where, lambda: wanted) is wanted
        assert len(caplog.messages) == 1 and "made anew" in caplog.messages[0] and file.name in caplog.messages[0]
        assert file.read_bytes() == whole
    found = folder.bake(*where, lambda: pytest.fail("it is there"))
    assert found.digest == wanted.digest


def test_files_not_used_for_longest_are_removed_first(keeps_all, tmp_path):
    scene, camera = box()
    folder = kept.BakeFolder(tmp_path, most_bytes=20_000)  # two bakes of 8 kB

    def use(seed, size=1000):
        return folder.bake(CACHE, scene, camera, CPU, seed, lambda: made(seed, size)), folder.path(
            CACHE, scene, camera, CPU, seed
        )

    paths = [use(seed)[1] for seed in (1, 2)]
    for age, path in zip((200, 100), paths, strict=True):
        os.utime(path, (os.stat(path).st_mtime - age,) * 2)
    use(1)  # older, and now used
    third = use(3)[1]
    assert [path.exists() for path in (*paths, third)] == [True, False, True]
    large = use(4, 10_000)[1]  # more than all together
    assert [path.exists() for path in (paths[0], third, large)] == [True, True, False]


def test_what_is_made_in_no_time_is_not_kept(tmp_path):
    scene, camera = box()
    folder = kept.BakeFolder(tmp_path)
    assert folder.bake(CACHE, scene, camera, CPU, 1, made).digest == made().digest
    assert folder.bake(CACHE, scene, camera, CPU, 1, lambda: None) is None
    assert not list(tmp_path.iterdir())


def test_a_folder_that_cannot_be_written_to_is_one_line(keeps_all, tmp_path, caplog):
    scene, camera = box()
    (tmp_path / "file").write_text("")
    folder = kept.BakeFolder(tmp_path / "file")
    with caplog.at_level(logging.INFO, "warp_gi"):
        assert folder.bake(CACHE, scene, camera, CPU, 1, made).digest == made().digest
    assert len(caplog.messages) == 1 and "cannot be kept" in caplog.messages[0]


def test_where_bakes_are_kept(monkeypatch, tmp_path):
    monkeypatch.setenv("WARP_GI_BAKES", str(tmp_path / "mine"))
    assert kept.BakeFolder().folder == tmp_path / "mine"
    monkeypatch.delenv("WARP_GI_BAKES")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert kept.BakeFolder().folder == tmp_path / "warp_gi" / "bakes"


WRITER = """
import sys
import numpy as np
from pathlib import Path
from warp_gi.baking import Bake
from warp_gi.kept import BakeFolder
folder, path = BakeFolder(sys.argv[1], most_bytes=1000000), Path(sys.argv[2])
bake = Bake("SurfaceCache", "key", {}, {"values": np.ones(50000)})
for _ in range(20):
    folder._keep(path, bake)
    found = folder._read(path)
    assert found is not None and found.digest == bake.digest
print(bake.digest)
"""


def test_two_processes_share_a_folder(tmp_path):
    path = tmp_path / "SurfaceCache-0.safetensors"
    command = [sys.executable, "-c", WRITER, str(tmp_path), str(path)]
    writers = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True) for _ in range(2)]
    digests = {writer.communicate(timeout=120)[0].strip() for writer in writers}
    assert [writer.returncode for writer in writers] == [0, 0]
    assert digests == {kept.load_bake(path).digest} and [one.name for one in tmp_path.iterdir()] == [path.name]


def test_the_commands_keep_bakes_unless_told_not_to(keeps_all, monkeypatch, tmp_path, capsys):
    folder = tmp_path / "kept"
    monkeypatch.setenv("WARP_GI_BAKES", str(folder))
    settings = ["--paths", "1000"]
    bake = ["bake", "cornell_box", "--technique", "cache", "--quiet", "-o", str(tmp_path / "b.safetensors"), *settings]
    render = [
        "render",
        "cornell_box",
        "--pipeline",
        "cache",
        "--quiet",
        "--spp",
        "1",
        "-o",
        str(tmp_path / "a.####.exr"),
    ]
    render += ["--indirect.ends-in.paths", "1000", "--resolution", "16x12", "--frames", "0"]
    for command in (bake, render):
        assert main([*command, "--no-cache"]) == 0 and not folder.exists()
    assert main([*bake, "--picture", "16x12"]) == 0 and len(list(folder.iterdir())) == 1
    monkeypatch.setattr(SurfaceCache, "bake", lambda *_: pytest.fail("the kept bake was not used"))
    assert main(render) == 0
    capsys.readouterr()


def test_without_a_camera_the_scene_s_own_decide(tmp_path):
    scene, camera = box()
    folder = kept.BakeFolder(tmp_path)
    before = folder.path(CACHE, scene, None, CPU, 1)
    assert before == folder.path(CACHE, scene, None, CPU, 1)
    scene.cameras["main"] = replace(camera, hfov=20.0)
    assert folder.path(CACHE, scene, None, CPU, 1) != before


def test_files_that_are_not_the_folder_s_own_stay(keeps_all, tmp_path):
    """A state, a bake of one's own: a folder of bakes may be one that holds other things."""
    others = [tmp_path / "shot.state.safetensors", tmp_path / "mine.safetensors"]
    for file in others:
        file.write_bytes(bytes(10_000))
        os.utime(file, (1, 1))
    scene, camera = box()
    folder = kept.BakeFolder(tmp_path, most_bytes=9000)
    for seed in range(4):
        folder.bake(CACHE, scene, camera, CPU, seed, made)
    assert all(file.exists() for file in others)
    assert 1 <= len(list(tmp_path.glob("SurfaceCache-*"))) < 4 and folder.path(CACHE, scene, camera, CPU, 3).exists()


def test_a_home_is_known_by_its_sign(monkeypatch, tmp_path):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv(kept.VARIABLE, "~/bakes")
    assert gi.BakeFolder().folder == tmp_path / "bakes" and gi.BakeFolder("~/other").folder == tmp_path / "other"
    monkeypatch.delenv(kept.VARIABLE)
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr("pathlib.Path.home", lambda: (_ for _ in ()).throw(RuntimeError("no home")))
    assert gi.BakeFolder().folder.name == "bakes"


class Own(SurfaceCache):
    """A cache of somebody else, which says nothing of its settings."""

    def bake_settings(self, scene):
        return {}


def test_classes_from_elsewhere_are_told_apart_by_all_their_settings(keeps_all, tmp_path, caplog):
    scene, camera = box()
    folder = kept.BakeFolder(tmp_path)
    files = {folder.path(Own(paths=paths), scene, camera, CPU, 1) for paths in (1000, 2000)}
    assert len(files) == 2
    with caplog.at_level(logging.INFO, "warp_gi"):
        bake = folder.bake(
            CACHE, scene, camera, CPU, 1, lambda: Bake("SurfaceCache", "key", {}, {}, {"n": float("nan")})
        )
    assert bake is not None and "cannot be kept" in caplog.text
