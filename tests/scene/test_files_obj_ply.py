"""OBJ and PLY as other programs write them: each kind of file that went wrong with other readers."""

from __future__ import annotations

import itertools
import struct
import warnings
from pathlib import Path

import numpy as np
import pytest
from scene_tools import png

import warp_gi as gi
from warp_gi.scene.files.polygons import triangulate

CASES = Path(__file__).parents[1] / "cases"
SQUARE = "v -1 -1 0\nv 1 -1 0\nv 1 1 0\nv -1 1 0\n"


def corners_of(scene):
    """Return the corners of all triangles, [triangle, 3, 3]."""
    return scene._flat.points[scene._flat.indices]


def written(folder, obj, mtl=None, **images):
    """Write an OBJ with its library and images; return its path."""
    (folder / "a.obj").write_text(obj)
    if mtl is not None:
        (folder / "a.mtl").write_text(mtl)
    for name, color in images.items():
        (folder / f"{name}.png").write_bytes(png(np.full((2, 2, 3), color, np.uint8)))
    return folder / "a.obj"


def material(folder, mtl, **images):
    """Return the material "m" of a library, on a square."""
    text = f"mtllib a.mtl\n{SQUARE}vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nusemtl m\nf 1/1 2/2 3/3 4/4\n"
    return gi.load_scene(written(folder, text, "newmtl m\n" + mtl, **images)).materials[0]


# ---- geometry ----


def test_relative_indices_count_back_from_their_line():
    folder = CASES / "obj-negative-indices-interleaved"
    scene, same = (gi.load_scene(folder / name) for name in ("two.obj", "same_positive.obj"))
    np.testing.assert_array_equal(corners_of(scene), corners_of(same))
    assert [(m.name, m.base_color) for m in scene.materials] == [("red", (0.5, 0.1, 0.1)), ("blue", (0.0, 0.0, 1.0))]
    assert corners_of(scene)[:2, :, 0].max() == 0.0 and corners_of(scene)[2:, :, 0].min() == 0.0


def test_relative_texture_coordinates_and_normals(tmp_path):
    text = "v 9 9 9\n" + SQUARE + "vt 9 9\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nvn 1 0 0\nvn 0 0 1\n"
    text += "f -4/-4/-1 -3/-3/-1 -2/-2/-1 -1/-1/-1\n"
    flat = gi.load_scene(written(tmp_path, text))._flat
    np.testing.assert_array_equal(flat.uvs * 2 - 1, flat.points[:, :2])
    np.testing.assert_array_equal(flat.normals, [[0, 0, 1]] * 4)


@pytest.mark.parametrize("name", sorted(path.name for path in (CASES / "obj-blanks-and-libraries").glob("*.obj")))
def test_blanks_comments_and_several_libraries(name):
    scene = gi.load_scene(CASES / "obj-blanks-and-libraries" / name)
    assert scene.triangle_count == 2 and scene.materials[0].base_color == (0.5, 0.1, 0.1)
    np.testing.assert_array_equal(scene.bounds, [[-1, -1, 0], [1, 1, 0]])


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_line_ends_comments_and_continued_lines(end, tmp_path):
    text = f"# head\n{SQUARE}v 5 5 5 # far\n\n  # deep\nf 1 2 \\\n 3 4 # face\n"
    (tmp_path / "a.obj").write_bytes(text.replace("\n", end).encode())
    assert gi.load_scene(tmp_path / "a.obj").triangle_count == 2


def test_names_with_blanks_and_hashes(tmp_path):
    obj = SQUARE.join(("mtllib a.mtl\n", "usemtl old #7  wood # the floor\nf 1 2 3 4\n")).replace(
        "#7  wood", "no#7 wood"
    )
    scene = gi.load_scene(written(tmp_path, obj, "newmtl old no#7 wood # mine\nKd 0.1 0.2 0.3 # brown\n"))
    assert scene.materials[0].name == "old no#7 wood" and scene.materials[0].base_color == (0.1, 0.2, 0.3)


