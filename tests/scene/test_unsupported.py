"""What a file uses and the library does not read in full: one warning a feature, which names it and where."""

from __future__ import annotations

import re
import warnings
from pathlib import Path

import numpy as np
import pytest
from scene_tools import GlbBuilder

import warp_gi as gi
from warp_gi.cli.main import main
from warp_gi.scene.files.feature_models import MODELS
from warp_gi.scene.files.support import BY_NAME, FEATURES, Findings

CASES = Path(__file__).parents[1] / "cases"


def notes(path):
    """Return the texts of the warnings about what a file uses."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        gi.load_scene(path)
    assert {one.filename for one in caught} <= {__file__}  # the caller's line, not one of the library
    return [str(one.message) for one in caught if one.category is gi.UnsupportedWarning]


def one_triangle(tmp_path, change):
    """Return the path of a GLB of a triangle on node "n" with material "m", whose JSON ``change`` was done to."""
    glb = GlbBuilder()
    glb.add("nodes", {"name": "n", "mesh": glb.mesh(glb.add("materials", {"name": "m"}))})
    change(glb)
    return glb.write(tmp_path / "a.glb")


def extend(name, value, used=True):
    """Return a change that gives the material an extension."""

    def change(glb):
        glb.json["materials"][0]["extensions"] = {name: value}
        if used:
            glb.json["extensionsUsed"] = [name]

    return change


@pytest.mark.parametrize("used", [True, False])
def test_an_extension_of_a_material_is_named_with_the_material(used, tmp_path):
    (note,) = notes(one_triangle(tmp_path, extend("KHR_materials_clearcoat", {"clearcoatFactor": 1.0}, used)))
    assert "a.glb' uses KHR_materials_clearcoat (material 'm'), which is ignored: the surface below the coat" in note


def test_an_unknown_extension_is_named(tmp_path):
    (note,) = notes(one_triangle(tmp_path, extend("ACME_paint", {})))
    assert "uses ACME_paint (material 'm'), which is ignored: this library does not know it" in note
    (note,) = notes(one_triangle(tmp_path, lambda glb: glb.json.update(extensionsUsed=["ACME_nothing"])))
    assert "uses ACME_nothing, which is ignored" in note


def test_one_warning_a_kind_names_three_places_and_counts_the_rest(tmp_path):
    def change(glb):
        for i in range(5):
            material = glb.add("materials", {"name": f"m{i}", "extensions": {"KHR_materials_sheen": {}}})
            glb.add("nodes", {"mesh": glb.mesh(material)})

    (note,) = notes(one_triangle(tmp_path, change))
    assert "KHR_materials_sheen (material 'm0', material 'm1', material 'm2' and 2 more)" in note


def attribute(name, width):
    return lambda glb: glb.json["meshes"][0]["primitives"][0]["attributes"].update(
        {name: glb.accessor(np.ones((3, width)))}
    )


def points(glb):
    glb.json["meshes"][0]["primitives"].append({"attributes": {"POSITION": 0}, "mode": 0})


def instances_of_a_skin(glb):
    attributes = glb.json["meshes"][0]["primitives"][0]["attributes"]
    attributes["JOINTS_0"], attributes["WEIGHTS_0"] = (
        glb.accessor(np.zeros((3, 4)), np.uint8),
        glb.accessor(np.ones((3, 4))),
    )
    glb.add("skins", {"joints": [0]})
    places = glb.accessor(np.zeros((2, 3)))
    glb.json["nodes"][0]["skin"] = 0
    glb.json["nodes"][0]["extensions"] = {"EXT_mesh_gpu_instancing": {"attributes": {"TRANSLATION": places}}}


USES = {
    "COLOR_1": (attribute("COLOR_1", 3), r"COLOR_1 and above \(mesh 'tri'\)"),
    "points": (points, r"points and lines \(mesh 'tri'\)"),
    "instances": (instances_of_a_skin, r"instances of meshes with a skin \(node 'n'\)"),
}


@pytest.mark.parametrize("case", USES)
def test_what_meshes_nodes_and_animations_use_is_named(case, tmp_path):

    change, expected = USES[case]
    (note,) = notes(one_triangle(tmp_path, change))
    assert re.search(expected, note)


def test_a_file_that_uses_nothing_else_gives_no_warning(tmp_path):
    assert notes(one_triangle(tmp_path, attribute("TANGENT", 4))) == []


def test_commands_print_one_line(tmp_path, capsys):
    path = one_triangle(tmp_path, extend("KHR_materials_sheen", {}))
    assert main(["info", str(path)]) == 0
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("warp-gi: warning: ") and "KHR_materials_sheen (material 'm')" in line


def test_the_table_has_one_row_a_feature():
    assert len(BY_NAME) == len(FEATURES)
    findings = Findings()
    for feature in FEATURES:
        findings.add(feature.name, "somewhere")
    named = " ".join(findings.messages("x.glb"))
    for feature in FEATURES:
        if feature.status == "supported":
            assert f"uses {feature.name} (" not in named


def test_the_page_of_scene_files_is_the_table():
    page = (Path(__file__).parents[2] / "docs/reference/scene_files.md").read_text(encoding="utf-8")
    for feature in FEATURES:
        assert f"| {feature.name} | {feature.formats} | {feature.status} | {feature.how} |" in page


def test_required_extensions_that_are_ignored_are_errors(tmp_path):
    def change(glb):
        extend("KHR_materials_sheen", {})(glb)
        glb.json["extensionsRequired"] = ["KHR_materials_sheen"]

    with pytest.raises(gi.SceneError, match="requires KHR_materials_sheen, which is not supported"):
        gi.load_scene(one_triangle(tmp_path, change))


def test_sample_models_are_told_in_the_words_of_the_table():
    """Every feature of theirs is one of the table, and those of glTF that are read have a model."""
    named = {feature for features in MODELS.values() for feature in features}
    assert named <= BY_NAME.keys()
    assert all("glTF" in BY_NAME[name].formats for name in named) and len(MODELS) > 40
