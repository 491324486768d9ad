"""A street of plastered houses with balconies and shutters, under trees with many leaves.

The street runs along z, 7 m wide, with pavements of 3.5 m; houses stand from x = +-7 outwards.
"""

from __future__ import annotations

import numpy as np

from warp_gi.scene.builtin import architecture as parts
from warp_gi.scene.builtin import materials
from warp_gi.scene.builtin.shapes import Shape, box, cylinder, icosphere, lathe, loft, merge, placement, quad, tube
from warp_gi.scene.camera import Camera, CameraKey, CameraPath
from warp_gi.scene.environment import SunSky, as_environment
from warp_gi.scene.model import Node
from warp_gi.scene.scene import Scene

FRONT = 7.0  # |x| of the facades
KERB = 3.5
LENGTH = 30.0  # the street runs from -LENGTH to LENGTH
BAY, STOREY, GROUND = 2.1, 3.0, 3.6  # metres
WINDOW = (0.95, 1.65, 0.75)  # width, height, sill above the floor
SKY = SunSky(elevation=47.0, azimuth=40.0, turbidity=3.0, intensity=0.018)
HOUSES = (  # bays, storeys above the ground floor, colour
    ((5, 3, 0), (4, 2, 1), (5, 3, 2), (4, 3, 3), (5, 2, 0), (5, 3, 1)),
    ((4, 3, 2), (5, 2, 3), (5, 3, 0), (4, 3, 1), (5, 3, 3), (5, 2, 2)),
)
PLASTERS = (
    ("ochre facade", (0.68, 0.46, 0.20), (0.70, 0.58, 0.40)),
    ("rose facade", (0.62, 0.33, 0.24), (0.68, 0.50, 0.40)),
    ("cream facade", (0.74, 0.66, 0.50), (0.62, 0.54, 0.42)),
    ("pale blue facade", (0.42, 0.52, 0.58), (0.58, 0.60, 0.58)),
)


def opening(width: float, height: float, window: tuple[float, float, float], depth: float = 0.18) -> Shape:
    """Return a piece of wall, x = +-width/2, y = 0 to ``height``, facing +z, with a recessed hole; open."""
    w, h, sill = window
    outer = np.array([[-width / 2, 0], [width / 2, 0], [width / 2, height], [-width / 2, height], [-width / 2, 0]])
    hole = np.array([[-w / 2, sill], [w / 2, sill], [w / 2, sill + h], [-w / 2, sill + h], [-w / 2, sill]])
    rings = [(outer, 0.0), (hole, 0.0), (hole, -depth)]
    grid = np.stack([np.column_stack([points, np.full(5, z)]) for points, z in rings])
    return loft(grid[:, ::-1], crease=20.0).box_mapped()


def window(shutter_angle: float) -> dict[str, Shape]:
    """Return what fills the window of ``opening``: "glass", "frame", "shutters", "stone" sill."""
    w, h, sill = WINDOW
    y = sill
    bars = [box((-w / 2, y, -0.18), (-w / 2 + 0.06, y + h, -0.1)), box((w / 2 - 0.06, y, -0.18), (w / 2, y + h, -0.1))]
    bars += [box((-w / 2, y + b, -0.18), (w / 2, y + b + 0.06, -0.1)) for b in (0.0, 0.62 * h, h - 0.06)]
    bars.append(box((-0.03, y, -0.17), (0.03, y + h, -0.11)))
    boards = [box((0, 0, 0.01), (w / 2, h, 0.045))]
    boards += [box((0.07, b, 0.005), (w / 2 - 0.07, b + 0.41 * h, 0.052)) for b in (0.06 * h, 0.53 * h)]
    blade = merge(boards)
    right = blade.turned(-shutter_angle).moved(w / 2, y, 0)
    left = blade.scaled(-1, 1, 1).turned(shutter_angle).moved(-w / 2, y, 0)
    return {
        "glass": quad((-w / 2, y, -0.16), (w, 0, 0), (0, h, 0)),
        "frame": merge(bars),
        "shutters": merge([right, left]),
        "stone": box((-w / 2 - 0.08, y - 0.08, -0.02), (w / 2 + 0.08, y, 0.09)),
    }


