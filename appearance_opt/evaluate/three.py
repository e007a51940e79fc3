"""three.js, as the page's viewer needs it: the copy that trimesh ships for its own viewer (MIT
licence, which stands in its first lines). Nothing is downloaded."""

from __future__ import annotations

import io
import re
import zipfile
from importlib.resources import files

TEMPLATE, MEMBER = "resources/templates/viewer.zip", "viewer.html.template"
NEEDED = ("@license", "PMREMGenerator", "BufferGeometry")


def library() -> str | None:
    """Source of three.js, which defines ``THREE``; None if this trimesh has none that we know.

    The page that trimesh ships holds one script: the library on lines of its own, and then its
    add-ons, each a function that begins a line.
    """
    try:
        packed = (files("trimesh") / TEMPLATE).read_bytes()
        text = zipfile.ZipFile(io.BytesIO(packed)).read(MEMBER).decode("utf-8")
    except (OSError, KeyError, ValueError, zipfile.BadZipFile):
        return None
    script = text.partition("<script>")[2].partition("</script>")[0]
    core = re.split(r"\n\(function\s*\(\)\s*\{", script)[0]
    return core if all(word in core for word in NEEDED) else None
