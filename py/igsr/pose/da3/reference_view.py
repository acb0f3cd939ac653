"""Which view is the reference, whose frame the world frame is close to.

Depth Anything 3 (arXiv 2511.10647). The choice is made from class tokens in the midst of the
backbone.
"""

from __future__ import annotations

import torch
from torch import Tensor

from igsr.errors import IgsrError

#: "first" and "middle" go by the order of the views, the others by what the views show.
REFERENCES = ("saddle_balanced", "first", "middle", "saddle_sim_range")
USUAL = REFERENCES[0]
#: Similarities that differ by less are equal: with all of them positive, the two most similar views
#: tie, and rounding would decide.
EQUAL = 1e-5


def reference_view(tokens: Tensor, reference: str = USUAL) -> int:
    """The index of the reference view.

    Args:
        tokens: float [S, C], a class token per view.
        reference: "first"; "middle", S // 2; "saddle_balanced", the view that is most average in
            its similarity to the others, and in size and variance of its token; or
            "saddle_sim_range", the view whose similarities to the others differ most. The first of
            equals.

    Raises:
        IgsrError: ``reference`` is none of these.
    """
    if reference == "first":
        return 0
    if reference == "middle":
        return len(tokens) // 2
    tokens = tokens.float()
    directions = tokens / tokens.norm(dim=-1, keepdim=True)
    similarity = directions @ directions.mT
    similarity.fill_diagonal_(0.0)
    if reference == "saddle_sim_range":
        spread = similarity.amax(dim=1) - similarity.amin(dim=1)
        return int((spread > spread.max() - EQUAL).nonzero()[0])
    if reference != "saddle_balanced":
        raise IgsrError(f"reference is {reference!r}; give one of {', '.join(REFERENCES)}")
    measures = torch.stack(
        [
            similarity.sum(dim=1) / max(len(tokens) - 1, 1),
            tokens.norm(dim=-1),
            directions.var(dim=-1),
        ]
    )
    least = measures.amin(dim=1, keepdim=True)
    ranges = measures.amax(dim=1, keepdim=True) - least
    off = ((measures - least) / (ranges + 1e-8) - 0.5).abs().sum(dim=0)
    return int(off.argmin())
