"""The pixels that an iteration compares: all of them, or a random one of each block."""

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from datasets.views import pixel_of_each_block
from renderers.checks import BadInput

COARSE_BLOCKS = (4, 2)  # pixels per side of the first blocks, if pixels are held out
HELD_OUT_FRACTION = 0.1


def generator_of(seed: int, iteration: int) -> torch.Generator:
    """The generator of an iteration's random draws, on the CPU."""
    return torch.Generator().manual_seed(seed * 1_000_003 + iteration)


class PixelDraw:
    """The pixels of an image that each iteration compares, by rows.

    If pixels are held out, blocks of 4 and 2 pixels per side come before those of `block`; see `refine`.
    """

    def __init__(self, observed: Bool[Tensor, "height width"], block: int, seed: int, *, holds_out: bool = False):
        """Draws the pixels to hold out, a tenth of the observed and of the other pixels.

        Args:
            block: pixels per side of a block; 1 compares all pixels.
            holds_out: whether pixels are held out.

        Raises:
            BadInput: a tenth of the observed pixels is less than one.
        """
        (self.height, self.width), self.seed = observed.shape, seed
        self.blocks = [*(side for side in COARSE_BLOCKS if holds_out and side > block), block]
        self.is_held_out, generator = torch.zeros(observed.numel(), dtype=torch.bool), generator_of(seed, -1)
        for group in (observed.flatten().cpu(), ~observed.flatten().cpu()) if holds_out else ():
            pixels = group.nonzero().squeeze(-1)
            drawn = torch.randperm(len(pixels), generator=generator)[: int(HELD_OUT_FRACTION * len(pixels))]
            self.is_held_out[pixels[drawn]] = True
        if holds_out and not (self.is_held_out & observed.flatten().cpu()).any():
            few = f"{int(observed.sum())} pixels with depth have no tenth to hold out"
            raise BadInput(f"{few}: set task.optimiser.ends=iterations or effort=full, or give task.points=10 or more")
        self.held_out, self.kept = (mask.nonzero().squeeze(-1) for mask in (self.is_held_out, ~self.is_held_out))
        self.drawn, self.iterations = 0, 0  # numbers of pixels and calls of `pixels`

    def pixels(self, iteration: int) -> Int[Tensor, " n"] | None:
        """The compared pixels without those held out; None if these are all pixels."""
        drawn = self.kept
        if (side := self.blocks[0]) > 1:
            drawn = pixel_of_each_block(self.height, self.width, side, generator_of(self.seed, iteration))
            drawn = drawn[~self.is_held_out[drawn]]
        self.drawn, self.iterations = self.drawn + len(drawn), self.iterations + 1
        return None if len(drawn) == len(self.is_held_out) else drawn

    def refine(self) -> bool:
        """Goes on to smaller blocks; returns False if there are none."""
        return len(self.blocks) > 1 and bool(self.blocks.pop(0))

    def release(self) -> None:
        """From now on, all pixels are compared, also the held-out ones."""
        self.is_held_out[:] = False
        self.blocks, self.kept = [1], torch.arange(len(self.is_held_out))

    @property
    def per_iteration(self) -> int:
        """The mean number of pixels over the iterations so far; before the first, the number of the last blocks."""
        blocks = -(-self.height // self.blocks[-1]) * -(-self.width // self.blocks[-1])
        return round(self.drawn / self.iterations) if self.iterations else blocks
