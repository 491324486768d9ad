"""Bake files: what comes back, what is refused and why, whole or not at all."""

import hashlib
import json
import os
import subprocess
import sys

import numpy as np
import pytest
from safetensors.numpy import load_file, save

from warp_gi.baking import Bake, load_bake
from warp_gi.errors import BakeError, GiError
from warp_gi.files import remove_stale_parts

TYPES = "bool uint8 uint16 uint32 uint64 int8 int16 int32 int64 float16 float32 float64".split()
SHAPES = [(), (0,), (0, 3), (1,), (7,), (5, 3), (2, 1, 3, 2)]
KEY, OTHER_KEY = "ab12cd34ef56" + "0" * 52, "0123456789ab" + "f" * 52


def make_bake(**changes):
    arrays = {
        "cells": np.arange(12, dtype=np.int32).reshape(4, 3),
        "seen": np.array([True, False, True]),
        "depth": np.linspace(0, 1, 5),
        "area": np.ones(2),
    }
    values = {
        "technique": "VisibilityField",
        "scene_key": KEY,
        "settings": {"directions": 36, "spacing": 0.5, "whole": 2.0, "mode": "cubes", "thin": True},
        "arrays": arrays,
        "counts": {"rays": 2**40, "seconds": 1.0},
        "scene_name": "atrium",
    }
    return Bake(**(values | changes))


