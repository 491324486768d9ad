"""The parts a scene is made of: plain host-side data, validated when a Scene is built from them."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

Color = tuple[float, float, float]


@dataclass(eq=False, repr=False)
class Texture:
    """An 8-bit image."""

    name: str
    """Name in error messages."""
    pixels: np.ndarray
    """RGBA values, uint8 [height, width, 4], row 0 at the top as in files."""
    srgb: bool = True
    """Whether red, green and blue are sRGB-coded (colours) or linear (normals, roughness)."""
    wrap: tuple[str, str] = ("repeat", "repeat")
    """Wrap modes in u and v: "repeat", "clamp" or "mirror"."""
    nearest: bool = False
    """Whether lookups take the nearest texel; else they are bilinear."""
    uv_set: int = 0
    """Coordinates that it is looked up at: 0 for the mesh's ``uvs``, 1 for its ``further_uvs``; 0 for a base colour."""
    transform: tuple[Color, Color] | None = None
    """Rows of the affine map from those coordinates to the texture's own, v up: u' = row 0 . (u, v, 1), and v' of row
    1; None is the identity, and has to be for a base colour."""

    def __repr__(self) -> str:
        size = " x ".join(map(str, np.shape(self.pixels)[1::-1]))
        return f"<Texture {self.name!r}: {size} pixels, {'sRGB' if self.srgb else 'linear'}>"


@dataclass(eq=False)
class Material:
    """A glTF 2.0 metallic-roughness material."""

    name: str = "material"
    """Name in error messages."""
    base_color: Color = (0.8, 0.8, 0.8)
    """Linear Rec. 709 reflectance, multiplied with ``base_color_texture``."""
    alpha: float = 1.0
    """Coverage in [0, 1], multiplied with the alpha of ``base_color_texture``."""
    metallic: float = 0.0
    """Metallic factor in [0, 1], multiplied with ``metallic_roughness_texture``."""
    roughness: float = 1.0
    """Perceptual roughness in [0, 1]; the GGX alpha is its square."""
    specular: float = 1.0
    """KHR_materials_specular factor on ``reflectance``, and the reflectance at grazing angles; 0 is pure Lambert. It
    is multiplied with the alpha of ``specular_texture``."""
    reflectance: Color = (0.04, 0.04, 0.04)
    """Reflectance of what is no metal at normal incidence, before ``specular``; cut off at 1. It is multiplied with
    ``reflectance_texture``."""
    emission: Color = (0.0, 0.0, 0.0)
    """Emitted radiance in W/(m^2 sr), multiplied with ``emission_texture``."""
    base_color_texture: Texture | None = None
    """Texture of base colour and alpha, sRGB-coded."""
    metallic_roughness_texture: Texture | None = None
    """Texture of the roughness (green) and of the metallic factor (blue); linear."""
    normal_texture: Texture | None = None
    """Texture of normals in tangent space, x right and y up; linear."""
    emission_texture: Texture | None = None
    """Texture of the emission, sRGB-coded."""
    specular_texture: Texture | None = None
    """Texture whose alpha is a factor on ``specular``."""
    reflectance_texture: Texture | None = None
    """Texture of the reflectance at normal incidence, sRGB-coded."""
    colors_emit: bool = False
    """Whether colours of vertices multiply the emission, too, as those of surfaces without light do."""
    normal_scale: float = 1.0
    """Factor on the x and y of the normal texture's normals."""
    alpha_cutoff: float | None = None
    """Alpha below which a ray passes through the surface; None is none."""
    double_sided: bool = True
    """Whether it emits on both sides. Every surface reflects and blocks light on both."""
    alpha_blend: bool = False
    """Whether alpha is the share of rays that the surface stops, as glTF's BLEND: each by chance, so that the mean is
    right. Without it and without ``alpha_cutoff`` the surface is opaque."""
    transmission: float = 0.0
    """Share in [0, 1] of the light that is not reflected which goes straight through, as through a thin pane, times the
    luminance of the base colour (KHR_materials_transmission); the rest meets the diffuse surface. Metal has none."""
    transmission_texture: Texture | None = None
    """Texture whose red is a factor on ``transmission``; linear."""

    @property
    def is_glass(self) -> bool:
        """Whether light goes straight through it."""
        return self.transmission > 0.0 and self.mean_metallic < 1.0

    @property
    def mean_metallic(self) -> float:
        """``metallic``, times the mean of its texture."""
        texture = self.metallic_roughness_texture
        return self.metallic * (1.0 if texture is None else float(texture.pixels[..., 2].mean()) / 255.0)

    @property
    def has_chance(self) -> bool:
        """Whether it lets some of the rays pass that meet one point of it."""
        return self.alpha_blend or self.is_glass

    @property
    def lets_rays_pass(self) -> bool:
        """Whether it lets any rays pass, by its alpha or by its transmission."""
        return self.alpha_cutoff is not None or self.has_chance


