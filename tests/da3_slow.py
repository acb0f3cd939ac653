"""A slow implementation of Depth Anything 3 in float64 and numpy, to compare the network with.

It follows the description of the network, not ``igsr.cameras.da3``: matrix products, not fused
kernels, and complex numbers, not rotated pairs. Only convolutions are torch's.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch.nn import functional

erf = np.vectorize(math.erf)


class SlowDa3:
    """The network on numpy arrays.

    Args:
        weights: per key an array.
        heads: of the attention.
    """

    def __init__(self, weights, heads):
        self.w = {key: np.asarray(value, dtype=np.float64) for key, value in weights.items()}
        self.heads = heads

    def __call__(self, views, reference=0):
        """Depth, confidence and pose encoding per view.

        Args:
            views: [3, H, W] each.
            reference: index of the view that goes first.
        """
        grids = [(view.shape[1] // 14, view.shape[2] // 14) for view in views]
        tokens = [self.embedded(view, *grid) for view, grid in zip(views, grids, strict=True)]
        order = [reference] + [n for n in range(len(views)) if n != reference]
        first, other = self.w["backbone.pretrained.camera_token"][0]
        camera_tokens = [first] + [other] * (len(views) - 1)
        tokens = [tokens[n] for n in order]
        features = [[] for _ in views]
        for n in range(12):
            name = f"backbone.pretrained.blocks.{n}"
            if n == 4:
                for one, token in zip(tokens, camera_tokens, strict=True):
                    one[0] = token
            if n < 5 or n % 2 == 0:
                places = [self.places(*grids[view]) if n > 3 else None for view in order]
                tokens = [
                    self.block(name, one, self.heads, 1e-6, place)
                    for one, place in zip(tokens, places, strict=True)
                ]
                local = tokens
                continue
            places = [np.minimum(self.places(*grids[view]), 1) for view in order]
            places = np.concatenate(places)
            whole = self.block(name, np.concatenate(tokens), self.heads, 1e-6, places)
            tokens = np.split(whole, np.cumsum([len(one) for one in tokens])[:-1])
            for at, view in enumerate(order):
                features[view].append((local[at], tokens[at]))
        return [self.view(pairs, *grid) for pairs, grid in zip(features, grids, strict=True)]

    def embedded(self, view, rows, columns):
        kernel = self.w["backbone.pretrained.patch_embed.proj.weight"]
        patches = view.astype(np.float64).reshape(3, rows, 14, columns, 14)
        patches = patches.transpose(1, 3, 0, 2, 4).reshape(rows * columns, -1)
        patches = patches @ kernel.reshape(len(kernel), -1).T
        patches = patches + self.w["backbone.pretrained.patch_embed.proj.bias"]
        stored = self.w["backbone.pretrained.pos_embed"][0]
        places = stored[1:].reshape(37, 37, -1)
        down, across = (cubic(37, n) for n in (rows, columns))
        places = np.einsum("ri,cj,ijk->rck", down, across, places).reshape(rows * columns, -1)
        first = self.w["backbone.pretrained.cls_token"][0] + stored[:1]
        return np.concatenate([first, patches + places])

    def places(self, rows, columns):
        return np.array([(0, 0), *(np.argwhere(np.ones((rows, columns))) + 1)])

    def block(self, name, x, heads, eps, places=None):
        w, dim = self.w, x.shape[1] // heads
        qkv = self.linear(f"{name}.attn.qkv", self.norm(f"{name}.norm1", x, eps))
        gathered = []
        for head in range(heads):
            q, k, v = (
                qkv[:, (part * heads + head) * dim : (part * heads + head + 1) * dim]
                for part in range(3)
            )
            if f"{name}.attn.q_norm.weight" in w:
                q, k = self.norm(f"{name}.attn.q_norm", q), self.norm(f"{name}.attn.k_norm", k)
            if places is not None:
                q, k = turned(q, places), turned(k, places)
            scores = q @ k.T / math.sqrt(dim)
            scores = np.exp(scores - scores.max(axis=1, keepdims=True))
            gathered.append(scores / scores.sum(axis=1, keepdims=True) @ v)
        x = x + w[f"{name}.ls1.gamma"] * self.linear(f"{name}.attn.proj", np.hstack(gathered))
        hidden = gelu(self.linear(f"{name}.mlp.fc1", self.norm(f"{name}.norm2", x, eps)))
        return x + w[f"{name}.ls2.gamma"] * self.linear(f"{name}.mlp.fc2", hidden)

    def view(self, pairs, rows, columns):
        height, width = 14 * rows, 14 * columns
        levels = []
        for n, (local, whole) in enumerate(pairs):
            patches = np.hstack([local[1:], self.norm("backbone.pretrained.norm", whole[1:])])
            image = self.norm("head.norm", patches).T.reshape(-1, rows, columns)
            image = placed(self.conv(f"head.projects.{n}", image), width / height)
            if n < 2:
                image = self.spread(f"head.resize_layers.{n}", image)
            if n == 3:
                image = self.conv("head.resize_layers.3", image)[:, ::2, ::2]
            levels.append(self.conv(f"head.scratch.layer{n + 1}_rn", image))
        x = resized(self.conv("head.scratch.output_conv1", self.joined(levels)), height, width)
        x = self.conv("head.scratch.output_conv2.0", placed(x, width / height))
        depth, confidence = np.exp(self.conv("head.scratch.output_conv2.2", np.maximum(x, 0)))
        x = np.concatenate([pairs[-1][0][0], pairs[-1][1][0]])
        for n in (0, 2):
            x = np.maximum(self.linear(f"cam_dec.backbone.{n}", x), 0.0)
        place, turn, fov = (self.linear(f"cam_dec.fc_{n}", x) for n in ("t", "qvec", "fov.0"))
        pose = np.concatenate([place, turn, np.maximum(fov, 0.0)])
        return depth, 1 + confidence, pose

    def joined(self, levels):
        x = None
        for n in (4, 3, 2, 1):
            name = f"head.scratch.refinenet{n}"
            height, width = levels[n - 1].shape[1:]
            x = levels[n - 1] if x is None else x + self.unit(f"{name}.resConfUnit1", levels[n - 1])
            x = self.unit(f"{name}.resConfUnit2", x)
            size = levels[n - 2].shape[1:] if n > 1 else (2 * height, 2 * width)
            x = self.conv(f"{name}.out_conv", resized(x, *size))
        return x

    def unit(self, name, x):
        inner = np.maximum(self.conv(f"{name}.conv1", np.maximum(x, 0.0)), 0.0)
        return x + self.conv(f"{name}.conv2", inner)

    def linear(self, name, x):
        return x @ self.w[f"{name}.weight"].T + self.w[f"{name}.bias"]

    def norm(self, name, x, eps=1e-5):
        off = x - x.mean(axis=-1, keepdims=True)
        scaled = off / np.sqrt((off**2).mean(axis=-1, keepdims=True) + eps)
        return scaled * self.w[f"{name}.weight"] + self.w[f"{name}.bias"]

    def conv(self, name, x):
        """A convolution as wide as its input."""
        kernel, bias = torch.from_numpy(self.w[f"{name}.weight"]), self.w.get(f"{name}.bias")
        out = functional.conv2d(torch.from_numpy(x)[None], kernel, padding="same")[0].numpy()
        return out if bias is None else out + bias[:, None, None]

    def spread(self, name, x):
        """A transposed convolution without overlap: each pixel becomes a tile."""
        kernel = self.w[f"{name}.weight"]
        tiles = np.einsum("chw,cdij->dhiwj", x, kernel)
        _, height, side, width, _ = tiles.shape
        flat = tiles.reshape(-1, height * side, width * side)
        return flat + self.w[f"{name}.bias"][:, None, None]


def gelu(x):
    return x * 0.5 * (1.0 + erf(x / math.sqrt(2.0)))


def turned(x, places):
    """Heads' channels as complex numbers, turned by rows in the first half, by columns then."""
    halves = []
    for half, place in zip(np.split(x, 2, axis=1), places.T, strict=True):
        q = half.shape[1] // 2
        angles = place[:, None] * 100.0 ** (-np.arange(q) / q)
        numbers = (half[:, :q] + 1j * half[:, q:]) * np.exp(1j * angles)
        halves += [numbers.real, numbers.imag]
    return np.hstack(halves)


