"""Native code of the CPU's queries for coherent rays: sixteen go down the tree together, with their hits and limits.

A packet is split by the octant and the dominant axis of its directions. A part first tests a node's eight boxes against
bounds on all of its rays (Embree's and Boulos' interval test), then its rays against each box that is left. Where few
rays enter a box, each goes on alone with the code for single rays. The hits are those of single rays, but where faces
coincide. Vectors are clang's portable ones, of 512 bits: two of 256 bits on CPUs without AVX-512.
"""

from warp_gi.kernels.bvh_native import cpu_only
from warp_gi.kernels.bvh_queries_native import ANY_METHODS, BVH, CLOSEST_METHODS

FEW = 2  # rays that go on alone


def _apart(axis: int) -> str:
    """Return code for one axis of sixteen vectors in `a`, `b` and `c`."""
    places = [3 * ray + axis for ray in range(16)]
    first = ", ".join(str(at if at < 32 else 0) for at in places)
    second = ", ".join(str(ray if at < 32 else at - 16) for ray, at in enumerate(places))
    return f"""            parts[{axis}] = __builtin_shufflevector(
                __builtin_shufflevector(a, b, {first}), c, {second}
            );"""


APART = "\n".join(_apart(axis) for axis in range(3))

# The rays, and the parts that go down together. Rounding is as in Ray: slopes and offsets are the same numbers.
PACKET_STRUCT = """
    typedef float Floats __attribute__((vector_size(64)));
    typedef int Ints __attribute__((vector_size(64)));
    typedef bool Bools __attribute__((ext_vector_type(16)));

    struct Packet {
        Floats origin[3], way[3], limit;
        Floats near_slope[3], near_offset[3], far_slope[3], far_offset[3];
        Ints part;  // of each ray: signs of its direction and its dominant axis; -1 for none
        Floats shear_x, shear_y, inverse_z;
        // of the part that is on its way:
        Ints taken;
        f8 least_slope[3], most_slope[3], near_origin[3], far_origin[3];
        float farthest, widest;  // the largest limit; the largest coordinate of origins
        int near_row[3], far_row[3], x, y, z;  // x, y, z: axes, the dominant one last

        static inline Floats low(Floats a, Floats b) { return a < b ? a : b; }
        static inline Floats high(Floats a, Floats b) { return a > b ? a : b; }
        static inline unsigned bits(Ints mask) {
            return __builtin_bit_cast(unsigned short, __builtin_convertvector(mask, Bools));
        }
        static inline float least(Floats a) {
            a = low(a, __builtin_shufflevector(a, a, 8, 9, 10, 11, 12, 13, 14, 15, 0, 1, 2, 3, 4, 5, 6, 7));
            a = low(a, __builtin_shufflevector(a, a, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 0, 1, 2, 3));
            a = low(a, __builtin_shufflevector(a, a, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 0, 1));
            a = low(a, __builtin_shufflevector(a, a, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 0));
            return a[0];
        }
        static inline float most(Floats a) { return -least(-a); }

        // Returns which rays are not finite or have a direction of no common length: they are for Ray.
        inline unsigned setup() {
            const Floats none = {};
            Floats size[3];
            for (int axis = 0; axis < 3; ++axis) size[axis] = high(way[axis], -way[axis]);
            const Floats largest = high(high(size[0], size[1]), size[2]), sum = size[0] + size[1] + size[2];
            const Floats far = high(origin[0], -origin[0]) + high(origin[1], -origin[1]) + high(origin[2], -origin[2]);
            const Ints common = (largest >= 1e-6f) & (sum <= 1e6f) & (far <= 3e38f);
            const Ints dominant = ((size[0] > size[1]) & (size[0] > size[2])) ? (Ints)none
                : ((size[1] > size[2]) & ~(size[0] > size[1]) ? (Ints)none + 1 : (Ints)none + 2);
            part = dominant << 3;
            for (int axis = 0; axis < 3; ++axis) {
                const Floats tiny = way[axis] < 0.0f ? none - 1e-20f : none + 1e-20f;
                const Floats inverse = 1.0f / (size[axis] > 1e-20f ? way[axis] : tiny);
                const Floats offset = -origin[axis] * inverse, error = high(offset, -offset) * 2e-7f;
                near_slope[axis] = inverse, near_offset[axis] = offset - error;
                far_slope[axis] = inverse * 1.000001f, far_offset[axis] = (offset + error) * 1.000001f;
                part |= (way[axis] < 0.0f) & (1 << axis);
            }
            part = (common & (limit > 0.0f)) ? part : (Ints)none - 1;
            return bits(~common);
        }

        // Takes the rays of one part on their way.
        inline void take(int which) {
            taken = part == which;
            x = (which >> 3) == 2 ? 0 : (which >> 3) + 1, y = (which >> 3) == 0 ? 2 : (which >> 3) - 1, z = which >> 3;
            inverse_z = near_slope[z], shear_x = way[x] / way[z], shear_y = way[y] / way[z];
            const Floats none = {}, far_away = none + 3.4e38f;
            widest = 0.0f;
            for (int axis = 0; axis < 3; ++axis) {
                const bool down = which >> axis & 1;
                near_row[axis] = 32 * axis + (down ? 96 : 0), far_row[axis] = 32 * axis + (down ? 0 : 96);
                least_slope[axis] = least(taken ? near_slope[axis] : far_away) - (f8) {};
                most_slope[axis] = most(taken ? near_slope[axis] : -far_away) - (f8) {};
                const float least_origin = least(taken ? origin[axis] : far_away);
                const float most_origin = most(taken ? origin[axis] : -far_away);
                widest = wp::max(widest, wp::max(most_origin, -least_origin));
                near_origin[axis] = (down ? least_origin : most_origin) - (f8) {};
                far_origin[axis] = (down ? most_origin : least_origin) - (f8) {};
            }
            reach();
        }
        inline void reach() { farthest = most(taken ? limit : (Floats) {} - 1.0f); }

        // Bits of the children that some ray may enter before its limit, and bounds on their entry distances.
        inline unsigned children(const char* node, f8& entry) const {
            f8 near[3], far[3];
            for (int axis = 0; axis < 3; ++axis) {
                const f8 a = *(const f8*)(node + near_row[axis]) - near_origin[axis];
                const f8 b = *(const f8*)(node + far_row[axis]) - far_origin[axis];
                near[axis] = Ray::low(a * least_slope[axis], a * most_slope[axis]);
                far[axis] = Ray::high(b * least_slope[axis], b * most_slope[axis]);
            }
            entry = Ray::high(Ray::high(near[0], near[1]), Ray::high(near[2], (f8) {})) * 0.999998f;
            const f8 leave = Ray::low(Ray::low(far[0], far[1]), Ray::low(far[2], farthest - (f8) {})) * 1.000002f;
            return Ray::bits(entry <= leave);
        }

        // Bits of a block's triangles that some ray may meet: by their boxes, wider than rounding in `triangle`.
        inline unsigned near(const float* block) const {
            f8 low[3], high[3], largest = {};
            for (int axis = 0; axis < 3; ++axis) {
                const f8 a = *(const f8*)(block + LANES * axis), b = *(const f8*)(block + LANES * (3 + axis));
                const f8 c = *(const f8*)(block + LANES * (6 + axis));
                low[axis] = Ray::low(Ray::low(a, b), c), high[axis] = Ray::high(Ray::high(a, b), c);
                largest = Ray::high(largest, Ray::high(high[axis], -low[axis]));
            }
            const f8 pad = (largest + widest) * 1e-6f;
            f8 enter = {}, leave = farthest - (f8) {};
            for (int axis = 0; axis < 3; ++axis) {
                const bool down = near_row[axis] > far_row[axis];
                const f8 under = low[axis] - pad, over = high[axis] + pad;
                const f8 a = (down ? over : under) - near_origin[axis], b = (down ? under : over) - far_origin[axis];
                enter = Ray::high(enter, Ray::low(a * least_slope[axis], a * most_slope[axis]));
                leave = Ray::low(leave, Ray::high(b * least_slope[axis], b * most_slope[axis]));
            }
            const i8 faces = *(const i8*)((const int*)block + FACE_WORD);
            return Ray::bits((enter * 0.999998f <= leave * 1.000002f) & (faces >= 0));
        }

        // The rays that enter a child before their limit.
        inline Ints enter(const char* node, int child, Floats& entry) const {
#pragma clang fp contract(fast)
            Floats near[3], far[3];
            for (int axis = 0; axis < 3; ++axis) {
                const float a = ((const float*)(node + near_row[axis]))[child];
                const float b = ((const float*)(node + far_row[axis]))[child];
                near[axis] = a * near_slope[axis] + near_offset[axis];
                far[axis] = b * far_slope[axis] + far_offset[axis];
            }
            entry = high(high(near[0], near[1]), high(near[2], (Floats) {}));
            return entry <= low(low(far[0], far[1]), low(far[2], limit * 1.000001f));
        }

        static inline Floats edge(Floats ax, Floats by, Floats ay, Floats bx) {
#pragma clang fp contract(off)
            return ax * by - ay * bx;
        }

        // As Ray::triangles, for one triangle and those of `active` rays.
        inline Ints triangle(const float* at, Ints active, Floats& t, Floats& u, Floats& v) const {
#pragma clang fp contract(fast)
            const Floats az = at[LANES * z] - origin[z];
            const Floats bz = at[LANES * (3 + z)] - origin[z];
            const Floats cz = at[LANES * (6 + z)] - origin[z];
            const Floats ax = (at[LANES * x] - origin[x]) - shear_x * az;
            const Floats ay = (at[LANES * y] - origin[y]) - shear_y * az;
            const Floats bx = (at[LANES * (3 + x)] - origin[x]) - shear_x * bz;
            const Floats by = (at[LANES * (3 + y)] - origin[y]) - shear_y * bz;
            const Floats cx = (at[LANES * (6 + x)] - origin[x]) - shear_x * cz;
            const Floats cy = (at[LANES * (6 + y)] - origin[y]) - shear_y * cz;
            const Floats wa = edge(cx, by, cy, bx), wb = edge(ax, cy, ay, cx), wc = edge(bx, ay, by, ax);
            const Ints inside = ((low(low(wa, wb), wc) >= 0.0f) | (high(high(wa, wb), wc) <= 0.0f)) & active;
            if (!bits(inside)) return inside;
            const Floats inverse = 1.0f / (wa + wb + wc);
            t = (wa * az + wb * bz + wc * cz) * inverse * inverse_z;
            u = wb * inverse;
            v = wc * inverse;
            return inside & (t > 0.0f) & (t < limit);
        }

        // Sixteen vectors that follow each other, by axis.
        static inline void apart(const void* at, Floats* parts) {
            struct __attribute__((packed)) Loose { Floats lanes; };
            const Loose* from = (const Loose*)at;
            const Floats a = from[0].lanes, b = from[1].lanes, c = from[2].lanes;
APART
        }

        inline f4 start_of(int i) const { return (f4) {origin[0][i], origin[1][i], origin[2][i], 0.0f}; }
        inline f4 way_of(int i) const { return (f4) {way[0][i], way[1][i], way[2][i], 0.0f}; }
    };
""".replace("APART", APART)

