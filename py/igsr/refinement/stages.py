"""The stages of a round, the same for all photos and for the photos of a cross-validation fold."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt
from PIL import Image

from igsr._internal.choices import FitBackend
from igsr.capture import Camera, Capture, View
from igsr.denoiser import Denoiser, photo_support, render_buffers
from igsr.errors import IgsrError
from igsr.evaluation.scores import (
    METRICS,
    ScoredView,
    default_background,
    evaluate,
    known_background,
    score_views,
)
from igsr.fitting.fit_capture import Progress, fit_with_cameras
from igsr.fitting.fitter import with_train_exposures, without_exposures
from igsr.fitting.photo_support import support_of
from igsr.fitting.presets import preset_settings
from igsr.fitting.settings import ExposureMode, TransientMode
from igsr.refinement.cut_highlights import with_cut_highlights
from igsr.refinement.near_sources import NearSources
from igsr.refinement.novel_views import NovelView
from igsr.refinement.results import HELD_OUT_SIDE, Scores, Stage
from igsr.refinement.run import STOPPED, RefineRun
from igsr.refinement.selection import (
    Candidate,
    Rejected,
    denoised_candidate,
    rejected,
)
from igsr.refinement.settings import RefineSettings
from igsr.rendering.backdrop import wants_backdrop, with_backdrop
from igsr.splats import Splats

#: Novel views rendered in a round, and how many of them are added at most.
CANDIDATES, SELECTED = 24, 16
#: Rendering and denoising novel views takes about this part of the time of a fit.
NOVEL_VIEWS_WORK = 0.4
#: Scores that cross-validation compares.
VALIDATED = ("psnr", "ssim", "flip")
#: Proposes novel views from the splats, the known cameras, the most views and the backend.
Propose = Callable[[Splats, Sequence[Camera], int, FitBackend], Sequence[NovelView]]
#: Selects the candidates to add, at most a number of them.
Select = Callable[[Sequence[Candidate], int], list[Candidate]]


@dataclass(eq=False)
class Reconstruction:
    """Splats fitted to some photos and to the novel views that rounds have added.

    Attributes:
        name: "whole" or "fold0", "fold1" ...; checkpoints are named after it.
        photos: that are fitted, with the scene's colors: exposures that the first fit has found are
            taken out of them, and with masks that leave out what it has found to be transient.
        share: the photos' pixels as a part of all; the number of splats goes by it.
        steps: of its fits, as a part of those that all photos are fitted with.
        splats: after the last fit, without a backdrop: holes are to be seen as such.
        shown: the same with the backdrop, if the scene has one: what is scored and written.
        added: novel views that the rounds so far have added.
    """

    name: str
    photos: list[View]
    share: float
    steps: float
    splats: Splats
    shown: Splats
    added: list[NovelView] = field(default_factory=list)


@dataclass(frozen=True, eq=False)
class DenoisedViews:
    """Views of a round, rendered from a reconstruction and denoised.

    Attributes:
        candidates: novel views.
        added_before: the views that earlier rounds added, rendered and denoised again.
    """

    candidates: list[Candidate]
    added_before: list[Candidate]


class Stages:
    """What the stages share: the capture, settings, denoiser, and the run that they report to."""

    def __init__(
        self,
        capture: Capture,
        settings: RefineSettings,
        run: RefineRun,
        denoiser: Denoiser,
        propose: Propose,
        select: Select,
    ) -> None:
        """Keep what is given.

        Raises:
            IgsrError: a setting cannot be used by fits.
        """
        self._capture, self._settings, self._run = capture, settings, run
        self._denoiser, self._propose, self._select = denoiser, propose, select
        self._background = default_background(capture)
        self._backdrop = wants_backdrop(capture.train_views)
        self._background_of_views = known_background(capture.views)
        # Folds have fewer photos and steps, but the settings and learning rate for all of them.
        preset = preset_settings(
            "default",
            support_of(capture.train_views),
            settings.quality,
            steps=settings.steps,
        )
        self._fit_settings = {
            name: preset[name]
            for name in (
                "steps",
                "sh_degree",
                "density",
                "learning_rate",
                "dropout",
                "coarse_to_fine",
            )
        }
        self._max_splats = int(preset["max_splats"])

    @property
    def capture(self) -> Capture:
        """The capture, its train views with the exposures that ``fit_whole`` has found."""
        return self._capture

    def fit_whole(self) -> Reconstruction:
        """Fit all photos; find their exposures and what is transient where that is asked for."""
        views, settings = self._capture.train_views, self._settings
        splats, fitted = self._fit(
            "whole", "fit", views, 1.0, 1.0, settings.exposure, settings.transients
        )
        exposures = [view.exposure for view in fitted.train_views]
        if any(exposures):
            self._capture = with_train_exposures(self._capture, exposures)
        photos = with_cut_highlights(
            without_exposures(fitted.train_views, exposures),
            fitted.train_views,
            splats,
            self._background,
            self._settings.backend,
        )
        shown = self._shown(splats, photos)
        # This fit decides for all, so that none with a backdrop is compared with one without.
        self._backdrop = shown is not splats
        return Reconstruction("whole", photos, 1.0, 1.0, splats, shown)

    def fit(self, name: str, photos: list[View], share: float, steps: float) -> Reconstruction:
        """Fit photos alone, which have the scene's colors; the arguments are the result's."""
        splats, _ = self._fit(name, "fit", photos, share, steps)
        return Reconstruction(name, photos, share, steps, splats, self._shown(splats, photos))

    def render_and_denoise(self, reconstruction: Reconstruction) -> DenoisedViews:
        """Render novel views, and again those that were added before, and denoise them."""
        photos, splats, added = reconstruction.photos, reconstruction.splats, reconstruction.added
        backend = self._settings.backend
        self._run.tell("novel_views")
        known = [photo.camera for photo in photos] + [view.camera for view in added]
        novel = self._propose(splats, known, CANDIDATES, backend)
        support = photo_support(splats, photos, backend)
        sources = NearSources(splats, photos, self._background, backend)
        denoised = []
        for view in (*novel, *added):
            buffers = render_buffers(
                splats, view.camera, support, self._background_of_views, backend
            )
            near = sources.of(view.camera)
            denoised.append(denoised_candidate(view, buffers, near, self._denoiser))
            self._run.tell("novel_views")
        self._run.work_done(NOVEL_VIEWS_WORK * reconstruction.share)
        return DenoisedViews(denoised[: len(novel)], denoised[len(novel) :])

    def select(self, views: DenoisedViews) -> tuple[list[Candidate], list[Rejected]]:
        """The candidates to add, and the others."""
        selected = self._select(views.candidates, SELECTED)
        others = [
            candidate
            for candidate in views.candidates
            if not any(candidate is one for one in selected)
        ]
        return selected, [rejected(candidate) for candidate in others]

    def refit(
        self,
        reconstruction: Reconstruction,
        selected: Sequence[Candidate],
        added_before: Sequence[Candidate],
        stage: Stage,
    ) -> None:
        """Fit photos and novel views from the initialization that the photos alone had.

        A fit that went on from the splats so far would keep what these made up where no photo
        showed better. The seed of a whole fit is another one: the same draws would err where the
        views err. That of a fold stays, so that chance is the same before its round and after it.
        """
        name = f"{reconstruction.name}-round{self._run.round}"
        views = [
            View(
                f"{name}-{number}.png",
                candidate.view.camera,
                "train",
                candidate.denoised,
                mask=None,
                weights=candidate.confidence,
                background=self._background_of_views,
            )
            for number, candidate in enumerate((*selected, *added_before))
        ]
        pictures = [*reconstruction.photos, *views]
        own = seed_of_round(self._settings.seed, self._run.round)
        seed = own if stage == "refit" else None
        splats, _ = self._fit(
            name, stage, pictures, reconstruction.share, reconstruction.steps, seed=seed
        )
        reconstruction.splats = splats
        reconstruction.shown = self._shown(splats, reconstruction.photos)
        reconstruction.added += [candidate.view for candidate in selected]

    def validated(self, splats: Splats, photos: list[View]) -> list[ScoredView]:
        """Held-out photos and their renders with ``VALIDATED`` scores, in small pictures."""
        backend = self._settings.backend
        scored = [
            replace(one, photo=_small(one.photo), render=_small(one.render), mask=None)
            for one in score_views(splats, photos, self._background, backend, VALIDATED)
        ]
        self._run.tell("cross_validate")
        return scored

    def test_scores(self, splats: Splats | None) -> Scores | None:
        """Mean scores of the test views, if there are any."""
        if splats is None or not self._capture.test_views:
            return None
        backend = self._settings.backend
        scores = evaluate(splats, self._capture, "test", self._background, backend)
        self._run.tell("test")
        return {metric: scores[metric] for metric in METRICS}

    def _shown(self, splats: Splats, photos: Sequence[View]) -> Splats:
        """The splats with a backdrop, if the scene wants one."""
        if not self._backdrop:
            return splats
        return with_backdrop(splats, photos, self._settings.backend)

    def _fit(
        self,
        name: str,
        stage: Stage,
        views: list[View],
        share: float,
        steps: float,
        exposure: ExposureMode = "off",
        transients: TransientMode = "off",
        seed: int | None = None,
    ) -> tuple[Splats, Capture]:
        goes_on = True
        whole = int(self._fit_settings["steps"])
        settings = {**self._fit_settings, "steps": max(1, round(steps * whole))}

        def progress(now: Progress) -> bool:
            nonlocal goes_on
            if now.removed is None:  # the end, which resumed fits tell again, is no news
                goes_on = self._run.fitting(stage, share * steps * now.step / now.steps)
            return goes_on

        checkpoint, resume = self._run.checkpoint(name)
        fitted = fit_with_cameras(
            Capture(self._capture.path, views, self._capture.points),
            progress=progress,
            backend=self._settings.backend,
            seed=self._settings.seed if seed is None else seed,
            max_splats=max(1, round(share * self._max_splats)),
            checkpoint=checkpoint,
            resume=resume,
            exposure=exposure,
            transients=transients,
            backdrop=False,
            **settings,
        )
        if not goes_on:  # not raised in the callback, so that the fit saves its checkpoint
            raise IgsrError(STOPPED)
        self._run.work_done(share * steps)
        return fitted


def seed_of_round(seed: int, number: int) -> int:
    """The seed of the fits of a round: other draws than the run's other fits have.

    Args:
        seed: the run's.
        number: of the round, from 1.
    """
    return int(np.random.SeedSequence([seed, number]).generate_state(1)[0])


def _small(picture: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    """A picture, uint8 [H, W, 3], of at most ``HELD_OUT_SIDE`` pixels."""
    image = Image.fromarray(picture)
    image.thumbnail((HELD_OUT_SIDE, HELD_OUT_SIDE), Image.Resampling.BOX)
    return np.asarray(image)
