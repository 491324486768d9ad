"""OFF and STL files as other programs write them."""

from __future__ import annotations

import struct
import warnings

import numpy as np
import pytest

import warp_gi as gi
from warp_gi.color import decode_srgb

SQUARE = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], float)
TRIANGLES = SQUARE[[[0, 1, 2], [0, 2, 3]]]


def load(folder, name, data):
    """Return a scene of a file of this text or these bytes, and the texts of its warnings."""
    (folder / name).write_bytes(data if isinstance(data, bytes) else data.encode())
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        scene = gi.load_scene(folder / name)
    return scene, [str(one.message) for one in caught]


def corners_of(scene):
    return scene._flat.points[scene._flat.indices]


def area(scene):
    triangles = corners_of(scene).astype(float)
    return (
        np.linalg.norm(np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]), axis=1).sum() / 2
    )


# ---- OFF ----


def off(faces=("4 0 1 2 3",), points=SQUARE, more=(), head="OFF"):
    """Return an OFF file, each of whose vertices has the numbers ``more`` behind its point."""
    extras = more or [()] * len(points)
    rows = [" ".join(f"{x:g}" for x in [*point, *extra]) for point, extra in zip(points, extras, strict=True)]
    return "\n".join([head, f"{len(points)} {len(faces)} 0", *rows, *faces]) + "\n"


@pytest.mark.parametrize(
    "text",
    [
        off(),
        off(head="# made by hand\nOFF"),
        off().replace("OFF\n", "OFF "),
        off().replace("\n", "\r\n"),
        off().replace("\n", "  # a comment\n\n"),
        off().replace("4 1 0", "4 1"),
        "\ufeff" + off(),
        off(("3 0 1 2", "3 0 2 3")),
    ],
)
def test_ways_to_write_off(text, tmp_path):
    scene, told = load(tmp_path, "a.off", text)
    np.testing.assert_array_equal(corners_of(scene), TRIANGLES)
    assert not told


def test_concave_faces_of_off_are_no_fans(tmp_path):
    points = [(0, 0, 0), (2, 0, 0), (2, 1, 0), (1, 1, 0), (1, 2, 0), (0, 2, 0)]
    scene, _ = load(tmp_path, "a.off", off(("6 1 2 3 4 5 0",), points))  # a fan of vertex 1 has an area of 4
    assert area(scene) == pytest.approx(3.0)
    scene, _ = load(tmp_path, "a.off", off(("4 0 1 2 3", "3 3 2 4"), [*SQUARE, (0, 2, 0)]))
    assert area(scene) == pytest.approx(5.0)


@pytest.mark.parametrize(
    ("head", "colors", "expected"),
    [
        ("COFF", [(255, 0, 51, 255)] * 4, (1, 0, 0.2, 1)),
        ("COFF", [(1.0, 0.5, 0.0, 0.25)] * 4, (1, 0.5, 0, 0.25)),
        ("OFF", [(0, 255, 51)] * 4, (0, 1, 0.2)),
    ],
)
def test_colours_of_vertices_of_off(head, colors, expected, tmp_path):
    scene, told = load(tmp_path, "a.off", off(more=colors, head=head))
    wanted = [*decode_srgb(np.array(expected[:3])), *expected[3:]]
    np.testing.assert_allclose(scene.nodes[0].meshes[0].colors, [wanted] * 4, atol=1e-6)
    material = scene.materials[0]
    assert material.base_color == (1, 1, 1) and material.alpha_blend == (expected[-1] == 0.25) and not told


def test_normals_and_coordinates_of_off(tmp_path):
    more = [(0, 0, 1, 9, 0, 0, 255, u, v) for u, v in ((0, 0), (1, 0), (1, 1), (0, 1))]
    scene, _ = load(tmp_path, "a.off", off(more=more, head="STCNOFF"))
    mesh = scene.nodes[0].meshes[0]
    np.testing.assert_array_equal(mesh.normals, [[0, 0, 1]] * 4)
    np.testing.assert_array_equal(mesh.uvs, [[0, 0], [1, 0], [1, 1], [0, 1]])
    assert mesh.colors.shape == (4, 4)


