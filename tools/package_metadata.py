# SPDX-License-Identifier: Apache-2.0
"""The package's README and addresses, when hatchling builds it (pyproject.toml).

The README's links are those of a checkout. Where the project has a public address, OHMSKIN_URL says
it, such as https://example.org/ohmskin, and the links of the packaged README become absolute: files
are below this address as in the checkout. Without OHMSKIN_URL, the README is packaged as it is.
"""

import os
import re
from pathlib import Path
from typing import Any

from hatchling.metadata.plugin.interface import MetadataHookInterface

VARIABLE = "OHMSKIN_URL"
# What the address of each is, below that of the project.
PLACES = {
    "Homepage": "",
    "Documentation": "/docs",
    "Source": "",
    "Issues": "/issues",
    "Changelog": "/CHANGELOG.md",
}
# The beginning of a link or picture that has neither a scheme nor a leading "#" or "/".
RELATIVE = re.compile(r"(\]\()(?![a-zA-Z][a-zA-Z+.-]*:|[#/])")


class Metadata(MetadataHookInterface):
    def update(self, metadata: dict[str, Any]) -> None:
        """Set `readme` and `urls`. Raises ValueError if OHMSKIN_URL is no address."""
        url = os.environ.get(VARIABLE, "").rstrip("/")
        if url and not re.fullmatch(r"https?://[^\s()<>\"]+", url):
            problem = f"{VARIABLE} is {url!r}, which is no address"
            raise ValueError(f"{problem}: say one such as https://example.org/ohmskin, or unset it")
        text = Path(self.root, "README.md").read_text(encoding="utf-8")
        if url:
            text = RELATIVE.sub(rf"\g<1>{url}/", text)
        metadata["readme"] = {"content-type": "text/markdown", "text": text}
        metadata["urls"] = {name: url + place for name, place in PLACES.items()} if url else {}