def balcony(width: float) -> dict[str, Shape]:
    """Return a balcony out of the wall z = 0 at y = 0: "stone" slab and brackets, "iron" railing."""
    deep = 0.85
    slab = box((-width / 2, -0.14, -0.05), (width / 2, 0.0, deep), 0.015)
    brackets = [box((x - 0.07, -0.42, -0.05), (x + 0.07, -0.14, 0.45)) for x in (-width / 2 + 0.2, width / 2 - 0.2)]
    bar = box((-0.008, 0.0, -0.008), (0.008, 0.95, 0.008))
    e = deep - 0.06
    posts = [(x, 0.0, e) for x in np.linspace(-width / 2 + 0.06, width / 2 - 0.06, round(width / 0.12))]
    posts += [(s * (width / 2 - 0.06), 0.0, z) for s in (-1, 1) for z in np.arange(0.06, e - 0.04, 0.12)]
    rails = [box((-width / 2 + 0.03, y, e - 0.02), (width / 2 - 0.03, y + 0.03, e + 0.02)) for y in (0.08, 0.95)]
    rails += [
        box((s - 0.02, y, 0.0), (s + 0.02, y + 0.03, e))
        for s in (-width / 2 + 0.06, width / 2 - 0.06)
        for y in (0.08, 0.95)
    ]
    return {"stone": merge([slab, *brackets]), "iron": merge([bar.at(posts), *rails])}


def house(bays: int, storeys: int, rng: np.random.Generator) -> dict[str, Shape]:
    """Return a house: facade in z = 0, x from 0 to bays * BAY, facing +z."""
    width, height = bays * BAY, GROUND + storeys * STOREY
    found: dict[str, list[Shape]] = {}

    def add(shapes: dict[str, Shape], x: float, y: float) -> None:
        for name, shape in shapes.items():
            found.setdefault(name, []).append(shape.moved(x, y, 0))

    wall = opening(BAY, STOREY, WINDOW)
    tall = (WINDOW[0], 2.3, 0.1)
    door_wall, shop_wall = opening(BAY, GROUND, (1.1, 2.6, 0.0), 0.3), opening(BAY, GROUND, (1.6, 2.3, 0.5), 0.25)
    door_bay = bays // 2
    for bay in range(bays):
        x = (bay + 0.5) * BAY
        if bay == door_bay:
            leaf = merge(
                [box((-0.55, 0, -0.3), (0.55, 2.6, -0.22), 0.01), box((-0.45, 0.3, -0.23), (0.45, 1.1, -0.2), 0.01)]
            )
            add({"wall": door_wall, "shutters": leaf, "stone": box((-0.7, -0.02, -0.3), (0.7, 0.13, 0.35), 0.02)}, x, 0)
        else:
            pane = quad((-0.8, 0.5, -0.24), (1.6, 0, 0), (0, 2.3, 0))
            mullions = [box((a - 0.04, 0.5, -0.25), (a + 0.04, 2.8, -0.17)) for a in (-0.76, 0.0, 0.76)]
            ledge = box((-0.9, 0.4, -0.02), (0.9, 0.5, 0.12), 0.01)
            add({"wall": shop_wall, "glass": pane, "frame": merge(mullions), "stone": ledge}, x, 0)
        for storey in range(storeys):
            y = GROUND + storey * STOREY
            has_balcony = storey < storeys - 1 and (bay + storey) % 2 == door_bay % 2
            pieces = window(rng.choice([8.0, 25.0, 140.0, 165.0], p=[0.15, 0.15, 0.2, 0.5]))
            if has_balcony:
                stretch = tall[1] / WINDOW[1]
                tall_pieces = {
                    k: s.moved(y=-WINDOW[2]).scaled(1, stretch, 1).moved(y=tall[2])
                    for k, s in pieces.items()
                    if k != "stone"
                }
                add({"wall": opening(BAY, STOREY, tall), **tall_pieces, **balcony(1.7)}, x, y)
            else:
                add({"wall": wall, **pieces}, x, y)
    for y, out, tallness in ((GROUND - 0.12, 0.10, 0.2), (height - 0.05, 0.28, 0.3)):
        add({"stone": box((-0.02, y, -0.1), (width + 0.02, y + tallness, out), 0.03)}, 0, 0)
    deep, peak = 9.0, height + 2.2
    sides = [box((0, 0, -deep), (width, height, -deep + 0.2)), box((0, 0, -deep), (0.2, height, -0.02))]
    sides += [
        box((width - 0.2, 0, -deep), (width, height, -0.02)),
        box((0.2, height - 0.2, -deep + 0.2), (width - 0.2, height, -0.02)),
    ]
    add({"wall": merge(sides)}, 0, 0)
    roof = loft(
        np.array(
            [
                [(0, height, 0.35), (0, peak, -deep / 2), (0, height, -deep - 0.3)],
                [(width, height, 0.35), (width, peak, -deep / 2), (width, height, -deep - 0.3)],
            ]
        ),
        crease=10.0,
    )
    gables = [
        Shape.of([(x, height, 0.0), (x, peak - 0.1, -deep / 2), (x, height, -deep)], [[0, 1, 2]])
        for x in (0.02, width - 0.02)
    ]
    add({"roof": roof, "wall": merge([gables[0], gables[1].flipped()])}, 0, 0)
    chimney = box((-0.35, 0, -0.35), (0.35, 2.0, 0.35), 0.02).moved(0.3 * width, height + 0.8, -deep / 2 - 0.9)
    add({"wall": chimney}, 0, 0)
    return {name: merge(shapes) for name, shapes in found.items()}


