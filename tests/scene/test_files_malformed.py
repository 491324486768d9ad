"""OBJ, MTL and PLY with what other readers drop in silence, mistake, or break at."""

from __future__ import annotations

import re
import struct
import tracemalloc
import warnings

import numpy as np
import pytest
from scene_tools import png

import warp_gi as gi

SQUARE = "v -1 -1 0\nv 1 -1 0\nv 1 1 0\nv -1 1 0\n"
FACE = "f 1 2 3 4\n"
MARK = b"\xef\xbb\xbf"


def load(folder, obj, mtl=None):
    """Load an OBJ of these bytes or this text with library a.mtl; return the scene and the texts of its warnings."""
    for name, data in (("a.obj", obj), ("a.mtl", mtl)):
        if data is not None:
            (folder / name).write_bytes(data if isinstance(data, bytes) else data.encode())
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        scene = gi.load_scene(folder / "a.obj")
    return scene, [str(one.message) for one in caught]


def named(folder, name, mtl):
    """Return the scene of a square of a material, and its warnings."""
    return load(folder, f"mtllib a.mtl\n{SQUARE}usemtl {name}\n{FACE}", mtl)


def material(folder, mtl):
    """Return material "m" of a library, and the warnings."""
    scene, told = named(folder, "m", f"newmtl m\n{mtl}")
    return scene.materials[0], told


# ---- text ----


def test_marks_of_utf_8_are_no_part_of_the_first_word(tmp_path):
    obj = f"{SQUARE}mtllib a.mtl\nusemtl m\n{FACE}".encode()
    scene, told = load(tmp_path, MARK + obj, MARK + b"newmtl m\nKd 0.1 0.2 0.3\n")
    assert scene.triangle_count == 2 and scene.materials[0].base_color == (0.1, 0.2, 0.3) and not told
    (tmp_path / "a.ply").write_bytes(MARK + ply())
    assert gi.load_scene(tmp_path / "a.ply").triangle_count == 1


@pytest.mark.parametrize("name", ["a.obj", "a.ply", "a.mtl"])
@pytest.mark.parametrize("encoding", ["utf-16-le", "utf-16-be"])
def test_utf_16_is_refused(encoding, name, tmp_path):
    (tmp_path / "a.obj").write_text(f"mtllib a.mtl\n{SQUARE}{FACE}")
    (tmp_path / name).write_bytes(("\ufeff" + SQUARE).encode(encoding))
    with pytest.raises(gi.SceneError, match=rf"{name}' is text in UTF-16, .*; save it as UTF-8"):
        gi.load_scene(tmp_path / name.replace("mtl", "obj"))


def test_a_backslash_in_a_comment_or_a_name_joins_no_lines(tmp_path):
    obj = f"# made in C:\\scenes\\\nmtllib a.mtl\n{SQUARE}o C:\\\nv 5 5 5 # \\\ng x\\\nusemtl a\\\nf 1 2 3 \\\n 4\n"
    scene, told = load(tmp_path, obj, "# here \\\nnewmtl a\\\nKd 0.1 0.2 \\\n 0.3\n")
    assert scene.triangle_count == 2 and not told
    assert (scene.materials[0].name, scene.materials[0].base_color) == ("a\\", (0.1, 0.2, 0.3))


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("f 1 2 9", "line 8: a face names vertex 9"),
        ("f 1 2 3.0", "line 8: f '1 2 3.0' must hold whole numbers, got '3.0'"),
        ("f 1 2 c", "line 8: f '1 2 c' must hold numbers, got 'c'"),
        ("f 1 2/ 3/1/1/1", "line 8: the corners of a face must be like .*, got '3/1/1/1'"),
        ("f 1 2// ///3", "line 8: the corners of a face must be like .*, got '///3'"),
        ("v 1 2", "line 8: v needs 3 numbers, got 2"),
        ("v 1 2 up", "line 8: v '1 2 up' must hold numbers, got 'up'"),
    ],
)
def test_numbers_of_lines_behind_joined_ones_are_those_of_the_file(line, message, tmp_path):
    with pytest.raises(gi.SceneError, match=message):
        load(tmp_path, f"{SQUARE}f 1 \\\n2 \\\n3\n{line}\n{FACE}")
    _, told = load(tmp_path, f"{SQUARE}f 1 \\\n2 \\\n3\nl 1 2\n")
    assert "(line 8)" in told[0]