def refused(path):
    """Return the message of the BakeError that loading raises, less the path; it must be one line."""
    with pytest.raises(BakeError) as caught:
        load_bake(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ") and "\n" not in message
    return message.removeprefix(f"{path}: ")


def test_bakes_come_back_bit_equal(tmp_path):
    rng = np.random.default_rng(1)
    arrays = {}
    for name in TYPES:
        for shape in SHAPES:
            size = int(np.prod(shape)) * np.dtype(name).itemsize
            values = rng.integers(0, 2 if name == "bool" else 256, size, dtype=np.uint8)  # NaN payloads too
            arrays[f"{name}/{shape}"] = values.view(name).reshape(shape)
    bake = make_bake(arrays=arrays)
    path = bake.save(str(tmp_path / "new" / "folder" / "a.bake"))
    assert path == tmp_path / "new" / "folder" / "a.bake"
    assert os.listdir(path.parent) == ["a.bake"]
    for back in (load_bake(path), Bake.load(str(path))):
        assert (back.technique, back.scene_key, back.scene_name) == ("VisibilityField", KEY, "atrium")
        assert back.settings == bake.settings and back.counts == bake.counts
        for name, value in (bake.settings | bake.counts).items():
            assert type((back.settings | back.counts)[name]) is type(value), name
        assert back.arrays.keys() == arrays.keys()
        for name, array in arrays.items():
            assert back.arrays[name].dtype == array.dtype and back.arrays[name].shape == array.shape, name
            assert back.arrays[name].tobytes() == array.tobytes(), name
            assert back.arrays[name].flags.writeable and back.arrays[name].flags.c_contiguous, name
        assert back.nbytes == bake.nbytes == sum(array.nbytes for array in arrays.values())
    back.arrays["int32/(5, 3)"][2, 1] += 1  # into memory of its own
    assert load_bake(path).arrays["int32/(5, 3)"].tobytes() == arrays["int32/(5, 3)"].tobytes()


def test_others_may_read_what_they_may_read_of_any_file(tmp_path):
    (tmp_path / "plain").write_bytes(b"")
    assert make_bake().save(tmp_path / "a.bake").stat().st_mode == (tmp_path / "plain").stat().st_mode


def test_other_layouts_come_back_by_value(tmp_path):
    values = np.arange(24, dtype=np.float32).reshape(4, 6)
    frozen = values.copy()
    frozen.flags.writeable = False
    arrays = {"columns": np.asfortranarray(values), "strided": values[::2, ::-3], "big": values.astype(">f4")}
    arrays |= {"frozen": frozen, "repeated": np.broadcast_to(values[0], (3, 6))}
    back = load_bake(make_bake(arrays=arrays).save(tmp_path / "a.bake"))
    for name, array in arrays.items():
        np.testing.assert_array_equal(back.arrays[name], array, err_msg=name)
        assert back.arrays[name].dtype == np.float32 and back.arrays[name].flags.writeable


def test_bakes_of_nothing_come_back(tmp_path):
    back = load_bake(Bake("Probes", "", {}, {}).save(tmp_path / "a.bake"))
    assert (back.arrays, back.settings, back.counts, back.scene_name, back.nbytes) == ({}, {}, {}, "", 0)


def test_numpy_scalars_become_plain_numbers(tmp_path):
    bake = make_bake(settings={"a": np.float32(0.1), "b": np.int64(3), "c": np.bool_(True)}, counts={"n": np.int32(4)})
    back = load_bake(bake.save(tmp_path / "a.bake"))
    assert [type(value) for value in back.settings.values()] == [float, int, bool] and type(back.counts["n"]) is int
    back.check(bake.technique, bake.scene_key, bake.settings)


def test_any_name_of_a_scene_can_be_stored(tmp_path):
    assert load_bake(make_bake(scene_name='Häuser "2"\n').save(tmp_path / "a.bake")).scene_name == 'Häuser "2"\n'
    undecodable = os.fsdecode(b"hall\xff.glb")
    assert load_bake(make_bake(scene_name=undecodable).save(tmp_path / "b.bake")).scene_name == undecodable


def test_equal_bakes_write_equal_bytes(tmp_path):
    """In every process: each hashes strings by another seed."""
    first = make_bake().save(tmp_path / "a.bake").read_bytes()
    other = make_bake()
    other.arrays = dict(reversed(other.arrays.items()))
    other.settings = dict(reversed(other.settings.items()))
    assert other.save(tmp_path / "b.bake").read_bytes() == first
    script = "import sys; from warp_gi.baking import load_bake; load_bake(sys.argv[1]).save(sys.argv[2])"
    for seed in ("0", "1", "2"):
        environment = {**os.environ, "PYTHONHASHSEED": seed}
        subprocess.run(
            [sys.executable, "-c", script, tmp_path / "a.bake", tmp_path / "d.bake"], env=environment, check=True
        )
        assert (tmp_path / "d.bake").read_bytes() == first


def test_files_are_safetensors_of_aligned_arrays(tmp_path):
    bake = make_bake()
    path = bake.save(tmp_path / "a.bake")
    for name, array in load_file(path).items():
        np.testing.assert_array_equal(array, bake.arrays[name])
    data = path.read_bytes()
    length = int.from_bytes(data[:8], "little")
    assert length % 8 == 0
    header = json.loads(data[8 : 8 + length])
    record = json.loads(header.pop("__metadata__")["warp_gi bake"])
    assert record["settings"] == bake.settings and record["counts"] == bake.counts and record["format_version"] == 2
    assert all(entry["data_offsets"][0] % bake.arrays[name].itemsize == 0 for name, entry in header.items())


def first_format(bake, **changes):
    """Return the metadata of format version 1, one entry for each value."""
    texts = {"format_version": "1", "warp_gi": "0.1.0", "sha256": bake.digest}
    texts |= {name: getattr(bake, name) for name in ("technique", "scene_key", "scene_name")}
    texts |= {name: json.dumps(getattr(bake, name), sort_keys=True) for name in ("settings", "counts")}
    seal = hashlib.sha256(json.dumps(texts, sort_keys=True).encode()).hexdigest()
    return {"format": "warp_gi bake", **texts, "metadata_sha256": seal, **changes}


def test_files_of_the_first_format_are_read(tmp_path):
    bake, path = make_bake(), tmp_path / "a.bake"
    path.write_bytes(save(bake.arrays, first_format(bake)))
    back = load_bake(path)
    assert (back.technique, back.scene_key, back.scene_name) == (bake.technique, bake.scene_key, bake.scene_name)
    assert (back.settings, back.counts, back.digest) == (bake.settings, bake.counts, bake.digest)
    for changes in ({"scene_key": OTHER_KEY}, {"settings": "{"}, {"sha256": "0"}, {"format_version": "one"}):
        path.write_bytes(save(bake.arrays, first_format(bake, **changes)))
        assert refused(path).startswith("is damaged")
    path.write_bytes(save(bake.arrays | {"area": np.zeros(2)}, first_format(bake)))
    assert refused(path).startswith("is damaged")


def test_damaged_files_are_refused(tmp_path):
    """Whatever byte is changed or lost."""
    path = make_bake().save(tmp_path / "a.bake")
    data = path.read_bytes()
    path.write_bytes(b"")
    assert refused(path).startswith("is empty")
    for size in range(1, len(data), 3):
        path.write_bytes(data[:size])
        assert refused(path).startswith("is truncated, damaged or no bake at all (")
    for position in range(len(data)):
        changed = bytearray(data)
        changed[position] ^= (0x01, 0x20, 0xFF)[position % 3]
        path.write_bytes(changed)
        refused(path)
    path.write_bytes(data[:-5] + b"12345")
    assert refused(path) == "is damaged: it does not hold what was written; delete it and bake again"
    path.write_bytes(data)
    load_bake(path)


def test_types_that_numpy_lacks_are_refused(tmp_path):
    path = make_bake(arrays={"half": np.ones(4, np.float16)}).save(tmp_path / "a.bake")
    data = path.read_bytes()
    length = int.from_bytes(data[:8], "little")
    header = data[8 : 8 + length].replace(b'"F16"', b'"BF16"')
    path.write_bytes(len(header).to_bytes(8, "little") + header + data[8 + length :])
    assert refused(path).startswith("is damaged")


@pytest.mark.parametrize(
    "record, message",
    [
        ({"format_version": 3}, "is a bake of format version 3, "),
        ({"format_version": "two"}, "is damaged"),
        ({}, "is damaged"),
        ([], "is damaged"),
        ({"format_version": 2, "settings": 7}, "is damaged"),
    ],
)
def test_other_records_are_refused(tmp_path, record, message):
    path = tmp_path / "a.bake"
    path.write_bytes(save(make_bake().arrays, {"warp_gi bake": json.dumps(record)}))
    assert refused(path).startswith(message)
    path.write_bytes(save(make_bake().arrays, {"warp_gi bake": "[" * 100_000}))
    assert refused(path).startswith("is damaged")


@pytest.mark.parametrize("content", [b"# cameras of the hall\n" * 20, bytes(64), b"\x89PNG\r\n\x1a\n" + bytes(100)])
def test_foreign_files_are_refused(tmp_path, content):
    (tmp_path / "a.bake").write_bytes(content)
    assert "or no bake at all" in refused(tmp_path / "a.bake")
    for metadata in (None, {"format": "pt"}, {"settings": "{}"}):
        (tmp_path / "a.bake").write_bytes(save({"weights": np.ones(3)}, metadata))
        assert refused(tmp_path / "a.bake").startswith("is a safetensors file by another program")


def test_missing_files_and_folders_are_refused(tmp_path):
    assert refused(tmp_path / "none.bake").startswith("no such file")
    assert refused(tmp_path).startswith("is a folder")
    (tmp_path / "file").write_text("")
    assert refused(tmp_path / "file" / "a.bake").startswith("no such file")


def unsuitable(bake, *arguments):
    with pytest.raises(BakeError) as caught:
        bake.check(*arguments)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_check_says_why():
    bake = make_bake()
    asked = dict(bake.settings)
    bake.check("VisibilityField", KEY, asked)
    bake.check("VisibilityField", KEY, asked, "another name of the same scene")
    bake.check("VisibilityField", KEY, asked | {"spacing": np.float32(0.5), "whole": 2})

    message = unsuitable(bake, "LightFieldProbes", OTHER_KEY, {})
    assert "by 'VisibilityField', not by 'LightFieldProbes'" in message
    assert unsuitable(bake, "VisibilityField", OTHER_KEY, {}, "hall\n2") == (
        "this bake is of scene 'atrium' (hash ab12cd34ef56), not of 'hall\\n2' (hash 0123456789ab): bake it again"
    )
    assert "is of an unnamed scene (hash ab12cd34ef56), not of an unnamed scene (hash 0123456789ab)" in unsuitable(
        make_bake(scene_name=""), "VisibilityField", OTHER_KEY, {}
    )
    changed = unsuitable(bake, "VisibilityField", OTHER_KEY, asked | {"mode": "plain"}, "atrium")
    assert changed == (
        "this bake has other settings (mode: bake has 'cubes', asked for 'plain'): bake it again or ask for its own"
    )
    assert unsuitable(bake, "VisibilityField", OTHER_KEY, asked, "atrium") == (
        "this bake is of scene 'atrium' as it was (hash ab12cd34ef56, now 0123456789ab): "
        "what it depends on has changed since; bake it again"
    )

    del asked["thin"]
    asked |= {"directions": 18, "mode": "a\nb", "new": False}
    assert unsuitable(bake, "VisibilityField", KEY, asked) == (
        "this bake has other settings (directions: bake has 36, asked for 18; mode: bake has 'cubes', asked for "
        "'a\\nb'; new: bake has none, asked for False; thin: bake has True, asked for none): "
        "bake it again or ask for its own"
    )


def test_a_loaded_bake_passes_its_own_check(tmp_path):
    bake = make_bake(settings={"x": 0.1 + 0.2, "y": 1e-320, "z": 2**70, "text": "ä"})
    load_bake(bake.save(tmp_path / "a.bake")).check(bake.technique, bake.scene_key, bake.settings, bake.scene_name)


@pytest.mark.parametrize(
    "array", [np.ones(2, np.complex64), np.array(["a"]), np.array([None]), np.ones(2, "M8[s]"), np.ones(2, "i4,f4")]
)
def test_other_types_are_refused_on_saving(tmp_path, array):
    with pytest.raises(TypeError, match=r"^array 'x' is .*; a bake holds bool, uint8, .*float64: convert it first$"):
        make_bake(arrays={"x": array}).save(tmp_path / "a.bake")
    assert os.listdir(tmp_path) == []


def test_what_cannot_come_back_is_refused_on_saving(tmp_path):
    for value in (float("nan"), float("inf"), np.float32("-inf")):
        with pytest.raises(BakeError, match=r"^setting 'x' is (nan|-?inf); "):
            make_bake(settings={"x": value}).save(tmp_path / "a.bake")
        with pytest.raises(BakeError, match=r"^count 'x' is (nan|-?inf); "):
            make_bake(counts={"x": value}).save(tmp_path / "a.bake")
    for value in ((1, 2), None, [1], {"a": 1}, np.ones(2), 1j):
        with pytest.raises(TypeError, match=r"^setting 'x' is a \w+; "):
            make_bake(settings={"x": value}).save(tmp_path / "a.bake")
    with pytest.raises(TypeError, match=r"^setting 3 is "):
        make_bake(settings={3: 4}).save(tmp_path / "a.bake")
    for name in ("__metadata__", "a\nb", "\udcff"):
        with pytest.raises(BakeError, match=r"^array name .* cannot be stored"):
            make_bake(arrays={name: np.ones(2)}).save(tmp_path / "a.bake")
    assert os.listdir(tmp_path) == []
    assert issubclass(BakeError, GiError)


def test_a_full_disk_leaves_the_old_file(tmp_path):
    """A limit on the size of files stands for the disk's."""
    path = make_bake().save(tmp_path / "a.bake")
    old = path.read_bytes()
    script = (
        "import resource, signal, sys, numpy as np; from warp_gi.baking import Bake; "
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN); resource.setrlimit(resource.RLIMIT_FSIZE, (4000, 4000))\n"
        "try:\n    Bake('T', '', {}, {'values': np.arange(9000)}).save(sys.argv[1])\n"
        "except OSError as error:\n    print(error.errno, error.filename)"
    )
    for target in (path, tmp_path / "new.bake"):
        told = subprocess.run([sys.executable, "-c", script, target], capture_output=True, text=True, check=True)
        assert told.stdout == f"27 {target}\n"
    assert os.listdir(tmp_path) == ["a.bake"] and path.read_bytes() == old


def test_importing_does_not_need_safetensors():
    script = "import sys, warp_gi.baking; print('safetensors' in sys.modules)"
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "False"


def test_nothing_stays_of_a_save_that_is_killed(tmp_path):
    """safetensors writes to a temporary file of its own beside the path that it is given."""
    code = """
import os, pathlib, sys
import numpy as np
import safetensors.numpy
from warp_gi.baking import Bake

def killed(arrays, path, metadata):
    pathlib.Path(path).with_name(".tmpKilled").write_bytes(b"half")
    os._exit(9)

safetensors.numpy.save_file = killed
Bake("VisibilityField", "key", {}, {"cells": np.zeros(3)}).save(sys.argv[1])
"""
    path = tmp_path / "a.safetensors"
    path.write_bytes(b"the one before")
    assert subprocess.run([sys.executable, "-c", code, str(path)]).returncode == 9
    assert len(os.listdir(tmp_path)) == 2
    remove_stale_parts(path)
    assert os.listdir(tmp_path) == ["a.safetensors"] and path.read_bytes() == b"the one before"
