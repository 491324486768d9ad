"""Kernels of the suite ``transfer``: the paper's glossy products at pixels and at vertices, each in three forms.

What the library itself does, TPFL, is ``transfer_products.glossy_product``. The paper's triple product (TP) is a sum
over the tripling coefficients that are not 0, once for each channel; reordered, the part without light comes first.
"""

import warp as wp

from warp_gi.kernels.atlas import SurfaceAtlas
from warp_gi.kernels.gbuffer import PrimaryHits, tiled_pixel
from warp_gi.kernels.surface import shading_normal, surface_at
from warp_gi.kernels.transfer_light import TransferRows, is_kept, surface_slots
from warp_gi.kernels.transfer_products import glossy_product, vec6
from warp_gi.kernels.transfer_snippets import HARMONICS, HAS_VECTOR_HALVES
from warp_gi.kernels.types import SceneData

wp.set_module_options({"enable_backward": False})

TP = wp.constant(0)
REORDERED = wp.constant(1)
TPFL = wp.constant(2)

# Sums over entries value, i | j << 8 | k << 16 of the table C_ijk, with T blended from rows of 32 halves.
_SPARSE = (
    HARMONICS
    + f"""
    wp::vec_t<3, float> result;
    float f[32] = {{}}, t[32] = {{}}, g[32] = {{}};
    harmonics(direction[0], direction[1], direction[2], 5, [&](int k, float value) {{ f[k] = value; }});
    for (int l = 0, k = 0; l < 5; ++l) for (int m = 0; m < 2 * l + 1; ++m, ++k) f[k] *= lobe[l];
    for (int k = 0; k < 4; ++k) {{
        if (shares[k] == 0.0f) continue;
        const wp::half* row = transfer.data + (size_t)slots[k] * 32;
#if {HAS_VECTOR_HALVES}
        _Float16 numbers[32];
        __builtin_memcpy(numbers, row, 64);
#else
        const wp::half* numbers = row;
#endif
        for (int i = 0; i < 25; ++i) t[i] += static_cast<float>(numbers[i]) * shares[k];
    }}
    auto each = [&](auto add) {{
        for (int n = 0; n < terms.shape[0]; ++n) {{
            const int e = terms.data[n];
            add(e & 255, (e >> 8) & 255, e >> 16, values.data[n]);
        }}
    }};
    if (reordered) each([&](int i, int j, int k, float value) {{ g[i] += value * t[j] * f[k]; }});
    for (int c = 0; c < 3; ++c) {{
        const float* sky = light.data + c * 32;
        float p[32] = {{}};
        if (!reordered) each([&](int i, int j, int k, float value) {{ p[k] += value * sky[i] * t[j]; }});
        for (int i = 0; i < 25; ++i) result[c] += reordered ? sky[i] * g[i] : p[i] * f[i];
    }}
    return result;
"""
)


@wp.func_native(snippet=_SPARSE)
def sparse_product(
    transfer: wp.array2d(dtype=wp.float16),
    slots: wp.vec4i,
    shares: wp.vec4,
    light: wp.array(dtype=wp.float32),
    direction: wp.vec3,
    lobe: vec6,
    terms: wp.array(dtype=wp.int32),
    values: wp.array(dtype=wp.float32),
    reordered: wp.int32,
) -> wp.vec3: ...


# A sky and a lobe, and which form of the product is taken.
@wp.struct
class ProductQuery:
    light: wp.array(dtype=wp.float32)  # [3, 32]
    matrix: wp.array(dtype=wp.float32)  # [25, 3, 32]
    terms: wp.array(dtype=wp.int32)  # i | j << 8 | k << 16
    values: wp.array(dtype=wp.float32)  # C_ijk
    lobe: vec6  # factors of a lobe about the mirrored view
    form: wp.int32


# Vertices as a vertex shader gets them.
@wp.struct
class ProductVertices:
    points: wp.array(dtype=wp.vec3)
    normals: wp.array(dtype=wp.vec3)  # unit
    eye: wp.vec3


@wp.func
def product(
    transfer: wp.array2d(dtype=wp.float16),
    slots: wp.vec4i,
    shares: wp.vec4,
    query: ProductQuery,
    normal: wp.vec3,
    view: wp.vec3,
) -> wp.vec3:
    direction = 2.0 * wp.dot(normal, view) * normal - view
    if query.form == TPFL:
        none = wp.vec4(0.0, 0.0, 0.0, 0.0)
        p = glossy_product(transfer, slots, shares, query.matrix, direction, query.lobe, normal, none)
        return wp.vec3(p[0], p[1], p[2])
    q = query
    return sparse_product(transfer, slots, shares, q.light, direction, q.lobe, q.terms, q.values, q.form)


# Thread: a pixel. Light that its surface reflects, by textures.
@wp.kernel(enable_backward=False)
def evaluate_pixels(
    first: wp.int32,
    scene: SceneData,
    rows: TransferRows,
    query: ProductQuery,
    hits: PrimaryHits,
    width: wp.int32,
    height: wp.int32,
    colors: wp.array(dtype=wp.vec3),
):
    p = tiled_pixel(first + wp.tid(), width)
    if p[0] >= width or p[1] >= height:
        return
    pixel = p[1] * width + p[0]
    face = hits.face[pixel]
    if face < 0:
        return
    view = -hits.direction[pixel]
    s = surface_at(scene, face, hits.u[pixel], hits.v[pixel], view)
    at = surface_slots(rows, scene, s, face, hits.u[pixel], hits.v[pixel])
    if is_kept(at):
        colors[pixel] = product(rows.transfer, at.slots, at.shares, query, shading_normal(s), view)


# Thread: a vertex. Light that it reflects.
@wp.kernel(enable_backward=False)
def evaluate_vertices(
    first: wp.int32,
    transfer: wp.array2d(dtype=wp.float16),
    query: ProductQuery,
    vertices: ProductVertices,
    colors: wp.array(dtype=wp.vec3),
):
    vertex = first + wp.tid()
    view = wp.normalize(vertices.eye - vertices.points[vertex])
    slots = wp.vec4i(vertex, 0, 0, 0)
    shares = wp.vec4(1.0, 0.0, 0.0, 0.0)
    colors[vertex] = product(transfer, slots, shares, query, vertices.normals[vertex], view)


# Thread: a pixel. The colours of the vertices of its face, interpolated.
@wp.kernel(enable_backward=False)
def interpolate_vertices(
    first: wp.int32,
    atlas: SurfaceAtlas,
    vertex_colors: wp.array(dtype=wp.vec3),
    hits: PrimaryHits,
    width: wp.int32,
    height: wp.int32,
    colors: wp.array(dtype=wp.vec3),
):
    p = tiled_pixel(first + wp.tid(), width)
    if p[0] >= width or p[1] >= height:
        return
    pixel = p[1] * width + p[0]
    face = hits.face[pixel]
    if face < 0:
        return
    c = atlas.corner_slots[0, face]
    if c[0] >= 0:
        u = hits.u[pixel]
        v = hits.v[pixel]
        colors[pixel] = vertex_colors[c[0]] * (1.0 - u - v) + vertex_colors[c[1]] * u + vertex_colors[c[2]] * v
