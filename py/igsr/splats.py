"""Splats: the Gaussians of one scene as numpy arrays, and the files that store them."""

from __future__ import annotations

import os
import warnings
from dataclasses import dataclass, field, fields
from pathlib import Path

import numpy as np
import numpy.typing as npt

from igsr import _core
from igsr.errors import IgsrError

FloatArray = npt.NDArray[np.float32]

#: Highest spherical-harmonics degree there is code for.
MAX_SH_DEGREE = 4

#: Endings of the files that :meth:`Splats.load` reads, in lower case.
SPLAT_ENDINGS = (".ply", ".splat", ".ksplat", ".spz", ".sog", ".glb", ".gltf")


@dataclass
class Splats:
    """N Gaussians with unbounded parameters, as the optimiser sees them.

    Attributes:
        means: [N, 3] float32, centres relative to ``origin``, in the capture's world units.
        quats: [N, 4] float32, rotations w x y z, not necessarily normalised.
        scales: [N, 3] float32, natural logarithms of the standard deviations.
        opacities: [N] float32, logits.
        sh: [N, K, 3] float32, spherical-harmonics coefficients, K = (degree + 1)^2, degree 0-4;
            colour = max(0, 0.5 + SH(direction from camera to mean)).
        origin: [3] float64, world position that ``means`` are relative to. It keeps scenes far
            from zero (map coordinates) precise in float32.
        antialiased: whether they were trained with antialiased opacities (Mip-Splatting's 2D
            filter), and so are to be drawn.

    Raises:
        IgsrError: an array has the wrong shape or dtype; the message names it.
    """

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

    @property
    def sh_degree(self) -> int:
        """Degree of the stored spherical harmonics, 0-4."""
        return round(self.sh.shape[1] ** 0.5) - 1

    @property
    def finite(self) -> npt.NDArray[np.bool_]:
        """bool [N]: which splats have only finite parameters; no other is drawn."""
        finite: npt.NDArray[np.bool_] = np.isfinite(self.opacities)
        for rows in (self.means, self.quats, self.scales):
            finite &= np.isfinite(rows).all(axis=1)
        finite &= np.isfinite(self.sh).all(axis=(1, 2))
        return finite

    def bounds(self) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]] | None:
        """Lowest and highest corner [3] of the finite splats' centres, world frame, or None."""
        world = self.means[self.finite].astype(np.float64) + self.origin
        if len(world) == 0:
            return None
        return world.min(axis=0), world.max(axis=0)

    def save(self, path: str | os.PathLike[str]) -> list[str]:
        """Write a file in the format that the ending of ``path`` names.

        ``.ply`` (INRIA's, which holds everything), ``.compressed.ply``, ``.splat``, ``.spz``,
        ``.sog``, ``.glb`` or ``.gltf``. The file appears whole or not at all: an older one of that
        name survives a failure.

        Returns:
            A sentence for each thing that the format cannot hold.

        Raises:
            IgsrError: the file cannot be written, or its ending is none of these.
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
        """Read a splat file: what :meth:`save` writes, or ``.ksplat``, told by its content.

        Warns of what in the file is passed over.

        Raises:
            IgsrError: there is no such file, or it is no splat file; the message says why.
        """
        if not Path(path).is_file():
            raise IgsrError(f"There is no splat file {path}.")
        try:
            read = _core.read_splats(os.fspath(path))
        except OSError as error:
            raise IgsrError(f"{error}.") from error
        for note in read["notes"]:
            warnings.warn(f"{path}: {note}", stacklevel=2)
        return Splats(**{part.name: read[part.name] for part in fields(Splats)})
