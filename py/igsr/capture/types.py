"""The types that readers of captures return and fits take: cameras, views, points, captures."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import ClassVar

import numpy as np

from igsr import _core
from igsr._internal.array_equality import ArrayEquality
from igsr._internal.choices import Split
from igsr._internal.notebook import NotebookPicture, numbers
from igsr.capture.exposure import Exposure
from igsr.capture.sharpness import blurred_photos
from igsr.errors import IgsrError

# Maximum of |R R^T - I|: numbers of four or five decimals stay below it, scale and shear do not.
RIGID_TOLERANCE = 1e-3
# Most columns or rows of a camera, for which floats and arrays have room.
MAX_SIDE = 1 << 40
# Maximum of |R R^T - I| of a rotation that was computed in float64.
ROUNDING = 1e-13


@dataclass(frozen=True, eq=False, repr=False)
class Camera(ArrayEquality):
    """A pinhole camera in OpenCV axes: x right, y down, z forward.

    The point (x, y, z) of the camera frame has the pixel coordinates
    (fx x / z + cx, fy y / z + cy); pixel (column i, row j) has its center at (i + 0.5, j + 0.5).
    Cameras with the same fields are equal (``==``) and have the same hash.

    Attributes:
        viewmat: float64 [4, 4], world to camera, in world units. It must be rigid within 1e-3; the
            nearest exact rotation replaces its 3x3 block.
        K: float64 [3, 3], pixels: [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], fx and fy positive.
        width: columns of the image, at least 1.
        height: rows of the image, at least 1.

    Raises:
        IgsrError: a field has another shape, is not finite, is singular or is not rigid.
    """

    viewmat: np.ndarray
    K: np.ndarray
    width: int
    height: int

    def __post_init__(self) -> None:
        object.__setattr__(self, "viewmat", nearest_rigid(self.viewmat, "viewmat"))
        object.__setattr__(self, "K", _checked_intrinsics(self.K))
        for name in ("width", "height"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < 1:
                raise IgsrError(f"{name} is {value!r}; give a whole number of pixels, at least 1")
            if value > MAX_SIDE:
                raise IgsrError(f"{name} is more than {MAX_SIDE} pixels; correct it")
            object.__setattr__(self, name, int(value))

    def __hash__(self) -> int:
        return hash((self.width, self.height, *self.K.ravel(), *self.viewmat.ravel()))

    def __repr__(self) -> str:
        fx, fy = self.K[0, 0], self.K[1, 1]
        return (
            f"Camera({self.width}x{self.height}, focal lengths {numbers((fx, fy))}, "
            f"center {numbers(self.center)})"
        )

    @property
    def center(self) -> np.ndarray:
        """float64 [3]: the camera's position in the world frame, in world units."""
        return np.asarray(-self.viewmat[:3, :3].T @ self.viewmat[:3, 3])


@dataclass(frozen=True)
class PoseEvidence:
    """The source of an estimated camera, and its uncertainty.

    Attributes:
        rests_on: "features" (matches between photos), "network" (a network's prediction) or "both".
        rotation: standard deviation about each axis, degrees.
        center: standard deviation along each axis, world units.

    Raises:
        IgsrError: ``rests_on`` has another value, or a deviation is negative or not finite.
    """

    rests_on: str
    rotation: float
    center: float

    def __post_init__(self) -> None:
        if self.rests_on not in ("features", "network", "both"):
            raise IgsrError(f"rests_on is {self.rests_on!r}; give 'features', 'network' or 'both'")
        for name in ("rotation", "center"):
            if not 0.0 <= getattr(self, name) < np.inf:
                raise IgsrError(
                    f"the {name} of pose_evidence is {getattr(self, name)!r}; give a finite number "
                    "of at least 0"
                )


