"""Makes a detection head give out how uncertain each edge is.

A head with distribution focal loss (YOLOv8, 11 and others, not 26) predicts a distribution of the distance from an
anchor to each edge. Ultralytics keeps only its mean. Here the graph also computes its standard deviation.
"""

from __future__ import annotations

from typing import Any

from annotator.detection.ultralytics_api import api


def give_edge_spread(head: Any) -> bool:
    """Replaces the decoding of a head; its output gains four rows: the spread of each edge, pixels.

    The means become weighted sums, because OpenVINO would compute ultralytics' convolution, and the softmax before
    it, in half precision.

    Returns:
        False if the head predicts distances directly; it is then left as it is.
    """
    torch = api().torch
    bins = getattr(head.dfl, "c1", None)
    if bins is None:
        return False

    class Mean(torch.nn.Module):  # type: ignore[name-defined]
        def __init__(self) -> None:
            super().__init__()
            self.register_buffer("distances", torch.arange(bins, dtype=torch.float32).view(1, 1, bins, 1))

        def shares(self, logits: Any) -> Any:
            return logits.view(logits.shape[0], 4, bins, logits.shape[2]).softmax(2)

        def forward(self, logits: Any) -> Any:
            return (self.shares(logits) * self.distances).sum(2)

        def spread(self, logits: Any) -> Any:
            shares = self.shares(logits)
            mean = (shares * self.distances).sum(2, keepdim=True)
            # not the mean of squares minus the square of the mean, which would round to noise for narrow distributions
            return (shares * (self.distances - mean) ** 2).sum(2).sqrt()

    head.dfl = Mean().to(head.dfl.conv.weight.device)
    decode = head._inference

    def with_spread(features: dict[str, Any]) -> Any:
        answer = decode(features)  # also sets the strides
        return torch.cat((answer, head.dfl.spread(features["boxes"]) * head.strides), 1)

    head._inference = with_spread
    return True
