"""Sky maps of files by other programs: layers, data windows, primaries, and the headers of Radiance pictures."""

import numpy as np
import OpenImageIO as oiio
import pytest
from PIL import Image

from warp_gi.color import SRGB_TO_LINEAR
from warp_gi.errors import SceneError
from warp_gi.scene.environment import Environment
from warp_gi.scene.sky_motion import SkySequence

WIDTH, HEIGHT = 8, 4


def picture(seed=0):
    return np.random.default_rng(seed).uniform(0.1, 2.0, (HEIGHT, WIDTH, 3)).astype(np.float32)


def spec_of(names, name="", width=WIDTH, height=HEIGHT, **attributes):
    spec = oiio.ImageSpec(width, height, len(names), "float")
    spec.channelnames = tuple(names)
    if name:
        spec.attribute("oiio:subimagename", name)
    for key, value in attributes.items():
        spec.attribute(key, oiio.TypeDesc(f"float[{len(value)}]"), value)
    return spec


def write(path, parts):
    """Write (spec, pixels) as the parts of an EXR file."""
    output = oiio.ImageOutput.create(str(path))
    specs = [spec for spec, _ in parts]
    assert output.open(str(path), specs[0]) if len(specs) == 1 else output.open(str(path), specs), output.geterror()
    for index, (spec, pixels) in enumerate(parts):
        if index:
            assert output.open(str(path), spec, "AppendSubimage"), output.geterror()
        assert output.write_image(np.ascontiguousarray(pixels)), output.geterror()
    output.close()
    return path


def layered(path, *prefixes):
    """Write one part with a layer of three channels for each prefix; layer i holds picture(i)."""
    names = [f"{prefix}.{c}" if prefix else c for prefix in prefixes for c in "RGB"]
    return write(path, [(spec_of(names), np.concatenate([picture(i) for i in range(len(prefixes))], axis=-1))])


@pytest.mark.parametrize(
    "prefixes, chosen",
    [
        (("albedo", "beauty"), 1),
        (("albedo", ""), 1),  # the one without a name is the picture itself
        (("beauty", ""), 1),
        (("View.Diffuse", "View.Combined"), 1),
        (("sky",), 0),
    ],
)
def test_the_beauty_of_several_layers_is_the_sky(tmp_path, prefixes, chosen):
    sky = Environment.load(layered(tmp_path / "sky.exr", *prefixes))
    assert np.array_equal(sky.pixels, picture(chosen))


def test_layers_are_chosen_by_name(tmp_path):
    file = layered(tmp_path / "sky.exr", "albedo", "beauty")
    assert np.array_equal(Environment.load(f"{file}:albedo").pixels, picture(0))
    assert np.array_equal(Environment.load(file, layer="albedo").pixels, picture(0))
    with pytest.raises(SceneError, match=r"no RGB layer is called 'albdo'; expected one of: albedo, beauty"):
        Environment.load(f"{file}:albdo")


def test_unclear_layers_are_listed(tmp_path):
    file = layered(tmp_path / "sky.exr", "diffuse", "specular")
    with pytest.raises(SceneError, match=r"2 layers are RGB .*\(diffuse, specular\); name one, as sky.exr:diffuse"):
        Environment.load(file)


def test_parts_of_a_file(tmp_path):
    names = ["N", "beauty", "Z"]
    parts = [(spec_of("RGB", names[i]), picture(i)) for i in range(2)]
    file = write(tmp_path / "sky.exr", [*parts, (spec_of("Z", names[2]), picture(2)[..., :1])])
    assert np.array_equal(Environment.load(file).pixels, picture(1))
    assert np.array_equal(Environment.load(f"{file}:N").pixels, picture(0))
    with pytest.raises(SceneError, match=r"no RGB layer is called 'Z'; expected one of: N, beauty"):
        Environment.load(f"{file}:Z")
    left = write(
        tmp_path / "eyes.exr", [(spec_of("RGB", name), picture(i)) for i, name in enumerate(("left", "right"))]
    )
    with pytest.raises(SceneError, match=r"\(left, right\)"):
        Environment.load(left)
    only = write(tmp_path / "only.exr", [(spec_of("Z", "depth"), picture(2)[..., :1]), parts[0]])
    assert np.array_equal(Environment.load(only).pixels, picture(0))


