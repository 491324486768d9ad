"""Fits linearly transformed cosines to the GGX lobe of kernels/bsdf.py: ``python assets/fit_ltc.py`` writes ltc.npz.

The method is that of Heitz, Dupuy, Hill, Neubelt 2016, "Real-Time Polygonal-Light Shading with Linearly Transformed
Cosines": for each roughness and view a matrix takes the lobe D V cos(wi) (height-correlated Smith, no Fresnel) to a
clamped cosine, and two amplitudes give the lobe's integral under Schlick's Fresnel as f0 * x + f90 * y. Differences:

- what is made small is the symmetric chi-squared distance, the integral of (f - g)^2 / (f + g): weights that select
  lights should be right in ratio, in the tail too, and it lets Gauss-Newton steps replace a simplex search;
- the tilt of the lobe is fitted, not set to the mean direction;
- matrices act in the frame of the mirror direction, whose rotation the kernels put in exactly: interpolated between
  views, the lobe of a smooth surface would otherwise miss its own highlight;
- amplitudes are divided by the share of the transformed cosine above the true horizon, so that a light that covers the
  whole hemisphere gets the albedo.

Every row (one roughness) is fitted by itself, from normal to grazing views, each from the one before. Nothing is
random: the points of the integrals are midpoints of regular grids. Needs SciPy; takes about a minute.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.optimize import least_squares

SIZE = 32
SMALLEST_ALPHA = 1e-3
"""As in kernels/bsdf.py."""
SMALLEST_COS = 0.02
"""Of a view: nearer to the horizon the lobe of a smooth surface is cut off by it within its own width."""


def alpha_of(row: int, size: int = SIZE) -> float:
    """Return the alpha of a row: rows are uniform in roughness, the root of alpha."""
    return max((row / (size - 1)) ** 2, SMALLEST_ALPHA)


def cos_of(column: int, size: int = SIZE) -> float:
    """Return the view's cosine of a column: columns are uniform in sqrt(1 - cos)."""
    return max(1.0 - (column / (size - 1)) ** 2, SMALLEST_COS)


def smith_root(alpha: float, cos: np.ndarray) -> np.ndarray:
    """Return sqrt(alpha^2 + (1 - alpha^2) cos^2)."""
    return np.sqrt(alpha**2 + (1 - alpha**2) * cos**2)


def half_density(alpha: float, wo: np.ndarray, wi: np.ndarray) -> np.ndarray:
    """Return the pdf [n] of reflecting at GGX's visible normals, D / (2 (cos_o + root_o)), at ``wi`` [n, 3]."""
    h = wo + wi
    h = h / np.linalg.norm(h, axis=1, keepdims=True)
    d = alpha**2 / (np.pi * (h[:, 0] ** 2 + h[:, 1] ** 2 + (alpha * h[:, 2]) ** 2) ** 2)
    return d / (2 * (wo[2] + smith_root(alpha, wo[2])))


def lobe(alpha: float, wo: np.ndarray, wi: np.ndarray) -> np.ndarray:
    """Return D V cos(wi) [n] [1/sr] at ``wi`` [n, 3] above the surface."""
    cos_o, cos_i = wo[2], wi[:, 2]
    share = cos_i * (cos_o + smith_root(alpha, cos_o))
    share = share / (cos_o * smith_root(alpha, cos_i) + cos_i * smith_root(alpha, cos_o))
    return half_density(alpha, wo, wi) * share


def midpoints(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the middles of the cells of a ``count`` x ``count`` grid on the unit square, each [count^2]."""
    middles = (np.arange(count) + 0.5) / count
    u, v = np.meshgrid(middles, middles, indexing="ij")
    return u.ravel(), v.ravel()


def reflections(alpha: float, wo: np.ndarray, count: int) -> np.ndarray:
    """Return directions [count^2, 3] that follow `half_density` (Dupuy and Benyoub 2023)."""
    turn, v = midpoints(count)
    w = wo * [alpha, alpha, 1.0]
    w = w / np.linalg.norm(w)
    z = (1 - v) * (1 + w[2]) - w[2]
    s = np.sqrt(np.clip(1 - z * z, 0, 1))
    h = np.stack([s * np.cos(2 * np.pi * turn), s * np.sin(2 * np.pi * turn), z], axis=1) + w
    h = h * [alpha, alpha, 1.0]
    h /= np.linalg.norm(h, axis=1, keepdims=True)
    return 2 * (h @ wo)[:, None] * h - wo


def points(alpha: float, wo: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return directions [n, 3] above the surface and weights [n] whose sum over f is f's integral.

    They are dense in the lobe, less so in one of four times its width, and cover the hemisphere.
    """
    wide = min(4 * alpha, 1.0)
    turn, v = midpoints(40)
    r = np.sqrt(v)
    cosine = np.stack([r * np.cos(2 * np.pi * turn), r * np.sin(2 * np.pi * turn), np.sqrt(1 - v)], axis=1)
    wi = np.concatenate([reflections(alpha, wo, 64), reflections(wide, wo, 48), cosine])
    wi = wi[wi[:, 2] > 0]
    density = 64**2 * half_density(alpha, wo, wi) + 48**2 * half_density(wide, wo, wi) + 40**2 * wi[:, 2] / np.pi
    return wi, 1 / density


def matrix_of(parameters: np.ndarray) -> np.ndarray:
    """Return the 3x3 matrix from the mirror frame into the cosine's space, yy = 1.

    The parameters are log widths in and across the plane, skew, and tilt against the mirror direction.
    """
    x, y, skew, tilt = parameters
    c, s = np.cos(tilt), np.sin(tilt)
    frame = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])  # columns: X, Y, Z of the lobe
    matrix = np.linalg.inv(frame @ np.array([[np.exp(x), 0, skew * np.exp(x)], [0, np.exp(y), 0], [0, 0, 1.0]]))
    return matrix / matrix[1, 1]


