"""Baked light field probes as atlases for other programs, and as pictures: their maps, places, and a ray's path."""

import json
from dataclasses import replace

import numpy as np
import pytest
import warp as wp
from PIL import Image

import warp_gi as gi
from warp_gi import launch
from warp_gi.kernels import light_field as field_kernels
from warp_gi.kernels.octahedral import octahedral_encode, octahedral_texel
from warp_gi.scene.builtin import builtin_camera_path
from warp_gi.sequence.preview import tone_map
from warp_gi.techniques.light_field import export, pictures
from warp_gi.techniques.light_field import ray as rays
from warp_gi.techniques.shared.legends import exposure_of
from warp_gi.techniques.shared.octahedral import encode

wp.set_module_options({"enable_backward": False})

CPU = launch.get_device("cpu")
SETTINGS = gi.LightFieldProbes(
    counts=(3, 3, 2), resolution=32, irradiance_resolution=8, rays=2, bounces=3, relocate=False
)


@pytest.fixture(scope="module")
def scene():
    scene = gi.builtin_scene("cornell_box")
    scene.environment = (0.2, 0.3, 0.4)
    return scene


@pytest.fixture(scope="module")
def bake(scene):
    """Probes that see walls, a lamp, and the sky; one of them said to be covered."""
    bake = gi.bake(scene, SETTINGS, seed=1)
    assert not bake.arrays["states"].any() and len(bake.arrays["emission_texels"])
    bake.arrays["states"][4] = int(field_kernels.PROBE_COVERED)
    return bake


@pytest.fixture(scope="module")
def state(scene, bake):
    return SETTINGS.start(scene, "cpu", bake)


@pytest.fixture(scope="module")
def exported(bake, tmp_path_factory):
    return export.export_atlases(bake, tmp_path_factory.mktemp("export") / "box.exr")


# ---- atlases ----


@wp.struct
class Said:
    radiance: wp.array(dtype=wp.vec3)
    normal: wp.array(dtype=wp.vec3)
    distance: wp.array(dtype=wp.float32)
    irradiance: wp.array(dtype=wp.vec3)
    moments: wp.array(dtype=wp.vec2)


# Thread: a direction from a probe. What the library's own lookups say of it.
@wp.kernel
def look_up_probes(
    first: wp.int32,
    field: field_kernels.LightField,
    probes: wp.array(dtype=wp.int32),
    directions: wp.array(dtype=wp.vec3),
    said: Said,
):
    i = first + wp.tid()
    uv = octahedral_encode(directions[i])
    texel = probes[i] * field.resolution * field.resolution + octahedral_texel(uv, field.resolution)
    said.radiance[i] = field_kernels.unpack_radiance(field.radiance[texel]) + field_kernels.texel_emission(field, texel)
    said.normal[i] = field_kernels.surfel_normal(field.surfels[texel])
    said.distance[i] = field_kernels.surfel_distance(field.surfels[texel])
    said.irradiance[i] = field_kernels.probe_irradiance(field, probes[i], uv)
    said.moments[i] = field_kernels.probe_moments(field, probes[i], uv)


def probes_say(state, probes, directions):
    said = Said()
    for name, variable in Said.vars.items():
        setattr(said, name, wp.zeros(len(probes), dtype=variable.type.dtype, device=CPU))
    inputs = [wp.array(probes, dtype=wp.int32, device=CPU), wp.array(directions, dtype=wp.vec3, device=CPU)]
    launch.launch(look_up_probes, len(probes), [state.field, *inputs, said], CPU)
    return {name: getattr(said, name).numpy().reshape(len(probes), -1) for name in Said.vars}


