# SPDX-License-Identifier: BSD-3-Clause
"""The loops of :mod:`groma.features.depth.planes`: sums of blocks, growing, joining, and pixels to planes.

A set of pixels is known by ten sums, in this order: w, wx, wy, wxx, wxy, wyy, wr, wxr, wyr, wrr, with the ray
(x, y, 1), the inverse depth r and its weight w. A plane is known by theta (3,), the coefficients of its inverse depth.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from groma._numba import inline_kernel, kernel, loop, unrolled_loop
from groma._ordering import ascending, copy
from groma.gates import gate

#: Regions that are remembered: the size of an array (cost: they fit in a byte).
MAX_REGIONS = 120
#: The normals of two regions are compared up to this angle, radians; beyond, noise is no explanation.
_ANY_ANGLE = 1.5


@dataclass(frozen=True)
class RegionGates:
    """Which blocks and pixels of a depth image belong to a plane, beside the options."""

    min_count: int = gate(6, "samples", "samples that a block needs", "derived from 3 unknowns")
    flat: float = gate(0.12, "cosine", "planes seen at a flatter angle are not used", "chosen on Kinect images")
    looser: float = gate(1.3, "ratio", "joined regions fit worse by at most this factor", "chosen on Kinect images")


#: The defaults.
REGIONS = RegionGates()


@kernel
def _fit(s, theta):
    """Write the least-squares plane of ten sums to theta (3,); return whether they determine one."""
    # About the weighted mean, where offset and slopes part.
    theta[:] = 0.0
    if not s[0] > 0.0:
        return False
    mx, my, mr = s[1] / s[0], s[2] / s[0], s[6] / s[0]
    xx, xy, yy = s[3] - s[1] * mx, s[4] - s[1] * my, s[5] - s[2] * my
    xr, yr = s[7] - s[1] * mr, s[8] - s[2] * mr
    determinant = xx * yy - xy * xy
    if not (xx > 0.0 and yy > 0.0 and determinant > 1e-6 * xx * yy):
        return False
    theta[0] = (yy * xr - xy * yr) / determinant
    theta[1] = (xx * yr - xy * xr) / determinant
    theta[2] = mr - theta[0] * mx - theta[1] * my
    return True


@kernel
def _chi_square(s, t):
    """Sum of squared whitened distances of the pixels behind ten sums from the plane t."""
    quadratic = t[0] * (t[0] * s[3] + 2.0 * (t[1] * s[4] + t[2] * s[1]))
    quadratic += t[1] * (t[1] * s[5] + 2.0 * t[2] * s[2]) + t[2] * t[2] * s[0]
    return max(quadratic - 2.0 * (t[0] * s[7] + t[1] * s[8] + t[2] * s[6]) + s[9], 0.0)


@kernel
def _tilt_variance(s, t):
    """Upper bound of the variance of the normal's angle."""
    mx, my = s[1] / s[0], s[2] / s[0]
    xx, xy, yy = s[3] - s[1] * mx, s[4] - s[1] * my, s[5] - s[2] * my
    return (xx + yy) / (xx * yy - xy * xy) / (t[0] * t[0] + t[1] * t[1] + t[2] * t[2])


@kernel
def _cosine(a, b):
    dot = a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
    return dot / math.sqrt(
        (a[0] * a[0] + a[1] * a[1] + a[2] * a[2]) * (b[0] * b[0] + b[1] * b[1] + b[2] * b[2]) + 1e-300
    )


@kernel
def _bend_allowance(s, t, noise, bend):
    """Mean squared whitened distance that a bend by this share of the depth causes, at the centre of the pixels."""
    rho = max(t[0] * s[1] / s[0] + t[1] * s[2] / s[0] + t[2], 1e-3)
    z = 1.0 / rho
    ratio = bend * z / (noise[0] + noise[1] * (z - noise[2]) * (z - noise[2]))
    return ratio * ratio