def test_a_layer_of_a_part(tmp_path):
    names = [f"{prefix}.{c}" for prefix in ("key", "fill") for c in "RGB"]
    both = np.concatenate([picture(0), picture(1)], axis=-1)
    file = write(tmp_path / "sky.exr", [(spec_of(names, "day"), both), (spec_of(names[:3], "night"), picture(2))])
    assert np.array_equal(Environment.load(f"{file}:day.fill").pixels, picture(1))
    assert np.array_equal(Environment.load(f"{file}:night").pixels, picture(2))
    with pytest.raises(
        SceneError, match=r"2 RGB layers are called 'key'; expected one of: day.fill, day.key, night.key"
    ):
        Environment.load(f"{file}:key")


def test_normals_and_depths_are_no_sky(tmp_path):
    file = write(tmp_path / "n.exr", [(spec_of(("N.X", "N.Y", "N.Z")), picture())])
    with pytest.raises(SceneError, match=r"no layer has red, green and blue \(channels: N.X, N.Y, N.Z\)"):
        Environment.load(file)
    for only in ("Z", "depth.Z", "objectId"):
        file = write(tmp_path / "z.exr", [(spec_of((only,)), picture()[..., :1])])
        with pytest.raises(SceneError, match=rf"no layer has red, green and blue \(channels: {only}\)"):
            Environment.load(file)
    grey = write(tmp_path / "y.exr", [(spec_of("YA"), picture()[..., :2])])
    assert np.array_equal(Environment.load(grey).pixels, np.repeat(picture()[..., :1], 3, axis=-1))


def test_deep_files_are_refused(tmp_path):
    spec = spec_of("RGBAZ")
    spec.deep = True
    data = oiio.DeepData()
    data.init(spec)
    output = oiio.ImageOutput.create(str(tmp_path / "deep.exr"))
    assert output.open(str(tmp_path / "deep.exr"), spec) and output.write_deep_image(data), output.geterror()
    output.close()
    with pytest.raises(SceneError, match=r"deep EXR.*flatten it"):
        Environment.load(tmp_path / "deep.exr")


@pytest.mark.parametrize(
    "x, y, width, height", [(2, 1, 4, 2), (-2, -1, 12, 7), (6, -3, 4, 5), (3, 2, 9, 2), (9, 9, 2, 2)]
)
def test_the_display_window_is_the_sky(tmp_path, x, y, width, height):
    spec = spec_of("RGB", width=width, height=height)
    spec.x, spec.y = x, y
    spec.full_x, spec.full_y, spec.full_width, spec.full_height = 0, 0, WIDTH, HEIGHT
    pixels = np.random.default_rng(1).uniform(0.1, 2, (height, width, 3)).astype(np.float32)
    expected = np.zeros((HEIGHT, WIDTH, 3), np.float32)
    for row in range(HEIGHT):
        for column in range(WIDTH):
            if 0 <= row - y < height and 0 <= column - x < width:
                expected[row, column] = pixels[row - y, column - x]
    assert np.array_equal(Environment.load(write(tmp_path / "sky.exr", [(spec, pixels)])).pixels, expected)


def test_a_display_window_off_the_origin(tmp_path):
    spec = spec_of("RGB")
    spec.x, spec.y, spec.full_x, spec.full_y, spec.full_width, spec.full_height = 5, 7, 5, 7, WIDTH, HEIGHT
    assert np.array_equal(Environment.load(write(tmp_path / "sky.exr", [(spec, picture())])).pixels, picture())


