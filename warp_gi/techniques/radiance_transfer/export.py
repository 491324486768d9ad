"""Baked transfer textures for other programs: EXR images, a glTF file of the surfaces, and JSON that says how to read.

A page and side of the atlas is an image. NAME.exr has a part for each, whose channels are the coefficients;
NAME.rgba.exr has the same numbers four to a part, for programs that know no other channels than R, G, B and A.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from warp_gi.baking import Bake
from warp_gi.errors import OptionError
from warp_gi.files import replacing
from warp_gi.scene.scene import Scene
from warp_gi.techniques.radiance_transfer.pca import CompressedBounces, compress_bounces
from warp_gi.techniques.radiance_transfer.textures import LIGHT_NUMBERS, TransferTextures, transfer_textures
from warp_gi.techniques.shared.atlas.gltf import generator_of, glb
from warp_gi.techniques.shared.exports import check_own
from warp_gi.techniques.shared.exr_parts import Part, write_exr_parts
from warp_gi.techniques.shared.octahedral_atlas import warn_if_too_large

FORMAT = "warp_gi transfer textures"
"""What all files say that they are."""
FORMAT_VERSION = 1
SIDES = ("front", "back")
MASK = ("Y",)
LAMPS = ("R", "G", "B")
DIGEST = "warp_gi:bake"
"""Text in the EXR files that names the bake, as the JSON file does: so parts of two exports are told apart."""
HEAD = 1 << 16
"""Bytes at the start of a file in which it says by whom it is."""

TEXT = {
    "shade": "Light that a Lambertian surface of reflectance rho reflects, W/(m^2 sr), for each of red, green and "
    "blue: rho / pi * (sum_j L_j * (T_j + B_j) + lamps), j from 0 to 24. L_j are the coefficients of the sky's "
    "radiance. Clamp sum_j L_j T_j and sum_j L_j B_j at 0: few harmonics swing below it. T alone is what comes "
    "directly from the sky, B over other surfaces.",
    "harmonics": "Real, orthonormal, without the Condon-Shortley sign; polar axis z in the world's axes, which "
    "are metres, y up, right-handed. Function j = l * l + l + m is of band l and degree m from -l to l: Y_0 = "
    "0.282095, Y_1 = 0.488603 y, Y_2 = 0.488603 z, Y_3 = 0.488603 x, Y_4 = 1.092548 x y, Y_6 = 0.315392 (3 z z - 1), "
    "Y_8 = 0.546274 (x x - y y). L_j is the integral of radiance times Y_j over the sphere. To turn the sky, turn its "
    "coefficients.",
    "transfer": "T_j, sr: the integral over directions w from which the sky is seen of max(n . w, 0) * Y_j(w), n "
    "being the shading normal. The cosine is in it: do not fold it in again. Of order 6 there are 36; diffuse light "
    "takes 25.",
    "bounces": "B_j of each colour, sr: transfer of light that other surfaces reflected, any number of times. The "
    "reflectance of these surfaces is in it, that of the surface itself is not. B.r.00 is red's first.",
    "components": "Where there are `components`, the 75 numbers of bounces (25 of red, then green, blue) are "
    "sum_i P_i * basis[i]. Filter P first, then expand.",
    "lamps": "Irradiance, W/m^2, by light of the scene's own emitters that was reflected before. No sky changes it.",
    "mask": "1 where texels are kept, else 0; all others are 0 there. After any linear filter (bilinear, mipmaps) "
    "divide by the filtered mask: then texels that are not kept count for nothing. Where it is 0, nothing is known.",
    "coordinates": "TEXCOORD_1 of the glTF file, (u, v), v down as glTF has it: texel column u * width - 0.5, row "
    "v * height - 0.5, where whole numbers are middles of texels and row 0 is the first row of the image, at the top.",
    "pages": "Each page is an atlas of its own size. The node of the glTF file whose extras have this `page` is "
    "on it. Primitives of the node `no page` have no transfer textures.",
    "sides": "front: seen from where a triangle's corners run counter-clockwise. back: seen from behind, with the "
    "coordinates of the front; only pages that are seen from behind have it. Where its mask is 0, nobody was thought "
    "to look from that side.",
    "rgba": "The same numbers in `rgba_file`, four to a part: R, G, B, A of part i are coefficients 4 i to 4 i + "
    "3, in the order of `channels`; those past the last are 0. A is no opacity. Of the mask all four are the mask.",
}


class PageImage(NamedTuple):
    """An image of one kind of numbers, for one page and side."""

    page: int
    """Number of the page."""
    side: int
    """0 front, 1 back."""
    kind: str
    """ "transfer", "mask", "bounces" or "lamps"."""
    channels: tuple[str, ...]
    """Names of the channels."""
    size: tuple[int, int]
    """Width and height."""
    pixels: Callable[[], np.ndarray]
    """Returns float16 or float32 [height, width, channel]; row 0 is the first row of the image."""
    type: str
    """Type of the numbers: "half" or "float"."""

    @property
    def name(self) -> str:
        """Name of the part in NAME.exr."""
        return f"page{self.page}.{SIDES[self.side]}.{self.kind}"

    def fours(self) -> Iterator[Part]:
        """Yield the parts in NAME.rgba.exr."""
        for first in range(0, len(self.channels), 4):
            yield Part(f"{self.name}.{first // 4}", "RGBA", self.size, partial(self._four, first), self.type)

    def _four(self, first: int) -> np.ndarray:
        pixels = self.pixels()
        if self.kind == "mask":
            return np.repeat(pixels, 4, axis=2)
        pixels = pixels[..., first : first + 4]
        return np.pad(pixels, ((0, 0), (0, 0), (0, 4 - pixels.shape[2])))


def channel_names(prefix: str, count: int) -> tuple[str, ...]:
    """Return "T.00", "T.01" ...: two digits, as files sort channels by name."""
    return tuple(f"{prefix}.{index:02d}" for index in range(count))


def exported_files(path: str | Path) -> dict[str, Path]:
    """Return the files of an export by what they are called in its description; "description" is the last."""
    path = Path(path)
    return {
        "file": path,
        "rgba_file": path.with_name(f"{path.stem}.rgba.exr"),
        "surfaces": path.with_name(f"{path.stem}.glb"),
        "description": path.with_name(f"{path.stem}.json"),
    }


def check_export_name(path: str | Path) -> None:
    """Raise OptionError unless ``path`` names an .exr file, beside which no file of another's would be overwritten.

    An export of hall.exr also writes hall.glb, which may be the scene; over an earlier export it may write.
    """
    path = Path(path)
    if path.suffix.lower() != ".exr":
        raise OptionError(f"cannot write {path.name}: transfer textures are .exr files; give NAME.exr")
    check_own(exported_files(path).values(), _says_so)


def _says_so(file: Path) -> bool:
    if file.suffix == ".json":
        return bool(json.loads(file.read_text())["format"] == FORMAT)
    if file.suffix == ".glb":
        return generator_of(file) == FORMAT
    with open(file, "rb") as opened:
        return DIGEST.encode() in opened.read(HEAD)


def page_images(
    textures: TransferTextures, bounces: CompressedBounces | None = None, kinds: Sequence[str] = ()
) -> list[PageImage]:
    """Return all images of transfer textures, by page, side and kind.

    ``bounces`` are the bounces compressed, in place of what the textures have. ``kinds`` are those that are wanted;
    none is all. Raises OptionError for transfer at vertices, which has no images.
    """
    atlas = textures.atlas
    rows: dict[str, tuple[np.ndarray, tuple[str, ...]]] = {}
    if not len(atlas.pages):
        raise OptionError('transfer at vertices has no images; bake with storage "texture" to export it')
    rows["mask"] = np.ones((atlas.count, 1), np.float16), MASK
    rows["transfer"] = textures.transfer, channel_names("T", textures.transfer.shape[1])
    if bounces is not None:
        rows["bounces"] = bounces.coefficients, channel_names("P", bounces.coefficients.shape[1])
    elif len(textures.bounces):
        names = tuple(name for color in "rgb" for name in channel_names(f"B.{color}", LIGHT_NUMBERS))
        rows["bounces"] = textures.bounces.reshape(atlas.count, -1), names
    if len(textures.lamps):
        rows["lamps"] = textures.lamps, LAMPS
    images = []
    for page, (first, width, height) in enumerate(atlas.pages.tolist()):
        for side in range(len(SIDES)):
            slots = atlas.slots[side, first : first + width * height]
            if side and not (slots >= 0).any():
                continue
            for kind, (values, names) in rows.items():
                if kind in kinds or not kinds:
                    maker = partial(_image, values, slots, (height, width))
                    scale = "float" if values.dtype == np.float32 else "half"
                    images.append(PageImage(page, side, kind, names, (width, height), maker, scale))
    return images


def _image(values: np.ndarray, slots: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Return rows of ``values`` [slot, channel] at the texels that have a slot, 0 elsewhere."""
    image = np.zeros((len(slots), values.shape[1]), values.dtype)
    kept = slots >= 0
    image[kept] = values[slots[kept]]
    return image.reshape(*shape, -1)