def inside(polygon, point):
    """Whether a point lies inside a polygon, by the crossings of a ray."""
    count = 0
    for (x0, y0), (x1, y1) in itertools.pairwise([*polygon, polygon[0]]):
        if (y0 > point[1]) != (y1 > point[1]):
            count += point[0] < x0 + (point[1] - y0) / (y1 - y0) * (x1 - x0)
    return count % 2 == 1


ARROW = [(0, 0), (4, 3), (0, 6), (1.5, 3)]
COMB = [(0, 0), (7, 0), (7, 4), (5, 4), (5, 1), (4, 1), (4, 4), (3, 4), (3, 1), (2, 1), (2, 4), (0, 4)]
STAR = [(np.cos(a), np.sin(a)) for a in np.arange(5) * 0.8 * np.pi]


@pytest.mark.parametrize("shape", [ARROW, ARROW[::-1], COMB, COMB[2:] + COMB[:2]])
@pytest.mark.parametrize("plane", ["xy", "yz", "slanted"])
def test_concave_faces_are_covered_once_and_keep_their_side(shape, plane):
    flat = np.array(shape, float)
    axes = {"xy": np.eye(3)[:2], "yz": np.eye(3)[1:], "slanted": np.array([[0.6, 0.8, 0], [0, 0, 1.0]])}[plane]
    points = flat @ axes + [10.0, -3.0, 2.0]
    triangles, faces = triangulate(points, np.arange(len(points)), np.array([len(points)]))
    assert len(triangles) == len(points) - 2 and not faces.any()
    a, b, c = (flat[triangles[:, i]] for i in range(3))
    areas = ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]) / 2
    x, y = flat.T
    whole = (x * np.roll(y, -1) - y * np.roll(x, -1)).sum() / 2
    assert areas.sum() == pytest.approx(whole) and (areas * np.sign(whole) >= 0).all()
    for middle in ((a + b + c) / 3)[np.abs(areas) > 1e-9]:
        assert inside(shape, middle)


def test_faces_stay_in_order_among_others():
    points = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0.6, 0.4, 0)], float)
    corners = np.array([0, 1, 2, 0, 1, 2, 4, 0, 2, 3, 0, 1, 2, 3])
    triangles, faces = triangulate(points, corners, np.array([3, 4, 3, 4]))
    np.testing.assert_array_equal(faces, [0, 1, 1, 2, 3, 3])
    np.testing.assert_array_equal(corners[triangles[[0, 3]]], [[0, 1, 2], [0, 2, 3]])
    assert {4} <= set(corners[triangles[1]]) and {4} <= set(corners[triangles[2]])  # the dent, in both halves


def test_a_star_is_no_fan():
    triangles, _ = triangulate(np.column_stack([STAR, np.zeros(5)]), np.arange(5), np.array([5]))
    fan = [[0, 1, 2], [0, 2, 3], [0, 3, 4]]
    assert sorted(map(sorted, triangles.tolist())) != fan


def test_lines_points_curves_and_smoothing_are_named(tmp_path):
    text = f"{SQUARE}l 1 2\np 1\ncurv 0 1 1 2\ns 1\nf 1 2 3 4\nf 1 2\n"
    with pytest.warns(gi.UnsupportedWarning) as caught:
        assert gi.load_scene(written(tmp_path, text)).triangle_count == 2
    told = " ".join(str(one.message) for one in caught)
    for what in ("points and lines (line 5, line 6)", "curves and surfaces (line 7)", "smoothing groups", "(line 10)"):
        assert what in told


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("f 1 2 9", "line 5: a face names vertex 9, which is out of range: the file has 4"),
        ("f -5 -4 -3", "line 5: a face names vertex -5, which is out of range"),
        ("f 0 1 2", "line 5: a face names vertex 0, which is out of range"),
        ("f 1/1 2/1 3/1", "line 5: a face names texture coordinate 1, which is out of range: the file has 0"),
        ("f 1 2 three", "f '1 2 three' must hold numbers, got 'three'"),
        ("f 1/1/1/1 2 3", "the corners of a face must be like 1, 1/2, 1//3 or 1/2/3"),
        ("v 1 2", "line 5: v needs 3 numbers, got 2"),
        ("v 1 2 up", "v '1 2 up' must hold numbers, got 'up'"),
    ],
)
def test_wrong_lines_are_named(line, message, tmp_path):
    with pytest.raises(gi.SceneError, match=message):
        gi.load_scene(written(tmp_path, f"{SQUARE}{line}\n"))


