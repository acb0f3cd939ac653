"""Old names: they work, and warn at the line that uses them."""

from __future__ import annotations

import numpy as np
import pytest
import refinements
import scenes

import igsr
from igsr._internal.deprecation import RenamedKeys, renamed_keywords
from igsr.refinement import loop, novel_views, selection
from igsr.refinement.results import Refined, RefineProgress, Round, Stop, StopReason


@renamed_keywords(old="new")
def double(new=0):
    return 2 * new


def renamed(use, message):
    """What ``use`` returns; it must warn, and at a line of this file."""
    with pytest.warns(DeprecationWarning, match=message) as warned:
        value = use()
    assert warned[0].filename == __file__
    return value


def test_keywords():
    assert renamed(lambda: double(old=2), "the keyword old of double is now new") == 4
    assert double(new=2) == 4
    with pytest.raises(TypeError, match="double"):
        double(new=1, old=2)


def test_keys():
    seconds = RenamedKeys({"novel_views": 2.0}, {"look": "novel_views", "judge": "cross_validate"})
    assert renamed(lambda: seconds["look"], "the key 'look' is now 'novel_views'") == 2.0
    assert seconds["novel_views"] == 2.0
    for key in ("judge", "fit"):
        with pytest.raises(KeyError, match=key):
            seconds[key]


def test_attributes_and_module_names_of_refinement():
    view = renamed(lambda: novel_views.UnseenView, "NovelView")(
        scenes.ring_camera(0.0, size=8), 12.0, True
    )
    picture, weights = np.zeros((8, 8, 3), np.uint8), np.ones((8, 8), np.float32)
    one = selection.Candidate(view, picture, picture, weights, 0.5)
    assert renamed(lambda: one.picture, "Candidate.picture is now Candidate.denoised") is picture
    assert renamed(lambda: one.trust, "Candidate.confidence") is weights
    assert renamed(lambda: one.worth, "Candidate.gain") == 0.5
    assert renamed(lambda: one.mean_trust, "mean_confidence") == 1.0
    assert renamed(lambda: selection.passed, "rejected")(one).gain == 0.5
    assert renamed(lambda: selection.trust_of, "confidence_weights") is selection.confidence_weights
    assert renamed(lambda: novel_views.unseen_views, "novel_views") is novel_views.novel_views
    assert renamed(lambda: loop.Choose, "Select") is loop.Select
    with pytest.raises(AttributeError, match="has no attribute 'nothing'"):
        _ = selection.nothing

    done = Round([one], [], {"psnr": 1.0}, {"psnr": 2.0}, True, None, None)
    assert renamed(lambda: done.chosen, "Round.selected") == [one]
    assert renamed(lambda: done.passed, "Round.rejected") == []
    assert renamed(lambda: done.before, "Round.validation_before") == {"psnr": 1.0}
    assert renamed(lambda: done.left_out, "Round.validation_after") == {"psnr": 2.0}
    stop = Stop(StopReason.ROUNDS_DONE, 2)
    refined = Refined(None, None, None, None, [done], stop, [], {})
    assert renamed(lambda: refined.stopped, "Refined.stop") == "2 rounds are done"
    assert renamed(lambda: refined.passed, "Refined.rejected") == []
    now = RefineProgress(1, "cross_validate", 0.5, 2.0)
    assert renamed(lambda: now.doing, "RefineProgress.stage") == "judge"


def test_keywords_of_refine():
    proposed = []

    def look(splats, known, count, backend):
        proposed.append(len(known))
        return []

    capture = scenes.capture(views=4, size=40)
    options = {"steps": 5, "backend": "cpu", "denoiser": refinements.unsure}
    with pytest.warns(DeprecationWarning, match="is now") as warned:
        igsr.refine(capture, 1, look=look, judge=False, choose=selection.select_views, **options)
    names = {str(one.message).split()[2] for one in warned if one.category is DeprecationWarning}
    assert names == {"look", "judge", "choose"}
    assert proposed == [3]
