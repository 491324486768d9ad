"""C++ that native code of radiance transfer shares: harmonics, the clamped cosine, and when halves convert."""

import math

import warp as wp

wp.set_module_options({"enable_backward": False})

ORDERS = (5, 6)  # of transfer
LIGHT_ORDER = wp.constant(5)  # of the sky, and so of what bounces
LIGHT_NUMBERS = wp.constant(LIGHT_ORDER**2)
MOST_NUMBERS = max(ORDERS) ** 2
# Without instructions for halves the compiler would call a library that is not there.
HAS_VECTOR_HALVES = "!defined(__CUDA_ARCH__) && (defined(__F16C__) || defined(__aarch64__))"


def clamped_cosine(order: int) -> list[float]:
    """Return A_l, the zonal factors of max(0, n . w): pi, 2 pi/3, pi/4, 0, -pi/24, 0, ...

    Source: Ramamoorthi and Hanrahan, "An Efficient Representation for Irradiance Environment Maps", Eq. 8.
    """
    result = [0.0] * order
    for l in range(order):
        if l == 1:
            result[l] = 2 * math.pi / 3
        elif l % 2 == 0:
            sign = -1.0 if l % 4 == 0 else 1.0
            result[l] = 2 * math.pi * sign / ((l + 2) * (l - 1)) * math.comb(l, l // 2) / 2**l
    return result


def _polynomial(degree: int, power: int) -> str:
    """Return K_lm d^m P_l / dz^m in z, by Horner's rule: a harmonic divided by Re or Im (x + i y)^m."""
    ratio = math.factorial(degree - power) / math.factorial(degree + power)
    scale = math.sqrt((2 * degree + 1) / (4 * math.pi) * ratio * (1 if power == 0 else 2)) / 2**degree
    text = ""
    for k in range((degree - power) // 2 + 1):
        left = degree - 2 * k
        value = (-1) ** k * math.comb(degree, k) * math.comb(left + degree, degree) * math.perm(left, power) * scale
        text = f"({text} * z2 + {value!r}f)" if text else f"{value!r}f"
    return text + " * z" * ((degree - power) % 2)


def _degree(degree: int) -> str:
    lines, center = [], degree * degree + degree
    for power in range(1, degree + 1):
        name = f"p{degree}{power}"
        lines.append(f"const auto {name} = {_polynomial(degree, power)};")
        lines.append(f"add({center + power}, {name} * c{power});")
        lines.append(f"add({center - power}, {name} * s{power});")
    even = " + 0.0f * z" if degree == 0 else ""  # makes a number as many as z has
    return "\n        ".join([f"add({center}, {_polynomial(degree, 0)}{even});", *lines])


def _powers(last: int) -> str:
    """Return c_m and s_m, the real and imaginary parts of (x + i y)^m."""
    return f"const auto c{last} = x * c{last - 1} - y * s{last - 1}, s{last} = x * s{last - 1} + y * c{last - 1};"


# Hands each real spherical harmonic at a unit direction to `add(index, value)`: 25 of them, or 36 where order > 5.
# Index l^2 + l + m, orthonormal, without the Condon-Shortley sign, polar axis z, as kernels/harmonics.py. Coordinates
# are numbers, or vectors of them.
HARMONICS = """
    auto harmonics = [](auto x, auto y, auto z, int order, auto add) {
#if !defined(__CUDA_ARCH__)
        #pragma clang fp contract(fast)
#endif
        const auto z2 = z * z;
        const auto c1 = x, s1 = y;
        LOW
        if (order <= 5) return;
        HIGH
    };
"""
HARMONICS = HARMONICS.replace("LOW", "\n        ".join([*map(_powers, (2, 3, 4)), *map(_degree, range(5))]))
HARMONICS = HARMONICS.replace("HIGH", "\n        ".join([_powers(5), _degree(5)]))
# A_l of all bands.
COSINE = f"    const float cosine[6] = {{{', '.join(f'{value!r}f' for value in clamped_cosine(max(ORDERS)))}}};\n"