# ---- materials ----


def test_meshlab_writes_tr_1_for_opaque(tmp_path):
    assert not material(tmp_path, "Kd 1 1 1\nTr 1.0\n").lets_rays_pass
    assert material(tmp_path, "Kd 1 1 1\nTr 1.0\nd 0.25\n").alpha == 0.25


@pytest.mark.parametrize("statement", ["Tr 0.75", "d 0.25", "d 0.25\nTr 0.75"])
def test_coverage_between_0_and_1_is_blended(statement, tmp_path):
    found = material(tmp_path, f"{statement}\n")
    assert (found.alpha, found.alpha_blend, found.alpha_cutoff) == (0.25, True, None)


@pytest.mark.parametrize("illum", [4, 6, 7, 9])
def test_glass_of_mtl_is_a_pane(illum, tmp_path):
    with pytest.warns(gi.UnsupportedWarning, match="glass of MTL"):
        found = material(tmp_path, f"Kd 0 0 0\nd 0.1\nNi 1.52\nTf 0.5 0.75 1\nillum {illum}\n")
    assert found.transmission == pytest.approx(0.9) and found.base_color == (0.5, 0.75, 1.0) and found.roughness == 0
    assert found.reflectance == pytest.approx([(0.52 / 2.52) ** 2] * 3)
    assert found.alpha == 1.0 and not found.alpha_blend


@pytest.mark.parametrize(("middle", "factor", "blends"), [(0, 1, False), (1, 1, True), (0, 0.5, True)])
def test_maps_of_holes_alone_are_cut_and_others_blended(middle, factor, blends, tmp_path):
    """Whether a fifth of the texels are neither hole nor surface, or the map has a factor."""
    from PIL import Image

    levels = np.uint8([[0, 255, 128 if middle else 255, 255, 0]])
    Image.fromarray(levels).save(tmp_path / "holes.png")
    found = material(tmp_path, f"d {factor}\nmap_d holes.png\n")
    assert found.alpha_blend == blends and found.alpha_cutoff == (None if blends else 0.5)
    np.testing.assert_array_equal(found.base_color_texture.pixels[0, :, 3], levels[0])


@pytest.mark.parametrize(
    ("mtl", "metallic", "color"),
    [
        ("Kd 0.8 0.1 0.1\nKs 0.9 0.9 0.9\n", 0.0, (0.8, 0.1, 0.1)),
        ("Kd 0.03 0.02 0.02\nKs 0.9 0.9 0.9\n", 1.0, (0.9, 0.9, 0.9)),  # as good as black
        ("Kd 0.588 0.588 0.588\nKs 0.9 0.9 0.9\n", 0.0, (0.588, 0.588, 0.588)),
        ("Kd 0.1 0.1 0.1\nKs 0.9 0.8 0.7\n", 1.0, (0.9, 0.8, 0.7)),
        ("Kd 0 0 0\nKs 0.6 0.6 0.6\n", 1.0, (0.6, 0.6, 0.6)),
        ("Kd 0 0 0\nKs 0.9 0.6 0.2\n", 1.0, (0.9, 0.6, 0.2)),  # gold: its blue is dark
        ("Kd 0 0 0\nKs 0.9 0 0\n", 1.0, (0.9, 0.0, 0.0)),
        ("Kd 0 0 0\nKs 0.2 0.1 0.1\n", 0.0, (0.0, 0.0, 0.0)),
        ("Kd 0.4 0.3 0.2\nKs 0.9 0.9 0.9\nPm 0.5\nPr 0.25\n", 0.5, (0.4, 0.3, 0.2)),
    ],
)
def test_what_is_a_metal(mtl, metallic, color, tmp_path):
    found = material(tmp_path, mtl)
    assert (found.metallic, found.base_color) == (metallic, color)
    assert found.roughness == (0.25 if "Pr" in mtl else 1.0)


