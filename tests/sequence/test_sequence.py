"""Frame files: names, layers, metadata, whole or not at all."""

import os
import subprocess
import sys

import numpy as np
import pytest
from frame_tools import make_frame

from warp_gi.errors import OptionError, SceneError
from warp_gi.files import machine, remove_stale_parts, replacing
from warp_gi.sequence import frames as sequence
from warp_gi.sequence.exr import read_exr, stored_format, write_exr
from warp_gi.sequence.preview import tone_map


def test_frame_path():
    assert sequence.frame_path("out/shot.####.exr", 7).as_posix() == "out/shot.0007.exr"
    assert sequence.frame_path("out/a#b.##.exr", 123).as_posix() == "out/a#b.123.exr"
    assert sequence.frame_path("out/still.exr", 7).as_posix() == "out/still.exr"
    assert sequence.frame_path("####/x.exr", 7).as_posix() == "####/x.exr"
    with pytest.raises(OptionError, match="start at 0"):
        sequence.frame_path("#.exr", -1)


@pytest.mark.parametrize(
    "text, frames",
    [("5", [5]), ("0-3", [0, 1, 2, 3]), ("0-6:2", [0, 2, 4, 6]), ("9,1-3,2", [9, 1, 2, 3]), (" 1 , 2 ", [1, 2])],
)
def test_parse_frames(text, frames):
    assert sequence.parse_frames(text) == frames


@pytest.mark.parametrize("text", ["", "a", "3-1", "1-", "-1", "0-4:0", "1,,2", "1:2", "1.5"])
def test_parse_frames_refuses(text):
    with pytest.raises(OptionError, match="not understood"):
        sequence.parse_frames(text)


def test_written_frames_read_back(tmp_path):
    frame = make_frame()
    path = sequence.write_frame(frame, tmp_path / "new" / "shot.####.exr")
    assert path == tmp_path / "new" / "shot.0003.exr"
    assert [p.name for p in path.parent.iterdir()] == ["shot.0003.exr"]
    back = sequence.read_frame(path)
    assert set(back.names) == set(frame.names)
    for name in frame.names:
        values = frame.numpy(name)
        assert back.numpy(name).dtype == values.dtype and back.numpy(name).shape == values.shape
        if name in ("position", "depth", "motion", "object_id", "material_id", "variance"):
            assert back.formats[name] == "float"
            np.testing.assert_array_equal(back.numpy(name), values, err_msg=name)
        else:
            assert back.formats[name] == "half"
            np.testing.assert_array_equal(back.numpy(name), values.astype(np.float16).astype(np.float32), err_msg=name)
    assert (back.index, back.time) == (3, 0.125)
    assert back.metadata["seed"] == 5 and back.metadata["large"] == str(2**40) and back.metadata["flag"] == 1
    assert back.metadata["epsilon"] == np.float32(0.1)
    assert back.timings == {"environment": 0.25, "compile": 1.5}
    assert back.camera.resolution == (24, 16) and back.camera.hfov == 50
    np.testing.assert_allclose(back.camera.world_from_camera, frame.camera.world_from_camera, atol=1e-5)
    with pytest.raises(OptionError, match="no layer 'shadow'"):
        back.numpy("shadow")


def test_layers_have_the_usual_names(tmp_path):
    import OpenImageIO as oiio

    path = sequence.write_frame(make_frame(), tmp_path / "a.exr")
    spec = oiio.ImageInput.open(str(path)).spec()
    expected = {"R", "G", "B", "N.X", "N.Y", "N.Z", "P.X", "P.Y", "P.Z", "Z", "motion.u", "motion.v"}
    expected |= {"objectId", "materialId"}
    for layer in ("emission", "environment", "emitters", "indirect", "albedo", "variance"):
        expected |= {f"{layer}.{letter}" for letter in "RGB"}
    assert set(spec.channelnames) == expected
    assert spec.getattribute("compression") == "zip"
    assert spec.getattribute("DateTime") is None


