"""Compiled loops of the box fit: costs of many rotations, refinement of a box, and counts of points in boxes.

In the loops over rotations, every inner loop runs along the rotations and writes one array, so that it vectorises.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float64

from annotator.compiled import compiled

# Keeps the equations solvable if a direction is not measured at all.
SIZE_RIDGE = 1e-6
# Below this share of the cubed trace, a determinant is rounding error.
LEAST_DETERMINANT = 1e-9


@compiled
def size_costs(
    scaled: Float64[np.ndarray, "m 3"],
    target: Float64[np.ndarray, "m"],
    rotations: Float64[np.ndarray, "k 3 3"],
    delta: float,
    least: float,
    rounds: int,
) -> Float64[np.ndarray, "k"]:
    """The robust cost of each rotation with the sizes that fit the intervals' lengths best.

    Args:
        scaled: directions divided by twice the expected error of half an interval, per metre.
        target: half the intervals' lengths divided by that error.
        rotations: columns = box axes in the frame of the directions.
        delta: residual above which Huber's cost is linear.
        least: lower bound of the sizes, metres.
        rounds: number of solutions for the sizes: the first with weights of one, the others with Huber's weights.
    """
    m, k, turned = len(target), len(rotations), rotations.transpose(1, 2, 0).copy()
    reach, weighted, sizes, sums = np.empty((3, k)), np.empty((3, k)), np.empty((3, k)), np.empty((9, k))
    residual, cost, weight = np.empty(k), np.zeros(k), np.ones((m, k))
    for done in range(rounds):
        sums[:] = 0.0
        cost[:] = 0.0
        for i in range(m):
            _reach(scaled[i], turned, reach)
            place = 0
            for a in range(3):
                for j in range(k):
                    weighted[a, j] = weight[i, j] * reach[a, j]
                for j in range(k):
                    sums[6 + a, j] += target[i] * weighted[a, j]
                for b in range(a + 1):
                    for j in range(k):
                        sums[place, j] += weighted[a, j] * reach[b, j]
                    place += 1
        _solve(sums, least, sizes)
        for i in range(m):
            _reach(scaled[i], turned, reach)
            for j in range(k):
                predicted = sizes[0, j] * reach[0, j] + sizes[1, j] * reach[1, j] + sizes[2, j] * reach[2, j]
                residual[j] = abs(predicted - target[i])
            for j in range(k):
                inner = min(residual[j], delta)
                cost[j] += inner * (residual[j] - 0.5 * inner)
            if done + 1 == rounds:
                continue
            for j in range(k):
                weight[i, j] = min(1.0, delta / max(residual[j], 1e-6))
    return cost


@compiled
def _reach(direction: np.ndarray, turned: np.ndarray, reach: np.ndarray) -> None:
    """Fills in the derivatives (3, k) of the extent along a direction with respect to the sizes.

    Args:
        turned: (3, 3, k) rotations.
    """
    x, y, z = direction
    for a in range(3):
        for j in range(turned.shape[2]):
            reach[a, j] = abs(x * turned[0, a, j] + y * turned[1, a, j] + z * turned[2, a, j])


@compiled
def _solve(sums: np.ndarray, least: float, sizes: np.ndarray) -> None:
    """Fills in the sizes (3, k) by Cramer's rule; `sums` holds a symmetric matrix's lower triangle and right side."""
    for j in range(sums.shape[1]):
        xx, xy, yy, xz, yz, zz, bx, by, bz = sums[:, j]
        trace = xx + yy + zz
        xx, yy, zz = xx + SIZE_RIDGE * trace, yy + SIZE_RIDGE * trace, zz + SIZE_RIDGE * trace
        cx, cy, cz = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
        dy, dz, ez = xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy
        determinant = xx * cx + xy * cy + xz * cz
        # the last term avoids a division by zero if nothing is measured
        inverse = 1.0 / max(determinant, LEAST_DETERMINANT * trace**3 + 1e-300)
        sizes[0, j] = max((cx * bx + cy * by + cz * bz) * inverse, least)
        sizes[1, j] = max((cy * bx + dy * by + dz * bz) * inverse, least)
        sizes[2, j] = max((cz * bx + dz * by + ez * bz) * inverse, least)


# Damped Gauss-Newton steps that fit a box to the ends of intervals, one equation per end.
#
# A low end lies at `d.c - r` and a high end at `d.c + r`, with direction d, centre c and the box's half-extent `r =
# sum_i s_i / 2 |d.r_i|` along d, with sizes s and axes r_i (`reach` in the code). Functions that call each other are
# in one file, because numba's cache only checks the file of the outermost function for changes.


# Limits of the iteration. They are not settings, because they only trade accuracy against time.
ROUNDS = 12
# After FIRST_ROUNDS rounds, only the best SURVIVORS starts are refined further.
FIRST_ROUNDS, SURVIVORS = 4, 2
# The iteration ends if no cost falls by more than this share.
SETTLED = 1e-5
# Keeps the normal equations solvable if a direction is not measured at all; `determined` rejects such fits.
RIDGE = 1e-6
# Number of unknowns: centre and sizes; also a rotation about the box's z axis; or about any axis.
FIXED, HELD, FREE = 6, 7, 9

# unit vectors (m, 3); low and high ends (m, 2), metres; one over their expected errors (m, 2), 0 for an unknown end
Measured = tuple[np.ndarray, np.ndarray, np.ndarray]
# centre (3,), metres; rotation (3, 3), columns = box axes; sizes (3,), metres
Box = tuple[np.ndarray, np.ndarray, np.ndarray]


@compiled
def refine(
    measured: Measured, rotations: Float64[np.ndarray, "k 3 3"], unknowns: int, delta: float, least: float
) -> tuple[Box, float]:
    """The best box that steps reach from several start rotations.

    Args:
        unknowns: `HELD` or `FREE`.

    Returns:
        the box; and its robust cost, in units of the expected variance.
    """
    count = len(rotations)
    rotation, center, size = rotations.copy(), np.zeros((count, 3)), np.zeros((count, 3))
    new = (np.empty(3), np.empty((3, 3)), np.empty(3))
    cost, damping, active = np.empty(count), np.full(count, 1e-3), np.ones(count, np.bool_)
    # a variable, since numba compiles another variant of `_step` for a constant
    placed = min(FIXED, unknowns)
    for k in range(count):
        box = (center[k], rotation[k], size[k])
        # centre and sizes by least squares, then again with Huber's weights
        for limit in (np.inf, delta):
            _move(box, _step(measured, box, 0.0, placed, limit), least, box)
        cost[k] = _cost(measured, box, delta)
    for done in range(ROUNDS):
        gained = False
        for k in range(count):
            if not active[k]:
                continue
            box = (center[k], rotation[k], size[k])
            _move(box, _step(measured, box, damping[k], unknowns, delta), least, new)
            new_cost = _cost(measured, new, delta)
            gained |= cost[k] - new_cost > SETTLED * cost[k]
            if new_cost < cost[k]:
                center[k], rotation[k], size[k] = new
                cost[k] = new_cost
                damping[k] /= 4.0
            else:
                damping[k] *= 10.0
        if not gained and done >= FIRST_ROUNDS:
            break
        if done + 1 == FIRST_ROUNDS:
            for k in range(count):
                active[k] = np.sum(cost < cost[k]) + np.sum(cost[:k] == cost[k]) < SURVIVORS
    best = np.argmin(cost)
    return (center[best], rotation[best], size[best]), cost[best]


@compiled
def determined(measured: Measured, box: Box, unknowns: int, limit: float) -> bool:
    """True if the smallest singular value of a box's equations, with columns of unit length, is above a limit.

    That is the case if the Gram matrix is positive definite after subtracting the squared limit from its diagonal.
    """
    direction, _, inverse = measured
    _, rotation, size = box
    gram, row, scale = np.zeros((unknowns, unknowns)), np.empty(unknowns), np.empty(unknowns)
    for i in range(len(direction)):
        _derivative(direction, i, rotation, size, row)
        _add(gram, row, inverse[i, 0] ** 2, inverse[i, 1] ** 2)
    for a in range(unknowns):
        if gram[a, a] == 0.0:
            return False
        scale[a] = np.sqrt(gram[a, a])
    for a in range(unknowns):
        for b in range(a + 1):
            gram[a, b] /= scale[a] * scale[b]
        gram[a, a] -= limit**2
    return _factorised(gram)


@compiled
def _step(measured: Measured, box: Box, damping: float, unknowns: int, delta: float) -> np.ndarray:
    """The Gauss-Newton step of all unknowns at a box, with Levenberg's damping."""
    direction, ends, inverse = measured
    center, rotation, size = box
    normal, right, row = np.zeros((unknowns, unknowns)), np.zeros(unknowns), np.empty(unknowns)
    for i in range(len(direction)):
        _derivative(direction, i, rotation, size, row)
        middle, reach = _middle_and_reach(row, center, size)
        low, high = middle - reach - ends[i, 0], middle + reach - ends[i, 1]
        # Huber's weights: the cost is quadratic up to delta
        low_weight = inverse[i, 0] ** 2 * min(1.0, delta / abs(low * inverse[i, 0]))
        high_weight = inverse[i, 1] ** 2 * min(1.0, delta / abs(high * inverse[i, 1]))
        _add(normal, row, low_weight, high_weight)
        low_pull, high_pull = low_weight * low, high_weight * high
        for a in range(unknowns):
            right[a] -= row[a] * (high_pull + low_pull if a < 3 else high_pull - low_pull)
    trace = 0.0
    for a in range(unknowns):
        trace += normal[a, a]
    for a in range(unknowns):
        normal[a, a] += RIDGE * trace / unknowns + damping * normal[a, a]
    _factorised(normal)
    # forward and back substitution
    for a in range(unknowns):
        for b in range(a):
            right[a] -= normal[a, b] * right[b]
        right[a] /= normal[a, a]
    for a in range(unknowns - 1, -1, -1):
        for b in range(a + 1, unknowns):
            right[a] -= normal[b, a] * right[b]
        right[a] /= normal[a, a]
    return right


