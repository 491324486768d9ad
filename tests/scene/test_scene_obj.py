"""OBJ with MTL, PLY, STL and OFF, written by hand."""

from __future__ import annotations

import numpy as np
import pytest
from scene_tools import png

import warp_gi as gi
from warp_gi.errors import OptionError, SceneError

QUAD = """mtllib quad.mtl
v 0 0 0
v 1 0 0
v 1 1 0
v 0 1 0
v 0 0 1
vt 0 0
vt 1 0
vt 1 1
vt 0 1
vn 0 0 1
usemtl wood
f 1/1/1 2/2/1 3/3/1 4/4/1
usemtl lamp
f 1 2 5
usemtl chrome
f 2 3 5
usemtl leaf
f 3/3 4/4 5/1
"""
MTL = """# materials
newmtl wood
Kd 0 0 0
Ks 0.02 0.02 0.01
Ns 30
map_Kd -s 1 1 1 -clamp on Tex\\grain one.png
newmtl lamp
Kd 0.5 0.4 0.3
Ks 0 0 0
Ke 3 2 1
newmtl chrome
Kd 0.1 0.1 0.1
Ks 0.9 0.8 0.7
newmtl leaf
Kd 0.2 0.5 0.1
map_d mask.png
"""
GREEN = np.full((2, 2, 3), (0, 255, 0), np.uint8)


def write_quad(folder, obj=QUAD, mtl=MTL):
    (folder / "quad.obj").write_text(obj)
    (folder / "quad.mtl").write_text(mtl)
    (folder / "tex").mkdir(exist_ok=True)
    (folder / "tex" / "Grain One.PNG").write_bytes(png(GREEN))
    mask = np.zeros((4, 8, 3), np.uint8)
    mask[:2] = 255
    (folder / "mask.png").write_bytes(png(mask))
    return folder / "quad.obj"


@pytest.fixture
def quad(tmp_path):
    return gi.load_scene(write_quad(tmp_path, mtl=MTL))


def test_materials_of_an_obj(quad):
    wood, lamp, chrome, leaf = (next(m for m in quad.materials if m.name == n) for n in "wood lamp chrome leaf".split())
    assert wood.base_color == (1, 1, 1) and wood.specular == pytest.approx(0.5) and wood.double_sided
    assert wood.roughness == pytest.approx(0.5)  # (2 / 32) ** 0.25
    assert wood.base_color_texture.wrap == ("clamp", "clamp") and wood.base_color_texture.pixels.shape == (2, 2, 4)
    assert lamp.emission == (3, 2, 1) and lamp.specular == 0 and lamp.base_color == (0.5, 0.4, 0.3)
    assert chrome.metallic == 1 and chrome.base_color == (0.9, 0.8, 0.7)
    assert leaf.alpha_cutoff == 0.5 and leaf.base_color == (0.2, 0.5, 0.1)
    np.testing.assert_array_equal(leaf.base_color_texture.pixels[:, 0], [[255] * 4] * 2 + [[255, 255, 255, 0]] * 2)
    assert quad.emitter_count == 1


def test_triangles_of_an_obj(quad):
    assert quad.triangle_count == 5 and [node.name for node in quad.nodes] == ["wood", "lamp", "chrome", "leaf"]
    g = quad.data("cpu").geometry
    wood = g.indices.numpy()[g.objects.numpy() == 0].reshape(-1)
    assert len(wood) == 6
    np.testing.assert_array_equal(g.points.numpy()[wood][:, :2], g.uvs.numpy()[wood])
    np.testing.assert_array_equal(g.normals.numpy()[wood], [[0, 0, 1]] * 6)
    others = g.indices.numpy()[g.objects.numpy() > 0]
    assert not g.normals.numpy()[others].any()


def test_obj_without_its_library_is_grey(tmp_path):
    path = write_quad(tmp_path)
    (tmp_path / "quad.mtl").unlink()
    with pytest.warns(UserWarning, match=r"material library .*quad\.mtl' is missing"):
        scene = gi.load_scene(path)
    assert scene.triangle_count == 5
    assert {(m.base_color, m.specular) for m in scene.materials} == {((0.8, 0.8, 0.8), 0.0)}


def test_latin_1_names(tmp_path):
    path = write_quad(tmp_path)
    for name, text in (("quad.obj", QUAD), ("quad.mtl", MTL)):
        (tmp_path / name).write_bytes(text.replace("wood", "Möbel").encode("latin-1"))
    assert gi.load_scene(path).materials[0].base_color_texture is not None


