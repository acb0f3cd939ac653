"""Gradients of ``rasterization``: leaves, losses, and comparison with finite differences."""

import torch
from scenes import rasterized


def leaves(scene):
    """A copy of a scene whose tensors require gradients."""
    return {name: tensor.clone().requires_grad_() for name, tensor in scene.items()}


def weighted_sum(picture):
    """One number, in which every pixel has its own weight."""
    weights = torch.linspace(-1.0, 1.0, picture.numel(), dtype=picture.dtype)
    return (picture.flatten() * weights).sum()


def intrinsic_matrices(lenses):
    """K of focal lengths and principal points [C, 4]."""
    fx, fy, cx, cy = lenses.unbind(dim=1)
    zero, one = torch.zeros_like(fx), torch.ones_like(fx)
    return torch.stack([fx, zero, cx, zero, fy, cy, zero, zero, one], dim=1).reshape(-1, 3, 3)


def lenses_of(Ks):
    """Focal lengths and principal points [C, 4]."""
    return Ks[:, [0, 1, 0, 1], [0, 1, 2, 2]].clone()


def check_gradients(loss, inputs):
    """Compare the gradients of a loss with finite differences."""
    for tensor in inputs:
        tensor.requires_grad_()
    assert torch.autograd.gradcheck(loss, inputs, eps=1e-6, atol=1e-6, rtol=1e-4)


def check_scene(scene, names, **options):
    """Compare the gradients of a scene's tensors with finite differences."""

    def loss(*tensors):
        arguments = {**scene, **dict(zip(names, tensors, strict=True))}
        picture, alpha, _ = rasterized(arguments, backend="reference", **options)
        return weighted_sum(picture) + alpha.square().sum()

    check_gradients(loss, [scene[name] for name in names])
