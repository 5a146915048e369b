# SPDX-License-Identifier: Apache-2.0
# PlatformIO runs this before it builds: the firmware has the version of the package. There is one
# version for both, because `ohmskin doctor` names a board whose firmware is of another one.
import re
from pathlib import Path

Import("env")  # noqa: F821
package = Path(env.subst("$PROJECT_DIR"), "host/ohmskin/version.py")  # noqa: F821
numbers = re.search(r'^VERSION = "(\d+)\.(\d+)\.(\d+)"$', package.read_text(), re.MULTILINE)
names = ("OHMSKIN_VERSION_MAJOR", "OHMSKIN_VERSION_MINOR", "OHMSKIN_VERSION_PATCH")
env.Append(CPPDEFINES=list(zip(names, numbers.groups(), strict=True)))  # noqa: F821