REC_2020 = (0.708, 0.292, 0.170, 0.797, 0.131, 0.046, 0.3127, 0.3290)
REC_709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
ACES_CG = (0.713, 0.293, 0.165, 0.830, 0.128, 0.044, 0.32168, 0.33767)
XYZ = (1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1 / 3, 1 / 3)


@pytest.mark.parametrize(
    "chromaticities, color, expected",
    [
        # ITU-R BT.2087: BT.709 red in BT.2020; and white
        (REC_2020, (0.6274, 0.0691, 0.0164), (1, 0, 0)),
        (REC_2020, (0.3293, 0.9195, 0.0880), (0, 1, 0)),
        (REC_709, (0.3, 0.2, 0.1), (0.3, 0.2, 0.1)),
        # ACES 1.0.3, AP1 to Rec. 709 with Bradford's adaptation; rows 1.70505 -0.62179 -0.08326, ...
        (ACES_CG, (1, 1, 1), (1, 1, 1)),
        (ACES_CG, (0.5, 0.3, 0.2), (0.6493, 0.2750, 0.1799)),
        # IEC 61966-2-1: white of sRGB; equal energy stays what it is
        (XYZ, (0.9505, 1.0, 1.0890), (1, 1, 1)),
        (XYZ, (1, 1, 1), (1.2048, 0.9483, 0.9089)),
    ],
)
def test_colors_come_in_the_primaries_of_the_renderer(tmp_path, chromaticities, color, expected):
    pixels = np.full((HEIGHT, WIDTH, 3), color, np.float32)
    sky = Environment.load(write(tmp_path / "sky.exr", [(spec_of("RGB", chromaticities=chromaticities), pixels)]))
    assert np.allclose(sky.pixels, expected, atol=1e-3)


def test_primaries_that_span_nothing(tmp_path):
    spec = spec_of("RGB", chromaticities=(0.3, 0.3) * 4)
    with pytest.raises(SceneError, match="span no colors"):
        Environment.load(write(tmp_path / "sky.exr", [(spec, picture())]))


def rgbe(values):
    """Return flat RGBE bytes of values that it can hold exactly: n / 16 below 8, for whole n."""
    codes = np.full((*values.shape[:2], 4), 131, np.uint8)
    codes[..., :3] = np.rint(values * 32)
    return codes.tobytes()


def radiance(path, values, header="FORMAT=32-bit_rle_rgbe\n", order="-Y 4 +X 8"):
    path.write_bytes(f"#?RADIANCE\n{header}\n{order}\n".encode() + rgbe(values))
    return path


EXACT = np.random.default_rng(3).integers(1, 128, (HEIGHT, WIDTH, 3)) / 16 / 1.0


def test_radiance_pictures_as_they_are(tmp_path):
    assert np.array_equal(Environment.load(radiance(tmp_path / "sky.hdr", EXACT)).pixels, EXACT)


def test_exposure_and_color_correction_are_taken_back(tmp_path):
    header = "EXPOSURE=2\nFORMAT=32-bit_rle_rgbe\nEXPOSURE= 4.0\nCOLORCORR= 2 1 0.5\nCOLORCORR=2 2 2\n"
    sky = Environment.load(radiance(tmp_path / "sky.hdr", EXACT, header))
    assert np.allclose(sky.pixels, EXACT / [32, 16, 8], rtol=1e-6)


@pytest.mark.parametrize("line", ["EXPOSURE=0", "EXPOSURE=two", "COLORCORR=1 1", "COLORCORR=1 -1 1", "EXPOSURE=nan"])
def test_exposures_that_are_none(tmp_path, line):
    with pytest.raises(SceneError, match=f"above 0, got '{line}'"):
        Environment.load(radiance(tmp_path / "sky.hdr", EXACT, f"FORMAT=32-bit_rle_rgbe\n{line}\n"))


