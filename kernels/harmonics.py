"""Real spherical harmonics of order 3: nine functions, the low frequencies of a sky (Ramamoorthi and Hanrahan 2001).

Y_0 = 1/2 sqrt(1/pi); Y_1..3 = sqrt(3/(4 pi)) (y, z, x); Y_4, Y_5, Y_7 = 1/2 sqrt(15/pi) (xy, yz, xz);
Y_6 = 1/4 sqrt(5/pi) (3 z^2 - 1); Y_8 = 1/4 sqrt(15/pi) (x^2 - y^2).
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

vec9 = wp.types.vector(length=9, dtype=wp.float32)
Harmonics = wp.types.matrix(shape=(3, 9), dtype=wp.float32)  # coefficients of red, green, blue


# The nine functions at a unit direction.
@wp.func
def harmonics(d: wp.vec3) -> vec9:
    x = d[0]
    y = d[1]
    z = d[2]
    return vec9(
        0.282094792,
        0.488602512 * y,
        0.488602512 * z,
        0.488602512 * x,
        1.092548431 * x * y,
        1.092548431 * y * z,
        0.315391565 * (3.0 * z * z - 1.0),
        1.092548431 * x * z,
        0.546274215 * (x * x - y * y),
    )


# The integrals of each function times max(0, n . w) / pi over the sphere: what a Lambert surface of albedo 1 with
# normal n reflects of it. Zonal factors A_l / pi = 1, 2/3, 1/4 (their Eq. 8).
@wp.func
def cosine_harmonics(n: wp.vec3) -> vec9:
    y = harmonics(n)
    for i in range(1, 4):
        y[i] = y[i] * (2.0 / 3.0)
    for i in range(4, 9):
        y[i] = y[i] * 0.25
    return y