def test_maps_of_roughness_and_metal(tmp_path):
    found = material(tmp_path, "Kd 1 1 1\nmap_Pr r.png\nmap_Pm m.png\n", r=(64, 64, 64), m=(128, 128, 128))
    assert (found.roughness, found.metallic, found.specular) == (1.0, 1.0, 1.0)
    np.testing.assert_array_equal(found.metallic_roughness_texture.pixels[0, 0], [255, 64, 128, 255])


def test_scale_and_offset_of_maps(tmp_path):
    text = f"mtllib a.mtl\n{SQUARE}vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nusemtl m\nf 1/1 2/2 3/3 4/4\n"
    mtl = "newmtl m\nKd 1 1 1\nmap_Kd -s 2 3 1 -o 0.25 0.5 0 -blendu on c.png\n"
    scene = gi.load_scene(written(tmp_path, text, mtl, c=(255, 0, 0)))
    expected = np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * [2, 3] + [0.25, 0.5]
    np.testing.assert_allclose(scene._flat.uvs, expected)


@pytest.mark.parametrize(
    "name",
    [
        "C:\\maps\\wood.png",
        "\\\\server\\share\\wood.png",
        "/home/me/wood.png",
        '"wood.png"',
        '"D:/a b/wood.png"',
        "x/wood.png",
    ],
)
def test_textures_of_another_machine_lie_beside_the_library(name, tmp_path):
    (tmp_path / "lib").mkdir()
    (tmp_path / "lib" / "wood.png").write_bytes(png(np.full((1, 1, 3), (9, 8, 7), np.uint8)))
    (tmp_path / "lib" / "a.mtl").write_text(f"newmtl m\nKd 1 1 1\nmap_Kd {name}\n")
    (tmp_path / "a.obj").write_text(f"mtllib lib/a.mtl\n{SQUARE}vt 0 0\nusemtl m\nf 1/1 2/1 3/1 4/1\n")
    np.testing.assert_array_equal(
        gi.load_scene(tmp_path / "a.obj").materials[0].base_color_texture.pixels[0, 0], [9, 8, 7, 255]
    )


@pytest.mark.parametrize("color", ["0.2 0.3 0.4", "0 0 0"])
def test_a_texture_that_is_on_another_machine_alone_is_a_warning(color, tmp_path):
    with pytest.warns(
        UserWarning, match=r"texture 'C:\\\\maps\\\\wood.png' of material 'm' is not here: .* plain colour"
    ):
        found = material(tmp_path, f"Kd {color}\nmap_Kd C:\\maps\\wood.png\n")
    assert found.base_color_texture is None
    assert found.base_color == ((0.2, 0.3, 0.4) if color != "0 0 0" else (0.8, 0.8, 0.8))


def test_what_mtl_holds_beside_is_named(tmp_path):
    with pytest.warns(gi.UnsupportedWarning) as caught:
        material(tmp_path, "map_Bump b.png\nmap_Ks b.png\nPs 0.5\nillum 7\n")
    told = " ".join(str(one.message) for one in caught)
    for what in ("bump and displacement maps", "maps of the specular colour", "sheen, clear coats", "glass of MTL"):
        assert f"uses {what}" in told and "(material 'm')" in told


@pytest.mark.parametrize("illum", [4, 6, 7, 9])
def test_coverage_without_a_tint_is_no_pane(illum, tmp_path):
    """Exporters write such values for all that is not opaque."""
    with pytest.warns(gi.UnsupportedWarning, match="with Tf, a pane .* else d is coverage"):
        found = material(tmp_path, f"Kd 1 0 0\nd 0.25\nillum {illum}\n")
    assert (found.alpha, found.alpha_blend, found.transmission) == (0.25, True, 0.0)


