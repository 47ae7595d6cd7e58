"""The silhouette loss, DIST Eq. 11, against values worked out by hand."""

import pytest
import torch

from renderers.silhouette import hinge_silhouette_loss

# Threshold 0.1. Soft silhouettes |closest| - 0.1: 0.4, -0.07, 0.2, -0.06.
CLOSEST = torch.tensor([0.5, 0.03, -0.3, -0.04], dtype=torch.float64)
ALL, NONE = torch.ones(4, dtype=torch.bool), torch.zeros(4, dtype=torch.bool)


def loss(mask, *, signed=False, average="all", closest=CLOSEST):
    return hinge_silhouette_loss(closest, mask, epsilon=0.1, signed=signed, average=average)


@pytest.mark.parametrize(
    ("mask", "signed", "average", "expected"),
    [
        # Foreground should be below 0: 0.4 and 0.2 are not. Background should be above: -0.07 and -0.06 are not.
        (ALL, False, "all", (0.4 + 0.2) / 4),
        (NONE, False, "all", (0.07 + 0.06) / 4),
        (ALL, False, "violating", (0.4 + 0.2) / 2),
        (NONE, False, "violating", (0.07 + 0.06) / 2),
        (torch.tensor([True, True, False, False]), False, "all", (0.4 + 0.06) / 4),
        (torch.tensor([True, True, False, False]), False, "violating", (0.4 + 0.06) / 2),
        # With its sign, the soft silhouette is 0.4, -0.07, -0.4, -0.14.
        (ALL, True, "all", 0.4 / 4),
        (ALL, True, "violating", 0.4),
        (NONE, True, "all", (0.07 + 0.4 + 0.14) / 4),
        (NONE, True, "violating", (0.07 + 0.4 + 0.14) / 3),
        (torch.tensor([False, True, True, True]), True, "violating", 0),  # nothing violates
        (torch.tensor([False, True, False, True]), False, "all", 0),
    ],
)
def test_values_worked_out_by_hand(mask, signed, average, expected):
    assert loss(mask, signed=signed, average=average).item() == pytest.approx(expected)


def test_a_background_ray_just_inside_is_pushed_out_with_its_sign_and_deeper_without():
    def slope(signed: bool) -> float:
        closest = torch.tensor([-0.04], dtype=torch.float64, requires_grad=True)
        loss(NONE[:1], signed=signed, closest=closest).backward()
        return closest.grad.item()

    assert slope(signed=True) == -1  # descent raises the field's value: out of the shape
    assert slope(signed=False) == 1  # descent lowers it: deeper


@pytest.mark.parametrize("signed", [False, True])
def test_gradients_pull_a_missed_ray_in_and_push_a_grazing_one_out(signed):
    def slopes(average: str, value: float, mask: bool) -> float:
        closest = torch.tensor([value, 5.0], dtype=torch.float64, requires_grad=True)
        loss(torch.tensor([mask, False]), signed=signed, average=average, closest=closest).backward()
        assert closest.grad[1] == 0  # a background ray far outside is content
        return closest.grad[0].item()

    assert slopes("all", 0.5, mask=True) == 0.5
    assert slopes("violating", 0.5, mask=True) == 1
    assert slopes("all", 0.03, mask=False) == -0.5
    assert slopes("violating", 0.03, mask=False) == -1


def test_any_leading_shape_gives_one_number():
    image = CLOSEST.view(2, 2)
    assert loss(ALL.view(2, 2), closest=image) == loss(ALL)
    assert loss(ALL[0], closest=CLOSEST[0]).shape == ()


@pytest.mark.parametrize("average", ["all", "violating"])
def test_no_rays_cost_nothing(average):
    assert loss(ALL[:0], average=average, closest=CLOSEST[:0]).item() == 0
