"""Edits after a scene was built: pictures are those of a new scene with them, or they are an error."""

from __future__ import annotations

import copy
import pickle
import threading
from dataclasses import replace

import numpy as np
import pytest
from scene_tools import triangle

import warp_gi as gi
from warp_gi.errors import SceneError
from warp_gi.scene.builtin import BUILTIN_SCENES
from warp_gi.scene.edits import Edits
from warp_gi.scene.model import Keyframe, Material, Mesh, Node, PunctualLight, Texture
from warp_gi.scene.watching import CHUNK, Watch

CAMERA = gi.Camera.look_at((1.0, 1.0, 4.0), (1.0, 0.5, 0.0), resolution=(8, 6))
PIPELINE = gi.Pipeline.preset("direct", spp=1)
SLIDE = [Keyframe(0.0), Keyframe(2.0, (4.0, 0.0, 0.0))]


def pixels(seed: int, size: int = 4) -> np.ndarray:
    return np.random.default_rng(seed).integers(1, 255, (size, size, 4)).astype(np.uint8)


def quad(material: Material, side: int = 4, **fields) -> Mesh:
    """Return a square of side * side * 2 triangles in the xy plane, with normals and texture coordinates."""
    u, v = np.meshgrid(np.linspace(0, 1, side + 1), np.linspace(0, 1, side + 1))
    points = np.stack([2 * u, 2 * v, 0 * u], -1).reshape(-1, 3).astype(np.float32)
    corner = (np.arange(side) + (side + 1) * np.arange(side)[:, None]).ravel()
    faces = [[corner, corner + 1, corner + side + 2], [corner, corner + side + 2, corner + side + 1]]
    indices = np.concatenate([np.stack(face, -1) for face in faces]).astype(np.int32)
    normals = np.tile(np.float32([0.6, 0, 0.8]), (len(points), 1))
    return Mesh(points, indices, material, normals, np.stack([u, v], -1).reshape(-1, 2).astype(np.float32), **fields)


def parts(side: int = 4, size: int = 4, moving: bool = False) -> gi.Scene:
    """Return a scene with everything that can be edited."""
    paint = Material("paint", base_color=[0.5, 0.6, 0.7], base_color_texture=Texture("colors", pixels(1, size)))
    paint.normal_texture = Texture("bumps", np.full((4, 4, 4), 128, np.uint8), srgb=False)
    paint.metallic_roughness_texture = Texture("gloss", pixels(2), srgb=False)
    glow = Material("glow", emission=(1.0, 2.0, 3.0), emission_texture=Texture("bulbs", pixels(3)))
    ring = triangle(glow, name="ring")
    ring.points[:, 2] = 0.0625
    nodes = [
        Node("wall", [quad(paint, side, name="front")], shifted(0.0, z=-0.5)),
        Node("arm"),
        Node(
            "hand",
            [triangle(Material("skin"), name="palm"), ring],
            shifted(0.0, z=0.25),
            parent=1,
        ),
        Node("post"),
        Node("tripod"),
        Node("lift", [triangle(Material("steel"), name="cabin")], keyframes=SLIDE if moving else None),
        Node("rope", [triangle(Material("hemp"), name="strand")], shifted(0.0, z=0.125), parent=5),
    ]
    lights = [
        PunctualLight("point", (5.0, 5.0, 5.0), (1.0, 1.0, 2.0), name="bulb"),
        PunctualLight("spot", (5.0, 5.0, 5.0), (0.0, 0.0, 3.0), name="beam", node=3),
    ]
    sky = gi.Environment(pixels=np.random.default_rng(4).uniform(0.1, 1, (8, 16, 3)).astype(np.float32))
    return gi.Scene(nodes, lights, sky, name="parts")


def shifted(x: float, z: float = 0.0) -> np.ndarray:
    matrix = np.eye(4)
    matrix[0, 3], matrix[2, 3] = x, z
    return matrix


def put(target, name, value):
    return lambda scene: setattr(target(scene), name, value)


def wall(scene):
    return scene.nodes[0].meshes[0]


def paint(scene):
    return scene.materials[0]


def glow(scene):
    return scene.materials[2]


def bulb(scene):
    return scene.lights[0]


def add(target, name, value):
    """Return an edit in place of the second item of an array, in C order."""

    def edit(scene):
        getattr(target(scene), name).flat[1] += value

    return edit


def colors(scene):
    return paint(scene).base_color_texture


def flip(scene):
    wall(scene).indices[:, [1, 2]] = wall(scene).indices[:, [2, 1]]


def swap(scene):
    wall(scene).points[:] = wall(scene).points[::-1].copy()


