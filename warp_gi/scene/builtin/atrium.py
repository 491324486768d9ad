"""Two storeys of arcades around a court open to the sky.

The court lies between x = +-6 and z = +-9.6 (axes of the arcades), in bays of 2.4 m: five across, eight along.
Galleries of 3.4 m run around it on both floors. The sun comes over the -x side.
"""

from __future__ import annotations

import math

import numpy as np

from warp_gi.scene.builtin import architecture as parts
from warp_gi.scene.builtin import materials
from warp_gi.scene.builtin.shapes import (
    Shape,
    arch,
    box,
    cloth_grid,
    loft,
    merge,
    placement,
    quad,
    ribbon_ring,
)
from warp_gi.scene.camera import Camera, CameraKey, CameraPath
from warp_gi.scene.environment import SunSky, as_environment
from warp_gi.scene.model import Material, Node
from warp_gi.scene.scene import Scene

BAY = 2.4
HALF_X, HALF_Z = 6.0, 9.6  # axes of the arcades
WALL_X, WALL_Z = 9.4, 13.0  # inner faces of the outer walls
DEPTH = 0.5  # thickness of the arcade walls, metres
FLOOR = 0.15  # height of the lower gallery's floor, metres
SPRING, CEILING = 3.25, 4.85  # heights of the lower arches' springing and of the lower gallery's ceiling, metres
UPPER = 5.15  # floor
UPPER_SPRING, UPPER_CEILING = 7.75, 9.2
RAIL = 0.95  # height of the balustrade
SKY = SunSky(elevation=54.0, azimuth=292.0, turbidity=3.2, intensity=0.018, ground_albedo=(0.25, 0.22, 0.18))
VIEW = ((-1.7, 1.75, 9.0), (0.65, 3.0, -2.0))


def arcade_bays(step: float, corner: float) -> list[np.ndarray]:
    """Return placements of all bays of ``step`` metres around the court: x along the arcade, z out of the court.

    ``corner`` is how far the outermost bay ends short of where the arcades cross.
    """
    result = []
    for half, other, turn in ((HALF_X, HALF_Z, 0.0), (HALF_Z, HALF_X, 90.0)):
        count = round(2 * (half - corner) / step)
        for side in (0.0, 180.0):
            for k in range(count):
                along = placement(((k + 0.5) * step - half + corner, 0, other))
                result.append(placement(turn=turn + side) @ along)
    return result


def column_places(step: float) -> list[np.ndarray]:
    """Return placements of the columns between bays; the four corners are left to the piers."""
    result = []
    for half, other, turn in ((HALF_X, HALF_Z, 0.0), (HALF_Z, HALF_X, 90.0)):
        count = round(2 * half / step)
        for side in (0.0, 180.0):
            for k in range(1, count):
                result.append(placement(turn=turn + side) @ placement((k * step - half, 0, other)))
    return result


def raised(places: list[np.ndarray], y: float) -> np.ndarray:
    """Return the placements moved up."""
    return np.stack([placement((0, y, 0)) @ p for p in places])


def floors() -> dict[str, Shape]:
    """Return the ground: "tiles" of the court, "terracotta" of the galleries, "stone" steps and slabs."""
    inner_x, inner_z = HALF_X - 0.55, HALF_Z - 0.55
    tiles = quad((-inner_x, 0, inner_z), (2 * inner_x, 0, 0), (0, 0, -2 * inner_z)).box_mapped().textured(3.2)
    step = [(-0.9, 0.0), (0.02, 0.0), (0.02, FLOOR - 0.03), (-0.01, FLOOR), (-0.9, FLOOR)]
    low = [(-0.1, 0.0), (0.32, 0.0), (0.32, 0.055), (0.30, 0.075), (-0.1, 0.075)]
    stone = [ribbon_ring(step, inner_x, inner_z), ribbon_ring(low, inner_x, inner_z)]
    terracotta, slabs = [], []
    for y, top in ((FLOOR, True), (UPPER, False)):
        for x0, x1, z0, z1 in _ring(HALF_X + 0.3 if top else HALF_X - 0.2, HALF_Z + 0.3 if top else HALF_Z - 0.2):
            terracotta.append(quad((x0, y + 0.002, z1), (x1 - x0, 0, 0), (0, 0, z0 - z1)))
    for y0, y1, margin in ((CEILING + 0.25, UPPER, 0.2), (UPPER_CEILING + 0.25, UPPER_CEILING + 0.45, 0.25)):
        for x0, x1, z0, z1 in _ring(HALF_X - margin, HALF_Z - margin):
            slabs.append(box((x0, y0, z0), (x1, y1, z1)))
    return {
        "tiles": tiles,
        "terracotta": merge(terracotta).box_mapped().textured(2.4),
        "stone": merge([*stone, *slabs]).box_mapped().textured(2.0),
    }