@dataclass(eq=False, repr=False)
class View(ArrayEquality, NotebookPicture):
    """One photo with its camera.

    Two views are equal (``==``) if all their fields are. A notebook shows the photo.

    Attributes:
        name: the photo's posix path relative to the capture; unique within it.
        camera: the pinhole camera of ``image``.
        split: "train" or "test".
        image: uint8 [H, W, 3] RGB, or [H, W, 4] RGB with straight (not premultiplied) alpha,
            without lens distortion.
        mask: bool [H, W], True for pixels that may be used, or None if all may. It combines the
            photo's own mask with the pixels that undistortion could fill.
        exposure: gain and offset of the photo's colors, found by a fit, or None for the scene's own
            colors. Scores compare the photo with renders at this exposure.
        exposure_value: exposure from the photo's EXIF, in stops (log2 of seconds times ISO / 100
            over the f-number squared), or None.
        depth: float32 [H, W], camera-space z of each pixel, world units, from a sensor or a
            network; 0 for unknown pixels. None if all are unknown.
        depth_confidence: float32 [H, W], confidence of each depth in [0, 1]; None: all are equally
            reliable.
        rig: the name that views of one wide photo (a panorama, a fisheye photo of more than 120
            degrees) share: they have one center, move together and are held out together. None for
            other photos.
        pose_evidence: source and uncertainty of an estimated camera, or None.

    Raises:
        IgsrError: the image, mask or depth has another dtype or shape than the camera's size
            requires, or a depth is negative or not finite.
    """

    _pictures_by: ClassVar[str] = "igsr.capture.thumbnails:view_pictures"

    name: str
    camera: Camera
    split: Split
    image: np.ndarray
    mask: np.ndarray | None = None
    exposure: Exposure | None = None
    exposure_value: float | None = None
    rig: str | None = None
    depth: np.ndarray | None = None
    depth_confidence: np.ndarray | None = None
    pose_evidence: PoseEvidence | None = None

    def __post_init__(self) -> None:
        size = (self.camera.height, self.camera.width)
        self._check("image", self.image, np.uint8, [(*size, 3), (*size, 4)])
        if self.mask is not None:
            self._check("mask", self.mask, np.bool_, [size])
        if self.depth is not None:
            self._check("depth", self.depth, np.float32, [size])
            if not (np.isfinite(self.depth) & (self.depth >= 0.0)).all():
                raise IgsrError(f"{self.name}: its depth must be finite and not negative")
        if self.depth_confidence is not None:
            self._check("depth_confidence", self.depth_confidence, np.float32, [size])
            if self.depth is None:
                raise IgsrError(f"{self.name}: it has depth_confidence without depth")
            if not ((self.depth_confidence >= 0.0) & (self.depth_confidence <= 1.0)).all():
                raise IgsrError(f"{self.name}: its depth_confidence must lie in 0..1")

    @property
    def photo(self) -> str:
        """The name of the photo that the view is part of: its rig, or else its own name."""
        return self.name if self.rig is None else self.rig

    def __repr__(self) -> str:
        parts = [repr(self.name), self.split, f"{self.camera.width}x{self.camera.height}"]
        parts += ["alpha"] if self.image.shape[2] == 4 else []
        parts += [name for name in ("mask", "depth") if getattr(self, name) is not None]
        return f"{type(self).__name__}({', '.join(parts)})"

    @property
    def known_depth(self) -> np.ndarray | None:
        """``depth`` with 0 for pixels of confidence 0; None without depth."""
        if self.depth is None or self.depth_confidence is None:
            return self.depth
        return np.where(self.depth_confidence > 0.0, self.depth, np.float32(0.0))

    def _check(
        self, what: str, array: object, dtype: type[np.generic], shapes: list[tuple[int, ...]]
    ) -> None:
        if not isinstance(array, np.ndarray):
            raise IgsrError(
                f"{self.name}: its {what} is a {type(array).__name__}; give a numpy array"
            )
        if array.dtype != dtype or array.shape not in shapes:
            wanted = " or ".join(str(list(shape)) for shape in shapes)
            raise IgsrError(
                f"{self.name}: its {what} is {array.dtype} {list(array.shape)} where its camera "
                f"needs {np.dtype(dtype)} {wanted}"
            )


