"""The inner loops of the silhouette, compiled: torch would write and read arrays of all pixels and capsules each time.

Of N pictures: outlines (6, N, C), which are u, v of one end, of the other, and the two radii; pixels (2, N, P);
distances and places on the axis (N, P, C). All of one type, float32 unless derivatives are checked.
"""

import numpy as np
from numba import njit

Array = np.ndarray

LITTLE = np.float32(1e-6)
FAR = np.float32(30.0)  # in temperatures: what weighs e^-30 of the nearest is nothing


@njit(cache=True, error_model="numpy", fastmath={"contract", "nsz", "arcp"})
def distances(outline: Array, pixels: Array, sd: Array, h: Array):
    """Fill sd and h: see `silhouette.distances`."""
    N, P, C = sd.shape
    ua, va, ub, vb, ra, rb = outline[0], outline[1], outline[2], outline[3], outline[4], outline[5]
    u, v = pixels[0], pixels[1]
    zero, one = np.float32(0), np.float32(1)
    for n in range(N):
        for p in range(P):
            x, y = u[n, p], v[n, p]
            for c in range(C):
                bu, bv, pu, pv = ub[n, c] - ua[n, c], vb[n, c] - va[n, c], x - ua[n, c], y - va[n, c]
                t = min(max((pu * bu + pv * bv) / (bu * bu + bv * bv + LITTLE), zero), one)
                pu -= t * bu
                pv -= t * bv
                h[n, p, c] = t
                sd[n, p, c] = np.sqrt(pu * pu + pv * pv + LITTLE) - ra[n, c] - t * (rb[n, c] - ra[n, c])


@njit(cache=True, error_model="numpy", fastmath={"contract", "nsz", "arcp"})
def distances_back(outline: Array, pixels: Array, h: Array, g: Array, out: Array):
    """Fill out (6, N, C), the gradients of the outline, from those of the distances g (N, P, C)."""
    N, P, C = g.shape
    ua, va, ub, vb = outline[0], outline[1], outline[2], outline[3]
    u, v = pixels[0], pixels[1]
    out[:] = 0
    for n in range(N):
        for p in range(P):
            x, y = u[n, p], v[n, p]
            for c in range(C):
                t = h[n, p, c]
                pu = x - ua[n, c] - t * (ub[n, c] - ua[n, c])
                pv = y - va[n, c] - t * (vb[n, c] - va[n, c])
                b = g[n, p, c] * t
                a = g[n, p, c] - b
                d = np.float32(1) / np.sqrt(pu * pu + pv * pv + LITTLE)
                out[0, n, c] -= a * pu * d
                out[1, n, c] -= a * pv * d
                out[2, n, c] -= b * pu * d
                out[3, n, c] -= b * pv * d
                out[4, n, c] -= a
                out[5, n, c] -= b


@njit(cache=True, error_model="numpy")
def nearest(sd: Array, temperature: float, soft: Array, least: Array, which: Array):
    """Fill the smooth minimum, the minimum and its place, each (M,), of the rows of sd (M, C)."""
    M, C = sd.shape
    T, per = np.float32(temperature), np.float32(1 / temperature)
    for m in range(M):
        best, at = sd[m, 0], 0
        for c in range(1, C):
            if sd[m, c] < best:
                best, at = sd[m, c], c
        total, end = np.float32(1), best + FAR * T
        for c in range(C):
            if sd[m, c] < end and c != at:
                total += np.exp((best - sd[m, c]) * per)
        soft[m], least[m], which[m] = best - T * np.log(total), best, at


@njit(cache=True, error_model="numpy")
def nearest_back(sd: Array, temperature: float, soft: Array, which: Array, g_soft: Array, g_least: Array, out: Array):
    """Fill out (M, C), the gradients of sd, from those of the smooth minimum and of the minimum, each (M,)."""
    M, C = sd.shape
    T, per = np.float32(temperature), np.float32(1 / temperature)
    for m in range(M):
        for c in range(C):
            out[m, c] = np.float32(0)
        if g_soft[m] != 0:
            end = soft[m] + FAR * T
            for c in range(C):
                if sd[m, c] < end:
                    out[m, c] = g_soft[m] * np.exp((soft[m] - sd[m, c]) * per)
        out[m, which[m]] += g_least[m]


@njit(cache=True, error_model="numpy")
def least_of(sd: Array, of: Array, least: Array, which: Array):
    """Fill the minimum over some columns `of` (M, K, S) of the rows of sd (M, C), and where it is, each (M, K)."""
    M, K, S = of.shape
    for m in range(M):
        for k in range(K):
            at = of[m, k, 0]
            for s in range(1, S):
                if sd[m, of[m, k, s]] < sd[m, at]:
                    at = of[m, k, s]
            least[m, k], which[m, k] = sd[m, at], at


@njit(cache=True, error_model="numpy")
def least_of_back(which: Array, g: Array, out: Array):
    """Add the gradients g (M, K) of those minima to out (M, C)."""
    M, K = which.shape
    for m in range(M):
        for k in range(K):
            out[m, which[m, k]] += g[m, k]


@njit(cache=True, error_model="numpy")
def visible(ends: Array, focal: float, sd: Array, h: Array, which: Array, meets: Array):
    """Fill (N, P) which capsule each pixel sees and whether it sees one, from depths and radii at the ends (4, N, C).

    See `silhouette.visible`.
    """
    N, P, C = sd.shape
    za, zb, ra, rb = ends[0], ends[1], ends[2], ends[3]
    f = np.float32(focal)
    zero, one = np.float32(0), np.float32(1)
    for n in range(N):
        for p in range(P):
            best, at, met = np.float32(np.inf), 0, False
            for c in range(C):
                d, t = sd[n, p, c], h[n, p, c]
                if d < np.float32(0.5):
                    radius = ra[n, c] + t * (rb[n, c] - ra[n, c])
                    off = min(max((d + radius) / radius, zero), one)
                    bulge = np.sqrt(one - off * off)
                    front = (za[n, c] + t * (zb[n, c] - za[n, c])) * (one - bulge * radius / f)
                    met = True
                else:
                    front = np.float32(1e4) + d
                if front < best:
                    best, at = front, c
            which[n, p], meets[n, p] = at, met
