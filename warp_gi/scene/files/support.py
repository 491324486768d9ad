"""What scene files can hold and what becomes of it: one table, which the readers and the documentation share.

A reader notes each feature that it meets and does not read in full; ``load_scene`` then gives one
``UnsupportedWarning`` a feature, which names it and where the file uses it.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Literal

from warp_gi.errors import UnsupportedWarning

MOST_PLACES = 3
"""Number of places that a warning names; others are counted."""

GLTF, OBJ, PLY, OFF, STL = "glTF", "OBJ", "PLY", "OFF", "STL"


@dataclass(frozen=True)
class Feature:
    """Something that a scene file can hold."""

    name: str
    """Its name in the file's format, as warnings show it."""
    formats: str
    """Formats that have it."""
    status: Literal["supported", "approximated", "ignored", "refused"]
    """Whether pictures show it. What is refused is an error."""
    how: str
    """What becomes of it."""


def _features(status: Literal["supported", "approximated", "ignored", "refused"], *rows: tuple[str, str, str]) -> list:
    return [Feature(name, formats, status, how) for name, formats, how in rows]


FEATURES: tuple[Feature, ...] = (
    *_features(
        "supported",
        ("triangles, strips and fans", GLTF, "triangles"),
        ("triangle strips", PLY, "triangles; -1 begins another strip"),
        ("default weights of morph targets", GLTF, "of the mesh and of the node, in positions and normals"),
        ("COLOR_0", GLTF, "multiplies base colour and coverage; linear"),
        ("colours of vertices", f"{OBJ}, {PLY}, {OFF}", "multiply the base colour; sRGB-coded, of any type of numbers"),
        ("EXT_texture_webp", GLTF, "read in the place of its stand-in"),
        ("sparse, strided and normalized accessors", GLTF, "as they are"),
        ("KHR_mesh_quantization", GLTF, "as it is"),
        ("KHR_draco_mesh_compression", GLTF, "by DracoPy (pip install 'warp-gi[draco]')"),
        ("EXT_meshopt_compression", GLTF, "by meshoptimizer (pip install meshoptimizer, which needs a C++ compiler)"),
        ("EXT_mesh_gpu_instancing", GLTF, "a node for each instance"),
        ("KHR_node_visibility", GLTF, "hidden nodes and what is below them are not drawn and give no light"),
        ("KHR_materials_specular", GLTF, "factor, colour and both textures"),
        ("KHR_materials_ior", GLTF, "the reflectance at normal incidence; nothing refracts"),
        ("KHR_texture_transform", GLTF, "one for each texture"),
        ("two sets of texture coordinates", GLTF, "for the textures of one material"),
        ("NEAREST filtering", GLTF, "where magFilter says so; mipmaps are not used"),
        ("skins", GLTF, "positions and normals at rest and in every frame; any number of joints a vertex"),
        (
            "animation of morph weights",
            GLTF,
            "positions and normals; cubic splines as 16 linear pieces from key to key",
        ),
        ("hierarchy and animation of nodes", GLTF, "cubic splines as 16 linear pieces from key to key"),
        ("metallic-roughness materials", GLTF, "as they are; texture lookups are bilinear, or take the nearest texel"),
        ("KHR_materials_emissive_strength", GLTF, "as it is"),
        ("KHR_lights_punctual", GLTF, "intensities are taken as W/sr and W/m², without conversion"),
        ("KHR_materials_transmission", GLTF, "thin glass: rays go straight through, by chance"),
        ("alphaMode MASK", GLTF, "rays pass where the coverage is below the cutoff"),
        ("alphaMode BLEND", GLTF, "rays pass by chance, with the probability 1 - coverage"),
        ("coverage between 0 and 1", OBJ, "rays pass by chance; a map of holes alone is a mask with a cutoff of 0.5"),
        ("alpha of vertex colours", f"{PLY}, {OFF}", "coverage: rays pass by chance"),
        ("perspective cameras", GLTF, "without aspectRatio they keep their yfov in pictures of any shape"),
        ("orthographic cameras", GLTF, "their xmag in pictures of any shape; znear and zfar cut nothing off"),
        ("polygons, concave ones too", f"{OBJ}, {PLY}, {OFF}", "triangles: fans, or ear clipping of concave ones"),
        ("MTL: Kd, Ks, Ns, Ke, d, Tr, Pr, Pm and their maps", OBJ, "metallic-roughness materials"),
        ("colours of glass", f"{GLTF}, {OBJ}", "tint paths and shadow rays; bakes take their luminance"),
        ("textures named by a path of another machine", OBJ, "looked for by their bare names beside the MTL file"),
    ),
    *_features(
        "approximated",
        ("KHR_materials_pbrSpecularGlossiness", GLTF, "converted to metallic-roughness; pure Lambert without specular"),
        ("KHR_materials_unlit", GLTF, "emits its base colour, reflects nothing, and lights what is around it"),
        (
            "coordinates of transmission textures",
            GLTF,
            "where the base colour has a texture: its coordinates and wrapping",
        ),
        (
            "coordinates of specular-glossiness textures",
            GLTF,
            "where they are not those of the diffuse texture: it is darkened by their mean",
        ),
        ("a third set of texture coordinates", GLTF, "two sets for the textures of a material"),
        ("KHR_materials_variants", GLTF, "the materials without a variant"),
        (
            "colours of vertices above 1",
            OBJ,
            "divided by 255 if one is above 2 or all are whole numbers, else cut off at 1",
        ),
        ("one scale and offset a map (-s, -o)", OBJ, "one for all maps of a material"),
        (
            "glass of MTL (illum 4, 6, 7, 9)",
            OBJ,
            "with Tf, a pane that lets 1 - d through, tinted by it; else d is coverage; opaque if d is 1",
        ),
        ("several animations", GLTF, "all at once; of those that move one property the first counts"),
    ),
    *_features(
        "ignored",
        ("COLOR_1 and above", GLTF, "only the first set of colours has a meaning in glTF"),
        ("TEXCOORD_1 and above, of no texture", GLTF, "no texture asks for them"),
        ("morph targets of colours and texture coordinates", GLTF, "only positions and normals move"),
        (
            "textures without their coordinates",
            f"{GLTF}, {OBJ}",
            "the colour of one point of the texture, as at (0, 0)",
        ),
        ("other attributes of instances", GLTF, "translation, rotation and scale of each instance alone"),
        ("animation of other properties", GLTF, "only placements of nodes and weights of morph targets move"),
        ("instances of meshes with a skin", GLTF, "one mesh, where its joints are"),
        ("points and lines", f"{GLTF}, {OBJ}, {PLY}", "only surfaces are rendered"),
        ("primitives without positions", GLTF, "there is nothing to draw"),
        ("occlusion textures", GLTF, "occlusion is computed"),
        ("further scenes", GLTF, "the default scene is read, else the first"),
        ("tangents", GLTF, "tangents follow from texture coordinates"),
        ("KHR_materials_volume", GLTF, "surfaces enclose nothing, and rays go straight through glass"),
        ("KHR_materials_volume_scatter", GLTF, "surfaces enclose nothing"),
        ("KHR_materials_diffuse_transmission", GLTF, "opaque"),
        ("KHR_materials_clearcoat", GLTF, "the surface below the coat"),
        ("KHR_materials_sheen", GLTF, "the surface below the sheen"),
        ("KHR_materials_iridescence", GLTF, "the surface without a film"),
        ("KHR_materials_anisotropy", GLTF, "the same roughness in all directions"),
        ("KHR_materials_dispersion", GLTF, "one index of refraction for all wavelengths"),
        ("KHR_animation_pointer", GLTF, "only placements of nodes move"),
        ("MSFT_lod", GLTF, "the most detailed level is shown"),
        ("EXT_lights_image_based", GLTF, "give a sky of its own"),
        ("KHR_audio_emitter", GLTF, "pictures have no sound"),
        ("smoothing groups", OBJ, "faces without normals are flat; load_scene(smooth=) and --smooth make normals"),
        ("faces of fewer than three corners", f"{OBJ}, {PLY}, {OFF}", "they have no area"),
        ("free-form curves and surfaces", OBJ, "only polygons are read"),
        ("bump and displacement maps", OBJ, "the surface without them; norm is a normal map"),
        ("maps of the specular colour and exponent", OBJ, "the numbers beside them"),
        ("reflection maps", OBJ, "reflections are computed"),
        ("sheen, clear coats and anisotropy of MTL", OBJ, "the surface without them"),
        ("spectral and XYZ colours", OBJ, "the colour is as if it were not given"),
        ("maps of MTL without a file", OBJ, "as if they were not there"),
        ("alpha of map_Kd without map_d", OBJ, "opaque; map_d says where there are holes"),
        ("more than six numbers of a vertex", OBJ, "its position and its colour without alpha"),
        ("other options of maps (-mm, -t, -cc, -imfchan, -bm)", OBJ, "the texture as it is"),
        ("other statements of OBJ, such as call and usemap", OBJ, "as if they were not there"),
        ("statements of MTL without the numbers they need", OBJ, "as if they were not there"),
        ("other statements of MTL, such as decal, and Tf of what is no glass", OBJ, "as if they were not there"),
        ("colours of faces", f"{PLY}, {OFF}, {STL}", "only vertices have colours"),
        ("textures of PLY", PLY, "the plain colour"),
        ("other elements of PLY, such as material", PLY, "vertices, faces and triangle strips alone"),
        ("KHR_xmp_json_ld", GLTF, "a note about the file"),
    ),
    *_features(
        "refused",
        ("KHR_texture_basisu", GLTF, "export textures as PNG or JPEG"),
    ),
)
BY_NAME = {feature.name: feature for feature in FEATURES}

