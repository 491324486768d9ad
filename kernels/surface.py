"""From a hit to a point with normals, texture coordinates, BSDF and emission."""

import warp as wp

from warp_gi.kernels.bsdf import Bsdf, luminance, make_bsdf, make_coated_bsdf
from warp_gi.kernels.bvh import transmitted
from warp_gi.kernels.sampling import frame_of
from warp_gi.kernels.types import WRAP_CLAMP, WRAP_MIRROR, WRAP_REPEAT, Geometry, Material, SceneData, Texture

wp.set_module_options({"enable_backward": False})


# A point on a surface, seen from the side of `wo`.
@wp.struct
class Surface:
    position: wp.vec3
    normal: wp.vec3  # geometric, unit, on the side of wo
    shading: wp.mat33  # world_from_shading; its third column is the shading normal
    bsdf: Bsdf
    base_color: wp.vec3
    uv: wp.vec2
    texture: wp.int32  # of base_color that is not looked up yet, or -1
    offset: wp.float32  # metres by which rays leave along `normal`


# Texture coordinate in units of texels from the first texel's centre, folded to [-0.5, size - 0.5].
@wp.func
def texel_coordinate(u: wp.float32, size: wp.int32, mode: wp.int32) -> wp.float32:
    folded = wp.clamp(u, 0.0, 1.0)
    if mode == WRAP_MIRROR:
        folded = wp.abs(u - 2.0 * wp.floor(0.5 * u + 0.5))
    elif mode != WRAP_CLAMP:
        folded = u - wp.floor(u)
    return folded * wp.float32(size) - 0.5


# Texel index of one in [-1, size].
@wp.func
def wrap_index(i: wp.int32, size: wp.int32, mode: wp.int32) -> wp.int32:
    if mode == WRAP_REPEAT:
        if i < 0:
            return size - 1
        if i >= size:
            return 0
        return i
    return wp.clamp(i, 0, size - 1)


@wp.func
def texel_color(scene: SceneData, index: wp.int32, srgb: wp.int32) -> wp.vec4:
    word = scene.texels[index]
    r = wp.int32(word & wp.uint32(255))
    g = wp.int32((word >> wp.uint32(8)) & wp.uint32(255))
    b = wp.int32((word >> wp.uint32(16)) & wp.uint32(255))
    a = wp.float32(word >> wp.uint32(24)) / 255.0
    if srgb != 0:
        return wp.vec4(scene.srgb_to_linear[r], scene.srgb_to_linear[g], scene.srgb_to_linear[b], a)
    return wp.vec4(wp.float32(r), wp.float32(g), wp.float32(b), a * 255.0) / 255.0


# Bilinear lookup, or the nearest texel where the texture asks for it; colours linear.
@wp.func
def texture_lookup(scene: SceneData, texture: wp.int32, uv: wp.vec2) -> wp.vec4:
    t = scene.textures[texture]
    x = texel_coordinate(uv[0], t.width, t.wrap_u)
    y = texel_coordinate(uv[1], t.height, t.wrap_v)
    if t.nearest != 0:
        x = wp.floor(x + 0.5)
        y = wp.floor(y + 0.5)
    fx = x - wp.floor(x)
    fy = y - wp.floor(y)
    i = wp.int32(wp.floor(x))
    j = wp.int32(wp.floor(y))
    i0 = wrap_index(i, t.width, t.wrap_u)
    i1 = wrap_index(i + 1, t.width, t.wrap_u)
    row0 = t.start + wrap_index(j, t.height, t.wrap_v) * t.width
    row1 = t.start + wrap_index(j + 1, t.height, t.wrap_v) * t.width
    bottom = texel_color(scene, row0 + i0, t.srgb) * (1.0 - fx) + texel_color(scene, row0 + i1, t.srgb) * fx
    top = texel_color(scene, row1 + i0, t.srgb) * (1.0 - fx) + texel_color(scene, row1 + i1, t.srgb) * fx
    return bottom * (1.0 - fy) + top * fy


@wp.func
def triangle_uv(scene: SceneData, face: wp.int32, u: wp.float32, v: wp.float32) -> wp.vec2:
    ids = scene.geometry.indices[face]
    uvs = scene.geometry.uvs
    return uvs[ids[0]] * (1.0 - u - v) + uvs[ids[1]] * u + uvs[ids[2]] * v


