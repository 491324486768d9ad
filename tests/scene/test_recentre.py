"""Scenes far from their origin: positions are moved in double precision, cameras stay where their file says."""

import json
import struct
import warnings

import numpy as np
import pytest
import trimesh

import warp_gi as gi
from warp_gi.cli import main as cli

UTM = np.array([446_123.4, 52.1, 5_411_987.6])
"""Easting, height, northing in metres, as surveys give them; float32 has steps of half a metre there."""
STEPS = 4
EYE, TARGET = np.array([1.3, 1.2, 1.1]), np.array([0.0, 0.3, -0.5])
SMALL = gi.Pipeline.preset("path", spp=4, denoise=None)


def stair():
    """Return corners [n, 3] and quads [m, 4] of a stair of steps of 0.15 m."""
    points, quads = [], []
    for i in range(STEPS):
        y, z = 0.15 * i, -0.3 * i
        for low, high in (((y, z), (y + 0.15, z)), ((y + 0.15, z), (y + 0.15, z - 0.3))):
            quads.append([len(points) + k for k in (0, 1, 3, 2)])
            points += [(x, *end) for end in (low, high) for x in (-1.0, 1.0)]
    return np.array(points), np.array(quads)


def write_obj(path, offset, scale=1.0):
    points, quads = stair()
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in ((points + offset) / scale).tolist()]
    lines += [f"f {' '.join(str(i + 1) for i in quad)}" for quad in quads]
    path.write_text("\n".join(lines) + "\n")
    return path


def write_glb(path, offset, with_camera=True):
    """Write the stair as a node at ``offset``, and a camera beside it."""
    points, quads = stair()
    data = points.astype("<f4").tobytes() + np.concatenate([quads[:, :3], quads[:, [0, 2, 3]]]).astype("<u4").tobytes()
    views = [(0, points.size * 4), (points.size * 4, quads.size // 4 * 24)]
    eye = np.add(offset, (0.0, 0.3, 3.0)).tolist()
    document = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0, 1]}],
        "nodes": [{"name": "stair", "mesh": 0, "translation": list(offset)}, {"camera": 0, "translation": eye}],
        "cameras": [
            {"type": "perspective", "name": "view", "perspective": {"yfov": 0.8, "znear": 0.1, "aspectRatio": 1.5}}
        ],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "buffers": [{"byteLength": len(data)}],
        "bufferViews": [{"buffer": 0, "byteOffset": start, "byteLength": length} for start, length in views],
        "accessors": [
            {
                "bufferView": 0,
                "componentType": 5126,
                "count": len(points),
                "type": "VEC3",
                "min": points.min(axis=0).tolist(),
                "max": points.max(axis=0).tolist(),
            },
            {"bufferView": 1, "componentType": 5125, "count": quads.size // 4 * 6, "type": "SCALAR"},
        ],
    }
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(data), 0x004E4942) + data
    path.write_bytes(struct.pack("<III", 0x46546C67, 2, 12 + len(chunks)) + chunks)
    return path


def write_ply(path, offset):
    points, quads = stair()
    lines = ["ply", "format ascii 1.0", f"element vertex {len(points)}", *(f"property double {c}" for c in "xyz")]
    lines += [f"element face {len(quads)}", "property list uchar int vertex_indices", "end_header"]
    lines += [f"{x!r} {y!r} {z!r}" for x, y, z in (points + offset).tolist()]
    path.write_text("\n".join(lines + [f"4 {a} {b} {c} {d}" for a, b, c, d in quads]) + "\n")
    return path


def trimesh_of(path, offset):
    """Return a scene of trimesh in place of a file."""
    points, quads = stair()
    faces = np.concatenate([quads[:, :3], quads[:, [0, 2, 3]]])
    return trimesh.Scene([trimesh.Trimesh(points + offset, faces, process=False)])


def world_points(scene):
    return scene.offset + np.asarray(scene._flat.points, np.float64)


def depths(scene, camera):
    (frame,) = gi.render(scene, camera.at_resolution(32, 24), SMALL)
    return frame


def test_a_far_scene_is_recentred_with_a_line(tmp_path):
    file = write_obj(tmp_path / "utm.obj", UTM)
    with pytest.warns(
        UserWarning, match=r"5,411,98\d m from its origin.*steps of 500 mm.*cameras are still in the file's"
    ):
        scene = gi.load_scene(file)
    assert np.abs(world_points(scene).min(axis=0) - (stair()[0] + UTM).min(axis=0)).max() < 1e-4
    assert np.abs(scene.bounds).max() < 5 and np.array_equal(scene.offset, np.round(scene.offset))