def test_camera_matrices_follow_openexr():
    camera = make_frame().camera
    to_camera, to_ndc = sequence.camera_matrices(camera)
    points = np.array([[0, 1, 0], [1, 2, -3], [0.5, 0, 1]], np.float64)
    rows = np.concatenate([points, np.ones((3, 1))], axis=1)
    local = rows @ to_camera
    axes = camera.world_from_camera[:3, :3]
    np.testing.assert_allclose(local[:, :3], (points - camera.position) @ (axes * [1, 1, -1]), atol=1e-5)
    assert (local[:, 2] > 0).all()  # the camera looks along +z in OpenEXR
    ndc = rows @ to_ndc
    np.testing.assert_allclose(ndc[:, :2] / ndc[:, 3:] * camera.resolution, camera.project(points), rtol=1e-5)
    assert abs(np.linalg.det(to_ndc.astype(np.float64))) > 1e-6


def test_values_past_half_stay_finite(tmp_path):
    frame = make_frame(peak=1e6)
    back = sequence.read_frame(sequence.write_frame(frame, tmp_path / "a.exr"))
    assert back.formats["beauty"] == "float" and back.formats["albedo"] == "half"
    np.testing.assert_array_equal(back.numpy("beauty"), frame.numpy("beauty"))


@pytest.mark.parametrize(
    ("values", "format"),
    [([1.0, -65504.0], "half"), ([1.0, -65505.0], "float"), ([np.nan, 1e6], "float"), ([np.inf, np.nan, 2.0], "half")],
)
def test_format_goes_by_finite_values(values, format):
    assert stored_format("beauty", np.array(values, np.float32)) == format


def test_full_precision_on_demand(tmp_path):
    frame = make_frame()
    back = sequence.read_frame(sequence.write_frame(frame, tmp_path / "a.exr", precision="float"))
    np.testing.assert_array_equal(back.numpy("beauty"), frame.numpy("beauty"))
    with pytest.raises(OptionError, match="precision"):
        sequence.write_frame(frame, tmp_path / "b.exr", precision="double")
    assert not (tmp_path / "b.exr").exists()


def test_equal_frames_are_equal_files(tmp_path):
    a = sequence.write_frame(make_frame(), tmp_path / "a.exr")
    b = sequence.write_frame(make_frame(), tmp_path / "b.exr")
    assert a.read_bytes() == b.read_bytes()


def test_every_truncation_is_noticed(tmp_path):
    whole = sequence.write_frame(make_frame(), tmp_path / "a.exr")
    data = whole.read_bytes()
    assert sequence.why_not_whole(whole) is None
    torn = tmp_path / "torn.exr"
    for length in [0, 1, 4, 50, *np.linspace(100, len(data) - 2, 40).astype(int), len(data) - 1]:
        torn.write_bytes(data[:length])
        assert sequence.why_not_whole(torn) == "not whole", length
        with pytest.raises(SceneError, match="not a whole EXR"):
            sequence.read_frame(torn)
    torn.write_bytes(data[:3000] + bytes(len(data) - 3000))
    assert sequence.why_not_whole(torn) == "not whole"
    assert sequence.why_not_whole(tmp_path / "none.exr") == "missing"


def test_frames_with_other_settings_are_not_done(tmp_path):
    frame = make_frame()
    path = sequence.write_frame(frame, tmp_path / "a.exr")

    def why(camera=frame.camera, index=frame.index, time=frame.time, **changes):
        metadata = {k: v for k, v in {**frame.metadata, **changes}.items() if v is not None}
        return sequence.why_not_whole(path, sequence.frame_attributes(index, time, camera, metadata), camera)

    assert why() is None
    assert why(spp=16) == "spp is 8 instead of 16"
    assert why(seed=None) == "seed is 5 instead of None"
    assert why(extra="x") == "extra is None instead of 'x'"
    assert why(index=4).startswith("frame is 3")
    assert why(camera=make_frame(index=4).camera) == "another camera"
    assert why(camera=frame.camera.at_resolution(48, 32)) == "24x16 instead of 48x32"


def test_unknown_kind_of_file(tmp_path):
    with pytest.raises(OptionError, match=r"\.exr or \.png"):
        sequence.write_frame(make_frame(), tmp_path / "a.tiff")