@compiled
def _cost(measured: Measured, box: Box, delta: float) -> float:
    """Huber's cost of a box, in units of the expected variance."""
    direction, ends, inverse = measured
    center, rotation, size = box
    row, cost = np.empty(FIXED), 0.0
    for i in range(len(direction)):
        _derivative(direction, i, rotation, size, row)
        middle, reach = _middle_and_reach(row, center, size)
        low, high = abs(middle - reach - ends[i, 0]) * inverse[i, 0], abs(middle + reach - ends[i, 1]) * inverse[i, 1]
        inner_low, inner_high = min(low, delta), min(high, delta)
        cost += inner_low * (low - 0.5 * inner_low) + inner_high * (high - 0.5 * inner_high)
    return cost


@compiled
def _derivative(direction: np.ndarray, i: int, rotation: np.ndarray, size: np.ndarray, row: np.ndarray) -> None:
    """Fills in, for one direction, the derivatives of the middle with respect to the centre, then those of the reach
    with respect to sizes and rotation.

    In box axes, the direction is a. A rotation by u changes it by a x u, and therefore the reach by u . (g x a) with
    g_i = s_i / 2 sign(a_i).
    """
    dx, dy, dz = direction[i, 0], direction[i, 1], direction[i, 2]
    ax = dx * rotation[0, 0] + dy * rotation[1, 0] + dz * rotation[2, 0]
    ay = dx * rotation[0, 1] + dy * rotation[1, 1] + dz * rotation[2, 1]
    az = dx * rotation[0, 2] + dy * rotation[1, 2] + dz * rotation[2, 2]
    row[0], row[1], row[2] = dx, dy, dz
    row[3], row[4], row[5] = abs(ax) / 2.0, abs(ay) / 2.0, abs(az) / 2.0
    if len(row) == FIXED:
        return
    gx, gy, gz = size[0] / 2.0 * np.sign(ax), size[1] / 2.0 * np.sign(ay), size[2] / 2.0 * np.sign(az)
    row[-1] = gx * ay - gy * ax
    if len(row) == FREE:
        row[6], row[7] = gy * az - gz * ay, gz * ax - gx * az


