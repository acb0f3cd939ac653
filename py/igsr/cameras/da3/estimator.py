"""Estimate cameras by Depth Anything 3: one pass over all photos, or several that are joined."""

from __future__ import annotations

import os
from collections.abc import Callable, Hashable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from igsr._internal.name_lists import listed
from igsr.cameras.all_evidence import Evidence, with_all_evidence
from igsr.cameras.checkpoint_search import find_checkpoint
from igsr.cameras.colmap.matchers import AUTO, Choice, chosen_matchers
from igsr.cameras.da3.checkpoint import LICENSE, SIZES, load_network
from igsr.cameras.da3.passes import joined_passes, passes_of
from igsr.cameras.da3.prediction import Da3Predictor, Predictor
from igsr.cameras.depth_maps import (
    AlignedPhoto,
    confident_pixels,
    fused_points,
    joined_points,
    trusted_depths,
)
from igsr.cameras.estimate import Estimate
from igsr.cameras.weights import sha256_of
from igsr.capture.photo_folder import Photo
from igsr.errors import IgsrError

#: Name in messages.
NETWORK = "Depth Anything 3"
#: Maximum distance between cameras that stand at one place, in units of the median depth.
MAX_ONE_PLACE = 1e-3


class Da3:
    """Depth Anything 3 (arXiv 2511.10647) as an estimator.

    Args:
        predictor: predicts cameras and depths; by default the network.
        checkpoint: safetensors file with the network's weights, or its folder; by default it is
            searched for.
        bundle_adjustment: whether to adjust cameras to features (``igsr.cameras.all_evidence``).
        matcher: of these features, as for ``Colmap``.
    """

    name = "da3"

    def __init__(
        self,
        predictor: Predictor | None = None,
        checkpoint: str | os.PathLike[str] | None = None,
        bundle_adjustment: bool = True,
        matcher: Choice = AUTO,
    ) -> None:
        self.predictor = predictor
        self.checkpoint = None if checkpoint is None else Path(checkpoint)
        self.bundle_adjustment = bundle_adjustment
        self.matchers = chosen_matchers(matcher)

    def __call__(
        self,
        photos: Sequence[Photo],
        *,
        seed: int = 0,
        progress: Callable[[str, int, int], None] | None = None,
    ) -> Estimate:
        """Find the cameras of photos.

        Photos of one device, size and EXIF focal length, upright or not, share their focal length;
        principal points are in the center.

        Args:
            photos: at least two.
            seed: of the verification of matches.
            progress: called as progress("passes", done, total), then with COLMAP's stages.

        Raises:
            IgsrError: no checkpoint is found, a photo is too narrow, or two photos do not fit into
                memory.
        """
        predictor, weights = (self.predictor, None) if self.predictor else self._network()
        plan = passes_of(len(photos), predictor.most_photos(photos))
        total, done = sum(len(part) for part in plan), 0
        passes = []
        for part in plan:
            predicted = predictor([photos[i] for i in part], seed)
            placed = zip(part, predicted, strict=True)
            passes.append({i: one for i, one in placed if one is not None})
            done += len(part)
            if progress is not None:
                progress("passes", done, total)
        world, lost = joined_passes(passes)
        aligned = with_shared_focals(photos, [world.get(i) for i in range(len(photos))])
        evidence = None
        if self.bundle_adjustment:
            confident = [None if one is None else confident_pixels(one) for one in aligned]
            evidence = with_all_evidence(
                photos, aligned, confident, NETWORK, self.matchers, seed, progress
            )
        estimate = self._estimate(photos, aligned, evidence)
        estimate.warnings = self._warnings(photos, aligned, lost, evidence)
        estimate.weights = weights
        return estimate

    def _estimate(
        self,
        photos: Sequence[Photo],
        aligned: Sequence[AlignedPhoto | None],
        evidence: Evidence | None,
    ) -> Estimate:
        cameras = [None if one is None else one.camera for one in aligned]
        if evidence is not None:
            cameras, aligned = evidence.cameras, evidence.photos
        trusted = trusted_depths(aligned)
        for photo, placed, mask in zip(photos, aligned, trusted, strict=True):
            if placed is not None and mask is not None:
                mask &= placed.grid.usable(photo)
        return Estimate(
            cameras=cameras,
            points=joined_points(
                None if evidence is None else evidence.points,
                fused_points(photos, aligned, trusted),
            ),
            depths=[None if one is None else one.depth for one in aligned],
            trusted=list(trusted),
            warnings=[],
            grids=[None if one is None else one.grid for one in aligned],
            lenses=[] if evidence is None else evidence.lenses,
            evidence=[] if evidence is None else evidence.evidence,
        )

    def _warnings(
        self,
        photos: Sequence[Photo],
        aligned: Sequence[AlignedPhoto | None],
        lost: Sequence[int],
        evidence: Evidence | None,
    ) -> list[str]:
        warnings = []
        missing = {i for i, one in enumerate(aligned) if one is None}
        if evidence is not None:
            # Features may place photos for which the network predicts no camera.
            missing &= {i for i, one in enumerate(evidence.cameras) if one is None}
            warnings += evidence.warnings
        not_joined = [photos[i].name for i in lost if i in missing]
        no_camera = [photos[i].name for i in sorted(missing.difference(lost))]
        if no_camera:
            warnings.append(
                f"Not registered: {listed(no_camera)}. Depth Anything 3 predicts no valid camera "
                "for them; leave them out, or take more photos between them and the others"
            )
        if not_joined:
            warnings.append(
                f"Not registered: {listed(not_joined)}. Their pass shares no confident pixels "
                "with the others; name photos in the order of capture"
            )
        placed = [one for one in aligned if one is not None]
        if len(placed) > 1:
            centers = np.stack([one.camera.center for one in placed])
            spread = float(np.linalg.norm(centers - centers[0], axis=1).max())
            depth = float(np.median([np.nanmedian(one.depth) for one in placed]))
            if spread <= MAX_ONE_PLACE * depth:
                warnings.append(
                    "All photos seem to be taken from one place, which does not show distances; "
                    "take photos from different places"
                )
        return warnings

    def _network(self) -> tuple[Predictor, dict[str, str]]:
        path = find_checkpoint("da3", self.checkpoint)
        if path is None:
            raise IgsrError(
                "no checkpoint of Depth Anything 3 is found; get one by 'igsr weights fetch "
                "da3-base', or name one by --checkpoint"
            )
        network = load_network(path)
        name = next(name for name, size in SIZES.items() if size == network.config)
        weights = {"name": name, "license": LICENSE, "sha256": sha256_of(path)}
        return Da3Predictor(network), weights


def with_shared_focals(
    photos: Sequence[Photo], aligned: Sequence[AlignedPhoto | None]
) -> list[AlignedPhoto | None]:
    """Give the photos of one camera their median focal length, in both directions.

    The network predicts one for each photo and direction, which differ by some percent.

    Args:
        photos: one camera took all photos of one device, size and EXIF focal length.
        aligned: the same photos, or None.
    """

    def camera_key(photo: Photo) -> Hashable:
        return photo.device, photo.focal, *sorted(photo.image.shape[:2])

    focals: dict[Hashable, list[float]] = {}
    for photo, one in zip(photos, aligned, strict=True):
        if one is not None:
            K = one.camera.K
            focals.setdefault(camera_key(photo), []).append(float(np.sqrt(K[0, 0] * K[1, 1])))
    result: list[AlignedPhoto | None] = []
    for photo, one in zip(photos, aligned, strict=True):
        if one is not None:
            K = one.camera.K.copy()
            K[0, 0] = K[1, 1] = float(np.median(focals[camera_key(photo)]))
            one = replace(one, camera=replace(one.camera, K=K))
        result.append(one)
    return result
