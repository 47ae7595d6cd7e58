"""Counts PyTorch's operations on a CPU as a GPU would execute them: each is a launch, some make the host wait."""

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

# Views and allocations, which compute nothing.
FREE = (
    *("alias", "as_strided", "chunk", "detach", "diagonal", "empty", "expand", "lift_fresh", "narrow", "new_empty"),
    *("permute", "reshape", "resize", "select", "slice", "split", "squeeze", "t", "transpose", "unbind", "unfold"),
    *("unsqueeze", "view", "_reshape_alias", "_unsafe_view"),
)
# The host must wait for the result, or its size.
WAITS = ("nonzero", "_local_scalar_dense", "masked_select", "unique", "is_nonzero", "equal", "repeat_interleave")


class Operations(TorchDispatchMode):
    """Counts the operations within it, also those of backward passes.

    `launches` counts all that compute. `waits` counts, by name, those that make the host wait. `made` counts, by the
    number of elements, the results that were not computed in place.
    """

    def __init__(self) -> None:
        super().__init__()
        self.launches, self.waits, self.made = 0, Counter[str](), Counter[int]()
        self.paused = False

    @contextmanager
    def pause(self) -> Iterator[None]:
        """Within it nothing is counted."""
        self.paused = True
        yield
        self.paused = False

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name = str(function).removeprefix("aten.").split(".")[0]
        result = function(*args, **(kwargs or {}))
        if self.paused or name in FREE:
            return result
        self.launches += 1
        masks = name in ("index", "index_put", "index_put_") and any(
            index is not None and index.dtype == torch.bool for index in args[1]
        )
        if name in WAITS or masks:
            self.waits[name] += 1
        if isinstance(result, Tensor) and not function._schema.is_mutable:
            self.made[result.numel()] += 1
        return result
