"""Docstrings say "Example:" where the parser of the documentation expects "Examples:"."""

import re

import griffe


class Examples(griffe.Extension):
    """Show examples as code."""

    def on_object(self, *, obj, **kwargs):
        """Rename the section of one docstring, before it is parsed."""
        if obj.docstring:
            obj.docstring.value = re.sub(r"^( *)Example:$", r"\1Examples:", obj.docstring.value, flags=re.MULTILINE)