def some_directions(count):
    """Unit vectors, half of them by the edges of the map and the planes along which it is folded."""
    directions = np.random.default_rng(3).normal(size=(count, 3))
    directions[: count // 4, 1] = np.abs(directions[: count // 4, 1]) * -50  # by the corners
    directions[count // 4 : count // 2, 2] *= 1e-3
    return (directions / np.linalg.norm(directions, axis=1, keepdims=True)).astype(np.float32)


def test_a_lookup_through_the_export_is_the_library_own(state, exported):
    count = 20_000
    directions = some_directions(count)
    probes = (np.arange(count) % 18).astype(np.int32)
    images, info = export.read_atlases(exported[-1])
    theirs = probes_say(state, probes, directions)
    theirs["distance"][theirs["distance"] >= 65536] = np.inf
    theirs["moments"] = np.pad(theirs["moments"], ((0, 0), (0, 1)))
    assert np.isinf(theirs["distance"]).any() and theirs["radiance"].max() > 5  # the sky, the lamp
    for name, atlas in info["atlases"].items():
        ours = export.look_up(images, info, name, probes, directions)
        tolerance = 1e-5 if atlas["filter"] == "linear" else 1e-3  # half floats
        is_same = np.isclose(ours, theirs[name], rtol=tolerance, atol=tolerance).all(axis=1)
        # by a rounding on the border of two texels; filtered values change steadily there
        assert (~is_same).mean() <= (0 if atlas["filter"] == "linear" else 1e-3), name
        assert len(np.unique(ours, axis=0)) > 100, name


def test_the_description_is_complete(bake, exported):
    info = json.loads(exported[-1].read_text())
    assert [path.name for path in exported] == [*(a["file"] for a in info["atlases"].values()), "box.json"]
    assert info["grid"]["counts"] == {"x": 3, "y": 3, "z": 2} and info["covered"] == [4]
    np.testing.assert_array_equal(np.float32(info["positions"]), bake.arrays["positions"])
    x, y, z = 2, 1, 1
    index = (z * 3 + y) * 3 + x
    regular = [info["grid"]["low"][a] + info["grid"]["spacing"][a] * k for a, k in zip("xyz", (x, y, z), strict=True)]
    np.testing.assert_allclose(info["positions"][index], regular, rtol=1e-6)
    assert set(info["atlases"]) | {"probes", "tiles", "map", "padding", "filter"} == set(info["how_to_read"])
    images, _ = export.read_atlases(exported[-1])
    for name, image in images.items():
        atlas = info["atlases"][name]
        tile = atlas["size"] + 2 * info["padding"]
        assert image.shape == (info["rows"] * tile, info["columns"] * tile, len(atlas["channels"]))
        assert image.dtype == {"half": np.float16, "float": np.float32}[atlas["type"]]


def test_equal_bakes_export_equal_files(bake, exported, tmp_path):
    for old, new in zip(exported, export.export_atlases(bake, tmp_path / "box.exr"), strict=True):
        assert old.read_bytes() == new.read_bytes()


def test_radiance_past_the_range_of_half_floats_is_clipped(bake, tmp_path):
    brightest = {name: np.full_like(bake.arrays[name], 0xFFFFFFFF) for name in ("radiance", "emission")}
    arrays = {**bake.arrays, **brightest}
    files = export.export_atlases(replace(bake, arrays=arrays), tmp_path / "a.exr")
    images, _ = export.read_atlases(files[-1])
    assert images["radiance"].max() == 65504 and np.isfinite(images["radiance"]).all()


def test_a_failed_export_leaves_the_old_one(bake, tmp_path, monkeypatch):
    files = export.export_atlases(bake, tmp_path / "a.exr")
    before = [path.read_bytes() for path in files]
    arrays = {**bake.arrays, "irradiance": 2 * bake.arrays["irradiance"]}
    write = export.write_parts

    def fail(part, path, *rest):
        if "moments" in path.name:
            raise OSError(f"cannot write {path}: no space")
        write(part, path, *rest)

    monkeypatch.setattr(export, "write_parts", fail)
    with pytest.raises(OSError, match="no space"):
        export.export_atlases(replace(bake, arrays=arrays), tmp_path / "a.exr")
    assert [path.read_bytes() for path in files] == before
    assert sorted(tmp_path.iterdir()) == sorted(files)


def test_what_cannot_be_exported_is_refused(scene, bake, exported, tmp_path):
    field = replace(bake, technique="VisibilityField")
    with pytest.raises(gi.BakeError, match=r"only bakes of LightFieldProbes have atlases, this one is of VisibilityF"):
        export.export_atlases(field, tmp_path / "a.exr")
    with pytest.raises(gi.OptionError, match=r"cannot write a.png: .* give NAME.exr"):
        export.export_atlases(bake, tmp_path / "a.png")
    assert not list(tmp_path.iterdir())
    (tmp_path / "a.json").write_bytes(exported[-1].read_bytes())
    with pytest.raises(OSError, match=r"box.radiance.exr: expected a whole EXR file beside a.json"):
        export.read_atlases(tmp_path / "a.json")
    (tmp_path / "box.radiance.exr").write_bytes(exported[0].read_bytes()[:-500])
    with pytest.raises(OSError, match=r"box.radiance.exr: expected a whole EXR file beside a.json"):
        export.read_atlases(tmp_path / "a.json")


# ---- pictures ----


@pytest.fixture(scope="module")
def shown(scene, bake, tmp_path_factory):
    camera = builtin_camera_path("cornell_box").camera(0).at_resolution(480, 360)
    paths = pictures.write_pictures(scene, camera, bake, SETTINGS, tmp_path_factory.mktemp("pictures") / "new", seed=1)
    return camera, {path.stem: np.asarray(Image.open(path)) for path in paths}


def test_sheets_show_the_maps(bake, shown):
    _, images = shown
    assert set(images) == {"radiance", "distance", "normal", "irradiance", "places", "seen", "ray"}
    exposure = exposure_of(bake.arrays["irradiance"].astype(np.float64) / np.pi)
    makers = export.probe_maps(bake)
    columns = pictures._sheet_columns(3, 18)
    zoom = 1600 // (columns * 32)
    expected = tone_map(makers["radiance"](13).reshape(32, 32, 3).astype(np.float32), exposure)
    tile = 32 * min(zoom, 8) + 2
    x, y = 13 % columns * tile, 13 // columns * tile
    part = images["radiance"][y : y + tile - 2, x : x + tile - 2]
    found = part[min(zoom, 8) // 2 :: min(zoom, 8), min(zoom, 8) // 2 :: min(zoom, 8)]
    np.testing.assert_array_equal(found[8:], expected[8:])  # below its number
    covered = images["radiance"][4 // columns * tile :, 4 % columns * tile :][: tile - 2, : tile - 2]
    assert (covered[(tile - 2) // 2, (tile - 2) // 2] == 255).all()  # crossed out
    sky = (images["distance"].reshape(-1, 3) == pictures.SKY_COLOR).all(1).mean()
    assert 0.02 < sky < 0.9
    colors = {tuple(c) for c in images["irradiance"].reshape(-1, 3)}
    assert {rays.probe_color(probe) for probe in range(18)} <= colors


def test_places_are_where_the_camera_sees_them(scene, bake, shown):
    camera, images = shown
    settings = replace(SETTINGS, mode="irradiance")
    frame = next(gi.render(scene, camera, gi.Pipeline(indirect=settings, spp=1), bakes=[bake]))
    seen = np.linalg.norm(frame.numpy("position") - camera.position, axis=-1)
    seen[np.isinf(frame.numpy("depth"))] = np.inf
    counts = {"seen": 0, "hidden": 0}
    for probe, position in enumerate(bake.arrays["positions"]):
        (x, y), distance = camera.project(position[None])[0].astype(int), np.linalg.norm(position - camera.position)
        if not (5 < x < 475 and 5 < y < 355) or probe == 4 or abs(distance - seen[y, x]) < 0.02:
            continue
        is_disc = tuple(images["places"][y, x]) == rays.probe_color(probe)
        nearer = [
            q for q in range(18) if np.linalg.norm(camera.project(bake.arrays["positions"][[q]])[0] - (x, y)) < 24
        ]
        if nearer == [probe]:  # no other disc or number over it
            assert is_disc == (distance < seen[y, x]), probe
            counts["seen" if is_disc else "hidden"] += 1
    assert counts["seen"] >= 5 and counts["hidden"] >= 1, counts


# ---- a ray ----


def random_rays(count):
    rng = np.random.default_rng(4)
    directions = rng.normal(size=(count, 3))
    return rng.uniform((-0.9, 0.1, -0.9), (0.9, 1.9, 0.9), (count, 3)), directions / np.linalg.norm(
        directions, axis=1, keepdims=True
    )


def test_looks_are_those_that_the_march_counts(state):
    """Texels are within the block looked at before, cells are where the ray is, and numbers are the march's own."""
    size, block = 32, int(field_kernels.BLOCK)
    positions = state.field.positions.numpy().astype(np.float64)
    visited = []
    for origin, direction in zip(*random_rays(60), strict=True):
        looks, hit = rays.ray_looks(state, origin, direction)
        steps, blocks, probes = hit["counts"]
        assert [sum(look.level == level for look in looks) for level in (0, 1)] == [steps, blocks]
        visits = [look.visit for look in looks]
        assert visits == sorted(visits) and visits[0] == 1 and visits[-1] <= probes
        visited.append(len(set(visits)))
        for number, look in enumerate(looks):
            assert state.field.states.numpy()[look.probe] == 0
            before = looks[number - 1] if number and visits[number - 1] == look.visit else None
            assert look.level == 1 or before is not None  # each probe is asked by blocks first
            assert before is None or (look.t >= before.t - 1e-6 and look.probe == before.probe)
            across = size // block if look.level else size
            corner = np.array([look.cell % across, look.cell // across]) / across
            at = encode(origin + direction * (look.t + 1e-5) - positions[look.probe])
            assert (at > corner - 2e-3).all() and (at < corner + 1 / across + 2e-3).all(), (number, look)
            if look.level:
                inside = look.cell
            else:
                assert (look.cell // size // block) * (size // block) + look.cell % size // block == inside
    assert max(visited) >= 3 and min(visited) == 1


def test_probes_are_asked_from_the_one_nearest_to_the_line_by_steps_of_three(state):
    """Within a cage: first the corner nearest to the ray's line, then corner (i + 3) mod 8 (section 4.1)."""
    positions, low, spacing = state.field.positions.numpy().astype(np.float64), state.grid.low, state.grid.spacing
    offsets = np.array([[corner & 1, corner >> 1 & 1, corner >> 2 & 1] for corner in range(8)])
    seconds = 0
    for origin, direction in zip(*random_rays(300), strict=True):
        cage_at = lambda t: np.clip(np.floor((origin + direction * t - low) / spacing), 0, (1, 1, 0)).astype(int)  # noqa: B023, E731
        x, y, z = (cage_at(0) + offsets).T
        corners = (z * 3 + y) * 3 + x
        away = np.linalg.norm(np.cross(positions[corners] - origin, direction), axis=1)
        usable = corners != 4
        looks, _ = rays.ray_looks(state, origin, direction)
        first = int(np.flatnonzero(corners == looks[0].probe)[0])
        assert away[first] < away[usable].min() + 1e-5
        later = [look for look in looks if look.visit == 2]
        if later and usable[(first + 3) % 8] and (cage_at(later[0].t - 1e-5) == cage_at(0)).all():
            if (cage_at(later[0].t + 1e-5) == cage_at(0)).all():
                assert later[0].probe == corners[(first + 3) % 8]
                seconds += 1
    assert seconds >= 5


def test_a_drawn_ray_shows_its_looks(state):
    """The middle of each texel that the ray was tested against is drawn in its colour, that of no other is."""
    drawn = 0
    for origin, direction in zip(*random_rays(6), strict=True):
        looks, hit = rays.ray_looks(state, origin, direction)
        image = rays.draw_ray(state, origin, 3 * direction, exposure=1.0)
        visits = sorted({look.visit for look in looks})
        zoom = rays.PANEL_PIXELS // 32
        side = 32 * zoom
        across = min(len(visits), rays.PICTURE_PIXELS // (side + 12))
        if len(visits) > across:
            continue  # in several rows
        for panel, visit in enumerate(visits):
            x = panel * (side + 12)
            middles = image[zoom // 2 : side : zoom, x + zoom // 2 : x + side : zoom]
            green = set(np.flatnonzero((middles == rays.FINE_COLOR).all(-1)).tolist())
            texels = {look.cell for look in looks if look.visit == visit and look.level == 0}
            assert green <= texels
            assert len(texels - green) <= 4  # below the dots where it starts and hits
            drawn += len(green)
        has_hit = (image[:side] == rays.HIT_COLOR).all(-1).any()
        assert has_hit == (hit["results"] == 1)
    assert drawn > 20


def test_a_ray_that_is_none_is_refused(state):
    for origin, direction in (((0, 0, 0), (0, 0, 0)), ((0, np.nan, 0), (1, 0, 0)), ((0, 0), (1, 0, 0))):
        with pytest.raises(gi.OptionError, match="expected the ray's origin and a direction above zero"):
            rays.draw_ray(state, origin, direction)


def test_a_ray_outside_meets_nothing(state):
    image = rays.draw_ray(state, (50, 50, 50), (0, 1, 0))
    assert image.shape[1] >= rays.PANEL_PIXELS and (image[:20] == 230).any()
