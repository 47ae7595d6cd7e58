"""An encoder from photographs to a prior's codes, from which shape from many views may start (PMO, Lin et al. 2019)."""

from copy import deepcopy
from dataclasses import asdict, dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from bench.evaluate.reference import fingerprint
from bench.evaluate.state import REACH
from bench.progress import notice
from bench.records.record import digest
from bench.setup.inputs import RunContext
from bench.shape_prior import Prior, kept, near_surface_first
from bench.single_view.network import encoder
from bench.solve.optimise import OptimiserSettings
from datasets.mesh import extract
from datasets.photographs import Photography
from datasets.scene import Truth
from renderers.checks import BadInput, check_at_least

VERSION = 1  # raise it when the training changes, so that no encoder of the old one is used
GRID = 64  # samples per axis, of the shapes that are photographed
POINTS, WIDTH = 256, 0.05  # at which a step compares two shapes; see `near_surface_first`


@dataclass(frozen=True)
class EncoderSettings:
    """How an encoder is made.

    Args:
        channels, blocks: see `bench.single_view.network.SingleViewNetwork`.
        pixels: per side, to which photographs are averaged.
        shapes: that are photographed: those of the prior's codes, and behind them blends of two of these.
        views: photographs of each, from random cameras of the run's `view` and with other textures.
        batch: photographs in a step.
        optimiser: steps of the training, and their rate.
    """

    channels: tuple[int, ...]
    blocks: int
    pixels: int
    shapes: int
    views: int
    batch: int
    optimiser: OptimiserSettings

    def __post_init__(self) -> None:
        for name in ("blocks", "pixels", "shapes", "views", "batch"):
            check_at_least(f"task.encoder.{name}", getattr(self, name), 1, "+method=multiview_encoder works")

    def start(
        self, run: RunContext, like: Photography, photographs: Float[Tensor, "views height width 3"]
    ) -> Float[Tensor, " code_length"]:
        """The mean of the codes that the photographs are encoded to, by the encoder in the cache, or a new one.

        Args:
            like: settings of the photographs, and of those of the training.
        """
        inputs, prior = run.inputs, Prior(deepcopy(run.inputs.prior.decoder).cpu(), run.inputs.prior.codes)
        settings = {"encoder": asdict(self), "photographs": asdict(like), "view": asdict(inputs.views)}
        key = digest({"version": VERSION, "prior": fingerprint(prior), **settings})
        with torch.random.fork_rng(), torch.device("cpu"):
            torch.manual_seed(0)
            network = encoder(3, self.channels, self.blocks, prior.codes.shape[1])
            model = nn.Sequential(nn.AdaptiveAvgPool2d(self.pixels), *network)

            def make() -> dict[str, Tensor]:
                notice(f"training an encoder to the codes of a prior, once; it is stored in {inputs.cache}")
                self._train(model, prior, run, like)
                return model.state_dict()

            model.load_state_dict(kept(inputs.cache, f"encoder-{key}", make))
        with torch.no_grad():
            return prior.codes.std() * model(photographs.permute(0, 3, 1, 2)).mean(0)

    def _train(self, model: nn.Sequential, prior: Prior, run: RunContext, like: Photography) -> None:
        """Fits the encoder by the differences of the values of the true and the encoded shape."""
        codes = torch.stack([_code(prior, index) for index in range(self.shapes)])
        images = torch.cat([self._photographed(prior, index, run, like) for index in range(self.shapes)])
        images = model[0](images.permute(0, 3, 1, 2))
        adam, steps, size = torch.optim.Adam(model.parameters()), self.optimiser.iterations, prior.codes.std()
        for step in range(steps):
            adam.param_groups[0]["lr"] = self.optimiser.rate(step)
            chosen = torch.randint(len(images), (self.batch,))
            points = 2 * torch.rand(self.batch, POINTS, 3) - 1
            found = model(images[chosen][:, torch.randperm(3)])  # whichever colour is which
            true = _values(prior, codes[chosen // self.views], points)
            loss = near_surface_first((_values(prior, size * found, points) - true).abs(), true, WIDTH).mean()
            adam.zero_grad()
            loss.backward()
            adam.step()
            run.progress("training the encoder", step + 1, steps, loss.item())

    def _photographed(
        self, prior: Prior, index: int, run: RunContext, like: Photography
    ) -> Float[Tensor, "views height width 3"]:
        """Photographs of the shape of a code, each with another texture, so that no texture tells the shape."""
        run.progress("photographing shapes for the encoder", index, self.shapes)
        mesh = extract(prior.decoder.at(_code(prior, index)), grid=GRID, reach=REACH)
        if mesh is None:
            raise BadInput(
                f"the prior has no surface at code {index}, from which no encoder can learn: remove task.encoder"
            )
        truth, places = Truth(mesh), range(index * self.views, (index + 1) * self.views)
        shots = [like.take_from(truth, [run.inputs.views.draw(place)], seed=place)[0] for place in places]
        return torch.stack([shot.colours for shot in shots])


def _values(
    prior: Prior, codes: Float[Tensor, "batch code_length"], points: Float[Tensor, "batch n 3"]
) -> Float[Tensor, "batch n"]:
    return torch.stack([prior.decoder.at(code)(where) for code, where in zip(codes, points, strict=True)])


def _code(prior: Prior, index: int) -> Float[Tensor, " code_length"]:
    """The prior's code of that number, or beyond the last one a blend of two."""
    if index < len(prior.codes):
        return prior.codes[index]
    generator = torch.Generator().manual_seed(index)
    first, second = torch.randperm(len(prior.codes), generator=generator)[:2]
    return torch.lerp(prior.codes[first], prior.codes[second], torch.rand((), generator=generator))
