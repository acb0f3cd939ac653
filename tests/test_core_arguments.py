"""Calls of the Rust module: each wrong argument is refused by name, and nothing panics."""

import itertools

import numpy as np
import pytest
import scenes

from igsr import _core

#: Values that fit no argument, or hardly any.
ODD = (None, True, -1, 0, 2**32 - 1, 2**70, 1e308, float("nan"), "", "a\0b", [], {}, b"x", object())


@pytest.fixture(scope="module")
def good():
    """Every function of many arguments with good ones."""
    project = scenes.project_call()
    projected = _core.project(**project)
    size = {"width": 48, "height": 48}
    background = np.zeros(3, np.float32)
    image = _core.rasterize(projected, **size, background=background, backend="cpu")
    v_image = {name: np.ones((48, 48), np.float32) for name in ("v_alpha", "v_depth")}
    v_image["v_color"] = np.ones((48, 48, 3), np.float32)
    drawn = {"projected": projected, "image": image, "background": background}
    backward = {**drawn, **v_image, "absolute": True, "backend": "cpu"}
    v_projected = _core.rasterize_backward(**backward)
    timing = {**v_image, "background": background, "repeats": 1}
    return {
        "project": project,
        "rasterize_backward": backward,
        "project_backward": {**project, "projected": projected, "v_projected": v_projected},
        "time_rasterize": {"projected": projected, **size, **timing, "backend": "cpu"},
        "time_pipeline": {**project, **timing},
        "Fitter": {
            "images": [np.zeros((48, 48, 3), np.uint8)],
            "masks": [None],
            "backgrounds": [None],
            "schedule": [(1, None)],
            "viewmats": project["viewmat"][None],
            "intrinsics": project["intrinsics"][None],
            "state": {name: project[name] for name in ("means", "quats", "scales", "opacities")}
            | {"sh": project["colors"]},
            "config": {"steps": 2, "sh_degree": 1},
            "backend": "cpu",
        },
    }


FUNCTIONS = ["project", "rasterize_backward", "project_backward", "time_rasterize"]
FUNCTIONS += ["time_pipeline", "Fitter"]


@pytest.mark.parametrize("function", FUNCTIONS)
def test_missing_unknown_and_doubled_arguments_are_type_errors(good, function):
    call, arguments = getattr(_core, function), good[function]
    call(**arguments)
    for name in arguments:
        rest = {key: value for key, value in arguments.items() if key != name}
        with pytest.raises(TypeError, match=rf"{function}\(\) missing .*'{name}'"):
            call(**rest)
    with pytest.raises(TypeError, match=rf"{function}\(\) got an unexpected .*'flavor'"):
        call(**arguments, flavor=1)
    first = next(iter(arguments))
    with pytest.raises(TypeError, match=f"multiple values for argument '{first}'"):
        call(arguments[first], **arguments)
    with pytest.raises(TypeError, match=r"takes \d+ positional arguments, not 30"):
        call(*[None] * 30)


@pytest.mark.parametrize("function", FUNCTIONS)
def test_odd_values_are_refused_by_name_or_harmless(good, function):
    call, arguments = getattr(_core, function), good[function]
    # No odd number of repeats is too large to count to.
    names = [name for name in arguments if name != "repeats"]
    for name, odd in itertools.product(names, ODD):
        try:
            call(**{**arguments, name: odd})
        except (ValueError, RuntimeError) as error:
            assert str(error).strip(), name
    for name in names:
        with pytest.raises(ValueError, match=rf"^{name}"):
            call(**{**arguments, name: object()})


def test_odd_entries_of_dicts_are_refused(good):
    def tried(call, arguments, name):
        given = arguments[name]
        for key in given:
            rest = {other: value for other, value in given.items() if other != key}
            with pytest.raises(ValueError, match=key):
                call(**{**arguments, name: rest})
            for odd in (*ODD, np.zeros(0, np.float32), np.zeros((1, 1, 1, 1), np.float32)):
                with pytest.raises(ValueError, match=r"\w"):
                    call(**{**arguments, name: {**given, key: odd}})

    backward = good["rasterize_backward"]
    tried(_core.rasterize_backward, backward, "image")
    used = ("means2d", "factors", "depths", "colors", "opacities", "radii")
    projected = {name: backward["projected"][name] for name in used}
    tried(_core.rasterize_backward, {**backward, "projected": projected}, "projected")
    tried(_core.Fitter, good["Fitter"], "state")


def test_settings_of_a_fit_are_refused_by_name(good):
    arguments = good["Fitter"]
    words = {
        "density": "must be mcmc, original or fixed, not 'x'",
        "focal": "must be fixed, shared or per-camera, not 'x'",
        "poses": "must be fixed or joint, not 'x'",
    }
    for name, message in words.items():
        with pytest.raises(ValueError, match=f"^{name}: {message}".replace("'", "[\"']")):
            _core.Fitter(**{**arguments, "config": {name: "x"}})
    numbers = ("steps", "seed", "sh_degree", "max_splats", "dropout", "camera_rate", "background")
    for name in numbers:
        config = {"sh_degree": 1, "poses": "joint", name: "many"}
        with pytest.raises(ValueError, match=f"^{name}: "):
            _core.Fitter(**{**arguments, "config": config})
    # None stands for the default.
    defaults = dict.fromkeys((*words, *numbers)) | {"sh_degree": 1, "steps": 2}
    _core.Fitter(**{**arguments, "config": defaults})