@pytest.mark.parametrize("vertical", "-+")
@pytest.mark.parametrize("horizontal", "-+")
@pytest.mark.parametrize("columns_first", [False, True])
def test_every_orientation_of_a_radiance_picture(tmp_path, vertical, horizontal, columns_first):
    """X grows to the right and Y upwards: "-Y 4 +X 8" is stored from the top, and from the left in each line."""
    stored = EXACT[:: 1 if vertical == "-" else -1, :: 1 if horizontal == "+" else -1]
    axes = [f"{vertical}Y {HEIGHT}", f"{horizontal}X {WIDTH}"]
    if columns_first:
        stored, axes = stored.swapaxes(0, 1), axes[::-1]
    file = radiance(tmp_path / "sky.hdr", np.ascontiguousarray(stored), order=" ".join(axes))
    assert np.array_equal(Environment.load(file).pixels, EXACT)


def test_radiance_pictures_in_xyz(tmp_path):
    color = np.array([0.5, 0.75, 0.25])
    xyz = np.array(
        [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]]
    )
    values = np.broadcast_to(xyz @ color, (HEIGHT, WIDTH, 3))
    file = radiance(tmp_path / "sky.hdr", values, "EXPOSURE=2\nFORMAT=32-bit_rle_xyze\n")
    assert np.allclose(Environment.load(file).pixels, color / 2, atol=0.06)  # RGBE holds it in steps of 1 / 32


def test_primaries_of_a_radiance_picture(tmp_path):
    header = f"PRIMARIES= {' '.join(map(str, REC_2020))}\nFORMAT=32-bit_rle_rgbe\n"
    file = radiance(tmp_path / "sky.hdr", np.full((HEIGHT, WIDTH, 3), (2.0, 1.0, 1.0)), header)
    # BT.2087: 1.6605 -0.5876 -0.0728 / -0.1246 1.1329 -0.0083 / -0.0182 -0.1006 1.1187
    assert np.allclose(Environment.load(file).pixels[0, 0], (2.6606, 0.8754, 0.9817), atol=2e-3)


def test_a_layer_of_a_sequence(tmp_path):
    layered(tmp_path / "sky.0000.exr", "diffuse", "specular")
    assert np.array_equal(SkySequence(f"{tmp_path}/sky.####.exr:specular")(0.0).pixels, picture(1))


def test_a_colon_in_a_name(tmp_path):
    file = layered(tmp_path / "sky.exr", "").rename(tmp_path / "sky.exr:beauty")
    assert np.array_equal(Environment.load(file).pixels, picture(0))


def test_indented_lines_are_those_of_other_pictures(tmp_path):
    """Programs that combine pictures, as pcomb, keep the headers of those behind a tab."""
    lines = ["EXPOSURE=2", "COLORCORR=2 2 2", "FORMAT=32-bit_rle_xyze", f"PRIMARIES= {' '.join(map(str, REC_2020))}"]
    header = "".join(f"{line}\n" for line in ["FORMAT=32-bit_rle_rgbe", "EXPOSURE=4", *(f"\t{one}" for one in lines)])
    assert np.allclose(Environment.load(radiance(tmp_path / "sky.hdr", EXACT, header)).pixels, EXACT / 4, rtol=1e-6)


def test_headers_with_carriage_returns(tmp_path):
    stored = np.ascontiguousarray(EXACT[::-1, ::-1])
    file = radiance(tmp_path / "sky.hdr", stored, "EXPOSURE=2\nFORMAT=32-bit_rle_rgbe\n", "+Y 4 -X 8")
    file.write_bytes(file.read_bytes().replace(b"\n", b"\r\n", 5))
    assert np.allclose(Environment.load(file).pixels, EXACT / 2)


def test_layers_with_a_slash(tmp_path):
    file = layered(tmp_path / "sky.exr", "key/left", "fill:a.b/c")
    assert np.array_equal(Environment.load(f"{file}:key/left").pixels, picture(0))
    assert np.array_equal(Environment.load(f"{file}:fill:a.b/c").pixels, picture(1))
    file.rename(tmp_path / "sky.0000.exr")
    assert np.array_equal(SkySequence(f"{tmp_path}/sky.####.exr:key/left")(0.0).pixels, picture(0))