GEOMETRY = {
    "points, in place": (add(wall, "points", 0.25), "points of mesh 'front' .node 0 'wall'. changed"),
    "points, all": (lambda s: wall(s).points.__isub__(1.0), "points of mesh 'front'"),
    "points, in another order": (swap, "points of mesh 'front'"),
    "points, another array": (lambda s: setattr(wall(s), "points", wall(s).points * 2), "points of mesh 'front'"),
    "points, fewer": (
        lambda s: setattr(wall(s), "points", wall(s).points[:3]),
        "mesh 'front' of node 'wall': index 24 is out of range, there are 3 vertices",
    ),
    "points, more": (
        lambda s: setattr(wall(s), "points", np.concatenate([wall(s).points] * 2)),
        "mesh 'front' of node 'wall': normals must be .50, 3., got .25, 3.",
    ),
    "points, NaN": (add(wall, "points", np.nan), "mesh 'front' of node 'wall': 1 of 25 vertices are not finite"),
    "normals": (add(wall, "normals", 0.5), "normals of mesh 'front'"),
    "no normals": (put(wall, "normals", None), "normals of mesh 'front'"),
    "uvs": (add(wall, "uvs", 0.5), "uvs of mesh 'front'"),
    "indices": (add(wall, "indices", 1), "indices of mesh 'front'"),
    "winding": (flip, "indices of mesh 'front'"),
    "fewer triangles": (lambda s: setattr(wall(s), "indices", wall(s).indices[:4]), "indices of mesh 'front'"),
    "material of a mesh": (lambda s: setattr(wall(s), "material", glow(s)), "material of mesh 'front'"),
    "mesh added": (lambda s: s.nodes[0].meshes.append(triangle(paint(s), name="more")), "mesh 'more' was added"),
    "mesh removed": (lambda s: s.nodes[2].meshes.pop(), "mesh 'ring' was removed .*node 2 'hand'"),
    "meshes replaced": (
        lambda s: setattr(s.nodes[0], "meshes", [triangle(paint(s), name="tile")]),
        "mesh 'front' of node 'wall' was replaced by mesh 'tile'",
    ),
    "node moved": (put(lambda s: s.nodes[0], "parent_from_node", shifted(1.0)), "parent_from_node of node 0 'wall'"),
    "node moved in place": (add(lambda s: s.nodes[2], "parent_from_node", 0.5), "node 2 'hand' changed"),
    "node above moved": (put(lambda s: s.nodes[1], "parent_from_node", shifted(1.0)), "node 1 'arm' changed"),
    "another parent": (
        put(lambda s: s.nodes[2], "parent", 9),
        "node 'hand': parent must stand before it .0 to 1., got 9",
    ),
    "keyframes of a node at rest": (put(lambda s: s.nodes[0], "keyframes", SLIDE), "keyframes of node 0 'wall'"),
    "node added": (lambda s: s.nodes.append(Node("extra", [triangle(paint(s))])), "node 'extra' was added"),
    "node removed": (lambda s: s.nodes.pop(0), "node 'wall' was removed"),
    "node replaced": (
        lambda s: s.nodes.__setitem__(0, replace(s.nodes[0], parent_from_node=shifted(1.0))),
        "node 0 'wall' was replaced",
    ),
    "list of nodes replaced": (lambda s: setattr(s, "nodes", s.nodes[:2]), "node 'hand' was removed"),
}
"""Edits of what is read when a scene is made."""