def _ring(inner_x: float, inner_z: float) -> list[tuple[float, float, float, float]]:
    """Return rectangles x0, x1, z0, z1 that fill the gallery around an inner rectangle, and reach into the niches."""
    x, z = WALL_X + 0.3, WALL_Z + 0.3
    return [
        (-x, x, inner_z, z),
        (-x, x, -z, -inner_z),
        (-x, -inner_x, -inner_z, inner_z),
        (inner_x, x, -inner_z, inner_z),
    ]


def ceilings() -> Shape:
    """Return the coffers of both galleries."""
    matrices = []
    wide, long = (WALL_X - HALF_X - 0.25) / 3, 2 * WALL_Z / 25
    one = parts.coffer(1.0, 1.0, 0.22)
    stretch = np.diag([wide, 1.0, long, 1.0])
    for y in (CEILING, UPPER_CEILING):
        for i in range(3):
            for side in (-1, 1):
                x = side * (HALF_X + 0.25 + (i + 0.5) * wide)
                matrices += [placement((x, y, (k + 0.5) * long - WALL_Z)) @ stretch for k in range(25)]
                across = np.diag([2 * (HALF_X + 0.25) / 12, 1.0, (WALL_Z - HALF_Z - 0.25) / 3, 1.0])
                z = side * (HALF_Z + 0.25 + (i + 0.5) * across[2, 2])
                matrices += [placement(((k - 5.5) * across[0, 0], y, z)) @ across for k in range(12)]
    return one.repeated(np.stack(matrices)).box_mapped().textured(1.2)


def arcades() -> dict[str, Shape]:
    """Return both storeys' walls: "ashlar" below, "plaster" above, "stone" dressings."""
    lower, upper = arcade_bays(BAY, 0.0), arcade_bays(BAY / 2, 0.0)
    ashlar = [arch(BAY, CEILING - SPRING, 0.93, DEPTH, 20).repeated(raised(lower, SPRING))]
    plaster = [arch(BAY / 2, UPPER_CEILING - UPPER_SPRING, 0.45, 0.36, 12).repeated(raised(upper, UPPER_SPRING))]
    stone = [
        parts.archivolt(0.93, 0.19, DEPTH, 20).repeated(raised(lower, SPRING)),
        parts.archivolt(0.45, 0.10, 0.36, 12, fine=False).repeated(raised(upper, UPPER_SPRING)),
    ]
    keystone = box((-0.09, 0.88, -DEPTH / 2 - 0.11), (0.09, 1.24, DEPTH / 2 + 0.11), 0.02)
    stone.append(keystone.repeated(raised(lower, SPRING)))
    for x in (-HALF_X, HALF_X):
        for z in (-HALF_Z, HALF_Z):
            stone.append(box((x - 0.42, 0, z - 0.42), (x + 0.42, UPPER_CEILING, z + 0.42), 0.03))
    face_x, face_z = HALF_X - DEPTH / 2, HALF_Z - DEPTH / 2
    string = [
        (-0.4, 0.0),
        (0.03, 0.0),
        (0.05, 0.06),
        (0.10, 0.10),
        (0.10, 0.16),
        (0.17, 0.22),
        (0.17, 0.30),
        (-0.4, 0.30),
    ]
    cornice = [(-0.5, 0.0), (0.04, 0.0), (0.06, 0.07), (0.06, 0.20), (0.20, 0.26), (0.24, 0.34), (0.40, 0.40)]
    cornice += [(0.42, 0.50), (-0.5, 0.50)]
    for profile, y in ((string, CEILING), (cornice, UPPER_CEILING - 0.02)):
        stone.append(ribbon_ring([(a, b + y) for a, b in profile], face_x, face_z))
    dentil = box((-0.06, 0.0, -0.17), (0.06, 0.14, 0.02))
    stone.append(dentil.repeated(raised(_along(0.24, face_x - 0.03, face_z - 0.03), UPPER_CEILING + 0.06)))
    top = UPPER_CEILING + 0.48
    parapet = [(-0.35, 0.0), (-0.05, 0.0), (-0.05, 0.5), (-0.35, 0.5)]
    coping = [(-0.42, 0.5), (0.02, 0.5), (0.04, 0.56), (-0.2, 0.64), (-0.44, 0.56)]
    plaster.append(ribbon_ring([(a, b + top) for a, b in parapet], face_x, face_z))
    stone.append(ribbon_ring([(a, b + top) for a, b in coping], face_x, face_z))
    return {
        "ashlar": merge(ashlar).textured(2.4),
        "plaster": merge(plaster).textured(3.0),
        "stone": merge(stone).textured(2.0),
    }