# Methods of Query. `lead` makes the query that of one ray, whose set-up is kept in `alone`.
TOGETHER = """
        inline void lead(const Packet& packet, int i) { start = packet.start_of(i), way = packet.way_of(i); }
        inline const Ray& ray_of(const Packet& packet, Ray* alone, unsigned& ready, int i) {
            if (!(ready >> i & 1)) {
                f4 d = packet.way_of(i);
                d[3] = 1.0f;
                alone[i].setup(packet.start_of(i), d);
                ready |= 1u << i;
            }
            return alone[i];
        }
        // Clears the lanes of `hit` whose rays pass through the masked triangle.
        __attribute__((noinline, cold)) void pass(
            const Packet& packet, int face, const Floats& u, const Floats& v, Ints& hit
        ) {
            for (unsigned left = Packet::bits(hit); left; left &= left - 1) {
                const int i = __builtin_ctz(left);
                lead(packet, i);
                if (transparent(face & ~FACE_MASKED, u[i], v[i])) hit[i] = 0;
            }
        }
"""

# Bits of the rays that something is in the way of.
ANY_PACKET = (
    ANY_METHODS.replace("struct Query {", PACKET_STRUCT + "\n    struct Query {")
    + TOGETHER
    + """
        __attribute__((noinline)) unsigned together(Packet& packet) {
            unsigned done = 0, ready = 0;
            Ray alone[16];
            for (unsigned odd = packet.setup(); odd; odd &= odd - 1) {
                const int i = __builtin_ctz(odd);
                lead(packet, i);
                if (run(start[0], start[1], start[2], way[0], way[1], way[2], packet.limit[i], 0)) done |= 1u << i;
            }
            int stack[STACK_SIZE];
            unsigned lanes[STACK_SIZE];
            unsigned waiting = Packet::bits(packet.part >= 0);
            while (waiting) {
                packet.take(packet.part[__builtin_ctz(waiting)]);
                const unsigned rays = Packet::bits(packet.taken);
                waiting &= ~rays;
                int size = 1;
                stack[0] = 0, lanes[0] = rays;
                while (size) {
                    const int child = stack[--size];
                    const unsigned active = lanes[size] & ~done;
                    if (!active) continue;
                    if (__builtin_popcount(active) <= FEW) {
                        for (unsigned left = active; left; left &= left - 1) {
                            const int i = __builtin_ctz(left);
                            lead(packet, i);
                            const Ray& ray = ray_of(packet, alone, ready, i);
                            if (below(ray, packet.limit[i], child, false)) done |= 1u << i;
                        }
                    } else if (child >= 0) {
                        const char* node = node_at(child);
                        f8 bound;
                        Floats entry;
                        for (unsigned left = packet.children(node, bound); left; left &= left - 1) {
                            const int c = __builtin_ctz(left);  // the most promising is the last
                            const unsigned inside = Packet::bits(packet.enter(node, c, entry)) & active;
                            stack[size] = ((const int*)(node + 192))[c], lanes[size] = inside;
                            size += inside != 0;
                        }
                    } else {
                        const float* block = block_at(child);
                        const Bools lanes_left = __builtin_bit_cast(Bools, (unsigned short)active);
                        Ints left = __builtin_convertvector(lanes_left, Ints) != 0;
                        for (unsigned some = packet.near(block); some; some &= some - 1) {
                            const int lane = __builtin_ctz(some), face = ((const int*)block)[FACE_WORD + lane];
                            Floats t, u, v;
                            Ints hit = packet.triangle(block + lane, left, t, u, v);
                            if (!Packet::bits(hit)) continue;
                            if (__builtin_expect(face & FACE_MASKED, 0)) pass(packet, face, u, v, hit);
                            left &= ~hit;
                            done |= Packet::bits(hit);
                            if (!Packet::bits(left)) break;
                        }
                    }
                }
            }
            return done;
        }
    };
"""
)