def test_channels_of_a_layer_in_any_order(tmp_path):
    names = ["A", "Z", "B", "R", "G", "U"]
    pixels = np.random.default_rng(4).uniform(0.1, 2, (HEIGHT, WIDTH, 6)).astype(np.float32)
    sky = Environment.load(write(tmp_path / "sky.exr", [(spec_of(names), pixels)]))
    assert np.array_equal(sky.pixels, pixels[..., [3, 4, 2]])
    sky = Environment.load(write(tmp_path / "sky.tif", [(spec_of("RGB"), picture())]))
    assert np.array_equal(sky.pixels, picture())


def test_a_data_window_that_is_too_large(tmp_path):
    spec = spec_of("RGB", width=17_000, height=1)
    spec.x, spec.full_x, spec.full_y, spec.full_width, spec.full_height = 0, 0, 0, WIDTH, HEIGHT
    file = write(tmp_path / "sky.exr", [(spec, np.zeros((1, 17_000, 3), np.float32))])
    with pytest.raises(SceneError, match="data window is 17000x1, at most 16384 a side"):
        Environment.load(file)


def with_runs(values):
    """Return RGBE bytes in the coding of before 1991: a pixel 1, 1, 1, n is n more of the one before."""
    flat = np.frombuffer(rgbe(values), np.uint8).reshape(-1, 4)
    coded, at = [], 0
    while at < len(flat):
        end = at
        while end < len(flat) and (flat[end] == flat[at]).all():
            end += 1
        coded.append(flat[at].tobytes())
        more = end - at - 1
        while more:
            coded.append(bytes((1, 1, 1, more % 256)))
            more //= 256
        at = end
    return b"".join(coded)


@pytest.mark.parametrize("runs", [1, 5, 64, 700])
def test_the_first_run_length_coding_of_radiance(tmp_path, runs):
    width, height = 64, 32
    values = EXACT.reshape(-1, 3)[: max(width * height // runs, 1)]
    values = np.resize(np.repeat(values, runs, axis=0), (height, width, 3))
    head = f"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\nEXPOSURE=2\n\n-Y {height} +X {width}\n".encode()
    path = tmp_path / "sky.hdr"
    path.write_bytes(head + with_runs(values))
    assert np.array_equal(Environment.load(path).pixels, np.float32(values / 2))
    path.write_bytes(head + with_runs(values)[:-9])
    with pytest.raises(SceneError, match="damaged or cut short"):
        Environment.load(path)


def test_whole_numbers_are_ids_and_no_light(tmp_path):
    spec = oiio.ImageSpec(WIDTH, HEIGHT, 3, "uint")
    spec.channelnames = ("R", "G", "B")
    path = write(tmp_path / "sky.exr", [(spec, (picture() * 9).astype(np.uint32))])
    with pytest.raises(SceneError, match="the channels of RGB are whole numbers, as ids are; expected half or float"):
        Environment.load(path)


def test_ids_beside_colors_leave_them_linear(tmp_path):
    spec = spec_of(["R", "G", "B", "id"])
    spec.channelformats = ("half", "half", "half", "uint")
    pixels = np.dstack([picture(), np.full((HEIGHT, WIDTH), 7.0, np.float32)])
    loaded = Environment.load(write(tmp_path / "sky.exr", [(spec, pixels)])).pixels
    np.testing.assert_allclose(loaded, picture(), rtol=1e-3)


def test_pictures_of_webp(tmp_path):
    colors = np.zeros((8, 16, 3), np.uint8)
    colors[:4], colors[4:] = (200, 100, 50), (20, 40, 80)
    Image.fromarray(colors).save(tmp_path / "sky.webp", lossless=True)
    np.testing.assert_allclose(Environment.load(tmp_path / "sky.webp").pixels, SRGB_TO_LINEAR[colors], atol=1e-6)