def placed(x, aspect):
    """Maps [c, h, w] with sines and cosines of places, 0.1 high, added."""
    channels, height, width = x.shape
    diagonal = math.hypot(aspect, 1.0)
    u = np.linspace(-1, 1, width) * aspect / diagonal * (width - 1) / width
    v = np.linspace(-1, 1, height) / diagonal * (height - 1) / height
    q = channels // 4
    waves = 100.0 ** (-np.arange(q) / q)
    across, down = (
        np.concatenate([np.sin(np.outer(waves, w)), np.cos(np.outer(waves, w))]) for w in (u, v)
    )
    result = x.copy()
    result[: 2 * q] += 0.1 * across[:, None, :]
    result[2 * q :] += 0.1 * down[:, :, None]
    return result


def resized(x, height, width):
    """Bilinear, corners on corners."""
    maps, size = torch.from_numpy(x)[None], (height, width)
    return functional.interpolate(maps, size, mode="bilinear", align_corners=True)[0].numpy()


def cubic(size, wanted):
    """Cubic convolution (a = -0.75) at places scaled by (wanted + 0.1) / size."""
    if wanted == size:
        return np.eye(size)
    matrix = np.zeros((wanted, size))
    for i in range(wanted):
        place = (i + 0.5) * size / (wanted + 0.1) - 0.5
        for tap in range(math.floor(place) - 1, math.floor(place) + 3):
            d = abs(place - tap)
            weight = (
                1.25 * d**3 - 2.25 * d**2 + 1 if d <= 1 else -0.75 * (d**3 - 5 * d**2 + 8 * d - 4)
            )
            matrix[i, min(max(tap, 0), size - 1)] += weight
    return matrix
