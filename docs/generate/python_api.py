"""The page on the package, from its public names; their docstrings are read when the site is built."""

from __future__ import annotations

from inspect import ismodule

import coec
from generate.markdown import WRITTEN

HEAD = """\
# Python

{written}
{doc}

{entries}"""


def python_page() -> str:
    """Markdown: the docstring of the package, and an entry for each name in `coec.__all__`."""
    public = sorted(getattr(coec, "__all__", ("__version__",)), key=str.lower)
    return HEAD.format(written=WRITTEN, doc=(coec.__doc__ or "").strip(), entries="\n".join(map(_entry, public)))


def _entry(name: str) -> str:
    """The entry of a name. Data have no docstring at run time, so their value is shown."""
    value = getattr(coec, name)
    heading = f'<a id="coec.{name}"></a>\n\n## `coec.{name}`\n\n'
    home = getattr(value, "__module__", None)
    if ismodule(value):
        source = value.__name__
    elif home is not None:
        source = f"{home}.{value.__qualname__}"
    else:
        return f"{heading}`{value!r}`\n"
    return f"{heading}::: {source}\n    options:\n      show_root_heading: false\n      heading_level: 3\n"