# Where a texture is looked up at the point (u, v) of a triangle, whose own coordinates there are `uv`.
@wp.func
def texture_uv(
    scene: SceneData, texture: wp.int32, face: wp.int32, u: wp.float32, v: wp.float32, uv: wp.vec2
) -> wp.vec2:
    if scene.textures[texture].moved == 0:
        return uv
    t = scene.textures[texture]
    at = uv
    if t.uv_set != 0:
        ids = scene.geometry.indices[face]
        uvs = scene.geometry.further_uvs
        at = uvs[ids[0]] * (1.0 - u - v) + uvs[ids[1]] * u + uvs[ids[2]] * v
    p = wp.vec3(at[0], at[1], 1.0)
    return wp.vec2(wp.dot(t.to_u, p), wp.dot(t.to_v, p))


# Colour of the vertices of a scene that has any, at the point (u, v) of a triangle.
@wp.func
def vertex_color(scene: SceneData, face: wp.int32, u: wp.float32, v: wp.float32) -> wp.vec3:
    ids = scene.geometry.indices[face]
    colors = scene.geometry.colors
    color = colors[ids[0]] * (1.0 - u - v) + colors[ids[1]] * u + colors[ids[2]] * v
    return wp.vec3(color[0], color[1], color[2])


# Radiance at a point of an emissive triangle, on its emitting side.
@wp.func
def emitted_radiance(scene: SceneData, face: wp.int32, u: wp.float32, v: wp.float32) -> wp.vec3:
    m = scene.materials[scene.geometry.materials[face]]
    emission = m.emission
    if m.colors_emit != 0 and scene.geometry.colors.shape[0] > 0:
        emission = wp.cw_mul(emission, vertex_color(scene, face, u, v))
    if m.emission_texture < 0:
        return emission
    uv = texture_uv(scene, m.emission_texture, face, u, v, triangle_uv(scene, face, u, v))
    texel = texture_lookup(scene, m.emission_texture, uv)
    return wp.cw_mul(emission, wp.vec3(texel[0], texel[1], texel[2]))


# Radiance that the point (u, v) of a triangle emits towards wo.
@wp.func
def surface_emission(scene: SceneData, face: wp.int32, u: wp.float32, v: wp.float32, wo: wp.vec3) -> wp.vec3:
    if scene.geometry.emitters[face] < 0:
        return wp.vec3(0.0, 0.0, 0.0)
    if scene.materials[scene.geometry.materials[face]].double_sided == 0:
        ids = scene.geometry.indices[face]
        p0 = scene.geometry.points[ids[0]]
        if wp.dot(wp.cross(scene.geometry.points[ids[1]] - p0, scene.geometry.points[ids[2]] - p0), wo) <= 0.0:
            return wp.vec3(0.0, 0.0, 0.0)
    gain = float(1.0)
    if scene.materials[scene.geometry.materials[face]].transmission > 0.0:
        gain = 1.0 / wp.max(1.0 - transmitted(scene.bvh, face, u, v, wo)[0], 1.0e-4)
    return emitted_radiance(scene, face, u, v) * gain


# Distance by which a ray leaves the surface at `position`: above the rounding of positions
# of that size (30 ulp), and of the scene's.
@wp.func
def ray_offset(position: wp.vec3, radius: wp.float32) -> wp.float32:
    size = wp.max(wp.max(wp.abs(position[0]), wp.abs(position[1])), wp.abs(position[2]))
    return 4.0e-6 * wp.max(size, 0.25 * radius)


# Tangent-space normal of the material's normal map in world space, about the unit normal n.
# The tangent is dp/du of the triangle in the texture's coordinates, made perpendicular to n.
@wp.func
def mapped_normal(
    scene: SceneData, texture: wp.int32, scale: wp.float32, face: wp.int32, uv: wp.vec2, n: wp.vec3
) -> wp.vec3:
    ids = scene.geometry.indices[face]
    e1 = scene.geometry.points[ids[1]] - scene.geometry.points[ids[0]]
    e2 = scene.geometry.points[ids[2]] - scene.geometry.points[ids[0]]
    d1 = scene.geometry.uvs[ids[1]] - scene.geometry.uvs[ids[0]]
    d2 = scene.geometry.uvs[ids[2]] - scene.geometry.uvs[ids[0]]
    if scene.textures[texture].moved != 0:
        at = texture_uv(scene, texture, face, 0.0, 0.0, scene.geometry.uvs[ids[0]])
        d1 = texture_uv(scene, texture, face, 1.0, 0.0, scene.geometry.uvs[ids[1]]) - at
        d2 = texture_uv(scene, texture, face, 0.0, 1.0, scene.geometry.uvs[ids[2]]) - at
    det = d1[0] * d2[1] - d1[1] * d2[0]
    if wp.abs(det) < 1.0e-20:
        return n
    tangent = (e1 * d2[1] - e2 * d1[1]) * wp.sign(det)
    tangent = tangent - n * wp.dot(n, tangent)
    length = wp.length(tangent)
    if length < 1.0e-20:
        return n
    tangent = tangent / length
    bitangent = wp.cross(n, tangent) * wp.sign(det)
    texel = texture_lookup(scene, texture, uv)
    x = (texel[0] * 2.0 - 1.0) * scale
    y = (texel[1] * 2.0 - 1.0) * scale
    z = wp.max(texel[2] * 2.0 - 1.0, 1.0e-3)
    return wp.normalize(tangent * x + bitangent * y + n * z)