def ground() -> dict[str, Shape]:
    """Return the road, pavements and kerbs, and the land beyond."""
    far = LENGTH + 7.5
    road = quad((-KERB, 0, far), (2 * KERB, 0, 0), (0, 0, -2 * far)).box_mapped().textured(3.0)
    pavements = [
        box((s * KERB if s > 0 else -FRONT - 0.5, -0.1, -far), (FRONT + 0.5 if s > 0 else -KERB, 0.14, far))
        for s in (-1, 1)
    ]
    kerbs = [box((s * KERB - 0.15, -0.1, -far), (s * KERB + 0.15, 0.15, far), 0.02) for s in (-1, 1)]
    land = quad((-80, -0.12, 80), (160, 0, 0), (0, 0, -160))
    dash = box((-0.07, 0.0, -1.0), (0.07, 0.004, 1.0))
    return {
        "road": road,
        "pavement": merge(pavements).textured(2.0),
        "kerb": merge(kerbs).textured(2.0),
        "land": land,
        "paint": dash.at([(0, 0, z) for z in np.arange(-far + 2, far - 1, 4.0)]),
    }


def trees() -> dict[str, Shape]:
    """Return street trees, three kinds repeated, in square beds."""
    places = [(s * (KERB + 0.75), z) for s in (-1, 1) for z in (-24.0, -12.5, -1.0, 10.5)]
    found: dict[str, list[Shape]] = {"bark": [], "leaves": [], "soil": []}
    kinds = []
    for kind in range(3):
        trunk, tips = parts.branches(5.4, 1.7, 9, 0.12, seed=20 + kind)
        inner = 0.55 * tips + 0.45 * tips.mean(axis=0)
        centres = np.concatenate([tips, inner]) + np.array([0, 0.25, 0])
        leaves = parts.foliage(
            centres, np.r_[np.full(len(tips), 0.85), np.full(len(inner), 0.8)], 1900, 0.22, 30 + kind
        )
        kinds.append((trunk, leaves))
    for k, (x, z) in enumerate(places):
        trunk, leaves = kinds[k % 3]
        place = placement((x, 0.14, z), turn=77.0 * k, scale=0.9 + 0.05 * (k % 4))
        found["bark"].append(trunk.transformed(place))
        found["leaves"].append(leaves.transformed(place))
        found["soil"].append(box((x - 0.55, 0.0, z - 0.55), (x + 0.55, 0.15, z + 0.55), 0.005))
    return {name: merge(shapes) for name, shapes in found.items()}