UNSEEN = {"several animations", "occlusion textures", "tangents", "further scenes"}
"""Features without a warning: what becomes of them is what glTF asks for, or shows in no picture."""


class Findings:
    """The features of one file that are not read in full, and where it uses them."""

    def __init__(self) -> None:
        self.places: dict[str, dict[str, None]] = {}
        self.lost: list[str] = []
        """Messages about files that are not there and parts of no use, without which the scene can be read."""

    def add(self, name: str, where: str = "") -> None:
        """Note that the file uses a feature in some place, such as "material 'paint'"."""
        places = self.places.setdefault(name, {})
        if where:
            places[where] = None

    def messages(self, path: object) -> list[str]:
        """Return a line for each feature found."""
        lines = []
        for name, places in self.places.items():
            if name in UNSEEN:
                continue
            feature = BY_NAME.get(name)
            if feature is not None and feature.status == "supported":
                continue
            status, how = (feature.status, feature.how) if feature else ("ignored", "this library does not know it")
            where = ", ".join(list(places)[:MOST_PLACES])
            if len(places) > MOST_PLACES:
                where += f" and {len(places) - MOST_PLACES:,} more"
            lines.append(f"{str(path)!r} uses {name}{f' ({where})' if where else ''}, which is {status}: {how}")
        return lines

    def warn(self, path: object, stacklevel: int = 2) -> None:
        """Give one warning for each feature found and for each file lost, as from ``stacklevel`` calls above."""
        for line in self.messages(path):
            warnings.warn(line, UnsupportedWarning, stacklevel=stacklevel + 1)
        for line in self.lost:
            warnings.warn(line, stacklevel=stacklevel + 1)