@compiled
def _middle_and_reach(row: np.ndarray, center: np.ndarray, size: np.ndarray) -> tuple[float, float]:
    """A box's middle and half-extent along a direction, metres, from the direction's `_derivative`."""
    middle = row[0] * center[0] + row[1] * center[1] + row[2] * center[2]
    return middle, row[3] * size[0] + row[4] * size[1] + row[5] * size[2]


@compiled
def _add(normal: np.ndarray, row: np.ndarray, low: float, high: float) -> None:
    """Adds an interval's two ends, with their weights, to the lower triangle of the normal equations.

    Both ends move together with the centre, and in opposite directions with all other unknowns. The mixed terms
    therefore depend only on the difference of the weights.
    """
    both, odd = low + high, high - low
    for a in range(3):
        for b in range(a + 1):
            normal[a, b] += both * row[a] * row[b]
    for a in range(3, len(row)):
        for b in range(3):
            normal[a, b] += odd * row[a] * row[b]
        for b in range(3, a + 1):
            normal[a, b] += both * row[a] * row[b]


@compiled
def _factorised(matrix: np.ndarray) -> bool:
    """Overwrites a symmetric matrix's lower triangle with its Cholesky factor; False if not positive definite."""
    for a in range(len(matrix)):
        for b in range(a + 1):
            rest = matrix[a, b]
            for c in range(b):
                rest -= matrix[a, c] * matrix[b, c]
            if a > b:
                matrix[a, b] = rest / matrix[b, b]
            elif rest > 0.0:
                matrix[a, a] = np.sqrt(rest)
            else:
                return False
    return True


