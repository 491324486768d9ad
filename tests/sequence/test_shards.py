"""Shards of bakes: a merge is equal to one bake, bit for bit, and what is no set of shards is refused in one line."""

import itertools

import numpy as np
import pytest

import warp_gi as gi
from warp_gi.baking import Bake
from warp_gi.cli import main as cli
from warp_gi.techniques.visibility_field.bake import running_sums

FIELD = ["bake", "cornell_box", "--cell-size=0.5", "--resolution=18", "--rays=64", "--everywhere", "--quiet"]
MERGE = ["merge", "--quiet", "-o"]


def same(one, other):
    """Whether two bakes are equal in all but the seconds they took."""
    assert list(one.arrays) == list(other.arrays)
    for name, array in one.arrays.items():
        assert array.dtype == other.arrays[name].dtype
        np.testing.assert_array_equal(array, other.arrays[name], err_msg=name)
    for bake in (one, other):
        bake.counts = {name: count for name, count in bake.counts.items() if not name.endswith("seconds")}
    assert one.counts == other.counts
    for name in ("technique", "scene_key", "scene_name", "settings"):
        assert getattr(one, name) == getattr(other, name)
    assert one.digest == other.digest


@pytest.fixture(scope="module")
def field(tmp_path_factory):
    """Files of a whole field, and of its three shards."""
    folder = tmp_path_factory.mktemp("field")
    whole, *shards = (folder / f"{name}.safetensors" for name in ("whole", "1", "2", "3"))
    assert cli.main([*FIELD, "--no-cache", "-o", str(whole)]) == 0
    for number, path in enumerate(shards, 1):
        assert cli.main([*FIELD, f"--chunk={number}/3", "--threads=1", "-o", str(path)]) == 0
    return whole, *shards


def test_a_field_of_three_shards_is_that_of_one_bake(field, tmp_path):
    whole, *shards = field
    out = tmp_path / "new" / "merged.safetensors"
    assert cli.main([*MERGE, str(out), *map(str, reversed(shards))]) == 0
    assert all(len(gi.load_bake(path).arrays["cells"]) > 5 for path in shards)
    same(gi.load_bake(out), gi.load_bake(whole))
    assert [path.name for path in out.parent.iterdir()] == [out.name]


def test_a_field_of_a_view_in_more_shards_than_cells():
    """Triangles of all sizes, so that sums of areas round; shards without any cell, and with empty ones alone."""
    rng = np.random.default_rng(5)
    corners = rng.uniform(-1, 1, (150, 1, 3)) + rng.normal(size=(150, 3, 3)) * 10 ** rng.uniform(-5, -0.3, (150, 1, 1))
    mesh = gi.Mesh(corners.reshape(-1, 3).astype(np.float32), np.arange(450).reshape(-1, 3), gi.Material("grey"))
    scene = gi.Scene([gi.Node("one", [mesh])], name="bits")
    view = gi.Camera.look_at((0, 0, 4), (0, 0, 0), hfov=50.0, resolution=(24, 16))
    part = gi.VisibilityField(cell_size=0.9, resolution=18, rays=8)
    for camera, count in ((view, 2), (None, 40)):
        shards = [gi.bake(scene, part, seed=7, camera=camera, chunk=(k + 1, count)) for k in range(count)]
        same(gi.merge_bakes(shards), gi.bake(scene, part, seed=7, camera=camera))


def test_sums_within_runs_know_nothing_of_other_runs():
    rng = np.random.default_rng(2)
    values, starts = 10.0 ** rng.uniform(-12, 3, 1000), np.array([0, 400, 401, 900, 1000])
    sums = running_sums(values, starts)
    for first, last in itertools.pairwise(starts):
        expected = list(itertools.accumulate(values[first:last].tolist()))
        np.testing.assert_array_equal(sums[first:last], expected)


def changed(path, folder, **more):
    """A shard with other attributes, as a file."""
    bake = gi.load_bake(path)
    bake.settings |= more.pop("settings", {})
    for name, value in more.items():
        setattr(bake, name, value)
    return bake.save(folder / "changed.safetensors")


