"""Compiled values and gradients against their plain twin; and that runs without a compiler do the same more slowly."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from bench.machine import environment
from bench.machine.environment import using_threads
from renderers.fields.mlp import BoundDecoder, Decoder
from renderers.kernels import decoder as decoder_kernels
from renderers.kernels import library
from renderers.kernels.library import kernels
from tests.looped import each

NETWORKS = {
    "no skip": {"layers": 3, "width": 64, "skip": 0, "narrow": False},
    "skip": {"layers": 4, "width": 128, "skip": 2, "narrow": False},
    "odd widths": {"layers": 3, "width": 50, "skip": 1, "narrow": True},
    "skip last": {"layers": 3, "width": 65, "skip": 2, "narrow": False},
    "one layer": {"layers": 1, "width": 7, "skip": 0, "narrow": False},
}


def by_default() -> library.Kernels:
    """The kernels of a process that chooses nothing."""
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv(library.KERNELS_VARIABLE, raising=False)
        return kernels.__wrapped__()


COMPILED = by_default()
with_compiler = pytest.mark.skipif(COMPILED.library is None, reason=f"nothing is compiled here: {COMPILED.description}")


@pytest.fixture(autouse=True)
def compiled_code(monkeypatch):
    monkeypatch.setattr(decoder_kernels, "kernels", lambda: COMPILED)


def make(name: str) -> Decoder:
    torch.manual_seed(0)
    return Decoder(code_length=4, **NETWORKS[name]).requires_grad_(False)


def fresh(monkeypatch: pytest.MonkeyPatch, cache: Path, **environment: str) -> library.Kernels:
    """The kernels of a new process."""
    for name, value in {"XDG_CACHE_HOME": str(cache), library.KERNELS_VARIABLE: "", **environment}.items():
        monkeypatch.setenv(name, value)
    return kernels.__wrapped__()


@with_compiler
@each("name", NETWORKS)
@each("count", [0, 1, 5, 6, 47, 48, 301])
def test_values_are_those_of_torch(name, count):
    field = make(name).at(torch.linspace(-1, 1, 4))
    points = 2 * torch.rand(count, 3) - 1
    with using_threads(1):
        assert field._compiled_for(points) is field._compiled()
        torch.testing.assert_close(field(points), field._forward(points), rtol=1e-6, atol=1e-6)
        if count > 5:
            points[2], points[4] = torch.nan, torch.inf
            assert torch.equal(field(points).isnan(), field._forward(points).isnan()) and field(points).isnan().any()


def gradients(forward, points: torch.Tensor, code: torch.Tensor, to_values: torch.Tensor):
    """The gradients of points and code, of values by `forward`."""
    return torch.autograd.grad(forward(points), (points, code), to_values)


@with_compiler
@each("name", NETWORKS)
@each("count", [1, 48, 301])
def test_gradients_are_those_of_torch_in_float64(name, count):
    """Of points and code, with zeros among the gradients of values; all values have a gradient, or one."""
    decoder, generator = make(name), torch.Generator().manual_seed(1)
    points = 2 * torch.rand(count, 3, generator=generator) - 1
    to_values = torch.randn(count, generator=generator) * (torch.rand(count, generator=generator) > 0.3)
    with using_threads(1):
        for weights in (to_values, torch.zeros(count), torch.ones(count)):
            leaf, code = points.clone().requires_grad_(), torch.linspace(-1, 1, 4).requires_grad_()
            compiled = gradients(make(name).at(code), leaf, code, weights)
            twin, code = decoder.double(), code.detach().double().requires_grad_()
            leaf = leaf.detach().double().requires_grad_()
            expected = gradients(twin.at(code)._forward, leaf, code, weights.double())
            for gradient, truth in zip(compiled, expected, strict=True):
                scale = max(float(truth.abs().max()), 1e-9)
                torch.testing.assert_close(gradient.double(), truth, rtol=0, atol=3e-6 * scale)


@with_compiler
def test_a_nan_spoils_the_gradient_of_its_point_alone():
    field, points = make("skip").at(torch.zeros(4)), torch.rand(50, 3)
    points[7] = torch.nan
    weights = torch.ones(50)
    weights[9] = torch.nan
    with using_threads(1):
        leaf = points.clone().requires_grad_()
        (gradient,) = torch.autograd.grad(field(leaf), leaf, weights)
        without = torch.arange(50)[(torch.arange(50) != 7) & (torch.arange(50) != 9)]
        other = points[without].requires_grad_()
        (expected,) = torch.autograd.grad(field(other), other, torch.ones(48))
    torch.testing.assert_close(gradient[without], expected)
    assert gradient[9].isnan().all()


@with_compiler
def test_a_nan_passes_closed_relus_as_in_torch():
    decoder = make("skip")
    for layer in decoder.hidden:
        layer.bias.fill_(-100.0)
    code = torch.zeros(4, requires_grad=True)
    with using_threads(1):
        (gradient,) = torch.autograd.grad(decoder.at(code)(torch.rand(3, 3)), code, torch.full((3,), torch.nan))
    assert gradient.isnan().all()


@with_compiler
def test_a_code_has_a_gradient_though_points_have_none_and_are_changed_afterwards():
    decoder, points = make("skip"), torch.rand(20, 3)
    code = torch.linspace(-1, 1, 4).requires_grad_()
    with using_threads(1):
        (expected,) = torch.autograd.grad(decoder.at(code)._forward(points).sum(), code)
        values = decoder.at(code)(points)
        points.mul_(2)
        (gradient,) = torch.autograd.grad(values.sum(), code)
    torch.testing.assert_close(gradient, expected, rtol=1e-5, atol=1e-6)


@with_compiler
def test_compiled_gradients_have_a_derivative_towards_those_of_the_values():
    """Which the derivatives of a rendering by the points' motion use (task=gradients)."""
    field, weights = make("skip").at(torch.zeros(4)), torch.linspace(1, 2, 5).requires_grad_()
    points = torch.rand(5, 3, requires_grad=True)
    with using_threads(1):
        (gradient,) = torch.autograd.grad(field(points), points, weights, create_graph=True)
        (derivative,) = torch.autograd.grad(gradient.sum(), weights)
        (expected,) = torch.autograd.grad(field(points).sum(), points)
    torch.testing.assert_close(derivative, expected.sum(1))