@dataclass(eq=False, repr=False)
class PseudoView(View):
    """An image that a fit uses like a photo, such as a denoised novel view.

    Fits take at least five steps on photos for each step on a pseudo-view, and none on pseudo-views
    in the last fifth of the steps.

    Attributes:
        weights: float32 [H, W], weight of each pixel, finite and not negative; photos have 1.
        background: RGB in [0, 1] behind the content of the image; None if it is unknown.

    Raises:
        IgsrError: the weights have another dtype or shape than the image, a weight is negative or
            not finite, or the background is not a color or is given for an image with alpha.
    """

    weights: np.ndarray = field(kw_only=True)
    background: tuple[float, float, float] | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        """Check the pixels against the camera."""
        super().__post_init__()
        self._check("weights", self.weights, np.float32, [self.image.shape[:2]])
        if not (np.isfinite(self.weights) & (self.weights >= 0.0)).all():
            raise IgsrError(f"{self.name}: its weights must be finite and not negative")
        if self.background is not None:
            color = np.asarray(self.background, np.float64)
            if color.shape != (3,) or not ((color >= 0.0) & (color <= 1.0)).all():
                raise IgsrError(f"{self.name}: its background must be three numbers in [0, 1]")
            if self.image.shape[2] == 4:
                raise IgsrError(f"{self.name}: only an image without alpha has a background")


def photos_among(views: Sequence[View]) -> list[View]:
    """Return the views that are photos, not pseudo-views; all if none is a photo."""
    return [view for view in views if not isinstance(view, PseudoView)] or list(views)


@dataclass(eq=False, repr=False)
class Tracks(ArrayEquality):
    """M observations of points in photos. Two are equal (``==``) if all their fields are.

    Attributes:
        names: names of the photos, as ``View.name``.
        view: int64 [M], index into ``names``.
        point: int64 [M], index of the point.
        xy: float64 [M, 2], pixel coordinates in the undistorted photo (pixel centers at +0.5).

    Raises:
        IgsrError: shapes differ, an index is out of range, or a coordinate is not finite.
    """

    names: list[str]
    view: np.ndarray
    point: np.ndarray
    xy: np.ndarray

    def __post_init__(self) -> None:
        count = len(self.view)
        if self.view.shape != (count,) or self.point.shape != (count,):
            raise IgsrError("tracks: view and point must be lists of one length")
        if self.xy.shape != (count, 2) or not np.isfinite(self.xy).all():
            raise IgsrError(f"tracks: xy must be two finite numbers for each of {count}")
        if count and not (self.view.min() >= 0 and self.view.max() < len(self.names)):
            raise IgsrError("tracks: view has an index without a name")

    def __repr__(self) -> str:
        return f"Tracks({len(self.view)} observations in {len(self.names)} photos)"


