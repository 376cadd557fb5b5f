"""Docstrings as Markdown: the stars of `*batch` and G* are no emphasis."""

from typing import Any

from griffe import Extension, Object


class Stars(Extension):
    """Escapes them."""

    def on_instance(self, *, obj: Object, **_: Any) -> None:
        """Change the docstring of everything that is read."""
        if obj.docstring:
            obj.docstring.value = obj.docstring.value.replace("*batch", r"\*batch").replace("G*", r"G\*")
