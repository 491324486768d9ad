"""Structs that two or more kernel modules share.

Lengths in metres, radiance in W/(m^2 sr), colours linear Rec. 709, y up.
Indices of -1 mean "none".
"""

import warp as wp

WRAP_REPEAT = 0
WRAP_CLAMP = 1
WRAP_MIRROR = 2

ENVIRONMENT_NONE = 0
ENVIRONMENT_CONSTANT = 1
ENVIRONMENT_MAP = 2

EMITTER_TRIANGLE = 0
EMITTER_POINT = 1
EMITTER_SPOT = 2
EMITTER_DIRECTIONAL = 3


# One image in SceneData.texels. Row 0 is the bottom: texel (i, j) is centred
# at u = (i + 0.5) / width, v = (j + 0.5) / height, v up.
@wp.struct
class Texture:
    start: wp.int32  # first texel in SceneData.texels
    width: wp.int32
    height: wp.int32
    wrap_u: wp.int32  # WRAP_*
    wrap_v: wp.int32
    srgb: wp.int32  # 1: red, green, blue are sRGB-coded; alpha never is
    nearest: wp.int32  # 1: the nearest texel, else bilinear
    uv_set: wp.int32  # 0: Geometry.uvs, 1: Geometry.further_uvs
    moved: wp.int32  # 1: the set is not 0, or coordinates are (dot(to_u, (u, v, 1)), dot(to_v, (u, v, 1)))
    to_u: wp.vec3
    to_v: wp.vec3


# glTF 2.0 metallic-roughness. Texture fields index SceneData.textures.
@wp.struct
class Material:
    base_color: wp.vec3
    alpha: wp.float32
    metallic: wp.float32
    roughness: wp.float32  # perceptual; GGX alpha is its square
    specular: wp.float32  # KHR_materials_specular factor; 0 is pure Lambert
    reflectance: wp.vec3  # of the coat at normal incidence, before the factor; 0.04 is usual
    normal_scale: wp.float32
    emission: wp.vec3  # radiance
    alpha_cutoff: wp.float32  # negative: no mask
    alpha_blend: wp.int32  # 1: alpha is the share of rays that it stops
    transmission: wp.float32  # share of the light that is not reflected which goes straight through, tinted
    transmission_texture: wp.int32  # R factor on transmission
    double_sided: wp.int32  # 1: emits on both sides (every surface reflects on both)
    base_color_texture: wp.int32  # RGB base colour, A coverage
    metallic_roughness_texture: wp.int32  # G roughness, B metallic
    normal_texture: wp.int32  # tangent space, x right, y up
    emission_texture: wp.int32
    specular_texture: wp.int32  # A factor on specular
    reflectance_texture: wp.int32  # RGB factor on reflectance
    colors_emit: wp.int32  # 1: colours of vertices multiply the emission, too


# Triangles in world space, at the current and at the previous frame.
@wp.struct
class Geometry:
    points: wp.array(dtype=wp.vec3)  # [vertex]
    previous_points: wp.array(dtype=wp.vec3)  # [vertex]
    normals: wp.array(dtype=wp.vec3)  # [vertex] unit, or zero for flat shading
    uvs: wp.array(dtype=wp.vec2)  # [vertex]
    further_uvs: wp.array(dtype=wp.vec2)  # [vertex] second set, empty where no texture asks for it
    colors: wp.array(dtype=wp.vec4)  # [vertex] linear, multiplied with base colour and coverage; empty if all are 1
    indices: wp.array(dtype=wp.vec3i)  # [triangle]
    materials: wp.array(dtype=wp.int32)  # [triangle]
    objects: wp.array(dtype=wp.int32)  # [triangle]
    emitters: wp.array(dtype=wp.int32)  # [triangle] index in Emitters, or -1


# Bucket of an alias table: itself with `probability`, else item `index`; with the pdfs
# of both, so that one cache line answers a draw.
@wp.struct
class AliasBucket:
    probability: wp.float32
    index: wp.int32
    pdf: wp.float32  # of selecting the bucket's own item, however it is reached
    index_pdf: wp.float32  # of item `index`


# The sky. A map is latitude-longitude: in environment space
#   u = fract(atan2(x, -z) / 2 pi), v = acos(y) / pi (v = 0 is up, row 0 the top row),
# which is Mitsuba's `envmap` with an identity to_world. Radiance is the bilinear
# interpolation of texels, wrapping in u and clamped in v.
@wp.struct
class Environment:
    kind: wp.int32  # ENVIRONMENT_*
    radiance: wp.vec3  # of a constant sky; of a map the scale that multiplies texels
    environment_from_world: wp.mat33
    width: wp.int32
    height: wp.int32
    texels: wp.array(dtype=wp.vec3)  # [height * width]
    alias: wp.array(dtype=AliasBucket)  # [height * width] table over texels, as nodes with tents about them
    # [height + 1] between the rows of texels, and 0 beyond them: density of samples, times the sine of the polar angle,
    # over the luminance of the texel there, 1/sr
    row_pdfs: wp.array(dtype=wp.float32)


