# SPDX-License-Identifier: Apache-2.0
"""The site's hooks (mkdocs.yml): pages from outside docs/, and nothing from other hosts."""

from __future__ import annotations

import posixpath
import re
from pathlib import Path
from typing import Any

from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File

ROOT = Path(__file__).resolve().parents[1]

# Where a file of the repository is in the site.
OUTSIDE = {
    "README.md": "readme.md",
    "ARCHITECTURE.md": "architecture.md",
    "CHANGELOG.md": "changelog.md",
    "CONTRIBUTING.md": "contributing.md",
    "SECURITY.md": "security.md",
    "protocol/FRAMES.md": "frames.md",
    **{f"examples/{path.name}": f"examples/{path.name}" for path in ROOT.glob("examples/*.*")},
    **{
        f"integrations/{path.parent.name}/README.md": f"integrations/{path.parent.name}.md"
        for path in ROOT.glob("integrations/*/README.md")
    },
    "integrations/notebook/skin.ipynb": "integrations/notebook/skin.ipynb",
}
_INSIDE = {uri: path for path, uri in OUTSIDE.items()}
_LINK = re.compile(r"(\]\()([^)#\s:]+)((?:#[^)\s]*)?\))")
_LOADED = re.compile(
    r"<(?:script|img|iframe|source|link)\b[^>]*\b(?:src|href)=[\"']?(?:https?:)?//"
)


def on_files(files: Any, *, config: Any) -> Any:
    """Add what is outside docs/."""
    for path, uri in OUTSIDE.items():
        files.append(File.generated(config, uri, abs_src_path=str(ROOT / path)))
    return files


def on_page_markdown(markdown: str, *, page: Any, **_: Any) -> str:
    """Links are of the repository, where they work as well: make them the site's."""
    uri = page.file.src_uri
    here = posixpath.dirname(_INSIDE.get(uri, f"docs/{uri}"))

    def moved(link: re.Match[str]) -> str:
        path = posixpath.normpath(posixpath.join(here, link[2]))
        target = OUTSIDE.get(path, path.removeprefix("docs/"))
        return link[1] + posixpath.relpath(target, posixpath.dirname(uri) or ".") + link[3]

    return _LINK.sub(moved, markdown)


def on_post_page(output: str, *, page: Any, **_: Any) -> str:
    """Refuse a page that loads something from another host."""
    if loaded := _LOADED.search(output):
        raise PluginError(f"{page.file.src_uri} loads from another host: {loaded[0]}")
    return output
