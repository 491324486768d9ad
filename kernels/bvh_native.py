"""Native code of the CPU's ray queries (bvh.py): the layout of the eight-wide tree, and the alpha test.

Node, 56 words: six rows of eight floats, the low x, y, z and high x, y, z of its children's boxes; eight children.
Block, 80 words: nine rows of eight floats, the x, y, z of vertices 0, 1, 2 of its triangles; eight face words. A child
is where a node starts or the complement of where a block starts, in steps of 32 bytes. Block 0 is empty and stands
for no child. The triangle test is Woop, Benthin, Wald: "Watertight Ray/Triangle Intersection" (JCGT 2013), so no ray
slips through an edge or vertex that triangles share.
"""

STEP_WORDS = 8  # 32 bytes
NODE_STEPS = 7
BLOCK_STEPS = 10
NODE_WORDS = NODE_STEPS * STEP_WORDS
BLOCK_WORDS = BLOCK_STEPS * STEP_WORDS
LANES = 8  # triangles in a block
FACE_WORD = 9 * LANES  # of a block, the first
FACE_MASKED = 1 << 30  # flag in a face word; -1 marks an empty lane
STACK_SIZE = 512  # 7 for each level of a tree that is at most 70 deep
LAYOUT = {
    "NODE_STEPS": NODE_STEPS,
    "BLOCK_STEPS": BLOCK_STEPS,
    "NODE_WORDS": NODE_WORDS,
    "BLOCK_WORDS": BLOCK_WORDS,
    "LANES": LANES,
    "FACE_WORD": FACE_WORD,
    "FACE_MASKED": FACE_MASKED,
    "STACK_SIZE": STACK_SIZE,
}


def cpu_only(snippet: str, otherwise: str = "", **constants: float) -> str:
    """Return the snippet with named constants filled in; CUDA, without clang's vector types, sees ``otherwise``."""
    constants = {**LAYOUT, **constants}
    for name, value in constants.items():
        snippet = snippet.replace(name, repr(value) + ("f" if isinstance(value, float) else ""))
    return f"#if !defined(__CUDA_ARCH__)\n{snippet}\n#else\n{otherwise}\n#endif\n;"


# The coverage of `face` at barycentrics u, v: its alpha, or 0 or 1 where its mask has a cutoff. Needs the arrays of Bvh
# in scope.
ALPHA = """
    const auto& mask = masks[face_masks[face]];
    const wp::vec3i corner = indices[face];
    const auto texture_alpha = [&](int index) -> float {
        const auto& texture = textures[index];
        const wp::vec2 uv0 = uvs[corner[0]], uv1 = uvs[corner[1]], uv2 = uvs[corner[2]];
        int texel[2][2];  // axis, lower and upper neighbour
        float fraction[2];
        for (int axis = 0; axis < 2; ++axis) {
            const int count = axis ? texture.height : texture.width;
            const int wrap = axis ? texture.wrap_v : texture.wrap_u;
            float at = (1.0f - u - v) * uv0[axis] + u * uv1[axis] + v * uv2[axis];
            if (wrap == 0) at -= wp::floor(at);
            else if (wrap == 1) at = at < 0.0f ? 0.0f : (at > 1.0f ? 1.0f : at);
            else at -= 2.0f * wp::floor(0.5f * at);
            at = at * (float)count - 0.5f;
            if (texture.nearest) at = wp::floor(at + 0.5f);
            const float low = wp::floor(at);
            fraction[axis] = at - low;
            for (int side = 0; side < 2; ++side) {
                int i = (int)low + side;
                if (wrap == 0) i = i < 0 ? i + count : (i >= count ? i - count : i);
                else if (wrap == 2) i = i < 0 ? 0 : (i >= 2 * count ? 0 : (i >= count ? 2 * count - 1 - i : i));
                texel[axis][side] = i < 0 ? 0 : (i >= count ? count - 1 : i);
            }
        }
        float sum = 0.0f;
        for (int corner_index = 0; corner_index < 4; ++corner_index) {
            const int right = corner_index & 1, up = corner_index >> 1;
            const float weight = (right ? fraction[0] : 1.0f - fraction[0]) * (up ? fraction[1] : 1.0f - fraction[1]);
            const int at = texture.start + texel[1][up] * texture.width + texel[0][right];
            sum += weight * (float)(texels[at] >> 24);
        }
        return sum * (1.0f / 255.0f);
    };
    float alpha = mask.factor;
    if (alphas) alpha *= (1.0f - u - v) * alphas[corner[0]] + u * alphas[corner[1]] + v * alphas[corner[2]];
    if (mask.texture >= 0) alpha *= texture_alpha(mask.texture);
    if (mask.cutoff >= 0.0f) alpha = alpha < mask.cutoff ? 0.0f : 1.0f;
"""

