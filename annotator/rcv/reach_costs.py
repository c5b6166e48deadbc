"""How well each of many rotations explains the lengths of measured intervals: the grid search of the box fit.

Half an interval's length along d is `sum_i s_i / 2 |d.r_i|`: linear in the sizes once the rotation is known, and free
of the centre. So each rotation is one least-squares problem with three unknowns, solved in closed form, and for the
better ones the sizes are solved for again with each interval weighted by how well it fitted (`kernels.reach`).
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64

from annotator.rcv.config import FitConfig

# The share of the rotations that is looked at again: an interval that is wrong pulls at all of them alike at first.
AGAIN = 0.25
# So few rotations are all looked at again.
FEW = 64


def reach_costs(
    directions: Float64[np.ndarray, "m 3"],
    ends_m: Float64[np.ndarray, "m 2"],
    sigma_m: Float64[np.ndarray, "m 2"],
    rotations: Float64[np.ndarray, "k 3 3"],
    config: FitConfig,
) -> Float64[np.ndarray, "k"]:
    """The robust cost of each rotation with its best sizes, in units of the expected variance; infinite for those that
    were not among the better ones after the first look.

    Args:
        directions, ends_m, sigma_m: as of `Intervals`; an interval with an unknown end does not count.
        rotations: columns = box axes in the frame of `directions`.
    """
    from annotator.rcv.kernels.reach import size_costs

    half = (ends_m[:, 1] - ends_m[:, 0]) / 2
    sigma = np.hypot(sigma_m[:, 0], sigma_m[:, 1]) / 2
    known = np.isfinite(sigma)
    # in multiples of the expected error, so that every weight begins at one
    scaled, target = directions[known] / sigma[known, None] / 2, half[known] / sigma[known]
    delta, least = config.huber_sigmas, config.min_size_m
    if len(rotations) <= FEW:
        return size_costs(scaled, target, rotations.copy(), delta, least, 2)
    # copies, since functions are compiled anew for arrays that are read-only
    costs = size_costs(scaled, target, rotations.copy(), delta, least, 1)
    again = np.argpartition(costs, int(len(costs) * AGAIN))[: int(len(costs) * AGAIN)]
    costs[:] = np.inf
    costs[again] = size_costs(scaled, target, rotations[again], delta, least, 2)
    return costs