CLOSEST_PACKET = (
    CLOSEST_METHODS.replace("struct Query {", PACKET_STRUCT + "\n    struct Query {")
    + TOGETHER
    + """
        // Puts the closest hits in `hits`.
        __attribute__((noinline)) void together(Packet& packet, wp::vec4* hits) {
            unsigned ready = 0;
            Ray alone[16];
            const Floats t_max = packet.limit;
            const float* nearest_at[16];
            for (int i = 0; i < 16; ++i) {
                nearest_at[i] = nullptr;
                hits[i] = wp::vec4(t_max[i], 0.0f, 0.0f, __builtin_bit_cast(float, -1));
            }
            for (unsigned odd = packet.setup(); odd; odd &= odd - 1) {
                const int i = __builtin_ctz(odd);
                lead(packet, i);
                hits[i] = run(start[0], start[1], start[2], way[0], way[1], way[2], t_max[i]);
            }
            int stack[STACK_SIZE];
            Floats entries[STACK_SIZE];
            unsigned waiting = Packet::bits(packet.part >= 0);
            while (waiting) {
                packet.take(packet.part[__builtin_ctz(waiting)]);
                waiting &= ~Packet::bits(packet.taken);
                const Floats never = (Floats) {} + __builtin_inff();
                int size = 1;
                stack[0] = 0, entries[0] = packet.taken ? (Floats) {} : never;
                while (size) {
                    const int child = stack[--size];
                    const Ints active = (entries[size] <= packet.limit * 1.000001f) & (entries[size] < never);
                    const unsigned rays = Packet::bits(active);
                    if (!rays) continue;
                    if (__builtin_popcount(rays) <= FEW) {
                        for (unsigned left = rays; left; left &= left - 1) {
                            const int i = __builtin_ctz(left);
                            lead(packet, i);
                            float limit = packet.limit[i];
                            below(ray_of(packet, alone, ready, i), limit, child, nearest_at[i], hits[i]);
                            packet.limit[i] = limit;
                        }
                        packet.reach();
                    } else if (child >= 0) {
                        const char* node = node_at(child);
                        f8 bound;
                        unsigned keys[8];
                        int count = 0;
                        const unsigned found = packet.children(node, bound);
                        const i8 lanes = {0, 1, 2, 3, 4, 5, 6, 7};
                        const i8 all = ((i8)bound & ~7) | lanes;  // not negative: ordered like their bits
                        for (unsigned left = found; left; left &= left - 1) {
                            const unsigned key = (unsigned)all[__builtin_ctz(left)];
                            int at = count++;
                            while (at > 0 && keys[at - 1] < key) { keys[at] = keys[at - 1]; --at; }
                            keys[at] = key;
                        }
                        for (int k = 0; k < count; ++k) {  // the nearest last
                            const int c = keys[k] & 7;
                            Floats entry;
                            const Ints inside = packet.enter(node, c, entry) & active;
                            stack[size] = ((const int*)(node + 192))[c], entries[size] = inside ? entry : never;
                            size += Packet::bits(inside) != 0;
                        }
                    } else {
                        const float* block = block_at(child);
                        unsigned changed = 0;
                        for (unsigned some = packet.near(block); some; some &= some - 1) {
                            const int lane = __builtin_ctz(some), face = ((const int*)block)[FACE_WORD + lane];
                            Floats t, u, v;
                            Ints hit = packet.triangle(block + lane, active, t, u, v);
                            if (!Packet::bits(hit)) continue;
                            if (__builtin_expect(face & FACE_MASKED, 0)) pass(packet, face, u, v, hit);
                            packet.limit = hit ? t : packet.limit;
                            const unsigned met = Packet::bits(hit);
                            changed |= met;
                            for (unsigned left = met; left; left &= left - 1) {
                                const int i = __builtin_ctz(left);
                                nearest_at[i] = block + lane;
                                hits[i] = wp::vec4(t[i], u[i], v[i], 0.0f);
                            }
                        }
                        if (changed) packet.reach();
                    }
                }
            }
            for (int i = 0; i < 16; ++i) {
                if (!nearest_at[i]) continue;
                lead(packet, i);
                hits[i] = exact(nearest_at[i], t_max[i], hits[i]);
            }
        }
    };
"""
)