@compiled
def _move(box: Box, step: np.ndarray, least: float, moved: Box) -> None:
    """Fills in the box after a step; the rotation is about the box's own axes (Rodrigues), radians."""
    center, rotation, size = box
    new_center, new_rotation, new_size = moved
    for j in range(3):
        new_center[j], new_size[j] = center[j] + step[j], max(size[j] + step[3 + j], least)
    x, y, z = 0.0, 0.0, 0.0
    if len(step) != FIXED:
        z = step[-1]
    if len(step) == FREE:
        x, y = step[6], step[7]
    angle = np.sqrt(x * x + y * y + z * z)
    # sin(t) / t and (1 - cos(t)) / t**2 in forms that are exact near zero
    by_cross = np.sin(angle) / angle if angle > 0.0 else 1.0
    by_square = 0.5 * (np.sin(0.5 * angle) / (0.5 * angle)) ** 2 if angle > 0.0 else 0.5
    for i in range(3):
        a, b, c = rotation[i, 0], rotation[i, 1], rotation[i, 2]
        # a row times the cross-product matrix of the rotation vector, once and twice
        ka, kb, kc = b * z - c * y, c * x - a * z, a * y - b * x
        kka, kkb, kkc = kb * z - kc * y, kc * x - ka * z, ka * y - kb * x
        new_rotation[i, 0] = a + by_cross * ka + by_square * kka
        new_rotation[i, 1] = b + by_cross * kb + by_square * kkb
        new_rotation[i, 2] = c + by_cross * kc + by_square * kkc


# Corners nearer than this are moved to it before they are projected, metres.
NEAR_M = 0.05


