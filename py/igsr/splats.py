"""Splats: the Gaussians of one scene as numpy arrays, and the files that store them."""

from __future__ import annotations

import logging
import os
import pkgutil
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import numpy.typing as npt

from igsr import _core
from igsr._internal.array_equality import ArrayEquality
from igsr._internal.extras import naming_extra
from igsr._internal.notebook import NotebookPicture, numbers
from igsr._internal.user_warning import warn_user
from igsr.errors import IgsrError

if TYPE_CHECKING:
    import torch

logger = logging.getLogger(__name__)

FloatArray = npt.NDArray[np.float32]

#: The arrays of splats, one row per splat.
PARAMETERS = ("means", "quats", "scales", "opacities", "sh")

MAX_SH_DEGREE = 4

#: Number of splats of a backdrop (``igsr.rendering.backdrop``), and their opacity logit.
BACKDROP_SPLATS = 200
BACKDROP_OPACITY = 6.0

#: Suffixes of the files that :meth:`Splats.load` reads, in lower case.
SPLAT_ENDINGS = (".ply", ".splat", ".ksplat", ".spz", ".sog", ".glb", ".gltf")


@dataclass(eq=False, repr=False)
class Splats(ArrayEquality, NotebookPicture):
    """N Gaussians with unbounded parameters, as the optimizer sees them.

    Two are equal (``==``) if all their parameters are. Notebooks show a small render.

    Attributes:
        means: [N, 3] float32, centers relative to ``origin``, world units of the capture.
        quats: [N, 4] float32, rotations w x y z, not necessarily normalized.
        scales: [N, 3] float32, natural logarithms of the standard deviations.
        opacities: [N] float32, logits.
        sh: [N, K, 3] float32, spherical-harmonics coefficients, K = (degree + 1)^2, degree 0-4;
            color = max(0, 0.5 + SH(direction from camera to mean)).
        origin: [3] float64, world position that ``means`` are relative to. It keeps scenes far
            from zero (map coordinates) precise in float32.
        antialiased: whether opacities are antialiased (Mip-Splatting's 2D filter), in the fit and
            in renders.

    Raises:
        IgsrError: an array has the wrong shape or dtype; the message names it.
    """

    _pictures_by: ClassVar[str] = "igsr.rendering.thumbnails:splats_pictures"

    means: FloatArray
    quats: FloatArray
    scales: FloatArray
    opacities: FloatArray
    sh: FloatArray
    origin: npt.NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    antialiased: bool = False

    def __post_init__(self) -> None:
        count = self.means.shape[0] if isinstance(self.means, np.ndarray) and self.means.ndim else 0
        for name, tail in (("means", (3,)), ("quats", (4,)), ("scales", (3,)), ("opacities", ())):
            self._check(name, getattr(self, name), (count, *tail))
        bands = self.sh.shape[1] if isinstance(self.sh, np.ndarray) and self.sh.ndim == 3 else 0
        if bands not in [(degree + 1) ** 2 for degree in range(MAX_SH_DEGREE + 1)]:
            raise IgsrError("sh must be float32 [N, K, 3] with K one of 1, 4, 9, 16, 25")
        self._check("sh", self.sh, (count, bands, 3))
        self.origin = np.asarray(self.origin, dtype=np.float64)
        if self.origin.shape != (3,) or not np.isfinite(self.origin).all():
            raise IgsrError("origin must be three finite numbers")

    @staticmethod
    def _check(name: str, array: object, shape: tuple[int, ...]) -> None:
        if not isinstance(array, np.ndarray):
            raise IgsrError(f"{name} must be a numpy array, not {type(array).__name__}")
        if array.dtype != np.float32 or array.shape != shape:
            raise IgsrError(
                f"{name} must be float32 {list(shape)}, not {array.dtype} {list(array.shape)}"
            )

    def __len__(self) -> int:
        return len(self.means)

    def __repr__(self) -> str:
        antialiased = ", antialiased" if self.antialiased else ""
        return (
            f"Splats({len(self)} splats, SH degree {self.sh_degree}, "
            f"origin {numbers(self.origin)}{antialiased})"
        )

    @property
    def sh_degree(self) -> int:
        """Degree of the stored spherical harmonics, 0-4."""
        return round(self.sh.shape[1] ** 0.5) - 1

    @property
    def backdrop_splats(self) -> int:
        """Number of the last splats that are a backdrop (``igsr.rendering.backdrop``), or 0.

        A backdrop is recognized by its equal shapes, so only in formats without loss.
        """
        if len(self) < BACKDROP_SPLATS:
            return 0
        last = slice(len(self) - BACKDROP_SPLATS, None)
        equal = (
            (self.opacities[last] == np.float32(BACKDROP_OPACITY)).all()
            and (self.scales[last] == self.scales[-1, 0]).all()
            and (self.quats[last] == [1.0, 0.0, 0.0, 0.0]).all()
            and (self.sh[last, 1:] == 0.0).all()
        )
        return BACKDROP_SPLATS if equal else 0

    def without_backdrop(self) -> Splats:
        """Return the splats without their backdrop, or ``self`` if they have none."""
        count = self.backdrop_splats
        return subset(self, slice(len(self) - count)) if count else self

    def with_backdrop_of(self, other: Splats) -> Splats:
        """Add the backdrop of another scene, if it has one, to splats without a backdrop.

        Args:
            other: a scene in the same world; its SH degree may differ.
        """
        count = other.backdrop_splats
        if not count:
            return self
        last = slice(-count, None)
        sh = np.zeros((count, *self.sh.shape[1:]), np.float32)
        sh[:, 0] = other.sh[last, 0]  # further bands are zero
        means = (other.means[last] + (other.origin - self.origin)).astype(np.float32)
        return joined([self, replace(subset(other, last), means=means, sh=sh)])

    @property
    def finite(self) -> npt.NDArray[np.bool_]:
        """bool [N], whether all parameters are finite. Splats with other ones are not drawn."""
        finite: npt.NDArray[np.bool_] = np.isfinite(self.opacities)
        for rows in (self.means, self.quats, self.scales):
            finite &= np.isfinite(rows).all(axis=1)
        finite &= np.isfinite(self.sh).all(axis=(1, 2))
        return finite

    def bounds(self) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]] | None:
        """Compute the box around the centers of the finite splats.

        Returns:
            Lower and upper corner, float64 [3], world frame; None if no splat is finite.
        """
        world = self.means[self.finite].astype(np.float64) + self.origin
        if len(world) == 0:
            return None
        return world.min(axis=0), world.max(axis=0)

    @property
    def extent(self) -> tuple[npt.NDArray[np.float64], float, float]:
        """Center, radius and near plane for renders, without the backdrop, world units.

        Returns:
            The median of the visible splats, float64 [3], relative to ``origin``; the radius that
            contains 90 % of them, at most four times the radius that contains 50 %; and the
            distance in front of a camera from which splats are drawn, 10^-4 radii.
        """
        count = len(self) - self.backdrop_splats
        arrays = (np.ascontiguousarray(array[:count]) for array in (self.means, self.opacities))
        center, radius, near = _core.splat_extent(*arrays)
        return np.array(center), radius, near

    def to_torch(
        self,
        device: torch.device | str | None = None,
        requires_grad: bool = False,
        *,
        origin: npt.ArrayLike = (0.0, 0.0, 0.0),
    ) -> dict[str, Any]:
        """Return the splats as arguments of ``igsr.rasterization`` or gsplat's.

        ``rasterization(**splats.to_torch(), viewmats=..., Ks=..., width=..., height=...)`` draws
        the same as ``igsr.render``. The parameters are activated: scales are lengths and opacities
        are in [0, 1], not logarithms and logits.

        Args:
            device: of the tensors; None is the CPU.
            requires_grad: whether the tensors are leaves that collect gradients.
            origin: [3], world position that the returned means are relative to. Zero is too coarse
                in float32 for a scene far from zero (map coordinates). Use ``splats.origin`` then,
                and move the cameras: ``viewmat[:3, 3] += viewmat[:3, :3] @ splats.origin``, in
                float64.

        Returns:
            "means" [N, 3], "quats" [N, 4] (w x y z), "scales" [N, 3], "opacities" [N] and "colors"
            [N, K, 3] (spherical harmonics), all float32 copies; "sh_degree", int; and
            "rasterize_mode", "antialiased" or "classic".

        Raises:
            IgsrError: ``origin`` is not three finite numbers.
            MissingExtraError: torch is not installed.
        """
        with naming_extra("Splats.to_torch"):
            import torch

        try:
            shift = self.origin - np.asarray(origin, dtype=np.float64)
        except (TypeError, ValueError):
            shift = np.zeros(0)
        if shift.shape != (3,) or not np.isfinite(shift).all():
            raise IgsrError("origin must be three finite numbers")
        means = self.means if not shift.any() else self.means.astype(np.float64) + shift
        tensors = {
            "means": torch.tensor(means, dtype=torch.float32),
            "quats": torch.tensor(self.quats),
            "scales": torch.exp(torch.tensor(self.scales)),
            "opacities": torch.sigmoid(torch.tensor(self.opacities)),
            "colors": torch.tensor(self.sh),
        }
        return {
            **{n: t.to(device).requires_grad_(requires_grad) for n, t in tensors.items()},
            "sh_degree": self.sh_degree,
            "rasterize_mode": "antialiased" if self.antialiased else "classic",
        }

    def show(
        self,
        capture: Any = None,
        background: Sequence[float] = (0.0, 0.0, 0.0),
        height: int = 480,
    ) -> Any:
        """Make a viewer for notebooks: return it from a cell, then drag to orbit.

        Args:
            capture: an ``igsr.Capture`` with cameras to jump to; the view starts at the first one.
                None starts with a view of the whole scene.
            background: RGB in [0, 1] behind the splats.
            height: of the viewer, pixels.

        Returns:
            An object with ``_repr_html_``: the page that ``igsr convert`` writes.

        Raises:
            IgsrError: an argument cannot be used, or the page cannot hold the splats.
        """
        # By name, since the viewer imports this module.
        page = pkgutil.resolve_name("igsr.rendering.notebook_page:notebook_page")
        return page(self, capture, background, height)

    def save(self, path: str | os.PathLike[str]) -> list[str]:
        """Write a file in the format of its suffix.

        ``.ply`` (INRIA's, lossless), ``.compressed.ply``, ``.splat``, ``.spz``, ``.sog``, ``.glb``
        or ``.gltf``. If writing fails, an older file stays as it is.

        Args:
            path: the file; its folder is created.

        Returns:
            Messages about data that the format cannot hold.

        Raises:
            IgsrError: the file cannot be written, or its suffix is unknown.
        """
        try:
            Path(path).parent.mkdir(parents=True, exist_ok=True)
            return _core.write_splats(os.fspath(path), vars(self))
        except OSError as error:
            raise IgsrError(f"{error}.") from error
        except ValueError as error:  # more than the format's fields can count
            raise IgsrError(f"{path}: {error}.") from error

    @staticmethod
    def load(path: str | os.PathLike[str]) -> Splats:
        """Read a splat file: any format of :meth:`save`, or ``.ksplat``.

        The format is detected from the content. A ``UserWarning`` names ignored parts of the file.

        Args:
            path: the file.

        Raises:
            IgsrError: the file does not exist or is not a splat file; the message says why.
        """
        if Path(path).exists() and not Path(path).is_file() and not Path(path).is_dir():
            raise IgsrError(f"{path} is a pipe or a device; save its content to a file first.")
        if (Path(path) / _core.LEVELS_INDEX).is_file():
            raise IgsrError(
                f"{path} is a scene in levels of detail; splat-view draws it, and a level's "
                f"{Path(path) / '0_0' / 'meta.json'} is a splat file."
            )
        if not Path(path).is_file():
            raise IgsrError(f"There is no splat file {path}.")
        try:
            read = _core.read_splats(os.fspath(path))
        except OSError as error:
            raise IgsrError(f"{error}.") from error
        for note in read["notes"]:
            warnings.warn(f"{path}: {note}", stacklevel=2)
        splats = Splats(**{part.name: read[part.name] for part in fields(Splats)})
        broken = len(splats) - int(splats.finite.sum())
        if broken:
            warn_user(f"{path}: {broken} of {len(splats)} splats are not finite and not drawn.")
        logger.info("%s: %r", path, splats)
        return splats


def subset(splats: Splats, chosen: npt.NDArray[np.bool_] | slice) -> Splats:
    """Return the ``chosen`` splats, bool [N] or a slice."""
    return replace(splats, **{name: getattr(splats, name)[chosen] for name in PARAMETERS})


def joined(parts: Sequence[Splats]) -> Splats:
    """Concatenate splats of the same origin and SH degree."""
    arrays: dict[str, Any] = {
        name: np.concatenate([getattr(part, name) for part in parts]) for name in PARAMETERS
    }
    return replace(parts[0], **arrays)
