"""Muon with SGD, the most accurate optimiser on small training sets, fast enough for a CPU.

Muon (K. Jordan et al., "Muon: an optimizer for hidden layers in neural networks", 2024) replaces each weight matrix's
momentum by approximately the nearest semi-orthogonal matrix, found by Newton-Schulz iteration. Ultralytics trains
YOLO26 with a mix of Muon and SGD. Its version computes in bfloat16 and pads matrices to batches, which suits GPUs; on a
CPU it takes nearly as long as the rest of a training step. This version computes in float32 and batches equal shapes
only.

This module imports torch; import it only to train.
"""

from __future__ import annotations

from collections import defaultdict
from typing import Any

import torch

# Coefficients and number of the Newton-Schulz iterations, from the Muon paper.
NEWTON_SCHULZ = (3.4445, -4.7750, 2.0315)
ITERATIONS = 5


def orthogonalised(matrices: torch.Tensor) -> torch.Tensor:
    """The (n, rows, columns) matrices with all singular values moved close to 1 (0.7 to 1.2)."""
    a, b, c = NEWTON_SCHULZ
    x = matrices / (matrices.norm(dim=(1, 2), keepdim=True) + 1e-7)
    tall = x.shape[1] > x.shape[2]
    if tall:
        x = x.transpose(1, 2)
    for _ in range(ITERATIONS):
        gram = x @ x.transpose(1, 2)
        x = torch.baddbmm(x, torch.baddbmm(gram, gram, gram, beta=b, alpha=c), x, beta=a)
    return x.transpose(1, 2) if tall else x


class MuonSgd(torch.optim.Optimizer):
    """SGD with Nesterov momentum for all parameters, plus a Muon update for groups with `use_muon`.

    Groups have `lr`, `momentum`, `weight_decay` (of the SGD part) and `use_muon`. Parameters of a Muon group have at
    least two dimensions; all but the first are flattened.
    """

    def __init__(self, groups: list[dict[str, Any]], muon: float = 0.2, sgd: float = 1.0) -> None:
        """
        Args:
            groups: parameter groups.
            muon, sgd: factors of the learning rate for the two parts.
        """
        super().__init__(groups, {"lr": 0.01, "momentum": 0.9, "weight_decay": 0.0, "use_muon": False})
        self._muon, self._sgd = muon, sgd

    @torch.no_grad()
    def step(self, closure: Any = None) -> None:
        """One update from the gradients; `closure` is not supported."""
        for group in self.param_groups:
            parameters = [p for p in group["params"] if p.grad is not None]
            if not parameters:
                continue
            lr, momentum = group["lr"], group["momentum"]
            if group["use_muon"]:
                self._muon_part(parameters, lr * self._muon, momentum)
                lr = lr * self._sgd
            buffers = self._buffers(parameters, "momentum_sgd")
            gradients = [p.grad for p in parameters]
            if group["weight_decay"]:
                gradients = torch._foreach_add(gradients, parameters, alpha=group["weight_decay"])
            torch._foreach_mul_(buffers, momentum)
            torch._foreach_add_(buffers, gradients)
            torch._foreach_add_(parameters, torch._foreach_add(gradients, buffers, alpha=momentum), alpha=-lr)

    def _muon_part(self, parameters: list[torch.Tensor], lr: float, momentum: float) -> None:
        buffers = self._buffers(parameters, "momentum_muon")
        gradients = [p.grad for p in parameters]
        torch._foreach_lerp_(buffers, gradients, 1 - momentum)
        ahead = torch._foreach_lerp(gradients, buffers, momentum)
        by_shape: dict[torch.Size, list[int]] = defaultdict(list)
        for index, parameter in enumerate(parameters):
            by_shape[parameter.shape].append(index)
        for shape, indices in by_shape.items():
            rows, columns = shape[0], shape[1:].numel()
            update = orthogonalised(torch.stack([ahead[i].reshape(rows, columns) for i in indices]))
            step = lr * max(1.0, rows / columns) ** 0.5
            for i, change in zip(indices, update, strict=True):
                parameters[i].add_(change.reshape(shape), alpha=-step)

    def _buffers(self, parameters: list[torch.Tensor], name: str) -> list[torch.Tensor]:
        for parameter in parameters:
            if name not in self.state[parameter]:
                self.state[parameter][name] = torch.zeros_like(parameter)
        return [self.state[parameter][name] for parameter in parameters]