@dataclass(eq=False, repr=False)
class Mesh:
    """Triangles of one material, in the space of their object."""

    points: np.ndarray
    """Vertex positions in metres, float32 [vertex, 3]."""
    indices: np.ndarray
    """Vertices of each triangle, int32 [triangle, 3], counter-clockwise seen from the front."""
    material: Material = field(default_factory=Material)
    """Material of all triangles."""
    normals: np.ndarray | None = None
    """Unit shading normals, float32 [vertex, 3]; None is flat shading."""
    uvs: np.ndarray | None = None
    """Texture coordinates, float32 [vertex, 2], v up; None is all zero."""
    name: str = "mesh"
    """Name in error messages."""
    further_uvs: np.ndarray | None = None
    """Second set of texture coordinates, for textures of ``uv_set`` 1, float32 [vertex, 2], v up; None is all zero."""
    colors: np.ndarray | None = None
    """Linear colours from 0 to 1, float32 [vertex, 3], or [vertex, 4] with coverage; they multiply base colour and
    alpha of the material. None is all 1."""
    targets: list[MorphTarget] = field(default_factory=list)
    """Shapes that the ``morphs`` of a node blend in."""
    joints: np.ndarray | None = None
    """Joints that each vertex follows where a node has a ``skin``: indices in ``Skin.joints``, [vertex, influence]."""
    joint_weights: np.ndarray | None = None
    """How much it follows each of them, from 0 up, float32 [vertex, influence]; they count relative to their sum."""

    def __repr__(self) -> str:
        has = [
            name for name in ("normals", "uvs", "further_uvs", "colors", "joints") if getattr(self, name) is not None
        ]
        parts = [f"{len(self.points):,} vertices", f"{len(self.indices):,} triangles"]
        return f"<Mesh {self.name!r}: {', '.join([*parts, f'material {self.material.name!r}', *has])}>"


@dataclass(eq=False)
class MorphTarget:
    """A shape of a mesh, as what its vertices differ by."""

    points: np.ndarray | None = None
    """What is added to the positions at a weight of 1, in metres, float32 [vertex, 3]; None is nothing."""
    normals: np.ndarray | None = None
    """What is added to the normals, float32 [vertex, 3]; None is nothing."""


@dataclass(eq=False)
class PunctualLight:
    """A light without size, as KHR_lights_punctual defines it."""

    kind: str
    """Kind of light: "point", "spot" or "directional"."""
    intensity: Color
    """Intensity in W/sr a channel (point, spot), or irradiance in W/m^2 perpendicular to the light (directional)."""
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Position in metres, in the space of ``node``; of no account for a directional light."""
    direction: tuple[float, float, float] = (0.0, 0.0, -1.0)
    """Direction in which the light shines, of any length."""
    inner_cone: float = 0.0
    """Half angle in radians at which a spot begins to fall off."""
    outer_cone: float = 0.7853981633974483
    """Half angle in radians at which a spot ends; the default is 45 degrees."""
    range: float | None = None
    """Distance in metres at which the light ends; None is no limit."""
    name: str = "light"
    """Name in error messages."""
    node: int | None = None
    """Index in Scene.nodes of the node that carries the light, and in whose space it is given; None is the world."""


@dataclass(eq=False, repr=False)
class Node:
    """A named placement of meshes; the objects of a scene. Parents come before children."""

    name: str
    """Name of the node, by which ``Scene.animate`` finds it."""
    meshes: list[Mesh] = field(default_factory=list)
    """Meshes that the node places."""
    parent_from_node: np.ndarray = field(default_factory=lambda: np.eye(4))
    """Placement at rest, float64 [4, 4], acting on column vectors."""
    parent: int | None = None
    """Index of the parent in Scene.nodes."""
    keyframes: list[Keyframe] | None = None
    """Animation of the node, which replaces ``parent_from_node``; None rests."""
    pivot: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Point of the node's own space in a file that is its origin now, because what lies there is far away in the
    file; keyframes are given for the file's."""
    skin: Skin | None = None
    """Nodes that the vertices of the meshes follow; the placement of this node is then of no account for them."""
    morphs: list[MorphKeyframe] | None = None
    """Weights of the meshes' morph targets over time; None is none of them."""

    def __repr__(self) -> str:
        where = np.asarray(self.parent_from_node, np.float64)[:3, 3]
        parts = [
            f"at ({', '.join(f'{x:g}' for x in where)}) m",
            *([] if self.parent is None else [f"below node {self.parent}"]),
            *([f"{len(self.keyframes)} keyframes"] if self.keyframes else []),
            *(repr(mesh) for mesh in self.meshes),
        ]
        return f"<Node {self.name!r}: {', '.join(parts)}>"


@dataclass(eq=False)
class Skin:
    """Joints that bend meshes: a vertex is where its joints would take it, weighted (linear blend skinning)."""

    joints: list[int]
    """Indices of the joints in Scene.nodes."""
    joint_from_mesh: np.ndarray
    """From the mesh as it is to the space of each joint, inverse bind matrices, float64 [joint, 4, 4]."""
    name: str = "skin"
    """Name in error messages."""


@dataclass(frozen=True)
class MorphKeyframe:
    """Weights of morph targets at a time; linear between keys, held outside them."""

    time: float
    """Time of the weights in seconds."""
    weights: tuple[float, ...]
    """A weight for each target of the meshes; 0 leaves it out, 1 is all of it."""


@dataclass(frozen=True)
class Keyframe:
    """A rigid pose with scale at a time; linear between keys (rotation: spherical), held outside them."""

    time: float
    """Time of the pose in seconds."""
    translation: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Position in metres, in the space of the parent."""
    rotation: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)
    """Rotation as a unit quaternion x, y, z, w."""
    scale: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Factors on the size along x, y and z, before the rotation."""
