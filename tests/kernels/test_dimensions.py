"""Random-number dimensions: one table, no literals elsewhere, and nothing that one launch draws twice."""

from __future__ import annotations

import ast
from itertools import combinations
from pathlib import Path

import pytest

from warp_gi.kernels import sampling as d
from warp_gi.scene.sky_map import MOST_RAYS
from warp_gi.techniques.paths.estimators import BsdfPaths

KERNELS = sorted((Path(__file__).resolve().parents[2] / "kernels").glob("*.py"))
DRAWS = {"sample_1d", "sample_2d", "random_1d", "light_1d", "light_2d", "explore_2d", "explore_3d"}
STRATIFIED, RANDOM = "stratified", "random"
VERTICES = 511  # of a path, for which the table has room


def _dimension(call: ast.Call) -> ast.expr | None:
    """Return what a call that draws a number has as its dimension."""
    name = call.func.id if isinstance(call.func, ast.Name) else getattr(call.func, "attr", "")
    return call.args[2] if name in DRAWS else None


@pytest.mark.parametrize("path", KERNELS, ids=lambda path: path.stem)
def test_dimensions_have_names(path):
    """Every number is drawn by a dimension of the table: a name, a parameter, or sums of them and of at most 1."""
    tree = ast.parse(path.read_text())
    for call in (node for node in ast.walk(tree) if isinstance(node, ast.Call)):
        dimension = _dimension(call)
        if dimension is None:
            continue
        assert not isinstance(dimension, ast.Constant), f"{path.name}:{call.lineno}: give the dimension a name"
        numbers = [node.value for node in ast.walk(dimension) if isinstance(node, ast.Constant)]
        assert all(number == 1 for number in numbers), f"{path.name}:{call.lineno}: give {numbers} names"
    if path.stem != "sampling":
        named = [n.targets[0].id for n in tree.body if isinstance(n, ast.Assign) and isinstance(n.targets[0], ast.Name)]
        assert not [name for name in named if "DIMENSION" in name], f"{path.name}: its place is kernels/sampling.py"


def path_numbers(vertices: int = VERTICES) -> dict[tuple[str, int], str]:
    """Return what every number of a path is for, by kind and dimension; two of one dimension fail."""
    uses: dict[tuple[str, int], str] = {}

    def draw(kind: str, dimension: int, what: str) -> None:
        assert (kind, dimension) not in uses, f"{what} and {uses[kind, dimension]} both draw {kind} {dimension}"
        uses[kind, dimension] = what

    draw(STRATIFIED, d.CAMERA_DIMENSION, "camera")
    for vertex in range(vertices):
        at = d.PATH_DIMENSION + vertex * d.VERTEX_DIMENSIONS
        who = f"vertex {vertex}: "
        for offset, pair, what in (
            (d.LIGHT_DIMENSION, False, "light"),
            (d.SKY_DIMENSION, True, "sky"),
            (d.EMITTER_DIMENSION, True, "emitter"),
        ):
            if vertex == 0:
                draw(STRATIFIED, at + offset, who + what)
                continue
            draw(RANDOM, at + offset + d.FURTHER_DIMENSIONS, who + what)
            if pair:
                draw(RANDOM, at + offset + d.FURTHER_SECOND_DIMENSIONS, who + what)
        draw(RANDOM, at + d.LIGHT_DIMENSION, who + "digits of light")
        draw(RANDOM, at + d.SKY_DIGITS_DIMENSION, who + "digits of sky")
        draw(STRATIFIED, at + d.DIRECTION_DIMENSION, who + "lobe")
        draw(STRATIFIED, at + d.DIRECTION_DIMENSION + 1, who + "direction")
        draw(RANDOM, at + d.DIRECTION_DIMENSION + d.GUIDE_DIMENSIONS, who + "leaf of a guide")
        draw(RANDOM, at + d.ROULETTE_DIMENSION, who + "roulette")
        draw(RANDOM, at + d.CACHE_DIMENSION, who + "cache")
        draw(RANDOM, at + d.CACHE_PLACE_DIMENSION, who + "place in a cache")
        draw(RANDOM, at + d.CACHE_PLACE_DIMENSION + 1, who + "place in a cache")
        draw(RANDOM, at + d.CACHE_LOBE_DIMENSION, who + "lobe beside a cache")
        draw(RANDOM, at + d.EXPLORE_DIMENSION, who + "exploring")
        for first in (d.EXPLORE_POINT_DIMENSION, d.EXPLORE_POINT_DIMENSION + d.EXPLORE_DIGITS_DIMENSION):
            draw(RANDOM, at + first, who + "exploring")
            draw(RANDOM, at + first + 1, who + "exploring")
    return uses