# ---- names ----


@pytest.mark.parametrize("name", ["A #1", "Material #25", "A # b"])
def test_names_may_hold_a_hash(name, tmp_path):
    scene, told = named(tmp_path, name, f"newmtl A\nKd 1 1 1\nnewmtl {name}\nKd 0.1 0.2 0.3\nnewmtl A #2\n")
    assert (scene.materials[0].name, scene.materials[0].base_color) == (name, (0.1, 0.2, 0.3)) and not told


@pytest.mark.parametrize(
    ("used", "made"), [("A # x", "A"), ("A #x", "A"), ("A", "A # y"), ("A # x", "A # y"), ("A #x", "A # y")]
)
def test_comments_behind_names_are_cut_where_no_whole_name_fits(used, made, tmp_path):
    scene, told = named(tmp_path, used, f"newmtl {made}\nKd 0.1 0.2 0.3\n")
    assert (scene.materials[0].name, scene.materials[0].base_color) == ("A", (0.1, 0.2, 0.3)) and not told


def test_a_numbered_name_is_not_taken_for_another(tmp_path):
    scene, told = named(tmp_path, "Material #27", "newmtl Material #25\nKd 0.1 0.2 0.3\n")
    assert scene.materials[0].base_color == (0.8, 0.8, 0.8)
    assert "material 'Material #27' is not in its library; plain grey" in told[0]


def test_a_material_without_a_name(tmp_path):
    mtl = "newmtl A\nKd 0.1 0.2 0.3\nnewmtl\nKd 0.4 0.5 0.6\n"
    scene, told = load(tmp_path, f"mtllib a.mtl\n{SQUARE}f 1 2 3\nusemtl A\nf 1 2 3\nusemtl\nf 1 3 4\n", mtl)
    assert [one.base_color for one in scene.materials] == [(0.8, 0.8, 0.8), (0.1, 0.2, 0.3), (0.4, 0.5, 0.6)]
    assert not told


@pytest.mark.parametrize(("text", "file"), [("w #1.png", "w #1.png"), ("w.png # old", "w.png"), ('"w.png" #', "w.png")])
def test_names_of_textures_may_hold_a_hash(text, file, tmp_path):
    (tmp_path / file).write_bytes(png(np.full((1, 1, 3), (9, 8, 7), np.uint8)))
    scene, told = load(
        tmp_path, f"mtllib a.mtl\n{SQUARE}vt 0 0\nusemtl m\nf 1/1 2/1 3/1\n", f"newmtl m\nKd 1 1 1\nmap_Kd {text}\n"
    )
    found = scene.materials[0]
    assert found.base_color_texture.pixels[0, 0].tolist() == [9, 8, 7, 255] and not told


def test_libraries_may_hold_a_hash(tmp_path):
    (tmp_path / "l #1.mtl").write_text("newmtl m\nKd 0.1 0.2 0.3\n")
    scene, _ = load(tmp_path, f"mtllib l #1.mtl\n{SQUARE}usemtl m\n{FACE}")
    assert scene.materials[0].base_color == (0.1, 0.2, 0.3)


def test_textures_of_one_name_in_two_folders(tmp_path):
    for folder, grey in (("x", 10), ("y", 20)):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "w.png").write_bytes(png(np.full((1, 1, 3), grey, np.uint8)))
        (tmp_path / folder / "a.mtl").write_text(f"newmtl {folder}\nKd 1 1 1\nmap_Kd w.png\n")
    scene, _ = load(tmp_path, f"mtllib x/a.mtl y/a.mtl\n{SQUARE}usemtl x\n{FACE}usemtl y\n{FACE}")
    assert [one.base_color_texture.pixels[0, 0, 0] for one in scene.materials] == [10, 20]


def test_a_path_that_is_here_comes_before_its_bare_name(tmp_path):
    (tmp_path / "far").mkdir()
    for folder, grey in ((tmp_path, 10), (tmp_path / "far", 20)):
        (folder / "w.png").write_bytes(png(np.full((1, 1, 3), grey, np.uint8)))
    found, _ = material(tmp_path, f"Kd 1 1 1\nmap_Kd {tmp_path}/far/w.png\n")
    assert found.base_color_texture.pixels[0, 0, 0] == 20
    (tmp_path / "far" / "a.mtl").write_text("newmtl m\nKd 0.1 0.2 0.3\n")
    scene, _ = load(tmp_path, f"mtllib {tmp_path}/far/a.mtl\n{SQUARE}usemtl m\n{FACE}", "newmtl m\nKd 1 1 1\n")
    assert scene.materials[0].base_color == (0.1, 0.2, 0.3)