@dataclass(eq=False, repr=False)
class Points(ArrayEquality):
    """P points in the world frame. Two clouds are equal (``==``) if all their fields are.

    Attributes:
        xyz: float64 [P, 3], world units.
        rgb: uint8 [P, 3].
        confidence: float64 [P], confidence in each position, positive, in any unit: only the
            order counts. None if it is unknown.
        tracks: observations of the points in photos, or None if they are unknown. Fits that move
            cameras derive pose priors from them.

    Raises:
        IgsrError: confidence has another shape or holds a number that is not positive and finite,
            or a track refers to a point that does not exist.
    """

    xyz: np.ndarray
    rgb: np.ndarray
    confidence: np.ndarray | None = None
    tracks: Tracks | None = None

    def __post_init__(self) -> None:
        seen = () if self.tracks is None else self.tracks.point
        if len(seen) and not (np.min(seen) >= 0 and np.max(seen) < len(self.xyz)):
            raise IgsrError("tracks: point has an index without a point")
        if self.confidence is None:
            return
        try:
            self.confidence = np.asarray(self.confidence, dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise IgsrError("confidence is not a list of numbers; give one per point") from error
        shape = self.confidence.shape
        if shape != (len(self.xyz),):
            raise IgsrError(f"confidence has shape {list(shape)}; give [{len(self.xyz)}]")
        if not (np.isfinite(self.confidence) & (self.confidence > 0.0)).all():
            raise IgsrError(
                "confidence holds a number that is not positive and finite; remove such points"
            )

    def __repr__(self) -> str:
        known = [name for name in ("confidence", "tracks") if getattr(self, name) is not None]
        return f"Points({len(self.xyz)} points{''.join(f', {name}' for name in known)})"

    def seen_by(self, names: Iterable[str]) -> Points:
        """Return the points that at least two of the given photos observe, without tracks.

        This hides points from a fit that only held-out photos show. Without tracks, all points are
        returned.

        Args:
            names: names of the photos, as ``View.name``.
        """
        if self.tracks is None or not len(self.tracks.view):
            return self
        wanted, tracks = set(names), self.tracks
        named = np.array([name in wanted for name in tracks.names], np.bool_)[tracks.view]
        both = np.stack([tracks.point[named], tracks.view[named]])
        seen = np.bincount(np.unique(both, axis=1)[0], minlength=len(self.xyz))
        kept = np.flatnonzero(seen >= 2)
        confidence = None if self.confidence is None else self.confidence[kept]
        return Points(self.xyz[kept], self.rgb[kept], confidence)


@dataclass(eq=False, repr=False)
class Capture(ArrayEquality, NotebookPicture):
    """Photos with their cameras and, if the capture has them, points.

    Two captures are equal (``==``) if all their fields are. A notebook shows a few photos.

    Attributes:
        path: the folder or file that the capture was loaded from.
        views: in the order of the file (``transforms.json``) or of the names (COLMAP).
        points: the point cloud, or None.
    """

    _pictures_by: ClassVar[str] = "igsr.capture.thumbnails:capture_pictures"

    path: Path
    views: list[View]
    points: Points | None = None

    def __repr__(self) -> str:
        points = "no" if self.points is None else len(self.points.xyz)
        return (
            f"Capture({str(self.path)!r}, {len(self.views)} views: {len(self.train_views)} train, "
            f"{len(self.test_views)} test; {points} points)"
        )

    @property
    def train_views(self) -> list[View]:
        """The views to fit."""
        return [view for view in self.views if view.split == "train"]

    @property
    def test_views(self) -> list[View]:
        """The held-out views, which are scored and never fitted."""
        return [view for view in self.views if view.split == "test"]

    def with_holdout(self, every: int) -> Capture:
        """Hold out every Nth photo for testing.

        The views of one rig, and photos with the same pixels, count as one photo. If a photo is
        blurred and its neighbors are sharp, the next sharp one is held out instead: a blurred photo
        gives a good fit a bad score.

        Args:
            every: photos, sorted by name, whose index is a multiple of ``every`` become "test", all
                others "train". LLFF and 3DGS use 8.

        Returns:
            A capture with the new split. It shares the images with this one.

        Raises:
            IgsrError: ``every`` is not a whole number of at least 2, or there is only one photo.
        """
        copied = self._copies()
        photos = sorted({copied[view.photo] for view in self.views})
        check_holdout(every, len(photos), self.path)
        blurred = blurred_photos((copied[v.photo], v.image, v.mask) for v in self.views)
        spans = (photos[first : first + every] for first in range(0, len(photos), every))
        sharp_spans = ([name for name in span if name not in blurred] for span in spans)
        held_out = {span[0] for span in sharp_spans if span}
        views = [
            replace(view, split="test" if copied[view.photo] in held_out else "train")
            for view in self.views
        ]
        return Capture(self.path, views, self.points)

    def _copies(self) -> dict[str, str]:
        """For each photo, the first one with the same pixels."""
        first: dict[bytes, str] = {}
        copied: dict[str, str] = {}
        for view in sorted(self.views, key=lambda view: view.name):
            digest = hashlib.sha256(str(view.image.shape).encode())
            digest.update(np.ascontiguousarray(view.image).tobytes())
            copied.setdefault(view.photo, first.setdefault(digest.digest(), view.photo))
        return copied

    def _camera_centers(self) -> np.ndarray:
        return np.stack([view.camera.center for view in self.train_views or self.views])

    @property
    def scene_center(self) -> np.ndarray:
        """float64 [3]: the mean of the training cameras' centers, in world units."""
        return np.asarray(self._camera_centers().mean(axis=0))

    @property
    def scene_extent(self) -> float:
        """1.1 times the largest distance of a training camera from ``scene_center``, world units.

        3DGS scales its learning rates and thresholds by this length (Kerbl et al. 2023). From six
        cameras on, outliers are ignored. It is 1 if all cameras are at the same place, since 0
        would freeze every fit.
        """
        return _core.camera_extent(self._camera_centers()) or 1.0


def check_holdout(every: object, photos: int, path: Path) -> None:
    """Check that every ``every``-th of so many photos, loaded from ``path``, can be held out.

    Raises:
        IgsrError: ``every`` is not a whole number of at least 2, or there is only one photo.
    """
    if isinstance(every, bool) or not isinstance(every, (int, np.integer)) or every < 2:
        raise IgsrError(f"holdout is {every!r}; give a whole number of at least 2, such as 8")
    if photos < 2:
        raise IgsrError(f"{path} has one photo only, so none can be held out; leave holdout out")


def nearest_rigid(matrix: np.ndarray, name: str) -> np.ndarray:
    """Return the rigid matrix, float64 [4, 4], nearest to one that is rigid up to rounding.

    Args:
        matrix: [4, 4], of any numeric dtype.
        name: of the matrix, for error messages.

    Raises:
        IgsrError: the matrix is not [4, 4], not finite, or further than 1e-3 from rigid.
    """
    matrix = _matrix_of_floats(matrix, name, 4)
    if not np.isfinite(matrix).all():
        raise IgsrError(f"{name} holds a NaN or infinite entry; give a finite pose")
    if np.abs(matrix[3] - [0.0, 0.0, 0.0, 1.0]).max() > 1e-6:
        raise IgsrError(f"{name} ends in the row {matrix[3].tolist()}; it must be [0, 0, 0, 1]")
    # Clipped, so that the products below do not overflow.
    block = np.clip(matrix[:3, :3], -1e100, 1e100)
    scale = float(np.cbrt(abs(np.linalg.det(block))))
    deviation = float(np.abs(block @ block.T - np.eye(3)).max())
    if deviation > RIGID_TOLERANCE:
        unscaled = block / scale if scale > 0.0 else block
        hint = "remove scale and shear from it"
        if np.abs(unscaled @ unscaled.T - np.eye(3)).max() <= RIGID_TOLERANCE:
            hint = f"divide its 3x3 block by the uniform scale {scale:.6g}"
        raise IgsrError(
            f"{name} is not rigid: R R^T differs from the identity by {deviation:.3g} "
            f"(at most {RIGID_TOLERANCE:g} passes as rounding); {hint}"
        )
    if np.linalg.det(block) < 0.0:
        raise IgsrError(f"{name} is a reflection (determinant -1); flip one axis of its rotation")
    rigid = np.eye(4)
    rigid[:3, :3] = block
    if deviation > ROUNDING:  # keeps the bits of a matrix that is exact already
        u, _, vt = np.linalg.svd(block)
        rigid[:3, :3] = u @ vt
    rigid[:3, 3] = matrix[:3, 3]
    return rigid


def _checked_intrinsics(K: np.ndarray) -> np.ndarray:
    K = _matrix_of_floats(K, "K", 3)
    for name, value in (("fx", K[0, 0]), ("fy", K[1, 1])):
        if not (np.isfinite(value) and value > 0.0):
            raise IgsrError(
                f"the focal length {name} is {value:g} pixels, so the intrinsics are singular; "
                "give a positive one"
            )
    for name, value in (("cx", K[0, 2]), ("cy", K[1, 2])):
        if not np.isfinite(value):
            raise IgsrError(f"the principal point {name} is {value:g}; give it in pixels")
    if (K[[0, 1, 2, 2, 2], [1, 0, 0, 1, 2]] != [0.0, 0.0, 0.0, 0.0, 1.0]).any():
        raise IgsrError("K is not of the form [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]; remove skew")
    return K


def _matrix_of_floats(matrix: np.ndarray, name: str, size: int) -> np.ndarray:
    """A copy as float64 [size, size]."""
    try:
        copy = np.array(matrix, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise IgsrError(f"{name} is not a matrix of numbers; give {size} rows of {size}") from error
    if copy.shape != (size, size):
        raise IgsrError(f"{name} has shape {list(copy.shape)}; give [{size}, {size}]")
    return copy


def intrinsic_matrix(fx: float, fy: float, cx: float, cy: float) -> np.ndarray:
    """Return the pinhole matrix, float64 [3, 3], of focal lengths and principal point in pixels."""
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
