"""Glossy lobes in spherical harmonics: Phong by closed formulas, GGX by a fit to this library's own.

A lobe stands for the BRDF without the cosine, which transfer holds. Its parts are zonal: coefficients
F_lm = Lambda_l y_lm(d) about a unit direction d (``products.zonal``).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import numpy as np

from warp_gi.errors import OptionError
from warp_gi.kernels.transfer_snippets import LIGHT_ORDER, clamped_cosine
from warp_gi.scene import harmonics
from warp_gi.techniques.radiance_transfer import products

ROUGHNESSES = 16
"""Rows of a LobeTable, from SMALLEST_ROUGHNESS to 1 in equal steps."""
COLUMNS = 17
"""Columns of a LobeTable, sqrt(1 - sqrt(cosine of the angle to the viewer)) from 0 to 1 in equal steps."""
SMALLEST_ROUGHNESS = 0.2
NORMAL_BANDS = 4
"""Bands 1 to 4 of a lobe's second part, about the normal."""
SMALLEST_ALPHA = 1.0e-3  # as in kernels/bsdf.py
_UP = np.array([0.0, 0.0, 1.0])
_ANGLES = (-0.6 * math.pi, 0.2)  # between which a lobe's direction is sought, radians from the normal
_STEPS = 192  # of that search
_RINGS, _SPOKES = 48, 24  # visible normals by which a GGX lobe is integrated, on half of the sphere
# Costs that keep the fit from answering differently to neighbours, where different answers are nearly as good.
_RIDGE = 3e-4  # of coefficients
_NORMAL_RIDGE = 1e-3 * 0.2**-6  # of the part about the normal, times (1 - roughness)^6: it is for rough lobes
_TURN = 0.01  # of the angle between a lobe's direction and the mirrored view, in units of the lobe's energy


def phong(exponents: np.ndarray | float, order: int) -> np.ndarray:
    """Return Lambda_l, float64 [..., order], of B = (s + 2) / (2 pi) max(r . w, 0)^s for ``exponents`` s [...].

    By int_0^1 x^s P_l = (s + 2 - l) / (s + l + 1) int_0^1 x^s P_(l-2), which is stable for any s >= 0.
    """
    s = np.asarray(exponents, np.float64)
    rows = [(s + 2) / (s + 1), np.ones_like(s)]
    for l in range(2, order):
        rows.append(rows[l - 2] * (s + 2 - l) / (s + l + 1))
    return np.stack(rows[:order], axis=-1)


@dataclass(frozen=True, eq=False)
class LobeTable:
    """Lobes for this library's GGX (kernels/bsdf.py) by roughness and the cosine of the angle to the viewer.

    A lobe has two zonal parts: one of all bands about a direction d near the mirrored view, and one of bands 1 to 4
    about the normal n, which is nearly 0 below a roughness of 0.5. In the plane of n and the view wo, with
    t = wo - (n . wo) n made unit, d = sine t + cosine n; sine is below 0, away from the viewer. Entries are
    interpolated bilinearly, (sine, cosine) is made unit after, and then all factors are divided by what the lobe
    reflects of a white sky without occluders, ``white``, which is 1 at entries and differs between them. Then::

        F_lm = about_d[l] y_lm(d) + about_n[l] y_lm(n)
    """

    entries: np.ndarray
    """float32 [ROUGHNESSES, COLUMNS, 8 + order]: sine, cosine, A, B, about_d[0 .. order - 1], about_n[1 .. 4].

    The directional albedo of GGX is f0 A + f90 B. F is that of a lobe of albedo 1: without occluders it reflects 1 of a
    sky of radiance 1. So a pixel's radiance is (f0 A + f90 B) sum_k F_k t_k.
    """

    @property
    def order(self) -> int:
        """Number of bands about d."""
        return self.entries.shape[-1] - 4 - NORMAL_BANDS

    def white(self, entries: np.ndarray) -> np.ndarray:
        """Return F . T of lobes [..., 8 + order] for the T of an unoccluded point, float64 [...].

        sum_l A_l (2 l + 1) / (4 pi) (about_d[l] P_l(cosine) + about_n[l]), in which l = 3 and 5 vanish:
        1/4 about_d[0] + 1/2 (about_d[1] c + about_n[1]) + 5/16 (about_d[2] P_2(c) + about_n[2])
        - 3/32 (about_d[4] P_4(c) + about_n[4]).
        """
        factors = np.array(clamped_cosine(self.order)) * (2 * np.arange(self.order) + 1) / (4 * math.pi)
        legendre = np.polynomial.legendre.legvander(entries[..., 1:2], self.order - 1)[..., 0, :]
        about_d, about_n = entries[..., 4 : 4 + self.order], entries[..., 4 + self.order :]
        return (about_d * legendre) @ factors + about_n @ factors[1 : 1 + NORMAL_BANDS]

    def at(self, roughness: np.ndarray | float, cosine: np.ndarray | float) -> np.ndarray:
        """Return lobes between those of the table, float64 [..., 8 + order], as kernels read them: of albedo 1."""
        r = (np.asarray(roughness, np.float64) - SMALLEST_ROUGHNESS) * ((ROUGHNESSES - 1) / (1 - SMALLEST_ROUGHNESS))
        c = np.sqrt(1 - np.sqrt(np.clip(np.asarray(cosine, np.float64), 0, 1))) * (COLUMNS - 1)
        r, c = np.broadcast_arrays(np.clip(r, 0, ROUGHNESSES - 1), c)
        i, j = np.minimum(r.astype(int), ROUGHNESSES - 2), np.minimum(c.astype(int), COLUMNS - 2)
        s, t = (r - i)[..., None], (c - j)[..., None]
        e = self.entries.astype(np.float64)
        result = (e[i, j] * (1 - t) + e[i, j + 1] * t) * (1 - s) + (e[i + 1, j] * (1 - t) + e[i + 1, j + 1] * t) * s
        result[..., :2] /= np.linalg.norm(result[..., :2], axis=-1, keepdims=True)
        result[..., 4:] /= self.white(result)[..., None]
        return result

    def coefficients(self, lobes: np.ndarray, normals: np.ndarray, views: np.ndarray) -> np.ndarray:
        """Return F [..., order^2] of lobes [..., 8 + order] at unit normals and directions to the viewer [..., 3]."""
        across = views - (views * normals).sum(axis=-1, keepdims=True) * normals
        length = np.linalg.norm(across, axis=-1, keepdims=True)
        axes = lobes[..., :1] * across / np.maximum(length, 1e-12) + lobes[..., 1:2] * normals
        axes /= np.linalg.norm(axes, axis=-1, keepdims=True)
        about_n = np.zeros((*lobes.shape[:-1], self.order))
        about_n[..., 1 : 1 + NORMAL_BANDS] = lobes[..., 4 + self.order :]
        return products.zonal(axes, lobes[..., 4 : 4 + self.order]) + products.zonal(normals, about_n)


