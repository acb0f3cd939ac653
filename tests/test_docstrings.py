"""Public docstrings: each argument and field is described, and each error that is raised."""

from __future__ import annotations

import ast
import dataclasses
import enum
import importlib
import inspect
import re
import textwrap

import pytest

import igsr
from igsr._internal.settings import settings_of

#: Packages whose ``__all__`` is public.
ROOMS = (
    *("igsr", "igsr.capture", "igsr.geometry", "igsr.rendering", "igsr.evaluation", "igsr.pose"),
    *("igsr.fitting", "igsr.denoiser", "igsr.refinement"),
    *("igsr.compaction", "igsr.floaters"),
)
SECTIONS = ("Args", "Attributes", "Raises", "Returns", "Yields")


def public_things():
    """(name, object) of each public class, function, method and property."""
    things = {}
    for room in ROOMS:
        package = importlib.import_module(room)
        for name in package.__all__:
            thing = getattr(package, name)
            if inspect.isclass(thing) or inspect.isfunction(thing):
                things[f"{thing.__module__}.{thing.__qualname__}"] = thing
                if inspect.isclass(thing):
                    things.update(members(thing))
    return things


def members(cls):
    """Public methods and properties that a class itself defines."""
    return {
        f"{cls.__module__}.{cls.__qualname__}.{name}": getattr(member, "__func__", member)
        for name, member in vars(cls).items()
        if not name.startswith("_")
        and (
            inspect.isfunction(getattr(member, "__func__", member)) or isinstance(member, property)
        )
    }


THINGS = public_things()


def sections(text):
    """The indented text below each heading of a docstring, by heading."""
    found, heading = {"": ""}, ""
    for line in inspect.cleandoc(text).splitlines():
        title = line.removesuffix(":")
        if line.endswith(":") and title in SECTIONS:
            heading = title
            found[heading] = ""
        elif heading and line and not line.startswith(" "):
            heading = ""
        found[heading] += line + "\n"
    return found


def described(text):
    """Names in front of the colons of a section: one, or several with commas between."""
    names = set()
    for entry in re.finditer(r"^    (\S[^:]*?(?:,\n {8}[^:]*?)*):(?!:)", text, re.MULTILINE):
        names.update(name.strip(" *\n") for name in entry[1].split(","))
    return names


def wanted_names(thing):
    """Parameters of a function, or of the class's constructor.

    Not of enums, which are not constructed, and not settings, which carry their own help.
    """
    if inspect.isclass(thing) and issubclass(thing, enum.Enum):
        return set()
    settings = settings_of(thing) if dataclasses.is_dataclass(thing) else {}
    assert all(setting.help for setting in settings.values())
    try:
        parameters = inspect.signature(thing).parameters.values()
    except ValueError:  # the constructor of a builtin
        return set()
    return {
        parameter.name
        for parameter in parameters
        if parameter.name not in ("self", "args", "kwargs", *settings)
        and not parameter.name.startswith("_")
    }


def raises_igsr_error(thing):
    """Whether the code itself, or a class's checks of its fields, raise an ``IgsrError``."""
    if inspect.isclass(thing):
        checks = vars(thing).get("__post_init__")
        return checks is not None and raises_igsr_error(checks)
    if isinstance(thing, property):
        thing = thing.fget
    tree = ast.parse(textwrap.dedent(inspect.getsource(thing)))
    return any(
        isinstance(node, ast.Raise)
        and isinstance(node.exc, ast.Call)
        and getattr(node.exc.func, "id", getattr(node.exc.func, "attr", "")) == "IgsrError"
        for node in ast.walk(tree)
    )


def missing(thing):
    """What the docstring of a thing lacks."""
    text = thing.__doc__ or ""
    # A dataclass without a docstring gets its signature as one.
    if not text or text.startswith(f"{getattr(thing, '__name__', '')}("):
        return ["a docstring"]
    found = sections(text)
    lacks = [] if found[""].split("\n\n")[0].rstrip().endswith((".", ":")) else ["a full stop"]
    of_another = re.match(r"As ``|(?s:.*)Arguments are those of ``", text)
    if not isinstance(thing, property) and not of_another:
        names = described(found.get("Args", "") + found.get("Attributes", ""))
        lacks += sorted(wanted_names(thing) - names)
        if names - wanted_names(thing) and inspect.isfunction(thing):
            lacks += [f"{name}, which is no argument" for name in names - wanted_names(thing)]
    if raises_igsr_error(thing) and "Raises" not in found and "Raises as" not in text:
        lacks.append("Raises")
    return lacks


@pytest.mark.parametrize("name", sorted(THINGS))
def test_docstring_is_complete(name):
    assert missing(THINGS[name]) == []


def test_the_check_sees_what_is_missing():
    def complete(path, *, near, far):
        """Do it.

        Args:
            path: of the file; either
                kind: of file.
            near, far: planes.

        Raises:
            IgsrError: always.
        """
        raise igsr.IgsrError("no")

    assert missing(complete) == []
    complete.__doc__ = complete.__doc__.replace("near, far", "near")
    assert missing(complete) == ["far"]
    complete.__doc__ = complete.__doc__.replace("near:", "far, nearest:")
    assert missing(complete) == ["near", "nearest, which is no argument"]
    complete.__doc__ = "Do it"
    assert missing(complete) == ["a full stop", "far", "near", "path", "Raises"]
    complete.__doc__ = None
    assert missing(complete) == ["a docstring"]