# Rays `begin` to `end` - 1 of a batch, sixteen at a time. What stands for a missing ray has no limit.
PACKETS = (
    "Query query = {"
    + BVH
    + """
        {}, {}
    };
    const bool ordered = rays.order.shape[0] > 0;
    const int last_limit = (int)rays.t_max.shape[0] - 1;
    const bool limited = last_limit > 0;
    for (int item = begin; item < end; item += 16) {
        const int count = end - item < 16 ? end - item : 16;
        Packet packet;
        int index[16];
        if (!ordered && count == 16) {
            Packet::apart(rays.origins.data + item, packet.origin);
            Packet::apart(rays.directions.data + item, packet.way);
            for (int k = 0; k < 16; ++k) index[k] = item + k;
            const char* limits = (const char*)rays.t_max.data;
            if (!limited) packet.limit = *(const float*)limits - (Floats) {};
            else for (int k = 0; k < 16; ++k)
                packet.limit[k] = *(const float*)(limits + (item + k) * (long long)rays.t_max.strides[0]);
        } else
        for (int k = 0; k < 16; ++k) {
            const int at = item + (k < count ? k : 0), i = ordered ? (int)rays.order.data[at] : at;
            const wp::vec3 o = rays.origins.data[i], d = rays.directions.data[i];
            for (int axis = 0; axis < 3; ++axis) packet.origin[axis][k] = o[axis], packet.way[axis][k] = d[axis];
            const long long limit_at = (long long)(i < last_limit ? i : last_limit) * rays.t_max.strides[0];
            packet.limit[k] = k < count ? *(const float*)((const char*)rays.t_max.data + limit_at) : -1.0f;
            index[k] = i;
        }
        %s
    }
"""
)