# What goes straight through glass in the direction `way`, of the light that meets its surface: what its one interface
# does not reflect (Schlick's Fresnel term on the triangle's plane), times its transmission and the luminance of its
# tint, as in KHR_materials_transmission; and `entering`, the same without Fresnel's term. Follows ALPHA.
THROUGH = """
    float through = mask.through, entering = 0.0f;
    if (through > 0.0f) {
        if (mask.through_texture >= 0) through *= texture_alpha(mask.through_texture);
        entering = through;
        const wp::vec3 p0 = points[corner[0]], p1 = points[corner[1]], p2 = points[corner[2]];
        const float ax = p1[0] - p0[0], ay = p1[1] - p0[1], az = p1[2] - p0[2];
        const float bx = p2[0] - p0[0], by = p2[1] - p0[1], bz = p2[2] - p0[2];
        const float nx = ay * bz - az * by, ny = az * bx - ax * bz, nz = ax * by - ay * bx;
        const float facing = nx * way[0] + ny * way[1] + nz * way[2];
        const float length = (nx * nx + ny * ny + nz * nz) * (way[0] * way[0] + way[1] * way[1] + way[2] * way[2]);
        const float cosine = wp::min(wp::abs(facing) / wp::sqrt(wp::max(length, 1e-37f)), 1.0f);
        const float m = 1.0f - cosine, m2 = m * m, s = m2 * m2 * m;
        through *= 1.0f - wp::min(mask.f0 + (mask.f90 - mask.f0) * s, 1.0f);
    }
"""

# Whether the ray passes through `face`: by chance, unless its coverage is 0, or is 1 and it is no glass. Chance is a
# hash of the ray's own bits, of the triangle and of Bvh.salt. So queries for closest and for any hit agree, triangles
# along a ray are independent, and no ray needs a state. Needs ALPHA's arrays in scope, the ray's `start` and `way`, and
# of Bvh `points`, `salt` and `chance`.
TRANSPARENT = (
    ALPHA
    + """
    if (chance == 2) return alpha < 1e-4f;
    if (chance == 3) return alpha < 1.0f || mask.through > 0.0f;
    if (alpha <= 0.0f) return true;
    float stops = alpha;
    if (mask.through > 0.0f) {
"""
    + THROUGH
    + """
        stops *= 1.0f - through;
    }
    if (stops >= 1.0f) return false;
    union { float number; unsigned bits; } words[6];
    for (int axis = 0; axis < 3; ++axis) {
        words[axis].number = start[axis];
        words[3 + axis].number = way[axis];
    }
    unsigned long long hash = (unsigned long long)salt << 32 | (unsigned)face;
    for (int pair = 0; pair < 3; ++pair) {
        hash ^= hash >> 29;
        hash = hash * 0xBF58476D1CE4E5B9ull + ((unsigned long long)words[pair].bits << 32 | words[3 + pair].bits);
    }
    hash = (hash ^ hash >> 30) * 0xBF58476D1CE4E5B9ull;  // splitmix64
    hash = (hash ^ hash >> 27) * 0x94D049BB133111EBull;
    return (float)(unsigned)(hash >> 40) * 0x1p-24f >= stops;
"""
)
