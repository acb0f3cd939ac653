"""Cameras of photos by Depth Anything 3: one pass over all photos, or several that are joined."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from igsr.capture import Camera
from igsr.capture.photo_folder import MIN_PHOTOS, Photo
from igsr.errors import IgsrError
from igsr.geometry.similarity import similarity_between
from igsr.pose.alignment import AlignedPhoto
from igsr.pose.all_evidence import Evidence, with_all_evidence
from igsr.pose.colmap.matcher import Matcher
from igsr.pose.colmap.named_matchers import SIFT, matcher_of
from igsr.pose.da3.chunks import chunks_of, joined
from igsr.pose.da3.confidence import sure_pixels, trusted_depths
from igsr.pose.da3.passes import SOURCES, Predictor
from igsr.pose.estimate import Estimate
from igsr.pose.fused_points import fused_points, joined_points
from igsr.pose.given_cameras import check_given_cameras
from igsr.pose.name_lists import listed
from igsr.pose.photo_samples import usable

#: What messages call it.
NETWORK = "Depth Anything 3"
#: Distance of a principal point from the middle, in units of the side, that is told of: the network
#: takes it to be in the middle.
OFF_CENTRE = 0.05
#: Greatest distance of cameras, in units of the median depth, that is called one place.
ONE_PLACE = 1e-3


class Da3:
    """Depth Anything 3 (arXiv 2511.10647) as an estimator.

    Args:
        predictor: what stands where the network stands; by default the network itself.
        checkpoint: safetensors file with the network's weights, or the folder that it lies in; by
            default where they usually lie.
        cameras: by photo name, the cameras of all photos, if they are known; they stay as they are,
            and depths are found for them.
        cameras_from: "decoder", the network's prediction of cameras, or "rays", what fits its
            prediction of every pixel's ray best; that takes longer.
        bundle_adjustment: whether cameras that are found rest on features, too, where photos share
            some (``igsr.pose.all_evidence``).
        matcher: what finds and matches these features, as for ``Colmap``.
    """

    name = "da3"

    def __init__(
        self,
        predictor: Predictor | None = None,
        checkpoint: str | os.PathLike[str] | None = None,
        cameras: Mapping[str, Camera] | None = None,
        cameras_from: str = SOURCES[0],
        bundle_adjustment: bool = True,
        matcher: str | Matcher = SIFT,
    ) -> None:
        """Keep the settings; nothing is loaded yet."""
        self.predictor = predictor
        self.checkpoint = None if checkpoint is None else Path(checkpoint)
        self.cameras = dict(cameras or {})
        self.cameras_from = cameras_from
        self.bundle_adjustment = bundle_adjustment
        self.matcher = matcher_of(matcher)

    def __call__(
        self,
        photos: Sequence[Photo],
        *,
        seed: int = 0,
        progress: Callable[[str, int, int], None] | None = None,
    ) -> Estimate:
        """Find the cameras of photos, or depths for cameras that are known.

        Photos of one device, size and EXIF focal length, upright or not, share their focal length;
        principal points are in the middle. Photos that are the same picture get the same camera.

        Args:
            photos: at least two, of which two differ.
            seed: of what samples rays and verifies matches.
            progress: called with ("passes", photos that are done, photos of all passes), then with
                COLMAP's stages.

        Raises:
            IgsrError: there are under two different photos, cameras are known of some photos only,
                of none of them or of another size, no checkpoint is found, a photo is too narrow,
                or two photos do not fit into memory.
        """
        different, same_as = _different(photos)
        if len(different) < MIN_PHOTOS:
            only = f"; all are the same as {photos[0].name}" if len(photos) > 1 else ""
            raise IgsrError(f"Cameras are found from {MIN_PHOTOS} different photos at least{only}")
        self._check_cameras(photos)
        predictor, weights = (self.predictor, None) if self.predictor else self._network()
        shown = [photos[i] for i in different]
        chunks = chunks_of(len(shown), predictor.most_photos(shown))
        in_all, done = sum(len(chunk) for chunk in chunks), 0
        passes = []
        for chunk in chunks:
            part = [shown[i] for i in chunk]
            known = [self.cameras[photo.name] for photo in part] if self.cameras else None
            _check_apart(known)
            predicted = predictor(part, known, seed)
            placed = {i: one for i, one in zip(chunk, predicted, strict=True) if one is not None}
            passes.append(self._with_given(placed, shown) if known else placed)
            done += len(chunk)
            if progress is not None:
                progress("passes", done, in_all)
        lost: list[int] = []
        if self.cameras:
            world = {i: one for each in reversed(passes) for i, one in each.items()}
        else:
            world, lost = joined(passes)
        aligned = [world.get(i) for i in range(len(shown))]
        evidence = None
        if not self.cameras:
            aligned = with_shared_focals(shown, aligned)
            if self.bundle_adjustment:
                sure = [None if one is None else sure_pixels(one) for one in aligned]
                evidence = with_all_evidence(
                    shown, aligned, sure, NETWORK, self.matcher, seed, progress
                )
        found = self._estimate(photos, shown, same_as, aligned, lost, evidence)
        found.weights = weights
        return found

    def _estimate(
        self,
        photos: Sequence[Photo],
        shown: Sequence[Photo],
        same_as: Sequence[int],
        aligned: Sequence[AlignedPhoto | None],
        lost: Sequence[int],
        evidence: Evidence | None,
    ) -> Estimate:
        warnings = self._warnings(photos, shown, aligned, lost, evidence)
        predicted = [None if one is None else one.camera for one in aligned]
        cameras = predicted if evidence is None else evidence.cameras
        aligned = aligned if evidence is None else evidence.photos
        trusted = trusted_depths(aligned)
        for photo, placed, sure in zip(shown, aligned, trusted, strict=True):
            if placed is not None and sure is not None:
                sure &= usable(photo, placed.grid)
        places = [aligned[i] for i in same_as]
        return Estimate(
            cameras=[
                self.cameras[photo.name] if self.cameras else cameras[i]
                for photo, i in zip(photos, same_as, strict=True)
            ],
            points=joined_points(
                None if evidence is None else evidence.points,
                fused_points(shown, aligned, trusted),
            ),
            depths=[None if one is None else one.depth for one in places],
            trusted=[trusted[i] for i in same_as],
            warnings=warnings,
            grids=[None if one is None else one.grid for one in places],
            lenses=[] if evidence is None else [evidence.lenses[i] for i in same_as],
            evidence=[] if evidence is None else [evidence.evidence[i] for i in same_as],
        )

    def _warnings(
        self,
        photos: Sequence[Photo],
        shown: Sequence[Photo],
        aligned: Sequence[AlignedPhoto | None],
        lost: Sequence[int],
        evidence: Evidence | None,
    ) -> list[str]:
        found = []
        missing = {i for i, one in enumerate(aligned) if one is None}
        if evidence is not None:
            # What the network places nowhere may have features.
            missing &= {i for i, one in enumerate(evidence.cameras) if one is None}
            found += evidence.warnings
        lost = [i for i in lost if i in missing]
        no_camera = [shown[i].name for i in sorted(missing.difference(lost))]
        if no_camera:
            found.append(
                f"Not registered: {listed(no_camera)}. What Depth Anything 3 predicts for them is "
                "no camera; leave them out, or take more photos between them and the others"
            )
        if lost:
            found.append(
                f"Not registered: {listed([shown[i].name for i in lost])}. Their pass shares "
                "nothing with the others that both are sure of; name photos in the order they were "
                "taken"
            )
        placed = [one for one in aligned if one is not None]
        if len(placed) > 1:
            centres = np.stack([one.camera.center for one in placed])
            spread = float(np.linalg.norm(centres - centres[0], axis=1).max())
            if spread <= ONE_PLACE * float(np.median([np.nanmedian(one.depth) for one in placed])):
                found.append(
                    "All photos seem to be taken from one place, from where nothing shows how far "
                    "things are; take photos from different places"
                )
        off = [
            name
            for name, camera in self.cameras.items()
            if abs(camera.K[0, 2] / camera.width - 0.5) > OFF_CENTRE
            or abs(camera.K[1, 2] / camera.height - 0.5) > OFF_CENTRE
        ]
        if off:
            found.append(
                f"The principal point is far from the middle of {listed(off)}, where Depth "
                "Anything 3 takes it to be, so depths may be off; give whole photos, not parts"
            )
        return found

    def _with_given(
        self, placed: dict[int, AlignedPhoto], shown: Sequence[Photo]
    ) -> dict[int, AlignedPhoto]:
        """A pass brought to the world of the cameras that are known, with those cameras."""
        if not placed:
            return placed
        given = {i: self.cameras[shown[i].name] for i in placed}
        order = sorted(placed)
        similarity = similarity_between(
            [placed[i].camera for i in order], [given[i] for i in order]
        )
        return {i: replace(placed[i].mapped(similarity), camera=given[i]) for i in order}

    def _network(self) -> tuple[Predictor, dict[str, str]]:
        from igsr.pose.da3.checkpoint import find_checkpoint, load_network, stated
        from igsr.pose.da3.passes import Da3Predictor
        from igsr.pose.weights import sha256_of

        found = find_checkpoint(self.checkpoint)
        if found is None:
            raise IgsrError(
                "no checkpoint of Depth Anything 3 is found; get one by 'igsr weights fetch "
                "da3-base', or name one by --checkpoint"
            )
        network = load_network(found)
        weights = {**stated(network.config), "sha256": sha256_of(found)}
        return Da3Predictor(network, self.cameras_from), weights

    def _check_cameras(self, photos: Sequence[Photo]) -> None:
        check_given_cameras(self.cameras, photos)
        missing = [photo.name for photo in photos if photo.name not in self.cameras]
        if self.cameras and missing:
            raise IgsrError(
                f"cameras has none for {listed(missing)}; Depth Anything 3 takes the cameras of "
                "all photos or of none"
            )


def _check_apart(cameras: Sequence[Camera] | None) -> None:
    centres = np.array([camera.center for camera in cameras or ()])
    # Rounding of the coordinates alone: they may be of a map, millions of metres from its origin.
    if len(centres) and np.ptp(centres, axis=0).max() <= 1e-9 * np.abs(centres).max():
        raise IgsrError(
            "the cameras given for photos of one pass all stand at one place, which sets no scale; "
            "leave cameras out"
        )


def with_shared_focals(
    photos: Sequence[Photo], aligned: Sequence[AlignedPhoto | None]
) -> list[AlignedPhoto | None]:
    """The photos with one focal length for those of one camera, in both directions.

    The network predicts one for each photo and direction. They differ by some per cent even where a
    lens has only one.

    Args:
        photos: of one device, size and EXIF focal length were taken by one camera.
        aligned: what is known of them; None where one has no place.
    """
    focals: dict[Hashable, list[float]] = {}
    for photo, one in zip(photos, aligned, strict=True):
        if one is not None:
            K = one.camera.K
            focals.setdefault(_camera_key(photo), []).append(float(np.sqrt(K[0, 0] * K[1, 1])))
    result: list[AlignedPhoto | None] = []
    for photo, one in zip(photos, aligned, strict=True):
        if one is not None:
            K = one.camera.K.copy()
            K[0, 0] = K[1, 1] = float(np.median(focals[_camera_key(photo)]))
            one = replace(one, camera=replace(one.camera, K=K))
        result.append(one)
    return result


def _camera_key(photo: Photo) -> Hashable:
    """Equal for photos that one camera took, upright or not."""
    return photo.device, photo.focal, *sorted(photo.image.shape[:2])


def _different(photos: Sequence[Photo]) -> tuple[list[int], list[int]]:
    """Indices of the photos that differ, and per photo which of these it is the same as."""
    first: dict[Hashable, int] = {}
    different: list[int] = []
    same_as: list[int] = []
    for i, photo in enumerate(photos):
        content = hashlib.sha256(photo.image.tobytes()).digest()
        masked = None if photo.mask is None else np.packbits(photo.mask).tobytes()
        key = photo.image.shape, content, masked
        if key not in first:
            first[key] = len(different)
            different.append(i)
        same_as.append(first[key])
    return different, same_as
