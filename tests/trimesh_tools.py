"""A plugin of pytest (``-p trimesh_tools``) that runs trimesh's ray tests on this library in place of embreex.

Both of trimesh's intersectors are replaced. trimesh's sdist has its tests without their tools and models: ``generic``
stands in for the tools, and shapes of the same kind for models that are made of a few triangles.
"""

from __future__ import annotations

import importlib.util
import json
import logging
import os
import sys
import time
import types
from pathlib import Path

import numpy as np
import pytest
import trimesh

from warp_gi import trimesh_rays

embreex = types.ModuleType("embreex")
embreex.__version__ = "4.4.0"  # tests of the bugs of older versions ask
sys.modules["embreex"] = embreex
sys.modules["trimesh.ray.ray_pyembree"] = trimesh_rays
trimesh.ray.ray_pyembree = trimesh_rays
trimesh.ray.has_embree = True
trimesh.ray.ray_triangle.RayMeshIntersector = trimesh_rays.RayMeshIntersector

MODELS = Path(os.environ.get("WARP_GI_TRIMESH", "")) / "models"


def stand_in(name):
    """Return a shape in place of a model, or None."""
    if name == "unit_cube.STL":
        return trimesh.creation.box()
    if name == "unit_sphere.STL":
        return trimesh.creation.icosphere(radius=0.5)
    if name == "teapot.stl":  # asked for as a mesh that is not closed
        sphere = trimesh.creation.icosphere()
        sphere.update_faces(sphere.triangles_center[:, 2] < 0.7)
        return sphere
    return None


def get_mesh(name, use_embree=True, **options):
    """Return a model of trimesh's repository, its queries those of this library."""
    path = MODELS / name
    mesh = trimesh.load_mesh(path) if path.exists() else stand_in(name)
    if mesh is None:
        pytest.skip(f"trimesh's sdist has no models, and nothing stands in for {name}")
    assert isinstance(mesh.ray, trimesh_rays.RayMeshIntersector)
    return mesh


def ray_data():
    """Return the rays of ``test_rays``, which are beside the models."""
    path = MODELS / "data" / "ray_data.json"
    if not path.exists():
        pytest.skip("trimesh's sdist has no models and no rays through them")
    return json.loads(path.read_text(encoding="utf-8"))


def hollowed(meshes):
    """Return a mesh less another inside of it: what trimesh asks a library for that may be missing."""
    outer, inner = meshes
    assert (np.abs(inner.bounds) < np.abs(outer.bounds)).all()
    inner.invert()
    return trimesh.util.concatenate([outer, inner])


if importlib.util.find_spec("manifold3d") is None:
    trimesh.boolean.difference = hollowed


class Data(dict):
    def __missing__(self, name):
        assert name == "ray_data"
        return ray_data()


generic = types.ModuleType("generic")
generic.np, generic.trimesh, generic.time, generic.log = np, trimesh, time, logging.getLogger("trimesh tests")
generic.random = np.random.default_rng(0).random
generic.get_mesh, generic.data = get_mesh, Data()
sys.modules["generic"] = generic