@unrolled_loop
def block_sums(depth, pinhole, noise, size, step, sums, counts):
    """Sums (R, C, 10) and numbers (R, C) of the pixels of blocks of ``size`` samples, ``step`` pixels apart."""
    rows, columns = (depth.shape[0] + step - 1) // step, (depth.shape[1] + step - 1) // step
    x_of = np.empty(columns)
    for j in range(columns):
        x_of[j] = (min(j * step + step // 2, depth.shape[1] - 1) + 0.5 - pinhole[2]) / pinhole[0]
    c0, c2, z0, far = noise[0], noise[1], noise[2], noise[3]
    sums[:, :, :] = 0.0
    counts[:, :] = 0
    for i in range(rows):
        v = min(i * step + step // 2, depth.shape[0] - 1)
        y = (v + 0.5 - pinhole[3]) / pinhole[1]
        for block in range(sums.shape[1]):
            s0 = s1 = s2 = s3 = s4 = s5 = 0.0
            count = 0
            for j in range(block * size, min((block + 1) * size, columns)):
                z = float(depth[v, min(j * step + step // 2, depth.shape[1] - 1)])
                known = (z > 0.0) & (z <= far)
                z = z if known else 1.0
                sigma = c0 + c2 * (z - z0) * (z - z0)
                root = z * z / sigma
                w = root * root if known else 0.0
                count += 1 if known else 0
                x, rho = x_of[j], 1.0 / z
                s0 += w
                s1 += w * x
                s2 += w * x * x
                s3 += w * rho
                s4 += w * x * rho
                s5 += w * rho * rho
            s = sums[i // size, block]
            s[0] += s0
            s[1] += s1
            s[2] += s0 * y
            s[3] += s2
            s[4] += s1 * y
            s[5] += s0 * y * y
            s[6] += s3
            s[7] += s4
            s[8] += s3 * y
            s[9] += s5
            counts[i // size, block] += count


@inline_kernel
def _fit_blocks(sums, counts, gate, min_count, flat, thetas, quality, labels):
    """Fit a plane to every block: -1 labels those that can seed a region, by their quality; -2 all others."""
    rows, columns = counts.shape
    for i in range(rows):
        for j in range(columns):
            labels[i, j] = -2  # cannot be part of a plane
            if counts[i, j] < min_count or not _fit(sums[i, j], thetas[i, j]):
                continue
            s, t = sums[i, j], thetas[i, j]
            x, y = s[1] / s[0], s[2] / s[0]
            rho = t[0] * x + t[1] * y + t[2]
            length = math.sqrt((t[0] * t[0] + t[1] * t[1] + t[2] * t[2]) * (x * x + y * y + 1.0))
            chi = _chi_square(s, t) / max(counts[i, j] - 3, 1)
            if rho > flat * length and chi < gate:
                labels[i, j] = -1
                # Blocks with few pixels fit well by chance: they are tried last.
                quality[i * columns + j] = (chi + 1.0) / counts[i, j]


@loop
def grow(sums, counts, noise, limits, gates, min_blocks, labels, regions, region_counts):
    """Label blocks (R, C) by region, -1 for none; write the sums of regions. Return their number."""
    gate, bend, cos_floor = limits
    min_count, flat, turn = gates
    rows, columns = counts.shape
    thetas = np.zeros((rows, columns, 3))
    quality = np.full(rows * columns, np.inf)
    _fit_blocks(sums, counts, gate, min_count, flat, thetas, quality, labels)
    order = ascending(quality)
    queue = np.empty((rows * columns, 2), np.int64)
    theta, region = np.empty(3), np.empty(10)
    floor = math.acos(cos_floor)
    found = 0
    for k in range(len(order)):
        if not quality[order[k]] < np.inf or found == regions.shape[0]:
            break
        i, j = order[k] // columns, order[k] % columns
        if labels[i, j] != -1:
            continue
        copy(sums[i, j], region)
        copy(thetas[i, j], theta)
        pixels = counts[i, j]
        labels[i, j] = found
        queue[0, 0], queue[0, 1] = i, j
        head, tail = 0, 1
        while head < tail:
            i, j = queue[head, 0], queue[head, 1]
            head += 1
            for side in range(4):
                a = i + (1 if side == 0 else -1 if side == 1 else 0)
                b = j + (1 if side == 2 else -1 if side == 3 else 0)
                if a < 0 or b < 0 or a >= rows or b >= columns or labels[a, b] != -1:
                    continue
                s = sums[a, b]
                allowed = gate + _bend_allowance(s, thetas[a, b], noise, bend)
                if _chi_square(s, theta) > allowed * counts[a, b]:
                    continue
                limit = math.sqrt(floor * floor + turn * _tilt_variance(s, thetas[a, b]))
                if limit < _ANY_ANGLE and _cosine(theta, thetas[a, b]) < math.cos(limit):
                    continue
                labels[a, b] = found
                region += s
                pixels += counts[a, b]
                _fit(region, theta)
                queue[tail, 0], queue[tail, 1] = a, b
                tail += 1
        if tail >= min_blocks:
            copy(region, regions[found])
            region_counts[found] = pixels
            found += 1
        else:
            for q in range(tail):  # too small: free for no other seed, but for the pixels of its neighbours
                labels[queue[q, 0], queue[q, 1]] = -2
    for i in range(rows):
        for j in range(columns):
            labels[i, j] = max(labels[i, j], -1)
    return found


@loop
def join(regions, region_counts, count, noise, limits, gates, target):
    """Join regions on one plane; ``target`` (count,) receives the region that each became part of."""
    gate, bend, cos_floor = limits
    looser, turn = gates
    thetas, theta, both = np.zeros((count, 3)), np.empty(3), np.empty(10)
    for a in range(count):
        target[a] = a
        _fit(regions[a], thetas[a])
    floor = math.acos(cos_floor)
    joined = True
    while joined:
        joined = False
        for a in range(count):
            if target[a] != a:
                continue
            for b in range(a + 1, count):
                if target[b] != b:
                    continue
                variance = _tilt_variance(regions[a], thetas[a]) + _tilt_variance(regions[b], thetas[b])
                limit = min(math.sqrt(floor * floor + turn * variance), _ANY_ANGLE)
                if _cosine(thetas[a], thetas[b]) < math.cos(limit):
                    continue
                for k in range(len(both)):
                    both[k] = regions[a, k] + regions[b, k]
                if not _fit(both, theta):
                    continue
                fits = True
                for c in (a, b):
                    own = _chi_square(regions[c], thetas[c]) / region_counts[c]
                    allowed = max(gate, looser * own) + _bend_allowance(regions[c], thetas[c], noise, bend)
                    fits = fits and _chi_square(regions[c], theta) < allowed * region_counts[c]
                if fits:
                    copy(both, regions[a])
                    region_counts[a] += region_counts[b]
                    copy(theta, thetas[a])
                    for c in range(count):
                        if target[c] == b:
                            target[c] = a
                    joined = True


@loop
def assign(depth, pinhole, noise, bend, inlier, size, step, blocks, thetas, labels, sums, counts, centers):
    """Give pixels to planes; write labels (h, w), and of each plane sums (K, 10), numbers and sums of points."""
    rows, columns = labels.shape
    c0, c2, z0, far = noise[0], noise[1], noise[2], noise[3]
    near = np.empty(9, np.int64)
    for bi in range(blocks.shape[0]):
        for bj in range(blocks.shape[1]):
            candidates = 0
            for a in range(max(bi - 1, 0), min(bi + 2, blocks.shape[0])):
                for b in range(max(bj - 1, 0), min(bj + 2, blocks.shape[1])):
                    label = blocks[a, b]
                    if label < 0:
                        continue
                    known = False
                    for c in range(candidates):
                        known = known or near[c] == label
                    if not known:
                        near[candidates] = label
                        candidates += 1
            for i in range(bi * size, min((bi + 1) * size, rows)):
                if candidates == 0:
                    break
                v = min(i * step + step // 2, depth.shape[0] - 1)
                y = (v + 0.5 - pinhole[3]) / pinhole[1]
                for j in range(bj * size, min((bj + 1) * size, columns)):
                    u = min(j * step + step // 2, depth.shape[1] - 1)
                    z = float(depth[v, u])
                    if not (z > 0.0 and z <= far):
                        continue
                    x, rho = (u + 0.5 - pinhole[2]) / pinhole[0], 1.0 / z
                    sigma = c0 + c2 * (z - z0) * (z - z0)
                    root = z * z / sigma
                    best, limit = -1, math.sqrt(inlier * inlier * sigma * sigma + bend * bend * z * z) * rho * rho
                    for c in range(candidates):
                        t = thetas[near[c]]
                        away = abs(rho - t[0] * x - t[1] * y - t[2])
                        if away < limit:
                            best, limit = near[c], away
                    if best < 0:
                        continue
                    labels[i, j] = best
                    w = root * root
                    s = sums[best]
                    s[0] += w
                    s[1] += w * x
                    s[2] += w * y
                    s[3] += w * x * x
                    s[4] += w * x * y
                    s[5] += w * y * y
                    s[6] += w * rho
                    s[7] += w * x * rho
                    s[8] += w * y * rho
                    s[9] += w * rho * rho
                    counts[best] += 1
                    centers[best, 0] += x * z
                    centers[best, 1] += y * z
                    centers[best, 2] += z