@cache
def lobe_table(order: int) -> LobeTable:
    """Return the table for transfer of an order from 5 to 8, fitted once a process in about 0.1 s."""
    if not 5 <= order <= 8:
        raise OptionError(f"lobes of GGX are fitted for transfer of orders 5 to 8, got {order}; use 5 or 6")
    cosines = (1 - np.linspace(0, 1, COLUMNS) ** 2) ** 2
    rows = [fit_ggx(r, cosines, order) for r in np.linspace(SMALLEST_ROUGHNESS, 1, ROUGHNESSES)]
    return LobeTable(np.stack(rows).astype(np.float32))


@cache
def phong_table(order: int) -> LobeTable:
    """Return the table of the paper's lobe, modified Phong (``phong``) with s = 2 / roughness^4 - 2, about the mirror.

    It reflects f0 times sum_k F_k t_k, the integral of L V (s + 2) / (2 pi) cos^s(r, w) cos(n, w): not made white.
    """
    cosines = (1 - np.linspace(0, 1, COLUMNS) ** 2) ** 2
    entries = np.zeros((ROUGHNESSES, COLUMNS, 4 + order + NORMAL_BANDS))
    entries[..., 0], entries[..., 1], entries[..., 2] = -np.sqrt(1 - cosines**2), cosines, 1.0
    exponents = 2 / np.linspace(SMALLEST_ROUGHNESS, 1, ROUGHNESSES) ** 4 - 2
    entries[..., 4 : 4 + order] = phong(exponents, order)[:, None]
    return LobeTable(entries.astype(np.float32))


def fit_ggx(roughness: float, cosines: np.ndarray, order: int) -> np.ndarray:
    """Return entries of a LobeTable for one roughness, float64 [cosines, 8 + order].

    Without occluders the lobe F reflects K F of each of the light's 25 functions, K_ik = sum_j C_ijk T_j with T the
    clamped cosine. The fit brings that nearest to m_i = int f cos y_i, by least squares for each direction d, of which
    the best is taken. So it makes up for what the cut of transfer at an order loses: errors at roughness 0.6 are 0.7 of
    those of a fit to f itself, weighted by the cosine. Then F is scaled to an albedo of 1.
    """
    moments, scale, offset = _ggx_moments(roughness, cosines)
    product = _product(order)
    penalty = np.diag([0.0] * order + [_NORMAL_RIDGE * (1 - roughness) ** 6 + 1e-6] * NORMAL_BANDS)
    angles = np.linspace(*_ANGLES, _STEPS)
    parts = _parts(angles, order)
    targets = np.einsum("cn,anj->acj", moments @ product, parts)
    inverses = np.linalg.inv(_normal_equations(angles, order) + penalty)
    reached = np.einsum("acj,ajk,ack->ac", targets, inverses, targets)
    turns = angles[:, None] + np.arccos(cosines)
    cost = _TURN * turns**2 - reached / (moments**2).sum(axis=-1)
    best = np.clip(cost.argmin(axis=0), 1, _STEPS - 2)
    low, middle, high = (cost[best + k, np.arange(len(best))] for k in (-1, 0, 1))
    step = 0.5 * (low - high) / np.maximum(low + high - 2 * middle, 1e-12)  # of the parabola through the best three
    angle = angles[best] + np.clip(step, -1, 1) * (angles[1] - angles[0])
    parts = _parts(angle, order)
    targets = np.einsum("cn,cnj->cj", moments @ product, parts)
    solved = np.linalg.solve(_normal_equations(angle, order) + penalty, targets[..., None])
    white = products.unoccluded(_UP, order)[_even(order)] @ (parts @ solved)
    return np.concatenate(
        [np.stack([np.sin(angle), np.cos(angle), scale, offset], axis=-1), solved[..., 0] / white], axis=-1
    )