@pytest.mark.parametrize(
    ("face", "feature"),
    [("4 0 1 2 3 255 0 0", "colours of faces"), ("2 0 1", r"faces of fewer than three corners (line 7)")],
)
def test_what_off_has_and_is_not_read_is_told(face, feature, tmp_path):
    _, (told,) = load(tmp_path, "a.off", off((face, "3 0 1 2")))
    assert f"uses {feature}, which is ignored" in told


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is no OFF file: it does not begin with OFF"),
        (off()[4:], "is no OFF file"),
        (off(head="4OFF"), "is OFF with '4OFF', which is not supported"),
        (off(head="OFF BINARY"), "is OFF with 'OFF BINARY', which is not supported"),
        ("OFF\n", "its numbers of vertices, faces and edges are missing"),
        (off().replace("4 1 0", "4 x 0"), "line 2: expected numbers, got '4 x 0'"),
        (off().replace("4 1 0", "4 2 0"), "is truncated: it should have 4 vertices and 2 faces, and has 5 lines"),
        (off().replace("1 1 0", "1 one 0"), "line 5: expected numbers, got '1 one 0'"),
        (off().replace("1 1 0", "1 1"), "its vertices have 2 to 3 numbers"),
        (off(("4 0 1 2",)), "line 7: a face of 4 corners names 3"),
        (off(("3 0 1 9",)), "line 7: index 9 is out of range, there are 4 vertices"),
        (off(("3 0 1 b",)), "line 7: expected a face, got '3 0 1 b'"),
        (off(()), "holds no triangles"),
    ],
)
def test_faults_of_off_are_one_line(text, message, tmp_path):
    with pytest.raises(gi.SceneError, match=message) as error:
        load(tmp_path, "a.off", text)
    assert "\n" not in str(error.value) and "Error" not in str(error.value)


# ---- STL ----


def stl(triangles=TRIANGLES, head=b"", color=0):
    """Return a binary STL file."""
    facets = [struct.pack("<12fH", 0, 0, 1, *np.ravel(one), color) for one in triangles]
    return head.ljust(80, b"\0") + struct.pack("<I", len(triangles)) + b"".join(facets)


def facets(triangles=TRIANGLES, name=" s"):
    """Return an STL file in text."""
    rows = ["".join(f"   vertex {x:e} {y:e} {z:e}\n" for x, y, z in one) for one in triangles]
    body = "".join(f" facet normal 0 0 1\n  outer loop\n{row}  endloop\n endfacet\n" for row in rows)
    return f"solid{name}\n{body}endsolid{name}\n"


@pytest.mark.parametrize(
    "data",
    [
        stl(),
        stl(head=b"solid by a program that writes so"),
        stl(head=b"solid facet normal"),
        stl() + b"\0" * 7,
        facets(),
        facets(name=""),
        facets().upper(),
        facets().replace("\n", "\r\n"),
        "\n" + facets(),
        facets(TRIANGLES[:1]) + facets(TRIANGLES[1:], " of another solid"),
    ],
)
def test_ways_to_write_stl(data, tmp_path):
    scene, told = load(tmp_path, "a.stl", data)
    np.testing.assert_array_equal(corners_of(scene), TRIANGLES)
    assert not told


@pytest.mark.parametrize("kind", [{"head": b"COLOR=\xff\0\0\xff"}, {"color": 0x8000 | 0x7C00}])
def test_colours_of_stl_are_told(kind, tmp_path):
    _, (told,) = load(tmp_path, "a.stl", stl(**kind))
    assert "uses colours of faces, which is ignored" in told


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ("", "is no STL file: it has neither facets in text nor 84 bytes before them"),
        (stl()[:-30], "is truncated: its 2 triangles take 184 bytes, it has 154"),
        (stl([]), "holds no triangles"),
        (facets().replace("1.000000e", "one"), "line 4: vertex must have 3 numbers, got '-one"),
        (facets()[: facets().rindex("   vertex")], "is truncated: it has 5 vertices, not 3 a facet"),
        (facets().replace(" 0.000000e+00\n", "\n"), "line 4: vertex must have 3 numbers"),
    ],
)
def test_faults_of_stl_are_one_line(data, message, tmp_path):
    with pytest.raises(gi.SceneError, match=message) as error:
        load(tmp_path, "a.stl", data)
    assert "\n" not in str(error.value) and "Error" not in str(error.value)