SHADING = {
    "base_color": (put(paint, "base_color", (0.1, 0.2, 0.3)), "base_color of material 'paint' changed"),
    "base_color, in place": (lambda s: paint(s).base_color.__setitem__(1, 0.1), "base_color of material 'paint'"),
    "alpha": (put(paint, "alpha", 0.5), "alpha of material 'paint'"),
    "metallic": (put(paint, "metallic", 0.5), "metallic of material 'paint'"),
    "roughness": (put(paint, "roughness", 0.5), "roughness of material 'paint'"),
    "roughness out of range": (put(paint, "roughness", 7.0), "material 'paint': roughness must be from 0 to 1"),
    "specular": (put(paint, "specular", 0.5), "specular of material 'paint'"),
    "emission": (put(paint, "emission", (1.0, 0.0, 0.0)), "emission of material 'paint'"),
    "normal_scale": (put(paint, "normal_scale", 0.5), "normal_scale of material 'paint'"),
    "alpha_cutoff": (put(paint, "alpha_cutoff", 0.5), "alpha_cutoff of material 'paint'"),
    "alpha_blend": (put(paint, "alpha_blend", True), "alpha_blend of material 'paint'"),
    "double_sided": (put(glow, "double_sided", False), "double_sided of material 'glow'"),
    "no texture": (put(paint, "base_color_texture", None), "base_color_texture of material 'paint'"),
    "a texture more": (
        lambda s: setattr(s.materials[1], "emission_texture", colors(s)),
        "emission_texture of material 'skin'",
    ),
    "another texture": (
        lambda s: setattr(paint(s), "base_color_texture", Texture("other", pixels(9))),
        "base_color_texture 'other' of material 'paint'",
    ),
    "texels": (add(colors, "pixels", 1), "pixels of base_color_texture 'colors' of material 'paint' changed"),
    "texels of normals": (add(lambda s: paint(s).normal_texture, "pixels", 1), "normal_texture 'bumps'"),
    "texels of roughness": (
        add(lambda s: paint(s).metallic_roughness_texture, "pixels", 1),
        "metallic_roughness_texture 'gloss'",
    ),
    "texels of emission": (add(lambda s: glow(s).emission_texture, "pixels", 1), "emission_texture 'bulbs'"),
    "other texels": (lambda s: setattr(colors(s), "pixels", pixels(9)), "pixels of base_color_texture 'colors'"),
    "larger image": (lambda s: setattr(colors(s), "pixels", pixels(9, 8)), "pixels of base_color_texture 'colors'"),
    "wrap": (lambda s: setattr(colors(s), "wrap", ("clamp", "clamp")), "wrap of base_color_texture 'colors'"),
    "srgb": (lambda s: setattr(colors(s), "srgb", False), "srgb of base_color_texture 'colors'"),
    "material replaced": (
        lambda s: s.materials.__setitem__(0, Material("new", base_color=(0.1, 0.1, 0.1))),
        "material 0 'paint' was replaced in scene.materials",
    ),
    "material removed": (lambda s: s.materials.pop(), "material .* was removed in scene.materials"),
    "light kind": (put(bulb, "kind", "directional"), "kind of light 'bulb'"),
    "light intensity": (put(bulb, "intensity", (1.0, 1.0, 1.0)), "intensity of light 'bulb' changed"),
    "light position": (put(bulb, "position", (1.0, 1.0, 1.0)), "position of light 'bulb'"),
    "light direction": (put(lambda s: s.lights[1], "direction", (1.0, 0.0, -1.0)), "direction of light 'beam'"),
    "light inner_cone": (put(lambda s: s.lights[1], "inner_cone", 0.5), "inner_cone of light 'beam'"),
    "light outer_cone": (put(lambda s: s.lights[1], "outer_cone", 0.5), "outer_cone of light 'beam'"),
    "light range": (put(bulb, "range", 3.0), "range of light 'bulb'"),
    "light out of range": (put(bulb, "range", -3.0), "light 'bulb': range must be above 0 m"),
    "light added": (lambda s: s.lights.append(replace(bulb(s), name="second")), "light 'second' was added"),
    "light removed": (lambda s: s.lights.pop(0), "light 'bulb' was removed"),
    "light replaced": (
        lambda s: s.lights.__setitem__(0, replace(bulb(s), intensity=(1.0, 1.0, 1.0))),
        "intensity of light 'bulb'",
    ),
    "light carried elsewhere": (
        lambda s: setattr(s.nodes[3], "parent_from_node", shifted(1.0)),
        "parent_from_node of node 3 'post' changed",
    ),
    "sky rotation": (put(lambda s: s.environment, "rotation", 90.0), "rotation of the environment changed"),
    "sky scale": (put(lambda s: s.environment, "scale", 2.0), "scale of the environment changed"),
    "sky texel": (add(lambda s: s.environment, "pixels", 1.0), "pixels of the environment changed"),
    "sky pixels": (
        lambda s: setattr(s.environment, "pixels", s.environment.pixels * 2),
        "pixels of the environment changed",
    ),
}
"""Edits of what is read when a device is first used."""

REFUSED = (
    *(
        "points, fewer",
        "points, more",
        "points, NaN",
        "uvs",
        "indices",
        "winding",
        "fewer triangles",
        "material of a mesh",
    ),
    *("mesh added", "mesh removed", "meshes replaced", "another parent", "keyframes of a node at rest", "node added"),
    *("node removed", "list of nodes replaced", "roughness out of range", "material replaced", "material removed"),
    "light out of range",
)
"""Edits that pictures cannot follow."""
FOLLOWED = [name for name in {**GEOMETRY, **SHADING} if name not in REFUSED]


