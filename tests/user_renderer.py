"""A user's package: a renderer in fifteen lines that calls shared functions."""

from renderers import IDR, Capabilities, Field, Kind, Rays, Rendering


class Mine:
    """Source: this test. Differentiable in: field and rays. Needs: a distance. Deviates from the paper: no."""

    capabilities = Capabilities(needs=(Kind.DISTANCE, Kind.BOUND), field_gradient=True, ray_gradient=True)

    def __init__(self, steps: int = 60) -> None:
        self.tracer = IDR(
            steps=steps, epsilon=1e-5, least_slope=1e-3, mask_sharpness=50.0, mask_weight=100.0, sphere_radius=1.0
        )

    def render(self, field: Field, rays: Rays) -> Rendering:
        return self.tracer.render(field, rays)

    def silhouette_loss(self, field, rays, rendering, mask):
        return self.tracer.silhouette_loss(field, rays, rendering, mask)
