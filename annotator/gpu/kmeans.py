"""K-means of directions on a device, as in `annotator.rcv.axes.axial_kmeans`."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float64

from annotator.rcv.axes import KMEANS_ROUNDS


def axial_kmeans(
    directions: Float64[np.ndarray, "n 3"], clusters: int, seed: int, device: Any
) -> tuple[Float64[np.ndarray, "k 3"], np.ndarray]:
    """As `annotator.rcv.axes.axial_kmeans`: the same clusters for the same seed; the sign of a centre may differ.

    Args:
        device: a torch device with double precision.
    """
    import torch

    points = torch.tensor(directions, device=device)
    first = int(np.random.default_rng(seed).integers(len(directions)))
    centres = [points[first]]
    nearest = (points * centres[0]).sum(dim=1).abs()
    for _ in range(clusters - 1):
        centres.append(points.index_select(0, nearest.argmin()[None])[0])
        nearest = torch.maximum(nearest, (points * centres[-1]).sum(dim=1).abs())
    centre = torch.stack(centres)
    outer = (points[:, :, None] * points[:, None]).reshape(-1, 9)
    member = torch.full((len(directions),), -1, device=device)
    for _ in range(KMEANS_ROUNDS):
        assigned = (points @ centre.T).abs().argmax(dim=1)
        if bool((assigned == member).all()):
            break
        member = assigned
        is_member = torch.nn.functional.one_hot(member, clusters).to(points.dtype)
        # the sums of n n^T of all clusters in one product, and their eigenvectors in one batch
        moments = (is_member.T @ outer).reshape(clusters, 3, 3)
        principal = torch.linalg.eigh(moments).eigenvectors[:, :, -1]
        centre = torch.where((is_member.sum(dim=0) > 0)[:, None], principal, centre)
    return centre.cpu().numpy(), np.bincount(member.cpu().numpy(), minlength=clusters)