@pytest.mark.parametrize("moving", [False, True], ids=["still", "moving"])
@pytest.mark.parametrize("name", REFUSED)
def test_an_edit_that_cannot_be_followed_is_an_error(name, moving):
    """It is found at the next frame, by ``render`` and by ``bake``; the line names the edit and what works."""
    edit, message = {**GEOMETRY, **SHADING}[name]
    scene = parts(moving=moving)
    scheduler = gi.FrameScheduler(scene, CAMERA, PIPELINE)
    scheduler.frame(0)
    scheduler.frame(1)
    edit(scene)
    for attempt in (
        lambda: scheduler.frame(1),
        lambda: next(gi.render(scene, CAMERA, PIPELINE)),
        lambda: gi.bake(scene, gi.VisibilityField()),
    ):
        with pytest.raises(SceneError, match=message) as caught:
            attempt()
        text = str(caught.value)
        assert "\n" not in text
        if name not in INVALID:
            assert text.startswith("scene 'parts': ") and "pictures would not show it" in text
            assert "gi.Scene(scene.nodes" in text
        assert ("scene.animate(" in text) == (name == "keyframes of a node at rest")


INVALID = (
    "points, fewer",
    "points, more",
    "points, NaN",
    "indices",
    "another parent",
    "roughness out of range",
    "light out of range",
)
"""Edits that no scene can hold."""


@pytest.mark.parametrize("name", [name for name in GEOMETRY if name in REFUSED])
def test_such_an_edit_of_the_geometry_before_the_first_frame_is_an_error_too(name):
    edit, message = GEOMETRY[name]
    scene = parts()
    edit(scene)
    with pytest.raises(SceneError, match=message):
        next(gi.render(scene, CAMERA, PIPELINE))


def fresh(scene):
    """Return a new scene of what a scene was edited to."""
    sky = scene.environment
    if sky is not None:
        sky = gi.Environment(None if sky.pixels is None else sky.pixels.copy(), sky.color, sky.rotation, sky.scale)
    return gi.Scene(scene.nodes, scene.lights, sky, name="parts")


def assert_equal_frames(ours, truth, names=("beauty", "emitters", "environment", "albedo", "normal", "position")):
    for name in names:
        np.testing.assert_array_equal(ours.numpy(name), truth.numpy(name), err_msg=name)


@pytest.mark.parametrize("moving", [False, True], ids=["still", "moving"])
@pytest.mark.parametrize("name", FOLLOWED)
def test_the_next_frame_is_that_of_a_new_scene(name, moving):
    """To the last bit, by a scheduler that rendered before and by another, and with the hashes of the new scene."""
    scene = parts(moving=moving)
    scheduler = gi.FrameScheduler(scene, CAMERA, PIPELINE)
    before = scheduler.frame(0).numpy("beauty")
    scheduler.frame(1)
    hashes = scene.hash, scene.version
    {**GEOMETRY, **SHADING}[name][0](scene)
    ours, again = scheduler.frame(0), next(gi.render(scene, CAMERA, PIPELINE))
    truth = next(gi.render(fresh(scene), CAMERA, PIPELINE))
    assert_equal_frames(ours, truth)
    assert_equal_frames(again, truth, ("beauty", "motion", "object_id"))
    assert scene.hash == fresh(scene).hash != hashes[0] and scene.version > hashes[1]
    assert scene.geometry_hash == fresh(scene).geometry_hash
    np.testing.assert_array_equal(scene.bounds, fresh(scene).bounds)
    np.testing.assert_array_equal(scene.emitter_powers(), fresh(scene).emitter_powers())
    if name not in UNSEEN:
        assert not np.array_equal(ours.numpy("beauty"), before)
    version = scene.version
    scheduler.frame(0)
    assert scene.version == version  # once


UNSEEN = (
    *("points, in place", "normals", "alpha", "a texture more", "normal_scale", "no normals"),
    *("double_sided", "light direction", "light inner_cone", "light outer_cone"),
)
"""Edits whose effect eight by six pixels need not show."""


@pytest.mark.parametrize("name", [name for name in GEOMETRY if name in FOLLOWED])
def test_the_geometry_may_be_edited_before_the_first_frame(name):
    scene = parts()
    GEOMETRY[name][0](scene)
    assert_equal_frames(*(next(gi.render(one, CAMERA, PIPELINE)) for one in (scene, fresh(scene))))
    assert scene.hash == fresh(scene).hash


@pytest.mark.parametrize("edit", ["another texture", "other texels"])
def test_a_lamp_whose_texture_was_black_when_the_scene_was_made_shines(edit):
    """Which triangles emit was known then."""
    black = Texture("black", np.zeros((2, 2, 4), np.uint8))
    points = np.float32([[-1, 0, 0], [1, 0, 0], [0, 1, 0]])
    material = Material("lamp", emission=(1.0, 1.0, 1.0), emission_texture=black)
    scene = gi.Scene([gi.Node("lamp", [gi.Mesh(points, np.int32([[0, 1, 2]]), material)])])
    if edit == "another texture":
        scene.materials[0].emission_texture = None
    else:
        black.pixels[:] = 255
    next(gi.render(scene, CAMERA, PIPELINE))
    assert scene.emitter_count == 1
    np.testing.assert_array_equal(scene.emitter_powers(), fresh(scene).emitter_powers())