def test_names_that_no_file_can_have(tmp_path):
    _, told = load(tmp_path, f"mtllib {'x' * 300}.mtl\n{SQUARE}{FACE}")
    assert "x.mtl' is missing; its materials become plain grey" in told[0]
    with pytest.raises(gi.SceneError, match=r"texture 'y+.png' of material 'm' .* is missing"):
        material(tmp_path, f"Kd 1 1 1\nmap_Kd {'y' * 300}.png\n")


# ---- statements ----


@pytest.mark.parametrize("line", ["Kd 1,0 0,5 0", "Kd 1 0", "Kd", "d 0,5", "Ns nan", "Ke 1 2 #3"])
def test_numbers_that_cannot_be_read_are_named(line, tmp_path):
    found, told = material(tmp_path, f"{line}\n")
    assert found.base_color == (0.8, 0.8, 0.8) and found.alpha == 1.0 and found.emission == (0.0, 0.0, 0.0)
    (text,) = told
    assert "uses statements of MTL without the numbers they need" in text and "line 2 of 'a.mtl'" in text


def test_one_number_is_grey(tmp_path):
    found, told = material(tmp_path, "Kd 0.25 # grey\n")
    assert found.base_color == (0.25, 0.25, 0.25) and not told


@pytest.mark.parametrize(
    ("line", "feature"),
    [
        ("Tf 0.5 0.5 1", "Tf of MTL"),
        ("decal a.png", "decal of MTL"),
        ("map_tr a.png", "map_tr of MTL"),
        ("map_ORM a.png", "map_ORM of MTL"),
        ("map_refl a.png", "reflection maps"),
        ("map_Pc a.png", "sheen, clear coats and anisotropy of MTL"),
        ("Kd spectral a.rfl 1", "spectral and XYZ colours"),
    ],
)
def test_statements_that_are_not_read_are_named(line, feature, tmp_path):
    _, told = material(tmp_path, f"Kd 1 1 1\nKa 1 1 1\nNi 1.45\nillum 2\n{line}\n")
    (text,) = told
    assert f"uses {feature} (" in text and "which is ignored" in text
    assert material(tmp_path, "Tf 1 1 1\nNi 1.45\n")[1] == []


@pytest.mark.parametrize(
    ("alpha", "mtl", "is_told"),
    [
        (0, "map_Kd c.png", True),
        (255, "map_Kd c.png", False),
        (0, "map_Kd c.png\nmap_d c.png", False),
        (0, "map_Kd c.png\nd 0.5", False),  # which the alpha of the map counts for, too
    ],
)
def test_holes_in_a_colour_map_that_no_coverage_names_are_told(alpha, mtl, is_told, tmp_path):
    pixels = np.full((4, 4, 4), 255, np.uint8)
    pixels[0, :, 3] = alpha
    (tmp_path / "c.png").write_bytes(png(pixels))
    text = f"mtllib a.mtl\n{SQUARE}vt 0 0\nusemtl m\nf 1/1 2/1 3/1 4/1\n"
    _, told = load(tmp_path, text, f"newmtl m\nKd 1 1 1\n{mtl}\n")
    assert ["alpha of map_Kd without map_d (material 'm'), which is ignored: opaque" in one for one in told] == (
        [True] * is_told
    )


@pytest.mark.parametrize(("line", "words"), [("map_Kd", "map_Kd, line 3"), ("\tnorm ", "norm, line 3")])
def test_maps_without_a_file_are_told(line, words, tmp_path):
    _, (told,) = material(tmp_path, f"Kd 1 1 1\n{line}\n")
    assert f"maps of MTL without a file ({words} of 'a.mtl'), which is ignored" in told


def test_a_factor_on_a_normal_map_is_told(tmp_path):
    (tmp_path / "c.png").write_bytes(png(np.full((2, 2, 3), 128, np.uint8)))
    text = f"mtllib a.mtl\n{SQUARE}vt 0 0\nusemtl m\nf 1/1 2/1 3/1 4/1\n"
    for factor, is_told in (("0.5", True), ("1", False)):
        _, told = load(tmp_path, text, f"newmtl m\nKd 1 1 1\nnorm -bm {factor} c.png\n")
        assert ["-bm 0.5 of norm of material 'm'" in one for one in told] == [True] * is_told