BROKEN_OBJ = {
    "texture": (
        dict(mtl=MTL.replace("mask.png", "masc.png")),
        r"texture 'masc.png' of material 'leaf' .*masc.png' is missing; did you mean 'mask.png'",
    ),
    "index": (
        dict(obj=QUAD.replace("f 1 2 5", "f 1 2 9")),
        "line 15: a face names vertex 9, which is out of range: the file has 5",
    ),
    "nan": (dict(obj=QUAD.replace("v 0 0 1", "v nan 0 1")), "of 3 vertices are not finite"),
    "no faces": (dict(obj="v 0 0 0\nv 1 0 0\n"), "holds no triangles"),
    "empty": (dict(obj=""), "holds no triangles"),
}


@pytest.mark.parametrize("case", BROKEN_OBJ)
def test_broken_obj_is_one_clear_line(case, tmp_path):
    texts, message = BROKEN_OBJ[case]
    path = write_quad(tmp_path, **texts)
    with pytest.raises(SceneError, match=message) as error:
        gi.load_scene(path)
    assert "\n" not in str(error.value)


PLY = """ply
format ascii 1.0
element vertex 4
property float x
property float y
property float z
element face 2
property list uchar int vertex_indices
end_header
0 0 0
1 0 0
1 1 0
0 1 0.5
3 0 1 2
3 0 2 3
"""
OFF = "OFF\n4 2 0\n0 0 0\n1 0 0\n1 1 0\n0 1 0.5\n3 0 1 2\n3 0 2 3\n"
FACET = "facet normal 0 0 1\nouter loop\nvertex {}\nvertex {}\nvertex {}\nendloop\nendfacet\n"
STL = f"solid s\n{FACET}{FACET}endsolid s\n".format("0 0 0", "1 0 0", "1 1 0", "0 0 0", "1 1 0", "0 1 0.5")


@pytest.mark.parametrize(("name", "text"), [("a.ply", PLY), ("a.off", OFF), ("a.stl", STL)])
def test_single_meshes(name, text, tmp_path):
    (tmp_path / name).write_text(text)
    scene = gi.load_scene(tmp_path / name)
    g = scene.data("cpu").geometry
    corners = g.points.numpy()[g.indices.numpy()]
    np.testing.assert_allclose(corners[0], [[0, 0, 0], [1, 0, 0], [1, 1, 0]])
    np.testing.assert_allclose(corners[1], [[0, 0, 0], [1, 1, 0], [0, 1, 0.5]])
    assert not g.normals.numpy().any() and scene.name == "a"
    smooth = gi.load_scene(tmp_path / name, smooth=60.0).data("cpu").geometry
    np.testing.assert_allclose(np.linalg.norm(smooth.normals.numpy(), axis=1), 1.0, atol=1e-6)
    assert len(smooth.points) == 4


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (PLY[:150], "a.ply' cannot be read as PLY|holds no triangles"),
        (PLY.replace("3 0 2 3", "3 0 2 8"), "index 8 is out of range, there are 4 vertices"),
        (PLY.replace("1 1 0\n", "1 nan 0\n"), "1 of 4 vertices are not finite"),
        (PLY[: PLY.index("3 0 1 2")].replace("face 2", "face 0"), "holds no triangles"),
        ("", "a.ply' cannot be read as PLY|holds no triangles"),
    ],
)
def test_broken_ply_is_one_clear_line(text, message, tmp_path):
    (tmp_path / "a.ply").write_text(text)
    with pytest.raises(SceneError, match=message) as error:
        gi.load_scene(tmp_path / "a.ply")
    assert "\n" not in str(error.value)


def test_missing_and_unknown_files(tmp_path):
    (tmp_path / "hall.glb").touch()
    (tmp_path / "hall.fbx").touch()
    with pytest.raises(SceneError, match=r"scene file .*halls\.glb' is missing; did you mean 'hall\.glb'"):
        gi.load_scene(tmp_path / "halls.glb")
    with pytest.raises(SceneError, match="there is no folder"):
        gi.load_scene(tmp_path / "no" / "x.glb")
    with pytest.raises(SceneError, match=r"unknown kind of file '\.fbx'; expected one of \.glb, \.gltf, \.obj, \.ply"):
        gi.load_scene(tmp_path / "hall.fbx")
    with pytest.raises(SceneError, match="missing"):
        gi.load_scene(tmp_path)
    (tmp_path / "a.off").write_text(OFF)
    with pytest.raises(OptionError, match="scale must be a finite number above 0, got 0"):
        gi.load_scene(tmp_path / "a.off", scale=0.0)