@pytest.mark.parametrize("option", ["-mm 0.2 0.5", "-t 1 1 0", "-cc on", "-imfchan l"])
def test_options_of_maps_that_change_their_values_are_named(option, tmp_path):
    with pytest.warns(gi.UnsupportedWarning, match=f"other options of maps .*{option} of map_kd of material 'm'"):
        found = material(tmp_path, f"Kd 1 1 1\nmap_Kd {option} c.png\n", c=(255, 0, 0))
    assert found.base_color_texture.name == "c.png"


@pytest.mark.parametrize("option", ["-mm 0 1", "-mm 0", "-t 0 0 0", "-cc off", "-boost 2", "-texres 64", "-blendv off"])
def test_options_of_maps_that_change_nothing_are_not(option, tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        material(tmp_path, f"Kd 1 1 1\nmap_Kd {option} c.png\n", c=(255, 0, 0))


@pytest.mark.parametrize(
    ("obj", "told"),
    [
        (f"{SQUARE}usemtl a\nf 1 2 3\nusemtl b\nf 1 3 4\n", r"names materials 'a', 'b' and no library \(mtllib\)"),
        (f"mtllib a.mtl\n{SQUARE}usemtl b\nf 1 2 3\n", "material 'b' is not in its library; plain grey"),
        (
            f"mtllib a.mtl\n{SQUARE}usemtl b\nf 1 2 3\n" + "".join(f"usemtl {k}\nf 1 3 4\n" for k in range(4)),
            "materials 'b', '0', '1' and 2 more are not in its library",
        ),
        (
            f"{SQUARE}f 1 2 3\ncall more.obj\nusemap wood\n",
            r"other statements of OBJ.*\('call', line 6, 'usemap', line 7\)",
        ),
    ],
)
def test_what_obj_names_and_does_not_hold_is_told(obj, told, tmp_path):
    with pytest.warns(UserWarning, match=told):
        gi.load_scene(written(tmp_path, obj, "# nothing\n"))


def test_textures_of_faces_without_coordinates_are_named(tmp_path):
    mtl = "newmtl m\nKd 1 1 1\nmap_Kd c.png\nnewmtl plain\nKd 1 0 0\n"
    text = f"mtllib a.mtl\n{SQUARE}vt 0 0\nusemtl m\nf 1/1 2/1 3/1\n"
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        gi.load_scene(written(tmp_path, f"{text}usemtl plain\nf 1 3 4\n", mtl, c=(255, 0, 0)))
    with pytest.warns(gi.UnsupportedWarning, match="textures without their coordinates \\(material 'm'\\)"):
        gi.load_scene(written(tmp_path, f"{text}f 1 3 4\n", mtl, c=(255, 0, 0)))


# ---- PLY ----


@pytest.mark.parametrize("order", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("faces", [False, True])
def test_strips_are_triangles(order, faces, tmp_path):
    """A strip of three, one of two of which one names a vertex twice, one of two corners; and a face, or none."""
    strips = [[0, 1, 2, 3, 4, -1, 5, 6, 7, 7, -1, 0, 1], [8, 7, 6]]
    expected = [[0, 1, 2], [2, 1, 3], [2, 3, 4], [5, 6, 7], [8, 7, 6]]
    points = np.array([[k // 2, k % 2, 0.1 * k] for k in range(9)], np.float32)
    header = f"ply\nformat {order} 1.0\nelement vertex 9\n" + "".join(f"property float {axis}\n" for axis in "xyz")
    header += "element face 1\nproperty list uchar int vertex_indices\n" if faces else ""
    header += "element tristrips 2\nproperty list int int vertex_indices\nend_header\n"
    if order == "ascii":
        lines = [" ".join(map(str, row)) for row in [*points.tolist(), *([[3, 4, 5, 8]] if faces else [])]]
        body = "\n".join([*lines, *(f"{len(one)} {' '.join(map(str, one))}" for one in strips)]).encode()
    else:
        end = "<" if "little" in order else ">"
        body = points.astype(end + "f4").tobytes()
        body += np.uint8([3]).tobytes() + np.array([4, 5, 8], end + "i4").tobytes() if faces else b""
        body += b"".join(np.array([len(one), *one], end + "i4").tobytes() for one in strips)
    (tmp_path / "a.ply").write_bytes(header.encode() + body)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        scene = gi.load_scene(tmp_path / "a.ply")
    np.testing.assert_array_equal(scene._flat.indices, [[4, 5, 8], *expected] if faces else expected)


@pytest.mark.parametrize("name", ["ascii", "little", "big"])
def test_ply_lists_of_differing_length(name):
    scene = gi.load_scene(CASES / "ply-binary-mixed-faces" / f"{name}.ply")
    ascii_scene = gi.load_scene(CASES / "ply-binary-mixed-faces" / "ascii.ply")
    assert scene.triangle_count == 3
    np.testing.assert_array_equal(corners_of(scene), corners_of(ascii_scene))
    assert scene.surface_area == pytest.approx(4.5)


PLY_HEAD = "ply\nformat {} 1.0\nelement vertex 4\n{}element face 2\nproperty {}\nend_header\n"


def test_ply_of_every_numeric_type_with_other_properties_between(tmp_path):
    """Points and faces of each type, both byte orders, with a scalar and a second list in the rows of faces."""
    from warp_gi.scene.files.ply import TYPES, read_ply

    points = np.array([(0, 0, 0), (2, 0, 0), (2, 3, 0), (0, 3, 1)])
    codes = {"i1": "b", "u1": "B", "i2": "h", "u2": "H", "i4": "i", "u4": "I", "f4": "f", "f8": "d"}
    for (kind, code), order in itertools.product(TYPES.items(), ("binary_little_endian", "binary_big_endian")):
        mark = "<" if "little" in order else ">"
        body = b"".join(struct.pack(f"{mark}B3{codes[code]}", 7, *row) for row in points.tolist())
        index = "uint" if code[0] == "f" else kind
        form = codes[TYPES[index]]
        for face, extra in (((0, 1, 2, 3), (5,)), ((3, 1, 0), (5, 6, 7))):
            body += struct.pack(f"{mark}H{len(extra)}dfB{len(face)}{form}", len(extra), *extra, 0.5, len(face), *face)
        head = "property uchar tag\n" + "".join(f"property {kind} {axis}\n" for axis in "xyz")
        faces = f"list ushort double more\nproperty float weight\nproperty list uchar {index} vertex_index"
        (tmp_path / "a.ply").write_bytes(PLY_HEAD.format(order, head, faces).encode() + body)
        mesh = read_ply(tmp_path / "a.ply").nodes[0].meshes[0]
        np.testing.assert_array_equal(mesh.points, points)
        np.testing.assert_array_equal(mesh.indices, [[0, 1, 2], [0, 2, 3], [3, 1, 0]])


def test_ply_that_is_cut_short_or_lacks_faces(tmp_path):
    data = (CASES / "ply-binary-mixed-faces" / "little.ply").read_bytes()
    (tmp_path / "a.ply").write_bytes(data[:-3])
    with pytest.raises(gi.SceneError, match="is truncated: its 2 rows of 'face' are not all there"):
        gi.load_scene(tmp_path / "a.ply")
    (tmp_path / "a.ply").write_bytes(data.replace(b"property float x\n", b"property float q\n"))
    with pytest.raises(gi.SceneError, match="has no vertices with x, y and z"):
        gi.load_scene(tmp_path / "a.ply")
    (tmp_path / "a.ply").write_bytes(data.replace(b"float x", b"loat x"))
    with pytest.raises(gi.SceneError, match="its header has 'property loat x'"):
        gi.load_scene(tmp_path / "a.ply")