def mirror_frame(cos_o: float) -> np.ndarray:
    """Return the matrix from the shading frame, wo in the plane y = 0, to the one with the mirror direction as z."""
    sin_o = np.sqrt(1 - cos_o**2)
    return np.array([[cos_o, 0, sin_o], [0, 1, 0], [-sin_o, 0, cos_o]])


def share_above(matrix: np.ndarray) -> float:
    """Return the share of the transformed cosine above the true horizon, a lune of the cosine's hemisphere."""
    normal = np.linalg.inv(matrix)[2]
    return float(1 + normal[2] / np.linalg.norm(normal)) / 2


def transformed_cosine(matrix: np.ndarray, wi: np.ndarray) -> np.ndarray:
    """Return the density [n] of the transformed cosine at ``wi`` [n, 3], of integral 1 over the whole sphere."""
    w = wi @ matrix.T
    length = np.linalg.norm(w, axis=1)
    return np.maximum(w[:, 2], 0) / length * np.linalg.det(matrix) / (np.pi * length**3)


def amplitudes_of(alpha: float, cos_o: float) -> np.ndarray:
    """Return x, y of the lobe's integral f0 * x + f90 * y."""
    wo = np.array([np.sqrt(1 - cos_o**2), 0, cos_o])
    wi = reflections(alpha, wo, 128)
    above = wi[:, 2] > 0
    wi = wi[above]
    share = lobe(alpha, wo, wi) / half_density(alpha, wo, wi)
    schlick = np.clip(1 - np.sqrt(np.maximum((1 + wi @ wo) / 2, 0)), 0, 1) ** 5
    return np.array([(share * (1 - schlick)).sum(), (share * schlick).sum()]) / len(above)


def fit_cell(alpha: float, cos_o: float, start: np.ndarray) -> np.ndarray:
    """Return the parameters of `matrix_of` that fit best, searching from ``start``."""
    wo = np.array([np.sqrt(1 - cos_o**2), 0, cos_o])
    wi, weight = points(alpha, wo)
    f = lobe(alpha, wo, wi)
    f = f / (f @ weight)
    frame = mirror_frame(cos_o)

    def residuals(parameters: np.ndarray) -> np.ndarray:
        matrix = matrix_of(parameters) @ frame
        g = transformed_cosine(matrix, wi) / share_above(matrix)
        return (f - g) * np.sqrt(weight / (f + g))

    if cos_o == 1.0:  # round: one width, no skew, no tilt
        width = least_squares(lambda p: residuals(np.array([p[0], p[0], 0, 0])), start[:1]).x[0]
        return np.array([width, width, 0, 0])
    return least_squares(residuals, start, x_scale=[1, 1, 1, max(alpha, 0.02)]).x


def fit_row(row: int, size: int = SIZE) -> tuple[np.ndarray, np.ndarray]:
    """Return the matrices [size, 4] (xx, xz, zx, zz) and amplitudes [size, 2] of a row, float32."""
    alpha = alpha_of(row, size)
    parameters = np.array([np.log(alpha), np.log(alpha), 0.0, 0.0])
    matrices, amplitudes = np.empty((size, 4)), np.empty((size, 2))
    for column in range(size):
        cos_o = cos_of(column, size)
        parameters = fit_cell(alpha, cos_o, parameters)
        matrix = matrix_of(parameters)
        matrices[column] = matrix[[0, 0, 2, 2], [0, 2, 0, 2]]
        amplitudes[column] = amplitudes_of(alpha, cos_o) / share_above(matrix @ mirror_frame(cos_o))
    return matrices.astype(np.float32), amplitudes.astype(np.float32)


def main() -> None:
    """Fit all rows and write ltc.npz beside this file."""
    rows = [fit_row(row) for row in range(SIZE)]
    matrices, amplitudes = (np.stack(part) for part in zip(*rows, strict=True))
    np.savez(Path(__file__).with_name("ltc.npz"), matrices=matrices, amplitudes=amplitudes)


if __name__ == "__main__":
    main()
