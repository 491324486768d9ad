"""Products of light, transfer and lobes in spherical harmonics, float64 on the host.

Light L, transfer T and a lobe F are coefficients of one function each. What TP and TPFL of the paper
(prt_textures.txt, Eq. 2) compute is the integral of the product of the three: sum_ijk C_ijk L_i T_j F_k with the
tripling coefficients C_ijk = int y_i y_j y_k, which are symmetric in all three.
"""

from __future__ import annotations

import math
from functools import cache

import numpy as np

from warp_gi.kernels.transfer_snippets import LIGHT_ORDER, clamped_cosine
from warp_gi.scene import harmonics

_ROUNDING = 1e-12
"""Tripling coefficients below it are 0; the smallest of others is 6e-3."""


@cache
def tripling(order: int, light_order: int = LIGHT_ORDER) -> np.ndarray:
    """Return C_ijk, float64 [light_order^2, order^2, order^2]; not to be written to.

    Exact, by Gauss-Legendre quadrature in z and equal steps in azimuth.
    """
    directions, weights = harmonics.sphere(2 * (order - 1) + light_order - 1)
    light, other = harmonics.basis(directions, light_order), harmonics.basis(directions, order)
    pairs = (other[:, :, None] * other[:, None, :]).reshape(len(other), -1)
    result = ((light * weights[:, None]).T @ pairs).reshape(light_order**2, order**2, order**2)
    result[np.abs(result) < _ROUNDING] = 0
    result.flags.writeable = False
    return result


def light_matrix(light: np.ndarray, order: int) -> np.ndarray:
    """Return M_kj = sum_i C_ijk L_i, float64 [3, order^2, order^2], of a sky's ``light`` [3, light_order^2].

    It turns transfer into light that was transferred, t = M T. Symmetric in k and j.
    """
    table = tripling(order, math.isqrt(np.shape(light)[-1]))
    return (light @ table.reshape(len(table), -1)).reshape(-1, order**2, order**2)


def unoccluded(normals: np.ndarray, order: int) -> np.ndarray:
    """Return transfer T_j = A_l y_j(n) of points from which all of the sky is seen, float64 [..., order^2]."""
    return harmonics.by_coefficient(np.array(clamped_cosine(order))) * harmonics.basis(normals, order)


def zonal(directions: np.ndarray, factors: np.ndarray) -> np.ndarray:
    """Return coefficients F_lm = Lambda_l y_lm(d) of lobes about unit directions, float64 [..., order^2].

    Args:
        directions: Axes of the lobes, [..., 3].
        factors: Lambda_l = 2 pi int_-1^1 B(x) P_l(x) dx, [..., order].
    """
    return harmonics.by_coefficient(factors) * harmonics.basis(directions, np.shape(factors)[-1])


def window(order: int, strength: float) -> np.ndarray:
    """Return factors 1 / (1 + strength l^2 (l + 1)^2) of bands, float64 [order], against ringing.

    For the light of glossy lobes alone: it makes diffuse light darker, and worse. Source: Sloan, "Stupid Spherical
    Harmonics Tricks" (GDC 2008).
    """
    l = np.arange(order)
    return 1 / (1 + strength * (l * (l + 1.0)) ** 2)


def triple_product(light: np.ndarray, transfer: np.ndarray, lobe: np.ndarray) -> np.ndarray:
    """Return sum_ijk C_ijk L_i T_j F_k a channel, float64 [3], by all of C: TP, as slow as it is written.

    Args:
        light: [3, light_order^2].
        transfer: [order^2].
        lobe: [order^2].
    """
    return np.einsum("ijk,ci,j,k->c", _table(light, transfer), light, transfer, lobe)


def sparse_triple_product(light: np.ndarray, transfer: np.ndarray, lobe: np.ndarray) -> np.ndarray:
    """Return ``triple_product`` by the list of those C_ijk that are not 0."""
    table = _table(light, transfer)
    i, j, k = np.nonzero(table)
    return (light[:, i] * transfer[j] * lobe[k]) @ table[i, j, k]


def reordered_triple_product(light: np.ndarray, transfer: np.ndarray, lobe: np.ndarray) -> np.ndarray:
    """Return ``triple_product`` as L . (T x F): the product of transfer and lobe serves all channels."""
    return light @ (_table(light, transfer) @ lobe @ transfer)


def fixed_light_product(light: np.ndarray, transfer: np.ndarray, lobe: np.ndarray) -> np.ndarray:
    """Return ``triple_product`` as F . M T: TPFL, with ``light_matrix`` computed once for all points."""
    return light_matrix(light, math.isqrt(len(transfer))) @ transfer @ lobe


def _table(light: np.ndarray, transfer: np.ndarray) -> np.ndarray:
    return tripling(math.isqrt(len(transfer)), math.isqrt(light.shape[-1]))