OCCLUDED_PACKETS = cpu_only(
    ANY_PACKET
    + PACKETS
    % """const unsigned met = query.together(packet);
        for (int k = 0; k < count; ++k) occluded.data[index[k]] = met >> k & 1;""",
    FEW=FEW,
)
INTERSECT_PACKETS = cpu_only(
    CLOSEST_PACKET
    + PACKETS
    % """wp::vec4 found[16];
        query.together(packet, found);
        for (int k = 0; k < count; ++k) {
            const int i = index[k];
            hits.t.data[i] = found[k][0], hits.u.data[i] = found[k][1], hits.v.data[i] = found[k][2];
            hits.face.data[i] = __builtin_bit_cast(int, found[k][3]);
        }""",
    FEW=FEW,
)
# Closest hits of a square of 4 x 4 pixels of a picture. Their origins are in t, u, v.
INTERSECT_PIXELS = cpu_only(
    CLOSEST_PACKET
    + "Query query = {"
    + BVH
    + """
        {}, {}
    };
    Packet packet;
    int index[16];
    for (int k = 0; k < 16; ++k) {
        const bool seen = x + (k & 3) < width && y + (k >> 2) < height;
        const int i = seen ? (y + (k >> 2)) * width + x + (k & 3) : y * width + x;
        const wp::vec3 d = hits.direction.data[i];
        packet.origin[0][k] = hits.t.data[i], packet.origin[1][k] = hits.u.data[i];
        packet.origin[2][k] = hits.v.data[i];
        for (int axis = 0; axis < 3; ++axis) packet.way[axis][k] = d[axis];
        packet.limit[k] = seen ? __builtin_inff() : -1.0f;
        index[k] = seen ? i : -1;
    }
    wp::vec4 found[16];
    query.together(packet, found);
    for (int k = 0; k < 16; ++k) {
        const int i = index[k];
        if (i < 0) continue;
        hits.t.data[i] = found[k][0], hits.u.data[i] = found[k][1], hits.v.data[i] = found[k][2];
        hits.face.data[i] = __builtin_bit_cast(int, found[k][3]);
    }
""",
    FEW=FEW,
)

# Distances to what rays from one point meet, infinite for none: of a square of 4 x 4 of the `side` x `side` directions.
FAN_DISTANCES = cpu_only(
    CLOSEST_PACKET
    + "Query query = {"
    + BVH
    + """
        {}, {}
    };
    Packet packet;
    for (int k = 0; k < 16; ++k) {
        const bool inside = x + (k & 3) < side && y + (k >> 2) < side;
        const wp::vec3 d = wp::mul(frame, local.data[inside ? (y + (k >> 2)) * side + x + (k & 3) : y * side + x]);
        for (int axis = 0; axis < 3; ++axis) packet.origin[axis][k] = origin[axis], packet.way[axis][k] = d[axis];
        packet.limit[k] = inside ? __builtin_inff() : -1.0f;
    }
    wp::vec4 found[16];
    query.together(packet, found);
    for (int k = 0; k < 16; ++k)
        if (x + (k & 3) < side && y + (k >> 2) < side)
            distances.data[start + (y + (k >> 2)) * side + x + (k & 3)] = found[k][0];
""",
    FEW=FEW,
)