def lamps() -> dict[str, Shape]:
    """Return street lamps: "iron" posts and unlit "globes"."""
    post = lathe([(0, 0), (0.14, 0), (0.14, 0.1), (0.07, 0.25), (0.05, 3.6), (0.09, 3.65), (0, 3.7)], 10)
    arm = tube(np.array([[0, 3.5, 0], [0.25, 3.85, 0], [0.6, 3.8, 0]]), 0.025, 6)
    cap = cylinder(0.13, 0.05, 12).moved(0.6, 3.75)
    iron, globe = merge([post, arm, cap]), icosphere(0.17, 1).moved(0.6, 3.58)
    places = [
        placement((s * (KERB + 0.4), 0.14, z), turn=0.0 if s < 0 else 180.0)
        for s in (-1, 1)
        for z in (-18.0, -6.5, 5.0, 16.5)
    ]
    return parts.plants(places, {"iron": iron, "globes": globe})


def scene() -> Scene:
    """Return the street in afternoon sun."""
    rng = np.random.default_rng(12)
    stone, iron = materials.limestone(), materials.plain("iron", (0.03, 0.03, 0.032), 0.5)
    plasters = [materials.plaster(name, color, worn, 150 + 2 * k) for k, (name, color, worn) in enumerate(PLASTERS)]
    shutters = [
        materials.plain("green shutters", (0.05, 0.14, 0.09), 0.6),
        materials.plain("blue shutters", (0.06, 0.13, 0.22), 0.6),
        materials.plain("brown shutters", (0.16, 0.08, 0.045), 0.6),
    ]
    common = {
        "stone": stone,
        "iron": iron,
        "glass": materials.plain("glass", (0.02, 0.025, 0.03), 0.06),
        "frame": materials.plain("window frames", (0.62, 0.60, 0.55), 0.6),
        "roof": materials.terracotta_tiles(),
        "road": materials.asphalt(),
        "pavement": materials.paving(),
        "kerb": stone,
        "land": materials.matte("land", (0.22, 0.20, 0.15)),
        "paint": materials.plain("road paint", (0.7, 0.7, 0.68), 0.7),
        "bark": materials.plain("bark", (0.16, 0.12, 0.085), 0.95),
        "leaves": materials.plain("leaves", (0.09, 0.19, 0.035), 0.5),
        "soil": materials.plain("soil", (0.06, 0.045, 0.03), 1.0),
        "globes": materials.plain("lamp globes", (0.8, 0.8, 0.76), 0.3),
    }
    sizes = {"stone": 2.0, "wall": 3.0, "roof": 2.4}
    groups = [("ground", ground(), common), ("trees", trees(), common), ("lamps", lamps(), common)]
    for side, row in zip((-1, 1), HOUSES, strict=True):
        z = -LENGTH
        for k, (bays, storeys, color) in enumerate(row):
            built = house(bays, storeys, rng)
            width = bays * BAY
            place = placement((side * FRONT, 0.14, z + width if side < 0 else z), turn=-90.0 * side)
            looks = {**common, "wall": plasters[color], "shutters": shutters[(k + color) % 3]}
            shapes = {
                name: s.textured(sizes.get(name, 1.0), (0.37 * k, 0.0)).transformed(place) for name, s in built.items()
            }
            groups.append((f"house {'left' if side < 0 else 'right'} {k}", shapes, looks))
            z += width
    end = house(8, 3, rng)
    place = placement((-4 * BAY, 0.14, -LENGTH - 7.0))
    shapes = {name: s.textured(sizes.get(name, 1.0)).transformed(place) for name, s in end.items()}
    groups.append(("house at the end", shapes, {**common, "wall": plasters[0], "shutters": shutters[0]}))
    nodes = [
        Node(name, [s.mesh(looks[key], f"{name} {key}") for key, s in shapes.items()]) for name, shapes, looks in groups
    ]
    cameras = {
        "main": Camera.look_at((-1.6, 1.75, 17.0), (0.6, 3.6, -8.0), hfov=70.0),
        "balcony": Camera.look_at((-6.4, 8.2, 6.0), (4.0, 3.5, -6.0), hfov=70.0),
    }
    return Scene(nodes, environment=as_environment(SKY), cameras=cameras, name="street")


def camera_path() -> CameraPath:
    """Return a walk down the street."""
    keys = (
        CameraKey(0.0, (-1.6, 1.75, 17.0), (0.6, 3.6, -8.0), hfov=70.0),
        CameraKey(47 / 24, (-1.2, 1.75, 14.6), (0.8, 3.6, -10.0), hfov=70.0),
    )
    return CameraPath(keys, name="street")