@wp.struct
class Emitter:
    kind: wp.int32  # EMITTER_*
    triangle: wp.int32  # of EMITTER_TRIANGLE
    position: wp.vec3  # of point and spot lights
    direction: wp.vec3  # the way the light shines, of spot and directional lights
    intensity: wp.vec3  # W/sr of point and spot lights; W/m^2 perpendicular to directional ones
    cos_inner: wp.float32
    cos_outer: wp.float32
    range: wp.float32  # metres; light ends there; 0 is no limit


# How points are chosen on an emissive triangle; see emission_grids.py.
@wp.struct
class EmissionGrid:
    start: wp.int32  # first cell in Emitters.cells and Emitters.densities
    side: wp.int32  # the triangle has side^2 cells; 0: points are chosen evenly
    lit: wp.vec3  # least u, least v and largest u + v (barycentric) of where it shines


@wp.struct
class Emitters:
    count: wp.int32
    emitters: wp.array(dtype=Emitter)  # [count] emissive triangles first, then punctual lights
    alias: wp.array(dtype=AliasBucket)  # [count] table of the current light sampler
    lower: wp.vec3  # box around all emissive triangles; empty (lower > upper) if there are none
    upper: wp.vec3
    grids: wp.array(dtype=EmissionGrid)  # [emissive triangle]; empty where points are chosen evenly on all of them
    cells: wp.array(dtype=AliasBucket)  # [cell] a table of each grid, one after another
    densities: wp.array(dtype=wp.vec4)  # [cell] over that of uniform points: rising to each corner, and everywhere


# One way in which triangles let rays pass. Their coverage is the texture's alpha times `factor`, or 0 below `cutoff`
# and 1 above it; rays pass by chance, with the probability 1 - coverage (1 - what glass lets through).
@wp.struct
class AlphaMask:
    texture: wp.int32  # in Bvh.textures; its alpha is 1 where there is none
    factor: wp.float32
    cutoff: wp.float32  # negative: none
    through: wp.float32  # of glass: its transmission times the luminance of its tint; 0 is none
    through_texture: wp.int32  # in Bvh.textures; its alpha is a factor on `through`
    f0: wp.float32  # of glass: what it reflects at normal incidence and at grazing angles
    f90: wp.float32


# What a ray query needs; see bvh.py. The CPU reads nodes and blocks, CUDA reads mesh.
@wp.struct
class Bvh:
    mesh: wp.uint64  # wp.Mesh id, 0 on the CPU
    nodes: wp.array(dtype=wp.uint32)  # [node * NODE_WORDS] eight-wide, node 0 is the root
    blocks: wp.array(dtype=wp.float32)  # [block * BLOCK_WORDS] eight triangles each
    parents: wp.array(dtype=wp.int32)  # [block] the node above it
    face_masks: wp.array(dtype=wp.int32)  # [triangle] index in masks, -1 is opaque; empty where all are
    masks: wp.array(dtype=AlphaMask)
    points: wp.array(dtype=wp.vec3)  # [vertex] for glass; empty without it
    chance: wp.int32  # 1: some masks let rays pass by chance (for layers.py 2: they do not, 3: always); 0: none does
    salt: wp.uint32  # of chance; another one for each camera sample
    indices: wp.array(dtype=wp.vec3i)  # [triangle] for uvs; empty where all are opaque
    uvs: wp.array(dtype=wp.vec2)  # [vertex]
    alphas: wp.array(dtype=wp.float32)  # [vertex] coverage, multiplied with the texture's; empty if all are 1
    textures: wp.array(dtype=Texture)
    texels: wp.array(dtype=wp.uint32)  # RGBA8


# Triangles of coloured glass.
@wp.struct
class Panes:
    bvh: wp.uint64  # of a wp.Bvh over their boxes
    faces: wp.array(dtype=wp.int32)  # [pane] triangle
    count: wp.int32


@wp.struct
class SceneData:
    bvh: Bvh
    panes: Panes
    geometry: Geometry
    materials: wp.array(dtype=Material)
    textures: wp.array(dtype=Texture)
    texels: wp.array(dtype=wp.uint32)  # RGBA8, red in the low byte
    srgb_to_linear: wp.array(dtype=wp.float32)  # [256]
    environment: Environment
    emitters: Emitters
    center: wp.vec3  # of the bounds
    radius: wp.float32  # half the diagonal of the bounds