def export_textures(bake: Bake, path: str | Path, scene: Scene, components: int = 0) -> list[Path]:
    """Write transfer textures as NAME.exr, NAME.rgba.exr, NAME.glb and NAME.json; return the paths, the JSON file last.

    Args:
        bake: Bake of RadianceTransfer, with texels.
        path: NAME.exr.
        scene: Scene that was baked: its surfaces are in the glTF file, at time 0.
        components: Number of principal components that bounces are written as; 0 writes all 75 numbers.

    Files of an earlier export stay until all new ones are whole. Raises OptionError for other names, and a bake at
    vertices or without the bounces that are to be compressed; BakeError for a bake of another technique or scene;
    OSError when nothing can be written.
    """
    path = Path(path)
    check_export_name(path)
    textures = transfer_textures(bake)
    compressed = compress_bounces(textures.bounces, components) if components else None
    images = page_images(textures, compressed)
    largest = max(max(image.size) for image in images)
    warn_if_too_large(path.name, largest, largest, "use a lower resolution")
    files = exported_files(path)
    description = files.pop("description")
    digest = {DIGEST: bake.digest}
    surfaces = glb(scene, textures.atlas, FORMAT)
    with ExitStack() as stack:  # it renames in reverse: the description last
        text = stack.enter_context(replacing(description))
        parts = {name: stack.enter_context(replacing(file)) for name, file in files.items()}
        wholes = [Part(image.name, image.channels, image.size, image.pixels, image.type) for image in images]
        write_exr_parts(parts["file"], path, wholes, digest)
        fours = [part for image in images for part in image.fours()]
        write_exr_parts(parts["rgba_file"], files["rgba_file"], fours, digest)
        parts["surfaces"].write_bytes(surfaces)
        text.write_text(_description(bake, textures, images, compressed, files))
        description.unlink(missing_ok=True)  # while files of two exports may stand beside each other
    return [*files.values(), description]


def _description(
    bake: Bake,
    textures: TransferTextures,
    images: Sequence[PageImage],
    compressed: CompressedBounces | None,
    files: dict[str, Path],
) -> str:
    """Return the text of an export's JSON file."""
    info: dict[str, Any] = {
        "format": FORMAT,
        "version": FORMAT_VERSION,
        "scene": bake.scene_name,
        "bake": bake.digest,
        **{name: file.name for name, file in files.items()},
        "order": round(textures.transfer.shape[1] ** 0.5),
        "light_order": round(LIGHT_NUMBERS**0.5),
        "pages": [{"width": width, "height": height} for _, width, height in textures.atlas.pages.tolist()],
        "parts": [
            {
                "name": image.name,
                "page": image.page,
                "side": SIDES[image.side],
                "kind": image.kind,
                "type": image.type,
                "channels": list(image.channels),
                "rgba_parts": [part.name for part in image.fours()],
            }
            for image in images
        ],
        "how_to_read": TEXT,
    }
    if compressed is not None:
        info["components"] = {
            "count": len(compressed.basis),
            "error": compressed.error,
            "basis": compressed.basis.tolist(),
        }
    return json.dumps(info, indent=2) + "\n"