@compiled
def outlines(
    rotation: Float64[np.ndarray, "k 3 3"],
    center: Float64[np.ndarray, "k 3"],
    size: Float64[np.ndarray, "k 3"],
    image: Float64[np.ndarray, "4"],
) -> Float64[np.ndarray, "k 4"]:
    """The projections of boxes, clipped to the image.

    Args:
        rotation: columns = box axes.
        center, size: metres, camera frame.
        image: left, right, top and bottom end of the image, normalised (x/z, y/z).

    Returns:
        left, right, top, bottom, normalised.
    """
    result = np.empty((len(center), 4))
    for k in range(len(center)):
        left, right, top, bottom = np.inf, -np.inf, np.inf, -np.inf
        for corner in range(8):
            a = size[k, 0] * (0.5 if corner & 1 else -0.5)
            b = size[k, 1] * (0.5 if corner & 2 else -0.5)
            c = size[k, 2] * (0.5 if corner & 4 else -0.5)
            x = center[k, 0] + rotation[k, 0, 0] * a + rotation[k, 0, 1] * b + rotation[k, 0, 2] * c
            y = center[k, 1] + rotation[k, 1, 0] * a + rotation[k, 1, 1] * b + rotation[k, 1, 2] * c
            z = center[k, 2] + rotation[k, 2, 0] * a + rotation[k, 2, 1] * b + rotation[k, 2, 2] * c
            z = max(z, NEAR_M)
            left, right = min(left, x / z), max(right, x / z)
            top, bottom = min(top, y / z), max(bottom, y / z)
        result[k, 0] = min(max(left, image[0]), image[1])
        result[k, 1] = min(max(right, image[0]), image[1])
        result[k, 2] = min(max(top, image[2]), image[3])
        result[k, 3] = min(max(bottom, image[2]), image[3])
    return result


@compiled
def point_evidence(
    rotation: Float64[np.ndarray, "k 3 3"],
    center: Float64[np.ndarray, "k 3"],
    size: Float64[np.ndarray, "k 3"],
    points: Float64[np.ndarray, "n 3"],
    in_middle: Bool[np.ndarray, "n"],
    margin: float,
) -> Float64[np.ndarray, "k 3"]:
    """How the rays from the camera through points meet boxes.

    A ray that meets a box ends in it (a hit), behind it, or in front of it, at something that hides the box.

    Args:
        rotation, center, size: as in `outlines`.
        points: camera frame; at least one.
        in_middle: which points are in the middle of the image box.
        margin: by which the boxes are enlarged on each side, share of their mean side.

    Returns:
        hits as shares of all points, of those not ending in front, and of the middle's points not ending in front.
    """
    count = len(points)
    result = np.empty((len(center), 3))
    origin, half = np.empty(3), np.empty(3)
    for k in range(len(center)):
        mean = (size[k, 0] + size[k, 1] + size[k, 2]) / 3
        for axis in range(3):
            half[axis] = size[k, axis] / 2 + margin * mean
            origin[axis] = -(
                rotation[k, 0, axis] * center[k, 0]
                + rotation[k, 1, axis] * center[k, 1]
                + rotation[k, 2, axis] * center[k, 2]
            )
        hits, behind, hits_middle, open_middle = 0, 0, 0, 0
        for i in range(count):
            enter, leave = -np.inf, np.inf
            for axis in range(3):
                along = (
                    rotation[k, 0, axis] * points[i, 0]
                    + rotation[k, 1, axis] * points[i, 1]
                    + rotation[k, 2, axis] * points[i, 2]
                )
                first, second = (-half[axis] - origin[axis]) / along, (half[axis] - origin[axis]) / along
                enter, leave = max(enter, min(first, second)), min(leave, max(first, second))
            meets = enter < leave and leave > 0
            is_front = meets and enter > 1
            is_hit = meets and enter <= 1 and leave >= 1
            hits += is_hit
            behind += meets and leave < 1
            if in_middle[i] and not is_front:
                open_middle += 1
                hits_middle += is_hit
        result[k, 0] = hits / count
        result[k, 1] = hits / max(hits + behind, 1)
        result[k, 2] = hits_middle / max(open_middle, 1)
    return result