def test_numbers_of_a_vertex_past_its_colour_are_told(tmp_path):
    scene, (told,) = load(tmp_path, "v 0 0 0 1 0 0\nv 1 0 0 0 1 0 0.5\nv 0 1 0 0 0 1\nf 1 2 3\n")
    assert "more than six numbers of a vertex (line 2), which is ignored" in told
    np.testing.assert_array_equal(scene.nodes[0].meshes[0].colors, np.eye(3))


@pytest.mark.parametrize("options", [{"scale": 0.5}, {"up": "z"}, {"scale": 0.5, "up": "z", "recentre": True}])
def test_keyframes_move_a_scaled_and_turned_file_in_metres(options, tmp_path):
    """Files without a hierarchy have scale and axis in their points, so that keyframes do not undo them."""
    (tmp_path / "a.obj").write_text("v 10 0 0\nv 12 0 0\nv 10 2 6\nvn 0 0 1\nf 1//1 2//1 3//1\n")
    scene = gi.load_scene(tmp_path / "a.obj", **options)
    rest, scale = scene.bounds + scene.offset, options.get("scale", 1.0)
    corner = scale * np.array([[10, 0, 0], [12, 2, 6]])
    if "up" in options:
        corner = np.array([[10, 0, -2], [12, 6, 0]]) * scale
        np.testing.assert_array_equal(scene._flat.normals, [[0, 1, 0]] * 3)
    np.testing.assert_allclose(rest, corner, atol=1e-6)
    scene.animate(scene.nodes[0].name, [gi.Keyframe(0.0, (7.0, 0.0, 0.0))])
    np.testing.assert_allclose(scene.bounds + scene.offset, rest + np.array([7, 0, 0]), atol=1e-5)


@pytest.mark.parametrize(
    ("color", "expected"),
    [("255 0 51", (1.0, 0.0, 0.2)), ("127.5 0 0", (0.5, 0.0, 0.0)), ("1.5 0 0.2", (1.0, 0.0, 0.2))],
)
def test_colours_of_vertices_above_1(color, expected, tmp_path):
    from warp_gi.color import decode_srgb

    scene, told = load(tmp_path, f"v 0 0 0 {color}\nv 1 0 0 {color}\nv 0 1 0\nf 1 2 3\n")
    np.testing.assert_allclose(
        scene.nodes[0].meshes[0].colors, [*[decode_srgb(np.array(expected))] * 2, [1, 1, 1]], atol=1e-6
    )
    assert "uses colours of vertices above 1, which is approximated" in told[0]


# ---- PLY ----


def ply(head="", vertices=3, faces=1, body="0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n", kind="ascii", more="", index="int"):
    """Return a PLY file of a triangle with the text of its header and its body changed."""
    axes = "".join(f"property float {axis}\n" for axis in "xyz")
    text = f"ply\nformat {kind} 1.0\n{head}element vertex {vertices}\n{axes}{more}element face {faces}\n"
    text += f"property list uchar {index} vertex_indices\nend_header\n"
    return text.encode() + (body if isinstance(body, bytes) else body.encode())


def wrong(folder, data):
    """Return the message of the error that a PLY file gives."""
    (folder / "a.ply").write_bytes(data)
    with pytest.raises(gi.SceneError) as error:
        gi.load_scene(folder / "a.ply")
    return str(error.value)


TRIANGLE = struct.pack("<9f", 0, 0, 0, 1, 0, 0, 0, 1, 0) + struct.pack("<B3i", 3, 0, 1, 2)


@pytest.mark.parametrize("count", [10**6, 10**12, 10**30])
@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian"])
def test_counts_beyond_the_file_take_no_memory(kind, count, tmp_path):
    data = ply(faces=count, kind=kind) if kind == "ascii" else ply(faces=count, kind=kind, body=TRIANGLE)
    tracemalloc.start()
    try:
        message = wrong(tmp_path, data)
        most = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert f"is truncated: its {count} rows of 'face' are not all there" in message and most < 4e6