@with_compiler
def test_weights_with_a_gradient_another_type_or_threads_are_left_to_torch(monkeypatch):
    monkeypatch.setattr(environment, "kernels", lambda: COMPILED)
    monkeypatch.setattr(BoundDecoder, "_compiled", lambda self: pytest.fail("compiled code was asked"))
    points, code = torch.rand(5, 3), torch.zeros(4)
    with using_threads(1):
        assert make("skip").requires_grad_(True).at(code)(points).requires_grad
        make("skip").double().at(code.double())(points.double())
    with using_threads(2), torch.no_grad():
        make("skip").at(code)(points)
        assert environment.describe(torch.device("cpu"))["kernels"] == "torch: compiled code is for one thread of a CPU"


@with_compiler
def test_values_follow_weights_that_are_being_learnt():
    decoder, points = make("skip").requires_grad_(True), torch.rand(5, 3)
    field = decoder.at(torch.zeros(4))
    with using_threads(1), torch.no_grad():
        before = field(points)
        assert field._compiled() is field._compiled()
        decoder.last.weight.mul_(2)
        assert not torch.allclose(field(points), before)
        torch.testing.assert_close(field(points), field._forward(points), rtol=1e-6, atol=1e-6)
    with using_threads(1), torch.inference_mode():
        torch.testing.assert_close(make("skip").at(torch.zeros(4))(points), make("skip").at(torch.zeros(4))(points))


def test_torch_alone_is_left_to_torch_and_nothing_else_can_be_asked_for(monkeypatch, tmp_path):
    assert fresh(monkeypatch, tmp_path, **{library.KERNELS_VARIABLE: "torch"}) == library.Kernels(None, "torch")
    with pytest.raises(ValueError, match=f"{library.KERNELS_VARIABLE} must be torch or compiled, not 'cuda'"):
        fresh(monkeypatch, tmp_path, **{library.KERNELS_VARIABLE: "cuda"})
    assert not list(tmp_path.iterdir())


def test_without_a_compiler_a_cache_or_the_processor_it_is_torch_and_says_why(monkeypatch, tmp_path):
    monkeypatch.setattr(library, "REQUIRED_CPU_FLAGS", set())
    assert fresh(monkeypatch, tmp_path, PATH="").description == "torch: no compiler (g++ or clang++)"
    broken = tmp_path / "bin" / "g++"
    broken.parent.mkdir()
    broken.write_text("#!/bin/sh\necho it is broken >&2\nexit 1\n")
    broken.chmod(0o755)
    assert fresh(monkeypatch, tmp_path, PATH=str(broken.parent)).description == "torch: g++: it is broken"
    file = tmp_path / "file"
    file.touch()
    assert fresh(monkeypatch, file, PATH=str(broken.parent)).description.startswith("torch: [Errno")
    monkeypatch.setattr(library, "REQUIRED_CPU_FLAGS", {"a-flag-of-none"})
    assert fresh(monkeypatch, tmp_path).description == "torch: the processor lacks a-flag-of-none"


@pytest.mark.slow
@with_compiler
def test_processes_that_build_at_once_share_one_file_and_a_damaged_one_is_built_anew(tmp_path, monkeypatch):
    program = "from renderers.kernels.library import kernels; print(kernels().description)"
    environment = {**os.environ, "XDG_CACHE_HOME": str(tmp_path), library.KERNELS_VARIABLE: ""}
    command = [sys.executable, "-c", program]
    several = [subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True) for _ in range(2)]
    assert [process.communicate()[0].strip() for process in several] == ["compiled"] * 2
    (built,) = (tmp_path / "implicit-bench" / "kernels").iterdir()
    whole = built.read_bytes()
    built.unlink()
    built.write_bytes(whole[:100])
    assert fresh(monkeypatch, tmp_path).description == "compiled" and built.stat().st_size > 1000