def test_numbers_of_a_path_do_not_meet():
    path_numbers()
    with pytest.raises(AssertionError, match="both draw"):
        path_numbers(VERTICES + 2)  # where they begin to


def test_lights_that_are_apart_draw_beside_paths():
    """Suns have numbers of their own, of the index and the seed of the path."""
    drawn = {(STRATIFIED, d.APART_DIMENSION + sun) for sun in range(MOST_RAYS)}
    assert not path_numbers().keys() & drawn


def test_probes_draw_beside_their_paths():
    """The path that goes on from the end of a ray has the index and the seed of the ray."""
    paths = path_numbers(BsdfPaths().max_depth - 1)
    for kind, dimension in (
        (STRATIFIED, d.PROBE_LOBE_DIMENSION),
        (STRATIFIED, d.PROBE_RAY_DIMENSION),
        (RANDOM, d.PROBE_PIXEL_DIMENSION),
        (RANDOM, d.PROBE_HIT_DIMENSION),
    ):
        assert (kind, dimension) not in paths


def test_transfer_draws_beside_its_paths():
    """The path of a sharp lobe's light from the sky, and the one from what its ray meets, have the ray's index."""
    paths = path_numbers(BsdfPaths().max_depth - 1)
    of_pixel = (d.TRANSFER_LOBE_DIMENSION, d.TRANSFER_SUN_DIMENSION, d.TRANSFER_HIT_SUN_DIMENSION)
    drawn = [(STRATIFIED, dimension) for dimension in of_pixel]
    assert len(set(drawn)) == 3 and not paths.keys() & set(drawn)


def test_paths_that_measure_reach_do_not_meet():
    used = {d.CAMERA_DIMENSION}
    for vertex in range(16):
        at = d.REACH_DIMENSION + vertex * d.REACH_VERTEX_DIMENSIONS
        assert not used & {at, at + 1}
        used |= {at, at + 1}


@pytest.mark.parametrize(
    "launch",
    [
        [
            (RANDOM, d.SURFACE_PIECE_DIMENSION),
            (STRATIFIED, d.SURFACE_POINT_DIMENSION),
            (RANDOM, d.SURFACE_TURN_DIMENSION),
        ],
        [
            (STRATIFIED, d.SET_TURN_DIMENSION),
            (STRATIFIED, d.SET_SKY_DIMENSION),
            (RANDOM, d.SET_SKY_DIGITS_DIMENSION),
            (STRATIFIED, d.SET_COSINE_DIMENSION),
        ],
        [
            (STRATIFIED, d.FIELD_BSDF_DIMENSION),
            (RANDOM, d.FIELD_BSDF_DIMENSION),
            (RANDOM, d.FIELD_LIGHT_DIMENSION),
            (RANDOM, d.FIELD_LOBE_DIMENSION),
            (RANDOM, d.FIELD_SET_DIMENSION),
        ],
        [
            (STRATIFIED, d.CAMERA_DIMENSION),
            (STRATIFIED, d.POLYGON_SKY_DIMENSION),
            (RANDOM, d.POLYGON_SKY_DIMENSION),
            (STRATIFIED, d.POLYGON_DIRECTION_DIMENSION),
            (STRATIFIED, d.POLYGON_LOBE_DIMENSION),
            (RANDOM, d.POLYGON_PATCH_DIMENSION),
            (RANDOM, d.POLYGON_PATCH_DIMENSION + 1),
            (RANDOM, d.POLYGON_EXACT_DIMENSION),
        ],
        [
            (STRATIFIED, d.TRANSFER_DIRECTION_DIMENSION),
            (RANDOM, d.TRANSFER_TURN_DIMENSION),
            (STRATIFIED, d.TRANSFER_LAMP_DIMENSION),
            (RANDOM, d.TRANSFER_LAMP_DIMENSION),
            (STRATIFIED, d.TRANSFER_POINT_DIMENSION),
            (STRATIFIED, d.TRANSFER_RAY_DIMENSION),
        ],
    ],
    ids=["visibility bake", "sets", "visibility field", "visibility polygons", "transfer bake"],
)
def test_numbers_of_a_launch_do_not_meet(launch):
    assert all(a != b for a, b in combinations(launch, 2))