def test_wrong_counts_are_refused(tmp_path):
    assert "its header has 'element face -1'" in wrong(tmp_path, ply(faces=-1))
    for size in ("1e18", "1e300", "200"):
        for body in (f"0 0 0 1 0 0 0 1 0 {size} 0 1 2 3 0 1 2\n", f"0 0 0 1 0 0 0 1 0 3 0 1 2 {size} 0 1 2\n"):
            assert "is truncated: its 2 rows of 'face'" in wrong(tmp_path, ply(faces=2, body=body))
    long = ply(kind="binary_little_endian", body=TRIANGLE[:36] + struct.pack("<I3i", 4 * 10**9, 0, 1, 2))
    assert "is truncated: its 1 rows of 'face'" in wrong(tmp_path, long.replace(b"list uchar", b"list uint"))


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_headers_are_split_at_ends_of_lines_alone(end, tmp_path):
    head = "comment Tä\x85 \x0b \x1c the end_header is below\nobj_info end_header of x\n"
    text = ply(head, kind="binary_little_endian", body=b"").decode().replace("\n", end).encode()
    (tmp_path / "a.ply").write_bytes(text + TRIANGLE)
    assert gi.load_scene(tmp_path / "a.ply").triangle_count == 1
    (tmp_path / "a.ply").write_bytes(ply(head.replace("T", "\u2026"), body=TRIANGLE, kind="binary_little_endian"))
    assert gi.load_scene(tmp_path / "a.ply").triangle_count == 1


def test_a_line_feed_behind_a_carriage_return_is_the_first_byte(tmp_path):
    """The first number begins with byte 10."""
    data = ply(kind="binary_little_endian", body=b"").replace(b"\n", b"\r") + b"\n" + TRIANGLE[1:]
    (tmp_path / "a.ply").write_bytes(data)
    assert gi.load_scene(tmp_path / "a.ply").triangle_count == 1


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ("0 0 0\n1 0 0\n0 1 0\n3 0 1 2 7\n", "its rows hold 1 numbers more than its header names"),
        ("0 0 0\n1 0 0\n0 1 0\n3 0 1 1.5\n", "vertices of faces must be whole numbers, got 1.5"),
        ("0 0 0\n1 0 0\n0 1 0\n3 0 1 nan\n", "vertices of faces must be whole numbers, got nan"),
        ("0 0 0\n1 0 0\n0 1 0\n3.5 0 1 2\n", "a list has 3.5 values"),
        ("0 0 0\n1 0 0\n0 1 0\n-3 0 1 2\n", "a list has -3 values"),
    ],
)
def test_rows_that_do_not_fit_their_header(body, message, tmp_path):
    assert re.search(message, wrong(tmp_path, ply(body=body)))


@pytest.mark.parametrize(
    ("kind", "alpha", "expected"),
    [
        ("uchar", "255", 1.0),
        ("uchar", "51", 0.2),
        ("float", "1", 1.0),
        ("float", "0.5", 0.5),
        ("float", "255", 1.0),
    ],
)
def test_alpha_of_vertex_colours_is_coverage(kind, alpha, expected, tmp_path):
    more = "".join(f"property {kind} {name}\n" for name in ("red", "green", "blue", "alpha"))
    body = "".join(f"{point} 1 0 0 {alpha}\n" for point in ("0 0 0", "1 0 0", "0 1 0")) + "3 0 1 2\n"
    (tmp_path / "a.ply").write_bytes(ply(more=more, body=body))
    scene = gi.load_scene(tmp_path / "a.ply")
    assert scene.materials[0].alpha_blend == (expected < 1.0)
    np.testing.assert_allclose(scene.nodes[0].meshes[0].colors[:, 3], expected, rtol=1e-6)


def test_other_elements_of_ply_are_told(tmp_path):
    element = b"element material 1\nproperty uchar red\nend_header\n"
    whole = ply().replace(b"end_header\n", element) + b"255\n"
    (tmp_path / "a.ply").write_bytes(whole)
    with pytest.warns(gi.UnsupportedWarning, match=r"other elements of PLY, such as material \(element 'material'\)"):
        gi.load_scene(tmp_path / "a.ply")


def test_a_ply_without_triangles_tells_what_it_has(tmp_path):
    (tmp_path / "a.ply").write_bytes(ply().replace(b"element face", b"element faces"))
    expected = r"holds no triangles \(its elements: 3 of 'vertex', 1 of 'faces'\); export it with faces"
    with pytest.warns(gi.UnsupportedWarning, match="faces"), pytest.raises(gi.SceneError, match=expected):
        gi.load_scene(tmp_path / "a.ply")
