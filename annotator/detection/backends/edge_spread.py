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
    decode = head._inference

    def with_spread(features: dict[str, Any]) -> Any:
        logits = features["boxes"]
        images, _, anchors = logits.shape
        shares = logits.view(images, 4, bins, anchors).softmax(2)
        distances = torch.arange(bins, dtype=logits.dtype, device=logits.device).view(1, 1, bins, 1)
        mean = (shares * distances).sum(2, keepdim=True)
        answer = decode({**features, "boxes": mean[:, :, 0]})  # also sets the strides
        # not the mean of squares minus the square of the mean, which would round to noise for narrow distributions
        apart = distances - mean
        spread = (shares * apart * apart).sum(2).sqrt()
        return torch.cat((answer, spread * head.strides), 1)

    head.dfl = torch.nn.Identity()  # `decode` gets the means
    head._inference = with_spread
    return True
