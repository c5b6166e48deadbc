"""The Muon optimiser."""

from __future__ import annotations

import numpy as np
import pytest

from annotator.detection.ultralytics_api import api


@pytest.mark.parametrize("shape", [(8, 8), (4, 30), (30, 4), (1, 9)])
def test_singular_values_approach_one_and_vectors_stay(shape: tuple[int, int]) -> None:
    torch = api().torch
    from annotator.detection.trainer import orthogonalised

    rng = np.random.default_rng(0)
    u, _, v = np.linalg.svd(rng.normal(size=(3, *shape)), full_matrices=False)
    spread = np.geomspace(5.0, 0.2, min(shape))
    matrix = torch.from_numpy((u * spread @ v).astype(np.float32))
    result = orthogonalised(matrix)
    assert result.shape == matrix.shape
    values = torch.linalg.svdvals(result)
    assert (values > 0.5).all()
    assert (values < 1.3).all()
    # Same singular vectors: matrix^T result is symmetric and positive.
    product = matrix.transpose(1, 2) @ result
    assert torch.allclose(product, product.transpose(1, 2), atol=1e-3)
    assert (torch.linalg.eigvalsh(product) > -1e-3).all()


def test_the_optimiser_solves_a_least_squares_problem() -> None:
    torch = api().torch
    from annotator.detection.trainer import MuonSgd

    torch.manual_seed(0)
    goal, inputs = torch.randn(6, 5), torch.randn(64, 5)
    weight = torch.nn.Parameter(torch.zeros(6, 5))
    bias = torch.nn.Parameter(torch.zeros(6))
    optimizer = MuonSgd(
        [
            {"params": [weight], "use_muon": True, "lr": 0.1, "momentum": 0.9, "weight_decay": 0.0},
            {"params": [bias], "use_muon": False, "lr": 0.1, "momentum": 0.9, "weight_decay": 0.0},
        ]
    )
    losses = []
    for _ in range(150):
        loss = ((inputs @ weight.T + bias - inputs @ goal.T - 1) ** 2).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < 0.01 * losses[0]


def test_the_state_of_the_optimiser_can_be_saved_and_restored() -> None:
    torch = api().torch
    from annotator.detection.trainer import MuonSgd

    def make() -> tuple[object, object]:
        torch.manual_seed(1)
        weight = torch.nn.Parameter(torch.randn(4, 3, 2, 2))
        return weight, MuonSgd([{"params": [weight], "use_muon": True, "lr": 0.05, "momentum": 0.9}])

    def steps(weight: object, optimizer: object, seeds: range) -> None:
        for seed in seeds:
            weight.grad = torch.from_numpy(  # type: ignore[attr-defined]
                np.random.default_rng(seed).normal(size=(4, 3, 2, 2)).astype(np.float32)
            )
            optimizer.step()  # type: ignore[attr-defined]

    straight, optimizer = make()
    steps(straight, optimizer, range(6))
    first, before = make()
    steps(first, before, range(3))
    second, after = make()
    second.data.copy_(first.data)  # type: ignore[attr-defined]
    after.load_state_dict(before.state_dict())  # type: ignore[attr-defined]
    steps(second, after, range(3, 6))
    assert torch.allclose(straight, second)