def ggx_directions(
    roughness: float, cosines: np.ndarray, rings: int = _RINGS, spokes: int = _SPOKES
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return a quadrature of the lobe D V cos of GGX over directions wi, by visible normals.

    The view lies in the half plane x > 0, and directions are those with y > 0: the other half mirrors them.

    Returns:
        wi [cosines, rings * spokes, 3]; weights of int f cos g ~ sum w g for even g, float64 [cosines, n], which count
        both halves; (1 - V.H)^5 [cosines, n] for Fresnel.
    """
    alpha = max(roughness * roughness, SMALLEST_ALPHA)
    cos_o = np.asarray(cosines, np.float64)[:, None]
    wo = np.concatenate([np.sqrt(1 - cos_o**2), 0 * cos_o, cos_o], axis=-1)
    stretched = wo * [alpha, alpha, 1.0]
    stretched /= np.linalg.norm(stretched, axis=-1, keepdims=True)
    nodes, weights = _gauss(rings)
    span = np.arccos(-stretched[:, 2:])  # a spherical cap of half vectors (Dupuy and Benyoub 2023)
    polar = span * (nodes + 1) / 2
    share = np.sin(polar) * weights * span / 2 / (1 + stretched[:, 2:])
    turn = (np.arange(spokes) + 0.5) * (math.pi / spokes)
    ring = np.sin(polar)[..., None]
    cap = np.stack([ring * np.cos(turn), ring * np.sin(turn), np.cos(polar)[..., None] + 0 * turn], axis=-1)
    h = (cap.reshape(len(wo), -1, 3) + stretched[:, None]) * [alpha, alpha, 1.0]
    h /= np.linalg.norm(h, axis=-1, keepdims=True)
    cos_h = np.einsum("cnk,ck->cn", h, wo)
    wi = 2 * cos_h[..., None] * h - wo[:, None]
    cos_i = np.maximum(wi[..., 2], 0)
    root_o, root_i = (np.sqrt(alpha**2 + (1 - alpha**2) * c**2) for c in (cos_o, cos_i))
    value = cos_i * (cos_o + root_o) / (cos_o * root_i + cos_i * root_o)  # f cos / pdf
    return wi, np.repeat(share, spokes, axis=-1) / spokes * value, (1 - np.clip(cos_h, 0, 1)) ** 5


@cache
def _gauss(count: int) -> tuple[np.ndarray, np.ndarray]:
    return np.polynomial.legendre.leggauss(count)


def _ggx_moments(roughness: float, cosines: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return int f cos y_i for the light's functions even in y [cosines, functions], and A and B [cosines]."""
    wi, weights, fresnel = ggx_directions(roughness, cosines)
    values = harmonics.basis(wi, LIGHT_ORDER)[..., _even(LIGHT_ORDER)]
    offset = (weights * fresnel).sum(axis=-1)
    return (weights[:, None] @ values)[:, 0], weights.sum(axis=-1) - offset, offset


@cache
def _even(order: int) -> np.ndarray:
    """Return the indices of functions even in y, degrees m >= 0; others are 0 in the plane of view and normal."""
    return np.concatenate([np.arange(l * l + l, (l + 1) ** 2) for l in range(order)])


@cache
def _product(order: int) -> np.ndarray:
    """Return what an unoccluded point about z makes of light times lobe, [the light's even functions, the lobe's]."""
    transfer = products.unoccluded(_UP, order)
    return (transfer @ products.tripling(order))[np.ix_(_even(LIGHT_ORDER), _even(order))]


def _normal_equations(angles: np.ndarray, order: int) -> np.ndarray:
    product, parts = _product(order), _parts(angles, order)
    return parts.transpose(0, 2, 1) @ (product.T @ product + _RIDGE * np.eye(product.shape[1])) @ parts


def _parts(angles: np.ndarray, order: int) -> np.ndarray:
    """Return what each factor of a lobe adds to its functions even in y, [angles, functions, order + NORMAL_BANDS]."""
    directions = np.stack([np.sin(angles), 0 * angles, np.cos(angles)], axis=-1)
    about_d, about_n = harmonics.basis(directions, order), harmonics.basis(_UP, order)
    result = np.zeros((len(angles), order * order, order + NORMAL_BANDS))
    for l in range(order):
        band = slice(l * l, (l + 1) ** 2)
        result[:, band, l] = about_d[:, band]
        if 1 <= l <= NORMAL_BANDS:
            result[:, band, order + l - 1] = about_n[band]
    return result[:, _even(order)]
