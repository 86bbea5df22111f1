"""HTML by small functions: all text is escaped unless it was built here."""

from __future__ import annotations

import html
from typing import Any, final

VOID = frozenset({"br", "hr", "img", "meta", "source"})


@final
class Markup(str):
    """Text that is HTML already; any other text is escaped where it is put in."""

    __slots__ = ()


def text(value: Any) -> Markup:
    """Return `value` as HTML: markup as it is, a list as its parts one after the other, all else escaped."""
    if isinstance(value, Markup):
        return value
    if isinstance(value, list | tuple):
        return Markup("".join(text(v) for v in value))
    return Markup(html.escape(str(value), quote=True))


def tag(name: str, /, *children: Any, **attributes: Any) -> Markup:
    """Return an element; `class_` stands for class, an attribute that is None is left out."""
    written = "".join(
        f' {key.rstrip("_").replace("_", "-")}="{html.escape(str(value), quote=True)}"'
        for key, value in attributes.items()
        if value is not None
    )
    if name in VOID:
        return Markup(f"<{name}{written}>")
    return Markup(f"<{name}{written}>{text(list(children))}</{name}>")