def test_failed_write_keeps_the_old_file(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")
    with pytest.raises(RuntimeError), replacing(path) as part:
        part.write_text("half")
        raise RuntimeError
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_stale_parts_go_and_living_ones_stay(tmp_path):
    path = tmp_path / "a.exr"
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    here, there = machine(), "0123abcd"
    stale = [f".a.exr.{here}-{dead.pid}-00000001.part", f".a.exr.{here}-{os.getpid()}-00000001.part"]
    stale += [f".a.exr.{there}-{os.getpid()}-00000001.part"]  # of another container, a day old
    kept = [f".a.exr.{here}-{os.getppid()}-00000001.part", f".b.exr.{here}-{dead.pid}-00000001.part"]
    kept += [f".a.exr.{there}-{dead.pid}-00000002.part"]  # whose process cannot be asked for
    for name in (*stale, *kept):
        (tmp_path / name).write_text("x")
    os.utime(tmp_path / stale[2], (0, 0))
    with replacing(path) as part:  # of a thread of this process
        part.write_text("new")
        remove_stale_parts(path)
        assert sorted(one.name for one in tmp_path.iterdir()) == sorted([*kept, part.name])
    assert path.read_text() == "new"


def test_two_writers_of_one_file_do_not_meet(tmp_path):
    """Each has a temporary file of its own, whatever their process numbers are."""
    path = tmp_path / "a.exr"
    with replacing(path) as one, replacing(path) as other:
        one.write_text("one")
        other.write_text("other")
    assert one != other and path.read_text() == "one" and list(tmp_path.iterdir()) == [path]


def test_full_disk_is_one_error_and_no_file(tmp_path):
    pytest.importorskip("resource")
    script = f"""
import resource, sys
sys.path.insert(0, {os.path.dirname(os.path.dirname(__file__))!r})
from frame_tools import make_frame
from warp_gi.sequence import frames as sequence
frame = make_frame(width=200, height=200)
resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))
try:
    sequence.write_frame(frame, "a.exr")
except OSError as error:
    print(error)
"""
    result = subprocess.run([sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True)
    assert result.stdout.startswith("cannot write a.exr: ") and result.stdout.count("\n") == 1, result
    assert list(tmp_path.iterdir()) == []


def test_png_is_tone_mapped(tmp_path):
    from PIL import Image

    frame = make_frame()
    path = sequence.write_frame(frame, tmp_path / "a.png")
    stored = sequence.read_frame(sequence.write_frame(frame, tmp_path / "a.exr"))
    pixels = np.asarray(Image.open(path))
    np.testing.assert_array_equal(pixels, tone_map(frame.numpy("beauty").astype(np.float16)))
    again = sequence.write_preview(stored, tmp_path / "b.png")
    assert again.read_bytes() == path.read_bytes()


def test_tone_curve():
    grey = np.array([0, 0.18, 1, 4, 1000, np.inf, np.nan])[None, :, None] * np.ones(3)
    mapped = tone_map(grey)[0].astype(int)
    assert np.ptp(mapped, axis=1).max() <= 1  # grey stays grey
    assert mapped[0, 0] == 0 and mapped[-1, 0] == 0
    assert 110 < mapped[1, 0] < 135  # middle grey stays in the middle
    assert (np.diff(mapped[:5, 0]) > 0).all() and mapped[4, 0] >= 254 and mapped[5, 0] >= 254
    np.testing.assert_array_equal(tone_map(grey / 2, exposure=1), tone_map(grey))


def test_exr_of_other_programs(tmp_path):
    path = tmp_path / "a.exr"
    write_exr(path, {"beauty": np.ones((2, 3, 3)), "mask": np.zeros((2, 3)), "uv": np.ones((2, 3, 2))}, {"by": "hand"})
    buffers, attributes, _ = read_exr(path)
    assert set(buffers) == {"beauty", "mask", "uv"} and attributes["by"] == "hand"
    assert sequence.read_frame(path).camera is None
    with pytest.raises(SceneError, match="no such file"):
        read_exr(tmp_path / "b.exr")
    with pytest.raises(OptionError, match="the others are"):
        write_exr(path, {"beauty": np.ones((2, 3, 3)), "mask": np.zeros((3, 3))}, {})
    with pytest.raises(OptionError, match=r"2\^24"):
        write_exr(path, {"object_id": np.full((2, 2), 2**24 + 2)}, {})