LATE = [
    name for name in SHADING if name not in ("material removed", "material replaced") and "out of range" not in name
]


@pytest.mark.parametrize("name", LATE)
def test_materials_lights_and_sky_may_be_edited_before_the_first_frame(name):
    """They are read at the first frame: it shows the edit."""
    scene = parts()
    SHADING[name][0](scene)
    assert_equal_frames(*(next(gi.render(one, CAMERA, PIPELINE)) for one in (scene, fresh(scene))))
    assert scene.hash == fresh(scene).hash
    no_alarm(scene)


@pytest.mark.parametrize("moving", [False, True], ids=["still", "moving"])
def test_one_item_in_the_middle_of_a_large_array_is_found_and_undone(moving):
    scene = parts(side=150, size=512, moving=moving)
    scheduler = gi.FrameScheduler(scene, CAMERA, PIPELINE)
    before = scheduler.frame(0).numpy("beauty")
    mesh = wall(scene)
    arrays = [mesh.points, mesh.normals, mesh.uvs, mesh.indices, colors(scene).pixels, scene.environment.pixels]
    assert mesh.points.nbytes > 4 * CHUNK and mesh.uvs.nbytes > 2 * CHUNK
    for array in arrays:
        for place in (0, array.size // 2, array.size - 1):
            kept = array.flat[place]
            array.flat[place] = kept + 1 if array.dtype.kind in "iu" else kept + np.float32(2.0**-20)
            version = scene.version
            if array is mesh.uvs or array is mesh.indices:
                with pytest.raises(SceneError, match="changed"):
                    scheduler.frame(0)
            else:
                scheduler.frame(0)
                assert scene.version > version
            array.flat[place] = kept
            assert np.array_equal(scheduler.frame(0).numpy("beauty"), before)


# ---- no false alarms ----


def no_alarm(scene, frames=(0, 1, 0, 2)):
    for frame in gi.render(scene, CAMERA, PIPELINE, frames=frames):
        assert np.isfinite(frame.numpy("beauty")).all()
    scene.check_unchanged()


HARMLESS = {
    "nothing": lambda s: None,
    "names": lambda s: [setattr(one, "name", "x") for one in (s, *s.nodes, *s.materials, *s.lights, wall(s))],
    "equal points": lambda s: setattr(wall(s), "points", wall(s).points.copy()),
    "equal points of another type": lambda s: setattr(wall(s), "points", wall(s).points.astype(np.float64)),
    "equal points in another order of memory": lambda s: setattr(wall(s), "points", np.asfortranarray(wall(s).points)),
    "equal indices": lambda s: setattr(wall(s), "indices", wall(s).indices.astype(np.int64)),
    "equal texels": lambda s: setattr(colors(s), "pixels", colors(s).pixels.copy()),
    "equal texture": lambda s: setattr(paint(s), "base_color_texture", replace(colors(s))),
    "equal color": lambda s: setattr(paint(s), "base_color", np.array(paint(s).base_color)),
    "equal material": lambda s: setattr(wall(s), "material", replace(paint(s))),
    "equal mesh": lambda s: s.nodes[0].meshes.__setitem__(0, replace(wall(s))),
    "equal node": lambda s: s.nodes.__setitem__(0, replace(s.nodes[0])),
    "equal lists": lambda s: [setattr(s, name, list(getattr(s, name))) for name in ("nodes", "materials", "lights")],
    "equal light": lambda s: s.lights.__setitem__(0, replace(bulb(s), intensity=[5.0, 5.0, 5.0])),
    "equal matrix": lambda s: setattr(s.nodes[0], "parent_from_node", np.float32(s.nodes[0].parent_from_node)),
    "a node that carries nothing": lambda s: setattr(s.nodes[4], "parent_from_node", shifted(3.0)),
    "keyframes of a node that carries nothing": lambda s: setattr(s.nodes[4], "keyframes", SLIDE),
    "a material that nothing has": lambda s: s.materials.append(Material("unused")),
    "cameras": lambda s: s.cameras.update(view=CAMERA),
    "equal sky": lambda s: setattr(s.environment, "pixels", s.environment.pixels.copy()),
    "a full turn of the sky": lambda s: setattr(s, "environment", s.environment.rotated(360.0)),
}


@pytest.mark.parametrize("moving", [False, True], ids=["still", "moving"])
@pytest.mark.parametrize("name", HARMLESS)
def test_what_changes_no_picture_is_no_error(name, moving):
    scene = parts(moving=moving)
    before = next(gi.render(scene, CAMERA, PIPELINE)).numpy("beauty")
    HARMLESS[name](scene)
    no_alarm(scene)
    np.testing.assert_allclose(next(gi.render(scene, CAMERA, PIPELINE)).numpy("beauty"), before, atol=2e-5)


@pytest.mark.parametrize("moving", [False, True], ids=["still", "moving"])
@pytest.mark.parametrize("name", HARMLESS)
def test_after_an_equal_copy_edits_are_still_found(name, moving):
    scene = parts(moving=moving)
    no_alarm(scene)
    HARMLESS[name](scene)
    no_alarm(scene)
    version = scene.version
    mesh, light, sky = wall(scene), bulb(scene), scene.environment
    for target, field in (
        (mesh, "points"),
        (mesh, "indices"),
        (scene.nodes[0], "parent_from_node"),
        (mesh.material.base_color_texture, "pixels"),
        (mesh.material, "base_color"),
        (light, "position"),
        (sky, "pixels"),
    ):
        kept = getattr(target, field)
        if np.size(kept) == 3:
            setattr(target, field, (0.25, 0.25, 0.25))
        else:
            first = kept.flat[0]
            kept.flat[0] += 1
        if field == "indices" or (name == "equal material" and target is mesh.material):
            with pytest.raises(SceneError, match="changed"):
                no_alarm(scene)
        else:
            no_alarm(scene)
            assert scene.version > version
        if np.size(kept) == 3:
            setattr(target, field, kept)
        else:
            kept.flat[0] = first
        no_alarm(scene)
        version = scene.version


PATH = gi.CameraPath.orbit((1.0, 0.5, 0.0), 4.0, fps=4.0, resolution=(8, 6))


def beauties(scene, frames):
    return [frame.numpy("beauty") for frame in gi.render(scene, PATH, PIPELINE, frames=frames)]


def test_keyframes_of_a_node_that_moves_are_read_for_every_frame():
    """Even before the first frame."""
    keys = [Keyframe(0.0, (4.0, 0.0, 0.0)), Keyframe(2.0)]  # within the bounds of SLIDE
    truth = parts(moving=True)
    truth.animate("lift", keys)
    truth = beauties(truth, [0, 4])
    early, late = parts(moving=True), parts(moving=True)
    beauties(late, [0, 4])
    for scene in (early, late):
        scene.nodes[5].keyframes = keys
        for ours, right in zip(beauties(scene, [0, 4]), truth, strict=True):
            np.testing.assert_allclose(ours, right, atol=1e-4)
    late.nodes[6].parent_from_node = shifted(0.5, z=0.125)  # hangs on it
    moved = beauties(late, [4])[0]
    late.animate("lift", keys)
    np.testing.assert_allclose(moved, beauties(late, [4])[0], atol=1e-4)


FITTED = [Keyframe(0.0, (4.0, 0.0, 0.0)), Keyframe(2.0)]  # within the bounds of SLIDE


def test_hashes_know_edited_keyframes_and_states_follow_them():
    """A new scheduler is of another scene; one that goes on keeps what it has, under another sky too."""
    scene = parts(moving=True)
    pipeline = replace(PIPELINE, emitters=gi.UniformLights())
    scheduler = gi.FrameScheduler(scene, PATH, pipeline)
    first, table = scheduler.frame(0), scheduler.state("emitters")
    hashes = {"as built": scene.hash}
    edits = {
        "keyframes": lambda: setattr(scene.nodes[5], "keyframes", FITTED),
        "in place": lambda: scene.nodes[5].keyframes.__setitem__(1, Keyframe(2.0, (1.0, 0.0, 0.0))),
        "a node that hangs on it": lambda: setattr(scene.nodes[6], "parent_from_node", shifted(0.5, z=0.125)),
    }
    for name, edit in edits.items():
        edit()
        frame = scheduler.frame(0)
        assert frame.metadata["scene_hash"] == scene.hash != scene.geometry_hash
        assert scene.hash not in hashes.values(), name
        hashes[name] = scene.hash
    scene.environment = 0.5
    scheduler.frame(0)
    assert scheduler.state("emitters") is table and first.metadata["scene_hash"] == hashes["as built"]
    scene.environment = parts().environment
    scene.nodes[5].keyframes, scene.nodes[6].parent_from_node = list(SLIDE), shifted(0.0, z=0.125)
    scene.check_unchanged()
    assert scene.hash == hashes["as built"] == parts(moving=True).hash


def test_a_resting_node_above_one_that_moves_is_in_the_hash():
    def rail(x):
        cabin = Node("cabin", [triangle(Material("steel"))], parent=0, keyframes=SLIDE)
        return gi.Scene([Node("rail", parent_from_node=shifted(x)), cabin, parts().nodes[0]], environment=1.0)

    scene = rail(0.0)
    next(gi.render(scene, CAMERA, PIPELINE))
    before = scene.hash
    assert before == rail(0.0).hash
    scene.nodes[0].parent_from_node = shifted(0.5)
    scene.check_unchanged()
    assert scene.hash != before


EDITED = {
    "keyframes": lambda scene: setattr(scene.nodes[5], "keyframes", FITTED),
    "a colour": lambda scene: setattr(paint(scene), "base_color", (0.1, 0.9, 0.1)),
}


@pytest.mark.parametrize("edit", EDITED.values(), ids=EDITED)
def test_frames_of_a_scene_before_an_edit_are_not_taken_for_done(tmp_path, edit):
    scene, where = parts(moving=True), {"frames": [0, 4], "output": tmp_path / "a.####.exr"}
    list(gi.render(scene, PATH, PIPELINE, **where))
    assert gi.plan_sequence(scene, PATH, PIPELINE, **where).frames == ()
    edit(scene)
    plan = gi.plan_sequence(scene, PATH, PIPELINE, **where)
    assert plan.frames == (0, 4) and "scene_hash is" in plan.reason(0)
    assert [frame.index for frame in gi.render(scene, PATH, PIPELINE, resume=True, **where)] == [0, 4]
    assert gi.plan_sequence(scene, PATH, PIPELINE, **where).frames == ()


def test_animate_takes_edits_over():
    scene = parts()
    no_alarm(scene)
    scene.nodes[0].parent_from_node = shifted(0.5)
    wall(scene).points[:, 1] += 0.25
    paint(scene).base_color = (0.1, 0.9, 0.1)
    scene.animate("rope", SLIDE)
    fresh = parts()
    fresh.nodes[0].parent_from_node, wall(fresh).points[:, 1] = shifted(0.5), wall(fresh).points[:, 1] + 0.25
    paint(fresh).base_color = (0.1, 0.9, 0.1)
    fresh.nodes[6].keyframes = SLIDE
    fresh = gi.Scene(fresh.nodes, fresh.lights, fresh.environment)
    assert np.array_equal(beauties(scene, [0, 3]), beauties(fresh, [0, 3]))
    wall(scene).indices[0] = 99
    with pytest.raises(SceneError, match="index 99 is out of range"):
        scene.animate("rope", SLIDE)


def test_a_new_material_and_animate_is_one_clear_line():
    scene = parts()
    wall(scene).material = Material("new")
    with pytest.raises(SceneError, match="mesh 'front' of node 'wall' has a material that the scene lacks"):
        scene.animate("rope", SLIDE)


def test_lights_may_be_edited_where_one_of_them_moves():
    scene = parts(moving=True)
    scene.lights[1].node = 5
    scheduler = gi.FrameScheduler(scene, PATH, PIPELINE)
    scheduler.frame(3)
    scene.lights[0] = replace(scene.lights[0], intensity=(50.0, 0.0, 0.0))
    scene.lights[1].intensity = (0.0, 9.0, 0.0)
    assert_equal_frames(scheduler.frame(4), gi.FrameScheduler(fresh(scene), PATH, PIPELINE).frame(4))
    scene.lights.pop()
    assert_equal_frames(scheduler.frame(5), gi.FrameScheduler(fresh(scene), PATH, PIPELINE).frame(5))


def test_the_environment_may_be_replaced_turned_and_edited_with_an_assignment():
    scene = parts()
    no_alarm(scene)
    sky = scene.environment
    for value in (sky.rotated(90.0), (0.5, 0.5, 0.5), None, sky, gi.SunSky(height=32), sky.rotated(10.0)):
        scene.environment = value
        no_alarm(scene)
    scene.environment = sky
    sky.pixels[:4] *= np.float32(3.0)
    sky.rotation, sky.scale = 45.0, 2.0
    no_alarm(scene)
    fresh = parts()
    fresh.environment = gi.Environment(pixels=sky.pixels.copy(), rotation=45.0, scale=2.0)
    assert scene.environment.content_hash == fresh.environment.content_hash
    assert np.array_equal(beauties(scene, [0]), beauties(fresh, [0]))


def test_a_color_of_the_sky_is_watched():
    scene = parts()
    scene.environment = (0.5, 0.5, 0.5)
    no_alarm(scene)
    scene.environment.color = (0.5, 0.5, 0.75)
    assert_equal_frames(*(next(gi.render(one, CAMERA, PIPELINE)) for one in (scene, fresh(scene))))
    assert scene.environment.mean_radiance.tolist() == [0.5, 0.5, 0.75]


def test_a_sky_that_moves_is_no_one_elses_to_edit():
    scene = parts()
    scene.environment = lambda time: gi.Environment(color=(0.5, 0.5, 0.5 + 0.0 * time))
    no_alarm(scene)
    scene.environment.scale = 2.0
    with pytest.raises(SceneError, match=r"scale of the environment changed .* assign it again"):
        no_alarm(scene)


@pytest.mark.parametrize("name", ["cornell_box", "sphere_row", "two_rooms"])
def test_built_in_scenes_raise_no_alarm(name):
    scene = gi.builtin_scene(name)
    camera = replace(next(iter(scene.cameras.values())), resolution=(8, 6))
    for _ in range(2):
        for frame in gi.render(scene, camera, PIPELINE, frames=range(2)):
            assert np.isfinite(frame.numpy("beauty")).all()


@pytest.mark.slow
@pytest.mark.parametrize("name", BUILTIN_SCENES)
def test_every_built_in_scene_is_what_it_was(name):
    scene = gi.builtin_scene(name)
    scene.data("cpu")
    scene.update(0.5, 0.4, "cpu")
    scene.check_unchanged()
    assert scene._edits.changes() == {}


def test_two_threads_and_two_schedulers_of_one_scene():
    scene, errors = parts(), []
    scene.data("cpu")

    def work():
        try:
            no_alarm(scene)
        except Exception as error:
            errors.append(error)

    threads = [threading.Thread(target=work) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert errors == []


def test_scenes_may_share_meshes_and_lists_or_strided_arrays_are_watched():
    shared = quad(Material("paint"))
    shared.points = shared.points.tolist()
    shared.uvs = np.repeat(shared.uvs, 2, 1)[:, ::2]
    shared.normals = None
    one, two = gi.Scene([Node("a", [shared])]), gi.Scene([Node("b", [shared]), Node("c", [shared])])
    no_alarm(one)
    no_alarm(two)
    shared.points[3][1] += 0.5
    for scene in (one, two):
        no_alarm(scene)
        np.testing.assert_array_equal(scene._flat.points, fresh(scene)._flat.points)
    shared.uvs[2, 1] += 0.5
    with pytest.raises(SceneError, match="uvs of mesh 'mesh'"):
        no_alarm(one)


def test_nan_is_equal_to_itself():
    mesh = quad(Material("paint"))
    mesh.normals[2] = mesh.uvs[3] = np.nan
    scene = gi.Scene([Node("n", [mesh])])
    no_alarm(scene)
    mesh.normals = mesh.normals.copy()
    no_alarm(scene)


def test_a_scene_that_was_not_rendered_yet_can_be_copied():
    for scene in (copy.deepcopy(parts()), pickle.loads(pickle.dumps(parts()))):
        no_alarm(scene)
        wall(scene).points += 1.0
        no_alarm(scene)
        assert scene.hash == fresh(scene).hash


def test_arrays_that_nobody_can_write_are_not_read_and_resized_ones_are_not_touched():
    fixed = np.frombuffer(np.ones(3000, np.float32).tobytes(), np.float32).reshape(-1, 3)
    locked = np.ones((1000, 3), np.float32)
    locked.flags.writeable = False  # can be undone
    mesh = Mesh(fixed, locked)
    watch = Watch([mesh])
    assert watch.nbytes == locked.nbytes
    locked.flags.writeable = True
    locked[500, 1] = 2.0
    assert watch.changes() == [(mesh, "indices")]
    locked[500, 1] = 1.0
    assert watch.changes() == []
    locked.resize((5_000_000, 3), refcheck=False)
    assert watch.changes() == [(mesh, "indices")]


def test_only_changed_words_count_and_every_byte_does():
    for size in (1, 7, 8, 31, 255, 256, 257, 1000, CHUNK, CHUNK + 3):
        array = np.random.default_rng(size).integers(0, 256, (size, 1)).astype(np.uint8)
        mesh = Mesh(array, np.zeros((1, 3), np.int32))
        watch = Watch([mesh])
        for place in {0, size // 3, size // 2, size - 1}:
            array[place] ^= 128
            assert watch.changes() == [(mesh, "points")]
            array[place] ^= 128
        array[:] = array[::-1].copy()
        assert watch.changes() == ([(mesh, "points")] if size > 1 else [])


def test_a_check_makes_nothing_new():
    """An edit that matters is not forgotten by the check that finds it."""
    scene = parts()
    no_alarm(scene)
    assert isinstance(scene._edits, Edits)
    wall(scene).uvs[0, 0] -= 1.0
    for _ in range(2):
        with pytest.raises(SceneError):
            scene.check_unchanged()
