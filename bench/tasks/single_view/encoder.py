"""An encoder from photographs to a prior's codes, a start of shape from many views (PMO, Lin et al. 2019)."""

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
from bench.shape_prior import Prior, load_or_make, near_surface_first
from bench.solve.optimise import OptimiserSettings
from bench.tasks.single_view.network import encoder
from datasets.mesh import extract
from datasets.photographs import Photography
from datasets.scene import Truth
from renderers.checks import BadInput, check_at_least

VERSION = 1  # raise it when the training changes, so that no encoder of the old one is used
GRID_SAMPLES = 64  # per axis, of the photographed shapes
COMPARED_POINTS, SURFACE_WIDTH = 256, 0.05  # for the comparison of two shapes; see `near_surface_first`


@dataclass(frozen=True)
class EncoderSettings:
    """Settings of an encoder and its training.

    Args:
        channels, blocks: see `bench.tasks.single_view.network.SingleViewNetwork`.
        pixels: per side of the averaged photographs.
        shapes: number of photographed shapes: first the prior's codes, then blends of two codes.
        views: photographs of each shape, from random cameras of the run's `view` and with different textures.
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
        self, run: RunContext, photography: Photography, photographs: Float[Tensor, "views height width 3"]
    ) -> Float[Tensor, " code_length"]:
        """The mean code of the photographs, by the encoder in the cache or a newly trained one.

        Args:
            photography: settings of these photographs and of the training photographs.
        """
        inputs, prior = run.inputs, Prior(deepcopy(run.inputs.prior.decoder).cpu(), run.inputs.prior.codes)
        settings = {"encoder": asdict(self), "photographs": asdict(photography), "view": inputs.views.identity}
        key = digest({"version": VERSION, "prior": fingerprint(prior), **settings})
        with torch.random.fork_rng(), torch.device("cpu"):
            torch.manual_seed(0)
            network = encoder(3, self.channels, self.blocks, prior.codes.shape[1])
            model = nn.Sequential(nn.AdaptiveAvgPool2d(self.pixels), *network)

            def make() -> dict[str, Tensor]:
                notice(f"training an encoder to the codes of a prior, once; it is stored in {inputs.cache}")
                self._train(model, prior, run, photography)
                return model.state_dict()

            model.load_state_dict(load_or_make(inputs.cache, f"encoder-{key}", make))
        with torch.no_grad():
            return prior.codes.std() * model(photographs.permute(0, 3, 1, 2)).mean(0)

    def _train(self, model: nn.Sequential, prior: Prior, run: RunContext, photography: Photography) -> None:
        """Fits the encoder by the differences between the field values of the true and the encoded shape."""
        codes = torch.stack([_shape_code(prior, index) for index in range(self.shapes)])
        images = torch.cat([self._photographs(prior, index, run, photography) for index in range(self.shapes)])
        images = model[0](images.permute(0, 3, 1, 2))
        adam, steps, size = torch.optim.Adam(model.parameters()), self.optimiser.iterations, prior.codes.std()
        for step in range(steps):
            adam.param_groups[0]["lr"] = self.optimiser.rate(step)
            chosen = torch.randint(len(images), (self.batch,))
            points = 2 * torch.rand(self.batch, COMPARED_POINTS, 3) - 1
            encoded = model(images[chosen][:, torch.randperm(3)])  # in a random order of the colour channels
            true = _values(prior, codes[chosen // self.views], points)
            loss = near_surface_first((_values(prior, size * encoded, points) - true).abs(), true, SURFACE_WIDTH).mean()
            adam.zero_grad()
            loss.backward()
            adam.step()
            run.progress("training the encoder", step + 1, steps, loss.item())

    def _photographs(
        self, prior: Prior, index: int, run: RunContext, photography: Photography
    ) -> Float[Tensor, "views height width 3"]:
        """Photographs of the shape of a code, each with another texture, so that no texture identifies the shape."""
        run.progress("photographing shapes for the encoder", index, self.shapes)
        mesh = extract(prior.decoder.at(_shape_code(prior, index)), grid=GRID_SAMPLES, reach=REACH)
        if mesh is None:
            raise BadInput(
                f"the prior has no surface at code {index}, from which no encoder can learn: remove task.encoder"
            )
        truth, seeds = Truth(mesh), range(index * self.views, (index + 1) * self.views)
        shots = [photography.take_from(truth, [run.inputs.views.draw(seed)], seed=seed)[0] for seed in seeds]
        return torch.stack([shot.colours for shot in shots])


def _values(
    prior: Prior, codes: Float[Tensor, "batch code_length"], points: Float[Tensor, "batch n 3"]
) -> Float[Tensor, "batch n"]:
    return torch.stack([prior.decoder.at(code)(batch) for code, batch in zip(codes, points, strict=True)])


def _shape_code(prior: Prior, index: int) -> Float[Tensor, " code_length"]:
    """The prior's code with this index; beyond the last code, a blend of two codes."""
    if index < len(prior.codes):
        return prior.codes[index]
    generator = torch.Generator().manual_seed(index)
    first, second = torch.randperm(len(prior.codes), generator=generator)[:2]
    return torch.lerp(prior.codes[first], prior.codes[second], torch.rand((), generator=generator))