# Starts fetching the texels around a point of a texture with coordinates in [0, 1).
@wp.func_native(
    snippet="""
#if !defined(__CUDA_ARCH__)
    const float x = (u - __builtin_floorf(u)) * (float)texture.width - 0.5f;
    const float y = (v - __builtin_floorf(v)) * (float)texture.height - 0.5f;
    const int i = x > 0.0f ? (int)x : 0, j = y > 0.0f ? (int)y : 0;
    if (i < texture.width && j < texture.height) {
        const wp::uint32* texel = &texels.data[texture.start + j * texture.width + i];
        __builtin_prefetch(texel);
        if (j + 1 < texture.height) __builtin_prefetch(texel + texture.width);
    }
#endif
"""
)
def texture_prefetch(texels: wp.array(dtype=wp.uint32), texture: Texture, u: wp.float32, v: wp.float32): ...


# Starts fetching what surface_at and emission will read first of a triangle.
@wp.func_native(
    snippet="""
#if !defined(__CUDA_ARCH__)
    __builtin_prefetch(&geometry.indices.data[face]);
    __builtin_prefetch(&geometry.emitters.data[face]);
    __builtin_prefetch(&geometry.materials.data[face]);
#endif
"""
)
def surface_prefetch(geometry: Geometry, face: wp.int32): ...


# The surface with its texture looked up.
@wp.func
def with_color(scene: SceneData, surface: Surface) -> Surface:
    s = surface
    if s.texture >= 0:
        texel = texture_lookup(scene, s.texture, s.uv)
        s.base_color = wp.cw_mul(s.base_color, wp.vec3(texel[0], texel[1], texel[2]))
        s.bsdf.diffuse = s.base_color
        s.texture = -1
    return s


# What a material that is no pure Lambert reflects at a point with the surface's base colour.
@wp.func
def coated_bsdf(
    scene: SceneData, m: Material, base: wp.vec3, face: wp.int32, u: wp.float32, v: wp.float32, uv: wp.vec2
) -> Bsdf:
    roughness = m.roughness
    metallic = m.metallic
    specular = m.specular
    reflectance = m.reflectance
    if m.metallic_roughness_texture >= 0:
        at = texture_uv(scene, m.metallic_roughness_texture, face, u, v, uv)
        texel = texture_lookup(scene, m.metallic_roughness_texture, at)
        roughness = roughness * texel[1]
        metallic = metallic * texel[2]
    if m.specular_texture >= 0:
        at = texture_uv(scene, m.specular_texture, face, u, v, uv)
        specular = specular * texture_lookup(scene, m.specular_texture, at)[3]
    if m.reflectance_texture >= 0:
        at = texture_uv(scene, m.reflectance_texture, face, u, v, uv)
        texel = texture_lookup(scene, m.reflectance_texture, at)
        reflectance = wp.cw_mul(reflectance, wp.vec3(texel[0], texel[1], texel[2]))
    reflectance = wp.min(reflectance, wp.vec3(1.0, 1.0, 1.0))
    return make_coated_bsdf(base, metallic, roughness, specular, reflectance)


# The BSDF of glass, for the rays that chance does not let through. They stand for all that it reflects, so it is over
# the probability that glass stops a ray along wo. This gain is on its Fresnel term F, of which the diffuse lobe takes
# 1 - F. So that lobe is made up for what it loses at f0, where F is for nearly all pairs of directions that meet in a
# diffuse lobe (bsdf.py).
@wp.func
def glass_bsdf(b: Bsdf, base: wp.vec3, through: wp.vec2) -> Bsdf:
    r = b
    gain = 1.0 / wp.max(1.0 - through[0], 1.0e-4)
    transmission = wp.clamp(through[1] / wp.max(luminance(base), 1.0e-6), 0.0, 1.0)
    f0 = luminance(b.f0)
    made_up = (1.0 - f0) / wp.max(1.0 - wp.min(gain * f0, 1.0), 1.0e-3)
    r.diffuse = b.diffuse * ((1.0 - transmission) * gain * made_up)
    r.f0 = b.f0 * gain
    r.f90 = b.f90 * gain
    return r