def _along(step: float, half_x: float, half_z: float) -> list[np.ndarray]:
    """Return placements every ``step`` metres along a rectangle, z outwards."""
    result = []
    for half, other, turn in ((half_x, half_z, 0.0), (half_z, half_x, 90.0)):
        count = int(2 * half / step)
        for side in (0.0, 180.0):
            result += [
                placement(turn=turn + side) @ placement(((k - (count - 1) / 2) * step, 0, other)) for k in range(count)
            ]
    return result


def columns() -> dict[str, Shape]:
    """Return the "rose" shafts below, "white" shafts above, and the "stone" of bases, capitals and balustrade."""
    lower, upper = column_places(BAY), column_places(BAY / 2)
    radius, slim = 0.21, 0.085
    foot, head = FLOOR + 0.12, 0.52
    tall = SPRING - head - foot - 0.9 * radius
    block = box((-0.33, 0, -0.33), (0.33, 0.12, 0.33), 0.015)
    stone = [
        block.repeated(raised(lower, FLOOR)),
        parts.base(radius, 22).repeated(raised(lower, foot)),
        parts.capital(radius * 0.86, 0.54, head, 16).repeated(raised(lower, SPRING - head)),
    ]
    rose = parts.shaft(radius, tall, 22).repeated(raised(lower, foot + 0.9 * radius), _shifts(len(lower)))
    sill = UPPER + RAIL
    short = UPPER_SPRING - 0.24 - sill - 0.9 * slim
    stone += [
        parts.base(slim, 12, fine=False).repeated(raised(upper, sill)),
        parts.capital(slim * 0.88, 0.30, 0.24, 10, leaves=6, fine=False).repeated(raised(upper, UPPER_SPRING - 0.24)),
    ]
    white = parts.shaft(slim, short, 12).repeated(raised(upper, sill + 0.9 * slim), _shifts(len(upper)))
    rail = [
        (-0.32, -0.12),
        (-0.06, -0.12),
        (-0.02, -0.08),
        (-0.02, -0.03),
        (-0.05, 0.0),
        (-0.33, 0.0),
        (-0.36, -0.03),
        (-0.36, -0.08),
    ]
    stone.append(ribbon_ring([(a - 0.06, b + sill) for a, b in rail], HALF_X - 0.25, HALF_Z - 0.25))
    stone.append(
        ribbon_ring(
            [(-0.42, UPPER), (-0.06, UPPER), (-0.06, UPPER + 0.1), (-0.42, UPPER + 0.1)], HALF_X - 0.25, HALF_Z - 0.25
        )
    )
    post = box((-0.14, 0, -0.14), (0.14, RAIL - 0.1, 0.14), 0.0)
    stone.append(post.repeated(raised(upper, UPPER)))
    turned = parts.baluster(RAIL - 0.22, 0.065)
    bays = arcade_bays(BAY / 2, 0.0)
    for k in range(3):
        shifted = [b @ placement(((k - 1) * 0.27, 0, 0)) for b in bays]
        stone.append(turned.repeated(raised(shifted, UPPER + 0.1)))
    return {"stone": merge(stone).textured(2.0), "rose": rose.textured(1.5), "white": white.textured(1.5)}


def _shifts(count: int) -> np.ndarray:
    """Return texture offsets [count, 2], so that no two shafts are cut from the same place."""
    return np.random.default_rng(5).random((count, 2)) * 3.0


