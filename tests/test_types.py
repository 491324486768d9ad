"""What users' type checkers see: every public name with its type, and wrong arguments found."""

import ast
import re
import sys
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace

import pytest

import warp_gi
from warp_gi import registry

ROOT = Path(__file__).resolve().parents[1]
STUB = "warp_gi/__init__.pyi"
EXAMPLE = """
import numpy as np
import warp_gi as gi

scene = gi.builtin_scene("cornell_box")
camera: gi.Camera = gi.Camera.look_at((0.0, 1.0, 5.0), np.zeros(3), hfov=40.0)
pipeline: gi.Pipeline = gi.Pipeline(environment=gi.VisibilityField(), indirect=None, spp=4)
for frame in gi.render(scene, camera, pipeline, frames=[0], device="cpu"):
    picture: np.ndarray = frame.numpy("beauty")
    gi.PowerLights().trace(frame, None)
    gi.write_frame(frame, "shot.####.exr")
    frame.data.radius = 2.0
    frame.numpy(3)  # wrong
    frame.data.radius = "wide"  # wrong
    gi.BsdfPaths().trace(scene, None)  # wrong
    for _, estimator in pipeline.estimators():
        estimator.trace(scene, None)  # wrong
    seconds: str = frame.timings["trace"]  # wrong
gi.render(scene, camera, pipeline, frames=48)  # wrong
gi.render(scene, "camera.json", pipeline)  # wrong
gi.render(scene, camera, pipeline, sead=1)  # wrong
gi.Camera.look_at(1.0, (0.0, 0.0, 0.0))  # wrong
gi.Camera.look_at((0.0, 1.0, 5.0), (0.0, 0.0, 0.0), resolution=960)  # wrong
gi.Pipeline(environment="VisibilityField")  # wrong
gi.VisibilityField(cell_size="large")  # wrong
gi.bake(camera, gi.VisibilityField())  # wrong
gi.Camrea  # wrong
"""


def stubbed():
    """Return the module of every name that the stub imports."""
    imports = [node for node in ast.parse((ROOT / STUB).read_text()).body if isinstance(node, ast.ImportFrom)]
    return {alias.asname: node.module for node in imports for alias in node.names}


def modules():
    """Return the module of every public name."""
    return {**warp_gi._PUBLIC, **registry.public(), **dict.fromkeys(warp_gi._MODULES, "warp_gi")}


def test_the_stub_has_every_public_name():
    assert set(modules()) == set(warp_gi.__all__)
    lines = {name: f"from {module} import {name} as {name}" for name, module in modules().items()}
    wanted = {*lines} - ({*registry.public()} - {*stubbed()})  # techniques may lack a line
    missing = [lines[name] for name in wanted if stubbed().get(name) != modules()[name]]
    assert not missing, f"type checkers do not see these names; add to {STUB}:\n" + "\n".join(sorted(missing))
    gone = sorted(set(stubbed()) - set(warp_gi.__all__))
    assert not gone, f"{STUB} has names that are not public: remove {', '.join(gone)}"


def test_a_name_that_the_stub_lacks_still_loads(monkeypatch):
    """The stub is for type checkers: a technique without a line in it works."""
    monkeypatch.setitem(sys.modules, "new_technique", SimpleNamespace(NewEstimator="loaded"))
    monkeypatch.setattr(registry, "public", lambda: {"NewEstimator": "new_technique"})
    assert "NewEstimator" not in stubbed() and "NewEstimator" in warp_gi.__all__
    assert warp_gi.NewEstimator == "loaded"


def test_wrong_arguments_are_found(tmp_path):
    mypy = import_module("mypy.api")
    path = tmp_path / "example.py"
    path.write_text(EXAMPLE)
    printed, problem, _ = mypy.run(["--config-file", str(ROOT / "pyproject.toml"), str(path)])
    assert not problem
    found = {int(line) for line in re.findall(r"^\S*example\.py:(\d+): error", printed, re.MULTILINE)}
    assert found == {n for n, line in enumerate(EXAMPLE.splitlines(), 1) if line.endswith("# wrong")}, printed


@pytest.mark.parametrize("name", ["py.typed", "__init__.pyi"])
def test_the_package_holds_what_type_checkers_ask_for(name):
    assert (ROOT / "warp_gi" / name).is_file()
    assert name in re.search(r'"warp_gi" = (\[.*\])', (ROOT / "pyproject.toml").read_text())[1]
