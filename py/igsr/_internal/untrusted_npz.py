"""What reading a damaged or hostile .npz file raises, so that it ends in one sentence."""

from __future__ import annotations

import tokenize
import zipfile
import zlib

#: What zipfile, numpy and json raise on damaged files. RuntimeError: members that are encrypted, of
#: an unknown zip version or nested too deep; the syntax errors: array headers that do not parse;
#: TypeError: an array alone, which is no archive.
DAMAGE = (
    OSError,
    EOFError,
    ValueError,
    KeyError,
    TypeError,
    OverflowError,
    RuntimeError,
    SyntaxError,
    tokenize.TokenError,
    zipfile.BadZipFile,
    zlib.error,
)