def outer_walls() -> dict[str, Shape]:
    """Return the galleries' back walls: "plaster", "stone" around the niches, "wood" doors, "shade" niches."""
    shell = [(-0.5, 0.0), (-0.26, 0.0), (-0.26, 10.3), (-0.5, 10.3)]
    plaster = [ribbon_ring(shell, WALL_X, WALL_Z)]
    upper = [(-0.3, UPPER - 0.1), (0.0, UPPER - 0.1), (0.0, UPPER_CEILING + 0.3), (-0.3, UPPER_CEILING + 0.3)]
    plaster.append(ribbon_ring(upper, WALL_X, WALL_Z))
    stone, wood = [], []
    panel = arch(BAY, CEILING + 0.3 - 2.5, 0.62, 0.26, 12)
    jamb = box((-0.58, 0.0, -0.13), (0.58, 2.5, 0.13))
    door = box((-0.62, 0.0, 0.06), (0.62, 3.14, 0.125), 0.01)
    frame = parts.archivolt(0.62, 0.13, 0.26, 12, fine=False)
    post = box((-0.065, 0.0, -0.17), (0.065, 2.5, 0.17))
    base_board = box((-0.51, 0.0, -0.16), (0.51, 0.32, 0.16))
    doors = []
    for other, turn, count in ((WALL_Z, 0.0, 7), (WALL_X, 90.0, 10)):
        for side in (0.0, 180.0):
            for k in range(count + 1):
                along = (k - count / 2) * BAY
                place = placement(turn=turn + side) @ placement((along, FLOOR, other + 0.13))
                plaster.append(jamb.transformed(place))
                stone.append(base_board.transformed(place))
                if k == count:
                    continue
                middle = placement(turn=turn + side) @ placement((along + BAY / 2, FLOOR, other + 0.13))
                plaster.append(panel.transformed(middle @ placement((0, 2.5, 0))))
                stone.append(frame.transformed(middle @ placement((0, 2.5, 0))))
                stone += [post.transformed(middle @ placement((x, 0, 0))) for x in (-0.685, 0.685)]
                if k % 2 == (count // 2) % 2:
                    doors.append(middle)
    wood.append(door.repeated(np.stack(doors)))
    for x in (-WALL_X, WALL_X):
        for z in (-WALL_Z, WALL_Z):
            plaster.append(box((x - 0.6, 0, z - 0.6), (x + 0.6, CEILING + 0.3, z + 0.6)))
    return {
        "plaster": merge(plaster).box_mapped().textured(3.0),
        "stone": merge(stone).textured(2.0),
        "wood": merge(wood).turned(90, "z").box_mapped().turned(-90, "z").textured(1.2),
    }


def banners() -> dict[str, Shape]:
    """Return cloths hung from the balustrade into the court, by colour."""
    places = [
        ("indigo", -1, -7.2),
        ("crimson", -1, -2.4),
        ("saffron", -1, 2.4),
        ("saffron", 1, -4.8),
        ("indigo", 1, 0.0),
        ("crimson", 1, 4.8),
    ]
    colors: dict[str, list[Shape]] = {"crimson": [], "indigo": [], "saffron": []}
    for k, (color, side, z) in enumerate(places):
        piece = drape(1.55, 2.7 + 0.25 * (k % 2), seed=k)
        place = placement((side * (HALF_X - 0.29), UPPER + RAIL + 0.015, z)) @ placement(turn=-90.0 * side)
        colors[color].append(piece.transformed(place))
    return {name: merge(pieces).textured(0.8) for name, pieces in colors.items()}


def drape(width: float, length: float, seed: int) -> Shape:
    """Return cloth over a rail that runs along x: behind it short, over the top, and down to -length in front (+z)."""
    grid = cloth_grid(width, length + 0.75, 26, 26, seed=seed, folds=0.035)
    s = -grid[..., 1]
    over = np.clip((s - 0.45) / 0.30, 0, 1)
    y = np.where(s < 0.45, s - 0.45, 0.0) + np.where(s > 0.75, 0.75 - s, 0.0)
    z = -0.16 + 0.44 * over
    hang = np.clip((s - 0.75) / 0.5, 0, 1)
    back = np.clip((0.45 - s) / 0.3, 0, 1)
    z = z + grid[..., 2] * np.maximum(hang, 0.3 * back) + 0.07 * hang * (1 - 0.3 * s / s.max())
    y = y + 0.02 * np.sin(math.pi * over)
    uvs = np.stack([grid[..., 0], -s], axis=-1)
    return loft(np.stack([grid[..., 0], y, z], axis=-1), uvs, crease=180.0)


def greenery() -> dict[str, Shape]:
    """Return trees in tubs around the fountain and bushes along the steps: "clay", "soil", "bark", "leaves"."""
    trunk, tips = parts.branches(2.1, 0.55, 6, 0.05, seed=3)
    tub = parts.pot(0.46, 0.62, 24)
    tree = {
        **tub,
        "bark": trunk.moved(y=0.5),
        "leaves": parts.foliage(tips + np.array([0, 0.55, 0]), 0.42, 820, 0.15, seed=4),
    }
    small = parts.pot(0.24, 0.36, 16)
    bush = {**small, "leaves": parts.foliage(np.array([[0, 0.52, 0], [0.08, 0.68, 0.05]]), 0.25, 170, 0.13, seed=6)}
    trees = [
        placement((x, 0, z), turn=57.0 * k)
        for k, (x, z) in enumerate(((-2.9, -2.9), (2.9, -2.9), (-2.9, 2.9), (2.9, 2.9)))
    ]
    bushes = []
    for k in range(8):
        for side in (-1, 1):
            z = (k - 3.5) * BAY
            if abs(z) < 8 and (k + (side > 0)) % 2:
                bushes.append(placement((side * (HALF_X - 0.95), 0.0, z), turn=71.0 * k))
    grown = [parts.plants(trees, tree), parts.plants(bushes, bush)]
    return {name: merge([g[name] for g in grown if name in g]) for name in ("clay", "soil", "bark", "leaves")}


def lanterns() -> dict[str, Shape]:
    """Return lanterns in the lower gallery, one a bay of the long sides, two on the short ones."""
    middle_x, middle_z = (HALF_X + WALL_X) / 2 + 0.1, (HALF_Z + WALL_Z) / 2 + 0.1
    places = [placement((side * middle_x, CEILING, (k - 3.5) * BAY)) for side in (-1, 1) for k in range(0, 8)]
    places += [placement((x, CEILING, side * middle_z)) for side in (-1, 1) for x in (-BAY, 0.0, BAY)]
    return parts.plants(places, parts.lantern(1.35))


def scene() -> Scene:
    """Return the atrium."""
    ashlar, stone = materials.ashlar(), materials.limestone()
    ochre = materials.plaster("ochre plaster", (0.66, 0.43, 0.20), (0.66, 0.53, 0.36), 51)
    rose = materials.plaster("rose plaster", (0.60, 0.31, 0.19), (0.66, 0.50, 0.36), 55)
    bronze, wood = materials.bronze(), materials.walnut()
    fountain = {name: shape.textured(2.0) for name, shape in parts.fountain(1.6).items()}
    cloths = {
        "crimson": materials.fabric("crimson", (0.42, 0.022, 0.022), (0.62, 0.36, 0.10), 101),
        "indigo": materials.fabric("indigo", (0.022, 0.045, 0.20), (0.55, 0.45, 0.28), 102),
        "saffron": materials.fabric("saffron", (0.62, 0.27, 0.035), (0.40, 0.05, 0.03), 103),
    }
    dressed = {"ashlar": ashlar, "plaster": rose, "stone": stone}
    groups: list[tuple[str, dict[str, Shape], dict[str, Material]]] = [
        (
            "floor",
            floors(),
            {"tiles": materials.court_tiles(), "terracotta": materials.terracotta_tiles(), "stone": stone},
        ),
        ("outer walls", outer_walls(), {"plaster": ochre, "stone": stone, "wood": wood}),
        ("arcades", arcades(), dressed),
        (
            "columns",
            columns(),
            {"stone": stone, "rose": materials.rose_marble(), "white": materials.white_marble()},
        ),
        ("ceilings", {"wood": ceilings()}, {"wood": wood}),
        ("banners", banners(), cloths),
        ("fountain", fountain, {"stone": stone, "water": materials.water()}),
        (
            "plants",
            greenery(),
            {
                "clay": materials.plain("clay", (0.42, 0.17, 0.085), 0.8),
                "soil": materials.plain("soil", (0.035, 0.024, 0.016), 1.0),
                "bark": materials.plain("bark", (0.13, 0.085, 0.05), 0.9),
                "leaves": materials.plain("leaves", (0.07, 0.155, 0.03), 0.42),
            },
        ),
        ("lanterns", lanterns(), {"metal": bronze, "glow": materials.lamp("lantern glow", (90.0, 48.0, 17.0))}),
    ]
    nodes = [Node(name, [s.mesh(m[k], f"{name} {k}") for k, s in shapes.items()]) for name, shapes, m in groups]
    eye, target = VIEW
    cameras = {
        "main": Camera.look_at(eye, target, hfov=68.0),
        "gallery": Camera.look_at((-7.9, 1.75, 11.3), (-7.2, 2.1, 0.0), hfov=65.0),
        "upper": Camera.look_at((6.9, 7.0, 7.4), (-2.5, 3.2, -4.5), hfov=68.0),
    }
    return Scene(nodes, environment=as_environment(SKY), cameras=cameras, name="atrium")


def camera_path() -> CameraPath:
    """Return a slow dolly along the court."""
    (x, y, z), target = VIEW
    keys = (
        CameraKey(0.0, VIEW[0], target, hfov=68.0),
        CameraKey(47 / 24, (x + 0.9, y + 0.15, z - 1.6), target, hfov=68.0),
    )
    return CameraPath(keys, resolution=(640, 360), name="atrium")