# Frame of shading at the point (u, v) of triangle `face` with coordinates uv, seen from direction wo.
@wp.func
def shading_frame(scene: SceneData, face: wp.int32, u: wp.float32, v: wp.float32, uv: wp.vec2, wo: wp.vec3) -> wp.mat33:
    g = scene.geometry
    ids = g.indices[face]
    m = scene.materials[g.materials[face]]
    p0 = g.points[ids[0]]
    normal = wp.normalize(wp.cross(g.points[ids[1]] - p0, g.points[ids[2]] - p0))
    shading = g.normals[ids[0]] * (1.0 - u - v) + g.normals[ids[1]] * u + g.normals[ids[2]] * v
    length = wp.length(shading)
    if length <= 1.0e-6:
        shading = normal
    elif wp.dot(shading, normal) >= 0.0:
        shading = shading / length
    else:  # files whose normals point to the back of their triangles
        shading = shading / -length
    if m.normal_texture >= 0:
        at = texture_uv(scene, m.normal_texture, face, u, v, uv)
        shading = mapped_normal(scene, m.normal_texture, m.normal_scale, face, at, shading)
    if wp.dot(normal, wo) < 0.0:
        shading = -shading
    # an interpolated normal may face away from the viewer: bend it until it just does not
    slant = wp.dot(shading, wo)
    if slant < 1.0e-3:
        shading = wp.normalize(shading + wo * (1.0e-3 - slant) * 1.001)
    return frame_of(shading)


# Starts fetching the texels that the shading of a point needs beside its colour.
@wp.func
def shading_prefetch(scene: SceneData, texture: wp.int32, uv: wp.vec2):
    if texture >= 0:
        texture_prefetch(scene.texels, scene.textures[texture], uv[0], uv[1])


# As surface_shape, but for the frame of shading, which is zero, and normal maps with it: what a look-up by place needs.
@wp.func
def bare_surface(
    scene: SceneData, face: wp.int32, u: wp.float32, v: wp.float32, wo: wp.vec3, fetches_normals: wp.int32
) -> Surface:
    s = Surface()
    g = scene.geometry
    ids = g.indices[face]
    m = scene.materials[g.materials[face]]
    s.texture = m.base_color_texture
    textured = m.metallic_roughness_texture >= 0 or m.specular_texture >= 0 or m.reflectance_texture >= 0
    if textured or m.base_color_texture >= 0 or m.normal_texture >= 0:
        s.uv = triangle_uv(scene, face, u, v)
        shading_prefetch(scene, m.base_color_texture, s.uv)
        shading_prefetch(scene, m.metallic_roughness_texture, s.uv)
        if fetches_normals != 0:
            shading_prefetch(scene, m.normal_texture, s.uv)
    p0 = g.points[ids[0]]
    p1 = g.points[ids[1]]
    p2 = g.points[ids[2]]
    s.position = p0 * (1.0 - u - v) + p1 * u + p2 * v
    s.offset = ray_offset(s.position, scene.radius)
    s.normal = wp.normalize(wp.cross(p1 - p0, p2 - p0))
    if wp.dot(s.normal, wo) < 0.0:
        s.normal = -s.normal
    s.base_color = m.base_color
    if g.colors.shape[0] > 0:
        s.base_color = wp.cw_mul(s.base_color, vertex_color(scene, face, u, v))
    if m.metallic > 0.0 or m.specular > 0.0 or m.transmission > 0.0:
        s = with_color(scene, s)
        s.bsdf = coated_bsdf(scene, m, s.base_color, face, u, v, s.uv)
        if m.transmission > 0.0:
            s.bsdf = glass_bsdf(s.bsdf, s.base_color, transmitted(scene.bvh, face, u, v, wo))
    else:
        s.bsdf = make_bsdf(s.base_color, 0.0, 1.0, 0.0)
    return s


# The point (u, v) of triangle `face` seen from direction wo, all but the texture of a Lambert
# material: where to go on from there does not depend on it, so a path asks for it (`with_color`)
# after the next ray, when it has arrived.
@wp.func
def surface_shape(scene: SceneData, face: wp.int32, u: wp.float32, v: wp.float32, wo: wp.vec3) -> Surface:
    s = bare_surface(scene, face, u, v, wo, 1)
    s.shading = shading_frame(scene, face, u, v, s.uv, wo)
    return s


# Everything about the point (u, v) of triangle `face`, seen from direction wo.
@wp.func
def surface_at(scene: SceneData, face: wp.int32, u: wp.float32, v: wp.float32, wo: wp.vec3) -> Surface:
    return with_color(scene, surface_shape(scene, face, u, v, wo))


@wp.func
def shading_normal(s: Surface) -> wp.vec3:
    return wp.vec3(s.shading[0, 2], s.shading[1, 2], s.shading[2, 2])


# Where a ray starts that leaves the surface to the side of `normal`.
@wp.func
def ray_origin(s: Surface) -> wp.vec3:
    return s.position + s.normal * s.offset