BAD = [
    ({"scene_key": "0" * 64}, "hash of the scene 000000000000 instead of"),
    ({"technique": "VisibilityField, shard 2 of 4"}, "number of shards 4 instead of 3"),
    ({"technique": "RadianceTransfer, shard 2 of 3"}, "technique RadianceTransfer instead of VisibilityField"),
    ({"settings": {"rays": 65}}, "setting rays 65 instead of 64"),
    ({"settings": {"shard.seed": 2}}, "seed 2 instead of 1"),
    ({"settings": {"shard.warp_gi": "0.0.1"}}, "warp_gi 0.0.1 instead of"),
    ({"settings": {"shard.processor": "riscv"}}, "processor riscv instead of"),
    ({"settings": {"shard.of": "1" * 64}}, "scene, sky or views of the camera 1111"),
    ({"technique": "VisibilityField, shard 1 of 3"}, "shard 1 of 3 is there twice"),
    ({"technique": "VisibilityField"}, "is a whole bake by 'VisibilityField', not a shard; leave it out"),
]


@pytest.mark.parametrize(("more", "expected"), BAD, ids=[expected for _, expected in BAD])
def test_what_is_no_shard_of_the_same_bake_is_named(field, tmp_path, capsys, more, expected):
    _, first, second, third = field
    refused(capsys, tmp_path, expected, first, changed(second, tmp_path, **more), third)


def refused(capsys, folder, expected, *shards):
    out = folder / "out" / "merged.safetensors"
    assert cli.main([*MERGE, str(out), *map(str, shards)]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1 and expected in lines[0], lines
    assert not out.parent.exists()


def test_missing_torn_and_forged_shards(field, tmp_path, capsys):
    _, first, second, third = field
    refused(capsys, tmp_path, "1 of 3 shards are missing (2/3): bake each by --chunk", first, third)
    refused(capsys, tmp_path, "no such file", first, second, tmp_path / "none.safetensors")
    torn = tmp_path / "torn.safetensors"
    torn.write_bytes(second.read_bytes()[:-100])
    refused(capsys, tmp_path, "is truncated, damaged or no bake", first, torn, third)
    bake = gi.load_bake(second)
    other = changed(second, tmp_path, arrays=bake.arrays | {"flags": bake.arrays["flags"][1:]})
    refused(capsys, tmp_path, "its array 'flags' is int32", first, other, third)
    copied = changed(second, tmp_path, arrays=gi.load_bake(first).arrays)
    refused(capsys, tmp_path, "have cells in common", first, copied, third)
    before = first.read_bytes()
    assert cli.main([*MERGE, str(first), *map(str, (first, second, third))]) == 2
    assert "would be written over a shard" in capsys.readouterr().err and first.read_bytes() == before
    with pytest.raises(gi.BakeError, match="there is no shard to merge"):
        gi.merge_bakes([])
    huge = Bake("VisibilityField, shard 1 of 1000000", "", {}, {})
    with pytest.raises(gi.BakeError, match=r"999999 of 1000000 shards are missing \(2/1000000, .*, \.\.\.\)"):
        gi.merge_bakes([huge])


def test_a_shard_is_no_bake(field, tmp_path, capsys):
    out = str(tmp_path / "a.exr")
    command = ["render", "cornell_box", "--pipeline=dvf,indirect=none", "--resolution=16x16", "--spp=1", "--quiet"]
    assert cli.main([*command, "--frames=0", f"--bake={field[2]}", "-o", out]) == 2
    assert "this is shard 2 of 3 of a bake by 'VisibilityField': merge all 3 first" in capsys.readouterr().err
    with pytest.raises(gi.BakeError, match="shard 2 of 3"):
        gi.load_bake(field[2]).check("VisibilityField", "", {})


OPTIONS = [
    (["--technique=surface-cache", "--chunk=1/2"], "SurfaceCache cannot be baked in shards yet, but VisibilityField"),
    (["--chunk=3/2"], "a chunk must be I/N with I from 1 to N"),
    (["--chunk=half"], "a chunk must be I/N, as 3/16"),
    (["--chunk=1/2", "--show=pictures"], "--show is of a whole bake, and --chunk makes a shard"),
]


@pytest.mark.parametrize(("options", "expected"), OPTIONS)
def test_shards_that_cannot_be(options, expected, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert cli.main(["bake", "cornell_box", *options]) == 2
    assert expected in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