@pytest.mark.parametrize("recentre", [None, False])
def test_near_scenes_stay_to_the_bit(tmp_path, recentre):
    file = write_obj(tmp_path / "near.obj", (9000.1, 0.0, 0.0))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        scene = gi.load_scene(file, recentre=recentre)
    assert not scene.offset.any()
    expected = np.unique((stair()[0] + (9000.1, 0, 0)).astype(np.float32), axis=0)
    assert np.array_equal(np.unique(scene._flat.points, axis=0), expected)
    assert all(mesh.points.dtype == np.float32 for node in scene.nodes for mesh in node.meshes)


def test_it_can_be_asked_for_and_refused(tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        near = gi.load_scene(write_obj(tmp_path / "near.obj", (500.0, 0.0, 0.0)), recentre=True)
        far = gi.load_scene(write_obj(tmp_path / "utm.obj", UTM), recentre=False)
    assert near.offset[0] == 500.0 and np.abs(near.bounds).max() < 5
    assert not far.offset.any() and far.bounds.max() > 5e6


@pytest.mark.parametrize("kind", ["obj", "glb", "ply", "trimesh"])
def test_a_far_scene_looks_as_a_near_one(tmp_path, kind):
    """Cameras are given in the file's coordinates, and stand where they stood before the stair."""
    write = {"obj": write_obj, "glb": write_glb, "ply": write_ply, "trimesh": trimesh_of}[kind]
    near = gi.load_scene(write(tmp_path / f"near.{kind}", np.zeros(3)), 1.0)
    far = gi.load_scene(write(tmp_path / f"far.{kind}", UTM), 1.0, recentre=True)
    here = depths(near, gi.Camera.look_at(EYE, TARGET))
    there = depths(far, gi.Camera.look_at(UTM + EYE, UTM + TARGET))
    assert np.isfinite(here.numpy("depth")).mean() > 0.2
    np.testing.assert_allclose(there.numpy("depth"), here.numpy("depth"), atol=1e-4)
    hit = np.isfinite(here.numpy("depth"))
    back = there.numpy("position")[hit] + far.offset
    assert np.abs(back - UTM - here.numpy("position")[hit]).max() < 1e-3


def test_cameras_of_the_file_and_paths(tmp_path):
    near = gi.load_scene(write_glb(tmp_path / "near.glb", np.zeros(3)), 1.0)
    far = gi.load_scene(write_glb(tmp_path / "far.glb", UTM), 1.0, recentre=True)
    a = depths(near, near.cameras["view"]).numpy("depth")
    np.testing.assert_allclose(depths(far, far.cameras["view"]).numpy("depth"), a, atol=1e-4)
    np.testing.assert_allclose(depths(far, gi.CameraPath.from_scene(far)).numpy("depth"), a, atol=1e-4)
    keys = [gi.CameraKey(0.0, tuple(UTM + EYE), tuple(UTM + TARGET)), gi.CameraKey(1.0, tuple(UTM), tuple(UTM + 1))]
    path = gi.CameraPath(tuple(keys))
    moved = path.relative_to(far.offset)
    assert np.allclose(moved.camera(12).position + far.offset, path.camera(12).position, atol=1e-6)
    assert moved.relative_to((0.0, 0.0, 0.0)).keys[0].eye == pytest.approx(keys[0].eye)
    assert gi.CameraPath.from_cameras([moved.camera(0), path.camera(0)]).camera(1).offset == moved.offset


def test_a_frame_file_tells_the_offset(tmp_path):
    scene = gi.load_scene(write_obj(tmp_path / "utm.obj", UTM), 1.0, recentre=True)
    camera = gi.Camera.look_at(UTM + EYE, UTM + TARGET, resolution=(32, 24))
    (frame,) = gi.render(scene, camera, SMALL, output=tmp_path / "a.exr")
    read = gi.read_frame(tmp_path / "a.exr")
    assert np.array_equal(read.offset, scene.offset) and read.metadata["offset"] == "446123 52 5411987"
    assert np.allclose(read.camera.position + read.offset, UTM + EYE, atol=1e-3)
    (again,) = gi.render(scene, read.camera, SMALL)
    np.testing.assert_allclose(again.numpy("depth"), frame.numpy("depth"), atol=1e-3)
    assert not list(gi.render(scene, camera, SMALL, output=tmp_path / "a.exr", resume=True))
    assert not gi.read_frame(tmp_path / "a.exr").offset.tolist() == [0, 0, 0]


def test_objects_of_trimesh_are_scaled_turned_and_recentred():
    with pytest.warns(UserWarning, match="'the trimesh object' lies .* m from its origin"):
        scene = gi.load_scene(trimesh_of(None, 1000 * UTM[[0, 2, 1]]), scale=0.001, up="z")
    points = 0.001 * (stair()[0] + 1000 * UTM[[0, 2, 1]]) @ [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
    assert np.abs(world_points(scene).min(axis=0) - points.min(axis=0)).max() < 1e-6
    assert all(mesh.points.dtype == np.float32 for node in scene.nodes for mesh in node.meshes)


def test_what_a_file_uses_is_told_of_far_scenes_too(tmp_path):
    file = write_obj(tmp_path / "far.obj", UTM)
    file.write_text(file.read_text() + "l 1 2\n")
    with pytest.warns(gi.UnsupportedWarning, match="points and lines"):
        assert gi.load_scene(file, recentre=True, smooth=30.0, scale=2.0, up="z").offset.any()


def test_scale_and_animation(tmp_path):
    scaled = gi.load_scene(write_obj(tmp_path / "mm.obj", UTM, scale=0.001), scale=0.001, recentre=True)
    assert np.abs(np.sort(world_points(scaled), axis=0)[0] - (stair()[0] + UTM).min(axis=0)).max() < 1e-3
    scene = gi.load_scene(write_glb(tmp_path / "far.glb", UTM), recentre=True)
    scene.animate("stair", [gi.Keyframe(0.0, tuple(UTM)), gi.Keyframe(1.0, tuple(UTM + 1.0))])
    box = scene.node_box([node.name for node in scene.nodes].index("stair"), 1.0) + scene.offset
    assert np.allclose(box[0], (stair()[0] + UTM + 1).min(axis=0), atol=1e-3)


@pytest.mark.parametrize("place", [np.eye(4), np.diag([0.5, 0.5, 0.5, 1.0])])
def test_keyframes_of_meshes_far_from_their_own_origin(place):
    """A key as the placement at rest leaves a mesh where it is, whether its points or its node were moved."""
    world = trimesh.Scene()
    world.add_geometry(trimesh_of(None, UTM).to_mesh(), node_name="stair", transform=place)
    scene = gi.load_scene(world, recentre=True)
    rest = scene.bounds
    size = (float(place[0, 0]),) * 3
    scene.animate("stair", [gi.Keyframe(0.0, scale=size), gi.Keyframe(1.0, (3.0, 0.0, 0.0), scale=size)])
    np.testing.assert_allclose(scene.node_box(0, 0.0), rest, atol=1e-5)
    np.testing.assert_allclose(scene.node_box(0, 0.5), np.add(rest, (1.5, 0, 0)), atol=1e-5)


def test_far_from_everything_but_the_middle_is_where_triangles_are(tmp_path):
    """One stray triangle at the origin does not keep a scene of many far away."""
    file = write_obj(tmp_path / "utm.obj", UTM)
    points = len(stair()[0])
    file.write_text(
        file.read_text()
        + f"o stray\nv 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl other\nf {points + 1} {points + 2} {points + 3}\n"
    )
    with pytest.warns(UserWarning, match=r"446,12\d x 5\d x 5,411,98\d m large and reaches .* steps of 500 mm"):
        scene = gi.load_scene(file, recentre=True)
    assert np.abs(scene.offset - UTM).max() < 3


def test_a_scene_that_is_far_on_both_sides_of_its_middle(tmp_path):
    """No offset helps a scene of 200 km, whose middle is its origin: what it reaches is told."""
    file = tmp_path / "wide.obj"
    corners = [(-1, 0, -1), (1, 0, -1), (1, 0, 1), (-1, 0, 1)]
    file.write_text("".join(f"v {1e5 * x} {y} {1e5 * z}\n" for x, y, z in corners) + "f 1 2 3 4\n")
    line = r"200,000 x 0 x 200,000 m large and reaches 100,000 m from the origin, where float32 has steps of 7.81 mm"
    with pytest.warns(UserWarning, match=line):
        assert not gi.load_scene(file).offset.any()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert gi.load_scene(file, scale=0.1).bounds[1, 0] == 1e4
        gi.load_scene(file, recentre=False)


def test_the_command_line(tmp_path, capsys):
    file = write_obj(tmp_path / "near.obj", (500.0, 0.0, 0.0))
    eye, target = np.add(EYE, (500, 0, 0)).tolist(), np.add(TARGET, (500, 0, 0)).tolist()
    view = ["--eye", *map(str, eye), "--target", *map(str, target), "--resolution=32x24", "--spp=1", "--pipeline=path"]
    command = ["render", str(file), *view, "--environment=1", "-o"]
    assert cli.main([*command, str(tmp_path / "a.exr"), "--recentre"]) == 0
    assert cli.main([*command, str(tmp_path / "b.exr")]) == 0
    a, b = gi.read_frame(tmp_path / "a.exr"), gi.read_frame(tmp_path / "b.exr")
    np.testing.assert_allclose(a.numpy("depth"), b.numpy("depth"), atol=1e-3)
    assert a.offset[0] == 500 and not b.offset.any()
    assert cli.main(["render", "cornell_box", "--recentre"]) == 2
    assert "--recentre go with a scene from a file" in capsys.readouterr().err
